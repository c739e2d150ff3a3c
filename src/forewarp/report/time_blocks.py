"""Guard findings about one run against chance: its views are no independent samples, as neighbours err alike.

Views are averaged over tenths of the scene's time. Means of tenths are taken to be correlated as those of
errors that vary smoothly over a tenth of the time, so that ten of them count as about five samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean

import numpy as np
from scipy.special import stdtrit

from forewarp.report.results import ENDS

TENTHS = 10
_CHANCE = 0.05  # of a false finding in a run, shared by all questions
_APART = 1000  # tenths, between what is independent
_SAME = 1e-9  # below which a difference is none


def tenth_of(time: float) -> int:
    """Return the tenth of the time, from 0, of a view; the ends are as ``results.ENDS`` has them.

    >>> [tenth_of(time) for time in (0.0, 0.1, 0.15, 0.3, 0.9, 1.0)]
    [0, 0, 1, 3, 9, 9]
    """
    return 0 if time <= ENDS else min(max(int(TENTHS * time + _SAME), 1), TENTHS - 1)


def mean_over_chance(values: Sequence[float], times: Sequence[float], questions: int) -> float:
    """Divide the mean of a value of each view by what chance reaches; above 1 it is surely above 0.

    >>> times = [0.05, 0.15, 0.25, 0.35]
    >>> [mean_over_chance(values, times, 1) > 1 for values in ([2.0, 2.1, 2.0, 2.1], [2.0, -1.0, 2.0, 1.0])]
    [True, False]
    """
    places = _places(times)
    names = sorted(set(places))
    means = [fmean(v for v, place in zip(values, places) if place == name) for name in names]
    return _over_chance(means, names, None, questions)


def drop_over_chance(
    values: Sequence[float], times: Sequence[float], chosen: Sequence[bool], questions: int
) -> float:
    """Divide by how much the ``chosen`` views lie below the others by what chance reaches.

    Where at least half of the tenths have views of both kinds, these are compared within each tenth: what is
    smooth cancels, so that the differences count as independent. Else tenths are compared, each by the kind
    that most of its views are of.
    """
    places, inside, rest = _places(times), {}, {}
    for value, place, is_in in zip(values, places, chosen):
        (inside if is_in else rest).setdefault(place, []).append(value)
    names = sorted({*inside, *rest})
    both = [name for name in names if name in inside and name in rest]
    if len(both) >= len(names) / 2:
        drops = [fmean(rest[name]) - fmean(inside[name]) for name in both]
        return _over_chance(drops, [_APART * name for name in both], None, questions)
    is_in = [len(inside.get(name, ())) > len(rest.get(name, ())) for name in names]
    means = [fmean((inside if side else rest)[name]) for name, side in zip(names, is_in)]
    return _over_chance(means, names, is_in, questions)


def worst_stretch(
    values: Sequence[float], times: Sequence[float], questions: int, fewest: int
) -> list[int] | None:
    """Return the consecutive tenths, or both ends, whose views most surely lie below the others.

    Args:
        values: of each view, larger is better.
        times: of each view, in [0, 1].
        questions: that share the chance of a false finding; stretches overlap, so that all of them count as
            ``TENTHS`` questions.
        fewest: views inside and outside of a stretch.

    Returns:
        tenths, at most half of all; None if it may be chance.
    """
    places = [tenth_of(time) for time in times]
    names = sorted(set(places))
    means = [fmean(v for v, place in zip(values, places) if place == name) for name in names]
    stretches = [
        [*range(first, first + n)] for n in range(1, TENTHS // 2 + 1) for first in range(TENTHS - n + 1)
    ]
    best, surest = None, 1.0
    for stretch in ([0, TENTHS - 1], *stretches):
        count = sum(place in stretch for place in places)
        if min(count, len(places) - count) < fewest:
            continue
        ratio = _over_chance(means, names, [name in stretch for name in names], questions)
        if ratio > surest:
            best, surest = stretch, ratio
    return best


def _places(times: Sequence[float]) -> list[int]:
    """Return each view's tenth; of a scene without time a place of its own, far from all others."""
    if len(set(times)) < 2:
        return [_APART * i for i in range(len(times))]
    return [tenth_of(time) for time in times]


def _over_chance(
    means: Sequence[float], places: Sequence[int], inside: Sequence[bool] | None, questions: int
) -> float:
    """Divide the mean, or the drop of those ``inside``, by the quantile of Student's t of its error.

    Least squares with correlated errors: their variance is that of the residuals, and the degrees of freedom
    are Satterthwaite's.
    """
    columns = [[True] * len(means)] if inside is None else [inside, [not is_in for is_in in inside]]
    design = np.array(columns, dtype=float).T
    if len(means) - len(columns) < 2 or not design.any(0).all():
        return 0.0
    averages = design / design.sum(0)
    weights = averages[:, 0] if inside is None else averages[:, 1] - averages[:, 0]
    correlation = np.exp(-(np.subtract.outer(places, places).astype(float) ** 2) / 2)
    left = np.eye(len(means)) - design @ averages.T
    spread, residuals, difference = left @ correlation, left @ means, float(weights @ means)
    trace = np.trace(spread)
    error = math.sqrt(residuals @ residuals / trace * (weights @ correlation @ weights))
    if difference <= _SAME:
        return 0.0
    if error <= _SAME:
        return math.inf
    freedom = trace**2 / np.trace(spread @ spread)
    return difference / (float(stdtrit(freedom, 1 - _CHANCE / questions)) * error)
