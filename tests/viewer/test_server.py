"""Where the page listens, and that a run in training is the same with it."""

import contextlib
import errno
import os
import socket
import threading
import urllib.request
from dataclasses import replace
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="no viser: pip install forewarp[viewer]")

import viser

from forewarp.viewer import live as live_view
from forewarp.viewer.address import check_address
from forewarp.viewer.controls import Controls
from forewarp.viewer.desk import Superseded
from forewarp.viewer.look import first_look
from forewarp.viewer.page import Page
from forewarp.viewer.server import served
from forewarp.viewer.studio import Studio
from forewarp.viewer.subject import Subject
from forewarp.viewer.visit import Visit
from tests.contract.fitting import stage_of
from tests.contract.table import METHODS
from tests.support.known_ball import known_ball
from tests.support.tiny_scene import ball_data, ball_scene, make_run, same, stage


@pytest.fixture(scope="module")
def studio():
    return Studio(ball_scene(frames=4))


def listening(studio, folder, host="127.0.0.1", port=0):
    return served(studio, host=host, port=port, title="ball", folder=folder)


def test_the_page_is_where_it_says_and_nowhere_else(studio, tmp_path, capsys):
    with listening(studio, tmp_path) as address:
        with urllib.request.urlopen(address, timeout=10) as page:
            assert b"<html" in page.read()
        port = int(address.rpartition(":")[2])
        with pytest.raises(ConnectionRefusedError), socket.create_connection(("127.0.0.2", port), timeout=5):
            pass
    with pytest.raises(ConnectionRefusedError), socket.create_connection(("127.0.0.1", port), timeout=5):
        pass
    assert capsys.readouterr().out == ""  # viser's own words
    with listening(studio, tmp_path, port=port) as again:  # the port is free again
        assert again == address


@pytest.mark.parametrize(
    ("where", "says"),
    [
        ({"port": 70000}, "port: expected a whole number from 0 to 65535, but got 70000"),
        ({"port": "web"}, "port: expected a whole number from 0 to 65535, but got web"),
        ({"host": None}, "host: expected an address of this machine, but got nothing; use host=127.0.0.1"),
        ({"host": ""}, "host: expected an address of this machine, but got nothing; use host=127.0.0.1"),
        ({"host": "192.0.2.1"}, "host: expected an address of this machine .* but got 192.0.2.1"),
        ({"host": "no such.host"}, "host: expected an address of this machine .* but got no such.host"),
    ],
)
def test_an_address_that_cannot_be_is_refused(studio, tmp_path, where, says):
    with pytest.raises(ValueError, match=says), listening(studio, tmp_path, **where):
        pass


