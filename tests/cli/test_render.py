import math
from unittest.mock import patch

import imageio.v3 as iio
import pytest

from forewarp.cli import render, train
from forewarp.data.dnerf import Shot, write_scene
from tests.support.films import read_film
from tests.support.tiny_scene import ball_scene

SIZE = 24


def call(script, *words):
    """Run a console script in this process; its exit status."""
    with patch("sys.argv", ["forewarp", *words]), pytest.raises(SystemExit) as leaving:
        script.main()
    return leaving.value.code


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A written ball scene."""
    folder, scene = tmp_path_factory.mktemp("scenes"), ball_scene(size=SIZE)
    splits = {
        split: [Shot(f.name, f.time, f.camera.camera_to_world, f.load()) for f in getattr(scene, split)]
        for split in ("train", "val", "test")
    }
    write_scene(folder / "ball", splits, camera_angle_x=2 * math.atan(0.5 / 1.2))
    return folder


@pytest.fixture(scope="module")
def run(root, tmp_path_factory):
    """A run that was fitted for a moment."""
    folder = tmp_path_factory.mktemp("runs") / "ball"
    words = [
        "experiment=dnerf",
        f"data.root={root}",
        "data.scene=ball",
        "data.near=1",
        "data.far=5.5",
        "data.rays=256",
        "budget.minutes=null",
        "budget.iterations=80",
        "stage.coarse.num_voxels=[[0,4096]]",
        "stage.fine.num_voxels=[[0,8000]]",
        "model.trajectory.nodes=8",
        "evaluate=false",
        "trainer=cpu",
        "threads=1",
    ]
    assert call(train, f"run={folder}", *words) == 0
    return folder


def test_training_left_pictures_and_curves(run):
    for stage in ("coarse", "fine"):
        assert (run / stage / "images" / "100_compare.png").is_file()
        assert list((run / stage / "tensorboard").glob("events.*"))


@pytest.mark.parametrize("path", ["fixed", "orbit", "both", "trajectories"])
def test_a_film_of_each_path(run, path, capsys):
    assert call(render, f"run={run}", f"path={path}", "frames=5", "size=32") == 0
    out, err = capsys.readouterr()
    file = run / "videos" / f"{path}.mp4"
    assert out.strip() == f"written: {file}"
    assert f"{path} 100% | 5/5" in err
    film = read_film(file, 32, 32).astype(float)
    assert len(film) == 5
    assert film.std((1, 2, 3)).min() > 5  # something to be seen in every frame
    assert abs(film[1:] - film[:-1]).max((1, 2, 3)).min() > 10  # which moves


def test_trajectories_are_drawn_over_fixed(run):
    for path in ("fixed", "trajectories"):
        assert call(render, f"run={run}", f"path={path}", "frames=3", "format=png", "size=48") == 0
    plain, drawn = (
        iio.imread(run / "videos" / path / "0002.png").astype(int) for path in ("fixed", "trajectories")
    )
    assert plain.shape == drawn.shape == (48, 48, 3)
    assert (abs(plain - drawn).max(-1) > 20).sum() > 20


def test_a_gif_of_small_images_is_larger(run):
    assert call(render, f"run={run}", "frames=2", "format=gif", "fps=10") == 0
    assert iio.imread(run / "videos" / "fixed.gif").shape[:3] == (2, 400, 400)


def test_large_images_keep_their_size(run, monkeypatch):
    monkeypatch.setattr(render, "LEAST_SIZE", 16)
    assert call(render, str(run), "frames=2", "format=gif") == 0  # a bare folder is one, too
    assert iio.imread(run / "videos" / "fixed.gif").shape[:3] == (2, SIZE, SIZE)


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("path=spiral", "path: expected one of fixed, orbit, both, trajectories, but got 'spiral'"),
        ("time=1.5", "time: expected a number in [0, 1], but got 1.5"),
        ("time=soon", "time: expected a number in [0, 1], but got soon"),
        ("frames=1", "frames: expected a whole number of at least 2, but got 1"),
        ("frames=2.5", "frames: expected a whole number of at least 2, but got 2.5"),
        ("fps=0", "fps: expected a number in [0.1, 1000], but got 0"),
        ("format=avi", "format: expected one of mp4, gif, png, but got 'avi'"),
        ("size=3", "size: expected a whole number of at least 16, but got 3"),
        ("view=99", "view: expected a test view, 0 to 2, but got 99"),
    ],
)
def test_mistakes_end_in_one_line(run, word, says, capsys):
    assert call(render, f"run={run}", word) == 2
    assert capsys.readouterr().err.splitlines() == [f"forewarp-render: error: {says}"]


def test_a_folder_that_is_no_run(tmp_path, capsys):
    assert call(render, f"run={tmp_path}") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(
        f"forewarp-render: error: {tmp_path / 'config.yaml'}: expected the configuration of a run"
    )


def test_a_run_that_is_not_finished(run, tmp_path, capsys):
    (tmp_path / "config.yaml").write_text((run / "config.yaml").read_text())
    assert call(render, f"run={tmp_path}") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"forewarp-render: error: {tmp_path / 'coarse'}: expected a finished stage")
    assert not (tmp_path / "videos").exists()


def test_help(capsys):
    assert call(render, "--help") == 0
    assert "path=trajectories" in capsys.readouterr().out
