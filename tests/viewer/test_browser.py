"""The page in a real browser, used as a person uses it."""

import contextlib
import re
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

pytest.importorskip("viser", reason="no viser: pip install forewarp[viewer]")

from forewarp.cli.view import renderer_of
from forewarp.runs.config import saved_config
from forewarp.viewer.rendering import Viewer, ViewState, camera_of, vertical_fov
from forewarp.viewer.server import serve
from tests.support.browser import Tab, chromium, until
from tests.support.commands import call
from tests.support.films import read_film

pytestmark = [pytest.mark.browser, pytest.mark.slow]
ROWS = 240


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


def words(fitted, iterations):
    """What ``forewarp-train`` is told for a short run of the scene of ``fitted``, without an evaluation."""
    data = [f"data.root={fitted.parent}/scenes", "data=dnerf", "data.scene=vehicle"]
    budget = ["budget.minutes=null", f"budget.iterations={iterations}"]
    return [*data, *budget, "model=particles", "preset=demo", "trainer=cpu", "threads=1", "evaluate=false"]


@pytest.fixture(scope="module")
def particles(fitted, tmp_path_factory):
    """A run of particles, of the scene of ``fitted``."""
    run = tmp_path_factory.mktemp("runs") / "particles"
    done = call("train", *words(fitted, 200), f"run={run}")
    assert done.status == 0, done
    return run


@contextmanager
def serving(folder, *runs):
    """Serve runs as the command does, but from a thread; yields the viewer and its address."""
    config = OmegaConf.create({"points": 100, "tail": 0.5})
    renderers = [renderer_of(saved_config(str(run), config), config) for run in runs]
    viewer = Viewer(renderers[0].scene, renderers, rows=ROWS)
    with serve(viewer, host="127.0.0.1", port=0, title="test", folder=folder) as address:
        thread = threading.Thread(target=viewer.queue.run_forever)
        thread.start()
        try:
            yield viewer, address
        finally:
            viewer.queue.close()
            thread.join(30)
            assert not thread.is_alive()


@pytest.fixture(scope="module")
def served(particles, tmp_path_factory):
    """The viewer of one run, its address, and the folder of its videos."""
    folder = tmp_path_factory.mktemp("videos")
    with serving(folder, particles) as (viewer, address):
        yield viewer, address, folder


@pytest.fixture
def tab(browser, served):
    with opened(browser, served[1]) as page:
        page.settled()
        yield page


@contextmanager
def opened(browser, address):
    """A page in the browser, which must complain of nothing."""
    tab = Tab(browser, address, width=640, height=480)
    yield tab
    tab.page.close()
    assert tab.errors == []


def exact(viewer, tab, **changes):
    """What the page should show, at the size of its canvas."""
    height, width = tab.picture().shape[:2]
    first = ViewState.first(viewer.scene)
    state = ViewState(**{"pose": first.pose, "fov": first.fov, "time": first.time} | changes)
    image = viewer.image(state, *viewer.pages[-1].session.full_size())[None].permute(0, 3, 1, 2)
    resized = torch.nn.functional.interpolate(image, (height, width), mode="bilinear", antialias=True)
    return 255 * resized[0].permute(1, 2, 0).numpy()


def changed(seen, other) -> float:
    """Share of the pixels that differ by more than compression does; red on orange is some 50 of 255."""
    return float((np.abs(seen.astype(int) - other).max(-1) > 30).mean())


def far(seen, other) -> float:
    """Mean difference of two images, of 255."""
    return float(np.abs(seen.astype(float) - other.astype(float)).mean())


def shows(tab, image, most: float) -> bool:
    """Wait until the page shows an image, but for ``most`` of 255 on average."""
    return until(lambda: far(tab.picture(), image) < most)


