"""``python -m forewarp.cli.limits RUN ...``: what keeps fitted scenes from the truth, as a table.

A row a run. PSNR of the test views, and by their time: the first fifth of the sequence, the middle, the last
fifth. PSNR of some training views: what motion between the given times and views between the given ones cost.
PSNR of the nearest picture that is linear between points a voxel apart: roughly what the lattice allows. And
where the squared error of the test views lies: outside of the true silhouettes, within two pixels of them,
inside.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch
from tabulate import tabulate
from torch import Tensor

from forewarp.cli.entry import MISTAKE, one_line, quiet
from forewarp.data.batches import Targets
from forewarp.evaluation.evaluate import Shown, draw
from forewarp.methods.abilities import HasMatter
from forewarp.metrics.image import psnr
from forewarp.metrics.limits import REGIONS, error_shares, low_passed
from forewarp.runs.stored import stored_run
from forewarp.runs.trust import without_trust
from forewarp.scene.frame import spread
from forewarp.training.handover import load_handover

COLUMNS = (
    *("scene", "seconds", "test views", "first fifth", "between", "last fifth", "training views"),
    *("voxel, pixels", "low-passed truth", *REGIONS),
)


@dataclass(frozen=True)
class Seen:
    """What one drawn view tells: its time, PSNR (dB), its low-passed truth's, its squared error by region."""

    time: float
    psnr: float
    voxel: float
    bound: float
    errors: dict[str, Tensor]


def seen(shown: Shown, center: Tensor, voxel_size: float) -> Seen:
    """Compare a drawn view, of voxels of ``voxel_size`` (world units) that lie as far as ``center`` (3,)."""
    target, camera = shown.target, shown.target.frame.camera
    truth = target.rgb.cpu()
    image = list(shown.renderings.values())[-1].rgb.clamp(0, 1).reshape(truth.shape).cpu()
    voxel = voxel_size * camera.fx / float((center - camera.center).norm())
    errors = error_shares(truth, image, target.foreground.cpu())
    return Seen(target.frame.time, psnr(image, truth), voxel, psnr(low_passed(truth, voxel), truth), errors)


def limits_of(folder: Path, views: int = 20, trust: Sequence[str] = ()) -> dict[str, float | str]:
    """The row of a finished run, by ``COLUMNS``: PSNR (dB), mean of images, and shares of squared error.

    Args:
        folder: the run's.
        views: training views that are drawn.
        trust: packages beside forewarp whose code the run's config may name.

    Raises:
        ValueError: where the scene's images have no alpha, so no silhouettes.
    """
    run = stored_run(folder, trust)
    module, scene = run.load(), run.datamodule.scene
    if not scene.has_alpha:
        raise ValueError(
            f"{folder}: expected a scene whose images have alpha, but got one without silhouettes"
        )
    if not isinstance(module.method, HasMatter):
        raise ValueError(f"{folder}: expected a method that tells where matter is, but got none")
    with torch.no_grad():
        voxel_size = module.method.matter().size
    before = [load_handover(run.stage_folder(stage)) for stage in run.stages[:-1]]
    center = torch.tensor((before[-1].box if before else scene.box).center).double()
    train = run.datamodule.targets("train")
    some = [train.frames[i] for i in spread(len(train), views)]
    tests, trained = (
        [seen(shown, center, voxel_size) for shown in draw(module, targets)]
        for targets in (run.datamodule.targets("test"), Targets(some, train.background, scene.has_alpha))
    )
    row = {"scene": scene.name, "seconds": sum(noted["seconds"] for noted in run.finished().values())}
    row |= by_time(tests) | {"training views": fmean(one.psnr for one in trained)}
    row |= {"voxel, pixels": fmean(one.voxel for one in tests)}
    row |= {"low-passed truth": fmean(one.bound for one in tests)}
    return row | {name: float(share) for name, share in shares(tests).items()}


def by_time(tests: Sequence[Seen]) -> dict[str, float]:
    """The mean of all, and of those whose time lies in the first fifth, between, and in the last."""
    parts = {
        "first fifth": lambda t: t < 0.2,
        "between": lambda t: 0.2 <= t <= 0.8,
        "last fifth": lambda t: t > 0.8,
    }
    found = {"test views": [one.psnr for one in tests]}
    found |= {name: [one.psnr for one in tests if holds(one.time)] for name, holds in parts.items()}
    return {name: fmean(values) if values else math.nan for name, values in found.items()}


def shares(tests: Sequence[Seen]) -> dict[str, Tensor]:
    """Of the squared error of all views, the part of each region; they sum to 1."""
    sums = {name: sum(one.errors[name] for one in tests) for name in REGIONS}
    return {name: part / sum(sums.values()) for name, part in sums.items()}


def page(rows: Iterable[dict[str, float | str]]) -> str:
    """The rows as a table in Markdown."""
    lines = []
    for row in rows:
        texts = [f"{row[c]:.0%}" if c in REGIONS else f"{row[c]:.2f}" for c in COLUMNS[2:]]
        lines.append([row["scene"], f"{row['seconds']:.0f}", *texts])
        print("  ".join(lines[-1]), file=sys.stderr, flush=True)
    return tabulate(lines, COLUMNS, tablefmt="github", disable_numparse=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; a mistake ends in one line and status 2."""
    parser = argparse.ArgumentParser(
        prog="python -m forewarp.cli.limits",
        description=__doc__.partition(":\n")[0].partition(": ")[2],
        epilog=__doc__.partition("\n\n")[2],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("runs", nargs="+", type=Path, help="folders of finished runs; trust=[PACKAGE] beside")
    parser.add_argument("--views", type=int, default=20, help="training views to draw (%(default)s)")
    quiet()
    try:
        words, trust = without_trust(sys.argv[1:] if arguments is None else arguments)
        given = parser.parse_args(words)
        print(page(limits_of(folder, given.views, trust) for folder in given.runs))
    except Exception as error:
        line = one_line(error)
        if line is None:
            raise
        print(f"forewarp.cli.limits: error: {line}", file=sys.stderr)
        raise SystemExit(MISTAKE) from None


if __name__ == "__main__":
    main()
