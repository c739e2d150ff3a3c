"""Compare numbers of independent runs: estimates with intervals, paired changes, verdicts, ties, chance.

Every page compares by these functions. docs/experiments.md, "How numbers are compared", gives the reasons.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache

from scipy.special import stdtrit

LEVEL = 0.95  # of intervals
LEAST = 3  # independent values that a verdict needs
FACTORS = ("step", "frame", "memory", "parameters", "steps")  # measures that change by a factor
NETS = ("vgg", "alex", "squeeze")  # LPIPS in tables is of the first whose weights were there
SEEDS = ("no pair", "one seed", "two seeds")  # in place of a verdict
INTERVALS = "± is half the 95 % confidence interval of a mean (Student's t over the seeds)"
INTERVALS += "; of two seeds both values are in brackets"
NO_VERDICTS = "No difference here is of three seeds or more, so that there is no verdict."


@dataclass(frozen=True)
class Estimate:
    """A mean over independent values, as a rule one of each seed.

    Attributes:
        mean: their mean.
        deviation: the sample's standard deviation; None of a single value.
        count: how many there are.
        asked: how many seeds there are, of which some may lack what the mean is over; 0: as many as values.
    """

    mean: float
    deviation: float | None = None
    count: int = 1
    asked: int = field(default=0, compare=False, repr=False)

    @classmethod
    def of(cls, values: Iterable[float | None]) -> Estimate | None:
        """Estimate from the values that are not None; None if there are none.

        >>> Estimate.of([1.0, None, 3.0])
        Estimate(mean=2.0, deviation=1.4142135623730951, count=2)
        """
        known = [value for value in values if value is not None]
        if not known:
            return None
        deviation = statistics.stdev(known) if len(known) > 1 else None
        return cls(statistics.fmean(known), deviation, len(known))

    def times(self, factor: float) -> Estimate:
        """Return the estimate in another unit.

        >>> Estimate(0.5, 0.25, 3).times(100)
        Estimate(mean=50.0, deviation=25.0, count=3)
        """
        deviation = None if self.deviation is None else self.deviation * abs(factor)
        return Estimate(self.mean * factor, deviation, self.count)

    @property
    def half_width(self) -> float | None:
        """Half the 95 % confidence interval of the mean, by Student's t; None of a single value.

        >>> round(Estimate.of([1.0, 2.0, 3.0]).half_width, 3)  # 4.303 standard errors
        2.484
        """
        return self.half_width_among(1)

    @property
    def error_bar(self) -> float:
        """How far a mean's error bar reaches: half the interval; of two values to each of them; of one 0."""
        if self.count < LEAST:
            return (self.deviation or 0.0) / math.sqrt(2)
        return self.half_width

    def half_width_among(self, questions: float) -> float | None:
        """Half the interval whose errors, 5 % in all, so many questions share (Bonferroni)."""
        if self.deviation is None:
            return None
        quantile = stdtrit(self.count - 1, 1 - (1 - LEVEL) / 2 / questions)
        return float(quantile) * self.deviation / math.sqrt(self.count)

    def sign(self, questions: float = 1) -> int | None:
        """Return 1 or -1 where the interval leaves out 0, above or below it, else 0; None if the values are
        fewer than ``LEAST``.

        >>> [Estimate(mean, 0.18, 3).sign() for mean in (0.23, 0.5, -0.5)], Estimate(9.0, 0.1, 2).sign()
        ([0, 1, -1], None)
        """
        if self.count < LEAST:
            return None
        if abs(self.mean) <= self.half_width_among(questions) + 1e-9:
            return 0
        return 1 if self.mean > 0 else -1


@dataclass(frozen=True)
class Factor(Estimate):
    """A geometric mean of quotients; ``deviation`` and ``half_width`` are of their natural logarithms.

    A quotient and its inverse are so judged alike.
    """

    @classmethod
    def of(cls, values: Iterable[float | None]) -> Factor | None:
        """Estimate from the quotients that are not None; None if there are none.

        >>> Factor.of([0.5, 2.0]).mean, Factor.of([4.0, 4.0, 4.0]).sign(), Factor.of([0.5, 2.0, 1.0]).sign()
        (1.0, 1, 0)
        """
        logs = Estimate.of(None if value is None else math.log(value) for value in values)
        return logs and cls(math.exp(logs.mean), logs.deviation, logs.count)

    @property
    def ends(self) -> tuple[float, float]:
        """The ends of the 95 % interval, of two quotients both."""
        return self.mean / math.exp(self.error_bar), self.mean * math.exp(self.error_bar)

    def sign(self, questions: float = 1) -> int | None:
        """Return 1 or -1 where the interval leaves out 1, as ``Estimate.sign`` does of 0."""
        return Estimate(math.log(self.mean), self.deviation, self.count).sign(questions)


