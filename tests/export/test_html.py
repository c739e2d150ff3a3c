"""The page that plays a scene: what is in it, and the page in a real browser."""

import base64
import html
import io
import re
import zlib
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from forewarp import load
from forewarp.drawing.images import to_bytes
from forewarp.evaluation.layers import LAYERS, layer_of
from forewarp.export.glb import packed_scene
from forewarp.export.html import _PLAYER, page, poster
from forewarp.export.tracks import Source
from forewarp.fields.moving import pinhole_of
from forewarp.glb import meshopt
from forewarp.metrics.image import psnr
from forewarp.scene.camera import Lens, orbit
from forewarp.scene.film import TRUST_DEGREES
from forewarp.scene.frame import spread
from forewarp.scene.view import Moment, View
from tests.export.conftest import TIMES, exporter
from tests.glb.test_meshopt import elements
from tests.support.browser import Tab, chromium, until
from tests.support.gltf import motion_of, packed, unpacked
from tests.support.particles import BARE, EVERY, module_with, small_data

export = exporter("html", quality="lossless", seconds=2.0)
ATTACK = "\"'><img src=x onerror=attacked=1></script><script>attacked=1</script> {{scene}} – Ünï\u2028🙂"
CODE = 100_000  # bytes of the page besides scene and poster


def test_the_page_holds_the_scene_and_fetches_nothing(particles, tmp_path):
    about = export(particles, tmp_path / "html")
    text = (tmp_path / "html" / "scene.html").read_text()
    held = re.search(r'id="scene">([^<]+)<', text)[1]
    content, facts = packed_scene(particles, "html", quality="lossless", seconds=2.0)
    assert zlib.decompress(base64.b64decode(held), wbits=-15) == content
    assert facts.items() <= about.items()
    assert facts["moving"] < facts["particles"] <= len(particles.method.gaussians.means)
    picture = re.search(r'src="data:image/jpeg;base64,([^"]+)"', text)[1]
    camera = particles.cameras[0]
    assert iio.imread(base64.b64decode(picture)).shape == (camera.height, camera.width, 3)
    assert len(text) - len(held) - len(picture) < CODE
    assert re.findall(r"https?://|\{\{", text) == []


def test_names_are_text_in_the_page(particles):
    text = page(b"", title=ATTACK, poster=torch.zeros(2, 2, 3), background=(1.0, 0.5, 0.0))
    assert text.count("<script") == 3
    assert "<img src=x" not in text
    assert html.unescape(re.search("<title>(.*)</title>", text)[1]) == ATTACK
    assert 'style="background: rgb(255 128 0)"' in text


def test_scripts_and_styles_name_parts_that_there_are():
    text = (_PLAYER / "player.html").read_text()
    script = "".join(file.read_text() for file in _PLAYER.glob("*.js"))
    named = set(re.findall(r'byId\("([\w-]+)"\)', script)) | set(re.findall(r'click\("([\w-]+)"', script))
    named |= set(re.findall(r"#([a-z]+)\b[^;]*\{", (_PLAYER / "player.css").read_text()))
    assert named <= set(re.findall(r'id="([\w-]+)"', text))


def test_page_and_videos_trust_the_same_angle_where_none_was_measured():
    assert f"const TRUST = {TRUST_DEGREES:g}," in (_PLAYER / "player.js").read_text()


def test_a_method_without_particles_is_refused_with_what_it_can_give(ball, tmp_path):
    with pytest.raises(ValueError, match=r"^format=html: expected .* forward; use format=mesh or gltf"):
        export(ball, tmp_path / "html")
    assert list(tmp_path.iterdir()) == []


# In a browser ----------------------------------------------------------------------------------------------


def in_browser(test):
    """Mark a test that opens the page."""
    return pytest.mark.browser(pytest.mark.slow(test))


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


@pytest.fixture
def tab_of(browser):
    """``tab_of(**options)``: a tab that complains of nothing."""
    tabs = []

    def open_tab(**options):
        tabs.append(Tab(browser, None, **{"width": 320, "height": 320} | options))
        return tabs[-1]

    yield open_tab
    for tab in tabs:
        assert tab.errors == []
        tab.page.close()


