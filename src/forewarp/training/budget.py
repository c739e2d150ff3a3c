"""What a run may spend, shared out among its stages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from forewarp.training.objective import Objective
from forewarp.training.settings import StageSettings
from forewarp.training.stages import Model, Stage


class StagePlan:
    """A stage that waits for its part of the budget.

    Args:
        share: of the run's budget, against the other stages' shares.
        objective: of the stage.
        model: makes its method; None: the run's model.
        settings: the other arguments of ``StageSettings``, and the method's own numbers.
    """

    def __init__(
        self, *, share: float, objective: Objective, model: Model | None = None, **settings: Any
    ) -> None:
        self.share, self.objective, self.model, self.settings = share, objective, model, settings

    def stage(self, name: str, minutes: float | None, iterations: int | None) -> Stage:
        """The stage, bounded."""
        settings = StageSettings.of(name, minutes=minutes, iterations=iterations, **self.settings)
        return Stage(settings, self.objective, self.model)


def share_out(
    plans: Mapping[str, StagePlan | None], *, minutes: float | None, iterations: int | None
) -> list[Stage]:
    """The stages in order, each with its share of the minutes and iterations of the whole run.

    Args:
        plans: by name; a None is left out.
        minutes, iterations: of the run; None where the other one bounds it. With both, what comes first.
    """
    kept = {name: plan for name, plan in plans.items() if plan is not None}
    if not kept:
        raise ValueError("stage: expected at least one stage, but got none; leave one of them on")
    for name, plan in kept.items():
        if not (isinstance(plan.share, int | float) and plan.share > 0):
            raise ValueError(
                f"stage.{name}.share: expected a number > 0, but got {plan.share}; drop it with ~stage.{name}"
            )
    for key, value in (("minutes", minutes), ("iterations", iterations)):
        if value is not None and not (isinstance(value, int | float) and value > 0):
            raise ValueError(f"budget.{key}: expected a number > 0 or null, but got {value}")
    whole = sum(plan.share for plan in kept.values())
    return [
        plan.stage(
            name,
            None if minutes is None else minutes * plan.share / whole,
            None if iterations is None else max(1, round(iterations * plan.share / whole)),
        )
        for name, plan in kept.items()
    ]


def seconds_after(stages: Sequence[Stage], name: str) -> float | None:
    """What the stages after ``name`` may take at most; None where minutes do not bound each of them."""
    names = [stage.settings.name for stage in stages]
    minutes = [stage.settings.minutes for stage in stages[names.index(name) + 1 :]]
    return None if None in minutes else 60 * sum(minutes)
