"""Make the plan of a run, or read the plan made before."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from omegaconf import DictConfig

from forewarp.data.module import most_held_out
from forewarp.methods.effect import Planning
from forewarp.planning.plan_file import read_plan, write_plan
from forewarp.planning.planner import Planner
from forewarp.planning.trials import Trials
from forewarp.runs.build import build_run
from forewarp.runs.config import HASH, content_hash, trust_of
from forewarp.runs.overrides import key_of
from forewarp.scene.frame import Scene

# Keys that do not change what a run computes.
NOT_OF_IT = ("effects", "plan", "run", "evaluate", "sheets", "views", "reduce", "planned", "trust", "score")
LEAST = {"steps": 1, "trial_steps": 1, "seeds": 1, "held_out": 2}  # whole numbers
OF_METHOD = ("steps", "trial_steps", "least")  # null: as the method has it
AMOUNTS = ("seconds", "trial_seconds", "minutes", "least")


def make_plan(config: DictConfig, overrides: Sequence[str]) -> dict:
    """Decide which effects a scene calls for and write ``plan.yaml``, or read an existing ``plan.yaml``.

    Args:
        config: the config of the run to plan, composed from ``overrides``.
        overrides: the typed overrides.

    Returns:
        the content of ``plan.yaml``: ``typed`` and ``overrides``, which together make the run, ``effects``
        (choice, on, because), ``evidence``, ``seconds``, ``of`` (a hash of config and data); and ``file``.

    Raises:
        ValueError: if the run cannot be planned, or ``plan.folder`` holds a plan of another config or data.
    """
    asked_as = list(overrides)
    typed = [override for override in overrides if key_of(override).split(".")[0] not in NOT_OF_IT]
    run = build_run(config)
    run.check_device()  # before a folder is made
    planning = planning_of(run.model, config.model.name)
    refuse(config, typed)
    run.datamodule.setup("fit")
    # A typed key is not decided by the plan, even if its value is the default.
    asked = content_hash(config, ("plan",), sorted(typed), run.datamodule.fingerprint())
    folder = Path(str(config.plan.folder).replace(HASH, asked))
    file = folder / "plan.yaml"
    if file.is_file():
        made = read_plan(file, trust_of(config.get("trust")), typed)
        if made["of"] != asked:
            raise ValueError(
                f"plan.folder: expected the plan of this command and data, but got another in {file}; "
                "use another plan.folder, or delete it"
            )
        return made | {"file": str(file), "found": True}
    begin = time.perf_counter()
    trials = Trials(
        typed,
        folder,
        steps=config.plan.steps or planning.steps,
        seconds=config.plan.seconds,
        fine_steps=config.plan.trial_steps or planning.trial_steps,
        fine_seconds=config.plan.trial_seconds,
        held_out=spared(run.datamodule.scene, config.plan.held_out),
        tell=lambda name: print(f"{folder / name}", flush=True),
    )
    made = Planner(config, typed, trials, run.datamodule.scene, planning).plan()
    seconds = time.perf_counter() - begin + trials.seconds_before
    made |= {"seconds": round(seconds, 1), "of": asked, "asked": asked_as}
    write_plan(file, made)
    return made | {"file": str(file)}


def planning_of(model: Callable, name: str) -> Planning:
    """Return the ``Planning`` of a method: what decides which effects to switch on.

    Raises:
        ValueError: if the method has no effects to plan.
    """
    planning = getattr(model, "planning", getattr(getattr(model, "func", None), "planning", None))
    if planning is None:
        raise ValueError(
            f"model: expected a method whose effects can be planned, but {name} has none; use "
            "model=particles or model=forward, or leave out effects=auto"
        )
    return planning


def spared(scene: Scene, wanted: int) -> int:
    """Return how many training views to hold out: as many as wanted, or as the scene can spare.

    Raises:
        ValueError: if the scene can spare fewer than two.
    """
    most = most_held_out(scene)
    if most < 2:
        raise ValueError(
            f"plan: expected a scene that can spare 2 training views for its trials, but {scene.name} of "
            f"{len(scene.train)} can spare {most}; choose the effects yourself"
        )
    return min(wanted, most)


def refuse(config: DictConfig, typed: Sequence[str]) -> None:
    """Refuse a run that cannot be planned, before its data are read."""
    if config.get("resume") is not None:
        raise ValueError("resume: expected nothing where a run is planned; leave it out")
    if gone := [one for one in typed if one.startswith("~") and not one.startswith("~stage.")]:
        raise ValueError(
            f"{gone[0]}: expected overrides that set a key, as a plan keeps them; use {gone[0][1:]}=null"
        )
    if any(one.startswith("~") for one in typed) or len(config.stage) < 2:
        raise ValueError("stage: expected a coarse stage and another, but got one; leave out ~stage.<name>")
    for key, least in LEAST.items():
        value = config.plan[key]
        if not (isinstance(value, int) and value >= least) and not (value is None and key in OF_METHOD):
            raise ValueError(f"plan.{key}: expected a whole number >= {least}, but got {value}")
    for key in AMOUNTS:
        value = config.plan[key]
        free = value is None and key in ("minutes", *OF_METHOD)
        if not (isinstance(value, int | float) and value > 0) and not free:
            raise ValueError(f"plan.{key}: expected a number > 0, but got {value}")
