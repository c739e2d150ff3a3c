"""The loggers of a run: one run of each tracker for all stages, which goes on after an interruption."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from lightning.pytorch.loggers import CSVLogger, Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter
from torch import Tensor

from forewarp.drawing.images import to_bytes
from forewarp.files import read_json, write_json

IDS = "loggers.json"  # in the run's folder: which run of its tracker each logger goes on with
_PACKAGES = {WandbLogger: "wandb", MLFlowLogger: "mlflow"}


class CsvLogger(CSVLogger):
    """Lightning's CSV logger that keeps the rows of a run that goes on, but for steps that are made again.

    Args:
        save_dir: the run's folder.
        name: of the folder in it.
        first: step that the run goes on from; rows of later steps are dropped.
        options: of Lightning's logger.
    """

    def __init__(self, save_dir: str, name: str = "csv", *, first: int = 0, **options) -> None:
        super().__init__(save_dir, name, **options)
        self.first = first

    @property
    def experiment(self) -> ExperimentWriter:
        """The writer of the file, made at first use."""
        if self._experiment is None:
            file, rows = Path(self.log_dir) / ExperimentWriter.NAME_METRICS_FILE, []
            if file.is_file():
                with file.open(newline="") as lines:
                    rows = [row for row in csv.DictReader(lines) if int(row["step"]) <= self.first]
                file.unlink()
            # Lightning's writer warns of a folder that holds something, and empties it.
            (Path(self.log_dir) / ExperimentWriter.NAME_HPARAMS_FILE).unlink(missing_ok=True)
            writer = super().experiment
            writer.metrics = [{name: value for name, value in row.items() if value} for row in rows]
            writer.save()
        return self._experiment


class RunLoggers:
    """Open the loggers of a run when something is first logged, and close them when the run ends.

    Args:
        makers: for each name a logger that waits for where it writes.
        folder: the run's folder.
        runs: the folder of all runs, where trackers that hold many of them write.
        hyperparameters: gives them by flat name, when something is first logged.

    As a context manager it closes them, as failed after an exception.
    """

    def __init__(
        self,
        makers: Mapping[str, Callable[..., Logger]] = {},
        folder: Path = Path("."),
        runs: Path = Path("."),
        hyperparameters: Callable[[], Mapping[str, object]] = dict,
    ) -> None:
        self.makers, self.folder, self.runs = dict(makers), Path(folder), Path(runs)
        self.hyperparameters = cache(hyperparameters)
        self._open: dict[str, Logger] | None = None
        self._closing: list[Callable[[str], None]] = []
        for name, maker in self.makers.items():
            package = _PACKAGES.get(_class_of(maker), "lightning")
            if find_spec(package) is None:
                raise ImportError(
                    f"logger: expected {package} for {name}, but got none; install forewarp[trackers]"
                )

    def open(self, step: int) -> list[Logger]:
        """List the open loggers; those of a run that goes on leave out what they have after ``step``."""
        if self._open is None:
            self._open, ids = {}, read_json(self.folder / IDS) or {}
            for name, maker in self.makers.items():
                try:
                    self._open[name] = self._begin(name, maker, step, ids)
                except (OSError, KeyboardInterrupt):
                    raise
                except Exception as error:  # of the tracker's own kinds
                    got = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
                    raise ValueError(
                        f"logger.{name}: expected a tracker that takes this run, but got {got}; mend it, or "
                        "leave it out of logger=[...]"
                    ) from error
            if ids:
                write_json(self.folder / IDS, ids)
        return list(self._open.values())

    def _begin(self, name: str, maker: Callable[..., Logger], step: int, ids: dict[str, str]) -> Logger:
        kind, known = _class_of(maker), name in ids
        title = "/".join(self.folder.resolve().parts[-2:])
        if kind is WandbLogger:
            self.runs.mkdir(parents=True, exist_ok=True)  # its links may not lie in a run's folder
            logger = maker(save_dir=str(self.runs), name=title, id=ids.get(name))
        elif kind is MLFlowLogger:
            where = {
                "tracking_uri": maker.keywords.get("tracking_uri") or os.environ.get("MLFLOW_TRACKING_URI")
            }
            if where["tracking_uri"] is None:
                self.runs.mkdir(parents=True, exist_ok=True)
                here = self.runs.resolve()
                where = {"tracking_uri": f"sqlite:///{here}/mlflow.db", "artifact_location": f"{here}/mlflow"}
            logger = maker(**where, run_name=title, run_id=ids.get(name))
        elif kind is TensorBoardLogger:
            logger = maker(save_dir=str(self.folder), purge_step=step + 1 if step else None)
        elif kind is CsvLogger:
            logger = maker(save_dir=str(self.folder), first=step)
        else:
            logger = maker(save_dir=str(self.folder))
        _ = logger.experiment  # connects
        if kind in _PACKAGES:
            ids[name] = str(logger.version)
        if not (known and kind is MLFlowLogger):  # which takes each parameter once
            logger.log_hyperparams(dict(self.hyperparameters()))
        self._closing.append(logger.finalize)
        logger.finalize = lambda status: logger.save()  # Lightning calls it after each stage
        return logger

    def log_scores(self, scores: Mapping[str, float], step: int) -> None:
        """Log the scores of a measured run, in TensorBoard beside its hyperparameters (HPARAMS)."""
        for logger in self.open(step):
            if isinstance(logger, TensorBoardLogger):
                logger.log_hyperparams(dict(self.hyperparameters()), dict(scores), step)
            else:
                logger.log_metrics(dict(scores), step)
            logger.save()

    def __enter__(self) -> RunLoggers:
        return self

    def __exit__(self, kind: type | None, *_) -> None:
        """Close all loggers, as failed after an exception."""
        for close in self._closing:
            close("success" if kind is None else "failed")
        for logger in (self._open or {}).values():
            if isinstance(logger, WandbLogger):  # else the next job of a sweep would go on in this run
                logger.experiment.finish(exit_code=0 if kind is None else 1)
        self._open, self._closing = None, []


def log_scalars(loggers: Sequence[Logger], scalars: Mapping[str, float], step: int) -> None:
    """Log scalars of a step of the run, counted over all its stages (``module.run_step``).

    Not by Lightning's ``self.log``, which repeats at every later step what was logged once.
    """
    for logger in loggers:
        logger.log_metrics(dict(scalars), step)
        logger.save()


def log_image(loggers: Sequence[Logger], name: str, image: Tensor, step: int) -> None:
    """Log an image (H, W, 3) in [0, 1] to each logger that takes images."""
    pixels = to_bytes(image)
    for logger in loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(name, pixels, step, dataformats="HWC")
        elif isinstance(logger, MLFlowLogger):
            logger.experiment.log_image(logger.run_id, pixels, key=name, step=step)
        elif hasattr(logger, "log_image"):  # Weights & Biases, and loggers made like it
            logger.log_image(name, [pixels])


def _class_of(maker: Callable[..., Logger]) -> type:
    return getattr(maker, "func", maker)
