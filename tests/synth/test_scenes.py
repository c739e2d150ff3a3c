"""Scenes in D-NeRF's layout; and what all writers share."""

import filecmp

import numpy as np
import pytest
import torch

from forewarp.data.dnerf import read_lego_complete, read_scene
from forewarp.data.files import SceneError
from forewarp.synth import rigs, scenes
from forewarp.synth.module import WRITERS, write_whole
from forewarp.synth.scenes import synthesize_lego_complete

FEW = {"frames": 2, "test_views": (1, 1, 1), "val_views": 1}
TINY = {
    "dnerf": {"size": 8, **FEW},
    "lego_complete": {"size": 8, "motions": ["lift", "drive"], **FEW},
    "hypernerf": {"size": 16, "frames": 3},
    "nhr": {"size": 24, "frames": 2, "points": 30},
}
BAD = [
    ("dnerf", {"size": 7}, "size: expected a whole number of at least 8, but got 7"),
    ("dnerf", {"motion": "fly"}, "motion: expected one of lift, lift_tilt, drive, still, rigid, band, "),
    ("dnerf", {"test_views": (1, 2)}, "test_views: expected three numbers"),
    ("dnerf", {"test_views": (0, 0, 0)}, "not all 0, but got"),
    ("dnerf", {"test_views": 5}, "test_views: expected three numbers"),
    ("dnerf", {"test_views": (1, -2, 3)}, "test_views: expected a whole number of at least 0, but got -2"),
    ("lego_complete", {"motions": ["fly"]}, "motions: expected one of lift, lift_tilt, drive, but got 'fly'"),
    ("lego_complete", {"motions": []}, "motions: expected a list of"),
    ("lego_complete", {"motions": "lift"}, "motions: expected a list of"),
    ("lego_complete", {"motions": ["lift", "lift"]}, "motions: expected each once"),
    ("lego_complete", {"workers": 0}, "workers: expected a whole number of at least 1, but got 0"),
    ("hypernerf", {"size": 20}, "size: expected a multiple of 8 of at least 16, but got 20; set size"),
    ("hypernerf", {"frames": 4}, "frames: expected an odd number, one in the middle, but got 4; set frames"),
    ("hypernerf", {"motion": "still"}, "motion: expected one of lift, lift_tilt, drive, but got 'still'"),
    ("nhr", {"size": 100}, "size: expected a multiple of 24 of at least 24, but got 100; set size"),
]


@pytest.mark.parametrize(("dataset", "change", "text"), BAD)
def test_bad_arguments_get_one_line(tmp_path, dataset, change, text):
    with pytest.raises(SceneError, match=text) as caught:
        WRITERS[dataset](tmp_path / "scene", **TINY[dataset] | change)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "scene").exists()


FILES = {"dnerf": 2 + 1 + 2 * 3 + 5 + 1, "lego_complete": 2 * 19, "hypernerf": 3 * 6 + 5, "nhr": 2 * 41 + 3}


@pytest.mark.parametrize("dataset", FILES)
def test_equal_arguments_give_equal_bytes(tmp_path, monkeypatch, dataset):
    for module in (scenes, rigs):
        monkeypatch.setattr(module, "POINTS", 200)  # of the trajectories
    arguments = {**TINY[dataset], "samples_per_pixel": 1}
    first, again = (WRITERS[dataset](tmp_path / name, **arguments) for name in ("first", "again"))
    names = sorted(p.relative_to(first).as_posix() for p in first.rglob("*") if p.is_file())
    assert len(names) == FILES[dataset]
    assert filecmp.cmpfiles(first, again, names, shallow=False) == (names, [], [])


def test_a_folder_that_cannot_be_written_to_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SceneError, match="scene: expected a folder to write to, but got"):
        write_whole(tmp_path / "file" / "scene", "dnerf", {**TINY["dnerf"], "samples_per_pixel": 1})


