"""What one sees of a stage while it is trained: a progress line and TensorBoard's curves."""

from __future__ import annotations

import math
import time
from collections import defaultdict

import lightning
from lightning.pytorch.loggers import TensorBoardLogger

from forewarp.progress import ProgressLine, time_text

_SMOOTHING = 0.02  # share of the newest step in the PSNR shown: about the last 50 count


class StageProgress(lightning.Callback):
    """A progress bar; where stderr is no terminal, a line every ``every`` seconds.

    Args:
        refresh: seconds between two drawings in a terminal.
        every: seconds between two lines elsewhere.

    ``later`` may be set: the seconds that the stages after this one may take, for the time left of all.

    Cost: a step pays for a look at the clock; a drawing takes about a millisecond.
    """

    def __init__(self, *, refresh: float = 0.25, every: float = 10.0) -> None:
        self.refresh, self.every = refresh, every
        self.later: float | None = None
        self._line: ProgressLine | None = None

    def on_train_start(self, trainer, module) -> None:
        """Begin a line for this stage."""
        self._line = ProgressLine(module.settings.name, refresh=self.refresh, every=self.every)
        self._psnr, self._seen, self._speed = 0.0, 0.0, None
        self._since = time.perf_counter(), module.global_step

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Follow the PSNR; show where it is time."""
        if math.isfinite(module.last["psnr"]):  # else the step was skipped
            self._psnr += _SMOOTHING * (module.last["psnr"] - self._psnr)
            self._seen += _SMOOTHING * (1 - self._seen)
        if self._line.due():
            fraction, seconds = module.fraction, module.clock.seconds
            left = seconds * (1 - fraction) / fraction if fraction > 0 else None
            known = left is not None and self.later
            whole = f"{time_text(left + self.later)} with what follows | " if known else ""
            with module.clock.paused():
                self._line.show(fraction, left, whole + self._text(module))

    def on_train_end(self, trainer, module) -> None:
        """Leave the last values behind."""
        self._close(module)

    def on_exception(self, trainer, module, exception) -> None:
        """Leave the terminal as it was."""
        self._close(module)

    def _close(self, module) -> None:
        if self._line is not None:
            text = self._text(module) if module.last else "no step"
            self._line.close(module.fraction, f"{time_text(module.clock.seconds)} trained | {text}")
            self._line = None

    def _text(self, module) -> str:
        last, playing, (kind, count) = module.last, module.curriculum, module.method.size
        return (
            f"train psnr {self._psnr / max(self._seen, _SMOOTHING):.1f} | loss {last['loss']:.4f} | "
            f"frames {playing.in_play}/{len(playing.order)} | {kind} {count:,} | "
            f"{self._steps_a_second(module.global_step):.1f} steps/s"
        )

    def _steps_a_second(self, step: int) -> float:
        now, (before, step_before) = time.perf_counter(), self._since
        speed = (step - step_before) / max(now - before, 1e-6)
        self._since = now, step
        smooth = 0.3 if self._line.terminal and self._speed is not None else 1.0
        self._speed = speed if self._speed is None else self._speed + smooth * (speed - self._speed)
        return self._speed


class TensorBoardScalars(lightning.Callback):
    """Logs the means over the last ``every`` steps: loss, each raw term, PSNR, rates and counts.

    Keys: ``train/<value>`` for all in ``module.last``, ``lr/<kind>``.
    """

    def __init__(self, *, every: int = 20) -> None:
        if every < 1:
            raise ValueError(f"callbacks.scalars.every: expected at least 1 step, but got {every}")
        self.every = every
        self._values: dict[str, list[float]] = defaultdict(list)

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Remember the step's values; log them where it is time."""
        for name, value in module.last.items():
            self._values[name].append(value)
        if module.global_step % self.every == 0:
            self._log(trainer, module)

    def on_train_end(self, trainer, module) -> None:
        """Log what is left."""
        if self._values:
            self._log(trainer, module)

    def _log(self, trainer, module) -> None:
        scalars = {f"train/{name}": sum(values) / len(values) for name, values in self._values.items()}
        self._values.clear()
        for group in trainer.optimizers[0].param_groups:
            scalars[f"lr/{group['name']}"] = group["lr"]
        with module.clock.paused():
            for logger in trainer.loggers:
                if isinstance(logger, TensorBoardLogger):
                    logger.log_metrics(scalars, module.global_step)