@pytest.fixture
def opened(tab_of, particles, tmp_path):
    """``opened(address="", source=None, **options)``: the page of a source, or that of ``particles``."""
    written = []

    def open_page(address="", source=None, **options):
        if source is not None or not written:
            written.append(export(source or replace(particles, name=ATTACK), tmp_path / "html"))
        tab = tab_of(**options)
        go(tab, tmp_path / "html" / "scene.html", address)
        return tab

    return open_page


def go(tab, file, address=""):
    """Open a page, and wait until it has drawn; also where only its address changes."""
    tab.page.goto("about:blank")
    tab.page.goto(file.as_uri() + address)
    tab.page.evaluate(SETTLED)


SETTLED = "forewarp.then((door) => door && door.settled())"
PIXELS = """(asked) => forewarp.then((door) => {
  const bytes = new Uint8Array(door.pixels(asked).buffer);
  let text = "";
  for (let i = 0; i < bytes.length; i += 32768) text += String.fromCharCode(...bytes.subarray(i, i + 32768));
  return btoa(text);
})"""


def state(tab, *names):
    """What the page's player has."""
    return tab.page.evaluate(f"forewarp.then(({{player}}) => [{', '.join(f'player.{n}' for n in names)}])")


def rendered(source, camera, time, method=None):
    """The image (H, W, 3) that the run renders."""
    snapshot = (method or source.method).at(Moment(time))
    image = snapshot.render(View(camera), torch.tensor(source.background))
    return image.rgb.detach().reshape(camera.height, camera.width, 3).clamp(max=1)


def drawn(tab, source, **asked):
    """The image that the page draws, of its floats."""
    text = tab.page.evaluate(PIXELS, asked)
    rgba = torch.frombuffer(bytearray(base64.b64decode(text)), dtype=torch.float32)
    rgba = rgba.reshape(asked["height"], asked["width"], 4)
    return (rgba[..., :3] + (1 - rgba[..., 3:]) * torch.tensor(source.background)).clamp(max=1)


def shown(place):
    """The image that a tab's page, or a part of it, shows, in [0, 1]."""
    image = iio.imread(io.BytesIO(place.screenshot()))[..., :3]
    return torch.from_numpy(image.astype(np.float32) / 255)


def fitted(camera, width, height):
    """The camera of a larger image of another form, in the middle of which is all of its own."""
    scale = min(width / camera.width, height / camera.height)
    camera = camera.resized(round(scale * camera.width), round(scale * camera.height))
    cx, cy = camera.cx + (width - camera.width) / 2, camera.cy + (height - camera.height) / 2
    return replace(camera, width=width, height=height, cx=cx, cy=cy)


@in_browser
def test_it_draws_what_the_method_renders(particles, opened):
    tab, cameras = opened(), particles.cameras
    assert state(tab, "renderer.bits", "scene.cameras.length") == [32, len(cameras)]
    for number in range(10):
        time, which = number / 9, number % len(cameras)
        size = {"width": 160, "height": 120 + 10 * number}
        wanted = rendered(particles, fitted(cameras[which], **size), time)
        got = drawn(tab, particles, time=time, camera=which, **size)
        assert psnr(got, wanted) > 50
        assert float((wanted - wanted[0, 0]).abs().max()) > 0.2


@in_browser
def test_what_is_shown_follows_the_address(particles, opened):
    for number, time in ((0, 0.0), (2, 0.5), (3, 1.0)):
        tab = opened(f"?t={time}&controls=0&camera={number}")
        wanted = rendered(particles, particles.cameras[number].resized(320, 320), time)
        assert psnr(shown(tab.page), wanted) > 40
        assert state(tab, "playing", "time", "camera") == [False, time, number]
    tab = opened("?t=0.25&camera=1#t=0.75&layer=resting")
    assert state(tab, "time", "camera", "layer") == [0.75, 1, "resting"]
    tab.page.evaluate("location.hash = 't=0.5&camera=2'")
    until(lambda: state(tab, "time", "camera") == [0.5, 2])
    tab = opened("?t=x&camera=99&layer=none&autoplay=0")
    assert state(tab, "playing", "time", "camera", "layer") == [False, 0, 0, "all"]
    assert state(opened("?t=0.2&autoplay=1"), "playing") == [True]


