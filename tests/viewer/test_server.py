"""Where pages are served, their controls, and that a run in training is the same with them."""

import contextlib
import errno
import html
import math
import os
import socket
import sys
import threading
import urllib.request
from collections import defaultdict
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="no viser: pip install forewarp[viewer]")

import viser

from forewarp.scene.cloud import Ellipsoids
from forewarp.viewer import server as server_module
from forewarp.viewer.page import Page, fitted_fov, markdown_text, splat_arrays
from forewarp.viewer.queue import Cancelled
from forewarp.viewer.rendering import SceneRenderer, Viewer, ViewState, first_frame, vertical_fov
from forewarp.viewer.server import check_address
from forewarp.viewer.session import Session
from tests.contract.fitting import stage_of
from tests.contract.table import METHODS
from tests.support.browser import NEEDED, chromium
from tests.support.fakes import FakePage
from tests.support.tiny_scene import ball_data, ball_scene, known_ball, make_run, same, stage


@pytest.fixture(scope="module")
def viewer():
    return Viewer(ball_scene(frames=4))


def serving(viewer, folder, host="127.0.0.1", port=0):
    return server_module.serve(viewer, host=host, port=port, title="ball", folder=folder)


def test_the_page_is_where_it_says_and_nowhere_else(viewer, tmp_path, capsys):
    with serving(viewer, tmp_path) as address:
        with urllib.request.urlopen(address, timeout=10) as page:
            assert b"<html" in page.read()
        port = int(address.rpartition(":")[2])
        with pytest.raises(ConnectionRefusedError), socket.create_connection(("127.0.0.2", port), timeout=5):
            pass
        says = f"port: expected a free port, but got {port}, which is in use; use port={port + 1}"
        before = threading.active_count()
        with pytest.raises(ValueError, match=says), serving(viewer, tmp_path, port=port):
            pass
        assert threading.active_count() == before
    with pytest.raises(ConnectionRefusedError), socket.create_connection(("127.0.0.1", port), timeout=5):
        pass
    assert capsys.readouterr().out == ""  # viser's own words
    with serving(viewer, tmp_path, port=port) as again:  # the port is free again
        assert again == address


def test_a_port_that_is_taken_since_is_refused(viewer, tmp_path, monkeypatch):
    monkeypatch.setattr(server_module, "check_address", lambda host, port: None)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with (
            pytest.raises(ValueError, match=f"got {port}, which is in use"),
            serving(viewer, tmp_path, port=port),
        ):
            pass


@pytest.mark.parametrize(
    ("where", "says"),
    [
        ({"port": 70000}, "port: expected a whole number from 0 to 65535, but got 70000"),
        ({"port": "web"}, "port: expected a whole number from 0 to 65535, but got web"),
        ({"host": None}, "host: expected an address of this machine, but got nothing; use host=127.0.0.1"),
        ({"host": ""}, "host: expected an address of this machine, but got nothing; use host=127.0.0.1"),
        ({"host": "192.0.2.1"}, "host: expected an address of this machine .* but got 192.0.2.1"),
        ({"host": "no such.host"}, "host: expected an address of this machine .* but got no such.host"),
        ({"port": 65535, "error": errno.EADDRINUSE}, "got 65535, which is in use; use port=0"),
        ({"port": 80, "error": errno.EACCES}, "one that you may open, but got 80, .* use port=8080"),
    ],
)
def test_an_address_on_which_nothing_can_listen_is_refused(monkeypatch, where, says):
    where = {"host": "127.0.0.1", "port": 0} | where
    error = where.pop("error", None)
    if error is not None:
        monkeypatch.setattr("socket.create_server", Mock(side_effect=OSError(error, os.strerror(error))))
    with pytest.raises(ValueError, match=says):
        check_address(**where)


