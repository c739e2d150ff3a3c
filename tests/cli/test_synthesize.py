import json

import pytest

from forewarp.cli.synthetic import SyntheticDataModule
from forewarp.data.dnerf import read_scene
from forewarp.scene.errors import SceneError

SMALL = ["size=16", "frames=3", "test_views=[1,1,1]", "val_views=0", "samples_per_pixel=1"]
ARGUMENTS = {"size": 16, "frames": 3, "test_views": [1, 1, 1], "val_views": 0, "samples_per_pixel": 1}


def test_writes_a_scene_that_reads(forewarp, in_tmp):
    done = forewarp("synthesize", "folder=a/s", *SMALL)
    assert (done.status, done.out) == (0, "written: a/s\n")
    scene = read_scene("a", "s")
    assert (len(scene.train), len(scene.test), scene.train[0].camera.width) == (3, 3, 16)
    assert [path.name for path in in_tmp.joinpath("a").iterdir()] == ["s"]


def test_keeps_a_scene_unless_told_otherwise(forewarp, refused, in_tmp):
    forewarp("synthesize", "folder=s", *SMALL)
    assert "s: expected a new or empty folder" in refused("synthesize", "folder=s", *SMALL, "seed=1")
    assert json.loads((in_tmp / "s" / "synthesis.json").read_text())["seed"] == 0
    assert forewarp("synthesize", "folder=s", *SMALL, "seed=1", "overwrite=true").status == 0
    assert json.loads((in_tmp / "s" / "synthesis.json").read_text())["seed"] == 1


def test_never_overwrites_what_is_no_scene(refused, in_tmp):
    (in_tmp / "s").mkdir()
    (in_tmp / "s" / "thesis.txt").write_text("dear")
    assert "expected a new or empty folder" in refused("synthesize", "folder=s", *SMALL, "overwrite=true")
    assert (in_tmp / "s" / "thesis.txt").read_text() == "dear"
    assert "expected a folder, but got the file" in refused("synthesize", "folder=s/thesis.txt")


@pytest.mark.parametrize(
    ("argument", "line"),
    [
        ("motion=fly", "motion: expected one of"),
        ("size=2", "size: expected a whole number of at least 8, but got 2"),
    ],
)
def test_bad_arguments_leave_nothing(refused, in_tmp, argument, line):
    assert line in refused("synthesize", "folder=s", argument)
    assert list(in_tmp.iterdir()) == []


def test_a_missing_extra_is_named(refused, in_tmp, monkeypatch):
    def absent(*_, **__):
        raise ImportError("expected trimesh and embreex; pip install 'forewarp[synth]'")

    monkeypatch.setattr("forewarp.cli.synthetic.synthesize", absent)
    assert refused("synthesize", "folder=s") == "expected trimesh and embreex; pip install 'forewarp[synth]'"


def test_the_data_module_writes_the_scene_at_first_use(tmp_path, capsys):
    data = SyntheticDataModule(tmp_path, "s", synthesis=ARGUMENTS, rays=8)
    assert not (tmp_path / "s").exists()
    data.setup("fit")
    assert len(data.scene.train) == 3
    before = (tmp_path / "s" / "transforms_train.json").stat().st_mtime_ns
    SyntheticDataModule(tmp_path, "s", synthesis=ARGUMENTS, rays=8).setup("fit")
    assert (tmp_path / "s" / "transforms_train.json").stat().st_mtime_ns == before
    assert "writing s 100%" in capsys.readouterr().err


def test_a_scene_made_otherwise_is_refused(tmp_path, capsys):
    SyntheticDataModule(tmp_path, "s", synthesis=ARGUMENTS).setup("fit")
    other = SyntheticDataModule(tmp_path, "s", synthesis=ARGUMENTS | {"frames": 4})
    with pytest.raises(
        SceneError, match=r"synthesis\.json: frames: expected 4, but got 3; use another data\.scene"
    ):
        other.setup("fit")
