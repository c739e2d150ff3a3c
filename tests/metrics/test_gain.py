import pytest

from forewarp.metrics.gain import Estimate, measure_effect

PAIRS = [({"psnr": 31.0, "step": 0.2}, {"psnr": 30.0, "step": 0.1}), ({"psnr": 30.0}, {"psnr": 30.0})]


def test_a_score_changes_by_a_difference_and_a_cost_by_a_factor():
    assert measure_effect(PAIRS, "psnr") == Estimate(0.5, pytest.approx(0.5**0.5))
    assert measure_effect(PAIRS, "step") == Estimate(2.0, None)
    assert measure_effect(PAIRS, "memory") is None
