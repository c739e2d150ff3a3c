import torch

from forewarp.scene.box import Box, Lattice
from forewarp.scene.silhouettes import visual_hull
from tests.support.tiny_scene import RADIUS, ball_center, camera_at, photograph


def views(count=6):
    cameras = [camera_at(i / count) for i in range(count)]
    return cameras, [photograph(c, 0.0)[..., 3] > 0 for c in cameras]


POINTS = (lambda lattice: lattice.to_world(lattice.all_voxels()))(
    Lattice(Box((-1, -0.7, -0.6), (1, 0.9, 0.6)), (12, 11, 10))
)
DISTANCE = (POINTS - ball_center(0.0)).norm(dim=-1)


def test_the_hull_holds_the_ball_and_not_much_else():
    hull = visual_hull(POINTS, *views())
    assert hull[DISTANCE < RADIUS].all()
    assert not hull[DISTANCE > 2 * RADIUS].any()


def test_a_view_may_disagree():
    cameras, masks = views()
    masks[2] = torch.zeros_like(masks[2])
    assert not visual_hull(POINTS, cameras, masks).any()
    assert visual_hull(POINTS, cameras, masks, misses=1)[DISTANCE < RADIUS].all()


def test_what_no_view_sees_is_outside():
    cameras, masks = views()
    far = torch.tensor([[0.0, 0.0, 50.0]])
    assert not visual_hull(far, cameras, [torch.ones_like(m) for m in masks]).any()
    assert visual_hull(POINTS[:0], cameras, masks).shape == (0,)
