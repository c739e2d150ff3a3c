"""What holds for every format: how it is rewritten, boxed and served."""

from itertools import islice

import numpy as np
import pytest
import torch

from forewarp.data import dnerf, hypernerf, nhr, posed_video
from forewarp.data.files import SceneError
from tests.support import dnerf_scene, nhr_scene, posed_scene, rig_scene

DOME, SPLITS = nhr_scene.dome(2), ["train"] * 5 + ["test"] * 5
FORMATS = {  # what reads it, what writes a scene with all that may be there, what writes shots and no more
    "dnerf": (
        dnerf.read_scene,
        dnerf_scene.write_kinds,
        lambda folder, cut: dnerf_scene.write_tiny(folder, test=cut(dnerf_scene.shots(2))),
    ),
    "hypernerf": (
        hypernerf.read_scene,
        lambda f: rig_scene.write_rig(f, points=np.zeros((1, 3)), trajectories=rig_scene.truth()),
        lambda folder, cut: rig_scene.write_rig(folder, cut(rig_scene.hand(5))),
    ),
    "nhr": (
        nhr.read_scene,
        lambda folder: nhr_scene.write_dome(folder, trajectories=nhr_scene.truth()),
        lambda folder, cut: nhr.write_scene(folder, DOME, cut(nhr_scene.dome_frames(DOME, 2))),
    ),
    "video": (
        posed_video.read_scene,
        lambda folder: posed_scene.write_tiny(folder, splits=SPLITS),
        lambda folder, cut: posed_video.write_scene(folder, cut(posed_scene.shots()), near=20, far=120),
    ),
}


def cut_short(shots):
    yield from islice(shots, 1)
    raise KeyboardInterrupt


@pytest.mark.parametrize("name", FORMATS)
def test_a_rewritten_scene_keeps_nothing_of_the_old_one(tmp_path, name):
    read, write, rewrite = FORMATS[name]
    write(tmp_path / "toy")
    with pytest.raises(KeyboardInterrupt):
        rewrite(tmp_path / "toy", cut_short)
    with pytest.raises(SceneError, match="expected a scene with"):
        read(tmp_path, "toy")
    for folder in ("toy", "fresh"):
        rewrite(tmp_path / folder, iter)
    found, expected = read(tmp_path, "toy"), read(tmp_path, "fresh")
    assert found.protocol == expected.protocol
    assert (found.truth, found.still) == (None, None)
    for split in ("train", "val", "test"):
        assert [f.name for f in getattr(found, split)] == [f.name for f in getattr(expected, split)]
    assert not list(tmp_path.rglob("*.partial"))


@pytest.mark.parametrize("name", ["dnerf", "hypernerf", "nhr"])
def test_a_box_is_as_given_or_bounds_all_training_rays(tmp_path, name):
    read, write, _ = FORMATS[name]
    write(tmp_path / "toy")
    assert read(tmp_path, "toy", box=[-1, -2, -3, 1, 2, 3]).box.high == (1, 2, 3)
    if name == "nhr":  # what its point clouds span, a tenth more on each side
        low, high = nhr_scene.BALLS.min(0), (nhr_scene.BALLS + 2 * nhr_scene.STEP).max(0)
        expected, near = (low - 0.1 * (high - low), high + 0.1 * (high - low)), 1e-6
    else:
        scene, points = read(tmp_path, "toy"), []
        for camera in (frame.camera for frame in scene.train):
            rays = camera.rays()
            points += [rays.origins + d * rays.directions for d in (camera.near, camera.far)]
        points = torch.cat(points)
        # 3 x 3 pixels stand for all; between them the far sphere bulges a little.
        expected, near = (points.amin(0), points.amax(0)), 0.1
    box = read(tmp_path, "toy").box
    for end, found in zip(expected, (box.low, box.high)):
        assert found == pytest.approx(end.tolist(), abs=near)