def test_what_is_written_reads_back(tmp_path):
    seen, few = [], {"size": 16, "frames": 4, "test_views": (3, 2, 2), "val_views": 2, "samples_per_pixel": 1}
    for seed in (0, 1):
        scenes.synthesize(tmp_path / f"{seed}", seed=seed, **few, progress=lambda *n: seen.append(n))
    assert seen == 2 * [(i, 13) for i in range(1, 14)]
    scene, other = (read_scene(tmp_path, seed) for seed in "01")
    assert all((a.camera.center != b.camera.center).any() for a, b in zip(scene.train, other.train))
    assert [f.time for f in scene.train] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert [f.ability for f in scene.test] == ["space"] * 3 + ["time"] * 2 + ["canonical"] * 2
    assert [f.time for f in scene.test] == pytest.approx([0, 2 / 3, 1, 1 / 6, 5 / 6, 0, 0])
    assert (len(scene.val), scene.has_alpha, scene.canonical_time) == (2, True, 0)
    assert scene.truth.times.tolist() == pytest.approx(np.linspace(0, 1, 7))
    assert scene.truth.points.shape == (4000, 7, 3)
    for frame in scene.test:
        assert frame.load().shape == (16, 16, 4)
        assert frame.load_depth().max() > 2
        assert frame.camera.center[2] > 0
        pixel, depth = frame.camera.project(frame.camera.center.new_zeros(3))
        assert [*pixel.tolist(), float(depth)] == pytest.approx([8, 8, 4.0311])
        assert frame.camera.camera_to_world[2, 1] < 0  # the image's down points to the ground


def test_the_default_counts_of_lego_complete_are_the_published_ones(monkeypatch, tmp_path):
    written = {}
    monkeypatch.setattr(scenes, "write_worlds", lambda worlds, times, **_: written.update(worlds))
    synthesize_lego_complete(tmp_path)
    assert [folder.name for folder in written] == ["lift", "lift_tilt", "drive"]
    for _, views, _ in written.values():
        counts = {a: sum(v.ability == a for v in views["test"]) for a in ("space", "time", "canonical")}
        assert counts == {"space": 200, "time": 197, "canonical": 50}
        assert len(views["train"]) == len({v.time for v in views["train"]}) == 50
        assert {v.time for v in views["train"]} <= {v.time for v in views["test"] if v.ability == "time"}


def test_every_motion_is_a_scene_of_three_kinds_of_view_whose_depth_true_points_meet(tmp_path):
    few = {"frames": 3, "motions": ["lift", "drive"], "test_views": (2, 4, 3), "val_views": 1}
    synthesize_lego_complete(tmp_path, size=64, samples_per_pixel=1, **few)
    places, shares = [], []
    for name in few["motions"]:
        scene = read_lego_complete(tmp_path, name)
        assert [f.time for f in scene.train] == pytest.approx([0, 0.5, 1])
        times = {a: [f.time for f in scene.test if f.ability == a] for a in ("space", "time", "canonical")}
        assert times["space"] == pytest.approx([0, 0, 0.5, 0.5, 1, 1])
        assert times["time"] == scene.truth.times.tolist() == pytest.approx(np.linspace(0, 1, 9))
        assert times["canonical"] == [0] * 3
        places += [f.camera.center for f in scene.train + scene.test]
        for frame in scene.test:
            step = int((scene.truth.times - frame.time).abs().argmin())
            points, depth = scene.truth.points[:, step].double(), frame.load_depth()
            column, row = frame.camera.project(points)[0].floor().long().clamp(1, 62).unbind(-1)
            around = [depth[row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
            around = torch.stack(around).double()
            distance = (points - frame.camera.center).norm(dim=-1)
            shares.append(float(((distance - around).abs().amin(0) < 0.02).double().mean()))
            around[around == 0] = torch.inf
            assert (distance > around.amin(0) - 0.15).double().mean() > 0.98, frame.name
    assert len(torch.unique(torch.stack(places), dim=0)) == len(places)
    # A pixel is 0.05 units wide here, and on a slab seen from low down a multiple of that deep.
    assert min(shares) > 0.2
    assert np.mean(shares) > 0.38
