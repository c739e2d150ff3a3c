"""Distortion against the printed formula, and its inverse wherever there is one."""

import pytest
import torch

from forewarp.ops.lens import distort, undistort, unfolded

LENSES = {
    "none": ((0.0, 0.0, 0.0), (0.0, 0.0)),
    "phone": ((0.10042, -0.20909, 0.0), (1.1e-3, -2.6e-5)),
    "slanted phone": ((0.105, -0.088, 0.0), (-0.0537, 0.0037)),
    "barrel": ((-0.25, 0.05, -0.004), (0.001, 0.002)),
    "cushion": ((0.4, 0.2, 0.1), (0.0, 0.0)),
}


def plane(extent, count=41):
    """A regular grid of points (count, count, 2) within ``extent`` of the axis."""
    line = torch.linspace(-extent, extent, count, dtype=torch.float64)
    return torch.stack(torch.meshgrid(line, line, indexing="xy"), -1)


def test_hand_worked():
    # r^2 = 1.25; s = 1 + 0.1 * 1.25 + 0.2 * 1.5625 + 0.3 * 1.953125 = 2.0234375
    point = torch.tensor([0.5, -1.0], dtype=torch.float64)
    x = 0.5 * 2.0234375 + 2 * 0.01 * 0.5 * -1 + 0.02 * (1.25 + 0.5)
    y = -1.0 * 2.0234375 + 2 * 0.02 * 0.5 * -1 + 0.01 * (1.25 + 2)
    expected = torch.tensor([x, y], dtype=torch.float64)
    torch.testing.assert_close(distort(point, (0.1, 0.2, 0.3), (0.01, 0.02)), expected)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
def test_each_is_the_inverse_of_the_other_to_1e_10_and_finite_elsewhere(lens):
    points = plane(0.7)
    assert (undistort(distort(points, *lens), *lens) - points).abs().max() < 1e-10
    points = plane(0.45)
    assert (distort(undistort(points, *lens), *lens) - points).abs().max() < 1e-10
    far = torch.cat([plane(50.0).reshape(-1, 2), torch.tensor([[1e17, 0.0], [-1e17, 1e17], [0.0, 0.0]])])
    assert undistort(far, *lens).isfinite().all()


def test_at_the_fold_the_jacobian_is_singular():
    # x (1 - x^2) has its maximum at x = 1/sqrt(3); beyond there is no inverse.
    lens = ((-1.0, 0.0, 0.0), (0.0, 0.0))
    fold = 3**-0.5
    points = torch.tensor([[0.999 * fold, 0.0], [fold, 0.0]], dtype=torch.float64)
    back = undistort(distort(points, *lens), *lens)
    assert abs(back[0, 0] - points[0, 0]) < 1e-10
    assert abs(back[1, 0] - fold) < 1e-6
    assert undistort(torch.tensor([[0.6, 0.0]]), *lens).isfinite().all()


# The fold of each lens: 1 + 3 k1 r^2 + 5 k2 r^4 = 0.
@pytest.mark.parametrize(
    ("k1", "k2", "fold"), [(0.3, -0.1, (0.9 + 2.81**0.5) ** 0.5), (-0.25, 0.0, 2 / 3**0.5)]
)
def test_the_fold_is_where_the_image_turns_back(k1, k2, fold):
    away = fold * torch.tensor([0.0, 0.1, 0.9, 0.9999, 1.0001, 1.1, 1.3, 2.0, 9.0, 1e6, 1e15]).double()
    points = torch.stack([0.6 * away, -0.8 * away], -1)
    assert unfolded(points, (k1, k2, 0.0), (0.0, 0.0)).tolist() == [True] * 4 + [False] * 7


def test_a_ring_that_is_folded_hides_what_lies_beyond():
    # 1 - 2.4 u + 1.25 u^2 is negative for u = r^2 from 0.61 to 1.31 only.
    away = torch.tensor([[0.7, 0.0], [1.0, 0.0], [1.2, 0.0], [2.0, 0.0], [5.0, 0.0]])
    assert unfolded(away, (-0.8, 0.25, 0.0), (0.0, 0.0)).tolist() == [True] + [False] * 4