def paired_change(pairs: Sequence[tuple[Mapping, Mapping]], measure: str) -> Estimate | None:
    """Estimate the change of a measure over pairs of runs (now, before) that are equal in all else.

    Where both runs of a pair have the scores of test views, ``images`` as of ``results.read_run``, their
    difference is the mean over the views that both have. A pair counts once, however many views it has:
    views of one run are not independent.

    Args:
        pairs: rows, one pair a seed (and scene); pairs without the measure are left out.
        measure: name; if in ``FACTORS`` the change is a ``Factor``, else a difference.

    >>> paired_change([({"psnr": 31.0, "step": 0.2}, {"psnr": 30.0, "step": 0.1})], "step")
    Factor(mean=2.0, deviation=None, count=1)
    """
    both = [(now, before) for now, before in pairs if None not in (now.get(measure), before.get(measure))]
    if measure in FACTORS:
        positive = ((now[measure], before[measure]) for now, before in both)
        return Factor.of(now / before for now, before in positive if now > 0 and before > 0)
    return Estimate.of(_difference(now, before, measure) for now, before in both)


def _difference(now: Mapping, before: Mapping, measure: str) -> float:
    # Views have LPIPS by the names of nets; a row has that of the first net.
    for name in [f"lpips_{net}" for net in NETS] if measure == "lpips" else [measure]:
        ours, theirs = _by_view(now, name), _by_view(before, name)
        if shared := [view for view in ours if view in theirs]:
            return statistics.fmean(ours[view] - theirs[view] for view in shared)
    return now[measure] - before[measure]


def _by_view(row: Mapping, measure: str) -> dict[str, float]:
    """Return a run's score of each test view, of the kind that its scores are of."""
    images = (image for image in row.get("images", ()) if image["ability"] == row["ability"])
    return {image["name"]: image["scores"][measure] for image in images if measure in image["scores"]}


def verdict(change: Estimate | None, above: str = "above", below: str = "below") -> str:
    """Say in words whether a change is above or below 0, or that it shows no difference; of fewer than
    ``LEAST`` pairs, how many there are.

    >>> verdict(Estimate(0.23, 0.18, 3)), verdict(Estimate(-0.28, 0.06, 3)), verdict(Estimate(9.0, 0.1, 2))
    ('no difference shown', 'below', 'two seeds')
    """
    if change is None or change.count < LEAST:
        return SEEDS[change.count if change else 0]
    return {1: above, -1: below}.get(change.sign(), "no difference shown")


def rank(rows: Mapping[object, Mapping[object, float]], higher_is_better: bool = True) -> list[list]:
    """Name the rows that share the first place, and those that share the second; empty if nothing is ranked.

    The row with the best mean has the first place, and with it all rows whose difference from it is not
    shown; the others share the second place in the same way. A difference is shown where both

    * it is larger than Tukey's studentized range, which 5 % of columns without a difference exceed anywhere,
      allows with the noise of all rows together, and
    * its own interval leaves out 0: in pairs, or of rows without three shared seeds by ``lies_below``. So
      rows with more noise than others are not judged by the noise of these. It is of 95 % for two rows and
      of 98 % for five or more, so that among twelve, some with five times the noise, errors stay at 7 %.

    Args:
        rows: name -> values by seed (or whatever pairs them); rows with fewer than ``LEAST`` are not ranked.
        higher_is_better: whether the best mean is the largest.

    >>> psnr = {"a": {0: 30.0, 1: 30.1, 2: 30.2}, "b": {0: 30.1, 1: 30.0, 2: 30.1}, "c": {0: 9, 1: 9, 2: 9}}
    >>> rank(psnr), rank({"a": {0: 1.0}, "b": {0: 2.0}})
    ([['a', 'b'], ['c']], [])
    """
    sign = 1 if higher_is_better else -1
    left = {name: values for name, values in rows.items() if len(values) >= LEAST}
    if len(left) < 2:
        return []
    places, questions = [], min(len(left), 5) / 2
    noise, quantile = _residual(list(left.values()))
    while left and len(places) < 2:
        best = max(left.values(), key=lambda values: sign * statistics.fmean(values.values()))
        places.append([])
        for name, values in left.items():
            error = noise * math.sqrt((1 / len(best) + 1 / len(values)) / 2)
            gap = abs(statistics.fmean(best.values()) - statistics.fmean(values.values()))
            is_behind = gap > quantile * error + 1e-9 and _differ(best, values, questions)
            places[-1] += [] if is_behind else [name]
        left = {name: values for name, values in left.items() if name not in places[-1]}
    return places


