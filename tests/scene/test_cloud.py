import pytest
import torch

from forewarp.ops.gaussians import FLAT, harmonics, rotations
from forewarp.scene.box import Box, Lattice
from forewarp.scene.cloud import Ellipsoids, far_apart
from forewarp.scene.frame import visual_hull
from tests.support.tiny_scene import RADIUS, ball_center, camera_at, photograph


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_chosen_points_are_far_from_one_another():
    points = random(500, 3)
    chosen = far_apart(points, 20)
    places = points[chosen]
    apart = torch.cdist(places, places) + 1e9 * torch.eye(20)
    # No point is farther from the places than they are from one another.
    assert float(torch.cdist(points, places).amin(-1).max()) <= float(apart.min()) + 1e-5
    assert int(chosen[0]) == int((points - points.mean(0)).norm(dim=-1).argmax())
    assert far_apart(points[:3], 3).tolist() == [0, 1, 2]


def gaussians(roots, colors=None):
    """Gaussians of roots (N, 3, 3), whose colours have B = 4 harmonics."""
    colors = random(len(roots), 4, 3) if colors is None else colors
    return Ellipsoids(random(len(roots), 3), roots, torch.ones(len(roots)), colors)


def test_axes_give_the_covariances_again_with_proper_rotations():
    roots = random(500, 3, 3)
    scales, quaternions = gaussians(roots).axes
    again = rotations(quaternions) * scales[:, None]
    torch.testing.assert_close(again @ again.mT, gaussians(roots).covariances)
    torch.testing.assert_close(quaternions.norm(dim=-1), torch.ones(500).double())
    assert float(scales.min()) > 0
    torch.testing.assert_close(torch.linalg.det(rotations(quaternions)), torch.ones(500).double())


def test_a_turned_diagonal_keeps_its_axes():
    given, turns = random(200, 3).exp(), torch.nn.functional.normalize(random(200, 4, seed=1), dim=-1)
    roots = rotations(turns) * given[:, None]
    scales, quaternions = gaussians(roots).axes
    torch.testing.assert_close(scales, given)
    torch.testing.assert_close(rotations(quaternions), rotations(turns))


@pytest.mark.parametrize(
    "diagonal", [(0.0, 0.0, 0.0), (1.0, 0.0, 2.0), (1.0, -1.0, 1.0), (1e-20, 1.0, 1.0), (1e-30, 1e-30, 1e-30)]
)
def test_what_is_flat_or_mirrored_has_finite_logarithms(diagonal):
    roots = torch.diag(torch.tensor(diagonal))[None]
    scales, quaternions = gaussians(roots).axes
    assert bool(scales.log().isfinite().all())
    again = rotations(quaternions) * scales[:, None]
    torch.testing.assert_close(again @ again.mT, roots @ roots.mT, atol=max(diagonal) ** 2 * 1e-6, rtol=0)


def test_colours_are_the_mean_stay_in_range_and_turn_along():
    flat = torch.tensor([[[0.0, 0.25, 9.0]], [[-9.0, -0.5, 0.5]]]) / FLAT
    cloud = gaussians(torch.eye(3).expand(2, 3, 3), flat)
    torch.testing.assert_close(cloud.colors, torch.tensor([[0.5, 0.75, 1.0], [0.0, 0.0, 1.0]]))
    assert torch.equal(cloud[[1]].colors, cloud.colors[1:])
    cloud, rotation = gaussians(random(5, 3, 3)), rotations(random(1, 4, seed=3))[0]
    direction = torch.nn.functional.normalize(random(1, 3, seed=4), dim=-1)
    before = torch.einsum("rb,nbc->nrc", harmonics(direction, 4), cloud.harmonics)
    turned = cloud.turned(rotation).harmonics
    after = torch.einsum("rb,nbc->nrc", harmonics(direction @ rotation.T, 4), turned)
    torch.testing.assert_close(after, before)


LATTICE = Lattice(Box((-1, -0.7, -0.6), (1, 0.9, 0.6)), (12, 11, 10))
POINTS = LATTICE.to_world(LATTICE.all_voxels())
DISTANCE = (POINTS - ball_center(0.0)).norm(dim=-1)
CAMERAS = [camera_at(i / 6) for i in range(6)]
MASKS = [photograph(camera, 0.0)[..., 3] > 0 for camera in CAMERAS]


def test_the_hull_holds_the_ball_and_not_much_else():
    hull = visual_hull(POINTS, CAMERAS, MASKS)
    assert hull[DISTANCE < RADIUS].all()
    assert not hull[DISTANCE > 2 * RADIUS].any()


def test_a_view_may_disagree():
    masks = [*MASKS[:5], torch.zeros_like(MASKS[5])]
    assert not visual_hull(POINTS, CAMERAS, masks).any()
    assert visual_hull(POINTS, CAMERAS, masks, misses=1)[DISTANCE < RADIUS].all()


def test_what_no_view_sees_is_outside():
    far = torch.tensor([[0.0, 0.0, 50.0]])
    assert not visual_hull(far, CAMERAS, [torch.ones_like(m) for m in MASKS]).any()
