"""``python -m tests.bench.limits RUN ...``: what limits the accuracy of fitted runs.

Time, views, the size of voxels, or regions of the image: each run renders its test views and some training
views, which are compared with the truth, and the truth with itself as blurred as the voxels. With ``--parts``
(particles): what each part alone would reach, if it were fitted to a test view, too. With ``--between``
(films of one camera): what motion that is smooth from image to image would reach.
"""

from __future__ import annotations

import math
import sys
from bisect import bisect
from collections.abc import Callable
from dataclasses import replace
from statistics import fmean

import numpy as np
import torch
from omegaconf import OmegaConf
from tabulate import tabulate
from torch import Tensor

from forewarp.data.batches import Sampler
from forewarp.evaluation.evaluate import RenderedView, draw
from forewarp.methods.method import HasMatter
from forewarp.metrics.image import psnr
from forewarp.ops.grid import dilate
from forewarp.runs.build import build_run
from forewarp.runs.config import saved_config
from forewarp.scene.frame import spread
from forewarp.scene.view import View
from forewarp.training.checkpoints import load_handover
from forewarp.training.objective import set_gradients
from forewarp.training.stages import Run

REGIONS = ("outside", "outline", "inside")
PARTS = {
    "first fifth": lambda time: time < 0.2,
    "between": lambda time: 0.2 <= time <= 0.8,
    "last fifth": lambda time: time > 0.8,
}


