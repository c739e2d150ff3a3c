"""Short runs that tell what an effect is worth: coarse stages, and fine ones that begin where these end."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from hydra import compose
from omegaconf import DictConfig, OmegaConf, open_dict

from forewarp.evaluation.pictures import psnr_by_view
from forewarp.files import read_json, write_json
from forewarp.report.effect import Gain, Numbers
from forewarp.runs.build import build_run
from forewarp.runs.identity import claim
from forewarp.runs.lock import alone, same_data
from forewarp.runs.overrides import merged, of_what_is_on
from forewarp.training.device import device_of
from forewarp.training.handover import NUMBERS, POINTS
from forewarp.training.module import DynamicSceneModule
from forewarp.training.stages import Run

RAYS = 10_000  # pixels that are looked at in each view set aside


@dataclass(frozen=True)
class Trial:
    """What a short run reached: ``psnr`` (dB) of each view set aside, ``step`` in seconds of training,
    ``steps``; ``took`` seconds in all.
    """

    psnr: tuple[float, ...]
    step: float
    steps: int
    took: float

    @property
    def numbers(self) -> list[Numbers]:
        """Of each view."""
        return [{"psnr": psnr, "step": self.step} for psnr in self.psnr]


def gain(on: Sequence[Trial], off: Sequence[Trial], *, equal_steps: bool = True) -> Gain:
    """What trials with an effect gain over those without, seed by seed and view by view."""
    pairs = [list(zip(a.numbers, b.numbers, strict=True)) for a, b in zip(on, off, strict=True)]
    seconds = on[0].step * on[0].steps, off[0].step * off[0].steps
    return Gain.of(pairs, on[0].steps if equal_steps else None, seconds)


def composed(words: Sequence[str]) -> DictConfig:
    """What ``forewarp-train`` would make of these words; Hydra must have been begun."""
    return compose("train", list(words))


@dataclass
class Trials:
    """All short runs of one plan; one that is finished is not run again.

    Args:
        words: as typed, for the run that is planned.
        folder: of the plan; a folder a trial.
        steps: of a coarse stage. seconds: that it may take at most.
        fine_steps, fine_seconds: the same of a fine one.
        held_out: training views set aside and scored.
        tell: takes a line before each.

    ``always`` and ``always_fine`` are overrides of every trial and of every fine one, which the method's
    planning says. ``seconds_before`` is what those took that were found finished; ``made`` are the fine ones
    so far: several effects are compared with the same.
    """

    words: list[str]
    folder: Path
    steps: int
    seconds: float
    fine_steps: int
    fine_seconds: float
    held_out: int
    tell: Callable[[str], None] = print
    seconds_before: float = 0.0
    made: dict[str, Trial] = field(default_factory=dict)
    always: Sequence[str] = ()
    always_fine: Sequence[str] = ()

    def coarse(self, name: str, changes: Sequence[str]) -> tuple[Trial, Run, DynamicSceneModule]:
        """A coarse stage with these words, its run and what it fitted."""
        config = self._config(name, changes, self.always, 0, self.steps, self.seconds)
        for later in list(config.stage)[1:]:
            config.stage[later] = None
        return self._fitted(config)

    def fine(
        self, name: str, changes: Sequence[str], after: str, seed: int, steps: int | None = None
    ) -> Trial:
        """A short fine stage that begins where the coarse one of the trial ``after`` ended.

        Args:
            steps: exactly so many; None: ``fine_steps``, or as many as ``fine_seconds`` allow.
        """
        if (known := self.made.get(f"{name}-seed{seed}")) is not None:
            return known
        seconds = self.fine_seconds if steps is None else None
        always = [*self.always, *self.always_fine]
        config = self._config(f"{name}-seed{seed}", changes, always, seed, steps or self.fine_steps, seconds)
        first, last = list(config.stage)[0], list(config.stage)[-1]
        config.stage[first].share, config.stage[last].share = 1e-6, 1.0
        self.made[f"{name}-seed{seed}"] = self._fitted(config, self.folder / after / first)[0]
        return self.made[f"{name}-seed{seed}"]

    def _config(
        self,
        name: str,
        changes: Sequence[str],
        always: Sequence[str],
        seed: int,
        steps: int,
        seconds: float | None,
    ) -> DictConfig:
        config = composed(of_what_is_on(merged(merged(changes, self.words), always)))
        data = OmegaConf.to_container(config.data, resolve=True) | {"seed": config.seed + seed}
        with open_dict(config):
            config.data = data  # of the scene as planned, whatever it is drawn by
            config.run, config.seed, config.effects = str(self.folder / name), config.seed + seed, "given"
            config.budget.iterations, config.budget.minutes = steps, None if seconds is None else seconds / 60
            config.data.held_out, config.evaluate = self.held_out, False
            config.logger, config.callbacks = None, {"progress": config.callbacks.get("progress")}
        self.tell(name)
        return config

    def _fitted(self, config: DictConfig, begun: Path | None = None) -> tuple[Trial, Run, DynamicSceneModule]:
        """Fit and score it, where that was not done; ``begun``: the folder of a stage finished before."""
        begin = time.perf_counter()
        run = build_run(config)
        run.tell = lambda line: None
        run.datamodule.setup("fit")
        with alone(run.folder):
            claim(config)
            same_data(run, "refuse")
            if begun is not None:
                _share(begun, run.folder / begun.name)
            module = run.fit().to(device_of(config.trainer.accelerator))
            file, stage = run.folder / "trial.json", run.stages[-1]
            known = read_json(file)
            if known is None:
                noted = read_json(run.stage_folder(stage) / "done.json")
                psnr = psnr_by_view(module, run.datamodule.watched(), RAYS)
                step, took = noted["seconds"] / noted["steps"], time.perf_counter() - begin
                known = asdict(Trial(psnr, step, noted["steps"], took))
                write_json(file, known)
            else:
                self.seconds_before += known["took"]
        return Trial(**known | {"psnr": tuple(known["psnr"])}), run, module


def _share(source: Path, target: Path) -> None:
    """A finished stage in another run, without a second copy where the system has links."""
    if target.is_dir():
        return
    beside = target.with_name(target.name + ".part")
    shutil.rmtree(beside, ignore_errors=True)
    beside.mkdir(parents=True)
    for name in ("last.ckpt", NUMBERS, POINTS, "done.json"):
        if not (source / name).is_file():  # not every method leaves points
            continue
        try:
            os.link(source / name, beside / name)
        except OSError:
            shutil.copyfile(source / name, beside / name)
    beside.rename(target)
