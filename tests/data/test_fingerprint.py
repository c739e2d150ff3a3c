import os

import pytest

from forewarp.data.files import MOST_BYTES, difference, fingerprint
from forewarp.data.module import DNeRFDataModule, SceneDataModule
from tests.support.dnerf_scene import write_tiny


@pytest.fixture
def scene(tmp_path):
    return write_tiny(tmp_path / "a")


def append(path):
    path.write_bytes(path.read_bytes() + b" ")


CHANGES = {
    "text": (lambda f: append(f / "transforms_val.json"), "transforms_val.json"),
    "gone": (lambda f: (f / "transforms_val.json").unlink(), "transforms_val.json"),
    "size": (lambda f: append(f / "train" / "r_0.png"), "images: 9 files of"),
    "fewer": (lambda f: (f / "train" / "r_0.png").unlink(), "images: 8 files of"),
    "name": (lambda f: (f / "train" / "r_0.png").rename(f / "train" / "r_9.png"), "images: 9 files of"),
    "new": (lambda f: (f / "b.json").write_text("{}"), "b.json"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_is_seen_and_named(scene, change):
    before = fingerprint(scene)
    assert difference(before, fingerprint(scene)) is None
    CHANGES[change][0](scene)
    assert difference(before, fingerprint(scene)).startswith(CHANGES[change][1])


def test_what_is_no_part_of_the_scene_does_not_count(scene):
    before, run = fingerprint(scene), scene / "runs" / "a"
    others = [scene / name for name in (".cache.json", ".hidden/a.png", "notes.md")]
    for path in (*others, *(run / name for name in (".lock", "data.json", "metrics.json", "images/0.png"))):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("{}")
    os.utime(scene / "transforms_train.json")
    assert fingerprint(scene) == before
    (scene / ".lock").write_text("")  # a scene that is locked is still one
    (scene / "new.json").write_text("{}")
    assert difference(before, fingerprint(scene)) == "new.json"


def test_a_text_too_large_to_read_counts_by_its_size(scene):
    large, before = scene / "sparse" / "images.txt", fingerprint(scene)
    large.parent.mkdir()
    large.touch()
    os.truncate(large, MOST_BYTES + 1)
    found = fingerprint(scene)
    assert found["texts"] == before["texts"]
    assert found["images"]["bytes"] == before["images"]["bytes"] + MOST_BYTES + 1
    os.truncate(large, MOST_BYTES + 2)
    assert difference(found, fingerprint(scene)).startswith("images: 10 files of")


def test_links_count_as_what_they_lead_to_and_may_go_in_circles(scene, tmp_path):
    before = fingerprint(scene)
    (scene / "train").rename(tmp_path / "elsewhere")
    (scene / "train").symlink_to(tmp_path / "elsewhere")
    assert fingerprint(scene) == before
    (scene / "round").symlink_to(scene)
    assert fingerprint(scene) == before


def test_a_data_module_knows_its_files(scene):
    module = DNeRFDataModule(scene.parent, "a", box=[-1, -1, -1, 1, 1, 1])
    assert module.fingerprint() == fingerprint(scene)
    assert SceneDataModule(lambda: None).fingerprint() is None
