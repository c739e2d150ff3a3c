"""Intervals, verdicts and ties; and, in simulation, how often they are wrong where nothing differs."""

import math

import numpy as np
import pytest

from forewarp.report.benchmark import above
from forewarp.report.choices import choices
from forewarp.report.paper import order_of
from forewarp.report.results import Runs
from forewarp.report.statistics import Estimate, by_chance, paired_change, rank, verdict

TRIALS = 800  # of which a share of 5 % is known to 0.8 %


def test_intervals_are_students():
    # Quantiles from tables: 12.706, 4.303 and 2.776 for one, two and four degrees of freedom.
    assert Estimate.of([1.0, 3.0]).half_width == pytest.approx(12.706, abs=1e-3)
    assert Estimate.of([1.0, 2.0, 3.0]).half_width == pytest.approx(4.303 / 3**0.5, abs=1e-3)
    assert Estimate.of([1, 2, 3, 4, 5]).half_width == pytest.approx(2.776 * 2.5**0.5 / 5**0.5, abs=1e-3)
    assert (Estimate.of([2.0, None]).half_width, Estimate.of([None])) == (None, None)
    assert Estimate.of([1.0, 3.0]).error_bar == pytest.approx(1.0)  # to each of both
    assert Estimate.of([1.0]).error_bar == 0


def test_what_was_called_above_is_not_and_what_was_hidden_is_shown():
    assert verdict(Estimate(0.23, 0.18, 3)) == "no difference shown"  # 2.2 standard errors; 4.3 are needed
    assert verdict(Estimate(0.28, 0.06, 3)) == "above"  # however much other rows scatter
    close = {"a": (30.02, 30.07, 30.12), "b": (30.12, 29.96, 30.04)}  # 30.07 ± 0.05 and 30.04 ± 0.08
    assert rank({name: dict(enumerate(psnr)) for name, psnr in close.items()}) == [["a", "b"]]


@pytest.mark.parametrize(("values", "words"), [((), "no pair"), ((9.0,), "one seed"), ((9, 9), "two seeds")])
def test_there_is_no_verdict_of_fewer_than_three_pairs(values, words):
    change = Estimate.of(values)
    assert verdict(change) == words
    assert by_chance([change]) == "No difference here is of three seeds or more, so that there is no verdict."
    assert rank({name: dict(enumerate(values)) for name in "ab"}) == []


def test_pairs_are_by_view_and_count_once_a_run():
    def run(psnr, ability="all", **views):
        images = [{"name": n, "ability": "all", "scores": {"psnr": value}} for n, value in views.items()]
        return {"psnr": psnr, "ability": ability, "images": images}

    both = [(run(31.0, a=32.0, b=30.0), run(29.0, a=29.0))] * 2  # b of one run alone
    assert paired_change(both, "psnr") == Estimate(3.0, 0.0, 2)
    assert paired_change([(run(31.0, "time", a=32.0), run(29.0, "time", a=20.0))], "psnr") == Estimate(2.0)
    assert paired_change([(run(31.0, a=32.0), {"psnr": 30.0})], "psnr") == Estimate(1.0)  # of a table


@pytest.mark.slow
def test_the_second_place_is_shared_as_the_first():
    scores = {"a": (30.0, 30.1, 30.2), "b": (20, 20, 20), "c": (20.1, 19.9, 20.0), "d": (0, 0, 0)}
    named = {name: dict(enumerate(values)) for name, values in scores.items()}
    assert rank(named) == [["a"], ["b", "c"]]
    assert rank(named, higher_is_better=False) == [["d"], ["b", "c"]]
    other_seeds = {"e": {7: 40.0, 8: 40.1, 9: 40.2}}
    assert rank(named | other_seeds) == [["e"], ["a"]]  # without a pair the means alone are compared


@pytest.fixture(params=[3, 5], ids="{} seeds".format)
def chance(request):
    """Call with a number of methods -> PSNR (trial, method, seed) of methods that do not differ.

    A seed's scores share a part, as data and initialisation do.
    """
    draws = np.random.default_rng(request.param)

    def drawn(methods):
        shared = draws.normal(30.0, 0.3, (TRIALS, 1, request.param))
        return (shared + draws.normal(0.0, 0.2, (TRIALS, methods, request.param))).tolist()

    return drawn


