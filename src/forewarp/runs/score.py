"""Score a job of a sweep on views that were not trained on."""

from __future__ import annotations

import math
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf

from forewarp.evaluation.evaluate import mean_scores
from forewarp.files import read_json, write_json
from forewarp.metrics.lpips import NETS, find_lpips, find_lpips_weights
from forewarp.metrics.suite import LPIPS_METRICS, METRICS, ImageSuite
from forewarp.runs.build import is_current
from forewarp.runs.overrides import key_of, typed_overrides
from forewarp.training.module import DynamicSceneModule
from forewarp.training.stages import Run

FILE = "score.json"
ADVICE = "set data.held_out=8"


class Score:
    """The number that a job returns in ``--multirun``, or if ``score`` was typed.

    The mean of a metric over whole pictures: of the held-out views (``data.held_out``), or else of up to 8
    validation views, never of test views. Stored in the run's ``score.json``.

    Args:
        run: the run, its scene already read.
        config: ``score`` (the metric), ``lpips_weights`` and ``trainer``.

    Raises:
        ValueError: if the metric is no validation metric, or the sweeper needs a score and there can be none.
    """

    def __init__(self, run: Run, config: DictConfig) -> None:
        self.name = named(config.get("score"))
        self.run, self.config = run, config
        self.without = None if wanted() and self.name is not None else "nobody asked"
        if self.without is None and (lacking := self._lacks()) is not None:
            self.without = lacking
            self._leave_out(lacking)

    def of(self, module: DynamicSceneModule | None = None) -> float | None:
        """Return the score, measured now or read from ``score.json``; None if there is none.

        Args:
            module: the fitted module; None: load the module if needed.
        """
        if self.without:
            return None
        value = self._stored().get(self.name)
        if not isinstance(value, int | float) or not math.isfinite(value):
            value = self._measured(module or self.run.load())
        if value is not None:
            print(f"score    {self.name} {value:.4f} of {self._views()}", flush=True)
        return value

    def _stored(self) -> dict:
        """Read the scores in ``score.json``, unless the run was trained after they were written."""
        path = Path(self.run.folder) / FILE
        scores = (read_json(path) or {}).get("scores")
        return scores if isinstance(scores, dict) and is_current(path, self.run) else {}

    def _views(self) -> str:
        count, held = len(self.run.datamodule.watched()), bool(self.run.datamodule.scene.held)
        return f"{count} {'held out' if held else 'validation'} view{'s' * (count != 1)}"

    def _lacks(self) -> str | None:
        """Return why the run can have no score, as far as this is known before training, or None."""
        if not len(self.run.datamodule.watched()):
            return f"the scene has no validation views and none are held out; {ADVICE}"
        nets = [net for net in NETS if f"lpips_{net}" == self.name]
        if nets and find_lpips_weights(nets[0], self.config.get("lpips_weights")) is None:
            return "no backbone weights were found; set lpips_weights=<file or folder>"
        return None

    def _measured(self, module: DynamicSceneModule) -> float | None:
        run = self.run
        nets = [net for net in NETS if f"lpips_{net}" == self.name]
        suite = ImageSuite(
            find_lpips(nets, self.config.get("lpips_weights")),
            mask_box=run.datamodule.scene.protocol.get("mask_box", False),
        )
        module.to(run.device)
        scores = mean_scores(module, run.datamodule.watched(), suite)
        content = {"views": self._views(), "scores": self._stored() | scores}
        write_json(Path(run.folder) / FILE, content)
        if self.name not in scores:
            self._leave_out(suite.absent.get(self.name, "the views have no such score"))
        return scores.get(self.name)

    def _leave_out(self, why: str) -> None:
        if searching():
            raise ValueError(f"score: expected {self.name}, which the sweeper needs, but got none: {why}")
        if _is_typed():
            print(f"no score: {why}", flush=True)


def named(score: object) -> str | None:
    """Return the metric, or None if ``score`` is null.

    Raises:
        ValueError: if ``score`` is no validation metric, or the sweeper maximises a distance (LPIPS).
    """
    if score is None:
        return None
    if score not in METRICS:
        known = ", ".join(METRICS)
        raise ValueError(f"score: expected a metric of validation views ({known}) or null, but got {score!r}")
    direction = str(OmegaConf.select(_sweeper(), "direction", default="")).lower()
    if "maximize" in direction and score in LPIPS_METRICS:
        raise ValueError(
            f"hydra.sweeper.direction: expected minimize for {score}, which is less where it is better, "
            "but got maximize; add hydra.sweeper.direction=minimize"
        )
    return str(score)


def wanted() -> bool:
    """Tell whether the score is used: in a sweep, or if ``score`` was typed."""
    return HydraConfig.initialized() and (HydraConfig.get().mode == RunMode.MULTIRUN or _is_typed())


def _is_typed() -> bool:
    return any(key_of(override) == "score" for override in typed_overrides())


def searching() -> bool:
    """Tell whether the sweeper chooses jobs by the scores of earlier ones, as all but Hydra's own do."""
    # Here, as Hydra defines its sweepers anew when it looks for plugins.
    from hydra._internal.core_plugins.basic_sweeper import BasicSweeper

    target = _sweeper().get("_target_")
    return target is not None and not issubclass(get_class(target), BasicSweeper)


def _sweeper() -> DictConfig:
    """Return the sweeper of this job; empty if there is none."""
    swept = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
    return HydraConfig.get().sweeper if swept else OmegaConf.create({})


class TellBest(Callback):
    """Print the best job at the end of a search."""

    def on_multirun_end(self, config: DictConfig, **_) -> None:
        """Print the best job from the sweeper's ``optimization_results.yaml``."""
        file = Path(config.hydra.sweep.dir) / "optimization_results.yaml"
        found = OmegaConf.load(file) if file.is_file() else {}
        if "best_params" in found:
            overrides = " ".join(f"{key}={value}" for key, value in found.best_params.items())
            print(f"best     {config.get('score')} {found.best_value:.4f}: {overrides}")
            print(f"written: {file}", flush=True)
