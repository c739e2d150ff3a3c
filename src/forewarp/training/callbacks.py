"""What is shown of a stage during training: a progress line and its loggers' curves.

``StageProgress`` stands in for Lightning's bars: they count batches, know no minutes and need a terminal.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence

import lightning
from torch.nn.utils import get_total_norm

from forewarp.methods.method import check_least
from forewarp.progress import ProgressLine, time_text

_SMOOTHING = 0.02  # weight of the newest step in the PSNR shown: a mean over about 50 steps


class StageProgress(lightning.Callback):
    """Show a progress bar with the time left, or a line now and then if stderr is no terminal.

    Args:
        refresh: seconds between two drawings of the bar.
        every: seconds between two lines.

    Set ``later`` to the seconds that the following stages may take: the time left is that of all stages.

    Cost: a step reads the clock; a drawing takes about a millisecond.
    """

    def __init__(self, *, refresh: float = 0.25, every: float = 10.0) -> None:
        self.refresh, self.every = refresh, every
        self.later: float | None = None
        self._line: ProgressLine | None = None

    def on_train_start(self, trainer, module) -> None:
        """Begin the line of this stage."""
        self._line = ProgressLine(module.settings.name, refresh=self.refresh, every=self.every)
        self._psnr, self._seen = 0.0, 0.0
        self._speed: float | None = None
        self._since: tuple[float, int] | None = None

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Update the mean PSNR; draw if it is time. The speed is of the steps after the first, which may wait
        for what is compiled or read.
        """
        self._since = self._since or (time.perf_counter(), module.global_step)
        if math.isfinite(module.last["psnr"]):  # not finite in a skipped step
            self._psnr += _SMOOTHING * (module.last["psnr"] - self._psnr)
            self._seen += _SMOOTHING * (1 - self._seen)
        if self._line.due():
            fraction, seconds = module.fraction, module.clock.seconds
            left = seconds * (1 - fraction) / fraction if fraction > 0 else None
            left = None if left is None else left + (self.later or 0.0)
            with module.clock.paused():
                self._line.show(fraction, left, self._text(module))

    def on_train_end(self, trainer, module, exception=None) -> None:
        """Leave a last line with the final values, also after an exception, and restore the terminal."""
        if self._line is not None:
            text = self._text(module) if module.last else "no step"
            self._line.close(module.fraction, f"{time_text(module.clock.seconds)} trained | {text}")
            self._line = None

    on_exception = on_train_end

    def _text(self, module) -> str:
        curriculum, (kind, count) = module.curriculum, module.method.size
        psnr, speed = self._psnr / max(self._seen, _SMOOTHING), self._steps_a_second(module.global_step)
        return (  # what matters first: a narrow terminal cuts the end
            f"train psnr {psnr:.1f} | "
            + ("" if speed is None else f"{speed:.1f} steps/s | ")
            + f"frames {curriculum.in_play}/{len(curriculum.order)} | {kind} {count:,} | "
            + f"loss {module.last['loss']:.4f}"
        )

    def _steps_a_second(self, step: int) -> float | None:
        now, (before, step_before) = time.perf_counter(), self._since or (0.0, step)
        if step == step_before:
            return self._speed
        speed = (step - step_before) / max(now - before, 1e-6)
        self._since = now, step
        smooth = 0.3 if self._line.terminal and self._speed is not None else 1.0
        self._speed = speed if self._speed is None else self._speed + smooth * (speed - self._speed)
        return self._speed


class Scalars(lightning.Callback):
    """Log the means over the last ``every`` steps of all values in ``module.last``, as ``train/<name>``.

    And of each parameter group the learning rate of the last step, ``lr/<group>``, and the norm of its
    gradient before it is clipped, ``grad_norm/<group>``, which is measured only at steps that are logged.

    Args:
        every: steps between two.
        lr, grad_norm: False leaves these out.
    """

    def __init__(self, *, every: int = 20, lr: bool = True, grad_norm: bool = True) -> None:
        check_least(1, of="callbacks.scalars", every=every)
        self.every, self.lr, self.grad_norm = every, lr, grad_norm
        self._values: dict[str, list[float]] = defaultdict(list)
        self._norms: dict[str, float] = {}

    def on_before_optimizer_step(self, trainer, module, optimizer) -> None:
        """Measure the gradients if the step will be logged."""
        if self.grad_norm and (module.global_step + 1) % self.every == 0:
            with module.clock.paused():
                self._norms = gradient_norms(optimizer.param_groups)

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Collect the values of the step; log their means if it is time."""
        for name, value in module.last.items():
            self._values[name].append(value)
        if module.global_step % self.every == 0:
            self._log(trainer, module)

    def on_train_end(self, trainer, module) -> None:
        """Log the means of the remaining steps."""
        if self._values:
            self._log(trainer, module)

    def _log(self, trainer, module) -> None:
        scalars = {f"train/{name}": sum(values) / len(values) for name, values in self._values.items()}
        self._values.clear()
        for group in trainer.optimizers[0].param_groups if self.lr else ():
            scalars[f"lr/{group['name']}"] = group["lr"]
        scalars |= {f"grad_norm/{name}": norm for name, norm in self._norms.items()}
        self._norms = {}
        with module.clock.paused():
            module.trackers.log(scalars, module.global_step)


def gradient_norms(groups: Sequence[Mapping]) -> dict[str, float]:
    """Return the Euclidean norm of the gradient of each parameter group that has one, by the group's name."""
    found = {}
    for group in groups:
        if gradients := [p.grad for p in group["params"] if p.grad is not None]:
            found[group["name"]] = float(get_total_norm(gradients))
    return found
