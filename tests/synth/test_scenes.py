import numpy as np
import pytest

from forewarp.data.dnerf import read_scene
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
        pixel, depth = frame.camera.project(frame.camera.center.new_zeros(3))
        assert [*pixel.tolist(), float(depth)] == pytest.approx([8, 8, 4.0311])
        assert frame.camera.camera_to_world[2, 1] < 0  # the image's down points to the ground


def test_another_seed_gives_other_views_and_progress_counts_every_image(folder, tmp_path):
    seen = []
    few = {"frames": 4, "test_views": (1, 0, 1), "val_views": 1}
    other = synthesize(tmp_path / "other", size=8, seed=1, **few, progress=lambda *n: seen.append(n))
    name = "transforms_train.json"
    assert (folder / name).read_bytes() != (other / name).read_bytes()
    assert seen == [(i, 7) for i in range(1, 8)]
