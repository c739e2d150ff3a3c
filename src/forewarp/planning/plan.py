"""Plan a run: fit coarse stages, try effects, let the method decide, and write ``plan.yaml``."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from statistics import fmean

from hydra import compose
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from forewarp.data.checks import remarks
from forewarp.data.module import most_held_out
from forewarp.evaluation.images import psnr_by_view
from forewarp.files import read_json, write_json
from forewarp.methods.effect import Asked, Effect, Planning
from forewarp.methods.method import HasRest, check_least, check_number
from forewarp.metrics.gain import Gain
from forewarp.planning.plan_file import read_plan, write_plan
from forewarp.runs.build import build_run
from forewarp.runs.config import HASH, content_hash, trust_of
from forewarp.runs.fitted import tell
from forewarp.runs.overrides import key_of, merged, without_switched_off
from forewarp.runs.session import session
from forewarp.scene.frame import Scene, survey
from forewarp.training.checkpoints import NUMBERS, POINTS
from forewarp.training.module import DynamicSceneModule
from forewarp.training.schedule import most_steps
from forewarp.training.stages import Run

RAYS = 10_000  # pixels rendered of each held-out view
# Keys that do not change what a run computes.
NOT_OF_IT = ("effects", "plan", "run", "evaluate", "sheets", "views", "reduce", "planned", "trust", "score")
MAY_BE_NULL = ("minutes", "steps", "trial_steps", "least")


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
    planning = getattr(run.model, "planning", getattr(getattr(run.model, "func", None), "planning", None))
    if planning is None:
        raise ValueError(
            f"model: expected a method whose effects can be planned, but {config.model.name} has none; use "
            "model=particles or model=forward, or leave out effects=auto"
        )
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
            raise ValueError(
                f"plan.folder: expected the plan of this command and data, but got another in {file}; "
                "use another plan.folder, or delete it"
            )
        return made | {"file": str(file), "found": True}
    begin = time.perf_counter()
    planner = Planner(config, typed, folder, run.datamodule.scene, planning)
    made = planner.plan()
    seconds = time.perf_counter() - begin + planner.seconds_before
    made |= {"seconds": round(seconds, 1), "of": asked, "asked": list(overrides)}
    write_plan(file, made)
    return made | {"file": str(file)}


class Planner:
    """Plan one run; the method says which effects there are and what counts for each (see ``CoarseTrials``).

    Args:
        config: the config of the run to plan.
        typed: the run's overrides; the plan decides nothing that they fix.
        folder: the plan's folder.
        scene: the scene as the run would read it.
        planning: the method's ``Planning``.

    Raises:
        ValueError: if the scene can spare fewer than two training views.
    """

    def __init__(
        self, config: DictConfig, typed: list[str], folder: Path, scene: Scene, planning: Planning
    ) -> None:
        self.typed, self.settings, self.planning = typed, config.plan, planning
        self.effects: dict[str, Effect] = {effect.name: effect for effect in planning.effects}
        values = {key_of(override): override.partition("=")[2] for override in typed}
        stages = {name: stage for name, stage in config.stage.items() if stage is not None}
        self.asked = Asked(stages, config.preset, values, self._choose, bool(config.plan.trials))
        can_spare = most_held_out(scene)
        if can_spare < 2:
            raise ValueError(
                f"plan: expected a scene that can spare 2 training views for its trials, but {scene.name} of "
                f"{len(scene.train)} can spare {can_spare}; choose the effects yourself"
            )
        self.folder, self.held_out = folder, min(config.plan.held_out, can_spare)
        self.fine_steps = config.plan.trial_steps or planning.trial_steps
        # Overrides of every trial, and further ones of fine trials.
        self.always, self.always_fine = planning.always(self.asked)
        self.seconds_before = 0.0  # of the trials that were finished before
        self.made: dict[str, Trial] = {}  # fine trials so far: several effects are compared with the same
        # An effect of the last stage costs time of the last stage only.
        last = stages[self.asked.last]
        share = last.share / sum(stage.share for stage in stages.values())
        minutes = config.plan.minutes and config.plan.minutes * share
        steps = config.budget.iterations and config.budget.iterations * share
        most = most_steps(steps, last.get("steps_per_picture"), len(scene.train))
        least = config.plan.least or planning.least
        self.evidence = planning.evidence(survey(scene), least=least, minutes=minutes, most_steps=most)

    def plan(self) -> dict:
        """Return the plan, without seconds: overrides, effects with reasons, evidence."""
        evidence, asked = self.evidence, self.asked
        self.planning.coarse(evidence, asked, self)
        scene, views = self.run.datamodule.scene, self.run.datamodule.targets("train")
        self.planning.look(evidence, self.module.method, scene, views, asked)
        if self.settings.trials:
            self._try_later_effects()
        model = f"model={HydraConfig.get().runtime.choices['model']}"  # its effects; defaults may change
        overrides, effects = [model], {}
        for decision in self.planning.decide(evidence, asked):
            overrides += decision.overrides
            if decision.on and decision.effect in self.effects:
                overrides += self.effects[decision.effect].with_it(asked)
            effects[decision.effect] = {n: getattr(decision, n) for n in ("choice", "on", "because")}
        values = {field.name: getattr(evidence, field.name) for field in fields(evidence)}
        numbers = {name: asdict(value) for name, value in values.items() if is_dataclass(value)}
        numbers["trials"] = {effect: asdict(found) for effect, found in evidence.gains.items()}
        numbers["at_rest"] = dict(evidence.at_rest)
        return {
            "typed": list(self.typed),
            "overrides": list(dict.fromkeys(overrides)),
            "effects": effects,
            "evidence": json.loads(json.dumps(numbers)),  # lists for tuples, as YAML has them
        }

    def begin(self, name: str, overrides: Sequence[str], *, change: bool = False) -> None:
        """See ``CoarseTrials``: evidence is taken from this coarse stage, and fine trials begin from it."""
        overrides = merged(self.base, overrides) if change else list(overrides)
        self.name, self.base, self.fine_name = name, overrides, "fine"
        self.reached, self.run, self.module = self._coarse(name, overrides)

    def rival(self, effect: str, name: str, overrides: Sequence[str], *, adds: bool = False) -> bool:
        """See ``CoarseTrials``."""
        overrides = merged(self.base, overrides)
        rival = self._coarse(name, overrides)
        on, off = (rival[0], self.reached) if adds else (self.reached, rival[0])
        self.evidence.gains[effect] = gain([on], [off], equal_steps=False)
        pays = self.evidence.pays(effect)
        if pays == adds:
            self.name, self.base, (self.reached, self.run, self.module) = name, overrides, rival
        return pays

    def drop(self, effect: str, overrides: Sequence[str], *, longer: int = 1) -> bool:
        """See ``CoarseTrials``."""
        self._price_of_steps()
        with_it = self.fine_name, self.base
        without = f"{self.fine_name}-no-{effect}", merged(self.base, overrides)
        self._try(effect, with_it, without, longer)
        pays = self.evidence.pays(effect)
        if not pays:
            self.fine_name, self.base = without
        return pays

    def _try_later_effects(self) -> None:
        """Try each undecided effect in the fine stage: with and without the effect, at equal steps."""
        for effect in self.effects.values():
            typed = effect.group in self.asked.typed
            if effect.later and not typed and not effect.rules_out(self.evidence):
                self._price_of_steps()
                overrides = merged(self.base, [f"{effect.group}={self._choose(effect.name)}"])
                self._try(effect.name, (f"fine-{effect.name}", overrides), ("fine", self.base))

    def _price_of_steps(self) -> None:
        """Measure once what steps are worth, if the planned run has given minutes."""
        evidence = self.evidence
        if evidence.minutes is None or evidence.step is not None:
            return
        plain = self._tried("fine", self.base, 0)
        half = self._tried("fine-half", self.base, 0, max(1, plain.steps // 2))
        evidence.slope, evidence.steps, evidence.step = gain([plain], [half]).psnr, plain.steps, plain.step

    def _try(
        self, effect: str, with_it: tuple[str, list[str]], without: tuple[str, list[str]], longer: int = 1
    ) -> None:
        """Compare two trials, each a name and overrides, seed by seed; stop once the gain is clearly too
        small. ``longer``: how many times the usual steps and seconds both have.
        """
        if longer != 1:
            many = longer * self.fine_steps
            with_it, without = ((f"{name}-{many}", overrides) for name, overrides in (with_it, without))
        on, off = [], []
        for seed in range(self.settings.seeds):
            on.append(self._tried(*with_it, seed, on[0].steps if on else None, longer))
            off.append(self._tried(*without, seed, None, longer))
            if off[-1].steps != on[-1].steps:  # the trial with the effect ran out of time
                name, overrides = without
                off[-1] = self._tried(f"{name}-{on[-1].steps}", overrides, seed, on[-1].steps)
            self.evidence.gains[effect] = gain(on, off)
            if self.effects[effect].rests:
                self.evidence.at_rest[effect] = fmean(trial.at_rest for trial in on)
            if self.evidence.hopeless(effect):
                return

    def _coarse(self, name: str, changes: Sequence[str]) -> tuple[Trial, Run, DynamicSceneModule]:
        """Fit a coarse stage with these overrides; return its result, its run and the fitted module."""
        steps = self.settings.steps or self.planning.steps
        config = self._config(name, changes, self.always, 0, steps, self.settings.seconds)
        for later in list(config.stage)[1:]:
            config.stage[later] = None
        return self._fitted(config)

    def _tried(
        self, name: str, changes: list[str], seed: int, steps: int | None = None, longer: int = 1
    ) -> Trial:
        """Fit a short fine stage that begins where the chosen coarse stage ended; not twice.

        Args:
            name: name of the trial.
            changes: overrides of the trial.
            seed: added to the run's seed.
            steps: steps of the stage; None: ``fine_steps``, or fewer if ``plan.trial_seconds`` end first.
            longer: how many times these steps and seconds; of no effect where ``steps`` is given.
        """
        name = f"{name}-seed{seed}"
        if name not in self.made:
            seconds = longer * self.settings.trial_seconds if steps is None else None
            steps, always = steps or longer * self.fine_steps, [*self.always, *self.always_fine]
            config = self._config(name, changes, always, seed, steps, seconds)
            first, last = list(config.stage)[0], list(config.stage)[-1]
            config.stage[first].share, config.stage[last].share = 1e-6, 1.0
            self.made[name] = self._fitted(config, self.folder / self.name / first)[0]
        return self.made[name]

    def _config(self, name: str, changes, always, seed: int, steps: int, seconds: float | None) -> DictConfig:
        config = compose("train", without_switched_off(merged(merged(changes, self.typed), always)))
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

    def _choose(self, effect: str) -> str:
        """Return the option that switches an effect on: the configured one, else ``Effect.on``."""
        choice = HydraConfig.get().runtime.choices.get(f"model/{effect}")
        return choice if choice not in (None, "none") else self.effects[effect].on


def refuse(config: DictConfig, typed: Sequence[str]) -> None:
    """Refuse a run that cannot be planned, before its data are read."""
    if config.get("resume") is not None:
        raise ValueError("resume: expected nothing where a run is planned; leave it out")
    removed = [override for override in typed if override.startswith("~")]
    for override in removed:
        if not override.startswith("~stage."):
            raise ValueError(
                f"{override}: expected overrides that set a key, as a plan keeps them; "
                f"use {override[1:]}=null"
            )
    if removed or len(config.stage) < 2:
        raise ValueError("stage: expected a coarse stage and another, but got one; leave out ~stage.<name>")
    given = {key: value for key, value in config.plan.items() if value is not None or key not in MAY_BE_NULL}
    check_least(2, of="plan", held_out=given.pop("held_out"))
    check_least(
        1, of="plan", **{key: given[key] for key in ("seeds", "steps", "trial_steps") if key in given}
    )
    for key in ("seconds", "trial_seconds", "minutes", "least"):
        check_number(f"plan.{key}", given.get(key, 1.0), "a number > 0", lambda amount: amount > 0)