@in_browser
def test_layers_are_those_of_the_run(opened):
    data = small_data()
    module = module_with(data, **EVERY)
    nodes, frames = module.method.deformation.nodes, data.scene.train
    right = nodes.positions[:, 0] > nodes.positions[:, 0].median()
    nodes.translations.data[right] += torch.linspace(-0.6, 0.6, nodes.curve.count)[:, None]
    times = [frame.time for frame in frames]
    source = Source(module, "particles", [f.camera for f in frames], TIMES, image_times=times)
    tab = opened(source=source)
    counts = state(tab, "scene.count", "scene.moving", "scene.inMotion")
    assert counts[0] >= counts[1] > counts[2] > 0
    tab.page.keyboard.press("v")
    assert tab.page.locator("#layers").is_visible()
    asked = {"width": 100, "height": 100, "time": 0.4, "camera": 1}
    for layer in LAYERS:
        method = layer_of(module.method, layer, frames)
        wanted = rendered(source, source.cameras[1].resized(100, 100), 0.4, method)
        assert psnr(drawn(tab, source, layer=layer, **asked), wanted) > 50
        assert float((1 - wanted).max()) > 0.1


@in_browser
def test_it_is_played_turned_and_set_by_keys_and_mouse(opened):
    tab = opened("?t=0.5")
    page, first = tab.page, shown(tab.page)[60:240, 20:300]
    page.keyboard.press(" ")
    until(lambda: state(tab, "time")[0] != 0.5)
    assert page.get_by_role("button", name="pause").is_visible()
    page.get_by_label("time", exact=True).fill("0.5")  # pauses
    page.keyboard.press(" ")  # also from the slider
    assert page.get_by_role("button", name="pause").is_visible()
    page.keyboard.press(" ")
    page.get_by_label("time", exact=True).fill("0.5")
    page.evaluate(SETTLED)
    assert psnr(shown(tab.page)[60:240, 20:300], first) > 45
    before = state(tab, "eye")[0]
    page.mouse.move(160, 120)
    page.mouse.down()
    page.mouse.move(220, 140, steps=3)
    page.mouse.up()
    assert state(tab, "eye")[0] != before
    page.mouse.wheel(0, -300)
    for key in ("ArrowLeft", "Shift+ArrowUp", "+", "-", "."):
        page.keyboard.press(key)
    page.evaluate(SETTLED)
    assert psnr(shown(tab.page)[60:240, 20:300], first) < 30
    page.keyboard.press("h")
    page.keyboard.press(",")
    page.evaluate(SETTLED)
    assert state(tab, "time")[0] == pytest.approx(0.5)
    assert psnr(shown(tab.page)[60:240, 20:300], first) > 45
    page.get_by_role("button", name="view and playback").click()
    page.get_by_text("moving", exact=True).click()
    page.get_by_text("½").click()
    page.get_by_role("button", name="trails").click()
    assert state(tab, "layer", "speed", "trails") == ["moving", 0.5, True]
    page.keyboard.press("Escape")
    page.keyboard.press("?")
    assert "32 bits" in page.get_by_role("dialog").inner_text()
    page.keyboard.press("Escape")
    assert not page.get_by_role("dialog").is_visible()


@in_browser
def test_nothing_plays_by_itself_where_motion_is_not_wanted(opened):
    assert state(opened(), "playing") == [True]
    tab = opened(reduced_motion="reduce")
    assert state(tab, "playing") == [False]
    tab.page.goto(tab.page.url + "?autoplay=1")
    tab.page.evaluate(SETTLED)
    assert state(tab, "playing") == [False]


@in_browser
def test_names_are_not_executed(opened):
    tab = opened()
    assert tab.page.evaluate("typeof attacked") == "undefined"
    assert tab.page.evaluate("document.title") == tab.page.locator("h1").text_content() == ATTACK
    assert tab.page.locator("img").count() == 0  # the poster has gone
    assert {worker.url.partition(":")[0] for worker in tab.page.workers} == {"data"}


