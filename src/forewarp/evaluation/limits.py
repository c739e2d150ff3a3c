"""Find what limits the accuracy of fitted runs: time, views, resolution, or regions of the picture."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean

import torch
from tabulate import tabulate
from torch import Tensor

from forewarp.evaluation.evaluate import Shown, draw
from forewarp.methods.abilities import HasMatter
from forewarp.metrics.image import psnr
from forewarp.metrics.limits import REGIONS, error_shares, low_passed
from forewarp.scene.frame import spread
from forewarp.training.handover import load_handover
from forewarp.training.stages import Run

COLUMNS = (
    *("scene", "seconds", "test views", "first fifth", "between", "last fifth", "training views"),
    *("voxel, pixels", "low-passed truth", *REGIONS),
)


@dataclass(frozen=True)
class Seen:
    """The numbers of one rendered view.

    Attributes:
        time: time of the view, in [0, 1].
        psnr: PSNR of the rendering, dB.
        voxel: voxel size in pixels.
        bound: PSNR (dB) of the true picture low-passed to the voxel size.
        errors: squared error by region.
    """

    time: float
    psnr: float
    voxel: float
    bound: float
    errors: dict[str, Tensor]


def seen(shown: Shown, center: Tensor, voxel_size: float) -> Seen:
    """Compare a rendered view with its truth.

    Args:
        shown: the view.
        center: (3,), world units; the voxel size in pixels is taken at this distance from the camera.
        voxel_size: world units.
    """
    target, camera = shown.target, shown.target.frame.camera
    truth = target.rgb.cpu()
    image = list(shown.renderings.values())[-1].rgb.clamp(0, 1).reshape(truth.shape).cpu()
    voxel = voxel_size * camera.fx / float((center - camera.center).norm())
    errors = error_shares(truth, image, target.foreground.cpu())
    return Seen(target.frame.time, psnr(image, truth), voxel, psnr(low_passed(truth, voxel), truth), errors)


def limits_of(run: Run, views: int = 20) -> dict[str, float | str]:
    """Return the table row of a finished run, by ``COLUMNS``.

    PSNR (dB, mean over images) is given for all test views; for those in the first fifth of the sequence, in
    the last fifth, and between; for some training views; and for the true pictures low-passed to the voxel
    size, about what the lattice allows. The last columns split the squared error of the test views: outside
    the true silhouettes, within two pixels of them, inside.

    Args:
        run: a finished run.
        views: number of training views to render.

    Raises:
        ValueError: if the images have no alpha, or the method has no ``matter``.
    """
    module, scene = run.load(), run.datamodule.scene
    if not scene.has_alpha:
        raise ValueError(
            f"{run.folder}: expected a scene whose images have alpha, but got one without silhouettes"
        )
    if not isinstance(module.method, HasMatter):
        raise ValueError(f"{run.folder}: expected a method that tells where matter is, but got none")
    with torch.no_grad():
        voxel_size = module.method.matter().size
    before = [load_handover(run.stage_folder(stage)) for stage in run.stages[:-1]]
    center = torch.tensor((before[-1].box if before else scene.box).center).double()
    test, train = run.datamodule.targets("test"), run.datamodule.targets("train")
    tests, trained = (
        [seen(shown, center, voxel_size) for shown in draw(module, targets, numbers)]
        for targets, numbers in ((test, None), (train, spread(len(train), views)))
    )
    row = {"scene": scene.name, "seconds": sum(noted["seconds"] for noted in run.finished().values())}
    row |= by_time(tests) | {"training views": fmean(one.psnr for one in trained)}
    row |= {"voxel, pixels": fmean(one.voxel for one in tests)}
    row |= {"low-passed truth": fmean(one.bound for one in tests)}
    return row | {name: float(share) for name, share in shares(tests).items()}


def by_time(tests: Sequence[Seen]) -> dict[str, float]:
    """Return the mean PSNR of all views, and of those in the first fifth of the time, between, and last."""
    parts = {
        "first fifth": lambda t: t < 0.2,
        "between": lambda t: 0.2 <= t <= 0.8,
        "last fifth": lambda t: t > 0.8,
    }
    found = {"test views": [one.psnr for one in tests]}
    found |= {name: [one.psnr for one in tests if holds(one.time)] for name, holds in parts.items()}
    return {name: fmean(values) if values else math.nan for name, values in found.items()}


def shares(tests: Sequence[Seen]) -> dict[str, Tensor]:
    """Return each region's share of the squared error of all views; the shares sum to 1."""
    sums = {name: sum(one.errors[name] for one in tests) for name in REGIONS}
    return {name: part / sum(sums.values()) for name, part in sums.items()}


def limits_table(rows: Iterable[dict[str, float | str]]) -> str:
    """Format the rows of ``limits_of`` as a Markdown table."""
    lines = []
    for row in rows:
        texts = [f"{row[c]:.0%}" if c in REGIONS else f"{row[c]:.2f}" for c in COLUMNS[2:]]
        lines.append([row["scene"], f"{row['seconds']:.0f}", *texts])
    return tabulate(lines, COLUMNS, tablefmt="github", disable_numparse=True)
