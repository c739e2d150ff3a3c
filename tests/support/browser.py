"""A real browser without a window, and the page in it as a person uses it."""

from __future__ import annotations

import io
import os
import shutil
import time
from contextlib import contextmanager

import imageio.v3 as iio
import numpy as np
import pytest

NEEDED = "FOREWARP_NEED_BROWSER"  # set to 1: a missing browser is a failure
# Without a graphics card; --no-sandbox as root may not make a sandbox.
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"]
_PATIENCE = 20.0  # seconds for anything to appear


def missing(what: str):
    """Skip, or fail where a browser is needed."""
    say = f"{what}; make install-browser adds it"
    return pytest.fail(say) if os.environ.get(NEEDED) == "1" else pytest.skip(say)


@contextmanager
def chromium():
    """A headless browser; skips or fails without one."""
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError:
        missing("no playwright")
    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        except Error as error:
            missing(f"no chromium ({str(error).splitlines()[0]})")
        yield browser
        browser.close()


class Tab:
    """A page of the viewer; ``errors`` is what its console complains of."""

    def __init__(self, browser, address: str, width: int = 900, height: int = 500) -> None:
        self.page = browser.new_page(viewport={"width": width, "height": height})
        self.errors = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", lambda m: m.type == "error" and self.errors.append(m.text))
        self.page.goto(address)
        self.page.get_by_text("pictures/s").wait_for(timeout=1000 * _PATIENCE)
        for close in self.page.locator(".mantine-Notification-closeButton").all():
            close.click()  # "WebGL is running in software mode"

    def status(self) -> str:
        """The line that says how fast pictures come."""
        return self.page.get_by_text("pictures/s").inner_text()

    def picture(self) -> np.ndarray:
        """What the canvas shows, (H, W, 3) uint8."""
        box = self.page.locator("canvas").first.bounding_box()
        box["width"] = min(box["width"], self.page.locator(".mantine-Paper-root").last.bounding_box()["x"])
        return iio.imread(io.BytesIO(self.page.screenshot(clip=box)))[..., :3]

    def settled(self, text: str = "exact") -> np.ndarray:
        """The picture once its size is the full one and it stays the same."""
        return until(self._still, text)

    def _still(self, text: str):
        said = self.status()
        if text not in said or "while moving" in said:
            return None
        before = self.picture()
        self.page.wait_for_timeout(250)
        after = self.picture()
        return after if (before == after).all() else None

    def set_time(self, time: float) -> None:
        """Type a time beside the slider."""
        field = self.page.locator("input[type=text]").first
        field.fill(str(time))
        field.press("Enter")

    def press(self, label: str) -> None:
        """Press a button."""
        self.page.get_by_role("button", name=label, exact=True).click()

    def choose(self, now: str, then: str) -> None:
        """Choose from a list that shows ``now``."""
        self.page.locator(f'input[value="{now}"]').first.click()
        self.page.get_by_role("option", name=then, exact=True).click()

    def turn(self, right: int = 120, down: int = 0) -> None:
        """Drag the camera around."""
        mouse = self.page.mouse
        mouse.move(250, 300)
        mouse.down()
        mouse.move(250 + right, 300 + down, steps=6)
        mouse.up()


def until(found, *arguments, seconds: float = _PATIENCE):
    """Wait for a truthy answer."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        answer = found(*arguments)
        if answer is not None and answer is not False:
            return answer
        time.sleep(0.1)
    raise AssertionError(f"waited {seconds} s in vain for {found.__name__}{arguments}")