def test_the_page_shows_what_the_method_renders_and_what_the_browser_draws(served, tab):
    viewer = served[0]
    first = tab.settled()
    assert far(first, exact(viewer, tab)) < 2
    assert first.astype(float).std() > 20
    tab.type("time", 0.5)
    then = tab.settled()
    assert far(then, exact(viewer, tab, time=0.5)) < 2
    assert far(first, then) > 2 * far(then, exact(viewer, tab, time=0.5))
    tab.choose("show", "depth")
    assert shows(tab, exact(viewer, tab, time=0.5, channel="depth"), 2)
    assert re.search(r"\d+\.\d images/s", tab.status())
    tab.choose("show", "splats")
    until(lambda: "drawn by the browser" in tab.status())
    near, other = exact(viewer, tab, time=0.5), exact(viewer, tab, time=0.9)
    assert shows(tab, near, 5)
    tab.type("time", 0.9)
    assert shows(tab, other, 5)
    assert far(tab.picture(), near) > far(tab.picture(), other)
    tab.choose("show", "colour")
    tab.choose("speed", "4")
    tab.press("play")
    seen = [tab.picture() for _ in range(4) if tab.page.wait_for_timeout(300) is None]
    assert sum(far(a, b) > 0.5 for a, b in zip(seen, seen[1:])) >= 2
    tab.press("pause")
    tab.settled()
    assert tab.has("play")


def test_pages_keep_their_own_camera_and_time_and_may_leave_or_be_killed(browser, served, tab):
    from playwright.sync_api import Error

    viewer = served[0]
    with opened(browser, served[1]) as other:
        before = other.settled()
        tab.turn(160)
        tab.type("time", 0.8)
        assert far(tab.settled(), before) > 3
        assert far(other.settled(), before) < 1  # viser adapts the canvas's own pixels to the machine
        other.check("trajectories")
        other.press("play")
        other.page.wait_for_timeout(300)
    until(lambda: len(viewer.pages) == 1)
    killed = Tab(browser, served[1], width=640, height=480)
    killed.press("play")
    with contextlib.suppress(Error):  # the page's process ends at once, without a farewell
        killed.page.goto("chrome://crash")
    until(lambda: len(viewer.pages) == 1)
    tab.type("time", 0.3)
    state = viewer.pages[0].session.state
    assert shows(tab, exact(viewer, tab, time=0.3, pose=state.pose, fov=state.fov), 2)
    assert not viewer.queue.has_due_job()


def test_cameras_and_points_are_clicked(served, tab):
    viewer = served[0]
    tab.type("time", 1.0)
    plain = tab.settled()
    height, width = plain.shape[:2]
    rows, columns = np.nonzero(plain.min(-1) < 150)  # something that is not the background
    tab.press("follow the point that I click")
    tab.page.wait_for_timeout(500)
    middle = len(rows) // 2
    tab.click(float(columns[middle] / width), float(rows[middle] / height))
    until(lambda: viewer.pages[0].session.state.followed)
    ink = until(lambda: changed(tab.picture(), plain) or None)
    assert ink < 0.1
    tab.press("follow none")
    until(lambda: changed(tab.picture(), plain) == 0)
    tab.check("trajectories")
    until(lambda: changed(tab.picture(), plain) > 1e-3)
    tab.check("trajectories", False)
    tab.check("show cameras")
    tab.page.mouse.move(200, 300)
    for _ in range(4):
        tab.page.mouse.wheel(0, 500)
        tab.page.wait_for_timeout(300)
    tab.page.wait_for_timeout(1200)
    index = click_a_camera(viewer, tab)
    until(lambda: "truth, prediction, error" in tab.status())
    frame = viewer.scene.train[index]
    assert f"training image {frame.name}:" in tab.status()
    seen = tab.settled("truth")
    pose = frame.camera.camera_to_world
    assert far(seen, exact(viewer, tab, pose=pose, training_view=index)) < 3
    tab.press("leave it")
    alone = tab.settled()
    tab.check("show cameras", False)
    there = exact(viewer, tab, pose=pose, fov=vertical_fov(frame.camera), time=frame.time)
    assert shows(tab, there, 3)
    assert far(alone, seen) > 5
    tab.type("image", 1)
    until(lambda: f"training image {viewer.scene.train[1].name}:" in tab.status())
    until(left_by_turning, tab)
    assert not tab.has("leave it")


