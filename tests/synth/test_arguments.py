"""What all generators share: bad arguments are one line that names the key, equal ones give equal files."""

import filecmp

import pytest

from forewarp.data.files import SceneError
from forewarp.synth import rigs, scenes
from forewarp.synth.module import WRITERS

FEW = {"frames": 2, "test_views": (1, 1, 1), "val_views": 1}
TINY = {
    "dnerf": {"size": 8, **FEW},
    "lego_complete": {"size": 8, "motions": ["lift", "drive"], **FEW},
    "hypernerf": {"size": 16, "frames": 3},
    "nhr": {"size": 24, "frames": 2, "points": 30},
}
BAD = [
    ("dnerf", {"size": 7}, "size: expected a whole number of at least 8, but got 7"),
    ("dnerf", {"frames": 1}, "frames: expected a whole number of at least 2, but got 1"),
    ("dnerf", {"seed": -1}, "seed: expected a whole number of at least 0, but got -1"),
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


@pytest.mark.parametrize(("generator", "change", "text"), BAD)
def test_bad_arguments_get_one_line(tmp_path, generator, change, text):
    with pytest.raises(SceneError, match=text) as caught:
        WRITERS[generator](tmp_path / "scene", **TINY[generator] | change)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "scene").exists()


FILES = {
    "dnerf": 2 + 1 + 2 * 3 + 5 + 1,
    "lego_complete": 2 * 19,
    "hypernerf": 3 * 6 + 5,
    "nhr": 2 * (2 * 20 + 1) + 3,
}


@pytest.mark.parametrize(("generator", "count"), FILES.items())
def test_equal_arguments_give_equal_bytes(tmp_path, monkeypatch, generator, count):
    for module in (scenes, rigs):
        monkeypatch.setattr(module, "POINTS", 200)  # of the trajectories
    arguments = {**TINY[generator], "samples_per_pixel": 1}
    first, again = (WRITERS[generator](tmp_path / name, **arguments) for name in ("first", "again"))
    names = sorted(p.relative_to(first).as_posix() for p in first.rglob("*") if p.is_file())
    assert len(names) == count
    assert filecmp.cmpfiles(first, again, names, shallow=False) == (names, [], [])


def test_a_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(SceneError, match="taken: expected a folder to write to, but got"):
        scenes.synthesize(tmp_path / "taken", **TINY["dnerf"])
