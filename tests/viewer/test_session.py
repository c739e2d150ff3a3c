from dataclasses import replace
from functools import partial
from threading import Thread
from time import monotonic

import pytest
import torch

from forewarp.scene.film import FilmPath
from forewarp.viewer import session as session_module
from forewarp.viewer.queue import FRAME_SECONDS, Cancelled, RenderQueue
from forewarp.viewer.session import LEAN_SECONDS, MIN_INTERVAL, REST_SECONDS, Session, camera_path
from tests.support.fakes import FakePage, FakeViewer, Watch
from tests.support.films import read_film
from tests.support.tiny_scene import camera_at


@pytest.fixture
def watch():
    return Watch()


@pytest.fixture
def viewer(watch):
    return FakeViewer(watch, cost=2e-6)  # full images take 0.43 s


def session_of(viewer):
    page = FakePage()
    session = Session(viewer, page, clock=viewer.watch)
    session.change(time=0.0)
    return session, page


def run(viewer, jobs=100):
    done = 0
    while done < jobs and viewer.queue.run_next():
        done += 1
    return done


@pytest.fixture(autouse=True)
def _as_fast_as_it_can(monkeypatch):
    monkeypatch.setattr(session_module, "MIN_INTERVAL", 0.0)


def test_thirty_images_a_second_are_enough_and_quick_ones_are_full_at_once(watch, monkeypatch):
    monkeypatch.setattr(session_module, "MIN_INTERVAL", MIN_INTERVAL)
    viewer = FakeViewer(watch, cost=1e-9)
    session, page = session_of(viewer)
    session.play(True)
    begun = watch.now
    while watch.now < begun + 1:
        viewer.queue.run_next()
        watch.now += 0.001
    assert 27 <= len(page.images) <= 31
    assert page.images[-1][:2] == ((400, 533), True)
    session.play(False)
    run(viewer)
    watch.now += REST_SECONDS
    assert run(viewer) == 0


def test_small_while_moving_and_full_at_rest(viewer, watch):
    session, page = session_of(viewer)
    for step in range(30):
        session.change(time=step / 30)
        begun = watch.now
        run(viewer)
    assert 0.6 * FRAME_SECONDS < watch.now - begun < 1.2 * FRAME_SECONDS  # ten a second
    assert [(rest, time) for _, rest, time in page.images] == [(False, round(i / 30, 3)) for i in range(30)]
    (height, width), _, _ = page.images[0]
    assert height < 400
    assert abs(width / height - 4 / 3) < 0.01
    watch.now += REST_SECONDS
    run(viewer)
    assert page.images[30:] == [((400, 533), True, round(29 / 30, 3))]
    assert run(viewer) == 0
    assert "533 x 400, exact" in page.said[-1]
    assert "drawing 533 x 400" in page.said[-2]
    assert page.said[0].endswith("small while moving")


def test_what_came_in_between_is_dropped(viewer, watch):
    session, page = session_of(viewer)
    for step in range(10):
        session.change(time=step / 10)
    run(viewer)
    assert [time for _, _, time in page.images] == [0.9]
    watch.now += REST_SECONDS
    viewer.interrupt = lambda: session.change(time=0.5)  # while the full image is rendered
    run(viewer, 1)
    viewer.interrupt = None
    assert len(page.images) == 1
    run(viewer)
    assert page.images[-1][1:] == (False, 0.5)


@pytest.mark.parametrize("loop", [True, False])
def test_it_plays_and_follows_the_time(viewer, watch, loop):
    session, page = session_of(viewer)
    session.loop = loop
    session.change(time=0.9)
    session.play(True)
    run(viewer, 200)
    for time, (_, _, shown) in zip(page.times, page.images[-len(page.times) :]):
        assert time == pytest.approx(shown, abs=0.002)
    if loop:
        assert session.playing
        assert min(page.times) < 0.1
        session.play(False)
        run(viewer, 3)
    assert not session.playing
    assert page.plays == ([] if loop else [False])
    assert loop or page.times[-1] == 1.0
    before = session.state.time
    watch.now += 10 * REST_SECONDS
    run(viewer)
    assert session.state.time == before
    assert page.images[-1][1] is True
    session.change(time=1.0)
    session.play(True)
    assert session.state.time == (1.0 if loop else 0.0)  # at the end: again from the beginning


