import pytest
import torch

from forewarp.ops.curves import dct_basis, spline_basis, spline_shares
from tests.support.reference import dct_difference

F64 = torch.float64


@pytest.mark.parametrize("padding", [0.0, 0.2])
def test_cosines_equal_the_slow_twin(padding):
    times = torch.tensor([0.0, 0.13, 0.5, 1.0], dtype=F64)
    expected = [dct_difference(t, 5, 9, 0.25, padding) for t in times.tolist()]
    torch.testing.assert_close(dct_basis(times, 5, 9, 0.25, padding), torch.tensor(expected, dtype=F64))


@pytest.mark.parametrize("canonical", [0.0, 0.1, 0.3, 0.7, 1.0])
@pytest.mark.parametrize("padding", [0.0, 0.1])
def test_cosines_are_exactly_zero_at_the_canonical_time(canonical, padding):
    for time in (canonical, torch.tensor([canonical]), torch.tensor([canonical], dtype=F64)):
        assert (dct_basis(time, 6, 20, canonical, padding) == 0).all()


def test_cosines_are_orthonormal_over_the_training_times():
    basis = dct_basis(torch.linspace(0, 1, 12, dtype=F64), 11, 12, 0.4)
    centred = basis - basis.mean(0)
    torch.testing.assert_close(centred.T @ centred, torch.eye(11, dtype=F64))


def test_hand_worked_spline():
    # Five knots are two spans; their middle, 1/2, lies on a knot: shares 1/6, 4/6, 1/6.
    assert (spline_basis(0.5, 5) * 6).tolist() == pytest.approx([0, 1, 4, 1, 0], abs=1e-6)
    assert spline_basis(torch.zeros(0), 7).shape == (0, 7)


@pytest.mark.parametrize(("knots", "straight"), [(7, False), (8, False), (2, True), (3, True), (8, True)])
def test_splines_sum_to_one_and_keep_straight_lines_also_beyond_the_ends(knots, straight):
    knot = torch.arange(knots, dtype=F64)
    line = knot / (knots - 1) if straight else (knot - 1) / (knots - 3)
    times = torch.linspace(-0.1, 1.1, 13, dtype=F64)
    basis = spline_basis(times, knots, straight=straight, beyond=0.2)
    torch.testing.assert_close(basis.sum(-1), torch.ones(13, dtype=F64))
    torch.testing.assert_close(basis @ line, times)
    for time, row in zip(times.tolist(), basis):
        torch.testing.assert_close(spline_basis(time, knots, straight=straight, beyond=0.2), row.float())


@pytest.mark.parametrize("knots", [2, 3, 8])
def test_a_natural_spline_passes_through_its_ends_without_acceleration(knots):
    values = torch.randn(knots, dtype=F64, generator=torch.Generator().manual_seed(0))
    step = 1e-3
    for end, value, inward in ((0.0, values[0], step), (1.0, values[-1], -step)):
        times = end + inward * torch.arange(4, dtype=F64)
        curve = spline_basis(times, knots, straight=True) @ values
        assert float(curve[0]) == pytest.approx(float(value))
        first, second = (curve.diff(n=2) / step**2).tolist()
        assert 2 * first - second == pytest.approx(0.0, abs=1e-6)  # the acceleration, continued to the end


def test_splines_are_smooth_between_spans():
    times = torch.linspace(0, 1, 1001, dtype=F64)
    acceleration = spline_basis(times, 9).diff(n=2, dim=0) / (times[1] - times[0]) ** 2
    assert float(acceleration.diff(dim=0).abs().amax()) < 1.0  # without jumps


@pytest.mark.parametrize(
    ("time", "knots", "options", "message"),
    [
        (0.5, 3, {}, "at least 4 knots, but got 3"),
        (0.5, 1, {"straight": True}, "at least 2 knots, but got 1"),
        (1.01, 5, {}, r"times in \[0, 1\], but got 1.01; scale"),
        (float("nan"), 5, {}, "times in"),
        (1.3, 7, {"beyond": 0.2}, r"times in \[-0.2, 1.2\], but got 1.3"),
    ],
)
def test_splines_refuse(time, knots, options, message):
    for call in (spline_shares, spline_basis, lambda t, *a, **o: spline_basis(torch.tensor([t]), *a, **o)):
        with pytest.raises(ValueError, match=message):
            call(time, knots, **options)