@in_browser
@pytest.mark.parametrize(
    ("script", "says"),
    [
        ("HTMLCanvasElement.prototype.getContext = () => null", "no WebGL 2"),
        ("delete window.WebGL2RenderingContext", "no WebGL 2"),
        ("delete window.DecompressionStream", "too old"),
    ],
)
def test_a_browser_that_cannot_play_it_shows_a_picture_and_says_so(tab_of, particles, tmp_path, script, says):
    export(particles, tmp_path / "html")
    tab = tab_of()
    tab.page.add_init_script(script)
    tab.page.goto((tmp_path / "html" / "scene.html").as_uri())
    assert tab.page.evaluate("forewarp") is None
    assert says in tab.page.get_by_role("status").inner_text()
    notice = tab.page.locator("#notice").bounding_box()
    seen = to_bytes(poster(particles)).astype(float)
    picture = to_bytes(shown(tab.page)).astype(float)
    step = len(picture) // len(seen)
    small = picture.reshape(len(seen), step, -1, step, 3).mean((1, 3))
    above = small[: int(notice["y"]) // step], seen[: int(notice["y"]) // step]
    assert len(above[0]) > len(seen) / 2
    assert abs(above[0] - above[1]).mean() < 12


@in_browser
def test_it_comes_back_after_the_graphics_card_was_taken_away(opened):
    tab = opened("?t=0.5")
    first = shown(tab.page)
    card = "(window.card = player.renderer.gl.getExtension('WEBGL_lose_context'))"
    tab.page.evaluate(f"forewarp.then(({{player}}) => {card}).then(() => card.loseContext())")
    until(lambda: "taken away" in tab.page.locator("#notice").inner_text())
    tab.page.evaluate("card.restoreContext()")
    until(lambda: not tab.page.locator("#notice").is_visible())
    tab.page.evaluate(SETTLED)
    assert psnr(shown(tab.page), first) > 60
    tab.errors[:] = [error for error in tab.errors if "CONTEXT_LOST" not in error]


@in_browser
def test_it_works_inside_another_page(tab_of, particles, tmp_path):
    file = tmp_path / "outer.html"
    export(particles, tmp_path / "inner")
    file.write_text('<iframe src="inner/scene.html?t=0.5&camera=2&controls=0" width=320 height=320></iframe>')
    tab = tab_of(width=400, height=400)
    tab.page.goto(file.as_uri())
    tab.page.frames[1].evaluate(SETTLED)
    image = shown(tab.page.locator("iframe"))[2:-2, 2:-2]  # without its border
    assert psnr(image, rendered(particles, particles.cameras[2].resized(320, 320), 0.5)) > 40


@in_browser
def test_compressed_views_are_decoded_as_python_encodes_them(opened):
    tab = opened()
    decode = """([data, count, stride, filter]) => {
      const bytes = decodeAttributes(Uint8Array.from(atob(data), (c) => c.charCodeAt(0)), count, stride);
      unfilter(bytes, filter);
      return [...bytes];
    }"""

    def decoded(made, kind="NONE"):
        packed = base64.b64encode(meshopt.encode(made)).decode()
        got = tab.page.evaluate(decode, [packed, *made.shape, kind])
        return np.array(got, np.uint8).reshape(made.shape)

    for count, stride in ((1, 4), (16, 8), (17, 12), (255, 4), (700, 12), (513, 64), (40, 256)):
        made = elements(count, stride)
        np.testing.assert_array_equal(decoded(made), made)
    values = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
    made = meshopt.exponential(values, -9)
    np.testing.assert_array_equal(decoded(made, "EXPONENTIAL").view("<f4"), meshopt.from_exponential(made))
    quaternions = np.random.default_rng(1).normal(size=(300, 4))
    made = meshopt.quaternion(quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True), 9)
    got, wanted = decoded(made, "QUATERNION").view("<i2"), meshopt.from_quaternion(made)
    assert abs(got.astype(int) - wanted.astype(int)).max() <= 1


@in_browser
def test_lenses_bend_what_it_draws(particles, opened):
    lens = Lens((0.5, -0.2, 0.1), (0.05, -0.06))
    cameras = [replace(camera, lens=lens, skew=2.0) for camera in particles.cameras]
    tab = opened(source=replace(particles, cameras=cameras))
    camera = cameras[0].resized(120, 120)
    got = drawn(tab, particles, width=120, height=120, time=0.3, camera=0)
    assert psnr(got, rendered(particles, camera, 0.3)) > 50
    assert psnr(got, rendered(particles, replace(camera, lens=None), 0.3)) < 38
    assert psnr(got, rendered(particles, replace(camera, skew=0.0), 0.3)) < 38
    for k, p in [((0.6, 0.2, 0.0), (0.0, 0.0)), ((-0.3, 0.08, 0.0), (0.02, -0.01)), (lens.k, lens.p)]:
        for focal in (50.0, 90.0, 200.0):
            wide = replace(camera, fx=focal, fy=1.1 * focal, lens=Lens(k, p))
            view = {"bend": [*k, *p], "focal": [wide.fx, wide.fy], "skew": wide.skew, "size": [120, 120]}
            reach = tab.page.evaluate("reachOf", view | {"middle": [wide.cx, wide.cy]})
            assert reach == pytest.approx(pinhole_of(wide, 0.1).reach, rel=1e-4)


