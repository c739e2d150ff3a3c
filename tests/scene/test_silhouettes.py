import torch

from forewarp.scene.box import Box, Lattice
from forewarp.scene.frame import visual_hull
from tests.support.tiny_scene import RADIUS, ball_center, camera_at, photograph

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
