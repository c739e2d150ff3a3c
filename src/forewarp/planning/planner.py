"""Gather the evidence for a plan: fit coarse stages, run trials, and let the method decide."""

from __future__ import annotations

import json
from dataclasses import asdict, fields, is_dataclass, replace
from statistics import fmean

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from forewarp.methods.effect import Asked, Begin, Decision, Drop, Effect, Planning, Rival
from forewarp.planning.trials import Trial, Trials, gain
from forewarp.runs.overrides import key_of, merged
from forewarp.scene.frame import Scene
from forewarp.scene.silhouettes import survey
from forewarp.training.schedule import most_steps


class Planner:
    """Plan one run; the method says which effects there are and what counts for each.

    Args:
        config: the config of the run to plan.
        typed: the run's overrides; the plan decides nothing that they fix.
        trials: fits the short runs.
        scene: the scene as the run would read it.
        planning: the method's ``Planning``.
    """

    def __init__(
        self, config: DictConfig, typed: list[str], trials: Trials, scene: Scene, planning: Planning
    ) -> None:
        self.typed, self.trials, self.settings, self.planning = typed, trials, config.plan, planning
        self.effects: dict[str, Effect] = {effect.name: effect for effect in planning.effects}
        values = {key_of(override): override.partition("=")[2] for override in typed}
        stages = {name: stage for name, stage in config.stage.items() if stage is not None}
        self.asked = Asked(stages, config.preset, values, self._choose, bool(config.plan.trials))
        trials.always, trials.always_fine = planning.always(self.asked)
        # An effect of the last stage costs time of the last stage only.
        shares = [stage.share for stage in stages.values()]
        minutes = self.settings.minutes and self.settings.minutes * shares[-1] / sum(shares)
        least = self.settings.least or planning.least
        steps = config.budget.iterations and config.budget.iterations * shares[-1] / sum(shares)
        most = most_steps(steps, list(stages.values())[-1].get("steps_per_picture"), len(scene.train))
        self.evidence = planning.evidence(survey(scene), least=least, minutes=minutes, most_steps=most)

    def plan(self) -> dict:
        """Return the plan, without seconds: overrides, effects with reasons, evidence."""
        self._fit_coarse()
        views = self.run.datamodule.targets("train")
        self.planning.look(self.evidence, self.module.method, self.run.datamodule.scene, views, self.asked)
        if self.settings.trials:
            self._try_fine()
        every = [self._as_tried(decision) for decision in self.planning.decide(self.evidence, self.asked)]
        model = f"model={HydraConfig.get().runtime.choices['model']}"  # its effects; defaults may change
        return {
            "typed": list(self.typed),
            "overrides": [model, *dict.fromkeys(one for decision in every for one in decision.overrides)],
            "effects": {d.effect: {"choice": d.choice, "on": d.on, "because": d.because} for d in every},
            "evidence": self._numbers(),
        }

    def _fit_coarse(self) -> None:
        """Fit the coarse stages that the method asks for; tell the method of each rival whether it pays."""
        stages, answer = self.planning.coarse(self.evidence, self.asked), None
        while True:
            try:
                wanted = stages.send(answer)
            except StopIteration:
                return
            if isinstance(wanted, Begin):
                overrides = list(wanted.overrides)
                answer = self._use(wanted.name, merged(self.base, overrides) if wanted.change else overrides)
            elif isinstance(wanted, Drop):
                answer = self._drop(wanted)
            else:
                answer = self._rival(wanted)

    def _use(self, name: str, overrides: list[str]) -> None:
        """Fit the coarse stage that evidence is taken from and fine trials begin from."""
        self.name, self.base, self.name_of_trial = name, overrides, "fine"
        self.reached, self.run, self.module = self.trials.coarse(name, overrides)

    def _rival(self, wanted: Rival) -> bool:
        """Fit another coarse stage, go on with the better, and return whether the effect pays."""
        overrides = merged(self.base, wanted.overrides)
        rival = self.trials.coarse(wanted.name, overrides)
        on, off = (rival[0], self.reached) if wanted.adds else (self.reached, rival[0])
        self.evidence.gains[wanted.effect] = gain([on], [off], equal_steps=False)
        pays = self.evidence.pays(wanted.effect)
        if pays == wanted.adds:
            self.name, self.base, (self.reached, self.run, self.module) = wanted.name, overrides, rival
        return pays

    def _try_fine(self) -> None:
        """Try each undecided effect in the fine stage: with and without the effect, at equal steps."""
        evidence = self.evidence
        asked = [
            effect
            for effect in self.effects.values()
            if effect.later and effect.group not in self.asked.typed and not effect.rules_out(evidence)
        ]
        if asked:
            self._price_of_steps()
        for effect in asked:
            choice = f"{effect.group}={self._choose(effect.name)}"
            self._try(effect.name, (f"fine-{effect.name}", merged(self.base, [choice])), ("fine", self.base))

    def _drop(self, wanted: Drop) -> bool:
        """Try to do without an effect; go on without it unless it is missed."""
        self._price_of_steps()
        with_it = self.name_of_trial, self.base
        without = f"{self.name_of_trial}-no-{wanted.effect}", merged(self.base, wanted.overrides)
        self._try(wanted.effect, with_it, without, wanted.longer)
        pays = self.evidence.pays(wanted.effect)
        if not pays:
            self.name_of_trial, self.base = without
        return pays

    def _price_of_steps(self) -> None:
        """Measure once what steps are worth, if the planned run has given minutes."""
        evidence = self.evidence
        if evidence.minutes is None or evidence.step is not None:
            return
        plain = self._tried("fine", self.base, 0)
        half = self._tried("fine-half", self.base, 0, max(1, plain.steps // 2))
        evidence.slope, evidence.steps, evidence.step = gain([plain], [half]).psnr, plain.steps, plain.step

    def _try(
        self,
        effect: str,
        with_it: tuple[str, list[str]],
        without: tuple[str, list[str]],
        longer: int = 1,
    ) -> None:
        """Compare two trials, each a name and overrides, seed by seed; stop once the gain is clearly too
        small. ``longer``: how many times the usual steps and seconds both have.
        """
        if longer != 1:
            many = longer * self.trials.fine_steps
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

    def _tried(
        self, name: str, overrides: list[str], seed: int, steps: int | None = None, longer: int = 1
    ) -> Trial:
        return self.trials.fine(name, overrides, self.name, seed, steps, longer)

    def _choose(self, effect: str) -> str:
        """Return the option that switches an effect on: the configured one, else ``Effect.on``."""
        own = HydraConfig.get().runtime.choices.get(f"model/{effect}")
        return own if own not in (None, self.effects[effect].off) else self.effects[effect].on

    def _as_tried(self, decision: Decision) -> Decision:
        """Return the decision with the overrides of its trial added; unchanged if the effect stays off."""
        effect = self.effects.get(decision.effect)
        if effect is None or not decision.on:
            return decision
        return replace(decision, overrides=(*decision.overrides, *effect.with_it(self.asked)))

    def _numbers(self) -> dict:
        values = {f.name: getattr(self.evidence, f.name) for f in fields(self.evidence)}
        found = {name: asdict(value) for name, value in values.items() if is_dataclass(value)}
        found["trials"] = {effect: asdict(one) for effect, one in self.evidence.gains.items()}
        found["at_rest"] = dict(self.evidence.at_rest)
        return json.loads(json.dumps(found))  # lists for tuples, as YAML has them
