"""One scene's evidence as it is gathered: coarse stages, what they leave, trials, decisions."""

from __future__ import annotations

import json
from dataclasses import asdict, fields, is_dataclass, replace
from functools import partial

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from forewarp.methods.effect import Asked, Begin, Decision, Effect, Planning, Rival
from forewarp.planning.trials import Trial, Trials, gain
from forewarp.runs.overrides import key_of, merged
from forewarp.scene.frame import Scene
from forewarp.scene.pictures import survey


class Planner:
    """Asks what a scene calls for; which effects there are, and what speaks for them, the method says.

    Args:
        config: of the run that is planned.
        words: as typed, for it; what they fix is not asked.
        trials: runs what is tried.
        scene: as the run would read it.
        planning: the method's.
    """

    def __init__(
        self, config: DictConfig, words: list[str], trials: Trials, scene: Scene, planning: Planning
    ) -> None:
        self.words, self.trials, self.settings, self.planning = words, trials, config.plan, planning
        self.effects: dict[str, Effect] = {effect.name: effect for effect in planning.effects}
        typed = {key_of(word): word.partition("=")[2] for word in words}
        stages = {name: stage for name, stage in config.stage.items() if stage is not None}
        self.asked = Asked(
            stages,
            config.preset,
            typed,
            self._choose,
            bool(config.plan.trials),
        )
        trials.always, trials.always_fine = planning.always(self.asked)
        # The run's share that the last stage has: what a dear effect of it takes its steps from.
        shares = [stage.share for stage in stages.values()]
        minutes = self.settings.minutes and self.settings.minutes * shares[-1] / sum(shares)
        self.evidence = planning.evidence(survey(scene), least=self.settings.least, minutes=minutes)

    def plan(self) -> dict:
        """What the run is to be, and why."""
        self._fit_coarse()
        views = self.run.datamodule.targets("train")
        self.planning.look(self.evidence, self.module.method, self.run.datamodule.scene, views, self.asked)
        if self.settings.trials:
            self._try_fine()
        every = [self._as_tried(decision) for decision in self.planning.decide(self.evidence, self.asked)]
        return {
            "typed": list(self.words),
            "words": list(dict.fromkeys(word for decision in every for word in decision.words)),
            "effects": {d.effect: {"choice": d.choice, "on": d.on, "because": d.because} for d in every},
            "evidence": self._numbers(),
        }

    def _fit_coarse(self) -> None:
        """Fit the coarse stages that the method names, and tell it of each rival whether it pays."""
        stages, answer = self.planning.coarse(self.evidence, self.asked), None
        while True:
            try:
                wanted = stages.send(answer)
            except StopIteration:
                return
            if isinstance(wanted, Begin):
                words = merged(self.base, wanted.words) if wanted.change else list(wanted.words)
                answer = self._use(wanted.name, words)
            else:
                answer = self._rival(wanted)

    def _use(self, name: str, words: list[str]) -> None:
        """What the evidence is taken from and the trials begin from."""
        self.name, self.base = name, words
        self.reached, self.run, self.module = self.trials.coarse(name, words)

    def _rival(self, wanted: Rival) -> bool:
        """Fit another coarse stage, go on with the better; whether the effect pays."""
        words = merged(self.base, wanted.words)
        rival = self.trials.coarse(wanted.name, words)
        on, off = (rival[0], self.reached) if wanted.adds else (self.reached, rival[0])
        self.evidence.gains[wanted.effect] = gain([on], [off], equal_steps=False)
        pays = self.evidence.pays(wanted.effect)
        if pays == wanted.adds:
            self.name, self.base, (self.reached, self.run, self.module) = wanted.name, words, rival
        return pays

    def _try_fine(self) -> None:
        """From the coarse stage on: what is still open, with it and without, at equal steps."""
        evidence, tried = self.evidence, partial(self._tried, "fine", self.base, 0)
        asked = [
            effect
            for effect in self.effects.values()
            if effect.later and effect.group not in self.asked.typed and not effect.rules_out(evidence)
        ]
        if asked and evidence.minutes is not None:
            plain = tried()
            half = self._tried("fine-half", self.base, 0, max(1, plain.steps // 2))
            evidence.slope, evidence.steps = gain([plain], [half]).psnr, plain.steps
            evidence.step = plain.step
        for effect in asked:
            choice = f"{effect.group}={self._choose(effect.name)}"
            self._try(effect.name, merged(self.base, [choice]))

    def _try(self, effect: str, words: list[str]) -> None:
        """An effect, seed by seed, as long as it is not plain that it brings nothing."""
        on, off = [], []
        for seed in range(self.settings.seeds):
            on.append(self._tried(f"fine-{effect}", words, seed, on[0].steps if on else None))
            off.append(self._tried("fine", self.base, seed))
            if off[-1].steps != on[-1].steps:  # it had no time for more
                off[-1] = self._tried(f"fine-{on[-1].steps}", self.base, seed, on[-1].steps)
            found = self.evidence.gains[effect] = gain(on, off)
            if found.psnr + found.noise < self.settings.least:
                return

    def _tried(self, name: str, words: list[str], seed: int, steps: int | None = None) -> Trial:
        return self.trials.fine(name, words, self.name, seed, steps)

    def _choose(self, effect: str) -> str:
        """What an effect is switched on by: the configuration's own choice, or else a usual one."""
        own = HydraConfig.get().runtime.choices.get(f"model/{effect}")
        return own if own not in (None, self.effects[effect].off) else self.effects[effect].on

    def _as_tried(self, decision: Decision) -> Decision:
        """The decision with what makes the run as it was tried."""
        effect = self.effects.get(decision.effect)
        if effect is None or not decision.on:
            return decision
        return replace(decision, words=(*decision.words, *effect.with_it(self.asked)))

    def _numbers(self) -> dict:
        values = {f.name: getattr(self.evidence, f.name) for f in fields(self.evidence)}
        found = {name: asdict(value) for name, value in values.items() if is_dataclass(value)}
        found["trials"] = {effect: asdict(one) for effect, one in self.evidence.gains.items()}
        return json.loads(json.dumps(found))  # lists for tuples, as YAML has them
