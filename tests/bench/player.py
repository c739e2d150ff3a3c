"""How fast the page of ``format=html`` draws without a graphics card: frames a second, by particles and size.

  .venv/bin/python -m tests.bench.player runs/hook/particles-fast-seed0

The particles of a run are repeated beside themselves, and smaller, up to the numbers below.
"""

import copy
import math
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch

from forewarp import load
from forewarp.export.html import export_html
from forewarp.export.tracks import Source, no_progress
from forewarp.methods.method import part_of
from tests.support.browser import chromium

COUNTS, SIDES = (13_000, 60_000), (400, 800)
MEASURE = "(size) => forewarp.then((door) => door.measure({ width: size, height: size }))"


def repeated(source: Source, count: int) -> Source:
    """The same scene of so many particles."""
    module = copy.deepcopy(source.module)
    rows = torch.arange(count) % len(module.method.gaussians.means)
    for name in module.method.grows:
        part = part_of(module.method, name)
        part.data = part.data[rows]
    means, scales = module.method.gaussians.means.data, module.method.gaussians.scales.data
    means += scales.exp() * torch.randn(means.shape, generator=torch.Generator().manual_seed(0))
    scales -= 0.5 * math.log(
        max(1.0, count / len(source.module.method.gaussians.means))
    )  # as much area in all
    return replace(source, module=module)


def main(run: str) -> None:
    """Print a table."""
    fitted = load(run)
    cameras = [frame.camera for frame in fitted.frames("train")]
    source = Source(fitted.module, "particles", cameras, [0.0])
    print("| particles | pixels | frames a second | sorting, in the worker | the page's own code a frame |")
    print("|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        for count in COUNTS:
            export_html(repeated(source, count), Path(folder), no_progress, quality="compact", seconds=4)
            page = browser.new_page(viewport={"width": 200, "height": 200})
            page.goto(f"{Path(folder).as_uri()}/scene.html?autoplay=0")
            for side in SIDES:
                found = page.evaluate(MEASURE, side)
                particles, _, _, frames, sort, own = found.values()
                size = f"{particles:,} | {side} x {side}"
                print(f"| {size} | {frames:.1f} | {sort:.1f} ms | {own:.1f} ms |", flush=True)
            page.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
