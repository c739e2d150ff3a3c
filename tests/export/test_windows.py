"""A film in windows: one file, what stands still stored once, each window drawn at its own time."""

import copy
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

import forewarp
from forewarp.export.glb import packed_scene, shared_in
from forewarp.export.tracks import Source
from forewarp.fields.windows import MovingWindows, check_windows
from forewarp.glb.reader import read
from forewarp.methods.method import Start
from forewarp.methods.particles import windows as particle_windows
from forewarp.methods.particles.model import Particles
from forewarp.metrics.image import psnr
from forewarp.runs.windows import check_film
from forewarp.scene.view import Moment, View
from tests.export.conftest import exporter
from tests.export.test_html import SETTLED, drawn
from tests.glb.plain_reader import PlainScene
from tests.glb.test_plain_reader import assert_alike
from tests.support.browser import Tab, chromium, until
from tests.support.gltf import motion_of, packed, unpacked
from tests.support.particles import BARE, EVERY, module_with, small_data

SPANS = (0.0, 0.55), (0.45, 1.0)
TIMES = (0.0, 0.3, 0.4999, 0.5, 0.53, 0.56, 1.0)


def below(still, frame):
    """As if the lower part of all images showed something that moves."""
    wrong = torch.zeros(frame.camera.height, frame.camera.width, dtype=torch.bool)
    wrong[frame.camera.height // 2 :] = True
    return wrong


@pytest.fixture(scope="module")
def film():
    """Two windows that begin from the same particles, each with random ones of its own; rotations of the
    second are quaternions.
    """
    data = small_data()
    still, generator = module_with(data, **BARE).method, torch.Generator().manual_seed(0)
    sources, cameras = [], [frame.camera for frame in data.scene.train]
    for span, begin, numbers in zip(SPANS, (0.0, 0.5), ({}, {"bodies": 0.5})):
        module = module_with(data, **EVERY)
        start = Start(data.scene, "fine", numbers, list(range(len(cameras))), None, still, shares=True)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(particle_windows, "wrong_pixels", below)
            module.method = method = Particles(start, **EVERY)
        own = method.shared < 0
        for p in (method.gaussians.means, method.gaussians.opacity):
            p.data[own] += 0.1 * torch.randn(p[own].shape, generator=generator)
        paths = method.deformation.nodes.translations
        paths.data += 0.1 * torch.randn(paths.shape, generator=generator)
        method.gaussians.opacity.data[own] += 1
        taken = torch.linspace(0, 1, len(cameras)).tolist()
        sources.append(Source(module, "particles", cameras, (0.0,), (1.0,) * 3, "film", taken, span, begin))
    return replace(sources[0], later=sources[1:])


@pytest.fixture
def written(film, tmp_path):
    """``written(quality)``: the file and the facts."""

    def write(quality="lossless"):
        content, facts = packed_scene(film, "glb", quality=quality, seconds=3.0)
        (tmp_path / "scene.glb").write_bytes(content)
        return tmp_path / "scene.glb", facts

    return write


def image(film, camera, time):
    """What the windows' runs show at a time of the film: at the seam from 0.45 to 0.55 more and more of the
    second one.
    """
    share, seen = min(max((time - 0.45) / 0.1, 0.0), 1.0), []
    for source in (film, film.later[0]):
        first, last = source.span
        moment = Moment(min(max((time - first) / (last - first), 0.0), 1.0))
        seen.append(source.method.at(moment).render(View(camera), torch.ones(3)).rgb.detach().clamp(0, 1))
    return torch.lerp(*seen, share).reshape(camera.height, camera.width, 3)


@pytest.mark.slow
@pytest.mark.parametrize(("quality", "least"), [("lossless", 60.0), ("compact", 35.0)])
def test_each_time_is_drawn_by_its_window(film, written, quality, least):
    file, facts = written(quality)
    scene = forewarp.load(file)
    assert facts["windows"] == 2
    assert facts["shared"] > 5
    assert motion_of(unpacked(file.read_bytes())[0])["features"] == ["quaternions", "windows"]
    for time in TIMES:
        camera = film.cameras[1]
        assert psnr(scene.render(camera, time).rgb, image(film, camera, time)) > least, time
    ends = [scene.render(film.cameras[1], time).rgb for time in (0.45, 0.55)]
    assert float((ends[0] - ends[1]).abs().max()) > 0.05


@pytest.mark.slow
def test_what_all_windows_share_is_stored_once(film, written):
    file, facts = written()
    gaussians = read(file).gaussians
    assert isinstance(gaussians, MovingWindows)
    assert gaussians.moves
    counts = [len(window.gaussians.means) for window in gaussians.windows]
    assert sum(counts) == facts["particles"] + facts["shared"]
    last = [window.gaussians.means[-facts["shared"] :] for window in gaussians.windows]
    assert torch.equal(*last)
    ids, still = film.method.common(), shared_in([film, *film.later])
    known = {tuple(row) for row in film.method.gaussians.means[still[0]].tolist()}
    assert {tuple(row) for row in last[0].tolist()} <= known
    assert int((ids >= 0).sum()) >= int(still[0].sum()) >= facts["shared"]


def test_windows_that_began_from_another_run_are_refused(film):
    """Else those of the first window would be drawn in all."""
    method = copy.deepcopy(film.later[0].method)
    method.gaussians.means.data[method.shared >= 0] += 0.1
    retrained = replace(film.later[0], module=SimpleNamespace(method=method))
    with pytest.raises(ValueError, match="^run: expected windows that begin from the same run, but window 2"):
        shared_in([film, retrained])


@pytest.mark.slow
def test_the_page_suffices_to_draw_a_film(film, written):
    file, _ = written()
    scene = forewarp.load(file)
    assert_alike(PlainScene(file), scene, scene.cameras)


def test_a_single_window_is_a_file_like_any_other(film, tmp_path):
    content, _ = packed_scene(replace(film, later=()), "glb", quality="lossless", seconds=1)
    (tmp_path / "one.glb").write_bytes(content)
    assert not isinstance(read(tmp_path / "one.glb").gaussians, MovingWindows)
    assert b"windows" not in content


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"list": []}, "windows.list: expected 2 to 1000 windows, but got 0"),
        ({"shared": 10**6}, "windows.shared: expected a whole number from 0"),
        ({"list": [{"span": [0, 0.4], "from": 0}, {"mesh": 1, "span": [0.45, 1], "from": 0.5}]}, "within"),
        ({"list": [{"span": [0, 0.6], "from": 0}, {"mesh": 9, "span": [0.45, 1], "from": 0.5}]}, "mesh: exp"),
        ({"list": [{"span": [0, 2], "from": 0}, {"mesh": 1, "span": [0, 1], "from": 0.5}]}, "spans in"),
    ],
)
def test_windows_that_cannot_be_are_refused(written, change, line):
    file, _ = written()
    description, binary = unpacked(file.read_bytes())
    motion_of(description)["windows"] |= change
    file.write_bytes(packed(description, binary))
    with pytest.raises(ValueError, match=line):
        read(file)


