"""Prepare a run: refuse a config that cannot work, and put together what is trained.

What is wrong with a command by itself is refused before torch is loaded, so a mistake is answered at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from forewarp.cli.mistakes import of_another
from forewarp.data.files import mismatch, number, one_of, scene_folder, whole
from forewarp.files import MOST_CONFIG, read_text, replace_file
from forewarp.outline import check_outline
from forewarp.runs.config import (
    check_planned,
    check_values,
    hashed,
    is_swept,
    refuse_to_synthesize,
    resumed,
    set_value,
    trust_of,
)
from forewarp.runs.overrides import key_of, merged, typed_overrides, without_switched_off

if TYPE_CHECKING:  # loads torch
    from forewarp.runs.fitted import Score
    from forewarp.training.stages import Run

# The layouts that our data modules read; those of others, and those that make their scene, check for
# themselves.
READ = {
    "DNeRFDataModule": "D-NeRF",
    "LegoCompleteDataModule": "D-NeRF",
    "HyperNeRFDataModule": "HyperNeRF",
    "NHRDataModule": "NHR",
    "MulticamDataModule": "DyNeRF",
    "PosedVideoDataModule": "nerfstudio",
}
VOXELS, PARTICLES = "forewarp.methods.voxel.", "forewarp.methods.particles."

CHOICES = {"effects": ("given", "auto"), "absent": ("refuse", "skip")}
# The least whole number, whether null is one too, and the range of a number.
LEAST = {"frames": 2, "view": 0, "points": 1, "size": 16, "views": 1, "sheets": 0, "reduce": 2}
MAY_BE_NULL = ("size", "views", "reduce", "frames", "fps")
RANGES = {"fps": (0.1, 1000), "time": (0, 1), "tail": (0.01, 1)}


@dataclass
class Prepared:
    """A run that nothing is known to be wrong with, its scene read.

    Attributes:
        run: the run.
        config: its config.
        score: what the job returns.
        measured: whether the run was finished and measured before.
        viewer: ``host`` and ``port`` of a page that shows the run while it trains; None: no page.
        plan: text of the plan that is followed; None: there is none, or the run's folder has it.
    """

    run: Run
    config: DictConfig
    score: Score
    measured: bool
    viewer: dict | None
    plan: str | None

    @contextmanager
    def session(self) -> Iterator[None]:
        """Hold the run's folder, with a copy of the plan that is followed; show a page, if one is asked for.

        Raises:
            ValueError, OSError: see ``forewarp.runs.session.session``.
        """
        from forewarp.runs.session import session

        with ExitStack() as stack:
            if self.viewer is not None and not self.measured:
                from forewarp.viewer.server import live

                stack.enter_context(live(self.run, **self.viewer))
            stack.enter_context(session(self.run, self.config, finished=self.measured))
            stack.enter_context(self.run.loggers)
            if self.plan is not None:
                replace_file(Path(self.run.folder) / "plan.yaml", self.plan)
            yield


def prepare(config: DictConfig) -> Prepared | None:
    """Refuse a command that cannot work, else put its run together; None where a sweep skips the scene.

    Args:
        config: composed for ``forewarp-train``; with ``resume`` that run's stored config takes its place.

    Raises:
        ValueError, OSError, ImportError: naming what to change. No folder of a run has been made then.
    """
    refuse_all(config)
    trust = trust_of(config.get("trust"))
    if config.get("planned") is not None:
        check_planned(config, trust)
        refuse_to_synthesize(config)
    viewer = viewer_of(config)  # as typed: a stored config has none
    config, resumes = resumed(config), config.get("resume") is not None
    refuse_missing_scene(config)
    # What follows loads torch; mistakes in the command have been answered before.
    from forewarp.data.checks import remarks
    from forewarp.runs.build import build_run
    from forewarp.runs.fitted import Score, is_current, named, tell

    named(config.get("score"))
    config = hashed(config)
    refuse_missing_start(config)
    run = build_run(config)
    place = run.datamodule.place
    synthetic = hasattr(run.datamodule, "prepare")  # it makes a scene that is not there
    if config.get("absent") == "skip" and not synthetic and place is not None and not place.is_dir():
        print(f"skipped: {place}: no such scene")
        return None
    is_planned = config.get("effects") == "auto" and config.get("resume") is None
    if is_planned:
        config = hashed(planned())
        run = build_run(config)
    measured = bool(config.evaluate) and is_current(run.folder / "metrics.json", run)
    if not measured:
        run.check_device()
        run.datamodule.setup("fit")
        refuse_unwatched(run)
        if config.evaluate and config.get("reduce") is not None:
            run.datamodule.targets("test").reduced(config.reduce)
        if not is_planned:  # else the plan has said so
            tell(remarks(run.datamodule.scene))
    plan = config.get("planned")  # of a stored config it could name any file
    plan = None if plan is None or measured or resumes else read_text(Path(plan), MOST_CONFIG)
    return Prepared(run, config, Score(run, config), measured, viewer, plan)


def planned() -> DictConfig:
    """Make or read a plan of what was typed; return the config of the run that the plan says."""
    from hydra import compose

    from forewarp.planning.plan import make_plan
    from forewarp.planning.plan_file import own_folder, show_plan

    typed, of_job = typed_overrides(of_sweep=True), typed_overrides()
    keys = [*map(key_of, typed)]
    if "sweeps" in keys and "model" not in keys:  # the sweep's file may name it
        of_job = [f"model={HydraConfig.get().runtime.choices['model']}", *of_job]
    made = make_plan(compose("train", typed), of_job)
    show_plan(made, to_fit=False)
    config = compose("train", without_switched_off(merged([*made["overrides"], *own_folder(typed)], typed)))
    config.planned = made["file"]
    return config


def refuse_all(config: DictConfig) -> None:
    """Refuse what is wrong with a config by itself, whatever the data."""
    check_outline(OmegaConf.to_container(config, resolve=False))
    for key, choices in CHOICES.items():
        one_of(config.get(key, choices[0]), key, *choices)
    refuse_seeds(config)
    model, ablation = config.model.name, config.get("variant") or {}
    if model not in ablation.get("of", [model]):
        expected = f"{' or '.join(ablation.of)}, which {ablation.name} is a change of"
        raise mismatch("model", expected, model, "leave one of them out")
    if config.preset.get("name") == "compact" and model not in ("forward", "backward"):
        expected = "expected demo, fast or faithful, as compact is of model=forward and model=backward"
        raise ValueError(f"preset: {expected}, but got compact beside model={model}")
    refuse_other_methods(config)
    refuse_numbers(config, "views", "sheets", "reduce")
    refuse_target_without_curve(config)
    check_values(config)


def refuse_missing_scene(config: DictConfig) -> None:
    """Refuse a scene whose folder is missing, unless ``absent`` says to skip it.

    Raises:
        SceneError: listing the scenes that are there.
    """
    layout = READ.get(str(config.data.get("_target_")).removeprefix("forewarp.data.module."))
    if layout is not None and config.get("absent", "refuse") == "refuse":
        scene_folder(Path(config.data.root).expanduser(), str(config.data.scene), layout)


def refuse_missing_start(config: DictConfig) -> None:
    """Refuse a run that begins from another one which is not finished, or by a method that cannot."""
    start = config.get("start")
    if start is None:
        return
    if not str(config.model.get("_target_")).startswith(PARTICLES):
        raise ValueError(f"start: expected model=particles beside it, but got model={config.model.name}")
    if not any(Path(config.run).glob("*/last.ckpt")) and not any(Path(start).glob("*/done.json")):
        advice = "make it by the same command with windows=still, without data.window and start"
        raise mismatch("start", "a finished run of what stands still", f"none in {start}", advice)


def refuse_target_without_curve(config: DictConfig) -> None:
    """Refuse a target where the curve that it is read from is switched off."""
    if set_value(config, "target") is not None and (config.get("callbacks") or {}).get("accuracy") is None:
        advice = "leave out callbacks.accuracy=null and debug=, which switches it off, or the target"
        raise mismatch("callbacks.accuracy", "the curve that a target is read from", "null", advice)


def refuse_unwatched(run: Run) -> None:
    """Refuse a target where no view is left to read it from."""
    if run.target.is_set and not len(run.datamodule.watched()):
        advice = "set data.held_out=8"
        raise mismatch("target", "views that are not trained on, and no test views", "none", advice)


def refuse_seeds(config: DictConfig) -> None:
    """Refuse ``seeds=`` without ``--multirun``, which repeats the run, and in a search by a sweeper."""
    swept = is_swept()
    if not swept and config.get("seeds", 1) != 1:
        raise ValueError(f"seeds: expected --multirun beside seeds={config.seeds}; add it, or use seed=N")
    if swept and "_optuna_" in str(HydraConfig.get().sweeper.get("_target_")):
        seeds = str((HydraConfig.get().sweeper.get("params") or {}).get("seed", ""))
        if config.get("seeds", 1) != 1:
            raise ValueError(f"seeds: expected 1 in a search, but got {config.seeds}; use seed=N")
        if seeds.startswith("range"):
            key, wanted = "hydra.sweeper.params.seed", "one seed, as this sweeper would search among several"
            raise mismatch(key, wanted, seeds, f"add {key}=0")


def refuse_other_methods(config: DictConfig) -> None:
    """Refuse options of another method: of voxels for particles, and the other way round.

    Effects of voxels are classes, those of particles numbers and words; particles see no single rays.
    """
    target, model = str(config.model.get("_target_")), config.model.name
    if not HydraConfig.initialized():
        return
    choices = HydraConfig.get().runtime.choices
    begins, of_preset = choices.get("start_motion"), f"{choices.get('model')}_{choices.get('preset')}"
    if begins not in (None, of_preset):  # which an experiment chooses for every method, and few have
        one_of(begins, "start_motion", "own", "particles")
    if begins == "particles" and model != "forward":
        raise ValueError(of_another("start_motion=particles", model, "forward"))
    if not target.startswith((VOXELS, PARTICLES)):
        return
    voxels = target.startswith(VOXELS)
    for group, option in choices.items():
        own = group.startswith("model/") and "@" not in group  # else of a stage's own model
        part = config.model._get_node(group[6:]) if own else None
        if part is not None and not part._is_none() and isinstance(part, DictConfig) != voxels:
            raise ValueError(of_another(f"{group}={option}", model, "particles" if voxels else "forward"))
    if voxels or any("model" in (stage or {}) for stage in config.get("stage", {}).values()):
        return
    for typed in typed_overrides():
        if key_of(typed) in ("preset.rays", "data.rays") and not typed.endswith("=null"):
            raise ValueError(of_another(typed, model, "forward"))


def refuse_numbers(config: DictConfig, *keys: str) -> None:
    """Refuse values that keys of ``LEAST`` and ``RANGES`` cannot have; a config may lack a key."""
    for key in keys:
        value = config.get(key)
        if key not in config or (value is None and key in MAY_BE_NULL):
            continue
        if key in LEAST:
            whole(value, key, LEAST[key])
        else:
            number(value, key, *RANGES[key])


def require_viewer() -> None:
    """Refuse to go on without the package that makes the page.

    Raises:
        ImportError: naming what to install.
    """
    if find_spec("viser") is None:
        raise ImportError("viewer: expected viser, but got none; install forewarp[viewer]")


def viewer_of(config: DictConfig) -> dict | None:
    """Return where a page should listen, None if none is asked for; refuse one that cannot be made."""
    port = config.get("port")
    one_of(config.get("viewer", False), "viewer", True, False)
    if not config.get("viewer"):
        return None
    require_viewer()
    from forewarp.viewer.server import check_address

    if is_swept() and port != 0 and "BasicLauncher" not in str(HydraConfig.get().launcher.get("_target_")):
        expected = "port: expected 0 where jobs may run at once, so that each takes one that is free"
        raise ValueError(f"{expected}, but got {port}; set port=0, or launcher=local")
    check_address(config.host, port)
    return {"host": config.host, "port": port}
