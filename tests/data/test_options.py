"""Views held out and another canonical time."""

from dataclasses import replace

import pytest
import torch

from forewarp.data.files import SceneError
from forewarp.data.module import SceneDataModule, hold_out, outline, with_canonical
from forewarp.scene.frame import Truth
from tests.support.tiny_scene import ball_scene


def names(frames):
    return [frame.name for frame in frames]


def test_frames_are_spread_and_leave_the_training_set():
    scene = hold_out(ball_scene(frames=14, size=8), 3)
    assert names(scene.held) == ["r_3", "r_7", "r_11"]
    assert len(scene.train) == 11
    assert not set(names(scene.train)) & set(names(scene.held))
    assert scene.protocol["held_out"] == 3
    assert hold_out(scene, 0) is scene


@pytest.mark.parametrize("canonical", [0.0, 5 / 11])
def test_the_ends_and_the_canonical_time_keep_their_frames(canonical):
    times = sorted([i / 11 for i in range(12)] * 2)  # two cameras a time
    scene = ball_scene(times=times, canonical_time=canonical, size=8)
    most = (24 - 2 * len({0.0, 1.0, canonical})) // 2
    held = {frame.time for frame in hold_out(scene, most).held}
    assert not held & {0.0, 1.0, canonical}
    with pytest.raises(SceneError, match="data.held_out: expected a whole number of at least 0, but got -1"):
        hold_out(scene, -1)
    with pytest.raises(SceneError, match=f"data.held_out: expected at most {most} of the 24 training frames"):
        hold_out(scene, most + 1)


def test_batches_never_show_them():
    data = SceneDataModule(lambda: ball_scene(frames=8, size=8), rays=4, held_out=2)
    times = {frame.time for frame in data.scene.held}
    assert len(data.targets("held")) == len(times) == 2
    assert data.watched().frames == data.targets("held").frames
    assert not {data.batches.draw().time for _ in range(200)} & times
    assert len(SceneDataModule(lambda: ball_scene(frames=8, size=8)).targets("held")) == 0


def moving(*times):
    """A scene that begins at 0, with trajectories at ``times``."""
    truth = Truth(torch.rand(3, len(times), 3), torch.tensor(times, dtype=torch.float64))
    return replace(ball_scene(frames=5, size=8), truth=truth)


def test_the_middle_training_time_becomes_canonical_and_leads_the_trajectories():
    scene = moving(0.0, 0.25, 0.5, 1.0)
    moved = with_canonical(scene, "middle")
    assert moved.canonical_time == moved.protocol["canonical_time"] == 0.5
    assert moved.truth.times.tolist() == [0.5, 0.0, 0.25, 1.0]
    assert torch.equal(moved.truth.points, scene.truth.points[:, [2, 0, 1, 3]])
    assert with_canonical(moving(0.0, 1.0), "middle").truth is None
    assert with_canonical(scene, None) is scene


@pytest.mark.parametrize(
    ("choice", "time"), [(0.0, 0.0), (0.3, 0.25), (0.45, 0.5), (1, 1.0), ("middle", 0.5)]
)
def test_the_training_time_nearest_to_a_typed_one_becomes_canonical(choice, time):
    scene = moving(0.0, 0.25, 0.5, 1.0)
    assert with_canonical(scene, choice).canonical_time == time


@pytest.mark.parametrize("word", ["last", 1.5, -0.1, True, float("nan")])
def test_another_canonical_time_is_refused(word):
    with pytest.raises(SceneError, match="data.canonical: expected middle, spread, a time in .0, 1. or null"):
        with_canonical(moving(0.0), word)


def posing(*apart, alpha=True):
    """A scene of two bars that are so many pixels apart in each frame; 0: they touch."""
    pictures = []
    for gap in apart:
        rgba = torch.zeros(24, 24, 4, dtype=torch.uint8)
        rgba[4:20, 8:12, 3] = rgba[4:20, 12 + gap : 16 + gap, 3] = 255
        pictures.append(rgba)
    scene = ball_scene(frames=len(apart), size=24)
    train = tuple(replace(f, load=lambda p=p: p) for f, p in zip(scene.train, pictures, strict=True))
    return replace(scene, train=train, has_alpha=alpha)


@pytest.mark.parametrize(
    ("apart", "time"),
    [
        ((4, 4, 0, 0, 0), 0.25),  # two parts that touch later on
        ((0, 0, 0, 0, 4), 1.0),
        ((4, 4, 4, 4, 0), 0.5),  # of much the same, the middle
        ((0, 0, 0, 0, 0), 0.5),
    ],
)
def test_the_canonical_time_is_one_at_which_parts_do_not_touch(apart, time):
    assert with_canonical(posing(*apart), "spread").canonical_time == time
    assert with_canonical(posing(*apart, alpha=False), "spread").canonical_time == 0.5


def test_an_empty_silhouette_has_no_outline():
    assert outline(torch.zeros(4, 4, dtype=torch.bool)) == 0
