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
# Without a graphics card; --no-sandbox, as root may make none.
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"]
# What viser itself logs as an error when it is given splats of any kind.
_OF_VISER = "computeBoundingSphere(): Computed radius is NaN"
_PATIENCE = 30.0  # seconds for anything to appear


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
    """A page of the viewer in a context of its own; ``errors`` is what its console complains of."""

    def __init__(self, browser, address: str | None, width: int = 900, height: int = 640, **options) -> None:
        self.page = browser.new_page(viewport={"width": width, "height": height}, **options)
        self.errors = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", self._said)
        if address is not None:
            self.open(address)

    def open(self, address: str) -> None:
        """Go to the page and wait for its first picture."""
        self.page.goto(address)
        self.page.get_by_text("images/s").wait_for(timeout=1000 * _PATIENCE)
        for close in self.page.locator(".mantine-Notification-closeButton").all():
            close.click()  # "WebGL is running in software mode"

    def _said(self, message) -> None:
        if message.type == "error" and _OF_VISER not in message.text:
            self.errors.append(message.text)

    def status(self) -> str:
        """The line that says how fast pictures come."""
        return self.page.get_by_text("images/s").inner_text()

    def canvas(self) -> dict[str, float]:
        """Where the picture is on the page."""
        return self.page.locator("canvas").first.bounding_box()

    def picture(self) -> np.ndarray:
        """What the canvas shows, (H, W, 3) uint8."""
        return iio.imread(io.BytesIO(self.page.screenshot(clip=self.canvas())))[..., :3]

    def settled(self, text: str = "exact") -> np.ndarray:
        """The picture once the full one is there and stays the same."""
        return until(self._still, text)

    def _still(self, text: str):
        said = self.status()
        if text not in said or "while moving" in said:
            return None
        before = self.picture()
        self.page.wait_for_timeout(300)
        after = self.picture()
        return after if (before == after).all() and self.status() == said else None

    def type(self, label: str, value: float) -> None:
        """Type a number into the field of a label."""
        field = self._row(label).locator("input:not([type=hidden])").last
        field.fill(str(value))
        field.press("Enter")

    def check(self, label: str, on: bool = True) -> None:
        """Set a checkbox."""
        self._row(label).locator("input[type=checkbox]").first.set_checked(on)

    def _row(self, label: str):
        """The innermost part of the page that holds a label and an input."""
        return self.page.locator(f'xpath=//label[text()="{label}"]/ancestor::*[.//input][1]').first

    def press(self, label: str) -> None:
        """Press a button."""
        self.page.get_by_role("button", name=label, exact=True).click()

    def has(self, label: str) -> bool:
        """Whether a button is there."""
        return self.page.get_by_role("button", name=label, exact=True).is_visible()

    def choose(self, label: str, option: str) -> None:
        """Choose from a list."""
        self._row(label).locator("input:not([type=hidden])").first.click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def turn(self, right: int = 120, down: int = 0) -> None:
        """Drag the camera around."""
        mouse = self.page.mouse
        mouse.move(200, 300)
        mouse.down()
        mouse.move(200 + right, 300 + down, steps=6)
        mouse.up()

    def click(self, x: float, y: float) -> None:
        """Click into the picture; fractions of it."""
        box = self.canvas()
        self.page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])


def until(found, *arguments, seconds: float = _PATIENCE):
    """Wait for an answer other than None and False."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        answer = found(*arguments)
        if answer is not None and answer is not False:
            return answer
        time.sleep(0.1)
    raise AssertionError(f"waited {seconds} s in vain for {getattr(found, '__name__', found)}{arguments}")
