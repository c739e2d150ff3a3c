"""The loggers of a run: one run of each tracker for all stages, which goes on after an interruption."""

from __future__ import annotations

import csv
import os
import re
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import yaml
from filelock import FileLock
from lightning.pytorch.loggers import CSVLogger, Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter
from lightning.pytorch.utilities.rank_zero import rank_zero_only
from tensorboard.compat.proto.summary_pb2 import Summary
from torch import Tensor

from forewarp.drawing.images import image_size, to_bytes
from forewarp.files import load_yaml, read_json, write_json

IDS = "loggers.json"  # in the run's folder: which run of its tracker each logger goes on with
_PACKAGES = {WandbLogger: "wandb", MLFlowLogger: "mlflow"}
_USER = re.compile(r"(?<=://)[^\s/]*@")  # user and password of a URI
_PATH = re.compile(r"(?:\b(?:file|sqlite):/*|(?<![\w./~:})\]])|(?<=:)(?!//))/[^,:;=\[\]{}'\"\n]+")
_HOME = re.compile(r"/root|(/home|/Users)/[^/]+")


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
                    whole = [row for row in csv.DictReader(lines) if None not in row.values()]
                rows = [row for row in whole if int(row["step"]) <= self.first]  # a killed run tears its last
                file.unlink()
            # Lightning's writer warns of a folder that holds something, and empties it.
            (Path(self.log_dir) / ExperimentWriter.NAME_HPARAMS_FILE).unlink(missing_ok=True)
            writer = super().experiment
            writer.metrics = [{name: value for name, value in row.items() if value} for row in rows]
            writer.save()
        return self._experiment


@dataclass(frozen=True)
class Labels:
    """How trackers file a run.

    Attributes:
        scene: the group of Weights & Biases where there is no sweep.
        sweep: that the run is a job of: that group, and a tag ``sweep`` of MLflow.
        tags: of Weights & Biases, and of MLflow, with the value true.
        config: whether trackers get the run's ``config.yaml`` as text.
    """

    scene: str | None = None
    sweep: str | None = None
    tags: Sequence[str] = ()
    config: bool = False


