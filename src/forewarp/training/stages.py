"""A run: all stages of one scene in one folder. What is finished is not run again, the rest goes on."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import lightning
import torch

from forewarp.fields.voxel_grid import VoxelGrid
from forewarp.methods.spec import MethodSpec, parameter_count
from forewarp.renderer import Renderer
from forewarp.scene.frame import Scene
from forewarp.training.curriculum import Curriculum
from forewarp.training.handover import (
    Handover,
    carried_method,
    fresh_method,
    load_handover,
    make_handover,
    save_handover,
    write_json,
)
from forewarp.training.module import DynamicSceneModule
from forewarp.training.objective import Objective
from forewarp.training.protocol import peak_memory_bytes
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
        """Whether a stage was fitted to its end."""
        return (self.stage_folder(stage) / "done.json").is_file()

    def finished(self) -> dict[str, dict]:
        """What finished stages noted at their end, by name: seconds, steps, peak memory and so on."""
        paths = {stage.settings.name: self.stage_folder(stage) / "done.json" for stage in self.stages}
        return {name: json.loads(path.read_text()) for name, path in paths.items() if path.is_file()}

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
        )
        return module, unit

    def _fit_stage(self, stage: Stage, module: DynamicSceneModule, folder: Path, unit: float) -> None:
        last = folder / "last.ckpt"
        keeper = KeepCheckpoint(last, self.checkpoint_seconds)
        trainer = self.make_trainer(folder, [*self.callbacks(stage.settings.name, folder), keeper])
        checkpoint = last if last.is_file() else None
        if checkpoint is not None:
            check_checkpoint(checkpoint, module)
        trainer.fit(module, datamodule=self.datamodule, ckpt_path=checkpoint, weights_only=True)
        if module.fraction < 1:
            raise KeyboardInterrupt
        keeper.save(trainer)
        save_handover(
            make_handover(module.method, self.datamodule.scene, unit, module.curriculum.in_play), folder
        )
        write_json(
            folder / "done.json",
            {
                "seconds": module.clock.seconds,
                "steps": module.global_step,
                "parameters": parameter_count(module.method),
                "frames_in_play": module.curriculum.in_play,
                "peak_memory_bytes": peak_memory_bytes(),
            },
        )


class KeepCheckpoint(lightning.Callback):
    """Writes ``last.ckpt`` beside, then renames it, every so many seconds of training.

    Args:
        path: of the checkpoint.
        seconds: between two.
    """

    def __init__(self, path: Path, seconds: float) -> None:
        self.path, self.every = Path(path), seconds
        self._next = seconds

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Save when it is time."""
        if module.clock.seconds >= self._next:
            self._next = module.clock.seconds + self.every
            with module.clock.paused():
                self.save(trainer)

    def on_train_start(self, trainer, module) -> None:
        """Count from where a continued run stands."""
        self._next = module.clock.seconds + self.every

    def save(self, trainer: lightning.Trainer) -> None:
        """Save now."""
        beside = self.path.with_name(self.path.name + ".part")
        try:
            trainer.save_checkpoint(beside)
            os.replace(beside, self.path)
        except OSError as error:  # a full disk does not say which file
            beside.unlink(missing_ok=True)
            raise OSError(error.errno, error.strerror or str(error), str(self.path)) from error


def check_checkpoint(path: Path, module: DynamicSceneModule) -> dict:
    """Read a checkpoint and refuse one of another configuration.

    Raises:
        ValueError: naming what does not fit.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise ValueError(
            f"{path}: expected a checkpoint, but it cannot be read ({type(error).__name__}); delete it"
        ) from None
    own, theirs = _shapes(module.state_dict(), module), _shapes(content.get("state_dict", {}), module)
    differ = sorted(k for k in {**own, **theirs} if k not in own or k not in theirs or own[k] != theirs[k])
    if differ:
        raise ValueError(
            f"{path}: expected a checkpoint of this configuration, but got one that differs in "
            f"{', '.join(differ[:3])}; use another run folder, or the configuration that it was made with"
        )
    return content


def _shapes(weights: dict, module: DynamicSceneModule) -> dict[str, tuple | None]:
    """Of every entry that must fit; None for those of voxel grids, which adopt a checkpoint's shapes."""
    grids = [(prefix, m) for prefix, m in module.named_modules() if isinstance(m, VoxelGrid)]
    adopted = {f"{prefix}.{name}" for prefix, m in grids for name in ("voxels", "index", *m.names)}
    return {
        k: tuple(v.shape) if torch.is_tensor(v) and k not in adopted else None for k, v in weights.items()
    }


def load_weights(module: DynamicSceneModule, path: Path) -> None:
    """Load a finished stage's weights into a module of the same configuration."""
    module.load_state_dict(check_checkpoint(path, module)["state_dict"])