def test_windows_make_up_a_whole_film(tmp_path):
    check_film([(0.0, 0.333333), (0.333333, 0.666667), (0.666667, 1.0)], tmp_path)
    for windows in ([], [(0.0, 0.5)], [(0.0, 0.5), (0.6, 1.0)], [(0.0, 0.5), (0.0, 0.5), (0.5, 1.0)]):
        with pytest.raises(ValueError, match="expected a run, or windows that follow one another"):
            check_film(windows, tmp_path)
    with pytest.raises(ValueError, match=r"but got 0 in \[0, 0.4\], 0.5 in \[0.5, 1\]"):
        check_windows([0.0, 0.5], [(0.0, 0.4), (0.5, 1.0)], 0.0)


@pytest.mark.browser
@pytest.mark.slow
def test_the_page_draws_the_windows_and_plays_over_their_seam(film, tmp_path):
    facts = exporter("html", quality="lossless", seconds=2.0)(film, tmp_path / "html")
    assert facts["windows"] == 2
    with chromium() as browser:
        tab = Tab(browser, None, width=320, height=320)
        tab.page.goto((tmp_path / "html" / "scene.html").as_uri() + "?autoplay=0")
        tab.page.evaluate(SETTLED)
        for time in (*TIMES, 0.3):
            camera = film.cameras[0]
            asked = {"width": camera.width, "height": camera.height, "time": time, "camera": 0}
            assert psnr(drawn(tab, film, **asked), image(film, camera, time)) > 55, time
        tab.page.evaluate("forewarp.then(({player}) => { player.setTime(0.45); player.play(true); })")
        until(lambda: tab.page.evaluate("forewarp.then(({player}) => player.time > 0.6)"))
        assert tab.page.evaluate("forewarp.then(({player}) => player.scene === player.windows[1].scene)")
        assert tab.errors == []
        tab.page.close()
