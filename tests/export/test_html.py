"""The exported page: what is in it, and the page in a real browser."""

import base64
import io
import re

import imageio.v3 as iio
import msgspec
import numpy as np
import pytest
import torch
import zstandard
from scipy.spatial import KDTree

from tests.export.conftest import TIMES, exporter
from tests.support.browser import Tab, chromium, until

export = exporter("html", points=200, seconds=2.0, megabytes=20.0)


def read(folder):
    """What the page plays: pairs of a second and a message, with arrays in their places."""
    text = (folder / "scene.html").read_text()
    data = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', text)[1])
    size = int.from_bytes(data[:8], "little")
    raw = zstandard.ZstdDecompressor().decompress(data[8:], max_output_size=size)
    at = 8 + int.from_bytes(raw[:8], "little")
    content, buffers = msgspec.msgpack.decode(raw[8:at]), []
    for length in content["binaryBufferLengths"]:
        at += -at % 8
        buffers.append(raw[at : at + length])
        at += length

    def filled(value):
        if isinstance(value, dict) and "__binary_index" in value:
            return np.frombuffer(buffers[value["__binary_index"]], value["dtype"])
        return {key: filled(part) for key, part in value.items()} if isinstance(value, dict) else value

    return content["durationSeconds"], [(second, filled(message)) for second, message in content["messages"]]


def shown(messages, part, last):
    """The scene's props at the start, and what it is when everything until a second was played."""
    of_scene = [(s, m) for s, m in messages if m.get("name") == "/scene" and s <= last]
    props = next(dict(m["props"]) for _, m in of_scene if "props" in m)
    for _, message in of_scene:
        props |= message.get("updates", {})
    return props, props[part]


def test_particles_are_splats_of_each_time(particles, tmp_path):
    about = export(particles, tmp_path / "html")
    assert "thinned" not in about
    duration, messages = read(tmp_path / "html")
    assert duration == pytest.approx(3.0)  # the last time is shown as long as others are, on average
    for time in TIMES:
        cloud = particles.method.ellipsoids(time)
        props, buffer = shown(messages, "buffer", 2 * time + 1e-6)
        table = buffer.view("<f4").reshape(-1, 8)
        assert len(table) == len(cloud) == about["particles"]
        chosen = KDTree(cloud.centers).query(props["scale"] * table[:, :3])[1]
        assert len(set(chosen)) == len(chosen)
        np.testing.assert_allclose(props["scale"] * table[:, :3], cloud.centers[chosen], atol=1e-5)
        halves = props["scale"] ** 2 * buffer.view("<f2").reshape(-1, 16)[:, 8:14].astype(np.float32)
        wanted = cloud.covariances[chosen][:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        largest = wanted.abs().amax(-1, keepdim=True)
        assert float((abs(torch.from_numpy(halves) - wanted) / largest).max()) < 2e-3
        rgba = buffer.view("u1").reshape(-1, 32)[:, 28:] / 255
        np.testing.assert_allclose(rgba[:, :3], cloud.colors[chosen], atol=0.005)
        np.testing.assert_allclose(rgba[:, 3], cloud.opacity[chosen], atol=0.005)


@pytest.mark.parametrize("shade", [0, 255])
def test_voxels_are_points_of_each_time_before_the_background_of_exact_images(ball, tmp_path, shade):
    object.__setattr__(ball, "background", (shade / 255,) * 3)
    about = export(ball, tmp_path / "html")
    _, messages = read(tmp_path / "html")
    first = torch.from_numpy(shown(messages, "points", 0.0)[1].reshape(-1, 3).copy())
    assert len(first) == about["points"] == 200
    wanted = ball.method.trajectories(first, torch.tensor(TIMES))
    for row, time in enumerate(TIMES):
        props, points = shown(messages, "points", 2 * time + 1e-6)
        np.testing.assert_allclose(points.reshape(-1, 3), wanted[:, row], atol=1e-5)
        np.testing.assert_allclose(props["colors"].reshape(-1, 3) / 255, torch.sigmoid(2 * first), atol=0.005)
    behind = [message["rgb_data"] for _, message in messages if message["type"] == "BackgroundImageMessage"]
    assert (iio.imread(io.BytesIO(bytes(behind[-1])))[..., :3] == shade).all()


def test_what_does_not_fit_is_left_out_and_said(particles, tmp_path):
    object.__setattr__(particles, "times", tuple(i / 39 for i in range(40)))
    most = 0.87  # viser's own page has 0.82
    about = export(particles, tmp_path / "html", megabytes=most)
    assert (tmp_path / "html" / "scene.html").stat().st_size <= most * 1e6
    count = len(particles.method.means)
    assert about["thinned"] == f"{about['particles']} of {count} particles, 12 of 40 times"
    assert 10 < about["particles"] < count
    seconds = sorted({second for second, _ in read(tmp_path / "html")[1]})
    np.testing.assert_allclose(seconds, 2 * np.array(about["times on the page"]), atol=1e-6)
    with pytest.raises(ValueError, match="megabytes: expected room for the page, but got 0.5"):
        export(particles, tmp_path / "none", megabytes=0.5)


@pytest.mark.browser
@pytest.mark.slow
def test_its_slider_goes_through_time_when_the_page_is_opened_as_a_file(particles, ball, tmp_path):
    with chromium() as browser:
        for source in (particles, ball):
            folder = tmp_path / source.model
            export(source, folder)
            tab = Tab(browser, None, width=480, height=360)
            tab.page.goto((folder / "scene.html").as_uri())
            tab.page.locator("input").first.fill("1.0", timeout=30000)  # typing stops the recording
            begin = until(settled, tab, 0.0)
            end = until(settled, tab, 1.9, begin, 0.5)
            until(settled, tab, 0.0, begin, 0.0, 0.3 * away(end, begin))
            # Splats are sorted by a worker, which browsers refuse to such a page at its plain address.
            workers = [worker.url.partition(":")[0] for worker in tab.page.workers]
            assert workers == (["data"] if source is particles else [])
            assert tab.errors == []
            tab.page.close()


def settled(tab, second, before=0.0, least=0.0, most=float("inf")):
    """Go to a second; the image once it stays, and differs from the one before as it should."""
    field = tab.page.locator("input").first
    if field.input_value() != f"{second}":
        field.fill(f"{second}")
    first = shot(tab)
    tab.page.wait_for_timeout(500)  # splats fade in
    image = shot(tab)
    stays = away(first, image) < 0.05 and image.std() > 5
    return image if stays and least <= away(before, image) <= most else None


def shot(tab):
    """What the page shows, beside viser's notice."""
    box = tab.canvas()
    clip = box | {"x": box["x"] + 0.4 * box["width"], "width": 0.6 * box["width"]}
    return iio.imread(io.BytesIO(tab.page.screenshot(clip=clip)))[..., :3].astype(float)


def away(one, other):
    """Mean difference of two images, of 255."""
    return abs(one - other).mean()
