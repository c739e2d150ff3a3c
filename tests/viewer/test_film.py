from dataclasses import replace
from pathlib import Path
from threading import Thread
from time import monotonic

import pytest
import torch

from forewarp.viewer.desk import Desk, Superseded
from forewarp.viewer.film import FPS, between, write_film
from forewarp.viewer.visit import Visit
from tests.support.fake_studio import FakePage, FakeStudio, Watch
from tests.support.films import read_film
from tests.support.tiny_scene import camera_at


def keys_of(*times):
    visit = Visit(FakeStudio(Watch()), FakePage())
    return [
        replace(visit.look, pose=camera_at(0.2 * i).camera_to_world, time=time, fov=0.5 + 0.1 * i)
        for i, time in enumerate(times)
    ]


@pytest.mark.parametrize("times", [(0.2, 0.9), (0.0, 1.0, 0.3), (0.0, 0.0, 1.0, 1.0)])
def test_a_path_goes_through_its_keys_smoothly(times):
    keys = keys_of(*times)
    looks = between(keys, 20 * (len(keys) - 1) + 1)
    for key, look in zip(keys, looks[::20]):
        torch.testing.assert_close(look.pose, key.pose, atol=1e-6, rtol=0)
        assert (look.time, look.fov) == (pytest.approx(key.time), pytest.approx(key.fov))
    poses = torch.stack([look.pose for look in looks])
    rotations = poses[:, :3, :3]
    torch.testing.assert_close(rotations @ rotations.mT, torch.eye(3).double().expand_as(rotations))
    steps = (poses[1:] - poses[:-1]).abs().amax((1, 2))
    assert float(steps.max()) < 3 * float(steps.median())
    for first, then, part in zip(times, times[1:], range(len(times))):
        within = [look.time for look in looks[20 * part : 20 * part + 21]]
        assert sorted(within, reverse=then < first) == within


def test_a_single_key_makes_no_video():
    with pytest.raises(ValueError, match="and 2 pictures of them, but got 1 key views and 50 pictures"):
        between(keys_of(0.5), 50)


@pytest.mark.parametrize(("seconds", "pictures"), [(1e9, 15_000), (-1.0, 2), (float("nan"), 2)])
def test_a_film_is_as_long_as_it_may_be(tmp_path, seconds, pictures):
    visit, told = Visit(FakeStudio(Watch()), FakePage()), []
    visit.leave()
    with pytest.raises(Superseded):
        write_film(tmp_path, visit, keys_of(0.0, 1.0), seconds, lambda *count: told.append(count))
    assert told == [(0, pictures)]
    assert list(tmp_path.iterdir()) == []


def out_of_memory():
    raise RuntimeError("no memory")


def test_a_film_through_its_keys(tmp_path):
    studio = FakeStudio(Watch())
    studio.desk = Desk(monotonic)
    studio.size = 63  # odd sizes are made even
    Thread(target=studio.desk.serve_forever, daemon=True).start()
    visit, told = Visit(studio, FakePage()), []
    for number in (1, 2):
        file = write_film(tmp_path, visit, keys_of(0.0, 1.0), 0.4, lambda *count: told.append(count))
        assert file == tmp_path / f"path-{number}.mp4"
        film = read_film(file, 64, 84)
        assert len(film) == 0.4 * FPS
        brightness = film.mean((1, 2, 3))
        assert (brightness[1:] > brightness[:-1]).all()
    assert told[:10] == [(i, 10) for i in range(10)]
    page = visit.surface

    def meanwhile(number, of):
        if number == 3:
            page.canvas = lambda: (300, 100)  # the window is resized, and another page makes a film
            write_film(tmp_path, Visit(studio, FakePage()), keys_of(0.0, 1.0), 0.4, lambda *_: None)

    assert write_film(tmp_path, visit, keys_of(0.0, 1.0), 0.4, meanwhile).name == "path-3.mp4"
    assert [len(read_film(tmp_path / f"path-{n}.mp4", 64, 84)) for n in (3, 4)] == [10, 10]
    for number in (3, 4):
        (tmp_path / f"path-{number}.mp4").unlink()
    studio.interrupt = out_of_memory
    with pytest.raises(RuntimeError, match="no memory"):
        write_film(tmp_path, visit, keys_of(0.0, 1.0), 0.4, lambda *_: None)
    studio.interrupt = lambda: told.append("left") or visit.leave()
    with pytest.raises(Superseded):
        write_film(tmp_path, visit, keys_of(0.0, 1.0), 0.4, lambda *_: None)
    assert told[-1] == "left"
    assert sorted(path.name for path in Path(tmp_path).iterdir()) == ["path-1.mp4", "path-2.mp4"]
    studio.desk.close()
