"""Poses that were written in another way than they are read are recognised by what their cameras look at."""

import numpy as np
import pytest
import torch

from forewarp.data.cameras import FLIP
from forewarp.data.directions import (
    by_translation,
    check_directions,
    closer_readings,
    doubt_readings,
    inverted,
    opposite,
    other_readings,
    transposed,
)
from tests.support.written_scenes import UP, around, look_at, refused

CHANGES = {"inverse": inverted, "axes": opposite}


# What docs/own-data.md gives for conversion.
MIRROR, TO_OPENGL = (
    np.diag([1.0, 1, -1, 1]),
    np.array([[0, 0, -1, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]]),
)


@pytest.mark.parametrize("kind", ["unity", "ros", "pytorch3d"])
def test_axes_that_no_key_names_are_converted(kind):
    """Written by what right, up and ahead are; converted as the documentation says, they are right."""
    stored, converted = [], []
    for pose in around():
        right, down, ahead, center = pose[:3].double().numpy().T
        if kind == "unity":  # y up, z into the distance: left-handed; all lengths along z are negated
            flip = np.array([1, 1, -1])
            columns = [flip * right, -flip * down, flip * ahead, flip * center]
        else:
            columns = [*{"ros": (ahead, -right, -down), "pytorch3d": (-right, -down, ahead)}[kind], center]
        matrix = np.eye(4)
        matrix[:3] = np.stack(columns, 1)
        stored.append(torch.from_numpy(matrix @ FLIP))
        mended = {
            "unity": lambda m: MIRROR @ m @ MIRROR,
            "ros": lambda m: m @ TO_OPENGL,
            "pytorch3d": lambda m: m @ np.diag([-1.0, 1, -1, 1]),
        }[kind](matrix)
        converted.append(torch.from_numpy(mended @ FLIP))
    torch.testing.assert_close(torch.stack(converted), torch.stack(around()).double())
    of_ros = "only if x is ahead, as of ROS and Isaac; convert them"
    said = of_ros if kind == "ros" else r"convert poses of Unity \(left-handed\)"
    with refused(said):
        check_directions(stored, "t.json", inverse=False)


def in_a_row():
    poses = [around()[0].clone() for _ in range(6)]
    for i, pose in enumerate(poses):
        pose[:3, 3] += i * pose[:3, 0]
    return poses


def by_inverse(poses):
    """Poses beside whose rotations the translations of their inverses stand."""
    changed = poses.clone()
    changed[:, :3, 3] = torch.linalg.inv(poses)[:, :3, 3]
    return changed


def test_poses_written_in_another_way_are_recognised():
    flip, right = torch.from_numpy(FLIP), around()
    check_directions(right, "t.json", inverse=False)
    with refused("look away from one point; set data.axes=opencv"):
        check_directions([pose @ flip for pose in right], "t.json", inverse=False)
    mixed = [pose @ flip if i % 2 else pose for i, pose in enumerate(right)]
    with refused("50% of them that look away from it; write all in the same axes"):
        check_directions(mixed, "t.json", inverse=False)
    keys = {"data.inverse=true data.axes=opencv": right, "data.inverse=true": [pose @ flip for pose in right]}
    for said, stored in keys.items():
        misread = [torch.linalg.inv(pose) @ flip for pose in stored]
        with refused(f"; set {said}, or"):
            check_directions(misread, "t.json", inverse=False)
    check_directions(in_a_row(), "t.json", inverse=False)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (transposed, "only if rotations are transposed; write them so, or set data.axes=opengl"),
        (by_inverse, "only if translations are of world-to-camera matrices; write them so"),
        (lambda poses: transposed(opposite(poses)), "transposed and axes are OpenCV's; write them so"),
    ],
)
def test_half_inverted_poses_are_recognised(change, said):
    misread = opposite(change(opposite(torch.stack(around()))))
    with refused(said):
        check_directions(list(misread), "t.json", inverse=False)


def test_poses_that_meet_much_closer_in_another_way_are_doubted():
    """Of a narrow rig whose places are translations of world-to-camera matrices axes miss by a third."""
    aim = torch.tensor([1.0, 0.4, 0.2], dtype=torch.float64)
    places = [pose[:3, 3] + aim for pose in around(24)[:8]]
    right = torch.stack([look_at(place, aim, UP).double() for place in places])
    misread = by_inverse(right)
    assert other_readings(misread, {"t": by_translation}) == []
    assert closer_readings(misread, CHANGES | {"t": by_translation}) == ["t"]
    assert closer_readings(right, CHANGES | {"t": by_translation}) == []
    (line,) = doubt_readings(misread, {"t": by_translation}, "camera", "write them anew")
    assert (
        line
        == "camera: cameras look at about one thing, and 5 times closer or more if t; if so, write them anew"
    )
    (line,) = doubt_readings(opposite(right), CHANGES, "camera", "write them anew")
    assert line.startswith("camera: cameras do not look at one thing, as all of them do if axes; if so")
    assert doubt_readings(right, CHANGES, "camera", "") == []
    (line,) = check_directions(opposite(by_inverse(opposite(right))), "t.json", inverse=False)
    assert "look at about one thing, and 5 times closer or more if translations are of world-to" in line


def test_several_ways_are_named():
    right = [pose for pose in around(40) if pose[0, 3] > 3]  # of a narrow view
    changes = CHANGES | {"halfway": lambda poses: opposite(poses)}
    assert other_readings([pose @ torch.from_numpy(FLIP) for pose in right], changes) == ["axes", "halfway"]


def test_the_fewest_changes_by_which_cameras_look_at_one_thing_are_named():
    right, flip = torch.stack(around()), torch.from_numpy(FLIP)
    ways = {"": right, "axes": right @ flip, "inverse": torch.linalg.inv(right)}
    for said, poses in (ways | {"inverse and axes": torch.linalg.inv(right @ flip)}).items():
        assert other_readings(list(poses), CHANGES) == [said] * bool(said)
    assert other_readings(in_a_row(), CHANGES) == []
    assert other_readings(list(torch.linalg.inv(right)[:3]), CHANGES) == []


def test_transposed_rotations_keep_their_scale_and_place():
    poses = torch.arange(1.0, 33).reshape(2, 4, 4)
    changed = transposed(poses)
    torch.testing.assert_close(changed[:, :3, :3], poses[:, :3, :3].mT)
    torch.testing.assert_close((changed[:, :3, 3], changed[:, 3]), (poses[:, :3, 3], poses[:, 3]))
