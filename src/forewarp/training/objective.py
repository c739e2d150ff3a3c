"""The objective: the weighted sum of a method's loss terms. No other module checks weights for 0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from forewarp.methods.method import Method, Step


class Objective:
    """``loss = sum_i w_i term_i``; a term of weight 0 is never called.

    Args:
        weights: weight by term, of the method's ``terms``; terms not named have weight 0.
        every: ``{term: n}`` evaluates a term at each n-th step only, with n times its weight.
        literal: terms to compute in the form printed in the paper, where the default differs.
        photo_on: renderings that the per-ray terms compare, for a method with several; None: all.

    Raises:
        ValueError: for an ``every`` that is not a whole number >= 1.
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
        """All terms named in ``weights`` or ``every``."""
        return (*self.weights, *self.every)

    def factors(self, number: int) -> dict[str, float]:
        """Return the factor of each term that counts in step ``number``."""
        every = {name: self.every.get(name, 1) for name, weight in self.weights.items() if weight != 0}
        return {name: self.weights[name] * n for name, n in every.items() if number % n == 0}


def parts(step: Step, factors: Mapping[str, float]) -> dict[str, tuple[Tensor, float]]:
    """Evaluate the terms of a step; return value and factor by name, without terms whose effect is off."""
    if missing := [name for name in factors if name not in step.terms]:
        expected = f"model: expected look to give the term '{missing[0]}', as the method's terms say"
        raise ValueError(f"{expected}, but got {', '.join(step.terms) or 'none'}")
    values = {name: (step.terms[name](), factor) for name, factor in factors.items()}
    return {name: found for name, found in values.items() if found[0] is not None}  # None: an effect is off


def total(step: Step, factors: Mapping[str, float]) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the loss of a step, and its unweighted terms by name.

    Args:
        step: the method's answer to a batch.
        factors: factors of the step's terms (see ``Objective.factors``).

    Raises:
        ValueError: for a term that the step should have given.
    """
    loss, raw = torch.zeros(()), {}
    for name, (value, factor) in parts(step, factors).items():
        raw[name] = value.detach()
        loss = loss.to(value) + factor * value
    return loss, raw


def set_gradients(method: Method, gradients: Mapping[str, Tensor]) -> None:
    """Make gradients that a method computed itself those of its parameters; they are not copied.

    Raises:
        ValueError: for none, one of no parameter, or one of another shape, dtype or device.
    """
    parameters = dict(method.named_parameters())
    if not gradients or not gradients.keys() <= parameters.keys():
        got = ", ".join(gradients) or "none"
        raise ValueError(f"model: expected gradients of some of {', '.join(parameters)}, but got {got}")
    for name, value in gradients.items():
        parameter = parameters[name]
        wanted, got = ((tuple(t.shape), t.dtype, t.device) for t in (parameter, value))
        if got != wanted:
            wanted, got = ("{} {} on {}".format(*about) for about in (wanted, got))
            raise ValueError(f"model: expected a gradient of {name} as it is, {wanted}, but got {got}")
        if parameter.requires_grad:
            parameter.grad = value