def test_a_malformed_message_takes_one_line(viewer, tmp_path, caplog):
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    messages = [b"\xff", "text", b"\x80", b"\x81\xa4type\xa1x", b"\x93\x01\x02\x03"]
    with serving(viewer, tmp_path) as address:
        for message in messages:
            protocol = f"viser-v{viser.__version__}"
            page = connect(address.replace("http", "ws"), subprotocols=[protocol], origin=address)
            with page, contextlib.suppress(ConnectionClosed):
                page.send(message)
                for _ in range(1000):
                    page.recv(10)  # until it is closed
    said = [record for record in caplog.records if record.levelname == "ERROR"]
    assert len(said) == len(messages)
    assert all(record.exc_info is None for record in said)
    assert {record.getMessage().partition(" (")[0] for record in said} == {
        "warning: expected a message of a page, but got another"
    }


def test_pages_of_foreign_sites_are_sent_nothing(viewer, tmp_path):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    with serving(viewer, tmp_path) as address:
        there = address.removeprefix("http://")
        for origin, host, welcome in (
            (None, there, True),
            (address, there, True),
            ("http://evil.example", there, False),
            ("http://evil.example", "evil.example", False),
        ):
            asked = {"origin": origin, "subprotocols": [f"viser-v{viser.__version__}"], "proxy": None}
            sock = socket.create_connection(there.split(":"), timeout=10)
            if welcome:
                with connect(f"ws://{host}", sock=sock, **asked) as client:
                    assert len(client.recv(timeout=10)) > 100
            else:
                with (
                    pytest.raises(InvalidStatus, match="HTTP 403"),
                    connect(f"ws://{host}", sock=sock, **asked),
                ):
                    pass


@pytest.mark.parametrize(
    ("host", "requested", "welcome"),
    [
        ("0.0.0.0", "192.0.2.7:8080", True),
        ("0.0.0.0", "[::1]:8080", True),
        ("0.0.0.0", f"{socket.gethostname()}:8080".lower(), True),
        ("render.example", "render.example:8080", True),
        ("0.0.0.0", "evil.example:8080", False),  # whose name leads here since
        ("::", "evil.example", False),
        ("0.0.0.0", "[", False),
        ("0.0.0.0", None, False),
    ],
)
def test_a_foreign_name_that_leads_here_is_no_page_of_ours(host, requested, welcome):
    assert server_module.is_same_origin(host, requested, None) is welcome
    assert server_module.is_same_origin(host, requested, f"http://{requested}") is welcome


def test_the_page_runs_no_script_but_its_own_and_lies_in_no_frame(viewer, tmp_path):
    with serving(viewer, tmp_path) as address, urllib.request.urlopen(address, timeout=10) as page:
        policy, text = page.headers["Content-Security-Policy"], page.read().decode()
        assert page.headers["X-Frame-Options"] == "DENY"
        assert int(page.headers["Content-Length"]) == len(text.encode())
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules["frame-ancestors"] == rules["object-src"] == rules["frame-src"] == "'none'"
    assert "unsafe-inline" not in rules["script-src"]
    nonce = rules["script-src"].split()[0].removeprefix("'nonce-").rstrip("'")
    assert text.count(f'nonce="{nonce}"') == 1  # the script that its own makes
    assert f"<script nonce={nonce} " in text


def test_text_on_the_page_is_no_markup(viewer):
    page = object.__new__(Page)
    page.status = Mock()
    page.tell("training image <iframe srcdoc='<script>1</script>'>*b*.png: [x](javascript:1)")
    assert not set("<>*[]()'`") & set(page.status.content)
    assert html.unescape(page.status.content).startswith("training image <iframe srcdoc='<script>")


@pytest.mark.parametrize(("side", "away"), [(1, 2.0), (-1, 7.0)])
def test_a_page_begins_where_a_camera_stands_and_turns_about_a_point_ahead(side, away):
    camera, server = ball_scene().train[0].camera, Mock()
    pose, up = camera.camera_to_world, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    center, ahead = pose[:3, 3], pose[:3, 2]
    scene = SimpleNamespace(box=SimpleNamespace(diagonal=7.0))
    viewer = SimpleNamespace(focus=center + side * 2 * ahead + 0.3 * pose[:3, 0], up=up, scene=scene)
    server_module._begin_at(server, viewer, ViewState(pose, vertical_fov(camera)))
    seen = server.initial_camera
    np.testing.assert_allclose(seen.position, center)
    np.testing.assert_allclose(seen.look_at, center + away * ahead)
    assert seen.fov == pytest.approx(2 * np.arctan(0.5 * camera.height / camera.fy))
    server.scene.set_up_direction.assert_called_once_with((0.0, 0.0, 1.0))


