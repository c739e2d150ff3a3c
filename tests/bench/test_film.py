"""The film of a phone in a tiny size."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from forewarp.data.posed_video import read_scene
from forewarp.scene.view import Rendering
from tests.bench import film
from tests.support.films import read_film

TINY = film.Form(count=9, size=(36, 64), beside=4)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of a tiny film."""
    folder = tmp_path_factory.mktemp("film")
    film.film(folder, TINY)
    return folder


@pytest.mark.slow
def test_the_film_stands_upright_and_is_what_truth_holds(made):
    frames = read_film(made / "film.mp4", 64, 36)  # turned by its flag
    scene = read_scene(made, "truth", normalise=False)
    assert (len(frames), len(scene.train), len(scene.test), len(scene.val)) == (9, 8, 1, 2)
    for frame in (*scene.train, *scene.test):
        number = film.number_of(frame.name)
        assert frame.time == pytest.approx(number / 8)
        true = frame.load()[..., :3].numpy().astype(float)
        turned = np.abs(frames[number][::-1, ::-1] - true).mean()
        assert np.abs(frames[number] - true).mean() < min(12, 0.3 * turned)
        assert 0.01 < frame.load_moving().float().mean() < 0.06
    assert scene.protocol["seconds"] == pytest.approx(8 / 25)
    assert len(scene.still) > 1000


@pytest.mark.slow
def test_the_shutter_smears_what_moves_and_only_that_counts_as_moving(made):
    filming = film.Filming(replace(film.PHONE, size=TINY.size))
    blurred, moving = filming.take(0.5)
    filming.open = 0 * filming.open
    sharp, same = filming.take(0.5)
    assert (moving & same).sum() > 0.7 * (moving | same).sum()
    away = np.abs(blurred.astype(float) - sharp).mean(-1)
    assert away[moving].mean() > 2 * away[~(moving | same)].mean()


@pytest.mark.slow
def test_views_beside_the_path_are_found_in_any_world(made):
    scene = read_scene(made, "truth")  # moved and scaled
    places = {frame.name: frame.camera for frame in scene.val}
    found = film.beside(scene, made / "truth")
    for frame in found:
        torch.testing.assert_close(frame.camera.camera_to_world, places[frame.name].camera_to_world)
    metres = read_scene(made, "truth", normalise=False)
    path = {film.number_of(frame.name): frame.camera.center for frame in (*metres.train, *metres.test)}
    for view in metres.val:
        assert float((view.camera.center - path[film.number_of(view.name)]).norm()) == pytest.approx(0.3)


class Perfect:
    """Stands for a fitted run that renders what is stored, but for a fault in what moves."""

    device, renderings = torch.device("cpu"), ("rgb",)

    def __init__(self, frames, fault):
        self.method, self.frames, self.fault = self, frames, fault

    def at(self, moment):
        return self

    def holds(self, moment):
        return True

    def render(self, view, background, name):
        (frame,) = (f for f in self.frames if torch.equal(f.camera.center, view.camera.center))
        rgb = frame.load()[..., :3].float() / 255 + self.fault * frame.load_moving()[..., None]
        return Rendering(rgb.reshape(-1, 3), torch.zeros(len(view)), torch.ones(len(view)))


@pytest.mark.slow
def test_scores_tell_what_moves_from_the_rest(made):
    scene = read_scene(made, "truth")
    small = replace(scene, test=tuple(replace(f, camera=f.camera.resized(18, 32)) for f in scene.test))
    assert film.held_out(small, made / "truth")[0].load_moving().shape == (32, 18)
    for frames in (film.held_out(scene, made / "truth"), film.beside(scene, made / "truth")):
        found = film.scores(Perfect(frames, -0.1), frames, torch.ones(3))
        assert found["still"] == 100
        assert 19.5 < found["moving"] < 21.5 < found["all"]
