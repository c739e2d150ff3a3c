import pytest

from forewarp.metrics.gain import Estimate, Gain, measure_effect

PAIRS = [({"psnr": 31.0, "step": 0.2}, {"psnr": 30.0, "step": 0.1}), ({"psnr": 30.0}, {"psnr": 30.0})]


def test_a_score_changes_by_a_difference_and_a_cost_by_a_factor():
    assert measure_effect(PAIRS, "psnr") == Estimate(0.5, pytest.approx(0.5**0.5))
    assert measure_effect(PAIRS, "step") == Estimate(2.0, None)
    assert measure_effect(PAIRS, "memory") is None


def test_a_gain_is_as_sure_as_its_pairs_agree():
    pairs = [({"psnr": 30 + d, "step": 0.3}, {"psnr": 30.0, "step": 0.1}) for d in (1.0, 2.0, 3.0, 2.0)]
    gain = Gain.of([pairs], steps=100)
    deviation = (2 / 3) ** 0.5
    assert (gain.psnr, gain.noise) == (2.0, pytest.approx(2 * deviation / 2))
    assert str(gain) == "trial +2.00 ± 0.82 dB for 3.0 times the time"
    assert str(Gain.of([pairs], None, (20.0, 8.0))) == "trial +2.00 ± 0.82 dB in 20 s against 8 s"


def test_seeds_that_disagree_make_it_less_sure_than_their_views():
    seeds = [[({"psnr": 30 + d, "step": 1.0}, {"psnr": 30.0, "step": 1.0})] * 50 for d in (0.0, 2.0)]
    assert Gain.of(seeds, 10).noise == pytest.approx(2 * 2**0.5 / 2**0.5)
    with pytest.raises(ValueError, match="expected at least 2 pairs, but got 1"):
        Gain.of([seeds[0][:1]], 10)
