import pytest
import torch

from forewarp.scene.cloud import far_apart


def test_chosen_points_are_far_from_one_another():
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    chosen = far_apart(points, 20)
    places = points[chosen]
    apart = torch.cdist(places, places) + 1e9 * torch.eye(20)
    # No point is farther from the places than they are from one another.
    assert float(torch.cdist(points, places).amin(-1).max()) <= float(apart.min()) + 1e-5
    assert int(chosen[0]) == int((points - points.mean(0)).norm(dim=-1).argmax())


@pytest.mark.parametrize("count", [0, 1, 3])
def test_of_few_points_all_are_chosen(count):
    assert far_apart(torch.randn(count, 3), 3).tolist() == list(range(count))
