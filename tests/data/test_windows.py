"""Windows of a film: which frames they have, and at which times of their own."""

import pytest

from forewarp.data.module import SceneDataModule
from forewarp.data.windows import OVERLAP, cut
from tests.support.tiny_scene import ball_scene
from tests.support.written_scenes import refused


@pytest.fixture(scope="module")
def film():
    return ball_scene(frames=21, size=8)


def test_windows_share_frames_at_their_seam_and_no_test_frame(film):
    first, second = (cut(film, window) for window in ([0, 0.5], [0.5, 1]))
    trained = [{frame.name for frame in part.train} for part in (first, second)]
    assert trained[0] | trained[1] == {frame.name for frame in film.train}
    assert len(trained[0] & trained[1]) == 2 * OVERLAP
    for split in ("val", "test", "held"):
        parts = [[frame.name for frame in getattr(part, split)] for part in (first, second)]
        assert sorted(parts[0] + parts[1]) == sorted(frame.name for frame in getattr(film, split))


def test_a_window_has_a_time_of_its_own_from_0_to_1(film):
    window = cut(film, [0.25, 0.75])
    begin, end = window.protocol["span"]
    assert (window.times[0], window.times[-1]) == (0, 1)
    assert window.canonical_time in window.times
    assert 0.4 < window.canonical_time < 0.6
    known = {frame.name: frame.time for frame in (*film.train, *film.test)}
    for frame in (*window.train, *window.test):
        assert begin + frame.time * (end - begin) == pytest.approx(known[frame.name])
    assert cut(film, None) is film


def test_a_window_of_the_data_module_counts_what_is_its_own():
    def read():
        scene = ball_scene(frames=21, size=8)
        scene.protocol.update(test_frames=len(scene.test), seconds=4.0)
        return scene

    scene = SceneDataModule(read, rays=1, window=[0.5, 1.0], held_out=2).scene
    assert scene.protocol["window"] == [0.5, 1.0]
    assert scene.protocol["test_frames"] == len(scene.test)
    assert scene.protocol["seconds"] == pytest.approx(4.0 * (1 - scene.protocol["span"][0]))
    assert len(scene.held) == 2


@pytest.mark.parametrize("window", [[0.5], "01", [0.5, 0.5], [-0.1, 1], [0, 1.1], [0, True], 0.5])
def test_what_is_no_window_is_refused_in_a_line(film, window):
    with refused(r"^data.window: expected from and to in \[0, 1\]"):
        cut(film, window)


def test_a_window_of_too_few_instants_is_refused(film):
    with refused(r"a window with at least 4 of the film's 21 instants, but got 2 in \[0, 0.1\]"):
        cut(film, [0, 0.1])
