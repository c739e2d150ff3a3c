"""Where the page listens, and that a run in training is the same with it."""

import contextlib
import socket
import threading
import urllib.request

import pytest

pytest.importorskip("viser", reason="no viser: pip install forewarp[viewer]")

from forewarp.viewer import live as live_view
from forewarp.viewer.server import served
from forewarp.viewer.studio import Studio
from forewarp.viewer.visit import Visit
from tests.support.tiny_scene import ball_scene, make_run, same, stage


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


def test_a_run_that_is_watched_ends_with_the_same_numbers(tmp_path, monkeypatch, capsys):
    plain = make_run(tmp_path / "plain", [stage(), stage("fine")]).fit()
    run, pages = make_run(tmp_path / "seen", [stage(), stage("fine")]), []

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
    assert len(pages[0].shown) == 24  # one picture a step, in both stages
    assert float((pages[0].shown[1] - pages[0].shown[-1]).abs().max()) > 0.05
    assert pages[0].said[0].startswith("coarse ")
    assert pages[0].said[-1] == "fine has ended; what follows is not shown"
    assert said == ["see it: http://nowhere", f"see it again: forewarp-view run={tmp_path / 'seen'}"]
    assert seen.clock.seconds < 5
    assert "gone while it was built" in capsys.readouterr().err


def test_nobody_watching_costs_no_picture(tmp_path, monkeypatch):
    run = make_run(tmp_path / "run", [stage()])

    @contextlib.contextmanager
    def nobody(studio, **where):
        monkeypatch.setattr(studio.desk, "serve", lambda: pytest.fail("a picture was drawn"))
        yield "http://nowhere"

    monkeypatch.setattr(live_view, "served", nobody)
    with live_view.live(run, host="127.0.0.1", port=0):
        assert run.fit().global_step == 12
