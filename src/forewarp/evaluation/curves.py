"""Record accuracy against training seconds while a run is trained."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import lightning

from forewarp.evaluation.evaluate import flow_error
from forewarp.evaluation.images import validation_psnr
from forewarp.files import read_json, read_rows, written_whole

FILE = "accuracy_time.csv"
COLUMNS = ("seconds", "stage", "step", "psnr", "epe_moving", "size")


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
    (voxels, particles, parameters). The loggers get ``curve/psnr``,
    ``curve/epe_moving`` and ``curve/seconds``. A resumed run continues its rows.

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
        self._before, self._next = 0.0, math.inf

    def on_train_start(self, trainer, module) -> None:
        """Continue the rows of a resumed run; drop rows of steps that were lost."""
        if not len(trainer.datamodule.watched()):
            return
        folder = Path(trainer.default_root_dir)
        done = [read_json(file) or {} for file in folder.parent.glob("*/done.json") if file.parent != folder]
        self._path, self._before = folder.parent / FILE, sum(float(one.get("seconds", 0.0)) for one in done)
        now, rows = self._seconds(module), read_rows(self._path)
        try:
            kept = [row for row in rows if float(row["seconds"]) <= now]
            self._rows = [{name: row[name] for name in COLUMNS} for row in kept]
        except (KeyError, TypeError, ValueError) as error:
            got = "another or half a one; delete it, and the curve begins where training goes on"
            expected = f"a table with the columns {', '.join(COLUMNS)}"
            raise ValueError(f"{self._path}: expected {expected}, but got {got}") from error
        last = float(self._rows[-1]["seconds"]) if self._rows else 0.0
        self._next = next_moment(last, self.first, self.ratio)

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Add a row if it is due."""
        if self._before + module.clock.seconds >= self._next:
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
            curve = {f"curve/{name}": value for name, value in scores.items()} | {"curve/seconds": seconds}
            module.trackers.log(curve, module.global_step)
        self._next = next_moment(seconds, self.first, self.ratio)
