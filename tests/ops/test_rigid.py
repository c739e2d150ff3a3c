import math

import pytest
import torch
from torch.autograd import gradcheck

from forewarp.ops.nodes import geman_mcclure, move_by_screw, stretch


def matrix(turn, shift):
    """The screw as a 4 x 4 matrix, by the exponential series."""
    x, y, z = turn.tolist()
    generator = torch.zeros(4, 4, dtype=torch.float64)
    generator[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    generator[:3, 3] = shift
    return torch.linalg.matrix_exp(generator)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.0499, 0.0501, 1.0, 3.1, 7.0])
def test_a_screw_is_the_exponential_of_its_matrix(angle):
    draw = torch.Generator().manual_seed(0)
    axis = torch.nn.functional.normalize(torch.randn(3, generator=draw, dtype=torch.float64), dim=0)
    shift, points = torch.randn(2, 3, generator=draw, dtype=torch.float64)
    moved = move_by_screw(points, angle * axis, shift)
    expected = matrix(angle * axis, shift) @ torch.cat([points, torch.ones(1, dtype=torch.float64)])
    torch.testing.assert_close(moved, expected[:3], rtol=0, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.7])
def test_gradients_of_a_screw_against_differences(angle):
    turn = torch.tensor([[0.6, 0.0, 0.8]], dtype=torch.float64) * angle
    inputs = (torch.randn(1, 3, dtype=torch.float64), turn, torch.randn(1, 3, dtype=torch.float64))
    assert gradcheck(move_by_screw, [t.requires_grad_() for t in inputs])


def test_without_a_turn_it_is_the_shift():
    points, shift = torch.randn(5, 3), torch.randn(5, 3)
    turn = torch.zeros(5, 3, requires_grad=True)
    moved = move_by_screw(points, turn, shift)
    assert moved.equal(points + shift)
    moved.sum().backward()
    assert turn.grad.isfinite().all()


def test_a_rigid_map_is_not_stretched_and_its_gradient_is_finite():
    jacobian = torch.eye(3, dtype=torch.float64).requires_grad_()
    found = stretch(jacobian)
    found.backward()
    assert found == 0
    assert jacobian.grad.isfinite().all()
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert float(stretch(quarter)) == pytest.approx(0, abs=1e-10)
    assert float(stretch(2 * quarter)) == pytest.approx(3 * math.log(2) ** 2)
    assert stretch(torch.zeros(3, 3)).isfinite()


def test_the_robust_function():
    q = torch.tensor([0.0, 1e-4, 4.0, 1e30, torch.inf], requires_grad=True)
    found = geman_mcclure(q)
    torch.testing.assert_close(found, torch.tensor([0.0, 5e-5, 1.0, 2.0, 2.0]), atol=1e-8, rtol=1e-4)
    (slope,) = torch.autograd.grad(found[1], q)
    assert float(slope[1]) == pytest.approx(0.5, rel=1e-3)


@pytest.mark.parametrize(
    ("turn", "match"),
    [(torch.zeros(4, 3), "rotation: expected shape"), (torch.zeros(5, 2), "rotation: expected")],
)
def test_shapes_that_do_not_fit(turn, match):
    with pytest.raises(ValueError, match=match):
        move_by_screw(torch.zeros(5, 3), turn, torch.zeros(5, 3))
