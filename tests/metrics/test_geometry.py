import math

import pytest
import torch

from forewarp.metrics.geometry import chamfer, depth_delta, end_point_error
from forewarp.metrics.limits import THRESHOLDS
from forewarp.metrics.variation import variation
from tests.support import reference


def test_depth_by_hand():
    truth = torch.tensor([[1.0, 1.0, 2.0], [2.0, 4.0, 0.0]])
    # Ratios 1.01, 1.1, 1.3 (too near), 1.6 (too far), 1 and background.
    prediction = torch.tensor([[1.01, 1.1, 2.0 / 1.3], [3.2, 4.0, 7.0]])
    assert depth_delta(prediction, truth) == (0.4, 0.6, 0.8)
    # A ratio on the threshold is not below it.
    assert depth_delta(torch.tensor([[2.5]]), torch.tensor([[2.0]]), thresholds=(1.25, 1.2501)) == (0.0, 1.0)


def test_depth_is_its_twin():
    generator = torch.Generator().manual_seed(0)
    truth = 2 + torch.rand(9, 7, generator=generator)
    truth[torch.rand(9, 7, generator=generator) < 0.3] = 0
    foreground = torch.rand(9, 7, generator=generator) < 0.8
    prediction = truth.clamp_min(1) * (1 + 0.6 * (torch.rand(9, 7, generator=generator) - 0.4))
    prediction[0, :4] = torch.tensor([math.nan, 0.0, math.inf, -1.0])  # all of them wrong
    shares = depth_delta(prediction, truth, foreground)
    twin = reference.depth_delta(prediction.double(), truth.double(), foreground, THRESHOLDS)
    assert shares == pytest.approx(twin)
    assert 0 < shares[0] < shares[1] < shares[2] < 1


def test_empty_foreground_has_no_fraction():
    image = torch.ones(3, 4)
    assert depth_delta(image, torch.zeros(3, 4)) is None
    assert depth_delta(image, image, torch.zeros(3, 4, dtype=torch.bool)) is None


def test_depth_refusals():
    image = torch.ones(3, 4)
    with pytest.raises(ValueError, match=r"depth: expected .* \(3, 4\), but got \(4, 3\)"):
        depth_delta(image.T, image)
    with pytest.raises(ValueError, match=r"foreground: expected .* but got \(3, 1\)"):
        depth_delta(image, image, torch.ones(3, 1, dtype=torch.bool))
    with pytest.raises(ValueError, match="thresholds: expected ratios above 1, but got"):
        depth_delta(image, image, thresholds=(0.9,))


def walks(count=7, times=4, seed=0):
    generator = torch.Generator().manual_seed(seed)
    start = torch.rand(count, 1, 3, generator=generator)
    steps = torch.rand(count, times - 1, 3, generator=generator)
    steps *= torch.linspace(0, 0.4, count)[:, None, None]
    truth = torch.cat([start, start + steps], 1)
    return truth + 0.05 * torch.randn(truth.shape, generator=generator), truth


def test_end_points_by_hand():
    # The first point goes 3 then 4 along x, the second stays; predictions miss by (5, 1) and (2, 0).
    truth = torch.tensor([[[0.0, 0, 0], [3, 0, 0], [4, 0, 0]], [[1.0, 1, 1], [1, 1, 1], [1, 1, 1]]])
    predicted = truth.clone()
    predicted[0, 1] += torch.tensor([0.0, 3, 4])
    predicted[0, 2] += torch.tensor([0.0, 0, 1])
    predicted[1, 1] += torch.tensor([2.0, 0, 0])
    predicted[:, 0] += 5  # the canonical time does not count
    expected = {"epe_moving": 3.0, "epe_still": 1.0, "motion_mean": 3.5, "moving_threshold": 0.5}
    assert end_point_error(predicted, truth, 0.5) == expected | {"count_moving": 1, "count_still": 1}


def test_default_threshold_follows_the_scale_of_the_scene():
    predicted, truth = walks()
    small, large = end_point_error(predicted, truth), end_point_error(predicted * 50, truth * 50)
    extent = (truth[:, 0].amax(0) - truth[:, 0].amin(0)).norm().item()
    assert small["moving_threshold"] == pytest.approx(0.02 * extent)
    assert small["count_moving"] == large["count_moving"] == 6
    assert large["epe_moving"] == pytest.approx(50 * small["epe_moving"], rel=1e-5)


def test_without_moving_or_still_points():
    predicted, truth = walks()
    all_still = end_point_error(predicted, truth, 100.0)
    assert all_still["epe_moving"] is all_still["motion_mean"] is None
    assert (all_still["count_moving"], all_still["count_still"]) == (0, 7)
    all_moving = end_point_error(predicted[1:], truth[1:], 0.0)
    assert all_moving["epe_still"] is None
    assert (all_moving["count_moving"], all_moving["count_still"]) == (6, 0)


def test_end_points_are_their_twin():
    predicted, truth = walks()
    scores = end_point_error(predicted, truth, 0.2)
    errors = tuple(scores[key] for key in ("epe_moving", "epe_still", "motion_mean"))
    assert errors == pytest.approx(reference.end_point_error(predicted, truth, 0.2))


def test_end_point_refusals():
    predicted, truth = walks()
    broken = predicted.clone()
    broken[2, 1, 0] = math.nan
    for points, true, match in (
        (predicted[:, :1], truth[:, :1], r"truth: expected N >= 1 and T >= 2, but got shape \(7, 1, 3\)"),
        (predicted[:0], truth[:0], r"truth: expected .* but got shape \(0, 4, 3\)"),
        (predicted[:, 1:], truth, r"predicted: expected shape \(7, 4, 3\), but got \(7, 3, 3\)"),
        (broken, truth, r"predicted: expected finite places, but got 1 of 84"),
    ):
        with pytest.raises(ValueError, match=match):
            end_point_error(points, true)


def test_chamfer_by_hand():
    predicted = torch.tensor([[0.0, 0, 0], [4.0, 0, 0]])
    truth = torch.tensor([[0.0, 3, 0], [4.0, 0, 0], [4.0, 0, 1]])
    # To the truth 3 and 0; from it 3, 0 and 1.
    found = chamfer(predicted, truth)
    assert found == pytest.approx({"accuracy": 1.5, "completeness": 4 / 3, "chamfer": (1.5 + 4 / 3) / 2})
    assert chamfer(predicted, truth[:0]) is None
    assert chamfer(truth, truth)["chamfer"] == 0


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([1.0, 2.0, 5.0], 1.0),
        ([0.0, 2.0, 0.0, 2.0], 3.0),
        ([3.0, 1.0, 2.0], 1.5),
        ([2.0, 2.0], None),
        ([1.0], None),
    ],
)
def test_variation_by_hand(values, expected):
    assert variation(values) == expected