def limits_of(run: Run, views: int = 20) -> dict[str, float | str]:
    """Return what limits a finished run, by name.

    PSNR (dB, mean over images) of all test views; of those in the first fifth of the sequence, in the last
    fifth, and between; of some training views; and of the true images low-passed to the voxel size, about
    what the lattice allows. The last entries split the squared error of the test views: outside the true
    silhouettes, within two pixels of them, inside.

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
    tested = [compared(shown, center, voxel_size) for shown in draw(module, test)]
    trained = [
        compared(shown, center, voxel_size) for shown in draw(module, train, spread(len(train), views))
    ]
    errors = {region: sum(float(view["errors"][region]) for view in tested) for region in REGIONS}
    return {
        "scene": scene.name,
        "seconds": sum(done["seconds"] for done in run.finished().values()),
        **by_time([(view["time"], view["psnr"]) for view in tested]),
        "training views": fmean(view["psnr"] for view in trained),
        "voxel, pixels": fmean(view["voxel"] for view in tested),
        "low-passed truth": fmean(view["bound"] for view in tested),
        **{region: error / sum(errors.values()) for region, error in errors.items()},
    }


def compared(shown: RenderedView, center: Tensor, voxel_size: float) -> dict:
    """Compare a rendered view with its truth; ``voxel`` is the voxel size in pixels at the center (3,)."""
    target, camera = shown.target, shown.target.frame.camera
    truth = target.rgb.cpu()
    image = list(shown.renderings.values())[-1].rgb.clamp(0, 1).reshape(truth.shape).cpu()
    voxel = voxel_size * camera.fx / float((center - camera.center).norm())
    return {
        "time": target.frame.time,
        "psnr": psnr(image, truth),
        "voxel": voxel,
        "bound": psnr(low_passed(truth, voxel), truth),
        "errors": error_shares(truth, image, target.foreground.cpu()),
    }


def by_time(views: list[tuple[float, float]]) -> dict[str, float]:
    """Return the mean PSNR of all views (time, PSNR), and of those in each of ``PARTS``; NaN without any."""
    found = {"test views": [psnr for _, psnr in views]}
    found |= {name: [psnr for time, psnr in views if holds(time)] for name, holds in PARTS.items()}
    return {name: fmean(values) if values else math.nan for name, values in found.items()}


def regions(foreground: Tensor, band: int = 2) -> dict[str, Tensor]:
    """Divide an image into the outside, the outline and the inside of its foreground.

    Args:
        foreground: (H, W) bool.
        band: half the width of the outline, in pixels.

    Returns:
        disjoint masks (H, W) bool by the names in ``REGIONS``.
    """
    outline = dilate(foreground, band) & dilate(~foreground, band)
    return {"outside": ~foreground & ~outline, "outline": outline, "inside": foreground & ~outline}


def error_shares(truth: Tensor, image: Tensor, foreground: Tensor) -> dict[str, Tensor]:
    """Sum the squared error of an image (H, W, 3) in each region of its foreground (H, W)."""
    error = (truth - image).square().mean(-1)
    return {name: torch.where(mask, error, 0.0).sum() for name, mask in regions(foreground).items()}


def low_passed(image: Tensor, pixels: float) -> Tensor:
    """Fit an image that is linear between points ``pixels`` apart, like a slice of a trilinear grid.

    Not a strict bound for a grid: grid points lie elsewhere in every view, and density makes edges.

    Args:
        image: (H, W, 3) in [0, 1].
        pixels: distance of the points; at most 1 returns the image itself.

    Returns:
        (H, W, 3), the least-squares fit.
    """
    if pixels <= 1:
        return image
    rows, columns = (_projection(length, pixels) for length in image.shape[:2])
    return torch.einsum("ab,bcd,ec->aed", rows, image.double(), columns).to(image.dtype)


def _projection(length: int, pixels: float) -> Tensor:
    """Return the projection (length, length) onto functions linear between the points, float64."""
    places = (torch.arange(length).double() + 0.5) / pixels
    points = torch.arange(math.ceil(length / pixels) + 1).double()
    hats = (1 - (places[:, None] - points).abs()).clamp(min=0)
    return hats @ torch.linalg.pinv(hats)


FITTED = {
    "motion": ("node_translations", "node_rotations"),
    "colours": ("colors", "sh", "color_over_time", "exposure"),
    "opacity": ("opacity", "opacity_over_time"),
    "places and shapes": ("means", "scales", "quaternions"),
}
FITTED["all of these"] = tuple(name for names in FITTED.values() for name in names)
LENGTHS = ("means", "node_translations")  # their rates are shares of the scene's extent
RATE = 0.3  # of a stage's first learning rates
FOLLOWED = 1.5  # pixels by which flow there and back may differ


def fitted_parts(run: Run, views: int = 4, steps: int = 60) -> dict[str, float | str]:
    """Return the PSNR (dB, mean over images) of a finished run of particles on some test views, and with one
    part alone fitted to each of these views: what is gained by much is what limits the run.

    Where the capture says what moves, of these pixels alone.

    Args:
        run: a finished run of ``model=particles``.
        views: number of test views.
        steps: of each part, on each view.
    """
    module, scene = run.load(), run.datamodule.scene
    method, targets = module.method, run.datamodule.targets("test")
    found: dict[str, list[float]] = {}
    kept = [value.detach().clone() for value in method.parameters()]
    unit = {True: float(method.extent), False: 1.0}
    method.progress = 1.0  # no shift of times, and rigidity as at the end
    for index in spread(len(targets), views):
        target = targets[index]
        pixels = None if target.moving is None else target.moving.flatten().nonzero()[:, 0]
        found.setdefault("as it is", []).append(float(module.psnr_of(target, pixels)))
        behind = "white" if bool(target.background.all()) else "black"
        tested = replace(scene, train=scene.test)
        batch = Sampler(tested, background=behind, asks=method.asks, picker=lambda index=index: index).draw()
        for part, names in FITTED.items():
            groups = [
                {"params": group["params"], "lr": RATE * group["base_lr"] * unit[group["name"] in LENGTHS]}
                for group in module.configure_optimizers().param_groups
                if group["name"] in names
            ]
            if not groups:
                continue
            optimizer = torch.optim.Adam(groups, eps=1e-15)
            for _ in range(steps):
                set_gradients(method, module.look(batch, module.objective.factors(0)).gradients)
                optimizer.step()
            found.setdefault(part, []).append(float(module.psnr_of(target, pixels)))
            with torch.no_grad():
                for value, before in zip(method.parameters(), kept):
                    value.copy_(before)
                    value.grad = None
    return {"scene": scene.name} | {name: fmean(values) for name, values in found.items()}


def smooth_between(run: Run) -> dict[str, float | str]:
    """Return the PSNR (dB, mean over images) of what moves in a finished run's test views, and of the same
    pixels of the true image, moved by what smooth motion misses there.

    Flow from the true image to the two training images on each side tells where its points are then. A line
    through the next two, and a cubic curve through all four, miss the truth by a field of pixels; its median
    over the still pixels is the camera's shake, which poses explain, and is subtracted. *Followed* are pixels
    whose flow leads back. The flow's own errors count as missed.

    Args:
        run: a finished run on images in the order of their times, with masks of what moves.

    Raises:
        ValueError: if no test image has followed pixels of both kinds, and two training images on each side.
    """
    module = run.load()
    tests, train = run.datamodule.targets("test"), run.datamodule.targets("train")
    times = [frame.time for frame in run.datamodule.scene.train]
    found: dict[str, list[float]] = {}
    for target in tests:
        after = bisect(times, target.frame.time)
        if target.moving is None or not 2 <= after <= len(times) - 2:
            continue
        beside = range(after - 2, after + 2)
        flows, followed = _flows(target.rgb, [train[index].rgb for index in beside])
        truth, moving = target.rgb.numpy(), target.moving.numpy()
        if not (moving & followed).any() or not (~moving & followed).any():
            continue
        with torch.no_grad():
            shown = module.render(View(target.frame.camera), target.moment, target.background).rgb
        images = {"as it is": shown.clamp(0, 1).reshape(truth.shape).numpy()}
        for name, used in (("as a line", slice(1, 3)), ("as a cubic curve", slice(4))):
            at = [times[index] - target.frame.time for index in beside[used]]
            field = np.einsum("f,fhwc->hwc", _shares(at), flows[used])
            own = field - np.median(field[~moving & followed], axis=0)
            images[name] = _moved(truth, -own)
        for name, image in images.items():
            for kind, pixels in (("", moving), (", followed", moving & followed)):
                value = psnr(torch.from_numpy(image[pixels][None]), torch.from_numpy(truth[pixels][None]))
                found.setdefault(name + kind, []).append(value)
    if not found:
        raise ValueError(
            f"{run.folder}: expected test images with masks between training images, but got none"
        )
    return {"scene": run.datamodule.scene.name} | {name: fmean(values) for name, values in found.items()}


def _shares(times: list[float]) -> np.ndarray:
    """Return the shares, of values at some times, of the polynomial through them at time 0 (Lagrange)."""
    return np.array([math.prod(b / (b - a) for b in times if b != a) for a in times])


def _flows(image: Tensor, others: list[Tensor]) -> tuple[np.ndarray, np.ndarray]:
    """Return where pixels (H, W) go in other images (F, H, W, 2), and which flow back leads back (H, W)."""
    import cv2  # of the extra ``capture``

    search, flows = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM), []
    here, *there = (
        cv2.cvtColor((view.numpy() * 255).round().clip(0, 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        for view in (image, *others)
    )
    followed = np.ones(here.shape, bool)
    for other in there:
        flow, back = search.calc(here, other, None), search.calc(other, here, None)
        followed &= np.linalg.norm(flow + _moved(back, flow), axis=-1) < FOLLOWED
        flows.append(flow)
    return np.stack(flows), followed


def _moved(image: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Return an image (H, W, C) read at pixels moved by ``flow`` (H, W, 2)."""
    import cv2

    y, x = np.mgrid[: flow.shape[0], : flow.shape[1]].astype(np.float32)
    places = x + flow[..., 0].astype(np.float32), y + flow[..., 1].astype(np.float32)
    return cv2.remap(image, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


KINDS: dict[str, Callable] = {"--parts": fitted_parts, "--between": smooth_between}


def main(words: list[str]) -> None:
    """Print a row for each run."""
    folders = [word for word in words if word not in KINDS]
    limits = next((KINDS[word] for word in words if word in KINDS), limits_of)
    rows = [limits(build_run(saved_config(folder, OmegaConf.create(), "runs"))) for folder in folders]
    print(tabulate(rows, "keys", tablefmt="github", floatfmt=".2f"))


if __name__ == "__main__":
    main(sys.argv[1:])
