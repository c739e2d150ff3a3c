import pytest
import torch

from forewarp.ops.march import by_importance, clip_to_box, midpoints, stratified, union


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def ones(count=1, value=1.0, dtype=torch.float32):
    return torch.full((count,), value, dtype=dtype)


# stratified ------------------------------------------------------------------------------------------------


def test_without_jitter_they_are_a_linspace_of_each_ray():
    depths = stratified(torch.tensor([2.0, 0.0]), torch.tensor([6.0, 1.0]), 5)
    torch.testing.assert_close(depths, torch.tensor([[2.0, 3, 4, 5, 6], [0, 0.25, 0.5, 0.75, 1]]))


def test_with_jitter_each_lies_in_its_bin_and_the_outer_bins_are_half_as_wide():
    depths = stratified(ones(4000, 2.0), ones(4000, 6.0), 5, generator())
    edges = torch.tensor([2.0, 2.5, 3.5, 4.5, 5.5, 6.0])
    assert (depths >= edges[:-1]).all()
    assert (depths <= edges[1:]).all()
    torch.testing.assert_close(depths.mean(0), (edges[1:] + edges[:-1]) / 2, atol=0.02, rtol=0)
    assert (depths.amax(0) - depths.amin(0) > 0.98 * (edges[1:] - edges[:-1])).all()
    assert (depths.diff(dim=1) >= 0).all()


def test_no_rays_and_no_stretch():
    assert stratified(ones(0), ones(0), 4, generator()).shape == (0, 4)
    assert (stratified(ones(2), ones(2), 3, generator()) == 1).all()


def test_midpoints_and_union():
    assert midpoints(torch.tensor([[0.0, 1, 3]])).tolist() == [[0.5, 2]]
    assert union(torch.tensor([[1.0, 4]]), torch.tensor([[3.0, 0, 5]])).tolist() == [[0, 1, 3, 4, 5]]


# by_importance ---------------------------------------------------------------------------------------------


def test_hand_worked():
    edges, weights = torch.tensor([[0.0, 1, 2, 4]]), torch.tensor([[1.0, 0, 3]])
    # The distribution function is 0, 1/4, 1/4, 1 at the edges; a plateau is left at its end.
    depths = by_importance(edges, weights, 5, floor=1e-9)
    torch.testing.assert_close(depths, torch.tensor([[0.0, 2, 2 + 2 / 3, 2 + 4 / 3, 4]]), atol=1e-4, rtol=0)


def test_the_share_of_a_bin_is_its_weight():
    edges, weights = torch.tensor([[0.0, 1, 3, 4]]), torch.tensor([[0.2, 0.5, 0.3]])
    depths = by_importance(edges, weights, 50_000, generator())[0]
    shares = torch.histogram(depths, edges[0]).hist / len(depths)
    torch.testing.assert_close(shares, weights[0], atol=0.01, rtol=0)


def test_without_any_weight_they_are_spread_over_all_bins():
    edges = torch.linspace(0, 3, 4)[None]
    torch.testing.assert_close(
        by_importance(edges, torch.zeros(1, 3), 7), torch.linspace(0, 3, 7)[None], atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("weight", [0.0, 1.0, 1e30])
def test_they_stay_inside_and_finite(weight):
    edges = torch.tensor([[1.0, 1, 2, 5]]).repeat(64, 1)  # an empty bin too
    depths = by_importance(edges, torch.tensor([0.0, weight, 0.0]).repeat(64, 1), 33, generator())
    assert depths.isfinite().all()
    assert (depths >= 1).all()
    assert (depths <= 5).all()


# clip_to_box -----------------------------------------------------------------------------------------------

LOW, HIGH = torch.tensor([-1.0, -2, -3]), torch.tensor([1.0, 2, 3])


def clipped(origin, direction, near=0.0, far=10.0):
    begin, end = clip_to_box(torch.tensor([origin]), torch.tensor([direction]), near, far, LOW, HIGH)
    return float(begin), float(end)


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ((-4.0, 0.0, 0.0), (1.0, 0.0, 0.0), (3.0, 5.0)),
        ((0.0, 0.0, 5.0), (0.0, 0.0, -1.0), (2.0, 8.0)),
        ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 2.0)),  # from inside
        ((-4.0, 2.0, 0.0), (1.0, 0.0, 0.0), (3.0, 5.0)),  # along a face
        ((-4.0, 0.0, 0.0), (0.6, 0.8, 0.0), None),
        ((-4.0, 2.1, 0.0), (1.0, 0.0, 0.0), None),
        ((4.0, 0.0, 0.0), (1.0, 0.0, 0.0), None),  # behind
    ],
)
def test_clipping_hand_worked(origin, direction, expected):
    begin, end = clipped(origin, direction)
    if expected is None:
        assert end <= begin
    else:
        assert (begin, end) == pytest.approx(expected)


def test_points_between_lie_in_the_box():
    origins = 4 * torch.randn(500, 3, generator=generator(), dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator(1)).double(), dim=1)
    begin, end = clip_to_box(origins, directions, 0.0, 20.0, LOW.double(), HIGH.double())
    along = torch.linspace(0, 20, 400, dtype=torch.float64)
    points = origins[:, None] + along[:, None] * directions[:, None]
    inside = ((points > LOW) & (points < HIGH)).all(-1)
    begin, end = begin[:, None], end[:, None]
    assert torch.equal(inside, (end > begin) & (along >= begin) & (along <= end))
