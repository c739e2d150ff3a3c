"""The schedules of a stage: its budget of minutes and steps, its learning rates, its curriculum of frames."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from forewarp.methods.method import Model, check_least, check_number
from forewarp.ops.backend import is_number
from forewarp.training.objective import Objective

_ENDS = 0.05  # of all time, at its beginning and at its end


@dataclass(frozen=True)
class StageSettings:
    """The numbers of one stage. Fractions are fractions of the stage.

    Args:
        name: name of the stage and of its folder.
        lr: learning rate of each of the method's ``param_groups``.
        iterations: steps; None if only minutes bound the stage.
        minutes: training minutes; None if only iterations bound it. With both, the stage ends at the first.
        steps_per_picture: the stage ends after so many steps for each training picture; None: no such end.
        lr_hold: keep the learning rates constant up to this fraction, then let them fall exponentially; one
            number, or one by group, where a group left out is not held.
        lr_final_factor: the learning rates end at this multiple of their initial values; one number, or one
            by group, where a group left out stays as it is.
        curriculum: arguments of ``Curriculum``.
        max_gradient: clip the gradients' norm to this; 0 does not clip.
        numbers: all other keys of the stage, which belong to the method.

    Raises:
        ValueError: for a name that is no folder name, a stage without a bound, a rate or its schedule that is
            not a number in range, or a schedule for a group that has no rate.
    """

    name: str
    lr: Mapping[str, float]
    iterations: int | None = None
    minutes: float | None = None
    steps_per_picture: float | None = None
    lr_hold: float | Mapping[str, float] = 0.0
    lr_final_factor: float | Mapping[str, float] = 0.1
    curriculum: Mapping[str, float] = field(default_factory=dict)
    max_gradient: float = 0.0
    numbers: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        where = f"stage.{self.name}"
        if not isinstance(self.name, str) or not re.fullmatch(r"\w[\w-]*", self.name):
            expected = "names of letters, digits, _ and -, as they name folders"
            raise ValueError(f"stage: expected {expected}, but got {self.name!r}")
        if self.iterations is None and self.minutes is None:
            raise ValueError(f"{where}: expected iterations or minutes, but got neither; set budget.minutes")
        for key in ("iterations", "minutes", "steps_per_picture"):
            if (bound := getattr(self, key)) is not None:
                check_number(f"{where}.{key}", bound, "a number > 0, or null", lambda bound: bound > 0)
        if not isinstance(self.lr, Mapping):
            raise ValueError(f"{where}.lr: expected a rate for each group, but got {self.lr!r}")
        for key, *wanted in (
            ("lr", "a number >= 0", lambda rate: rate >= 0),
            ("lr_hold", "a number in [0, 1]", lambda fraction: 0 <= fraction <= 1),
            ("lr_final_factor", "a number > 0", lambda factor: factor > 0),
        ):
            given = getattr(self, key)
            if not isinstance(given, Mapping):
                check_number(f"{where}.{key}", given, *wanted)
                continue
            for group, value in given.items():
                if group not in self.lr:
                    groups = ", ".join(self.lr)
                    raise ValueError(f"{where}.{key}: expected groups of {groups}, but got '{group}'")
                check_number(f"{where}.{key}.{group}", value, *wanted)

    @classmethod
    def of(cls, name: str, **keys: Any) -> StageSettings:
        """Make settings from a stage's keys; keys that are not fields go to ``numbers``.

        Raises:
            ValueError: where the learning rates are missing, or a value is none that its key may have.
        """
        if "lr" not in keys:
            raise ValueError(f"stage.{name}.lr: expected a learning rate of each group, but got no such key")
        fields = {key: keys.pop(key) for key in list(keys) if key in cls.__dataclass_fields__}
        return cls(name, **fields, numbers=keys)

    def over(self, pictures: int) -> StageSettings:
        """Return the settings whose ``iterations`` also keep ``steps_per_picture``."""
        per_picture = None if self.steps_per_picture is None else self.steps_per_picture * pictures
        bounds = [max(1, round(bound)) for bound in (self.iterations, per_picture) if bound is not None]
        return replace(self, iterations=min(bounds, default=None))

    def lr_factor(self, fraction: float, group: str) -> float:
        """Return what the learning rate of a group is multiplied by at ``fraction`` of the stage."""
        hold, last = self.lr_hold, self.lr_final_factor
        hold = hold.get(group, 0.0) if isinstance(hold, Mapping) else hold
        last = last.get(group, 1.0) if isinstance(last, Mapping) else last
        return 1.0 if fraction <= hold else last ** ((min(1.0, fraction) - hold) / (1 - hold))

    def fraction(self, steps: int, seconds: float) -> float:
        """Return the fraction done, in [0, 1]: of the iterations or of the minutes, whichever is larger."""
        by_steps = 0.0 if self.iterations is None else steps / self.iterations
        by_time = 0.0 if self.minutes is None else seconds / (60 * self.minutes)
        return min(1.0, max(by_steps, by_time))


@dataclass(frozen=True)
class Stage:
    """A stage: its numbers, its objective, and the factory of its method (None: the run's ``model``)."""

    settings: StageSettings
    objective: Objective
    model: Model | None = None


class StagePlan:
    """A stage as configured, before it is given its share of the budget.

    Args:
        share: weight of this stage when the run's budget is divided.
        objective: the stage's objective.
        model: makes the stage's method; None: the run's model.
        settings: the other arguments of ``StageSettings``, and the method's own numbers.
    """

    def __init__(
        self, *, share: float, objective: Objective, model: Model | None = None, **settings: Any
    ) -> None:
        self.share, self.objective, self.model, self.settings = share, objective, model, settings


def check_budget(minutes: object, iterations: object) -> None:
    """Raise ValueError for a bound of a run that is neither a number > 0 nor None."""
    for key, bound in (("minutes", minutes), ("iterations", iterations)):
        if bound is not None:
            check_number(f"budget.{key}", bound, "a number > 0 or null", lambda bound: bound > 0)


def share_out(
    plans: Mapping[str, StagePlan], *, minutes: float | None, iterations: int | None
) -> list[Stage]:
    """Divide the run's minutes and iterations among its stages by their shares; keep their order.

    Args:
        plans: by name.
        minutes, iterations: the run's budget; None: unbounded. With both, each stage ends at the first.

    Raises:
        ValueError: without any stage, for a share that is not > 0, or for a bound that is not > 0.
    """
    if not plans:
        raise ValueError("stage: expected at least one stage, but got none; leave one of them on")
    for name, plan in plans.items():
        wanted = f"a number > 0, or ~stage.{name} to drop it"
        check_number(f"stage.{name}.share", plan.share, wanted, lambda share: share > 0)
    check_budget(minutes, iterations)
    whole, stages = sum(plan.share for plan in plans.values()), []
    for name, plan in plans.items():
        bounds = {
            "minutes": None if minutes is None else minutes * plan.share / whole,
            "iterations": None if iterations is None else max(1, round(iterations * plan.share / whole)),
        }
        stages.append(Stage(StageSettings.of(name, **bounds, **plan.settings), plan.objective, plan.model))
    return stages


def seconds_after(stages: Sequence[Stage], name: str) -> float | None:
    """Return how many seconds the stages after ``name`` take at most; None if minutes do not bound them, or
    steps for each picture may end them much earlier.
    """
    names = [stage.settings.name for stage in stages]
    later = [stage.settings for stage in stages[names.index(name) + 1 :]]
    if any(settings.minutes is None or settings.steps_per_picture is not None for settings in later):
        return None
    return 60 * sum(settings.minutes for settings in later)


class Curriculum:
    """Progressive training: sample frames near the canonical time first, then ever more of the others.

    Call it for the index of the next training frame. The number of distinct times in play grows linearly
    with the fraction of the stage that is done, and each time brings all its frames, so a run bounded by
    minutes sees them all too; or, as published, with the steps. A share of the draws goes to the newest
    frames, whose motion is unknown yet.

    Args:
        times: time of every training frame.
        canonical_time: where training starts.
        start: distinct times in play at the beginning.
        all_in: fraction of the stage at which all times are in play; 0: from the start.
        from_zero: times come in as if from none on, of which ``start`` are in play in any case; False: from
            ``start`` on.
        iterations_per_time: one more time comes in after each so many steps, whatever ``all_in``; a stage too
            short for its sequence never sees it whole; null: by ``all_in``.
        most: number of times that ever come into play; null: all.
        newest_share: share of the draws that goes to the newest frames, while frames still come in.
        newest_part: share of the frames in play that counts as the newest.
        error_share: share of the draws that picks a frame with a probability proportional to its latest
            error (see ``report``): the few frames at the ends of a sequence are hard.
        ends_share: share of the draws that goes to the first and the last twentieth of all time, once all
            times are in play: what moves there has frames on one side alone.
        seed: seed of the draws.
        where: key that errors name.
    """

    def __init__(
        self,
        times: list[float],
        canonical_time: float,
        *,
        start: int = 10,
        all_in: float = 0.6,
        from_zero: bool = False,
        iterations_per_time: int | None = None,
        most: int | None = None,
        newest_share: float = 0.3,
        newest_part: float = 0.125,
        error_share: float = 0.0,
        ends_share: float = 0.0,
        seed: int = 0,
        where: str = "stage.curriculum",
    ) -> None:
        shares = {"all_in": all_in, "newest_share": newest_share, "error_share": error_share}
        shares |= {"ends_share": ends_share}
        are_numbers = all(map(is_number, (start, newest_part, *shares.values())))
        are_shares = are_numbers and all(0 <= share <= 1 for share in shares.values())
        if not (are_shares and start >= 1 and 0 < newest_part <= 1):
            expected = "expected start >= 1, newest_part in (0, 1]"
            expected = f"{where}: {expected}, {', '.join(shares)} in [0, 1]"
            got = ", ".join(f"{name}={value}" for name, value in shares.items())
            raise ValueError(f"{expected}, but got {start=}, {newest_part=}, {got}")
        self.canonical_time = canonical_time
        self.order = sorted(range(len(times)), key=lambda i: (abs(times[i] - canonical_time), times[i], i))
        last_of_time = {times[i]: place for place, i in enumerate(self.order)}
        self._ends = [place + 1 for place in last_of_time.values()]  # frames in play, by number of times
        for key, bound in (("most", most), ("iterations_per_time", iterations_per_time)):
            if bound is not None:
                check_least(1, of=where, **{key: bound})
        self._ends = self._ends[:most]
        self.start, self.all_in, self.from_zero = min(start, len(self._ends)), all_in, from_zero
        self.iterations_per_time = iterations_per_time
        self.newest_share, self.newest_part = newest_share, newest_part
        self.error_share, self.ends_share = error_share, ends_share
        first, last = min(times), max(times)
        near = _ENDS * (last - first)
        self.at_ends = [i for i, time in enumerate(times) if time <= first + near or time >= last - near]
        self.errors = torch.full((len(times),), float("nan"))
        self.fraction, self.step = 0.0, 0  # of the stage, set before each step
        self.generator = torch.Generator().manual_seed(seed)

    @property
    def in_play(self) -> int:
        """Number of frames that may be drawn now."""
        count, first = len(self._ends), 0 if self.from_zero else self.start
        done = 1.0 if self.all_in == 0 else min(1.0, self.fraction / self.all_in)
        if self.iterations_per_time is not None:
            grown = first + self.step // self.iterations_per_time
        else:
            grown = first + int((count - first) * done + (1e-9 if self.from_zero else 0.0))
        return self._ends[min(max(self.start, grown), count) - 1]

    def frames(self) -> list[int]:
        """Return the frames in play, nearest to the canonical time first."""
        return self.order[: self.in_play]

    def __call__(self) -> int:
        """Draw the next training frame."""
        playing = self.in_play
        if self._falls_to(self.error_share):
            errors = self.errors[self.order[:playing]]
            seen = errors[~errors.isnan()]
            # A frame not yet seen counts as the worst one.
            weights = torch.nan_to_num(errors, nan=float(seen.max()) if len(seen) else 1.0) + 1e-8
            return self.order[int(torch.multinomial(weights, 1, generator=self.generator))]
        growing = playing < len(self.order)
        if not growing and self._falls_to(self.ends_share):
            return self.at_ends[int(torch.randint(len(self.at_ends), (), generator=self.generator))]
        newest = max(1, int(playing * self.newest_part))
        favour = growing and float(torch.rand((), generator=self.generator)) < self.newest_share
        low = playing - newest if favour else 0
        return self.order[int(torch.randint(low, playing, (), generator=self.generator))]

    def _falls_to(self, share: float) -> bool:
        """Whether this draw is of a share; a share of 0 draws nothing."""
        return share > 0 and float(torch.rand((), generator=self.generator)) < share

    def report(self, frame: int, error: float) -> None:
        """Record the squared error of a frame after a step on it; ignore errors that are not finite."""
        if not math.isfinite(error):
            return
        before = float(self.errors[frame])
        self.errors[frame] = error if math.isnan(before) else 0.5 * (before + error)

    def state_dict(self) -> dict:
        """Return the generator's state, how far the stage is and the frames' errors."""
        done = {"fraction": self.fraction, "step": self.step, "errors": self.errors.clone()}
        return {"generator": self.generator.get_state(), **done}

    def load_state_dict(self, state: dict) -> None:
        """Continue from a ``state_dict``."""
        self.generator.set_state(state["generator"])
        self.fraction, self.step = state["fraction"], state.get("step", 0)
        self.errors = state["errors"].clone()
