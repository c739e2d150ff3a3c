import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from forewarp.capture.sharpness import edge_width, sharpest, sharpness


def test_the_sharpest_of_each_window_is_chosen():
    rng = np.random.default_rng(1)
    stamps, sharp = np.cumsum(rng.uniform(0.01, 0.2, 100)), rng.uniform(0, 1, 100)
    chosen = sharpest(stamps, sharp, 7)
    edges = np.linspace(stamps[0], stamps[-1], 8)
    for index, low, high in zip(chosen, edges[:-1], edges[1:], strict=True):
        inside = (stamps >= low) & (stamps <= high)
        assert sharp[index] == sharp[inside].max()


def test_windows_are_of_time_not_of_frames():
    stamps = np.concatenate([np.linspace(0, 1, 50), [6.0, 10.0]])
    assert sharpest(stamps, np.arange(52.0), 3) == [49, 50, 51]
    assert sharpest(stamps, -np.arange(52.0), 2) == [0, 50]


@pytest.mark.parametrize("count", [1, 7, 40, 59, 60, 99])
def test_gaps_cost_no_frames(count):
    stamps = np.concatenate([np.linspace(0, 1, 30), np.linspace(50, 51, 30)])
    chosen = sharpest(stamps, np.arange(60.0), count)
    assert chosen == sorted(set(chosen))
    assert min(count, 60) - 1 <= len(chosen) <= count


def test_blur_lowers_sharpness_and_widens_edges():
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (10, 16)).repeat(40, 0).repeat(40, 1).astype(np.uint8)
    series = [picture, *(gaussian_filter(picture.astype(float), s) for s in (1, 3, 6, 12))]
    values, widths = [sharpness(one) for one in series], [edge_width(one) for one in series]
    assert values == sorted(values, reverse=True)
    assert widths == sorted(widths)
    assert edge_width(0.1 * picture) == pytest.approx(widths[0], rel=1e-4)  # whatever the contrast
    assert edge_width(picture.repeat(2, 0).repeat(2, 1)) == pytest.approx(widths[0], rel=1e-4)  # or size
    assert edge_width(np.full((9, 9), 7)) == float("inf")
