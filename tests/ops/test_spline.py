import pytest
import torch

from forewarp.ops.curves import spline_basis


def test_hand_worked():
    # Five knots are two spans; their middle, 1/2, lies on a knot: shares 1/6, 4/6, 1/6.
    found = spline_basis(0.5, 5, canonical_time=0.0) * 6
    assert found.tolist() == pytest.approx([-1, 1 - 4, 4 - 1, 1, 0], abs=1e-6)


@pytest.mark.parametrize("canonical", [0.0, 0.31, 1.0])
def test_zero_at_the_canonical_time_and_in_sum(canonical):
    assert not bool(spline_basis(canonical, 9, canonical).any())
    basis = spline_basis(torch.linspace(0, 1, 41, dtype=torch.float64), 9, canonical)
    torch.testing.assert_close(basis.sum(-1), torch.zeros(41, dtype=torch.float64))


def test_straight_lines_are_straight():
    times = torch.linspace(0, 1, 17, dtype=torch.float64)
    path = spline_basis(times, 8, 0.25) @ torch.arange(8, dtype=torch.float64)
    torch.testing.assert_close(path, 5 * (times - 0.25))


def test_a_number_and_a_tensor_give_the_same():
    for time in (0.0, 0.123, 0.5, 1.0):
        torch.testing.assert_close(spline_basis(time, 7, 0.4), spline_basis(torch.tensor(time), 7, 0.4))


def test_beyond_its_times_a_spline_goes_on_as_at_the_end_and_only_so_far():
    line = (torch.arange(7.0) - 1) / 4
    for time in (-0.1, 1.1):
        basis = spline_basis(time, 7, beyond=0.2)
        torch.testing.assert_close(basis, spline_basis(torch.tensor(time), 7, beyond=0.2))
        assert float(basis.sum()) == pytest.approx(1.0, abs=1e-6)
        assert float(basis @ line) == pytest.approx(time, abs=1e-6)
    for time in (1.3, torch.tensor(1.3)):
        with pytest.raises(ValueError, match=r"expected times in \[-0.2, 1.2\], but got .*1.3"):
            spline_basis(time, 7, beyond=0.2)


@pytest.mark.parametrize("knots", [2, 3, 8])
def test_a_natural_spline_passes_through_its_ends_without_acceleration(knots):
    values = torch.randn(knots, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    step = 1e-3
    for end, value, inward in ((0.0, values[0], step), (1.0, values[-1], -step)):
        times = end + inward * torch.arange(4, dtype=torch.float64)
        curve = spline_basis(times, knots, straight=True) @ values
        assert float(curve[0]) == pytest.approx(float(value))
        first, second = (curve.diff(n=2) / step**2).tolist()
        assert 2 * first - second == pytest.approx(
            0.0, abs=1e-6
        )  # the second derivative, continued to the end
    line = torch.linspace(0, 1, knots, dtype=torch.float64)
    times = torch.linspace(-0.1, 1.1, 13, dtype=torch.float64)
    torch.testing.assert_close(spline_basis(times, knots, straight=True, beyond=0.2) @ line, times)
    for time in (-0.1, 0.3, 1.0):
        found = spline_basis(time, knots, 0.2, straight=True, beyond=0.2)
        of_tensor = spline_basis(torch.tensor(time), knots, 0.2, straight=True, beyond=0.2)
        torch.testing.assert_close(found, of_tensor)


def test_a_natural_spline_needs_two_knots():
    with pytest.raises(ValueError, match="at least 2 knots, but got 1"):
        spline_basis(0.5, 1, straight=True)


def test_smooth_between_spans():
    times = torch.linspace(0, 1, 2001, dtype=torch.float64)
    bend = spline_basis(times, 9, 0.0).diff(n=2, dim=0) / (times[1] - times[0]) ** 2
    assert float(bend.diff(dim=0).abs().amax()) < 1.0  # the second derivative has no jumps


@pytest.mark.parametrize(
    ("time", "knots", "canonical", "text"),
    [
        (0.5, 3, 0.0, "at least 4 knots, but got 3"),
        (1.01, 5, 0.0, r"times in \[0, 1\]"),
        (float("nan"), 5, 0.0, "times in"),
        (0.5, 5, 1.5, "times in"),
        (0.5, 5, float("nan"), "times in"),
    ],
)
def test_refused(time, knots, canonical, text):
    with pytest.raises(ValueError, match=text):
        spline_basis(time, knots, canonical)


@pytest.mark.parametrize("time", [0.3, torch.tensor([0.0, 0.3, 1.0])])
def test_without_a_canonical_time_shares_sum_to_one(time):
    total = spline_basis(time, 6).sum(-1)
    torch.testing.assert_close(total, torch.ones_like(total))


@pytest.mark.parametrize("canonical", [None, 0.5])
def test_no_times_have_no_shares(canonical):
    assert spline_basis(torch.zeros(0), 7, canonical).shape == (0, 7)