class RunLoggers:
    """Open the loggers of a run when something is first logged, and close them when the run ends.

    Args:
        makers: for each name a logger that waits for where it writes.
        folder: the run's folder.
        runs: the folder of all runs, where trackers that hold many of them write.
        hyperparameters: gives them by flat name, when something is first logged.
        labels: how trackers file the run.

    As a context manager it closes them, as failed after an exception, and warns of those that hold nothing.
    """

    def __init__(
        self,
        makers: Mapping[str, Callable[..., Logger]] = {},
        folder: Path = Path("."),
        runs: Path = Path("."),
        hyperparameters: Callable[[], Mapping[str, object]] = dict,
        labels: Labels = Labels(),
    ) -> None:
        self.makers, self.folder, self.runs = dict(makers), Path(folder), Path(runs)
        self.hyperparameters, self.labels = cache(hyperparameters), labels
        self._open: dict[str, Logger] | None = None
        self._closing: list[Callable[[str], None]] = []
        self._failed: set[str] = set()
        self._logged: set[str] = set()
        self.before = 0  # steps of the earlier stages
        for name, maker in self.makers.items():
            package = _PACKAGES.get(_class_of(maker), "lightning")
            if find_spec(package) is None:
                expected = f"logger: expected {package} for {name}"
                raise ImportError(f"{expected}, but got none; install forewarp[trackers]")

    def open(self, before: int = 0, step: int = 0) -> list[Logger]:
        """List the open loggers. From now on they log a stage's steps on the axis of the run.

        Args:
            before: steps of the run's earlier stages.
            step: of the stage, from which it goes on; later ones are left out of TensorBoard and CSV files,
                and stay in other trackers beside what is made again.

        Raises:
            ValueError: if a tracker does not take the run.
        """
        self.before = before
        rank_zero_only.rank = 0  # else a launcher's variables may silence them; see ``SingleProcess``
        if self._open is None:
            self._open, ids = {}, read_json(self.folder / IDS) or {}
            for name, maker in self.makers.items():
                try:
                    self._open[name] = self._begin(name, maker, before + step, ids)
                except (OSError, KeyboardInterrupt):
                    raise
                except Exception as error:  # of the tracker's own kinds
                    got = f"{_in_a_line(error)}; mend it, or leave it out of logger=[...]"
                    expected = f"logger.{name}: expected a tracker that takes this run"
                    raise ValueError(f"{expected}, but got {got}") from error
            if ids:
                write_json(self.folder / IDS, ids)
        return list(self._open.values())

    def _begin(self, name: str, maker: Callable[..., Logger], step: int, ids: dict[str, str]) -> Logger:
        kind, known = _class_of(maker), ids.get(name)
        title = "/".join(self.folder.resolve().parts[-2:])
        if kind in _PACKAGES:
            self.runs.mkdir(parents=True, exist_ok=True)
        options = {"save_dir": str(self.folder)}
        if kind is WandbLogger:  # its links may not lie in a run's folder
            group = maker.keywords.get("group") or self.labels.sweep or self.labels.scene
            tags = [*(maker.keywords.get("tags") or ()), *self.labels.tags]
            options = {"save_dir": str(self.runs), "name": title, "id": known, "group": group, "tags": tags}
        elif kind is MLFlowLogger:
            tags = dict.fromkeys(self.labels.tags, "true") | (maker.keywords.get("tags") or {})
            tags |= {"sweep": self.labels.sweep} if self.labels.sweep else {}
            options = self._store(maker) | {"run_name": title, "run_id": known, "tags": tags}
        elif kind in (TensorBoardLogger, CsvLogger):
            options |= {"purge_step": step + 1} if kind is TensorBoardLogger else {"first": step}
        # Only one job of a sweep may make the database.
        with FileLock(self.runs / ".mlflow.lock") if kind is MLFlowLogger else nullcontext():
            logger = maker(**options)
            _ = logger.experiment  # connects
        if kind in _PACKAGES:
            ids[name] = str(logger.version)
        if not (known and kind is MLFlowLogger):  # which takes each parameter once
            logger.log_hyperparams(dict(self.hyperparameters()))
        if self.labels.config and not known and (file := self.folder / "config.yaml").is_file():
            self._guard(name, _log_config, logger, file, step)
        self._closing.append(logger.finalize)
        log_metrics = logger.log_metrics

        def log_on_the_runs_axis(metrics: Mapping[str, float], step: int | None = None) -> None:
            step = None if step is None else step + self.before
            self._logged.add(name)
            self._guard(name, log_metrics, metrics, step)

        logger.finalize = lambda status: self._guard(name, logger.save)  # Lightning's, after each stage
        logger.log_metrics = log_on_the_runs_axis
        return logger

    def _store(self, maker: Callable[..., Logger]) -> dict[str, str]:
        """Return where MLflow writes: as typed, as in the environment, or else beside all runs."""
        uri = maker.keywords.get("tracking_uri") or os.environ.get("MLFLOW_TRACKING_URI")
        if uri:
            return {"tracking_uri": uri}
        here = self.runs.resolve()
        return {"tracking_uri": f"sqlite:///{here}/mlflow.db", "artifact_location": f"{here}/mlflow"}

    def _guard(self, name: str, call: Callable, *given, **options) -> None:
        """Let a run outlive a tracker that fails: tell it once, and leave it out from then on."""
        if name in self._failed:
            return
        try:
            call(*given, **options)
        except Exception as error:  # of the tracker's own kinds
            self._failed.add(name)
            told = f"warning: logger.{name} failed and is left out from now on"
            print(f"{told}: {_in_a_line(error)}", file=sys.stderr)

    def log(self, scalars: Mapping[str, float], step: int) -> None:
        """Log scalars of a step of the stage that ``open`` has begun.

        Not by Lightning's ``self.log``, which repeats at every later step what was logged once.
        """
        for name, logger in (self._open or {}).items():
            logger.log_metrics(dict(scalars), step)
            self._guard(name, logger.save)

    def log_image(self, title: str, image: Tensor, step: int) -> None:
        """Log an image (H, W, 3) in [0, 1] of a step of the stage to each logger that takes images."""
        pixels, at = to_bytes(image), step + self.before
        for name, logger in (self._open or {}).items():
            if isinstance(logger, TensorBoardLogger):
                self._guard(name, logger.experiment.add_image, title, pixels, at, dataformats="HWC")
            elif isinstance(logger, MLFlowLogger):
                self._guard(name, logger.experiment.log_image, logger.run_id, pixels, key=title, step=at)
            elif hasattr(logger, "log_image"):  # Weights & Biases, and loggers made like it
                self._guard(name, logger.log_image, title, [pixels], step=step)

    def takes_film(self) -> bool:
        """Tell whether a logger that is open takes films."""
        return any(isinstance(one, TensorBoardLogger | MLFlowLogger | WandbLogger) for one in self.open())

    def log_film(self, title: str, file: Path, step: int) -> None:
        """Log a GIF to each logger that takes films; ``step`` is of the whole run."""
        for name, logger in zip(self.makers, self.open(0, step)):
            self._guard(name, _log_film, logger, title, file, step)
            self._guard(name, logger.save)

    def log_scores(self, scores: Mapping[str, float], step: int) -> None:
        """Log the scores of a measured run, in TensorBoard beside its hyperparameters (HPARAMS).

        Args:
            scores: by name.
            step: steps of the whole run.
        """
        for name, logger in zip(self.makers, self.open(0, step)):
            if isinstance(logger, TensorBoardLogger):
                self._guard(name, logger.log_hyperparams, dict(self.hyperparameters()), dict(scores), step)
            else:
                logger.log_metrics(dict(scores), step)
            self._guard(name, logger.save)

    def __enter__(self) -> RunLoggers:
        return self

    def __exit__(self, kind: type | None, *_) -> None:
        """Close all loggers, as failed after an exception."""
        for (name, logger), close in zip((self._open or {}).items(), self._closing):
            self._guard(name, close, "success" if kind is None else "failed")
            if name in self._logged:
                self._guard(name, _check_written, logger)
            if isinstance(logger, WandbLogger):  # else the next job of a sweep would go on in this run
                self._guard(name, logger.experiment.finish, exit_code=0 if kind is None else 1)
        self._open, self._closing = None, []