def test_another_speed_or_time_goes_on_from_where_time_is(viewer, watch):
    session, page = session_of(viewer)
    session.change(time=0.2)
    session.play(True)
    watch.now += 0.1 * viewer.seconds
    session.set_speed(2.0)
    watch.now += 0.1 * viewer.seconds
    session.change(fov=0.5)
    run(viewer, 1)
    assert page.times == [pytest.approx(0.3), pytest.approx(0.5, abs=0.01)]
    session.change(time=0.8)
    run(viewer, 1)
    assert page.times[-1] == pytest.approx(0.8, abs=0.02)


def test_it_plays_also_if_started_just_before_the_image_at_rest_is_asked_for(viewer, watch):
    session, page = session_of(viewer)
    submit = viewer.queue.submit

    def late(page, kind, job, **when):
        if isinstance(job, partial) and not session.playing:
            session.play(True)
        submit(page, kind, job, **when)

    viewer.queue.submit = late
    run(viewer, 1)
    watch.now += REST_SECONDS
    run(viewer, 3)
    assert len(page.times) > 1


def test_a_page_that_leaves_is_asked_nothing_more(viewer, watch):
    session, page = session_of(viewer)
    run(viewer, 1)
    session.closed = True  # and what it asks for at the same moment comes after all else was dropped
    watch.now += REST_SECONDS
    assert run(viewer) == 1
    assert len(page.images) == 1
    session.closed = False
    session.play(True)
    viewer.interrupt = session.close
    run(viewer, 50)
    session.refresh()  # a last event of a page that is gone
    run(viewer)
    assert len(page.images) == 1


def test_a_training_view_is_left_by_a_new_camera_time_or_channel(viewer, watch):
    session, page = session_of(viewer)
    frame = viewer.scene.train[2]
    for change in ({"time": 0.1}, {"pose": session.state.pose}, {"channel": "depth"}):
        session.show_training_view(2)
        assert session.state.training_view == 2
        assert session.state.time == frame.time
        assert session.state.pose is frame.camera.camera_to_world
        run(viewer)
        assert f"training image {frame.name}: truth, prediction, error" in page.said[-1]
        session.change(**change)
        assert session.state.training_view is None
    session.show_training_view(1)
    session.change(trajectories=True)
    assert session.state.training_view == 1
    session.play(True)
    assert session.state.training_view is None
    session.show_training_view(1)
    assert not session.playing
    session.follow(0.5, 0.5)  # not in a comparison
    run(viewer)
    assert session.state.followed == ()
    assert session.show_training_view(None) is session.state.training_view is None


def test_a_training_view_or_a_time_that_is_none_becomes_the_nearest(viewer):
    session, _ = session_of(viewer)
    assert [session.show_training_view(index) for index in (-1, 3, 4, 10**9)] == [0, 3, 3, 3]
    for time, nearest in ((-0.5, 0.0), (7.0, 1.0), (float("nan"), 0.0)):
        session.change(time=time)
        assert session.state.time == nearest


def test_a_clicked_point_is_added_to_those_followed(viewer):
    session, page = session_of(viewer)
    session.change(time=0.25)
    for x in (0.5, 0.95, 0.25):
        session.follow(x, 0.5)
        run(viewer)
    assert session.state.followed == (((0.5, 0.5, 0.0), 0.25), ((0.25, 0.5, 0.0), 0.25))
    assert "nothing solid there to follow; press the button again" in page.said


def test_a_browser_draws_splats_by_itself_but_no_training_view(viewer, watch):
    session, page = session_of(viewer)
    session.change(channel="splats", time=0.5)
    run(viewer)
    watch.now += 10
    run(viewer)
    assert page.images == ["splats at 0.5"]
    assert "one colour from all sides" in page.said[-1]
    session.show_training_view(2)
    run(viewer)
    watch.now += REST_SECONDS
    run(viewer)
    assert page.images[-1][:2] == ((400, 533), True)


def test_without_a_method_it_says_why(viewer):
    viewer.renderers, viewer.note = [], "waiting for the first step"
    _, page = session_of(viewer)
    run(viewer)
    assert page.said == ["waiting for the first step"]
    assert page.images == []


def keys_of(*times):
    state = Session(FakeViewer(), FakePage()).state
    return [
        replace(state, pose=camera_at(0.2 * i).camera_to_world, time=time, fov=0.5 + 0.1 * i)
        for i, time in enumerate(times)
    ]


