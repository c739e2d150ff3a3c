"""A run: all stages of one scene, in one folder. Finished stages are loaded, unfinished ones continue."""

from __future__ import annotations

import ctypes
import gc
import re
import resource
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

import lightning
import torch

from forewarp.clock import Clock
from forewarp.files import held, read_json, write_json
from forewarp.methods.method import Model, Start, parameter_count
from forewarp.provenance import source_of, versions
from forewarp.scene.cloud import Handover
from forewarp.scene.frame import Scene, instants_of
from forewarp.training import checkpoints
from forewarp.training.loggers import RunLoggers
from forewarp.training.module import DynamicSceneModule
from forewarp.training.objective import Objective
from forewarp.training.schedule import Curriculum, Stage
from forewarp.training.sentinel import Sentinel
from forewarp.training.stopping import StopRule

_PROCESS = Path("/proc/self")  # Linux only


@dataclass
class Run:
    """Train the stages of one scene, one after the other.

    A stage's folder holds ``last.ckpt`` while it is trained. At its end ``handover.json`` (and ``.pt``) and
    ``done.json`` are added: the stage is then finished and is never trained again.

    Args:
        datamodule: serves the scene (``.scene``, ``.picker``, ``.restart``, batches).
        model: makes the method of a stage that names no model of its own.
        stages: in order.
        folder: the run's folder, with one folder for each stage.
        make_trainer: ``(stage folder, callbacks, loggers) -> lightning.Trainer``.
        callbacks: ``(stage name, stage folder) -> list`` of callbacks to add.
        seed: seed of all random numbers.
        checkpoint_seconds: training seconds between two checkpoints.
        skip: steps per stage that may be skipped because of numbers that are not finite (see ``Sentinel``).
        tell: called with a line for each stage that is loaded or continued.
        clock: what minutes are of: see ``Clock``.
        place: gives the device that its trainers compute on.
        loggers: its loggers; whoever fits the run closes them (``with run.loggers``).
        start: gives the fitted module of another run, from which the first stage begins, and what it left;
            None: the first stage begins from images.
        packages: whose code the run is of; ``done.json`` keeps their versions and commits.
        target: what ends the last stage before its budget; whoever watches the run's views applies it.
    """

    datamodule: lightning.LightningDataModule
    model: Model
    stages: Sequence[Stage]
    folder: Path
    make_trainer: Callable[[Path, list, list], lightning.Trainer]
    callbacks: Callable[[str, Path], list] = field(default=lambda name, folder: [])
    seed: int = 0
    checkpoint_seconds: float = 60.0
    skip: int = 0
    tell: Callable[[str], None] = lambda line: None
    clock: str = "wall"
    place: Callable[[], torch.device] = lambda: torch.device("cpu")
    loggers: RunLoggers = field(default_factory=RunLoggers)
    start: Callable[[], tuple[DynamicSceneModule, Handover]] | None = None
    packages: Sequence[str] = ("forewarp",)
    target: StopRule = StopRule()

    @property
    def device(self) -> torch.device:
        """The device that the run computes on.

        Raises:
            ValueError: if there is no such device.
        """
        return self.place()

    def check(self) -> None:
        """Refuse keys and terms that a stage's method does not know, before anything is read.

        Raises:
            ValueError: see ``Method.check``.
        """
        for stage in self.stages:
            settings, objective = stage.settings, stage.objective
            if not isinstance(objective, Objective):
                expected = (
                    f"stage.{settings.name}.objective: expected _target_: {Objective.__module__}.Objective"
                )
                raise ValueError(f"{expected}, but got none; add it")
            check = self._of_method(stage, "check")
            check(settings.name, settings.numbers, objective.names, objective.literal)

    def check_device(self) -> None:
        """Refuse a device that there is not, and to train on a GPU by the processor's clock.

        Raises:
            ValueError: naming the key.
        """
        place = self.device
        if self.clock != "wall" and place.type != "cpu":
            expected = "budget.clock: expected wall, as processor time leaves out the GPU's"
            raise ValueError(f"{expected}, but got {self.clock!r}; set budget.clock=wall, or trainer=cpu")

    def fit(self) -> DynamicSceneModule:
        """Train all stages that are not finished; return the module of the last one."""
        self.check_device()
        self.datamodule.setup("fit")
        finished = [self.is_finished(stage) for stage in self.stages]
        self._check_ahead([stage for stage, done in zip(self.stages, finished) if not done])
        module, handover, steps = None, None, 0
        for number, (stage, done) in enumerate(zip(self.stages, finished)):
            folder = self.stage_folder(stage)
            folder.mkdir(parents=True, exist_ok=True)
            # Every stage seeds anew, so that loading a finished one changes nothing that follows.
            lightning.seed_everything(self.seed + number, verbose=False)
            self.datamodule.restart(number)
            blank = done or (folder / "last.ckpt").is_file()
            if number == 0 and self.start is not None and not blank:
                module, handover = self.start()
            clock = Clock(self.clock)
            with clock.running():  # a hull, a plane sweep
                module = self._module(stage, module, handover, blank=blank)
            module.clock = Clock(self.clock) if blank else clock
            if done:
                checkpoints.load_weights(module, folder / "last.ckpt")
                self.tell(f"{stage.settings.name}: finished before")
            else:
                with held(folder) as check_folder:
                    self._fit_stage(stage, module, handover, steps, check_folder)
            steps += int(_done(folder)["steps"])
            handover = checkpoints.load_handover(folder)
        return module

    def _check_ahead(self, stages: Sequence[Stage]) -> None:
        """Refuse, before training, what a method cannot do on this device, and mistakes in later stages."""
        for stage in stages:
            settings, check = stage.settings, self._of_method(stage, "check_feasible")
            check(self.datamodule.scene, settings.name, settings.numbers, self.device)
            if stage is not self.stages[0]:
                self._module(stage, blank=True)

    def load(self) -> DynamicSceneModule:
        """Load the last stage of a finished run.

        Raises:
            ValueError: if a stage is not finished.
        """
        self.datamodule.setup("test")
        for stage in self.stages:
            if not self.is_finished(stage):
                expected = f"{self.stage_folder(stage)}: expected a finished stage"
                raise ValueError(f"{expected}, but got none; continue with forewarp-train")
        *before, last = self.stages
        handover = checkpoints.load_handover(self.stage_folder(before[-1])) if before else None
        module = self._module(last, handover=handover, blank=True)
        checkpoints.load_weights(module, self.stage_folder(last) / "last.ckpt")
        return module

    def stage_folder(self, stage: Stage) -> Path:
        """Return the folder of a stage."""
        return Path(self.folder) / stage.settings.name

    def is_finished(self, stage: Stage) -> bool:
        """Return whether a stage was trained to its end and has written all its files."""
        folder = self.stage_folder(stage)
        try:
            checkpoints.load_handover(folder)
        except ValueError:
            return False
        return _done(folder) is not None and (folder / "last.ckpt").is_file()

    def finished(self) -> dict[str, dict]:
        """Return the contents of ``done.json`` by stage: seconds, steps, peak memory and so on."""
        done = {stage.settings.name: _done(self.stage_folder(stage)) for stage in self.stages}
        return {name: content for name, content in done.items() if content is not None}

    def _of_method(self, stage: Stage, name: str) -> Callable:
        """Return a check of a stage's method before it is built; a factory of another kind has none."""
        model = stage.model or self.model
        return getattr(getattr(model, "func", model), name, lambda *_: None)

    def _module(
        self,
        stage: Stage,
        before: DynamicSceneModule | None = None,
        handover: Handover | None = None,
        *,
        blank: bool = False,
    ) -> DynamicSceneModule:
        """Build the module of a stage.

        Args:
            stage: one of ``stages``.
            before: the module of the stage before; None where it is not at hand.
            handover: what that stage left; None for the first.
            blank: whether a checkpoint will replace what the method begins with.
        """
        scene: Scene = self.datamodule.scene
        seed = self.seed + self.stages.index(stage)
        settings, objective = stage.settings.over(len(scene.train)), stage.objective
        options = {"seed": seed, "where": f"stage.{settings.name}.curriculum", **settings.curriculum}
        curriculum = Curriculum(instants_of(scene.train), scene.canonical_time, **options)
        start = Start(
            scene,
            settings.name,
            settings.numbers,
            frames=curriculum.frames(),
            handover=handover,
            before=None if before is None else before.method,
            blank=blank,
            weights=objective.weights,
            literal=objective.literal,
            photo_on=objective.photo_on,
            shares=self.start is not None,
        )
        method = (stage.model or self.model)(start)
        return DynamicSceneModule(
            method, objective=objective, settings=settings, curriculum=curriculum, seed=seed
        )

    def _fit_stage(
        self,
        stage: Stage,
        module: DynamicSceneModule,
        before: Handover | None,
        steps_before: int,
        check_folder: Callable[[], None],
    ) -> None:
        """Train a stage to its end, from its checkpoint if it has one, and write what it leaves."""

        def check(trainer: lightning.Trainer) -> None:
            check_folder()
            sentinel.check(trainer)

        settings, folder = stage.settings, self.stage_folder(stage)
        last = folder / "last.ckpt"
        sentinel = Sentinel(folder, skip=self.skip)
        keeper = checkpoints.KeepCheckpoint(last, self.checkpoint_seconds, check)
        checkpoint, steps = last if last.is_file() else None, 0
        if checkpoint is not None:
            steps, seconds = checkpoints.check_state(checkpoint, module)
            fraction = module.settings.fraction(steps, seconds)
            self.tell(f"{settings.name}: resuming at {fraction:.0%}, step {steps}")
        loggers, module.trackers = self.loggers.open(steps_before, steps), self.loggers
        callbacks = [sentinel, *self.callbacks(settings.name, folder), keeper]
        trainer = self.make_trainer(folder, callbacks, loggers)
        reset_peak_memory()
        code = {name: source_of(name) for name in self.packages}  # now, as the stage may end with others
        with keeper.listening():
            trainer.fit(module, datamodule=self.datamodule, ckpt_path=checkpoint, weights_only=True)
        if module.fraction < 1:  # fit returned early, as when a callback stops it: the stage is not finished
            raise KeyboardInterrupt(keeper.asked or signal.SIGINT)
        curriculum, most = module.curriculum, module.settings.iterations
        in_play, count = curriculum.in_play, len(curriculum.order)
        name = settings.name
        if most != settings.iterations and module.global_step >= most:
            each = f"{settings.steps_per_picture:g} for each of {count} training pictures"
            more = f"for as many as the budget has: stage.{name}.steps_per_picture=null"
            self.tell(f"{name}: ended after {most:,} steps, {each}; {more}")
        if in_play < count and curriculum.iterations_per_time is not None:
            more = f"for all, set a larger budget, or stage.{name}.curriculum.iterations_per_time=null"
            self.tell(f"{name}: ended when {in_play} of {count} training images had come in; {more}")
        target = self._target_of(stage, module)
        keeper.save(trainer)
        handover = checkpoints.make_handover(module.method, self.datamodule.scene, before, in_play)
        checkpoints.save_handover(handover, folder)
        clock, steps, parameters = module.clock, module.global_step, parameter_count(module.method)
        done = {"seconds": clock.seconds, "clocks": clock.every, "steps": steps, "parameters": parameters}
        done |= {"frames_in_play": in_play, "peak_memory_bytes": peak_memory_bytes(), **target}
        done |= {"skipped_steps": sentinel.skipped, "code": code, "versions": versions()}
        write_json(folder / "done.json", done)
        if keeper.asked:  # after the stage's last step
            raise KeyboardInterrupt(keeper.asked)

    def _target_of(self, stage: Stage, module: DynamicSceneModule) -> dict:
        """Say whether the target was reached, and when; return it for the last stage's ``done.json``."""
        if stage is not self.stages[-1] or not self.target.is_set:
            return {}
        target, name = asdict(self.target), stage.settings.name
        known, got = ", ".join(f"target.{key}={dB:g}" for key, dB in target.items() if dB), module.reached
        if got is None:
            self.tell(f"{name}: {known} not reached within the budget")
            got = dict.fromkeys(("reached", "seconds", "step", "held_out_psnr"))
        else:
            when = f"at {got['seconds']:.1f} s of training, step {got['step']:,} of the stage"
            psnr = f"with {got['held_out_psnr']:.2f} dB of views not trained on"
            self.tell(f"{name}: {got['reached']} reached {when}, {psnr} ({known})")
        return {"target": target | got}


def _done(folder: Path) -> dict | None:
    """Read a stage's ``done.json``; None if the stage has not ended."""
    done = read_json(folder / "done.json")
    return done if done is not None and {"seconds", "steps"} <= done.keys() else None


def reset_peak_memory() -> None:
    """Start a new measurement of ``peak_memory_bytes``, on Linux and on CUDA; elsewhere do nothing.

    Return unused memory to the system first, so that a run does not count what earlier runs left behind.
    """
    gc.collect()
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)  # glibc's
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    with suppress(OSError):
        (_PROCESS / "clear_refs").write_text("5")


def peak_memory_bytes() -> int:
    """Return the peak memory in bytes, of the GPU if one was used, else of the process.

    Measured since ``reset_peak_memory``, or since the process began if the system cannot reset the peak.
    """
    if torch.cuda.is_available() and torch.cuda.max_memory_allocated() > 0:
        return torch.cuda.max_memory_allocated()
    with suppress(OSError):
        if peak := re.search(r"^VmHWM:\s*(\d+)", (_PROCESS / "status").read_text(), re.MULTILINE):
            return int(peak[1]) * 1024  # in KiB
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # elsewhere in KiB
