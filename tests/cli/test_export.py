import json
import shutil

import numpy as np
import pytest
from plyfile import PlyData

from forewarp import load


@pytest.fixture(scope="module")
def run(fitted, tmp_path_factory):
    """A copy of the shared run."""
    return shutil.copytree(fitted, tmp_path_factory.mktemp("runs") / "vehicle")


def test_it_fills_the_runs_folder_and_says_so(forewarp, run):
    for times, count in (("times=2", 2), ("times=[0.25]", 1)):
        done = forewarp("export", str(run), times)
        folder = run / "exports" / "ply"
        assert done.out.startswith(f"written: {folder}: {count} file"), done
        assert f"ply 100% | {count}/{count}" in done.err
        assert len(list(folder.glob("frames/*.ply"))) == count  # nothing of a call before stays
    about = json.loads((folder / "about.json").read_text())
    assert about["times"] == [0.25]
    assert about["method"] == "forward"
    assert len(PlyData.read(folder / "frames" / "frame_0000.ply")["vertex"]) == about["points"]


def test_trajectories_are_those_of_the_run(ok, run, tmp_path):
    ok(
        "export",
        f"run={run}",
        "format=npz",
        "times=[0,1]",
        "points=20",
        "views=1",
        f"out={tmp_path / 'here'}",
    )
    found = np.load(tmp_path / "here" / "trajectories.npz")
    scene = load(run)
    wanted = scene.trajectories(scene.matter().points.new_tensor(found["points"]), [0.0, 1.0])
    np.testing.assert_allclose(found["positions"], wanted, atol=1e-5)


def test_the_background_is_that_of_the_runs_pictures(ok, run, tmp_path, monkeypatch):
    dark = shutil.copytree(run, tmp_path / "dark")
    text = (dark / "config.yaml").read_text()
    assert "eval_background: white" in text
    (dark / "config.yaml").write_text(text.replace("eval_background: white", "eval_background: black"))
    found = []

    def write(kind, source, *rest, **options):
        found.append(source.background)
        return {"bytes": {}}

    monkeypatch.setattr("forewarp.export.formats.write", write)
    for folder in (run, dark):
        ok("export", f"run={folder}", "times=1")
    assert found == [(1, 1, 1), (0, 0, 0)]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["format=stl"], "format: expected one of ply, mesh, gltf, html, npz, but got 'stl'"),
        (["times=0"], "times: expected a whole number of at least 1, or a list, but got 0"),
        (["times=[0,2]"], "times: expected numbers in [0, 1], but got [0, 2]"),
        (["times=[1,0]"], "times: expected each later than the one before, but got [1, 0]"),
        (["times=[]"], "times: expected numbers in [0, 1], but got []"),
        (["points=9"], "points: expected an option of format=ply (degree, up); leave it out"),
        (["degree=4"], "degree: expected a whole number from 0 to 3, but got 4"),
        (["format=npz", "points=0"], "points: expected a whole number from 1 to 1000000, but got 0"),
        (["format=mesh", "files=stl"], "files: expected ply or obj, but got stl"),
        (["format=mesh", "level=1"], "level: expected a number from 0.01 to 0.99, but got 1"),
        (["out=."], "but got a file in it; move it, or choose another"),
    ],
)
def test_mistakes_end_in_one_line(refused, run, words, says, in_tmp):
    (in_tmp / "a file").touch()
    assert says in refused("export", f"run={run}", *words)
    assert [file.name for file in in_tmp.iterdir()] == ["a file"]


def test_a_run_that_is_not_finished_is_refused(refused, run, tmp_path):
    half = shutil.copytree(run, tmp_path / "half")
    (half / "fine" / "done.json").unlink()
    said = refused("export", f"run={half}")
    assert said == f"{half}/fine: expected a finished stage, but got none; continue with forewarp-train"