@pytest.mark.slow
def test_without_a_difference_verdicts_are_wrong_in_one_case_of_twenty(chance):
    said = {"signs": [], "paper": [], "minutes": []}
    for one, other in chance(2):
        change = Estimate.of(a - b for a, b in zip(one, other))
        said["signs"].append(verdict(change))
        said["paper"].append(order_of(change, -0.9))
        first, second = (Runs({"seed": i, "psnr": psnr} for i, psnr in enumerate(v)) for v in (one, other))
        said["minutes"].append(above(first, second).rpartition(", ")[2])
    for page, words in said.items():
        assert len(set(words)) == 3, page
        wrong = sum(word != "no difference shown" for word in words) / TRIALS
        assert 0.03 < wrong <= 0.07, page


@pytest.mark.slow
def test_without_a_difference_plans_are_seldom_above_or_below_the_best(chance):
    names, rows = ("auto", "base", "all_effects", "no_effects"), Runs()
    for trial, of_trial in enumerate(chance(4)):
        for name, scores in zip(names, of_trial):
            row = {"scene": trial, "ablation": name, "minutes": 1, "plan": {}}
            rows += [row | {"seed": seed, "psnr": psnr} for seed, psnr in enumerate(scores)]
    words = [line[-2].split(", ")[0] for line in choices(rows).rows]
    assert len(words) == TRIALS
    assert 0.03 < sum(word != "no difference shown" for word in words) / TRIALS <= 0.07


@pytest.mark.slow
@pytest.mark.parametrize("noise", [[0.2], [2.0, 0.2], [0.2, 1.0]], ids=["equal", "one", "most"])
@pytest.mark.parametrize("methods", [2, 6, 12])
@pytest.mark.parametrize("seeds", [3, 5])
@pytest.mark.parametrize("is_paired", [True, False], ids=["paired", "unpaired"])
def test_without_a_difference_a_mark_is_seldom_withheld(noise, methods, seeds, is_paired):
    draws, trials = np.random.default_rng(seeds), 6000 // methods
    deviation = np.array([*noise[:1], *[noise[-1]] * (methods - 1)])[:, None]
    shared = draws.normal(30.0, 0.3 * is_paired, (trials, 1, seeds))
    withheld = 0
    for trial in (shared + deviation * draws.normal(size=(trials, methods, seeds))).tolist():
        rows = {
            i: {seed if is_paired else (i, seed): v for seed, v in enumerate(of)}
            for i, of in enumerate(trial)
        }
        withheld += len(rank(rows)[0]) < methods
    assert (0.03 if methods == 2 and noise == [0.2] else 0.005) < withheld / trials <= 0.07


@pytest.mark.parametrize("is_paired", [True, False], ids=["paired", "unpaired"])
def test_a_method_that_is_much_worse_than_eleven_others_loses_the_mark(is_paired):
    draws, lost = np.random.default_rng(0), 0
    for trial in draws.normal(30.0, 0.3, (100, 12, 3)).tolist():
        rows = {
            i: {seed if is_paired else (i, seed): v for seed, v in enumerate(of)}
            for i, of in enumerate(trial)
        }
        rows[11] = {seed: psnr - 4.0 for seed, psnr in rows[11].items()}
        lost += 11 not in rank(rows)[0]
    assert lost >= 90


def test_factors_are_averaged_as_logarithms():
    pairs = [({"step": now}, {"step": 1.0}) for now in (1.0, 4.0, 2.0)]
    change = paired_change(pairs, "step")
    inverse = paired_change([pair[::-1] for pair in pairs], "step")
    assert (change.mean, inverse.mean) == pytest.approx((2.0, 0.5))  # the mean of both, 2.33 and 0.58, is not
    reach = 4.3027 * math.log(2) / 3**0.5  # the logarithms are 0, 1 and 2 of those of 2
    assert change.ends == pytest.approx((2 / math.exp(reach), 2 * math.exp(reach)), rel=1e-3)
    assert verdict(change) == "no difference shown"
    assert verdict(paired_change(pairs[1:2] * 3, "step")) == "above"
    assert paired_change([({"step": 0.0}, {"step": 1.0})], "step") is None


def test_lpips_is_paired_by_view_by_the_name_of_its_net():
    def run(lpips, **views):
        images = [{"name": n, "ability": "all", "scores": {"lpips_alex": v}} for n, v in views.items()]
        return {"lpips": lpips, "ability": "all", "images": images}

    both = [(run(0.3, a=0.4, b=0.2), run(0.1, a=0.1))]
    assert paired_change(both, "lpips").mean == pytest.approx(0.3)  # of a alone
