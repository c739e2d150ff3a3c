"""Decide which effects a scene calls for, from its images and at most one still fit; write ``plan.yaml``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
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
from forewarp.progress import told_if_slow
from forewarp.runs.build import build_run
from forewarp.runs.config import HASH, content_hash, trust_of
from forewarp.runs.fitted import tell
from forewarp.runs.overrides import key_of, merged, without_switched_off
from forewarp.runs.session import session
from forewarp.scene.frame import survey
from forewarp.training.stages import Run

# Keys that do not change what a run computes.
NOT_OF_IT = ("effects", "plan", "run", "evaluate", "sheets", "views", "reduce", "planned", "trust", "score")
CAPTURES = ("cut_out", "video")  # options of the group ``capture`` that images can tell apart


def make_plan(config: DictConfig, overrides: Sequence[str]) -> dict:
    """Decide which effects a scene calls for and write ``plan.yaml``, or read an existing ``plan.yaml``.

    Args:
        config: the config of the run to plan, composed from ``overrides``.
        overrides: the typed overrides.

    Returns:
        the content of ``plan.yaml``: ``typed`` and ``overrides``, which together make the run, ``effects``
        (choice, on, because), ``evidence``, ``seconds``, ``of`` (a hash of config and data); where there was
        a still fit ``fit``: its steps, seconds and share of the budget, on top of it; and ``file``.

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
    of_data = run.datamodule.fingerprint()
    asked = content_hash(config, ("plan",), sorted(typed), of_data, method.still_steps)
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
        made, fit = _decided(config, typed, folder, run, method, clock)
    made["seconds"] = round(clock.seconds + (fit.seconds if fit else 0.0), 1)
    if fit is not None:
        made["fit"] = fit.cost(config.budget)
    write_plan(file, made := made | {"of": asked, "asked": list(overrides)})
    return made | {"file": str(file)}


@dataclass(frozen=True)
class StillFit:
    """A finished still fit: what it leaves over, None where hardly anything is opaque, and what it took."""

    residual: Residual | None
    steps: int
    seconds: float

    def cost(self, budget: Mapping) -> dict[str, float]:
        """Return its steps, seconds and share of a run's budget, by whichever of its bounds is nearer.

        >>> StillFit(None, 700, 4.5).cost({"minutes": 1, "iterations": 2000})
        {'steps': 700, 'seconds': 4.5, 'share': 0.35}
        """
        of_minutes = self.seconds / (60 * budget["minutes"]) if budget["minutes"] else 0.0
        of_steps = self.steps / budget["iterations"] if budget["iterations"] else 0.0
        share = round(max(of_minutes, of_steps), 3)
        return {"steps": self.steps, "seconds": round(self.seconds, 1), "share": share}


def _decided(
    config: DictConfig, typed: list[str], folder: Path, run: Run, method: type[Method], clock: Clock
) -> tuple[dict, StillFit | None]:
    """Return the plan, without seconds: overrides, effects with reasons, evidence; and the still fit, for
    which ``clock`` is paused, as a fit does not count reading and compiling.
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
    fit = None
    if evidence.silhouettes_rest and of_user < set(names):
        if method.still_steps is None:
            evidence = replace(evidence, unfit="the method names no steps of a still fit")
        else:
            # All effects are off in it, typed ones too: it says what the scene calls for.
            still = merged(base, [f"model/{name}=none" for name in names])
            fit = _still_fit(run, still, method.still_steps, folder / "still", clock)
            opaque = None if fit.residual else "a still fit shows hardly anything that is opaque"
            evidence = replace(evidence, residual=fit.residual, unfit=opaque)
    decisions = decide(method.effects, evidence, preset, as_typed)
    # The method and all choices: defaults may change.
    overrides = [f"model={choices['model']}", *base[len(typed) :]]
    overrides += [f"model/{d.effect}={d.choice}" for d in decisions if d.effect not in of_user]
    effects = {d.effect: {"choice": d.choice, "on": d.on, "because": d.because} for d in decisions}
    known = {name: value for name, value in asdict(evidence).items() if value is not None}
    return {"typed": list(typed), "overrides": overrides, "effects": effects, "evidence": known}, fit


def is_of(key: str, effect: str) -> bool:
    """Tell whether a typed key chooses an effect or sets its numbers.

    >>> [is_of(key, "motion") for key in ("model/motion", "model.motion.tau", "model.rotation")]
    [True, True, False]
    """
    return key in (f"model/{effect}", f"model.{effect}") or key.startswith(f"model.{effect}.")


def _still_fit(planned: Run, overrides: list[str], steps: int, folder: Path, clock: Clock) -> StillFit:
    """Fit the planned run without effects for so many steps, and measure the errors that it leaves.

    The steps are the same whatever the run's budget, and end by no clock; for them ``clock`` is paused.
    """
    config = compose("train", without_switched_off(overrides))
    with open_dict(config):
        config.run, config.effects, config.evaluate = str(folder), "given", False
        config.logger, config.callbacks, config.start, config.target = None, {}, None, None
        config.budget = {"clock": clock.kind, "minutes": None, "iterations": steps}
        for stage in planned.stages:
            model, settings = stage.model or planned.model, config.stage[stage.settings.name]
            settings.steps_per_picture = None
            if "effects" in getattr(getattr(model, "func", model), "numbers", ()):
                settings.effects = []  # motion, too, of a method that does not count it among its effects
    run = build_run(config)
    run.tell = lambda line: None
    with session(run, config):
        with clock.paused(), told_if_slow("plan", f"{steps} steps of a still fit, whatever the budget"):
            module = run.fit().to(run.device)
        done = [*run.finished().values()]
        left = residual(module.method, run.datamodule.targets("train"))
        return StillFit(left, sum(one["steps"] for one in done), sum(one["seconds"] for one in done))


def refuse(config: DictConfig, typed: Sequence[str]) -> None:
    """Refuse a run that cannot be planned, before its data are read."""
    if config.get("resume") is not None:
        raise ValueError("resume: expected nothing where a run is planned; leave it out")
    for override in typed:
        if override.startswith("~"):
            expected = "expected overrides that set a key, as a plan keeps them"
            raise ValueError(f"{override}: {expected}; use {override[1:]}=null")