def test_a_taken_port_is_refused_and_no_other_is_taken(studio, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        says = f"port: expected a free port, but got {port}, which is in use; use port={port + 1}"
        before = threading.active_count()
        with pytest.raises(ValueError, match=says), listening(studio, tmp_path, port=port):
            pass
        assert threading.active_count() == before


@pytest.mark.parametrize(
    ("failure", "port", "says"),
    [
        (errno.EADDRINUSE, 65535, "got 65535, which is in use; use port=0"),
        (errno.EACCES, 80, "port: expected one that you may open, but got 80, .* use port=8080"),
        (
            errno.EADDRNOTAVAIL,
            80,
            "host: expected an address of this machine that port 80 .* but got 127.0.0.1",
        ),
    ],
)
def test_why_a_port_cannot_be_opened_is_told(monkeypatch, failure, port, says):
    def create_server(*where, **how):
        raise OSError(failure, os.strerror(failure))

    monkeypatch.setattr("socket.create_server", create_server)
    with pytest.raises(ValueError, match=says):
        check_address("127.0.0.1", port)


@pytest.mark.parametrize(
    ("origin", "host", "welcome"),
    [
        (None, None, True),
        ("http://{host}", None, True),
        ("http://evil.example", None, False),
        ("http://evil.example", "evil.example", False),
    ],
)
def test_pages_of_foreign_sites_are_sent_nothing(studio, tmp_path, origin, host, welcome):
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    with listening(studio, tmp_path) as address:
        there = address.removeprefix("http://")
        asked = {
            "uri": f"ws://{host or there}",
            "sock": socket.create_connection(there.split(":"), timeout=10),
            "origin": origin and origin.format(host=there),
            "subprotocols": [f"viser-v{viser.__version__}"],
        }
        with connect(**asked, proxy=None) as client:
            if welcome:
                assert len(client.recv(timeout=10)) > 100
            else:
                with pytest.raises(ConnectionClosed, match="not a page of this server"):
                    client.recv(timeout=10)


class Watcher:
    """A page without a browser, which asks for a picture whenever it can."""

    def __init__(self, studio):
        self.studio, self.shown, self.said, self.visit = studio, [], [], None

    def build(self):
        if self.visit is None:
            self.visit = Visit(self.studio, self)
            self.visit.play(True)

    def canvas(self):
        return 40, 30

    def show(self, picture, *, rest):
        self.shown.append(picture)

    def tell(self, text):
        self.said.append(text)

    def time_is(self, time):
        pass

    def playing_is(self, playing):
        pass


class Broken(Watcher):
    """A page whose browser is gone in the worst moments."""

    def build(self):
        raise ConnectionError("gone while it was built")

    def tell(self, text):
        raise ConnectionError("gone while it was told")


def stages_of(method, steps=12):
    if method == "forward":
        return [stage(iterations=steps), stage("fine", iterations=steps)]
    return [stage_of(METHODS[method], name, steps=steps) for name in ("coarse", "fine")]


@pytest.mark.parametrize("method", ["forward", pytest.param("particles", marks=pytest.mark.slow)])
def test_a_run_that_is_watched_ends_with_the_same_numbers(tmp_path, monkeypatch, capsys, method):
    plain = make_run(tmp_path / "plain", stages_of(method)).fit()
    run, pages = make_run(tmp_path / "seen", stages_of(method)), []

    @contextlib.contextmanager
    def without_a_server(studio, **where):
        pages.extend([Watcher(studio), Broken(studio)])
        studio.pages = tuple(pages)
        yield "http://nowhere"

    monkeypatch.setattr(live_view, "served", without_a_server)
    monkeypatch.setattr("forewarp.viewer.visit.FASTEST", 0.0)
    said = []
    run.tell = said.append
    with live_view.live(run, host="127.0.0.1", port=0):
        seen = run.fit()
    assert same(plain, seen)
    assert [type(one) for one in run.callbacks("coarse", None)] == []  # as before
    assert len(pages[0].shown) == 24  # one picture a step, in both stages
    assert float((pages[0].shown[1] - pages[0].shown[-1]).abs().max()) > 0.05  # it plays
    assert pages[0].said[0].startswith("coarse ")
    assert pages[0].said[-1] == "fine has ended; what follows is not shown"
    assert said == ["see it: http://nowhere", f"see it again: forewarp-view run={tmp_path / 'seen'}"]
    assert seen.clock.seconds < 5
    assert "gone while it was built" in capsys.readouterr().err


@contextlib.contextmanager
def a_server():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        yield server
    finally:
        server.stop()


def modules_of_two_methods():
    """A method whose points a page follows and that its browser draws, and one without both."""
    first, second = known_ball(), known_ball()
    for ability in ("ellipsoids", "template", "movement"):
        setattr(first.method, ability, lambda *given: f"splats at {given}")
    second.method.__class__ = type("Unmoved", (type(second.method),), {"trajectories": None})
    return first, second


def test_a_stage_of_another_method_shows_what_it_can(capsys):
    data = ball_data()
    studio, trainer = Studio(data.scene), SimpleNamespace(datamodule=data)
    view, page = live_view.LiveView(studio, "run"), Watcher(studio)
    page.splats = page.shown.append
    studio.pages = (page,)
    first, second = modules_of_two_methods()
    view.on_train_start(trainer, first)
    assert "splats" in studio.shows
    page.visit.play(False)
    page.visit.change(show="splats", tails=True, followed=(((0.0, 0.0, 0.0), 0.5),))
    studio.desk.serve()
    assert str(page.shown[-1]).startswith("splats at")
    view.on_train_start(trainer, second)
    page.visit.refresh()
    studio.desk.serve()
    assert page.shown[-1].shape[2] == 3
    look = page.visit.look
    assert (look.show, look.tails, look.followed) == ("colour", False, ())
    assert capsys.readouterr().err == ""


def test_what_pages_cost_is_no_training_time():
    data, module, running = ball_data(), known_ball(), []
    studio = Studio(data.scene)
    view, page = live_view.LiveView(studio, "run"), Watcher(studio)
    page.build = lambda: running.append(module.clock._since is not None)
    page.visit = SimpleNamespace(refresh=page.build)
    studio.pages = (page,)
    module.trainer = trainer = SimpleNamespace(datamodule=data, global_step=1)
    with module.clock.running():
        view.on_train_start(trainer, module)
        view.on_train_batch_end(trainer, module, None, None, 0)
    assert running == [False] * 3


@pytest.mark.parametrize(
    ("show", "error", "says"),
    [
        ("colour", RuntimeError("no memory"), ["no screenshot: RuntimeError: no memory"]),
        ("splats", TimeoutError("30 s"), ["no screenshot: TimeoutError: 30 s"]),
        ("colour", Superseded(), []),
    ],
)
def test_why_there_is_no_screenshot_is_told(studio, show, error, says):
    def fail(*how, **more):
        raise error

    page, said = object.__new__(Page), []
    look = replace(first_look(studio.scene), show=show)
    page.visit = SimpleNamespace(look=look, request=fail)
    page.client = SimpleNamespace(get_render=fail, camera=SimpleNamespace(image_width=4, image_height=3))
    page.tell = said.append
    page.save_screenshot()
    assert said == says


def test_controls_offer_what_the_method_of_a_stage_can_show():
    data = ball_data()
    subjects = [Subject("run", module, data) for module in modules_of_two_methods()]
    studio = Studio(data.scene, subjects[:1])
    with a_server() as server:
        visit = Visit(studio, Watcher(studio))
        controls = Controls(SimpleNamespace(studio=studio, client=server, visit=visit, stand=visit.stand))
        parts = controls.splats, controls.tails, controls.choose, controls.forget
        controls.what.value, controls.tails.value = "splats", True
        assert [part.visible for part in parts] == [True] * 4
        assert controls._frusta._made == []  # nothing is made before it is asked for
        controls.shown.value = True
        controls._show_frusta()
        assert [one.visible for one in controls._frusta._made] == [True] * len(data.scene.train)
        visit.stand(0)
        controls.stands()
        assert not any(one.visible for one in controls._frusta._made)
        studio.subjects = subjects[1:]
        controls.adapt()
        assert [part.visible for part in parts] == [False] * 4
        assert controls.what.options == studio.shows
        assert (controls.what.value, controls.tails.value) == ("colour", False)
        studio.subjects = subjects[:1]
        controls.adapt()
        assert "splats" in controls.what.options
        assert [part.visible for part in parts] == [True] * 4


def test_nobody_watching_costs_no_picture(tmp_path, monkeypatch):
    run = make_run(tmp_path / "run", [stage()])

    @contextlib.contextmanager
    def nobody(studio, **where):
        monkeypatch.setattr(studio.desk, "serve", lambda: pytest.fail("a picture was drawn"))
        yield "http://nowhere"

    monkeypatch.setattr(live_view, "served", nobody)
    with live_view.live(run, host="127.0.0.1", port=0):
        assert run.fit().global_step == 12
