import math

import pytest
import torch

from forewarp.metrics.depth import depth_delta
from forewarp.metrics.registry import THRESHOLDS
from tests.support import reference


def test_by_hand():
    truth = torch.tensor([[1.0, 1.0, 2.0], [2.0, 4.0, 0.0]])
    # Ratios 1.01, 1.1, 1.3 (too near), 1.6 (too far), 1 and background.
    prediction = torch.tensor([[1.01, 1.1, 2.0 / 1.3], [3.2, 4.0, 7.0]])
    assert depth_delta(prediction, truth) == (0.4, 0.6, 0.8)
    # A ratio on the threshold is not below it.
    assert depth_delta(torch.tensor([[2.5]]), torch.tensor([[2.0]]), thresholds=(1.25, 1.2501)) == (0.0, 1.0)


def test_is_its_twin():
    generator = torch.Generator().manual_seed(0)
    truth = 2 + torch.rand(9, 7, generator=generator)
    truth[torch.rand(9, 7, generator=generator) < 0.3] = 0
    foreground = torch.rand(9, 7, generator=generator) < 0.8
    prediction = truth.clamp_min(1) * (1 + 0.6 * (torch.rand(9, 7, generator=generator) - 0.4))
    prediction[0, :4] = torch.tensor([math.nan, 0.0, math.inf, -1.0])  # all of them wrong
    found = depth_delta(prediction, truth, foreground)
    twin = reference.depth_delta(prediction.double(), truth.double(), foreground, THRESHOLDS)
    assert found == pytest.approx(twin)
    assert 0 < found[0] < found[1] < found[2] < 1


def test_empty_foreground_has_no_fraction():
    image = torch.ones(3, 4)
    assert depth_delta(image, torch.zeros(3, 4)) is None
    assert depth_delta(image, image, torch.zeros(3, 4, dtype=torch.bool)) is None


def test_refusals():
    image = torch.ones(3, 4)
    with pytest.raises(ValueError, match=r"depth: expected .* \(3, 4\), but got \(4, 3\)"):
        depth_delta(image.T, image)
    with pytest.raises(ValueError, match=r"foreground: expected .* but got \(3, 1\)"):
        depth_delta(image, image, torch.ones(3, 1, dtype=torch.bool))
    with pytest.raises(ValueError, match="thresholds: expected ratios above 1, but got"):
        depth_delta(image, image, thresholds=(0.9,))
