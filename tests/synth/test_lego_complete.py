import numpy as np
import pytest
import torch

from forewarp.data.dnerf import read_lego_complete as read_scene
from forewarp.synth.scenes import _views, synthesize_lego_complete

SMALL = {"size": 64, "frames": 3, "motions": ["lift", "drive"], "test_views": (2, 4, 3), "val_views": 1}
SMALL["samples_per_pixel"] = 1


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return synthesize_lego_complete(tmp_path_factory.mktemp("synth") / "scenes", **SMALL)


def test_every_motion_is_a_scene_with_three_kinds_of_view(folder):
    assert sorted(p.name for p in folder.iterdir()) == ["drive", "lift"]
    places = []
    for name in SMALL["motions"]:
        scene = read_scene(folder, name)
        assert [f.time for f in scene.train] == pytest.approx([0, 0.5, 1])
        times = {a: [f.time for f in scene.test if f.ability == a] for a in ("space", "time", "canonical")}
        assert times["space"] == pytest.approx([0, 0, 0.5, 0.5, 1, 1])
        assert times["time"] == pytest.approx(np.linspace(0, 1, 9))
        assert times["canonical"] == [0] * 3
        assert scene.truth.times.tolist() == pytest.approx(np.linspace(0, 1, 9))
        places += [f.camera.center for f in scene.train + scene.test]
    assert len(torch.unique(torch.stack(places), dim=0)) == len(places)


def test_the_default_counts_are_the_published_ones():
    views = _views((0, 100), 8, np.linspace(0, 1, 197), 4, (4, 4, 50), 0)
    counts = {a: sum(v.ability == a for v in views["test"]) for a in ("space", "time", "canonical")}
    assert counts == {"space": 200, "time": 197, "canonical": 50}
    assert len(views["train"]) == len({v.time for v in views["train"]}) == 50
    assert {v.time for v in views["train"]} <= {v.time for v in views["test"] if v.ability == "time"}


@pytest.mark.parametrize("name", SMALL["motions"])
def test_true_points_meet_the_depth_maps(folder, name):
    scene, shares = read_scene(folder, name), []
    for frame in scene.test:
        step = int((scene.truth.times - frame.time).abs().argmin())
        points, depth = scene.truth.points[:, step].double(), frame.load_depth()
        pixel, _ = frame.camera.project(points)
        column, row = pixel.floor().long().clamp(1, 62).unbind(-1)
        around = torch.stack([depth[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]).double()
        distance = (points - frame.camera.center).norm(dim=-1)
        seen = (distance - around).abs().amin(0) < 0.02
        shares.append(float(seen.double().mean()))
        around[around == 0] = torch.inf
        assert (distance > around.amin(0) - 0.15).double().mean() > 0.98, frame.name
    # A pixel is 0.05 units wide here, and on a slab seen from low down a multiple of that deep.
    assert min(shares) > 0.2
    assert np.mean(shares) > 0.38
