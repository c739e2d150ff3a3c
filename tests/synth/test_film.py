from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from forewarp.synth import film as of_film
from forewarp.synth.film import Exposure, Film, ImageSpec
from forewarp.synth.scenes import random_cameras
from forewarp.synth.world import World

CAMERAS = random_cameras(9, 12, np.random.default_rng(0))
VIEWS = [ImageSpec(str(i), i / 8, camera) for i, camera in enumerate(CAMERAS)]


@pytest.mark.parametrize("kind", ["threads", pytest.param("processes", marks=pytest.mark.slow)])
def test_the_number_of_processes_does_not_matter(monkeypatch, kind):
    """And an error in a process is the caller's. Threads take the processes' place, which start slowly."""
    if kind == "threads":
        monkeypatch.setattr(of_film, "ProcessPoolExecutor", lambda workers, *_: ThreadPoolExecutor(workers))
    seen, world = {1: [], 2: []}, World("drive")
    with Film(Exposure(2, 3), CAMERAS, 1, lambda *n: seen[1].append(n)) as film:
        alone = list(film.pictures(world, VIEWS))
    with Film(Exposure(2, 3), CAMERAS, 2, lambda *n: seen[2].append(n)) as film:
        together = list(film.pictures(world, VIEWS))
        with pytest.raises(AttributeError):
            list(film.pictures(world, [ImageSpec("", 0.5, None)]))
    assert seen[1] == seen[2] == [(i, 9) for i in range(1, 10)]
    assert len(alone) == len(together) == len({rgba.tobytes() for rgba, _ in alone}) == 9
    for one, other in zip(alone, together):
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])


def test_processes_are_for_much_work_and_never_more_than_processors(monkeypatch):
    monkeypatch.setattr(of_film, "cores", lambda: 3)
    assert [of_film._worth(samples) for samples in (0, 6e7, 9e7, 1e12)] == [1, 1, 2, 3]
    assert Film(Exposure(), CAMERAS).workers == 1
