"""The page in a real browser, used as a person uses it."""

import contextlib
import re
import subprocess
import sys
import threading
from contextlib import contextmanager

import imageio.v3 as iio
import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="no viser: pip install forewarp[viewer]")

from forewarp.cli.view import subject_of
from forewarp.runs.config import saved_config
from forewarp.viewer.look import Look, camera_of, first_look, vertical_fov
from forewarp.viewer.server import served
from forewarp.viewer.studio import Studio
from tests.support.browser import Tab, chromium, until
from tests.support.commands import call
from tests.support.films import read_film

pytestmark = [pytest.mark.browser, pytest.mark.slow]
SIZE = 400


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


def words(fitted, iterations):
    """What ``forewarp-train`` is told for a short run of the scene of ``fitted``, without an evaluation."""
    data = [f"data.root={fitted.parent}/scenes", "data=dnerf", "data.scene=vehicle"]
    budget = ["budget.minutes=null", f"budget.iterations={iterations}"]
    return [*data, *budget, "preset=demo", "trainer=cpu", "threads=1", "evaluate=false"]


@pytest.fixture(scope="module")
def particles(fitted, tmp_path_factory):
    """A run of particles, of the scene of ``fitted``."""
    run = tmp_path_factory.mktemp("runs") / "particles"
    done = call("train", "model=particles", *words(fitted, 400), f"run={run}")
    assert done.status == 0, done
    return run


def opened(*runs):
    """The studio of some runs, as the command opens them."""
    from omegaconf import OmegaConf

    config = OmegaConf.create({"points": 100, "tail": 0.5})
    subjects = [subject_of(saved_config(str(run), config), config) for run in runs]
    return Studio(subjects[0].scene, subjects, size=SIZE)


@contextmanager
def serving(studio, folder):
    """Serve a studio from a thread; yields the address."""
    with served(studio, host="127.0.0.1", port=0, title="test", folder=folder) as address:
        server = threading.Thread(target=studio.desk.serve_forever)
        server.start()
        try:
            yield address
        finally:
            studio.desk.close()
            server.join(30)
            assert not server.is_alive()


@pytest.fixture(scope="module")
def one(particles, tmp_path_factory):
    """The studio of one run, and its address."""
    studio = opened(particles)
    folder = tmp_path_factory.mktemp("videos")
    with serving(studio, folder) as address:
        yield studio, address, folder


@pytest.fixture
def tab(browser, one):
    page = Tab(browser, one[1])
    yield page
    page.page.close()
    assert page.errors == []


def exact(studio, tab, **changes):
    """What the page should show, at the size of its canvas."""
    seen = tab.picture()
    height, width = seen.shape[:2]
    first = first_look(studio.scene)
    values = {"pose": first.pose, "fov": first.fov, "time": first.time} | changes
    wide, rows = round(width * SIZE / height), SIZE
    picture = studio.picture(Look(**values), wide, rows, bool)[None].permute(0, 3, 1, 2)
    resized = torch.nn.functional.interpolate(picture, (height, width), mode="bilinear", antialias=True)
    return 255 * resized[0].permute(1, 2, 0).numpy()


def changed(seen, other) -> float:
    """Share of the pixels that differ by more than compression does; red on orange is some 50 of 255."""
    return float((np.abs(seen.astype(int) - other).max(-1) > 30).mean())


def far(seen, other) -> float:
    """Mean difference of two pictures, of 255."""
    return float(np.abs(seen.astype(float) - other.astype(float)).mean())


def shows(tab, picture, most: float) -> bool:
    """Wait until the page shows a picture, but for ``most`` of 255 on average."""
    return until(lambda: far(tab.picture(), picture) < most)


