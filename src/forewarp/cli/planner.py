"""One scene's evidence as it is gathered: coarse stages, what they leave, trials, decisions."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from functools import partial

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from forewarp.cli import decisions
from forewarp.cli.decisions import CUT_OUT, Decision, Evidence
from forewarp.cli.trials import Trial, Trials, gain
from forewarp.cli.words import key_of, merged
from forewarp.methods.voxel.evidence import movement, survey
from forewarp.methods.voxel.residual import residual
from forewarp.scene.box import Lattice
from forewarp.scene.frame import Scene, spread
from forewarp.training.handover import load_handover

# What each effect is switched on by where the configuration has it off.
ON = {"motion": "dct", "background": "grid", "view": "sh", "inpainter": "unet3d", "upsampler": "learned"}
VIEWS = 24  # training views whose residual is looked at
# Not asked while motion is learned: colour that depends on direction would explain it away.
PLAIN = ("model/view=none", "model/inpainter=none", "model/upsampler=none")


class Planner:
    """Asks what a scene calls for.

    Args:
        config: of the run that is planned.
        words: as typed, for it; what they fix is not asked.
        trials: runs what is tried.
        scene: as the run would read it.
    """

    def __init__(self, config: DictConfig, words: list[str], trials: Trials, scene: Scene) -> None:
        self.config, self.words, self.trials, self.settings = config, words, trials, config.plan
        self.fixed = {key_of(word): word.partition("=")[2] for word in words}
        stages = [name for name, stage in config.stage.items() if stage is not None]
        self.coarse, self.last = stages[0], stages[-1]
        # The run's share that the last stage has: what a dear effect of it takes its steps from.
        shares = [config.stage[name].share for name in stages]
        minutes = self.settings.minutes and self.settings.minutes * shares[-1] / sum(shares)
        self.evidence = Evidence(survey(scene), least=self.settings.least, minutes=minutes)
        self.usual = int(config.budget.bases)
        self.more = min(2 * self.usual, max(self.evidence.pictures.times - 1, 1))
        # How a scene without silhouettes begins: faint matter everywhere.
        faint = [f"stage.{self.coarse}.start_alpha=1e-2", f"stage.{self.coarse}.confine=0.0"]
        self.start = faint if self.evidence.pictures.cut_out < CUT_OUT else []

    def plan(self) -> dict:
        """What the run is to be, and why."""
        self._fit_coarse()
        self._look()
        if self.settings.trials:
            self._try_fine()
        every = self._decide()
        return {
            "typed": list(self.words),
            "words": list(dict.fromkeys(word for decision in every for word in decision.words)),
            "effects": {d.effect: {"choice": d.choice, "on": d.on, "because": d.because} for d in every},
            "evidence": self._numbers(),
        }

    def _fit_coarse(self) -> None:
        """Coarse stages: in how many cosines does something move, does it, what stands still behind it?"""
        pictures = self.evidence.pictures
        if pictures.times < 2 or self.fixed.get("model/motion") == "none":
            self._use("coarse-still", ["model/motion=none", "model/background=none", *PLAIN, *self.start])
            return
        behind = "model/background=" + (self._on("background") if self.start else "none")
        self._use("coarse", [f"model/motion={self._on('motion')}", behind, *PLAIN, *self.start])
        if not self.settings.trials:
            return
        if self.more > self.usual and not self.fixed.keys() & {"budget.bases", "model/motion"}:
            self._rival("bases", "coarse-bases", self._more_bases(), it_is_more=True)
        still = ["model/motion=none"]
        moves = "model/motion" in self.fixed or self._rival("motion", "coarse-still", still)
        if self.start and not moves:  # one field holds all that stands still
            self._use("coarse-still-alone", merged(self.base, ["model/background=none"]))
        elif self.start and "model/background" not in self.fixed:
            self._rival("background", "coarse-alone", ["model/background=none"])

    def _more_bases(self) -> list[str]:
        return [f"budget.bases={self.more}", f"stage.{self.coarse}.bases=[[0,{self.more}]]"]

    def _use(self, name: str, words: list[str]) -> None:
        """What the evidence is taken from and the trials begin from."""
        self.name, self.base = name, words
        self.reached, self.run, self.module = self.trials.coarse(name, words)

    def _rival(self, effect: str, name: str, change: list[str], *, it_is_more: bool = False) -> bool:
        """Fit another coarse stage, with an effect or without; go on with the better; whether it has it."""
        words = merged(self.base, change)
        rival = self.trials.coarse(name, words)
        on, off = (rival[0], self.reached) if it_is_more else (self.reached, rival[0])
        self.evidence.gains[effect] = gain([on], [off], equal_steps=False)
        pays = self.evidence.pays(effect)
        if pays == it_is_more:
            self.name, self.base, (self.reached, self.run, self.module) = name, words, rival
        return pays

    def _look(self) -> None:
        """What the coarse stage says."""
        datamodule, moves = self.run.datamodule, self.module.method.motion is not None
        self.evidence.movement = movement(self.module.method, datamodule.scene.times) if moves else None
        box = load_handover(self.run.stage_folder(self.run.stages[0])).box
        count = max(count for _, count in self.config.stage[self.last].voxels)
        views = datamodule.targets("train")
        some = [views[i] for i in spread(len(views), VIEWS)]
        self.evidence.residual = residual(self.module.method, some, Lattice.of_count(box, count).pitch)

    def _try_fine(self) -> None:
        """From the coarse stage on: what is still open, with it and without, at equal steps."""
        evidence, tried = self.evidence, partial(self._tried, "fine", self.base, 0)
        asked = [e for e in decisions.open_questions(evidence) if f"model/{e}" not in self.fixed]
        if asked and evidence.minutes is not None:
            plain = tried()
            half = self._tried("fine-half", self.base, 0, max(1, plain.steps // 2))
            evidence.slope, evidence.steps = gain([plain], [half]).psnr, plain.steps
            evidence.step = plain.step
        for effect in asked:
            self._try(effect, merged(self.base, [f"model/{effect}={self._on(effect)}"]))

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

    def _on(self, effect: str) -> str:
        """What an effect is switched on by: the configuration's own choice, or else a usual one."""
        own = HydraConfig.get().runtime.choices.get(f"model/{effect}")
        return own if own not in (None, "none") else ON[effect]

    def _decide(self) -> list[Decision]:
        """All decisions, overruled where something was typed, with what makes the run as it was tried."""
        evidence = self.evidence
        motion = self._overruled(decisions.of_motion(evidence, self._on("motion")))
        moves, found = motion.on and evidence.movement is not None, [motion]
        if moves:
            bases = decisions.of_bases(evidence, self.usual, self.more)
            found.append(replace(bases, words=tuple(self._more_bases()) if bases.on else ()))
        found += [
            decisions.of_background(evidence, moves, self._on("background"), self.start),
            decisions.of_view(evidence, self._on("view")),
            decisions.of_inpainter(evidence, self._on("inpainter")),
            decisions.of_upsampler(evidence, self._on("upsampler")),
        ]
        found = [motion, *(self._overruled(decision) for decision in found[1:])]
        return [replace(d, words=d.words + self._as_tried(d.effect)) if d.on else d for d in found]

    def _as_tried(self, effect: str) -> tuple[str, ...]:
        """Later effects not while motion is learned; what is dear on the lattice that it was tried on."""
        later = effect in decisions.LATER
        words = [f"stage.{self.coarse}.effects=[motion,background]"] if later else []
        if effect in decisions.DEAR:
            words.append(f"stage.{self.last}.voxels=[[0,{self.config.stage[self.last].voxels[0][1]}]]")
        return tuple(words)

    def _overruled(self, decision: Decision) -> Decision:
        """The decision, or what was typed in its place."""
        key = "budget.bases" if decision.effect == "bases" else f"model/{decision.effect}"
        if key not in self.fixed:
            return decision
        choice = self.fixed[key]
        words = () if key == "budget.bases" else tuple(w for w in decision.words if key_of(w) != key)
        on = choice != "none" and decision.effect != "bases"
        return Decision(decision.effect, choice, words, f"as typed; {decision.because}", on)

    def _numbers(self) -> dict:
        evidence = self.evidence
        known = {name: getattr(evidence, name) for name in ("pictures", "movement", "residual")}
        found = {name: asdict(value) for name, value in known.items() if value is not None}
        found["trials"] = {effect: asdict(one) for effect, one in evidence.gains.items()}
        return json.loads(json.dumps(found))  # lists for tuples, as YAML has them
