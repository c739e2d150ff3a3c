import filecmp

import numpy as np
import pytest

pytest.importorskip("trimesh")
pytest.importorskip("embreex")

from forewarp.data.dnerf import read_scene
from forewarp.scene.errors import SceneError
from forewarp.synth.cameras import random_cameras
from forewarp.synth.scenes import synthesize

SMALL = {"size": 16, "frames": 4, "test_views": (3, 2, 2), "val_views": 2}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return synthesize(tmp_path_factory.mktemp("synth") / "scene", **SMALL)


def test_what_is_written_reads_back(folder):
    scene = read_scene(folder.parent, folder.name)
    assert [f.time for f in scene.train] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert [f.ability for f in scene.test] == ["space"] * 3 + ["time"] * 2 + ["canonical"] * 2
    assert [f.time for f in scene.test] == pytest.approx([0, 2 / 3, 1, 1 / 6, 5 / 6, 0, 0])
    assert len(scene.val) == 2
    assert scene.has_alpha
    assert scene.canonical_time == 0
    assert scene.truth.times.tolist() == pytest.approx(np.linspace(0, 1, 7))
    assert scene.truth.points.shape == (4000, 7, 3)
    for frame in scene.test:
        assert frame.load().shape == (16, 16, 4)
        assert frame.load_depth().max() > 2
        assert float(frame.camera.center.norm()) == pytest.approx(4.0311)
        assert frame.camera.center[2] > 0


def test_equal_arguments_give_equal_bytes(folder, tmp_path):
    again = synthesize(tmp_path / "again", **SMALL)
    names = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(again).as_posix() for p in again.rglob("*") if p.is_file())
    assert len(names) == 4 + 2 + 2 * 7 + 5 + 1
    assert filecmp.cmpfiles(folder, again, names, shallow=False) == (names, [], [])


def test_another_seed_gives_other_views_and_progress_counts_every_image(folder, tmp_path):
    seen = []
    few = {"frames": 4, "test_views": (1, 0, 1), "val_views": 1}
    other = synthesize(tmp_path / "other", size=8, seed=1, **few, progress=lambda *n: seen.append(n))
    name = "transforms_train.json"
    assert (folder / name).read_bytes() != (other / name).read_bytes()
    assert seen == [(i, 7) for i in range(1, 8)]


def test_cameras_look_at_the_middle_from_above():
    for camera in random_cameras(20, 10, np.random.default_rng(0)):
        pixel, depth = camera.project(camera.center.new_zeros(3))
        assert pixel.tolist() == pytest.approx([5, 5])
        assert float(depth) == pytest.approx(4.0311)
        assert camera.camera_to_world[2, 1] < 0  # the image's down points to the ground


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"size": 7}, "size: expected a whole number of at least 8, but got 7"),
        ({"size": 20.5}, "size: expected a whole number"),
        ({"frames": 1}, "frames: expected a whole number of at least 2, but got 1"),
        ({"seed": -1}, "seed: expected a whole number of at least 0, but got -1"),
        (
            {"motion": "fly"},
            "motion: expected one of lift, lift_tilt, drive, still, rigid, band, glossy, room, quick",
        ),
        ({"test_views": (1, 2)}, "test_views: expected three numbers"),
        ({"test_views": (0, 0, 0)}, "not all 0, but got"),
        ({"test_views": 5}, "test_views: expected three numbers"),
        ({"test_views": (1, -2, 3)}, "test_views: expected a whole number of at least 0, but got -2"),
        ({"samples_per_pixel": 0}, "samples_per_pixel: expected a whole number of at least 1, but got 0"),
    ],
)
def test_bad_arguments_get_one_line(tmp_path, change, text):
    with pytest.raises(SceneError, match=text.replace("(", r"\(")) as caught:
        synthesize(tmp_path / "scene", **{**SMALL, **change})
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "scene").exists()


def test_a_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(SceneError, match="taken: expected a folder to write to, but got"):
        synthesize(tmp_path / "taken", **SMALL)
