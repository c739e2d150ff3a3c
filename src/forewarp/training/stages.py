"""A run: all stages of one scene in one folder. What is finished is not run again, the rest goes on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import lightning

from forewarp.methods.spec import MethodSpec, parameter_count
from forewarp.renderer import Renderer
from forewarp.scene.frame import Scene
from forewarp.training.checkpoints import KeepCheckpoint, check_state, load_weights
from forewarp.training.curriculum import Curriculum
from forewarp.training.handover import (
    Handover,
    carried_method,
    fresh_method,
    load_handover,
    make_handover,
    read_json,
    save_handover,
    write_json,
)
from forewarp.training.interruption import Interruption
from forewarp.training.module import DynamicSceneModule
from forewarp.training.objective import Objective
from forewarp.training.protocol import peak_memory_bytes, reset_peak_memory
from forewarp.training.sentinel import Sentinel
from forewarp.training.settings import StageSettings


@dataclass(frozen=True)
class Stage:
    """A stage's numbers and its objective."""

    settings: StageSettings
    objective: Objective


@dataclass
class Run:
    """All stages of one scene.

    Args:
        datamodule: serves the scene (``.scene``, ``.picker``, ``.restart``, batches).
        spec: the method.
        stages: in order.
        renderer: of training and evaluation.
        folder: where the run lives; a folder a stage.
        make_trainer: ``(stage folder, callbacks) -> lightning.Trainer``.
        callbacks: ``(stage name, stage folder) -> list`` of what watches a stage.
        seed: of everything random.
        checkpoint_seconds: between checkpoints of an unfinished stage.
        skip: steps of a stage that may be left out for a number that is not finite (see ``Sentinel``).
        tell: takes a line that says where a stage stands which is not begun anew.
    """

    datamodule: lightning.LightningDataModule
    spec: MethodSpec
    stages: Sequence[Stage]
    renderer: Renderer
    folder: Path
    make_trainer: Callable[[Path, list], lightning.Trainer]
    callbacks: Callable[[str, Path], list] = field(default=lambda name, folder: [])
    seed: int = 0
    checkpoint_seconds: float = 60.0
    skip: int = 0
    tell: Callable[[str], None] = lambda line: None

    def fit(self) -> DynamicSceneModule:
        """Run what is not finished; returns the last stage's module, fitted."""
        self.datamodule.setup("fit")
        module, handover = None, None
        for number, stage in enumerate(self.stages):
            folder = self.stage_folder(stage)
            folder.mkdir(parents=True, exist_ok=True)
            # Every stage draws anew, so that skipping a finished one changes nothing that follows.
            lightning.seed_everything(self.seed + number, verbose=False)
            self.datamodule.restart(number)
            module, unit = self._module(stage, module, handover, number)
            if self.is_finished(stage):
                load_weights(module, folder / "last.ckpt")
                self.tell(f"{stage.settings.name}: finished before")
            else:
                self._fit_stage(stage, module, folder, unit)
            handover = load_handover(folder)
        return module

    def load(self) -> DynamicSceneModule:
        """The fitted last stage of a finished run.

        Raises:
            ValueError: where a stage is not finished.
        """
        self.datamodule.setup("test")
        for stage in self.stages:
            if not self.is_finished(stage):
                raise ValueError(
                    f"{self.stage_folder(stage)}: expected a finished stage, but got none; "
                    "continue with forewarp-train"
                )
        stage = self.stages[-1]
        before = [load_handover(self.stage_folder(s)) for s in self.stages[:-1]]
        module, _ = self._module(stage, None, before[-1] if before else None, len(self.stages) - 1)
        load_weights(module, self.stage_folder(stage) / "last.ckpt")
        return module

    def stage_folder(self, stage: Stage) -> Path:
        """Where a stage lives."""
        return Path(self.folder) / stage.settings.name

    def is_finished(self, stage: Stage) -> bool:
        """Whether a stage was fitted to its end, and left all that it should; else it goes on."""
        folder = self.stage_folder(stage)
        try:
            load_handover(folder)
        except ValueError:
            return False
        return _noted(folder) is not None and (folder / "last.ckpt").is_file()

    def finished(self) -> dict[str, dict]:
        """What finished stages noted at their end, by name: seconds, steps, peak memory and so on."""
        found = {stage.settings.name: _noted(self.stage_folder(stage)) for stage in self.stages}
        return {name: noted for name, noted in found.items() if noted is not None}

    def rebuilt(self, name: str, scene: Scene, unit: float) -> DynamicSceneModule:
        """A stage's module for a ``state_dict`` that brings its grids: nothing is asked of images or of the
        stages before.

        Args:
            name: of the stage.
            scene: cameras, times and box.
            unit: of density, world units.
        """
        number, stage = next((i, s) for i, s in enumerate(self.stages) if s.settings.name == name)
        plain = replace(stage, settings=replace(stage.settings, start="box", carry=False))
        fresh = replace(self, datamodule=SimpleNamespace(scene=scene))
        handover = Handover(scene.box.low, scene.box.high, unit, False, 0)
        return fresh._module(plain, None, handover, number)[0]

    def _module(
        self, stage: Stage, before: DynamicSceneModule | None, handover: Handover | None, number: int
    ) -> tuple[DynamicSceneModule, float]:
        scene: Scene = self.datamodule.scene
        settings = stage.settings
        times = [frame.time for frame in scene.train]
        curriculum = Curriculum(times, scene.canonical_time, seed=self.seed + number, **settings.curriculum)
        if before is not None and settings.carry:
            method, unit = carried_method(self.spec, settings, scene, before.method, handover), handover.unit
        else:
            box, unit = (scene.box, None) if handover is None else (handover.box, handover.unit)
            method, unit = fresh_method(self.spec, settings, scene, box, unit, curriculum.frames())
        module = DynamicSceneModule(
            method,
            renderer=self.renderer.with_threshold(settings.color_threshold),
            objective=stage.objective,
            settings=settings,
            curriculum=curriculum,
            cameras=[frame.camera for frame in scene.train],
            seed=self.seed + number,
            still=scene.still,
        )
        return module, unit

    def _fit_stage(self, stage: Stage, module: DynamicSceneModule, folder: Path, unit: float) -> None:
        last = folder / "last.ckpt"
        sentinel = Sentinel(folder, skip=self.skip)
        interruption = Interruption()
        keeper = KeepCheckpoint(last, self.checkpoint_seconds, sentinel.check, interruption)
        watchers = [sentinel, *self.callbacks(stage.settings.name, folder), keeper]
        trainer = self.make_trainer(folder, watchers)
        checkpoint = last if last.is_file() else None
        if checkpoint is not None:
            steps, seconds = check_state(checkpoint, module)
            done = stage.settings.fraction(steps, seconds)
            self.tell(f"{stage.settings.name}: goes on at {done:.0%}, step {steps}")
        reset_peak_memory()
        with interruption:
            trainer.fit(module, datamodule=self.datamodule, ckpt_path=checkpoint, weights_only=True)
        if module.fraction < 1:
            raise KeyboardInterrupt
        keeper.save(trainer)
        scene, in_play = self.datamodule.scene, module.curriculum.in_play
        alpha = stage.settings.box_alpha
        save_handover(make_handover(module.method, scene, unit, in_play, alpha=alpha), folder)
        write_json(
            folder / "done.json",
            {
                "seconds": module.clock.seconds,
                "steps": module.global_step,
                "parameters": parameter_count(module.method),
                "frames_in_play": module.curriculum.in_play,
                "peak_memory_bytes": peak_memory_bytes(),
                "skipped_steps": sentinel.skipped,
            },
        )
        if interruption.asked:  # too late for a step of this stage
            raise KeyboardInterrupt


def _noted(folder: Path) -> dict | None:
    """What a stage noted at its end; None where it did not come to it."""
    noted = read_json(folder / "done.json")
    return noted if noted is not None and {"seconds", "steps"} <= noted.keys() else None
