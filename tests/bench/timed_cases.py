"""Time operators, steps and frames at any size, sparse as they run and dense as printed in the paper."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from forewarp.fields.curves import TrajectoryField
from forewarp.methods.voxel.effects import (
    LearnedUpsampler,
    Motion,
    SphericalHarmonics,
    StaticBackground,
    UNet3d,
)
from forewarp.methods.voxel.forward import ForwardWarp
from forewarp.ops.splat import average_splat
from forewarp.renderer import Renderer
from forewarp.scene.view import Moment, View
from forewarp.training.objective import total
from tests.bench.workloads import (
    EFFECTS,
    RADIUS,
    TIME,
    WHITE,
    batch_of,
    body,
    camera,
    lattice_of,
    make_method,
    make_module,
    module_of,
    some_rays,
)
from tests.stability.twin import implementation
from tests.support.tiny_scene import built, forward_model

Work = Callable[[], object]
REPEATS = 5


@dataclass(frozen=True)
class Case:
    """What to time.

    Args:
        axis: what grows, for the table's head.
        sizes: to time.
        make: (size, dense) -> the function to time.
        work: size -> amount of work.
        dense_sizes: those that are timed densely too.
    """

    axis: str
    sizes: tuple[float, ...]
    make: Callable[[float, bool], Work]
    work: Callable[[float], float] = float
    dense_sizes: tuple[float, ...] = ()


def timed(work: Work, repeats: int = REPEATS) -> float:
    """Return median seconds of processor time, after a first call that does not count.

    Processor time leaves out what else a shared machine does.
    """
    work()
    taken = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        taken.append(time.process_time() - begin)
    return statistics.median(taken)


def milliseconds(seconds: float | None) -> str:
    """Format with three digits.

    >>> milliseconds(0.0123456), milliseconds(2.5), milliseconds(None)
    ('12.3', '2500', '')
    """
    return "" if seconds is None else f"{1e3 * seconds:.3g}" if seconds < 1 else f"{1e3 * seconds:.0f}"


def backwards(dense: bool, work: Callable[[], Tensor]) -> Work:
    """Add the backward pass; dense work runs in plain PyTorch."""

    def both() -> None:
        with implementation("reference") if dense else nullcontext():
            work().backward()

    return both


def splat_work(side: float, dense: bool) -> Work:
    """Splat 13 channels of the ball, or of all voxels, along a smooth flow."""
    lattice = lattice_of(int(side))
    voxels = lattice.all_voxels() if dense else body(lattice, RADIUS).nonzero()
    source = torch.randn(len(voxels), 13, generator=torch.Generator().manual_seed(0)).requires_grad_()
    positions = (voxels + 2 * torch.sin(voxels / 9.0)).requires_grad_()
    return backwards(dense, lambda: average_splat(source, positions, lattice.shape).values.square().sum())


def fields_work(side: float, dense: bool) -> Work:
    """Evaluate F1 and F2 and the cosines at a time."""
    lattice = lattice_of(int(side))
    method = make_method(lattice, int(side), dense, effects=("motion", "view_dependence"))

    def work() -> Tensor:
        return method.radiance().values.sum() + method.motion.flow(method.radiance, TIME).sum()

    return backwards(dense, work)


def inpaint_work(side: float, dense: bool) -> Work:
    """Run the U-Net and the up-layer on the ball's box, or on the whole lattice, without the warp."""
    lattice = lattice_of(int(side))
    method = make_method(lattice, int(side), dense, effects=("view_dependence", "upsampler", "inpainter"))
    warped = method.radiance().with_values(method.radiance().values.detach())
    return backwards(dense, lambda: method._inpaint(warped, None)[0]["inpainted"].values.square().mean())


def render_work(rays: float, dense: bool, step: float = 0.5) -> Work:
    """Render a lattice of 128^3 voxels; the work is the number of rays."""
    lattice = lattice_of(128)
    method = make_method(lattice, 128, dense, effects=("view_dependence",))
    grid, view = method.radiance(), some_rays(int(rays))
    values = grid.values.detach().requires_grad_()
    renderer = Renderer(step=step, color_threshold=0.0 if dense else 1e-4)
    shaded = method.view_dependence
    return backwards(
        dense, lambda: renderer(grid.with_values(values), view, WHITE, shaded).rgb.square().mean()
    )


def step_work(side: float, dense: bool, rays: int = 2048, box: float = 1.0) -> Work:
    """Take a whole fine step of the paper's, with the optimiser."""
    module, batch = make_module(int(side), dense, rays=rays, box=box)
    optimizer, factors = module.configure_optimizers(), module.objective.factors(0)

    def step() -> None:
        with implementation("reference") if dense else nullcontext():
            optimizer.zero_grad()
            total(module.look(batch, factors), factors)[0].backward()
            optimizer.step()

    return step