@pytest.mark.parametrize("times", [(0.2, 0.9), (0.0, 1.0, 0.3), (0.0, 0.0, 1.0, 1.0)])
def test_a_path_goes_through_its_keys_smoothly(times):
    keys = keys_of(*times)
    states = camera_path(keys, 20 * (len(keys) - 1) + 1)
    for key, state in zip(keys, states[::20]):
        torch.testing.assert_close(state.pose, key.pose, atol=1e-6, rtol=0)
        assert (state.time, state.fov) == (pytest.approx(key.time), pytest.approx(key.fov))
    poses = torch.stack([state.pose for state in states])
    rotations = poses[:, :3, :3]
    torch.testing.assert_close(rotations @ rotations.mT, torch.eye(3).double().expand_as(rotations))
    steps = (poses[1:] - poses[:-1]).abs().amax((1, 2))
    assert float(steps.max()) < 3 * float(steps.median())
    for first, then, part in zip(times, times[1:], range(len(times))):
        within = [state.time for state in states[20 * part : 20 * part + 21]]
        assert sorted(within, reverse=then < first) == within


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "images"), [(1e9, 15_000), (-1.0, 2), (float("nan"), 2)])
def test_a_video_is_as_long_as_it_may_be_and_has_two_keys(tmp_path, seconds, images):
    session, progress = Session(FakeViewer(), FakePage()), []
    session.close()
    with pytest.raises(Cancelled):
        session.write_video(tmp_path, keys_of(0.0, 1.0), seconds, lambda *done: progress.append(done))
    assert progress == [(0, images)]
    with pytest.raises(ValueError, match=f"2 images of them, but got 1 key views and {images} images"):
        session.write_video(tmp_path, keys_of(0.5), seconds, print)
    assert list(tmp_path.iterdir()) == []


def test_a_video_through_its_keys(tmp_path):
    viewer = FakeViewer()
    viewer.queue, viewer.rows = RenderQueue(monotonic), 63  # odd sizes are made even
    Thread(target=viewer.queue.run_forever, daemon=True).start()
    session, keys, progress = Session(viewer, FakePage()), keys_of(0.0, 1.0), []

    def meanwhile(done, total):
        progress.append((done, total))
        if done == 3:  # the window is resized, and another page makes a video
            session.page.canvas = lambda: (300, 100)
            Session(viewer, FakePage()).write_video(tmp_path, keys, 0.2, lambda *_: None)

    assert session.write_video(tmp_path, keys, 0.4, meanwhile) == tmp_path / "path-1.mp4"
    assert progress == [(i, 10) for i in range(10)]
    film = read_film(tmp_path / "path-1.mp4", 64, 84)
    assert len(film) == 10
    brightness = film.mean((1, 2, 3))
    assert (brightness[1:] > brightness[:-1]).all()
    assert len(read_film(tmp_path / "path-2.mp4", 64, 84)) == 5

    def out_of_memory():
        raise RuntimeError("no memory")

    viewer.interrupt = out_of_memory
    with pytest.raises(RuntimeError, match="no memory"):
        session.write_video(tmp_path, keys, 0.4, lambda *_: None)
    viewer.interrupt = session.close
    with pytest.raises(Cancelled):
        session.write_video(tmp_path, keys, 0.4, lambda *_: None)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["path-1.mp4", "path-2.mp4"]
    viewer.queue.close()


def test_an_image_is_no_wider_than_a_screen_whatever_a_browser_tells():
    viewer = FakeViewer()
    viewer.rows = 720
    session = Session(viewer, FakePage())
    for canvas, size in (
        ((1280, 720), (1280, 720)),
        ((3_000_000, 10), (2880, 1)),
        ((2, 3_000_000), (1, 2880)),
        ((400, 800), (720, 1440)),  # square images, whole on a canvas half as wide as high
    ):
        session.page.canvas = lambda canvas=canvas: canvas
        assert session.full_size() == size


def test_a_lean_from_a_film_springs_back_after_a_moment(viewer, watch):
    viewer.film = FilmPath.of([camera_at(0.02 * i) for i in range(9)], [i / 8 for i in range(9)])
    session, page = session_of(viewer)
    assert session.state.lean == (0.0, 0.0)
    session.lean(40.0, 5.0, 1.5)
    run(viewer)
    camera = replace(viewer.film.at(0.0), camera_to_world=session.state.pose)
    assert 7 < viewer.film.beside(camera, 0.0) < 8.001
    assert page.gone == 0
    watch.now += LEAN_SECONDS
    for _ in range(30):
        run(viewer)
        watch.now += REST_SECONDS
    assert page.gone > 0
    assert (session.state.lean, session.state.zoom) == ((0.0, 0.0), 1.5)
    session.change(time=0.5)
    run(viewer)
    torch.testing.assert_close(session.state.pose, viewer.film.at(0.5).camera_to_world)
