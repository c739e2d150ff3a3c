"""The weighted sum of a method's terms. The only place where a weight is compared with 0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from forewarp.methods.method import Step


class Objective:
    """``loss = sum_i w_i term_i``; a term of weight 0 is never called.

    Args:
        weights: term -> weight; terms not named have weight 0. Which there are is the method's to say.
        every: term -> n: evaluated each n-th step with n times the weight.
        literal: terms in the printed form where a method has another by default.
        photo_on: renderings that the per-ray terms look at, where a method has several; null: all.
    """

    def __init__(
        self,
        weights: Mapping[str, float],
        *,
        every: Mapping[str, int] | None = None,
        literal: Sequence[str] = (),
        photo_on: Sequence[str] | None = None,
    ) -> None:
        self.every = dict(every or {})
        if any(not (n >= 1 and n == int(n)) for n in self.every.values()):
            raise ValueError(f"objective.every: expected whole numbers of steps >= 1, but got {self.every}")
        self.weights = {name: float(w) for name, w in weights.items()}
        self.literal, self.photo_on = tuple(literal), photo_on

    @property
    def names(self) -> tuple[str, ...]:
        """Every term that is spoken of."""
        return (*self.weights, *self.every)

    def factors(self, number: int) -> dict[str, float]:
        """The terms that count in step ``number``, with what each is multiplied by."""
        found = {}
        for name, weight in self.weights.items():
            every = self.every.get(name, 1)
            if weight != 0 and number % every == 0:
                found[name] = weight * every
        return found


def parts(step: Step, factors: Mapping[str, float]) -> dict[str, tuple[Tensor, float]]:
    """Every term of a step that is evaluated, with its factor, by name."""
    found = {}
    for name, factor in factors.items():
        if name not in step.terms:
            raise ValueError(
                f"model: expected look to give the term '{name}', as the method's terms say, but got "
                f"{', '.join(step.terms) or 'none'}"
            )
        value = step.terms[name]()
        if value is not None:  # else the effect that it measures is off
            found[name] = value, factor
    return found


def total(step: Step, factors: Mapping[str, float], parameters: Mapping[str, Tensor]) -> tuple[Tensor, dict]:
    """The loss of a step and every term evaluated, raw, by name.

    Args:
        step: what the method made of its batch.
        factors: of its terms.
        parameters: by name, for gradients that the method computed itself.
    """
    loss, raw = torch.zeros(()), {}
    for name, (value, factor) in parts(step, factors).items():
        raw[name] = value.detach()
        loss = loss.to(value) + factor * value
    if step.gradients is not None:
        if not step.gradients or not step.gradients.keys() <= parameters.keys():
            raise ValueError(
                f"model: expected gradients of some of {', '.join(parameters)}, but got "
                f"{', '.join(step.gradients) or 'none'}"
            )
        names, gradients = zip(*step.gradients.items())
        loss = _Given.apply(loss.detach(), gradients, *(parameters[name] for name in names))
    return loss, raw


class _Given(torch.autograd.Function):
    """A loss whose gradients are known already."""

    @staticmethod
    def forward(ctx, loss: Tensor, gradients: tuple[Tensor, ...], *parameters: Tensor) -> Tensor:
        ctx.gradients = gradients
        return loss.clone()

    @staticmethod
    def backward(ctx, slope: Tensor) -> tuple:
        if slope.device.type == "cpu" and float(slope) == 1:  # nobody scales it: no copies
            return None, None, *ctx.gradients
        return None, None, *(slope * gradient for gradient in ctx.gradients)
