"""The exported page in a real browser."""

import io
import threading
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import imageio.v3 as iio
import pytest

from forewarp.export.page import WORKERS
from tests.export.test_page import export
from tests.support.browser import Tab, chromium, until

pytestmark = [pytest.mark.browser, pytest.mark.slow]


@pytest.mark.parametrize("kind", ["particles", "ball"])
def test_its_slider_goes_through_time_without_a_server(request, tmp_path, kind):
    export(request.getfixturevalue(kind), tmp_path / "html")
    with chromium() as browser:
        tab = Tab(browser, None)
        tab.page.goto((tmp_path / "html" / "scene.html").as_uri())
        field = tab.page.locator("input").first
        field.wait_for(timeout=30000)

        def settled(is_right):  # a slow browser takes a while, and then draws fewer pixels
            before = shot(tab)
            tab.page.wait_for_timeout(500)
            after = shot(tab)
            return after if away(before, after) < 0.05 and after.std() > 5 and is_right(after) else None

        field.fill("1.0")  # typing also stops the recording
        field.fill("0.0")
        tab.page.wait_for_timeout(3000)  # until splats have faded in
        begin = until(settled, lambda picture: True)
        field.fill("1.9")
        end = until(settled, lambda picture: away(begin, picture) > 0.5)
        field.fill("0.0")
        until(settled, lambda picture: away(begin, picture) < 0.3 * away(end, picture))
        assert tab.errors == []


def test_splats_are_in_order_when_the_page_is_opened_as_a_file(particles, tmp_path):
    export(replace(particles, times=particles.times[:1]), tmp_path / "html")
    page = tmp_path / "html" / "scene.html"
    plain = tmp_path / "plain.html"
    plain.write_text(page.read_text().replace(WORKERS, ""))
    handler = partial(Silent, directory=tmp_path)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, chromium() as browser:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        served = f"http://127.0.0.1:{server.server_port}/html/scene.html"
        right, opened, unsorted = (
            drawn(browser, address) for address in (served, page.as_uri(), plain.as_uri())
        )
        server.shutdown()
    assert away(right, opened) < 0.3 * away(right, unsorted)


class Silent(SimpleHTTPRequestHandler):
    """Serves files without telling."""

    def log_message(self, *_):
        """Say nothing."""


def drawn(browser, address):
    """The page's picture once it has settled; a slow browser takes a while, and then draws fewer pixels."""
    tab = Tab(browser, None)
    tab.page.goto(address)
    tab.page.wait_for_timeout(4000)  # until splats have faded in
    shots = [shot(tab)]
    while len(shots) < 30:
        tab.page.wait_for_timeout(1000)
        shots.append(shot(tab))
        if len(shots) > 3 and max(away(shots[-1], one) for one in shots[-4:]) < 0.05 and shots[-1].std() > 5:
            break
    tab.page.close()
    return shots[-1]


def shot(tab):
    """What the page shows, beside viser's notice."""
    box = tab.canvas()
    clip = box | {"x": box["x"] + 0.4 * box["width"], "width": 0.6 * box["width"]}
    return iio.imread(io.BytesIO(tab.page.screenshot(clip=clip)))[..., :3].astype(float)


def away(one, other):
    """Mean difference of two pictures, of 255."""
    return abs(one - other).mean()