@in_browser
def test_each_camera_leaves_out_what_is_too_near_to_it(particles, opened):
    first, second, *others = particles.cameras
    away = float(second.center.norm())  # half of the scene is nearer
    cameras = [first, replace(second, near=10 * away, far=20 * away), *others]
    tab = opened(source=replace(particles, cameras=cameras))
    for number in (0, 1):
        got = drawn(tab, particles, width=120, height=120, time=0.3, camera=number)
        assert psnr(got, rendered(particles, cameras[number].resized(120, 120), 0.3)) > 50
    whole = rendered(particles, second.resized(120, 120), 0.3)
    assert psnr(got, whole) < 30


@in_browser
def test_the_page_of_a_run_looks_as_the_run_renders_it(tab_of, ok, fitted, tmp_path):
    data = [f"data.root={fitted.parent}/scenes", "data=dnerf", "data.scene=vehicle", "budget.minutes=null"]
    words = ["budget.iterations=200", "model=particles", "preset=demo", "trainer=cpu", "evaluate=false"]
    ok("train", *data, *words, f"run={tmp_path}/run", "threads=1")
    said = ok("export", f"run={tmp_path}/run", "format=html", "quality=lossless").out
    file = tmp_path / "run" / "exports" / "html" / "scene.html"
    assert said.startswith(f"written: {file}: 1 file, 0."), said
    run = load(tmp_path / "run")
    train = [frame.camera for frame in run.scene.train]
    cameras = [train[i] for i in sorted({0, *spread(len(train), 12)})]
    tab = tab_of(width=train[0].width, height=train[0].height)
    for number in range(10):
        time, which = number / 9, (5 * number) % len(cameras)
        go(tab, file, f"?t={time}&camera={which}&controls=0")
        assert psnr(shown(tab.page), run.render(cameras[which], time, "white").rgb) > 50


@in_browser
@pytest.mark.parametrize(
    "effects",
    [
        BARE,
        {"motion": "cosines", "rotation": None, "view_dependence": 3},
        {"opacity_over_time": 2},
        {"numbers": {"bodies": 0.5}},
    ],
    ids=["at rest", "cosines", "opacity", "quaternions"],
)
def test_scenes_of_other_effects_are_drawn_too(opened, effects):
    data = small_data()
    module = module_with(data, **effects)
    for parameter in module.method.parameters():
        parameter.data += 0.1 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1))
    source = Source(module, "particles", [frame.camera for frame in data.scene.train], TIMES)
    tab = opened(source=source)
    assert state(tab, "playing") == [module.method.moves]
    for time in (0.0, 0.37, 1.0):
        got = drawn(tab, source, width=120, height=120, time=time, camera=0)
        assert psnr(got, rendered(source, source.cameras[0].resized(120, 120), time)) > 50


@in_browser
def test_trails_follow_what_moves_and_two_fingers_come_nearer(particles, opened):
    tab = opened("?t=0.6&controls=0", has_touch=True)
    plain = shown(tab.page)
    tab.page.keyboard.press("t")
    tab.page.evaluate(SETTLED)
    ink = ((shown(tab.page) - plain).abs().amax(-1) > 0.1).float().mean()
    assert 0.001 < float(ink) < 0.5
    segments = tab.page.evaluate("forewarp.then(({scene}) => [...trailsOf(scene)])")
    path = torch.tensor(segments).reshape(-1, 12)[:96, :4]  # of the first trail
    centers = torch.stack([particles.method.ellipsoids(time).centers for time in path[:, 3].tolist()])
    assert float((centers - path[:, None, :3]).norm(dim=-1).amax(0).min()) < 1e-4
    tab.page.keyboard.press("t")
    away, eye = state(tab, "away", "eye")
    fingers = tab.page.context.new_cdp_session(tab.page)
    for kind, apart in (("touchStart", 40), ("touchMove", 60), ("touchMove", 80)):
        points = [{"x": 160 - apart, "y": 160, "id": 1}, {"x": 160 + apart, "y": 160, "id": 2}]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    fingers.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    until(lambda: state(tab, "away")[0] == pytest.approx(away / 2, rel=0.02))
    before = state(tab, "eye")[0]
    for kind, x in (("touchStart", 160), ("touchMove", 200)):
        points = [{"x": x, "y": 160, "id": 3}]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    fingers.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    until(lambda: state(tab, "eye")[0] != before)
    assert state(tab, "away")[0] == pytest.approx(away / 2, rel=0.02)
    assert eye != before


