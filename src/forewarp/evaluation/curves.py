"""Record accuracy against training seconds while a run is trained."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import lightning

from forewarp.evaluation.evaluate import flow_error
from forewarp.evaluation.images import validation_psnr
from forewarp.files import read_json, read_rows, written_whole
from forewarp.training.stopping import StopRule

FILE = "accuracy_time.csv"
COLUMNS = ("seconds", "stage", "step", "psnr", "epe_moving", "size")
# Beside a target: how many times later than the one before a row comes at most, and the first row where
# steps alone bound the stage. Its rows then come at certain steps, so that it ends at the same one each time.
_FINE, _FIRST_STEP = 1.1, 32


def next_moment(after: float, first: float, ratio: float) -> float:
    """Return the first of ``first, first * ratio, first * ratio^2, ...`` after a moment.

    >>> [next_moment(after, 2.0, 2.0) for after in (0.0, 2.0, 5.0, 31.0)]
    [2.0, 4.0, 8.0, 32.0]
    """
    moment = first
    while moment <= after:
        moment *= ratio
    return moment


class AccuracyCurve(lightning.Callback):
    """Write ``accuracy_time.csv`` into the run's folder: PSNR of views that are not trained on.

    Use the held-out views (``data.held_out``), else validation views; without either write nothing.
    A row holds ``seconds`` of training over all stages (the clock stands still while a row is made),
    ``stage``, ``step`` of the stage, ``psnr`` (dB, mean over the views, from the same random pixels of each),
    ``epe_moving`` (world units; empty if the scene has no true trajectories) and the method's ``size``
    (voxels, particles, parameters). The loggers get ``curve/held_out/psnr`` or ``curve/val/psnr``,
    ``curve/epe_moving``, and ``curve/seconds_wall`` or ``curve/seconds_processor``, of the clock that the
    budget counts by. A resumed run continues its rows.

    Set ``target`` for the last stage, to end it once the rows say so; they are then made more often.

    Args:
        first: seconds until the first row.
        ratio: each row comes this many times later than the one before; a stage's end has a row, too.
        rays: pixels rendered of each view.

    Cost: ``rays`` pixels and one snapshot for each view, not counted as training time.
    """

    def __init__(self, *, first: float = 2.0, ratio: float = 1.4, rays: int = 10_000) -> None:
        if not (first > 0 and ratio > 1 and rays >= 1 and math.isfinite(first * ratio)):
            expected = "first > 0, ratio > 1 and rays >= 1"
            raise ValueError(f"callbacks.accuracy: expected {expected}, but got {first=}, {ratio=}, {rays=}")
        self.first, self.ratio, self.rays = first, ratio, rays
        self.target, self._by_steps = StopRule(), False
        self._before, self._next = 0.0, math.inf

    def on_train_start(self, trainer, module) -> None:
        """Continue the rows of a resumed run; drop rows of steps that were lost."""
        if not len(trainer.datamodule.watched()):
            return
        folder = Path(trainer.default_root_dir)
        done = [read_json(file) or {} for file in folder.parent.glob("*/done.json") if file.parent != folder]
        self._path, self._before = folder.parent / FILE, sum(float(one.get("seconds", 0.0)) for one in done)
        self._steps_before = sum(int(one.get("steps", 0)) for one in done)
        self._by_steps = self.target.is_set and module.settings.minutes is None
        now, rows = self._seconds(module), read_rows(self._path)
        try:
            kept = [row for row in rows if float(row["seconds"]) <= now]
            self._rows = [{name: row[name] for name in COLUMNS} for row in kept]
        except (KeyError, TypeError, ValueError) as error:
            got = "another or half a one; delete it, and the curve begins where training goes on"
            expected = f"a table with the columns {', '.join(COLUMNS)}"
            raise ValueError(f"{self._path}: expected {expected}, but got {got}") from error
        self._next = self._after(self._time_of(self._rows[-1], module) if self._rows else 0.0)

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Add a row if it is due."""
        by_clock = self._before + module.clock.seconds
        now = self._steps_before + module.global_step if self._by_steps else by_clock
        if now >= self._next:
            self._add(trainer, module)

    def on_train_end(self, trainer, module) -> None:
        """Add the stage's last row."""
        if self._next == math.inf or module.fraction < 1:
            return
        last = self._rows[-1] if self._rows else {}
        if (last.get("stage"), last.get("step")) != (module.settings.name, str(module.global_step)):
            self._add(trainer, module)

    def _seconds(self, module) -> float:
        return round(self._before + module.clock.seconds, 3)  # rounded as in the file

    def _after(self, moment: float) -> float:
        first = _FIRST_STEP if self._by_steps else self.first
        return next_moment(moment, first, min(self.ratio, _FINE) if self.target.is_set else self.ratio)

    def _time_of(self, row: dict, module) -> float:
        """Return when a row was made: seconds of training, or steps where these decide, over all stages."""
        if not self._by_steps:
            return float(row["seconds"])
        return self._steps_before + int(row["step"]) * (row["stage"] == module.settings.name)

    def _check_target(self, module) -> None:
        """End the stage if its rows reach the target; what counts is when the first of two rows did.

        At the stage's end its budget ended it, and a schedule that comes to rest then, not a plateau.
        """
        rows = [row for row in self._rows if row["stage"] == module.settings.name]
        curve = [(self._time_of(row, module), float(row["psnr"])) for row in rows]
        all_in = module.curriculum.in_play == len(module.curriculum.order)
        is_flat = all_in and module.fraction < 1
        if (key := self.target.reached(curve, all_in=is_flat)) is not None:
            when = {"seconds": float(rows[-2]["seconds"]), "step": int(rows[-2]["step"])}
            module.reached = {"reached": key, **when, "held_out_psnr": float(rows[-2]["psnr"])}

    def _add(self, trainer, module) -> None:
        with module.clock.paused():
            seconds = self._seconds(module)
            scores = {"psnr": validation_psnr(module, trainer.datamodule.watched(), self.rays)}
            scores |= {"epe_moving": (flow_error(module, trainer.datamodule.scene) or {}).get("epe_moving")}
            scores = {name: value for name, value in scores.items() if value is not None}
            row = {"seconds": f"{seconds:.3f}", "stage": module.settings.name}
            row |= {"step": str(module.global_step), "size": str(module.method.size[1])}
            self._rows.append(row | {name: f"{value:.6g}" for name, value in scores.items()})
            with written_whole(self._path) as beside, beside.open("w", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS, restval="")
                writer.writeheader()
                writer.writerows(self._rows)
            views = "held_out" if trainer.datamodule.scene.held else "val"
            names = {"psnr": f"{views}/psnr", "epe_moving": "epe_moving"}
            curve = {f"curve/{names[name]}": value for name, value in scores.items()}
            curve[f"curve/seconds_{module.clock.kind}"] = seconds
            module.trackers.log(curve, module.global_step)
            if self.target.is_set:
                self._check_target(module)
        self._next = self._after(self._time_of(self._rows[-1], module))