def test_the_page_shows_what_the_method_renders_and_the_slider_changes_it(one, tab):
    studio = one[0]
    first = tab.settled()
    assert far(first, exact(studio, tab)) < 2
    assert first.astype(float).std() > 20
    tab.type("time", 0.5)
    then = tab.settled()
    assert far(then, exact(studio, tab, time=0.5)) < 2
    assert far(first, then) > 2 * far(then, exact(studio, tab, time=0.5))
    tab.choose("show", "depth")
    assert shows(tab, exact(studio, tab, time=0.5, show="depth"), 2)
    assert re.search(r"\d+\.\d pictures/s", tab.status())


def test_the_browser_draws_splats_where_the_method_does(one, tab):
    studio = one[0]
    tab.settled()
    tab.choose("show", "splats")
    until(lambda: "drawn by the browser" in tab.status())
    drawn = until(lambda: (seen := tab.picture()).std() > 15 and seen)
    near, other = exact(studio, tab), exact(studio, tab, time=0.7)
    assert far(drawn, near) < 5
    tab.type("time", 0.7)
    tab.page.wait_for_timeout(1500)
    assert far(tab.picture(), other) < 5
    assert far(tab.picture(), near) > far(tab.picture(), other)


def test_two_pages_keep_their_own_camera_and_time(browser, one, tab):
    other = Tab(browser, one[1])
    before = other.settled()
    tab.settled()
    tab.turn(160)
    tab.type("time", 0.8)
    assert far(tab.settled(), before) > 3
    assert far(other.settled(), before) < 1  # viser adapts the canvas's own pixels to the machine
    assert other.errors == []
    other.page.close()


def test_a_page_that_leaves_or_is_killed_harms_nothing(browser, one, tab):
    from playwright.sync_api import Error

    studio = one[0]
    for how in ("close", "crash"):
        other = Tab(browser, one[1])
        other.check("trajectories")
        other.press("play")
        other.page.wait_for_timeout(300)
        if how == "close":
            other.page.close()
        else:
            with contextlib.suppress(Error):  # the page's process ends at once, without a farewell
                other.page.goto("chrome://crash")
        until(lambda: len(studio.pages) == 1)
        tab.type("time", 0.3 if how == "close" else 0.6)
        tab.settled()
        assert shows(tab, exact(studio, tab, time=0.3 if how == "close" else 0.6), 2)
    assert not studio.desk.is_due()


def test_it_plays_and_pauses(tab):
    tab.settled()
    tab.choose("speed", "4")
    tab.press("play")
    seen = [tab.picture() for _ in range(4) if tab.page.wait_for_timeout(300) is None]
    assert sum(far(a, b) > 0.5 for a, b in zip(seen, seen[1:])) >= 2
    tab.press("pause")
    tab.settled()
    assert tab.has("play")


def test_a_camera_that_is_clicked_shows_its_image(one, tab):
    studio = one[0]
    tab.settled()
    tab.check("show cameras")
    tab.page.wait_for_timeout(1000)
    tab.page.mouse.move(200, 300)
    for _ in range(4):
        tab.page.mouse.wheel(0, 500)
        tab.page.wait_for_timeout(300)
    tab.page.wait_for_timeout(1200)
    found = click_a_camera(studio, tab)
    until(lambda: "truth, prediction, error" in tab.status())
    name = studio.scene.train[found].name
    assert f"training image {name}:" in tab.status()
    seen = tab.settled("truth")
    frame = studio.scene.train[found]
    assert far(seen, exact(studio, tab, pose=frame.camera.camera_to_world, stand=found)) < 3
    tab.press("leave it")
    alone = tab.settled()
    fov = vertical_fov(frame.camera)
    there = exact(studio, tab, pose=frame.camera.camera_to_world, fov=fov, time=frame.time)
    tab.check("show cameras", False)
    assert shows(tab, there, 3)
    assert far(alone, seen) > 5
    tab.type("image", 1)
    until(lambda: f"training image {studio.scene.train[1].name}:" in tab.status())
    until(left_by_turning, tab)
    assert not tab.has("leave it")


def left_by_turning(tab) -> bool:
    """Turn the camera; a drag while the page still moves it there is one too early."""
    tab.turn()
    tab.page.wait_for_timeout(500)
    return "truth" not in tab.status()