def left_by_turning(tab) -> bool:
    """Turn the camera; a drag while the page still moves it there is one too early."""
    tab.turn()
    tab.page.wait_for_timeout(500)
    return "truth" not in tab.status()


def click_a_camera(viewer, tab) -> int:
    """Click where a camera stands; returns the training image that is shown."""
    page = viewer.pages[0]
    width, height = page.canvas()
    camera = camera_of(page.session.state, width, height, viewer.scene)
    apexes = torch.stack([frame.camera.center for frame in viewer.scene.train])
    pixels, depth = camera.project(apexes)
    share = pixels / torch.tensor([width, height])
    inside = ((share > 0.1) & (share < 0.9)).all(-1) & (depth > 0)
    for x, y in share[inside].tolist():
        tab.click(x, y)
        tab.page.wait_for_timeout(1500)
        if page.session.state.training_view is not None:
            return page.session.state.training_view
    raise AssertionError("no camera was hit")


def test_screenshots_and_videos_are_saved(served, tab):
    viewer, _, folder = served
    with tab.page.expect_download() as got:
        tab.press("screenshot")
    assert re.fullmatch(r"vehicle-particles-colour-0\.\d{3}\.png", got.value.suggested_filename)
    session = viewer.pages[0].session
    width, rows = session.full_size()
    shot = iio.imread(got.value.path().read_bytes())
    assert far(shot, 255 * viewer.image(session.state, width, rows).numpy()) < 1
    tab.page.get_by_text("Video", exact=True).click()
    tab.press("make the video")
    tab.page.get_by_text("key views: expected at least 2").wait_for()
    tab.press("add this view and time")
    tab.turn(150)
    tab.type("time", 1.0)
    tab.settled()
    tab.press("add this view and time")
    tab.type("seconds", 0.4)
    with tab.page.expect_download() as got:
        tab.press("make the video")
    assert got.value.suggested_filename == "path-1.mp4"
    film = read_film(folder / "path-1.mp4", rows + rows % 2, width + width % 2)
    assert len(film) == 10
    assert far(film[0], film[-1]) > 3
    assert got.value.path().read_bytes() == (folder / "path-1.mp4").read_bytes()


def test_two_runs_side_by_side(browser, fitted, particles, tmp_path):
    with serving(tmp_path, particles, fitted) as (viewer, address), opened(browser, address) as tab:
        assert shows(tab, exact(viewer, tab), 2)
        assert tab.page.get_by_text("left: particles, right: run").is_visible()
        tab.type("image", 2)
        tab.settled("truth")
        pose = viewer.scene.train[2].camera.camera_to_world
        assert shows(tab, exact(viewer, tab, pose=pose, training_view=2), 3)


def test_a_run_is_seen_while_it_trains(browser, fitted, tmp_path):
    script = Path(sys.executable).with_name("forewarp-train")
    command = [sys.executable, "-u", str(script), *words(fitted, 1800)]  # some 30 s: the page comes before
    command += [f"run={tmp_path}/run", "viewer=true", "port=0"]
    with open(tmp_path / "said", "w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, cwd=tmp_path)
    try:
        said = until(lambda: re.search(r"see it: (\S+)", (tmp_path / "said").read_text()), seconds=60)
        with opened(browser, said[1]) as tab:
            first = until(step_said, tab)
            before = tab.picture()
            tab.press("play")
            until(lambda: (step_said(tab) or 0) > first + 20)
            assert far(before, tab.picture()) > 1
        assert process.wait(180) == 0
    finally:
        process.kill()
    assert f"see it again: forewarp-view run={tmp_path}/run" in (tmp_path / "said").read_text()


def step_said(tab) -> int | None:
    """The step that the page says training has reached."""
    found = re.search(r"step (\d+)", tab.status())
    return found and int(found[1])