class Watcher(FakePage):
    """A page without a browser, which asks for an image whenever it can."""

    def __init__(self, viewer):
        super().__init__()
        self.viewer, self.session = viewer, Session(viewer, self)

    def adapt(self):
        if not self.images:
            self.session.play(True)

    def canvas(self):
        return 40, 30

    def show_image(self, image, *, rest):
        self.images.append(image)


class Broken(Watcher):
    """A page whose browser is gone in the worst moments."""

    def adapt(self):
        raise ConnectionError("gone while it was adapted")

    def tell(self, text):
        raise ConnectionError("gone while it was told")


def stages_of(method, steps=12):
    if method == "forward":
        return [stage(iterations=steps), stage("fine", iterations=steps)]
    return [stage_of(METHODS[method], name, steps=steps) for name in ("coarse", "fine")]


def without_a_server(monkeypatch, make_pages):
    """Serve no pages but those that are made of a viewer."""

    @contextlib.contextmanager
    def serve(viewer, **where):
        viewer.pages = tuple(make_pages(viewer))
        yield "http://nowhere"

    monkeypatch.setattr(server_module, "serve", serve)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["forward", pytest.param("particles", marks=pytest.mark.slow)])
def test_a_run_that_is_watched_ends_with_the_same_numbers(tmp_path, monkeypatch, capsys, method):
    plain = make_run(tmp_path / "plain", stages_of(method)).fit()
    run, pages, said = make_run(tmp_path / "seen", stages_of(method)), [], []
    without_a_server(monkeypatch, lambda viewer: pages.extend([Watcher(viewer), Broken(viewer)]) or pages)
    monkeypatch.setattr("forewarp.viewer.session.MIN_INTERVAL", 0.0)
    run.tell = said.append
    with server_module.live(run, host="127.0.0.1", port=0):
        seen = run.fit()
    assert same(plain, seen)
    assert run.callbacks("coarse", None) == []  # as before
    page = pages[0]
    assert len(page.images) == 24  # one image a step, in both stages
    assert float((page.images[1] - page.images[-1]).abs().max()) > 0.05  # it plays
    assert page.said[0].startswith("coarse ")
    assert page.said[-1] == "fine has ended; what follows is not shown"
    assert said == ["see it: http://nowhere", f"see it again: forewarp-view run={tmp_path / 'seen'}"]
    assert seen.clock.seconds < 5
    assert "gone while it was adapted" in capsys.readouterr().err


@pytest.mark.slow
def test_nobody_watching_costs_no_image(tmp_path, monkeypatch):
    run = make_run(tmp_path / "run", [stage()])
    without_a_server(monkeypatch, lambda viewer: ())
    monkeypatch.setattr(
        "forewarp.viewer.queue.RenderQueue.run_next", lambda queue: pytest.fail("an image was rendered")
    )
    with server_module.live(run, host="127.0.0.1", port=0):
        assert run.fit().global_step == 12


def test_what_pages_cost_is_no_training_time():
    data, module, running = ball_data(), known_ball(), []
    viewer = Viewer(data.scene)

    def note():
        running.append(module.clock._since is not None)

    viewer.pages = (SimpleNamespace(adapt=note, session=SimpleNamespace(refresh=note)),)
    view = server_module.LiveView(viewer, "run")
    module.trainer = trainer = SimpleNamespace(datamodule=data, global_step=1)
    with module.clock.running():
        view.on_train_start(trainer, module)
        view.on_train_batch_end(trainer, module, None, None, 0)
    assert running == [False] * 3


@pytest.fixture
def modules():
    """A method whose points a page follows and that its browser draws, and one without both."""
    first, second = known_ball(), known_ball()
    for ability in ("ellipsoids", "template", "movement"):
        setattr(first.method, ability, lambda *given: f"splats at {given}")
    second.method.__class__ = type("Unmoved", (type(second.method),), {"trajectories": None})
    return first, second


