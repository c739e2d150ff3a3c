"""The page of a run in a real browser, opened from the disk."""

import io

import imageio.v3 as iio
import pytest
import torch

from forewarp.drawing.images import write_video
from forewarp.export.html import player_of, script_digests
from forewarp.export.tracks import Source
from forewarp.report.run_page import Media, Shown, read_story, write_run_page
from tests.report.test_run_page import told_run
from tests.support.browser import Tab, chromium, until
from tests.support.particles import module_with, small_data

pytestmark = [pytest.mark.browser, pytest.mark.slow]
COLORS = {"truth": (1.0, 0, 0), "prediction": (0.0, 0, 1), "error": (0.0, 0, 0), "depth": (1.0, 1, 0)}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A page whose truth is red and whose prediction is blue; of the second view green and white."""
    root = tmp_path_factory.mktemp("run")
    effects = {"motion": {"choice": "dct", "on": True, "because": "a reason " * 30}}
    folder = told_run(root, views=40, plan={"effects": effects}, command="forewarp-train " + "a.b=c/" * 60)
    plain = {name: torch.tensor(color).expand(60, 80, 3) for name, color in COLORS.items()}
    green = torch.tensor([0.0, 1, 0]).expand(60, 80, 3)
    second = plain | {"truth": green, "prediction": torch.ones(60, 80, 3)}
    views = [Shown("best", "test/r_1, 30.0 dB", plain), Shown("worst", "test/r_2, 20.0 dB", second)]
    film = write_video(root / "film.mp4", (torch.full((32, 32, 3), i / 9) for i in range(10)), fps=10)
    path = root / "page.html"
    write_run_page(path, read_story(folder), Media(views, film, "once around"), megabytes=4)
    return path


@pytest.fixture(scope="module")
def browser():
    with chromium() as chrome:
        yield chrome


@pytest.fixture(params=[1280, 390])
def tab(browser, file, request):
    """The page at two widths; nothing is fetched, and nothing is complained of."""
    tab, fetched = Tab(browser, None, width=request.param), []
    tab.page.on("request", lambda asked: fetched.append(asked.url))
    tab.page.goto(file.as_uri())
    yield tab
    assert tab.errors == []
    assert [url for url in fetched if not url.startswith(("file:", "data:"))] == []
    tab.page.close()


def pair(tab, number=0):
    """Truth and prediction of a view, as they are shown."""
    shot = tab.page.locator(f"#p{number} .pair").screenshot()
    return iio.imread(io.BytesIO(shot))[..., :3].astype(float) / 255


def share(picture, color):
    """How much of a picture has about a color."""
    return float((abs(picture - torch.tensor(color).numpy()).max(-1) < 0.2).mean())


def slider(tab, number=0):
    return tab.page.get_by_role("slider").nth(number)


def test_the_slider_moves_by_keys_and_by_the_pointer(tab):
    red, blue = COLORS["truth"], COLORS["prediction"]
    first = pair(tab)
    assert share(first, red) > 0.4
    assert share(first, blue) > 0.4
    slider(tab).focus()
    tab.page.keyboard.press("End")
    assert share(pair(tab), red) > 0.85
    tab.page.keyboard.press("Home")
    assert share(pair(tab), blue) > 0.85
    for _ in range(25):
        tab.page.keyboard.press("ArrowRight")
    assert share(pair(tab), red) == pytest.approx(0.25, abs=0.05)
    assert slider(tab).get_attribute("aria-valuetext") == "25 % truth, 75 % prediction"
    box = tab.page.locator("#p0 .pair").bounding_box()
    tab.page.locator("#p0 .pair").click(position={"x": 0.75 * box["width"], "y": 0.3 * box["height"]})
    assert share(pair(tab), red) == pytest.approx(0.75, abs=0.05)


def test_a_view_is_chosen_by_a_click_and_by_keys(tab):
    green = (0.0, 1.0, 0.0)
    assert not tab.page.locator("#p1").is_visible()
    tab.page.get_by_text("worst", exact=True).click()
    assert share(pair(tab, 1), green) > 0.4
    assert not tab.page.locator("#p0").is_visible()
    tab.page.keyboard.press("ArrowLeft")
    assert share(pair(tab), COLORS["truth"]) > 0.4


def test_nothing_is_wider_than_the_page_and_the_video_plays(tab):
    video = tab.page.locator("video")
    until(lambda: video.evaluate("video => video.currentTime > 0.2 && video.videoWidth == 32"))
    # Last, as a browser pauses what it has scrolled away.
    tab.page.locator("summary").click()
    wide, room = tab.page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    assert wide <= room
    assert tab.page.locator("svg").count() == 2
    assert min(box["height"] for box in (one.bounding_box() for one in tab.page.locator("svg").all())) > 100


def test_it_is_dark_where_that_is_preferred_and_still_where_motion_is_not(browser, file):
    page = browser.new_page(color_scheme="dark", reduced_motion="reduce")
    page.goto(file.as_uri())
    light, ink = page.evaluate(
        "[getComputedStyle(document.body).backgroundColor, getComputedStyle(document.body).color].map("
        "text => text.match(/\\d+/g).map(Number).reduce((a, b) => a + b))"
    )
    assert light < 120
    assert ink > 600
    assert page.locator("video").evaluate("video => video.paused")
    page.close()


def test_without_scripts_truth_and_prediction_stand_beside_each_other(browser, file):
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(file.as_uri())
    truth, guess = (page.locator(f"#p0 .{name} img").bounding_box() for name in ("truth", "prediction"))
    assert truth["x"] + truth["width"] <= guess["x"]
    assert abs(truth["y"] - guess["y"]) < 1
    page.get_by_text("worst", exact=True).click()
    assert page.locator("#p1").is_visible()
    context.close()


def test_particles_play_in_it_by_the_player_s_own_scripts_alone(browser, tmp_path):
    data = small_data()
    module = module_with(data)
    cameras = [frame.camera for frame in data.scene.train]
    source = Source(module, "particles", cameras, [0.0], name="</iframe>")
    text, _ = player_of(source)
    media, page = Media(), tmp_path / "page.html"
    assert not media.play(text, script_digests(), 1e5)
    assert media.play(text, script_digests(), 1e6, torch.rand(20, 40, 3), framed=True)
    write_run_page(page, read_story(told_run(tmp_path)), media, megabytes=1)
    tab = Tab(browser, None, width=900)
    tab.page.goto(page.as_uri())
    frame = tab.page.locator("iframe")
    box = frame.bounding_box()
    assert box["width"] / box["height"] == pytest.approx(2, rel=0.02)
    assert 'url("data:image/jpeg' in frame.evaluate("(frame) => getComputedStyle(frame).backgroundImage")
    inner = tab.page.frames[1]
    assert inner.evaluate("forewarp.then((door) => door.settled()).then(() => document.title)") == "</iframe>"
    until(lambda: inner.evaluate("forewarp.then(({player}) => player.time > 0)"))
    assert [worker.url.partition(":")[0] for worker in tab.page.workers] == ["data"]
    assert tab.errors == []
    tab.page.close()
