import pytest

from forewarp.data.held import hold_out
from forewarp.data.module import SceneDataModule
from forewarp.scene.errors import SceneError
from tests.support.tiny_scene import ball_scene


def names(frames):
    return [frame.name for frame in frames]


def test_frames_are_spread_and_leave_the_training_set():
    scene = hold_out(ball_scene(frames=14, size=8), 3)
    assert names(scene.held) == ["r_3", "r_7", "r_11"]
    assert len(scene.train) == 11
    assert not set(names(scene.train)) & set(names(scene.held))
    assert scene.protocol["held_out"] == 3


def test_always_the_same_and_nothing_else_changes():
    scene = ball_scene(frames=14, size=8)
    again = hold_out(scene, 4)
    assert names(hold_out(scene, 4).held) == names(again.held)
    assert (again.val, again.test, again.box, again.canonical_time) == (
        scene.val,
        scene.test,
        scene.box,
        scene.canonical_time,
    )
    assert hold_out(scene, 0) is scene


@pytest.mark.parametrize("canonical", [0.0, 5 / 11])
def test_the_ends_and_the_canonical_time_keep_their_frames(canonical):
    times = sorted([i / 11 for i in range(12)] * 2)  # two cameras a time
    scene = ball_scene(times=times, canonical_time=canonical, size=8)
    most = (24 - 2 * len({0.0, 1.0, canonical})) // 2
    held = {frame.time for frame in hold_out(scene, most).held}
    assert not held & {0.0, 1.0, canonical}
    with pytest.raises(SceneError, match=f"data.held_out: expected at most {most} of the 24 training frames"):
        hold_out(scene, most + 1)


@pytest.mark.parametrize("count", [-1, 1.5, "all"])
def test_bad_counts_are_named(count):
    with pytest.raises(SceneError, match="data.held_out: expected a whole number of at least 0, but got"):
        hold_out(ball_scene(frames=4, size=8), count)


def test_batches_never_show_them():
    data = SceneDataModule(lambda: ball_scene(frames=8, size=8), rays=4, held_out=2)
    times = {frame.time for frame in data.scene.held}
    assert len(data.targets("held")) == len(times) == 2
    assert data.watched().frames == data.targets("held").frames
    assert not {data.batches.draw().time for _ in range(200)} & times
    assert len(SceneDataModule(lambda: ball_scene(frames=8, size=8)).targets("held")) == 0