def test_a_stage_of_another_method_shows_what_it_can(modules):
    data = ball_data()
    viewer, trainer = Viewer(data.scene), SimpleNamespace(datamodule=data)
    view, page = server_module.LiveView(viewer, "run"), Watcher(viewer)
    viewer.pages = (page,)
    view.on_train_start(trainer, modules[0])
    assert "splats" in viewer.channels
    page.session.play(False)
    page.session.change(channel="splats", trajectories=True, followed=(((0.0, 0.0, 0.0), 0.5),))
    viewer.queue.run_next()
    assert str(page.images[-1]).startswith("splats at")
    view.on_train_start(trainer, modules[1])
    page.session.refresh()
    viewer.queue.run_next()
    assert page.images[-1].shape[2] == 3
    state = page.session.state
    assert (state.channel, state.trajectories, state.followed) == ("colour", False, ())


@pytest.fixture
def client():
    """Viser's server as the client of a page whose camera stands at the origin."""
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    server.camera = SimpleNamespace(on_update=lambda act: act, wxyz=np.eye(4)[0], position=(0, 0, 0), fov=0.5)
    server.camera.image_width, server.camera.image_height = 900, 640
    yield server
    server.stop()


def test_home_shows_the_whole_first_image_as_does_a_phone_from_the_start(client, tmp_path):
    viewer = Viewer(ball_data().scene)
    first = first_frame(viewer.scene).camera
    page, camera = Page(viewer, client, tmp_path), client.camera
    assert camera.fov == 0.5  # where the server let it begin
    camera.position = np.ones(3)
    page.go_home()
    np.testing.assert_allclose(camera.position, first.center)
    assert camera.fov == pytest.approx(vertical_fov(first))
    camera.image_width, camera.image_height = 390, 844
    Page(viewer, client, tmp_path)
    assert camera.fov == pytest.approx(fitted_fov(first, 390, 844))
    assert camera.fov > vertical_fov(first)


def test_controls_offer_what_the_method_of_a_stage_can_show(modules, client, tmp_path):
    data = ball_data()
    viewer = Viewer(data.scene)
    page = Page(viewer, client, tmp_path)
    parts = page.about_splats, page.trajectories, page.follow, page.follow_none
    assert not any(part.visible for part in parts)  # before the first step of a run in training
    renderers = [SceneRenderer("run", module, data) for module in modules]
    viewer.renderers = renderers[:1]
    page.adapt()
    assert not page.layer.visible  # voxels have none
    page.channel.value, page.trajectories.value = "splats", True
    assert all(part.visible for part in parts)
    assert page._cameras == []  # nothing is made before it is asked for
    page.cameras_shown.value = True
    page._show_cameras()
    assert [camera.visible for camera in page._cameras] == [True] * len(data.scene.train)
    page.show_training_view(0)
    assert not any(camera.visible for camera in page._cameras)
    viewer.renderers = renderers[1:]
    page.adapt()
    assert not any(part.visible for part in parts)
    assert page.channel.options == viewer.channels
    assert (page.channel.value, page.trajectories.value) == ("colour", False)


@pytest.mark.parametrize(("width", "height"), [(400, 400), (1000, 400), (390, 844)])
def test_a_canvas_shows_the_whole_image(width, height):
    camera = ball_scene().train[0].camera
    down = math.tan(0.5 * fitted_fov(camera, width, height))
    across = down * width / height
    assert down >= 0.5 * camera.height / camera.fy - 1e-9
    assert across >= 0.5 * camera.width / camera.fx - 1e-9
    assert min(down / (camera.height / camera.fy), across / (camera.width / camera.fx)) == pytest.approx(0.5)


def test_splats_keep_their_shape_in_half_precision():
    places, roots = torch.ones(1, 3), 3e-5 * torch.eye(3)[None]
    small = Ellipsoids(places, roots, torch.full((1,), 0.5), torch.zeros(1, 1, 3))
    centers, covariances, colors, opacity = splat_arrays(small, 1e-2)
    np.testing.assert_allclose(centers, [[100, 100, 100]], rtol=1e-6)
    sent = covariances[0].astype(np.float16).astype(float)
    np.testing.assert_allclose(1e-4 * sent, 9e-10 * np.eye(3), rtol=0.01)
    assert (colors.tolist(), opacity.tolist()) == ([[0.5] * 3], [[0.5]])