def redacted(value: object) -> object:
    """Replace what is of this machine and user alone, also within dicts, lists and commands.

    Absolute paths by their last part, a home folder by ``~``; user and password of URIs are left out.

    >>> redacted(["data.root=/home/me/my scans", "https://me:secret@host/mlflow", "model/motion=none", 3])
    ['data.root=my scans', 'https://host/mlflow', 'model/motion=none', 3]
    >>> redacted("forewarp-train --config-dir=/home/me 'hydra.searchpath=[file:///a/b,pkg://c]' out=a/b")
    "forewarp-train '--config-dir=~' 'hydra.searchpath=[b,pkg://c]' out=a/b"
    """
    if isinstance(value, dict):
        return {key: redacted(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [redacted(inner) for inner in value]
    if not isinstance(value, str):
        return value
    if value.startswith("forewarp-"):  # a command, in which a space ends a path
        return shlex.join(_PATH.sub(_last_part, _USER.sub("", word)) for word in shlex.split(value))
    return _PATH.sub(_last_part, _USER.sub("", value))


def _last_part(path: re.Match) -> str:
    absolute = "/" + re.sub(r"^\w*:?/*", "", path[0]).rstrip("/")
    return "~" if _HOME.fullmatch(absolute) else absolute.rpartition("/")[2]


def _log_config(logger: Logger, file: Path, step: int) -> None:
    content = redacted(load_yaml(file))
    _log_text(logger, "config", yaml.safe_dump(content, sort_keys=False, allow_unicode=True), step)


def _log_text(logger: Logger, title: str, text: str, step: int) -> None:
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_text(title, f"```yaml\n{text}\n```", step)  # which it shows as Markdown
    elif isinstance(logger, MLFlowLogger):
        logger.experiment.log_text(logger.run_id, text, f"{title}.yaml")
    elif isinstance(logger, WandbLogger):
        logger.log_text(title, columns=[f"{title}.yaml"], data=[[text]])


def _log_film(logger: Logger, title: str, file: Path, step: int) -> None:
    if isinstance(logger, TensorBoardLogger):  # its add_video would encode a GIF too, by another package
        (width, height), film = image_size(file), file.read_bytes()
        image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=film)
        summary = Summary(value=[Summary.Value(tag=title, image=image)])
        logger.experiment.file_writer.add_summary(summary, step)
    elif isinstance(logger, MLFlowLogger):
        logger.experiment.log_artifact(logger.run_id, str(file), title)
    elif isinstance(logger, WandbLogger):
        logger.log_video(title, [str(file)], step=step, format=["gif"])


def _check_written(logger: Logger) -> None:
    """Raise ValueError if a tracker holds nothing of what was logged; another kind than these is trusted."""
    if isinstance(logger, TensorBoardLogger):
        written = any(Path(logger.log_dir).glob("events.out.tfevents.*"))
    elif isinstance(logger, CSVLogger):
        written = (Path(logger.log_dir) / ExperimentWriter.NAME_METRICS_FILE).is_file()
    elif isinstance(logger, MLFlowLogger):
        written = bool(logger.experiment.get_run(logger.run_id).data.metrics)
    else:
        written = not getattr(logger.experiment, "disabled", False)  # by WANDB_MODE
    if not written:
        raise ValueError("expected what was logged, but it holds nothing; look for what switches it off")


def _class_of(maker: Callable[..., Logger]) -> type:
    return getattr(maker, "func", maker)


def _in_a_line(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