def frame_work(size: float, dense: bool, first: bool = True, side: int = 64, plain: bool = False) -> Work:
    """Render a picture of ``size`` squared pixels.

    Args:
        first: the first of its time, so that the grid must be warped.
        plain: without U-Net and up-sampler, as ``preset=fast``.
    """
    module, _ = make_module(side, dense, rays=1, effects=("motion", "view_dependence") if plain else EFFECTS)
    view, moment = View(camera(int(size))), Moment(TIME)

    def frame() -> Tensor:
        with torch.no_grad(), implementation("reference") if dense else nullcontext():
            return (known or module.method.at(moment)).render(view, WHITE).rgb

    known = None
    if not first:
        with torch.no_grad():
            known = module.method.at(moment)
    return frame


SIDES = (32, 48, 64, 80)
CUBE = {"work": lambda side: side**3}
CASES = {
    "splat": Case("side of the lattice", SIDES, splat_work, dense_sizes=SIDES, **CUBE),
    "fields": Case("side of the lattice", SIDES, fields_work, dense_sizes=(32, 48), **CUBE),
    "inpaint": Case("side of the lattice", SIDES, inpaint_work, dense_sizes=(32, 48), **CUBE),
    "render by rays": Case("rays", (1024, 2048, 4096, 8192), render_work, dense_sizes=(1024, 2048)),
    "render by samples": Case(
        "steps a voxel",
        (1, 2, 4, 8),
        lambda per, dense: render_work(2048, dense, step=1 / per),
        dense_sizes=(1, 2),
    ),
    "step by lattice": Case("side of the lattice", SIDES, step_work, dense_sizes=(32, 48), **CUBE),
    "step by rays": Case(
        "rays",
        (1024, 2048, 4096, 8192),
        lambda rays, dense: step_work(32, dense, int(rays)),
        dense_sizes=(1024,),
    ),
    "frame, first of its time": Case(
        "side of the picture", (50, 100, 200, 400), frame_work, work=lambda n: n**2, dense_sizes=(50, 100)
    ),
    "frame, another of it": Case(
        "side of the picture", (50, 100, 200, 400), partial(frame_work, first=False), work=lambda n: n**2
    ),
}

# Each effect by itself, for what it costs a step.
ALONE: Mapping[str, dict] = {
    "view_dependence": {"view_dependence": SphericalHarmonics},
    "motion": {"motion": Motion, "trajectory": partial(TrajectoryField, bases=10, padding=0.2)},
    "trajectory features": {
        "motion": Motion,
        "trajectory": partial(TrajectoryField, bases=10, padding=0.2, features=12),
    },
    "background": {
        "background": partial(StaticBackground, features=3, alpha_init=1e-2, alpha_threshold=1e-4)
    },
    "upsampler": {"upsampler": partial(LearnedUpsampler, width=16)},
    "inpainter": {"inpainter": partial(UNet3d, width=16)},
}


def method_with(choices: Mapping, side: int) -> ForwardWarp:
    """Make a solid ball that fills a tenth of ``side``^3 voxels, with the effects of ``choices``."""
    torch.manual_seed(0)
    lattice = lattice_of(side)
    active = body(lattice, 0.55)
    model = forward_model(**{"motion": None, "view_dependence": None} | choices)
    method = built(model, lattice, active, density_scale=2 / (side - 1), frames=50, box=lattice.box)
    with torch.no_grad():
        method.radiance.parameter("density").fill_(6.0)
        if method.background is not None:
            method.background.parameter("density").fill_(-8.0)
    return method


def step_with(choices: Mapping, side: int, rays: int, weights: Mapping[str, float]) -> Work:
    """Take a training step as the platform does."""
    module = module_of(method_with(choices, side), weights, side)
    optimizer, batch = module.configure_optimizers(), batch_of(rays)

    def step() -> None:
        optimizer.zero_grad()
        factors = module.objective.factors(0)
        total(module.look(batch, factors), factors)[0].backward()
        optimizer.step()

    return step


def step_by_hand(side: int, rays: int) -> Work:
    """Take the same step of a static field, written by hand without effects and with one loss term."""
    radiance, renderer = method_with({}, side).radiance, Renderer()
    (seen,) = batch_of(rays).observations
    generator = torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(radiance.parameters(), lr=0.1, betas=(0.9, 0.99), eps=1e-8, fused=True)

    def step() -> None:
        optimizer.zero_grad()
        drawn = renderer(radiance(), seen.view.rays(), seen.background, None, generator)
        (drawn.rgb - seen.rgb).square().mean().backward()
        optimizer.step()

    return step