@pytest.mark.parametrize("shade", [0, 255])
def test_splats_are_seen_before_the_background_of_exact_images(shade):
    client, renderer = Mock(), SimpleNamespace(background=torch.full((3,), shade / 255))
    viewer = SimpleNamespace(renderers=[renderer], scene=SimpleNamespace(box=SimpleNamespace(diagonal=2.0)))
    page = SimpleNamespace(viewer=viewer, client=client, _splats=None)
    single = Ellipsoids(torch.ones(1, 3), torch.eye(3)[None], torch.ones(1), torch.zeros(1, 1, 3))
    for _ in range(2):  # the background is sent once
        Page.show_splats(page, single)
    (sent,) = client.scene.set_background_image.call_args_list
    assert sent.args[0].tolist() == [[[shade] * 3]]
    assert [call.kwargs["scale"] for call in client.scene.add_gaussian_splats.call_args_list] == [0.02] * 2


@pytest.mark.parametrize(
    ("channel", "error", "says"),
    [
        ("colour", RuntimeError("no memory"), ["no screenshot: RuntimeError: no memory"]),
        ("splats", TimeoutError("30 s"), ["no screenshot: TimeoutError: 30 s"]),
        ("colour", Cancelled(), []),
    ],
)
def test_why_there_is_no_screenshot_is_told(viewer, channel, error, says):
    fail, said = Mock(side_effect=error), []
    page = object.__new__(Page)
    state = replace(ViewState.first(viewer.scene), channel=channel)
    page.session = SimpleNamespace(state=state, image=fail)
    page.client = SimpleNamespace(get_render=fail, camera=SimpleNamespace(image_width=4, image_height=3))
    page.tell = said.append
    page.save_screenshot()
    assert said == says


def test_a_screenshot_that_cannot_be_sent_is_none_that_could_not_be_drawn(viewer):
    page, image = object.__new__(Page), Mock(return_value=torch.ones(2, 2, 3))
    page.viewer, page.tell, page.client = viewer, Mock(), Mock()
    page.client.send_file_download.side_effect = RuntimeError("no connection")
    page.session = SimpleNamespace(state=ViewState.first(viewer.scene), image=image)
    with pytest.raises(RuntimeError, match="no connection"):
        page.save_screenshot()
    assert page.tell.call_count == 0


@pytest.mark.parametrize(
    ("broken", "says"), [("video", "no video: RuntimeError: no memory"), ("download", "written: {}")]
)
def test_a_video_that_cannot_be_sent_is_written_all_the_same(tmp_path, broken, says):
    page, buttons, file = object.__new__(Page), defaultdict(Mock), tmp_path / "path-1.mp4"
    file.touch()
    page.client, page.session, page.folder = MagicMock(), Mock(), tmp_path
    page.client.gui.add_button.side_effect = lambda label: buttons[label]
    page.session.write_video.return_value = file
    steps = {"video": page.session.write_video, "download": page.client.send_file_download}
    steps[broken].side_effect = RuntimeError("no memory")
    page._add_video()
    make = buttons["make the video"]
    with pytest.raises(RuntimeError) if broken == "download" else contextlib.nullcontext():
        make.on_click.call_args.args[0](None)
    assert page.client.gui.add_markdown.return_value.content == markdown_text(says.format(file))
    assert make.disabled is False


@pytest.mark.parametrize(
    ("needed", "outcome"), [("", pytest.skip.Exception), ("1", pytest.fail.Exception)], ids=["skip", "fail"]
)
@pytest.mark.parametrize("lacks", ["playwright", "chromium"])
def test_a_missing_browser_skips_its_tests_or_fails_where_it_is_needed(monkeypatch, lacks, needed, outcome):
    monkeypatch.setenv(NEEDED, needed)
    if lacks == "playwright":
        monkeypatch.setitem(sys.modules, "playwright.sync_api", None)
    else:
        pytest.importorskip("playwright.sync_api", reason="no playwright; make install-browser adds it")
        monkeypatch.setattr("shutil.which", lambda name: "/nowhere/chromium")
    with pytest.raises(outcome, match=f"no {lacks}.*make install-browser"), chromium():
        pass