@in_browser
def test_a_broken_scene_is_told_and_the_picture_stays(browser, particles, tmp_path):
    content, _ = packed_scene(particles, "html", quality="compact", seconds=2.0)

    def with_motion(**changes):
        description, binary = unpacked(content)
        motion_of(description).update(changes)
        return packed(description, binary)

    file, looks = tmp_path / "scene.html", {"poster": poster(particles), "background": (1.0, 1.0, 1.0)}
    for broken, says in (
        (content[:-100], "cut off"),
        (b"PK" + content, "expected a glTF 2.0 binary"),
        (with_motion(version="2.0"), "expected FOREWARP_gaussian_motion 1, but got 2.0"),
        (with_motion(features=["births"]), "does not know births"),
        (content.replace(b"FOREWARP_gaussian_motion", b"FOREWARP_gaussian_others"), "expected KHR_gaussian"),
    ):
        file.write_text(page(broken, title="scene", **looks))
        tab = Tab(browser, None, width=320, height=320)
        tab.page.goto(file.as_uri())
        tab.page.get_by_text(says).wait_for()
        assert tab.page.locator("#poster").is_visible()
        tab.page.close()


@in_browser
def test_the_view_rides_along_with_one_camera_leans_and_springs_back(tab_of, particles, tmp_path):
    first, times = particles.cameras[0], torch.linspace(0, 1, 20, dtype=torch.float64)
    path = orbit(first, torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 0, 1]).double(), 0.2 * times)
    times = times.tolist()
    source = replace(particles, cameras=path, image_times=times)
    export(source, tmp_path / "html")
    tab, file = tab_of(), tmp_path / "html" / "scene.html"
    for time in (0.0, times[10], 1.0):
        go(tab, file, f"?t={time}&controls=0")
        camera = path[times.index(time)]
        assert state(tab, "riding") == [True]
        np.testing.assert_allclose(state(tab, "eye")[0], camera.center, atol=0.02)
        np.testing.assert_allclose(state(tab, "ahead")[0], camera.camera_to_world[:3, 2], atol=0.02)
        np.testing.assert_allclose(state(tab, "down")[0], camera.camera_to_world[:3, 1], atol=0.02)
    beside = "beside() * 180 / Math.PI"
    tab.page.mouse.move(160, 160)
    tab.page.mouse.down()
    tab.page.mouse.move(310, 40, steps=3)
    assert 7 < state(tab, beside)[0] < 8.001
    tab.page.mouse.up()
    until(lambda: state(tab, beside)[0] < 0.05)
    tab.page.keyboard.press("ArrowLeft")
    assert 1 < state(tab, beside)[0] < 8.001
    until(lambda: state(tab, beside)[0] < 0.05)
    assert state(tab, "riding") == [True]
    tab.page.mouse.move(160, 160)
    tab.page.mouse.wheel(0, -300)
    until(lambda: state(tab, "zoom > 1")[0])
    assert state(tab, beside)[0] < 0.05
    tab.page.keyboard.press("r")
    for _ in range(4):
        tab.page.keyboard.press("ArrowLeft")
    tab.page.evaluate(SETTLED)
    assert state(tab, "riding", f"{beside} > 10") == [False, True]
    assert tab.page.get_by_text("beside the film, which shows up to 8°").is_visible()
    eye = state(tab, "eye")[0]
    tab.page.keyboard.press("r")
    tab.page.evaluate(SETTLED)
    assert state(tab, "riding", "eye") != [True, eye]
    assert not tab.page.locator("#edge").is_visible()
    go(tab, file, "?t=0.5&camera=3")
    assert state(tab, "riding") == [False]
    export(replace(source, image_times=[(7 * i % 20) / 19 for i in range(20)]), tmp_path / "html")
    go(tab, file)
    assert state(tab, "riding", "path") == [False, None]  # of many cameras, or one that jumps
