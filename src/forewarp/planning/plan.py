"""Decide which effects a scene calls for, from its images and at most one short fit; write ``plan.yaml``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from hydra import compose
from omegaconf import DictConfig, open_dict

from forewarp.clock import Clock
from forewarp.data.checks import remarks
from forewarp.data.files import mismatch
from forewarp.methods.effect import Evidence, Residual, decide
from forewarp.methods.method import Method
from forewarp.planning.plan_file import read_plan, write_plan
from forewarp.planning.residual import residual
from forewarp.runs.build import build_run
from forewarp.runs.config import HASH, content_hash, trust_of
from forewarp.runs.fitted import tell
from forewarp.runs.overrides import key_of, merged, without_switched_off
from forewarp.runs.session import session
from forewarp.scene.frame import survey
from forewarp.training.stages import Run

# Keys that do not change what a run computes.
NOT_OF_IT = ("effects", "plan", "run", "evaluate", "sheets", "views", "reduce", "planned", "trust", "score")
SHARE = 0.1  # of the run's budget that the short fit may take
MOST = 1.0  # minutes of it, whatever the run's budget
ENOUGH = 0.9  # of its steps that it must reach for its errors to count: stages end by the clock, too
CAPTURES = ("cut_out", "video")  # options of the group ``capture`` that images can tell apart


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
    typed = [override for override in overrides if key_of(override).split(".")[0] not in NOT_OF_IT]
    run = build_run(config)
    run.check_device()  # before a folder is made
    method = getattr(run.model, "func", run.model)
    if not getattr(method, "effects", ()):
        advice = "use model=particles, model=forward or model=backward, or leave out effects=auto"
        raise mismatch("model", "a method with effects to choose from", f"{config.model.name}", advice)
    refuse(config, typed)
    run.datamodule.setup("fit")
    tell(remarks(run.datamodule.scene))
    # A typed key is not decided by the plan, even if its value is the default.
    asked = content_hash(config, ("plan",), sorted(typed), run.datamodule.fingerprint())
    folder = Path(str(config.plan.folder).replace(HASH, asked))
    file = folder / "plan.yaml"
    if file.is_file():
        made = read_plan(file, trust_of(config.get("trust")), typed)
        if made["of"] != asked:
            expected, advice = "the plan of this command and data", "use another plan.folder, or delete it"
            raise mismatch("plan.folder", expected, f"another in {file}", advice)
        return made | {"file": str(file), "found": True}
    clock = Clock(config.budget.clock)
    with clock.running():
        made, fitted = _decided(config, typed, folder, run, method, clock)
    made |= {"seconds": round(clock.seconds + fitted, 1), "of": asked, "asked": list(overrides)}
    write_plan(file, made)
    return made | {"file": str(file)}


def _decided(
    config: DictConfig, typed: list[str], folder: Path, run: Run, method: type[Method], clock: Clock
) -> tuple[dict, float]:
    """Return the plan, without seconds: overrides, effects with reasons, evidence; and the seconds of a short
    fit, for which ``clock`` is paused, as a fit does not count reading and compiling.
    """
    evidence, names = Evidence(survey(run.datamodule.scene)), [effect.name for effect in method.effects]
    chosen = {key_of(override): override.partition("=")[2] for override in typed}
    of_user = {name for name in names if any(is_of(key, name) for key in chosen)}
    base = list(typed)
    if config.capture in CAPTURES and "capture" not in chosen:
        base.append(f"capture={CAPTURES[0] if evidence.cut_out else CAPTURES[1]}")
    choices = compose("train", base, return_hydra_config=True).hydra.runtime.choices
    preset = {name: choices.get(f"model/{name}") or "none" for name in names}
    off = {name for name in names if chosen.get(f"model.{name}") in ("null", "None")}
    as_typed = {name: "none" if name in off else preset[name] for name in of_user}
    budget = short(config.budget, method.still_steps)
    is_still = all(choice == "none" for choice in as_typed.values())  # what was typed stays in the fit
    seconds = 0.0
    if evidence.silhouettes_rest and budget is not None and is_still:
        still = [f"model/{name}=none" for name in names if name not in of_user]
        left, seconds = _still_fit(merged(base, still), budget, folder / "still", clock)
        evidence = replace(evidence, residual=left)
    decisions = decide(method.effects, evidence, preset, as_typed)
    # The method and all choices: defaults may change.
    overrides = [f"model={choices['model']}", *base[len(typed) :]]
    overrides += [f"model/{d.effect}={d.choice}" for d in decisions if d.effect not in of_user]
    effects = {d.effect: {"choice": d.choice, "on": d.on, "because": d.because} for d in decisions}
    known = {name: value for name, value in asdict(evidence).items() if value is not None}
    return {"typed": list(typed), "overrides": overrides, "effects": effects, "evidence": known}, seconds


def is_of(key: str, effect: str) -> bool:
    """Tell whether a typed key chooses an effect or sets its numbers.

    >>> [is_of(key, "motion") for key in ("model/motion", "model.motion.tau", "model.rotation")]
    [True, True, False]
    """
    return key in (f"model/{effect}", f"model.{effect}") or key.startswith(f"model.{effect}.")


def _still_fit(
    overrides: list[str], budget: Mapping, folder: Path, clock: Clock
) -> tuple[Residual | None, float]:
    """Fit the run without effects for a moment, and measure the errors that it leaves, None if the time was
    too short to tell; also return the seconds of the fit, for which ``clock`` is paused.
    """
    config = compose("train", without_switched_off(overrides))
    with open_dict(config):
        config.run, config.effects, config.evaluate = str(folder), "given", False
        config.logger, config.callbacks, config.budget = None, {}, budget
    run = build_run(config)
    run.tell = lambda line: None
    with session(run, config):
        with clock.paused():
            module = run.fit().to(run.device)
        done = run.finished().values()
        seconds = sum(stage["seconds"] for stage in done)
        if sum(stage["steps"] for stage in done) < ENOUGH * budget["iterations"]:
            return None, seconds
        return residual(module.method, run.datamodule.targets("train")), seconds


def short(budget: Mapping, steps: int) -> dict | None:
    """Return the budget of a short fit of so many steps; None if the run's budget is too small for it.

    >>> short({"clock": "wall", "minutes": 2, "iterations": None}, 700)
    {'clock': 'wall', 'minutes': 0.2, 'iterations': 700}
    >>> short({"clock": "wall", "minutes": None, "iterations": 500}, 700)
    """
    minutes, iterations = budget["minutes"], budget["iterations"]
    if iterations is not None and SHARE * iterations < steps:
        return None
    return {**budget, "minutes": min(MOST, SHARE * (minutes or math.inf)), "iterations": steps}


def refuse(config: DictConfig, typed: Sequence[str]) -> None:
    """Refuse a run that cannot be planned, before its data are read."""
    if config.get("resume") is not None:
        raise ValueError("resume: expected nothing where a run is planned; leave it out")
    for override in typed:
        if override.startswith("~"):
            expected = "expected overrides that set a key, as a plan keeps them"
            raise ValueError(f"{override}: {expected}; use {override[1:]}=null")
