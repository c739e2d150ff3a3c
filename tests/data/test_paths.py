"""What a camera's path tells of poses and times that are not the images' own."""

from dataclasses import replace

import pytest
import torch

from forewarp.data.checks import remarks
from forewarp.data.paths import doubt_paths
from forewarp.scene.frame import Frame
from tests.support.room import shown, walk
from tests.support.tiny_scene import ball_scene

COUNT = 16
NUMBERS = range(1, COUNT + 1)
SCENE, CAMERAS = ball_scene(frames=2, size=16), walk(COUNT, (48, 36))
IMAGES = [torch.from_numpy(shown(camera)[0]) for camera in CAMERAS]


def said(frames, what, doubts=doubt_paths):
    """The lines of a film's frames with some words; frames are (name, time, camera, image)."""
    film = tuple(Frame(name, time, camera, lambda image=image: image) for name, time, camera, image in frames)
    return [line for line in doubts(replace(SCENE, train=film, has_alpha=False)) if what in line]


def film(names=None, times=None, cameras=CAMERAS, images=IMAGES):
    names = names or [f"images/frame_{i}" for i in NUMBERS]
    return [*zip(names, times or [i / COUNT for i in NUMBERS], cameras, images)]


def test_films_of_a_phone_that_was_turned_and_of_which_all_views_are_tested_are_read():
    turned = [4 <= i < 8 for i in range(COUNT)]
    images = [image.transpose(0, 1) if is_turned else image for image, is_turned in zip(IMAGES, turned)]
    cameras = [CAMERAS[i - 1] if i in (4, 8) else camera for i, camera in enumerate(CAMERAS)]
    cameras = [replace(c, width=36, height=48) if is_turned else c for c, is_turned in zip(cameras, turned)]
    assert not said(film(cameras=cameras, images=images), "pose of the one before")
    times = torch.randperm(COUNT, generator=torch.Generator().manual_seed(0)).tolist()
    shuffled = tuple(Frame(*of[:3], lambda: IMAGES[0]) for of in film(times=[i / COUNT for i in times]))
    scene = replace(SCENE, train=shuffled[::2], val=shuffled[1::2], test=shuffled[1::2], has_alpha=False)
    assert any("path is" in line for line in doubt_paths(scene))


def test_poses_that_follow_names_as_texts_and_times_in_no_order_are_said():
    assert not said(film(), "path")
    names = sorted(f"images/frame_{i}" for i in NUMBERS)
    given = [(name, int(name.split("_")[1]) / COUNT, *of) for name, (_, _, *of) in zip(names, film())]
    (line,) = said(given, "path is", remarks)
    assert "in that of the images' names as texts (images/frame_2 and images/frame_10 are the first" in line
    shuffled = torch.randperm(COUNT, generator=torch.Generator().manual_seed(0)).tolist()
    (line,) = said(film(times=[i / COUNT for i in shuffled]), "path is")
    assert "images' names (" in line
    assert line.endswith("as if times were given to names in no order; give each image its own pose and time")
    cameras = {f"images/cam{k}_{i}": (2 * i + k, CAMERAS[8 * k]) for k in (0, 1) for i in NUMBERS}
    both = [(name, time / 40, camera, IMAGES[0]) for name, (time, camera) in cameras.items()]
    assert not said(both, "path is")  # two cameras in turn


@pytest.mark.parametrize("count", [1, COUNT])
def test_rounded_times_of_one_path_are_said_and_not_those_of_a_rig(count):
    cameras = [CAMERAS[i % count] for i in range(COUNT)]
    (line,) = said(film(times=[round(i / COUNT, 1) for i in range(COUNT)], cameras=cameras), "times (")
    assert line.startswith("16 images of one camera's path have 10 times (images/frame_2 and images/frame_3")
    rig = film(times=[i // 4 / 4 for i in range(COUNT)], cameras=CAMERAS[::4] * 4)
    assert not said(rig, "times (")
    assert not said(rig[:-1], "times (")
    assert not said(film(times=[i // 2 / 8 for i in range(COUNT)]), "times (")  # two cameras on one path
    assert not said(film(), "times (")


def test_one_pose_of_images_that_go_on_changing_is_said():
    rows, lines = [min(i, 5) if i < 10 else i for i in range(COUNT)], "pose of the one before"
    lost = [CAMERAS[i] for i in rows]
    (line,) = said(film(cameras=lost), lines)
    assert line.startswith(f"4 images have the {lines} (images/frame_7 to images/frame_10), and change")
    assert not said(film(cameras=lost, images=[IMAGES[i] for i in rows]), lines)  # it paused
    assert not said(film(cameras=CAMERAS[:1] * COUNT), lines)  # it stands