def _residual(rows: Sequence[Mapping[object, float]]) -> tuple[float, float]:
    """Return the standard deviation of what rows, and seeds where all have the same, do not explain, and the
    95 % quantile of the studentized range for it.
    """
    means = [statistics.fmean(row.values()) for row in rows]
    left = [{seed: value - mean for seed, value in row.items()} for row, mean in zip(rows, means)]
    freedom = sum(len(row) - 1 for row in rows)
    if all(row.keys() == rows[0].keys() for row in rows):  # complete blocks
        of_seed = {seed: statistics.fmean(row[seed] for row in left) for seed in rows[0]}
        left = [{seed: value - of_seed[seed] for seed, value in row.items()} for row in left]
        freedom = (len(rows) - 1) * (len(of_seed) - 1)
    squares = sum(value**2 for row in left for value in row.values())
    return math.sqrt(squares / freedom), _studentized_range(len(rows), freedom)


@cache
def _studentized_range(rows: int, freedom: int) -> float:
    from scipy.stats import studentized_range  # late, as its import takes time

    return float(studentized_range.ppf(LEVEL, rows, freedom))


def _differ(first: Mapping[object, float], second: Mapping[object, float], questions: float) -> bool:
    """Tell whether the interval of the difference of two rows' means leaves out 0; ``questions`` as above."""
    change = Estimate.of(first[seed] - second[seed] for seed in first if seed in second)
    if change is not None and change.count >= LEAST:
        return change.sign(questions) != 0
    one, other = (Estimate.of(row.values()) for row in (first, second))
    return lies_below(one, other, questions) or lies_below(other, one, questions)


def lies_below(first: Estimate, second: Estimate, questions: float = 1) -> bool:
    """Tell whether one mean lies below another of other independent values, whose spreads may differ (Welch's
    t-test); no where either has fewer than ``LEAST`` values. ``questions`` as of ``half_width_among``.

    >>> low, high = Estimate(20.0, 1.0, 5), Estimate(23.0, 2.0, 5)  # 3 standard errors
    >>> lies_below(low, high), lies_below(low, high, questions=10), lies_below(high, low)
    (True, False, False)
    """
    if min(first.count, second.count) < LEAST:
        return False
    parts = [of.deviation**2 / of.count for of in (first, second)]
    if not (error := math.sqrt(sum(parts))):
        return first.mean < second.mean
    freedom = sum(parts) ** 2 / sum(p**2 / (of.count - 1) for p, of in zip(parts, (first, second)))
    quantile = float(stdtrit(freedom, 1 - (1 - LEVEL) / 2 / questions))
    return second.mean - first.mean > quantile * error


def by_chance(changes: Iterable[Estimate | None]) -> str:
    """Say of a page's differences how many would leave out 0 by chance, and how many do.

    >>> print(by_chance([Estimate(1.0, 0.1, 3), Estimate(0.1, 0.1, 3), Estimate(5.0, 0.1, 2), None]))
    2 differences are of three seeds or more; by chance 0.1 of their intervals would leave out 0, and 1 does.
    """
    signs = [change.sign() for change in changes if change is not None]
    asked = [sign for sign in signs if sign is not None]
    if not asked:
        return NO_VERDICTS
    shown = sum(sign != 0 for sign in asked)
    are = f"{len(asked)} differences are" if len(asked) > 1 else "One difference is"
    chance = f"by chance {(1 - LEVEL) * len(asked):.2g} of their intervals would leave out 0"
    return f"{are} of three seeds or more; {chance}, and {shown} do{'es' * (shown == 1)}."
