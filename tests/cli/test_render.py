import shutil

import imageio.v3 as iio
import pytest

from forewarp.cli import render
from tests.support.films import read_film

SIZE = 32


@pytest.fixture(scope="module")
def run(fitted, tmp_path_factory):
    """A copy of the shared run."""
    return shutil.copytree(fitted, tmp_path_factory.mktemp("runs") / "vehicle")


@pytest.mark.slow
@pytest.mark.parametrize("path", ["orbit", "both"])
def test_a_film_of_each_path(forewarp, run, path):
    done = forewarp("render", f"run={run}", f"path={path}", "frames=5", "size=32")
    file = run / "videos" / f"{path}.mp4"
    assert done.out.strip() == f"written: {file}"
    assert f"{path} 100% | 5/5" in done.err
    film = read_film(file, 32, 32).astype(float)
    assert len(film) == 5
    assert film.std((1, 2, 3)).min() > 5  # something to be seen in every frame
    assert abs(film[1:] - film[:-1]).max((1, 2, 3)).min() > 10  # which moves


@pytest.mark.slow
def test_trajectories_are_drawn_over_fixed(ok, run):
    for path in ("fixed", "trajectories"):
        ok("render", f"run={run}", f"path={path}", "frames=3", "format=png", "size=48")
    files = (run / f"videos/{path}/0002.png" for path in ("fixed", "trajectories"))
    plain, drawn = (iio.imread(file).astype(int) for file in files)
    assert plain.shape == drawn.shape == (48, 48, 3)
    assert (abs(plain - drawn).max(-1) > 20).sum() > 20


@pytest.mark.slow
def test_a_gif_of_small_images_is_larger_and_large_images_keep_their_size(ok, run, monkeypatch):
    for least, side in ((render.LEAST_SIZE, 400), (16, SIZE)):
        monkeypatch.setattr(render, "LEAST_SIZE", least)
        ok("render", str(run), "frames=2", "format=gif")  # a bare folder is one, too
        assert iio.imread(run / "videos" / "fixed.gif").shape[:3] == (2, side, side)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("word", "says"),
    [
        (
            "path=spiral",
            "path: expected as_filmed, stabilised, lean, fixed, swing, orbit, both or trajectories, but",
        ),
        ("path=lean", "path: expected fixed, swing, orbit, both or trajectories, as no one camera filmed"),
        ("fps=0", "fps: expected a number in [0.1, 1000], but got 0"),
        ("format=avi", "format: expected mp4, gif or png, but got 'avi'"),
        ("format=html", "format: expected mp4, gif or png, but got 'html'; it is written by forewarp-export"),
        ("layer=still", "layer: expected all, moving or resting, but got 'still'"),
        ("masks=folder", "masks: expected true or false, but got 'folder'"),
        ("view=99", "view: expected a test view, 0 to 4, but got 99"),
    ],
)
def test_mistakes_end_in_one_line(refused, run, word, says):
    assert refused("render", f"run={run}", word).startswith(says)
