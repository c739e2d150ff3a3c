from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

pytest.importorskip("pycolmap", reason="no pycolmap; make install adds it")

from forewarp.capture import poses as checks
from forewarp.capture.frames import Frames
from forewarp.capture.poses import Evidence, refuse_matches, refuse_poses, unrotated
from forewarp.data.directions import inverted, opposite
from forewarp.scene.camera import Lens
from tests.support.captures import cameras_on_arc, sparse_arc

GOOD = Evidence(features=900, shift=0.2, unrotated=0.5)


def frames(count=12, edges=1.0, masks=None, size=(320, 240), originals=()):
    times = {name: float(i) for i, name in enumerate(cameras_on_arc(count))}
    sizes = dict.fromkeys(times, size)
    return Frames(Path("pictures"), masks, times, range(count), count, edges, sizes, originals)


@pytest.mark.parametrize(
    ("evidence", "given", "says"),
    [
        ({"features": 20}, {"edges": 5.0}, r"20 in a picture; edges are 5 pixels wide .* film slower"),
        ({"features": 20}, {}, "20 in a picture; there is hardly any texture"),
        ({"features": 20}, {"masks": Path("masks")}, "no texture but on what the masks call moving"),
        ({"shift": 0.002}, {}, "moves, but got matches that shift by 0.2 % .* walk around the subject"),
        ({"unrotated": 0.01}, {}, "99 % of all shift is explained by turning it; .* something flat: walk"),
    ],
)
def test_hopeless_matches_are_refused_with_advice(monkeypatch, evidence, given, says):
    monkeypatch.setattr(checks, "evidence_of", lambda database: replace(GOOD, **evidence))
    with pytest.raises(ValueError, match=says):
        refuse_matches(Path("database.db"), frames(**given))


def test_good_matches_and_poses_pass_and_of_known_poses_three_are_enough(monkeypatch):
    monkeypatch.setattr(checks, "evidence_of", lambda database: GOOD)
    refuse_matches(Path("database.db"), frames())
    refuse_poses(sparse_arc(), frames(), Path("database.db"))
    refuse_poses(sparse_arc(count=7), frames(), Path("database.db"))
    refuse_poses(sparse_arc(count=3), frames())
    with pytest.raises(ValueError, match="a model of at least 3 pictures, but got 2"):
        refuse_poses(sparse_arc(count=2), frames())


@pytest.mark.parametrize(
    ("found", "given", "says"),
    [
        (
            None,
            {},
            r"12 pictures registered, but got 0; film slower and .*, take more frames \(frames=\), or",
        ),
        ({"count": 5}, {}, "most of 12 pictures registered, but got 5; film slower and with more"),
        ({"count": 5}, {"edges": 4.0}, "but got 5; edges are 4 pixels wide"),
        (None, {"originals": {"picture_000001.jpg": "a.jpg"}}, "0; .*, take more pictures, or give"),
        (
            {},
            {"size": (640, 480)},
            "cameras of 640 x 480 pixels, as the pictures, but got 320 x 240; set images=",
        ),
        (
            {"focal": 60.0},
            {},
            "at most 130 degrees, but got 139; if it is a fisheye, .* before something flat",
        ),
        ({"lens": Lens((-2.0, 0.0, 0.0))}, {}, "a lens that can be undone .* if it is a fisheye"),
        ({"degrees": 0.1}, {}, "places that are 0.08 % of the distance apart; .* before something flat"),
        ({"error": 3.0}, {}, "reprojection error of at most 2.5 pixels, but got 3.0"),
    ],
)
def test_bad_poses_are_refused_with_advice(monkeypatch, found, given, says):
    monkeypatch.setattr(checks, "evidence_of", lambda database: GOOD)
    with pytest.raises(ValueError, match=says):
        refuse_poses(None if found is None else sparse_arc(**found), frames(**given), Path("database.db"))


def placed_anew(change, **options):
    """A known model, its poses (12, 4, 4) changed, without points."""
    found = sparse_arc(**options)
    poses = change(torch.stack([camera.camera_to_world for camera in found.cameras.values()]))
    cameras = {
        name: replace(camera, camera_to_world=pose)
        for (name, camera), pose in zip(found.cameras.items(), poses)
    }
    return replace(found, cameras=cameras, points=found.points[:0], seen=found.seen[:0])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (inverted, r"colmap: .* look at one thing only if they are camera-to-world \(invert them\); write"),
        (opposite, "only if their axes are OpenGL's .*; write them anew, or force=true if they are right"),
        (lambda poses: poses[:1].expand(12, 4, 4), "colmap: expected cameras that move, but got all in one"),
    ],
)
def test_known_poses_of_another_kind_are_refused_before_a_scene_is_written(change, says):
    refuse_poses(placed_anew(lambda poses: poses), frames())
    with pytest.raises(ValueError, match=says):
        refuse_poses(placed_anew(change), frames())
    refuse_poses(placed_anew(change), frames(), force=True)


@pytest.mark.parametrize(("moves", "least", "most"), [(0.0, 0.0, 1e-6), (0.002, 0, 0.06), (0.3, 0.08, 1.0)])
def test_turning_and_walking_are_told_apart(moves, least, most):
    """A camera turns by six degrees and moves sideways, as a share of the distance; a quarter is wrong."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-0.5, 0.5, (400, 2)), rng.uniform(0.6, 1.6, (400, 1))], 1)
    rotation = Rotation.from_euler("xyz", [2, 6, 1], degrees=True).as_matrix()
    ends = [1.2 * seen[:, :2] / seen[:, 2:] for seen in (points, (points - [moves, 0, 0]) @ rotation.T)]
    ends[1][:100] += rng.normal(size=(100, 2))
    assert least <= min(unrotated(*ends, focal) for focal in (1.0, 1.2, 1.6)) <= most
