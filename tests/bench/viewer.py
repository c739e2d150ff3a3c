"""``python -m tests.bench.viewer RUN [RUN ...]``: exact images a second, into docs/results/performance.md.

Takes finished runs, of one method each. The page is measured in a headless browser without a graphics
card, with the first run whose particles it can draw. ``--print`` leaves the document as it is.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

import torch
from omegaconf import OmegaConf

from forewarp.cli.entry import quiet
from forewarp.cli.view import renderer_of
from forewarp.runs.config import saved_config
from forewarp.runs.config_files import project_root
from forewarp.scene.camera import orbit
from forewarp.viewer.rendering import SPLATS, Viewer, ViewState
from forewarp.viewer.server import serve
from tests.stability.report import replace_section, table
from tests.support.browser import Tab, chromium, until

SIZES = (400, 800)
SECONDS = 5.0  # of each measurement, which has one picture at least
_FRAMES = """seconds => new Promise(done => {
    let count = 0, begun = performance.now();
    const step = now => (++count, now - begun < 1000 * seconds ? requestAnimationFrame(step)
        : done(1000 * count / (now - begun)));
    requestAnimationFrame(step);
})"""


def viewer_of(run: Path) -> Viewer:
    """Open a run as the command does."""
    config = OmegaConf.create({"points": 300, "tail": 0.5, "threads": torch.get_num_threads()})
    renderer = renderer_of(saved_config(str(run), config), config)
    return Viewer(renderer.scene, [renderer], rows=max(SIZES))


def images_a_second(viewer: Viewer, size: int, *, moving: str) -> float:
    """Render images of ``size`` squared pixels while the ``camera`` or the ``time`` moves; median rate."""
    first = ViewState.first(viewer.scene)
    start = replace(viewer.scene.test[0].camera, camera_to_world=first.pose)
    poses = [one.camera_to_world for one in orbit(start, viewer.focus, viewer.up, torch.arange(64) / 64)]
    viewer.image(first, 16, 16)  # compiles kernels
    taken, begun, step = [], time.perf_counter(), 0
    while not taken or time.perf_counter() - begun < SECONDS:
        step += 1
        changes = {"time": (0.37 * step) % 1} if moving == "time" else {"pose": poses[step % len(poses)]}
        state = replace(first, **changes)
        before = time.perf_counter()
        viewer.prepare(state)
        viewer.image(state, size, size)
        taken.append(time.perf_counter() - before)
    return 1 / statistics.median(taken)


def exact_table(viewers: list[Viewer]) -> str:
    """The rates of every run."""
    rows = []
    for viewer in viewers:
        renderer = viewer.renderers[0]
        kind, count = renderer.module.method.size
        row = [renderer.name, f"{count:,} {kind}"]
        for size in SIZES:
            rates = [images_a_second(viewer, size, moving=moving) for moving in ("camera", "time")]
            row += [f"{rate:.0f}" if rate >= 10 else f"{rate:.2g}" for rate in rates]
        rows.append(row)
        print("  ".join(row), flush=True)
    heads = [f"{size} x {size}, {what} moves" for size in SIZES for what in ("camera", "time")]
    return table(["run", "size", *heads], rows)


def page_table(viewer: Viewer) -> str:
    """Bytes and time of splats, and what the page shows a second, in a browser."""
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        address = serve(viewer, host="127.0.0.1", port=0, title="bench", folder=Path(folder))
        with address as where:
            server = threading.Thread(target=viewer.queue.run_forever)
            server.start()
            try:
                rows = measured(viewer, browser, where)
            finally:
                viewer.queue.close()
                server.join()
    return table(["on the page", ""], rows)


def measured(viewer: Viewer, browser, address: str) -> list[list[str]]:
    """The lines of ``page_table``."""
    tab, frames = Tab(browser, None), []
    received = lambda data: frames.append((len(data), time.perf_counter()))  # noqa: E731
    tab.page.on("websocket", lambda socket: socket.on("framereceived", received))
    tab.open(address)
    tab.settled()
    session = viewer.pages[0].session
    rows = [["frames a second, nothing changes", f"{tab.page.evaluate(_FRAMES, SECONDS):.0f}"]]
    drawn, begun = session.rendered, time.perf_counter()
    session.play(True)
    shown = tab.page.evaluate(_FRAMES, SECONDS)
    pictures = (session.rendered - drawn) / (time.perf_counter() - begun)
    session.play(False)
    tab.settled()
    rows.append(["frames a second while exact images play", f"{shown:.0f}, with {pictures:.1f} images"])
    tab.choose("show", "splats")
    until(lambda: "drawn by the browser" in tab.status())
    tab.page.wait_for_timeout(2000)
    count = len(viewer.renderers[0].module.method.ellipsoids(0.5))
    sent = [splats_sent(tab, session, frames, count, step / 7) for step in range(1, 7)]
    size, seconds = (statistics.median(column) for column in zip(*sent))
    rows.append([f"splats of one time, {count:,} of them", f"{size / 1e6:.2f} MB, {1000 * seconds:.0f} ms"])
    rows.append(["frames a second with splats", f"{tab.page.evaluate(_FRAMES, SECONDS):.0f}"])
    for row in rows:
        print("  ".join(row), flush=True)
    return rows


def splats_sent(tab: Tab, session, frames: list, count: int, moment: float) -> tuple[int, float]:
    """Bytes of the message that brings the splats of a time, and seconds from the change until it came."""
    frames.clear()
    begun = time.perf_counter()
    session.change(time=moment)
    while not any(size > 8 * count for size, _ in frames):
        tab.page.wait_for_timeout(5)
    size, came = max(frames)
    return size, came - begun


def main() -> None:
    """Measure, and write both tables."""
    quiet()
    reads = argparse.ArgumentParser(prog="python -m tests.bench.viewer", description=__doc__)
    reads.add_argument("runs", nargs="+", type=Path)
    reads.add_argument("--print", action="store_true", help="leave docs/results/performance.md as it is")
    given = reads.parse_args()
    viewers = [viewer_of(run) for run in given.runs]
    exact = exact_table(viewers)
    drawable = [viewer for viewer in viewers if SPLATS in viewer.channels]
    tables = {"exact images": exact} | ({"the page": page_table(drawable[0])} if drawable else {})
    if not given.print:
        for name, text in tables.items():
            replace_section(project_root() / "docs" / "results" / "performance.md", name, text)


if __name__ == "__main__":
    main()
