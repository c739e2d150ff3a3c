"""Images fade where they leave what was filmed."""

from dataclasses import replace

import torch

from forewarp.evaluation.filmed import Fade
from forewarp.scene.view import Rendering
from tests.support.tiny_scene import camera_at


def drawn_at(camera, depth, opacity=1.0):
    count = camera.width * camera.height
    return Rendering(torch.ones(count, 3), torch.full((count,), depth), torch.full((count,), opacity))


def test_what_a_training_image_shows_stays_and_the_rest_fades():
    camera = camera_at(0.6, size=40)
    fade = Fade([camera])
    image = torch.ones(40, 40, 3)
    assert torch.equal(fade(image, drawn_at(camera, 2.0), camera, 0.0), image)
    assert fade.told() is None
    wide = replace(camera, fx=camera.fx / 3, fy=camera.fy / 3)  # shows three times as much to each side
    faded = fade(image, drawn_at(wide, 2.0), wide, 0.0)
    assert faded[20, 20].min() == 1
    assert faded[:, :8].max() == faded[:8].max() == 0
    assert 0.7 < fade.shares[-1] < 0.95
    assert "1 of 2 images show what no training image shows" in fade.told()
    pose = camera.camera_to_world.clone()
    pose[:3, 0], pose[:3, 2] = -pose[:3, 0], -pose[:3, 2]  # it looks the other way
    behind = replace(camera, camera_to_world=pose)
    assert fade.kept(drawn_at(behind, 2.0), behind).max() == 0


def test_what_was_filmed_from_other_sides_alone_fades():
    camera = camera_at(0.0, size=40)
    fade = Fade([camera])
    cameras = [camera_at(turn, size=40) for turn in (0.0, 0.05, 0.12, 0.2, 0.5)]  # of a circle
    kept = [fade.kept(drawn_at(one, float(one.center.norm())), one)[20, 20] for one in cameras]
    assert kept[0] == kept[1] == 1
    assert 0 < kept[2] < 1
    assert kept[3] == kept[4] == 0


def test_where_nothing_is_the_far_plane_counts():
    """What is seen from elsewhere at a small distance may still be filmed far away."""
    filmed = replace(camera_at(0.6, size=40), far=100.0)
    pose = filmed.camera_to_world.clone()
    pose[:3, 3] += 3.0 * pose[:3, 0]  # to its right
    beside = replace(filmed, camera_to_world=pose)
    fade = Fade([filmed])
    assert fade.kept(drawn_at(beside, 2.0), beside)[20, 20] == 0
    assert fade.kept(drawn_at(beside, 0.0, opacity=0.0), beside)[20, 20] == 1
