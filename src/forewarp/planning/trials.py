"""Fit the short runs of a plan: coarse stages, and fine stages that begin where the coarse ones end."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from hydra import compose
from omegaconf import DictConfig, OmegaConf, open_dict

from forewarp.evaluation.images import psnr_by_view
from forewarp.files import read_json, write_json
from forewarp.methods.method import HasRest
from forewarp.metrics.gain import Gain
from forewarp.runs.build import build_run
from forewarp.runs.overrides import merged, without_switched_off
from forewarp.runs.session import session
from forewarp.training.handover import NUMBERS, POINTS
from forewarp.training.module import DynamicSceneModule
from forewarp.training.stages import Run

RAYS = 10_000  # pixels rendered of each held-out view


@dataclass(frozen=True)
class Trial:
    """The result of a short run.

    Attributes:
        psnr: PSNR of each held-out view, dB.
        step: training seconds per step.
        steps: number of steps done.
        took: seconds in all, with loading and scoring.
        at_rest: share of the matter that came to rest; 0 for a method that does not tell.
    """

    psnr: tuple[float, ...]
    step: float
    steps: int
    took: float
    at_rest: float = 0.0


def gain(on: Sequence[Trial], off: Sequence[Trial], *, equal_steps: bool = True) -> Gain:
    """Compare trials with and without an effect, seed by seed and view by view."""
    numbers = [[[{"psnr": psnr, "step": t.step} for psnr in t.psnr] for t in trials] for trials in (on, off)]
    pairs = [list(zip(*views, strict=True)) for views in zip(*numbers, strict=True)]
    seconds = on[0].step * on[0].steps, off[0].step * off[0].steps
    return Gain.of(pairs, on[0].steps if equal_steps else None, seconds)


def composed(overrides: Sequence[str]) -> DictConfig:
    """Compose the config of ``forewarp-train`` with these overrides; Hydra must be initialised."""
    return compose("train", list(overrides))


@dataclass
class Trials:
    """Run all short runs of one plan; finished ones are not run again.

    Args:
        typed: overrides of the run to plan.
        folder: the plan's folder, with one folder for each trial.
        held_out: number of training views to hold out and score.
        always: the method's overrides of every trial.
        always_fine: the method's overrides of every fine trial.
        steps: steps of a coarse stage.
        seconds: most seconds of a coarse stage.
        fine_steps: steps of a fine stage.
        fine_seconds: most seconds of a fine stage.
        seconds_before: total seconds of the trials that were finished before.
        made: the fine trials so far, as several effects are compared with the same trial.
    """

    typed: list[str]
    folder: Path
    held_out: int
    always: Sequence[str]
    always_fine: Sequence[str]
    steps: int
    seconds: float
    fine_steps: int
    fine_seconds: float
    seconds_before: float = 0.0
    made: dict[str, Trial] = field(default_factory=dict)

    def coarse(self, name: str, changes: Sequence[str]) -> tuple[Trial, Run, DynamicSceneModule]:
        """Fit a coarse stage with these overrides; return its result, its run and the fitted module."""
        config = self._config(name, changes, self.always, 0, self.steps, self.seconds)
        for later in list(config.stage)[1:]:
            config.stage[later] = None
        return self._fitted(config)

    def fine(
        self, name: str, changes: Sequence[str], after: str, seed: int, steps: int | None = None, longer=1
    ) -> Trial:
        """Fit a short fine stage that begins where the coarse stage of the trial ``after`` ended.

        Args:
            name: name of the trial.
            changes: overrides of the trial.
            after: name of the trial whose coarse stage to continue.
            seed: added to the run's seed.
            steps: steps of the stage; None: ``fine_steps``, or fewer if ``fine_seconds`` end first.
            longer: times ``fine_steps`` and ``fine_seconds``; of no effect where ``steps`` is given.
        """
        name = f"{name}-seed{seed}"
        if name not in self.made:
            seconds = longer * self.fine_seconds if steps is None else None
            steps, always = steps or longer * self.fine_steps, [*self.always, *self.always_fine]
            config = self._config(name, changes, always, seed, steps, seconds)
            first, last = list(config.stage)[0], list(config.stage)[-1]
            config.stage[first].share, config.stage[last].share = 1e-6, 1.0
            self.made[name] = self._fitted(config, self.folder / after / first)[0]
        return self.made[name]

    def _config(self, name: str, changes, always, seed: int, steps: int, seconds: float | None) -> DictConfig:
        config = composed(without_switched_off(merged(merged(changes, self.typed), always)))
        data = OmegaConf.to_container(config.data, resolve=True) | {"seed": config.seed + seed}
        with open_dict(config):
            config.data = data  # resolved before the seed changes, as synthetic scenes are made from the seed
            config.run, config.seed, config.effects = str(self.folder / name), config.seed + seed, "given"
            config.budget.iterations, config.budget.minutes = steps, None if seconds is None else seconds / 60
            config.data.held_out, config.evaluate = self.held_out, False
            config.logger, config.callbacks = None, {"progress": config.callbacks.get("progress")}
        print(self.folder / name, flush=True)
        return config

    def _fitted(self, config: DictConfig, begun: Path | None = None) -> tuple[Trial, Run, DynamicSceneModule]:
        """Fit and score a trial, or read the stored result; ``begun``: folder of a finished first stage."""
        begin = time.perf_counter()
        run = build_run(config)
        run.tell = lambda line: None
        run.datamodule.setup("fit")
        with session(run, config):
            if begun is not None:
                _share(begun, run.folder / begun.name)
            module = run.fit().to(run.device)
            file = run.folder / "trial.json"
            if (stored := read_json(file)) is not None:
                self.seconds_before += stored["took"]
                return Trial(**stored | {"psnr": tuple(stored["psnr"])}), run, module
            noted = read_json(run.stage_folder(run.stages[-1]) / "done.json")
            psnr = psnr_by_view(module, run.datamodule.watched(), RAYS)
            step, took = noted["seconds"] / noted["steps"], time.perf_counter() - begin
            rest = module.method.at_rest() if isinstance(module.method, HasRest) else 0.0
            trial = Trial(tuple(psnr), step, noted["steps"], took, rest)
            write_json(file, asdict(trial))
        return trial, run, module


def _share(source: Path, target: Path) -> None:
    """Link a finished stage into another run, or copy it if the file system has no hard links."""

    def link(file: str, copy: str) -> None:
        try:
            os.link(file, copy)
        except OSError:
            shutil.copyfile(file, copy)

    def is_no_result(folder: str, names: list[str]) -> set[str]:
        return set(names) - {"last.ckpt", NUMBERS, POINTS, "done.json"}

    if not target.is_dir():
        beside = target.with_name(target.name + ".part")
        shutil.rmtree(beside, ignore_errors=True)
        shutil.copytree(source, beside, ignore=is_no_result, copy_function=link)
        beside.rename(target)
