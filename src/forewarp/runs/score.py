"""The number that a job of a sweep returns: how well views are drawn that nothing learned from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from forewarp.training.device import device_of
from forewarp.runs.overrides import key_of
from forewarp.metrics.lpips import NETS, find_lpips, find_lpips_weights
from forewarp.metrics.suite import LPIPS_METRICS, METRICS, ImageSuite
from forewarp.evaluation.evaluate import mean_scores
from forewarp.files import read_json, write_json
from forewarp.training.module import DynamicSceneModule
from forewarp.training.stages import Run

FILE = "score.json"
ADVICE = "set data.held_out=8"


class Score:
    """What a job returns, where somebody wants it: in ``--multirun``, or where ``score`` was typed.

    It is the mean over whole pictures of the views held out (``data.held_out``), or else of up to 8
    validation views; never of test views. It is kept in the run's ``score.json``.

    Args:
        run: put together; its scene is read.
        config: ``score`` (the metric), ``lpips_weights`` and ``trainer``.

    Raises:
        ValueError: for what is no validation metric, and where a sweeper needs what there cannot be.
    """

    def __init__(self, run: Run, config: DictConfig) -> None:
        self.name = named(config.get("score"))
        self.run, self.config = run, config
        self.without = None if wanted() and self.name is not None else "nobody asked"
        if self.without is None:
            self.without = self._lacks()
            if self.without is not None:
                self._leave_out(self.without)

    def known(self) -> float | None:
        """As measured before, since the last stage was finished."""
        value = None if self.without else self._stored().get(self.name)
        return float(value) if isinstance(value, int | float) and math.isfinite(value) else None

    def of(self, module: DynamicSceneModule | None = None) -> float | None:
        """Measured now on the fitted ``module`` (loaded where it is None) or before; None: there is none."""
        if self.without:
            return None
        value = self.known()
        if value is None:
            value = self._measured(module or self.run.load())
        if value is not None:
            print(f"score    {self.name} {value:.4f} of {self._views()}", flush=True)
        return value

    def _stored(self) -> dict:
        """The scores that ``score.json`` holds of the run as it is now."""
        run, path = self.run, Path(self.run.folder) / FILE
        scores = (read_json(path) or {}).get("scores")
        if not isinstance(scores, dict) or not all(run.is_finished(stage) for stage in run.stages):
            return {}
        done = [run.stage_folder(stage) / "done.json" for stage in run.stages]
        return scores if path.stat().st_mtime_ns >= max(f.stat().st_mtime_ns for f in done) else {}

    def _views(self) -> str:
        count, held = len(self.run.datamodule.watched()), bool(self.run.datamodule.scene.held)
        return f"{count} {'held out' if held else 'validation'} view{'s' * (count != 1)}"

    def _lacks(self) -> str | None:
        """Why there can be no score, as far as that is known before anything is trained."""
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
        module.to(device_of(self.config.trainer.accelerator))
        scores = mean_scores(module, run.datamodule.watched(), suite)
        content = {"views": self._views(), "scores": self._stored() | scores}
        write_json(Path(run.folder) / FILE, content)
        if self.name not in scores:
            self._leave_out(suite.absent.get(self.name, "the views have no such score"))
        return scores.get(self.name)

    def _leave_out(self, why: str) -> None:
        if searching():
            raise ValueError(f"score: expected {self.name}, which the sweeper needs, but got none: {why}")
        if any(key_of(word) == "score" for word in HydraConfig.get().overrides.task):
            print(f"no score: {why}", flush=True)


def named(score: object) -> str | None:
    """The metric that ``score`` names; None: none.

    Raises:
        ValueError: for what is no metric of validation views, a test metric among them.
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
    """Whether somebody takes the score: a sweep, or whoever typed it."""
    if not HydraConfig.initialized():
        return False
    words: Sequence[str] = HydraConfig.get().overrides.task
    return HydraConfig.get().mode == RunMode.MULTIRUN or any(key_of(word) == "score" for word in words)


def searching() -> bool:
    """Whether the sweeper chooses jobs by the scores of those before."""
    return "_target_" in (sweeper := _sweeper()) and not sweeper._target_.endswith(".BasicSweeper")


def _sweeper() -> DictConfig:
    """The sweeper of this job; empty where there is none."""
    swept = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
    return HydraConfig.get().sweeper if swept else OmegaConf.create({})


class TellBest(Callback):
    """Says at the end of a search which job was the best."""

    def on_multirun_end(self, config: DictConfig, **_) -> None:
        """Print what the sweeper left in ``optimization_results.yaml``."""
        file = Path(config.hydra.sweep.dir) / "optimization_results.yaml"
        found = OmegaConf.load(file) if file.is_file() else {}
        if "best_params" in found:
            words = " ".join(f"{key}={value}" for key, value in found.best_params.items())
            print(f"best     {config.get('score')} {found.best_value:.4f}: {words}")
            print(f"written: {file}", flush=True)