def click_a_camera(studio, tab) -> int:
    """Click where a camera stands; returns the training image that is shown."""
    page = studio.pages[0]
    look, (width, height) = page.visit.look, page.canvas()
    camera = camera_of(look, width, height, studio.scene)
    apexes = torch.stack([frame.camera.center for frame in studio.scene.train])
    pixels, depth = camera.project(apexes)
    inside = (pixels > 60).all(-1) & (pixels[:, 0] < width - 60) & (pixels[:, 1] < height - 60) & (depth > 0)
    for index in inside.nonzero()[:, 0].tolist():
        tab.click(float(pixels[index, 0] / width), float(pixels[index, 1] / height))
        tab.page.wait_for_timeout(1500)
        if page.visit.look.stand is not None:
            return page.visit.look.stand
    raise AssertionError("no camera was hit")


def test_a_point_that_is_clicked_is_followed(one, tab):
    studio = one[0]
    tab.settled()
    tab.type("time", 1.0)
    plain = tab.settled()
    height, width = plain.shape[:2]
    rows, columns = np.nonzero(plain.min(-1) < 150)  # something that is not the background
    tab.press("follow the point that I click")
    tab.page.wait_for_timeout(500)
    middle = len(rows) // 2
    tab.click(float(columns[middle] / width), float(rows[middle] / height))
    until(lambda: studio.pages[0].visit.look.followed)
    ink = until(lambda: changed(tab.picture(), plain) or None)
    assert ink < 0.1
    tab.press("follow none")
    until(lambda: changed(tab.picture(), plain) == 0)
    tab.check("trajectories")
    until(lambda: changed(tab.picture(), plain) > 1e-3)


def test_screenshots_and_videos_are_saved(one, tab):
    studio, _, folder = one
    tab.settled()
    with tab.page.expect_download() as got:
        tab.press("screenshot")
    assert re.fullmatch(r"vehicle-particles-colour-0\.\d{3}\.png", got.value.suggested_filename)
    shot = iio.imread(got.value.path().read_bytes())
    look, page = studio.pages[0].visit.look, studio.pages[0]
    width, rows = page.visit.full_size()
    assert far(shot, 255 * studio.picture(look, width, rows, bool).numpy()) < 1
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


def test_two_runs_beside_each_other(browser, fitted, particles, tmp_path):
    studio = opened(particles, fitted)
    with serving(studio, tmp_path) as address:
        tab = Tab(browser, address)
        assert shows(tab, exact(studio, tab), 2)
        assert tab.page.get_by_text("left: particles, right: run").is_visible()
        tab.type("image", 2)
        tab.settled("truth")
        pose = studio.scene.train[2].camera.camera_to_world
        assert shows(tab, exact(studio, tab, pose=pose, stand=2), 3)
        assert tab.errors == []
        tab.page.close()


def test_a_run_is_seen_while_it_trains(browser, fitted, tmp_path):
    command = [sys.executable, "-u", "-m", "forewarp.cli.train", *words(fitted, 1200)]
    command += [f"run={tmp_path}/run", "viewer=true", "port=0"]
    with open(tmp_path / "said", "w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, cwd=tmp_path)
    try:
        found = until(lambda: re.search(r"see it: (\S+)", (tmp_path / "said").read_text()), seconds=60)
        tab = Tab(browser, found[1])
        first = until(step_said, tab)
        before = tab.picture()
        tab.press("play")
        until(lambda: (step_said(tab) or 0) > first + 50)
        assert far(before, tab.picture()) > 1
        assert tab.errors == []
        tab.page.close()
        assert process.wait(180) == 0
    finally:
        process.kill()
    assert f"see it again: forewarp-view run={tmp_path}/run" in (tmp_path / "said").read_text()


def step_said(tab) -> int | None:
    """The step that the page says training has reached."""
    found = re.search(r"step (\d+)", tab.status())
    return found and int(found[1])
