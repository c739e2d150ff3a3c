"""Every operator, a step and a frame at any size, as it runs and densely as the paper prints it."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from forewarp.ops.splat import average_splat
from forewarp.renderer import Renderer
from forewarp.scene.view import Moment, View
from forewarp.training.objective import total
from tests.bench.workloads import (
    EFFECTS,
    RADIUS,
    TIME,
    WHITE,
    body,
    camera,
    lattice_of,
    make_method,
    make_module,
    some_rays,
)
from tests.stability.twin import implementation

Work = Callable[[], object]
REPEATS = 5


@dataclass(frozen=True)
class Case:
    """``make(size, dense)`` gives what is timed; ``axis`` says in words what grows, ``work`` gives the amount
    of it at a size, and only ``dense_sizes`` are also computed densely.
    """

    axis: str
    sizes: tuple[float, ...]
    make: Callable[[float, bool], Work]
    work: Callable[[float], float] = float
    dense_sizes: tuple[float, ...] = ()


def timed(work: Work, repeats: int = REPEATS) -> float:
    """Median seconds of the processor's time, after a first time that does not count: what else a shared
    machine does is left out, and of one thread it is what a quiet one takes.
    """
    work()
    taken = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        taken.append(time.process_time() - begin)
    return statistics.median(taken)


def milliseconds(seconds: float | None) -> str:
    """Three digits.

    >>> milliseconds(0.0123456), milliseconds(2.5), milliseconds(None)
    ('12.3', '2500', '')
    """
    return "" if seconds is None else f"{1e3 * seconds:.3g}" if seconds < 1 else f"{1e3 * seconds:.0f}"


def backwards(dense: bool, work: Callable[[], Tensor]) -> Work:
    """``work`` and its gradient; what is dense is plain PyTorch."""

    def both() -> None:
        with implementation("reference") if dense else nullcontext():
            work().backward()

    return both


def splat_work(side: float, dense: bool) -> Work:
    """13 channels of the ball, or of all voxels, carried by a smooth flow."""
    lattice = lattice_of(int(side))
    voxels = lattice.all_voxels() if dense else body(lattice, RADIUS).nonzero()
    source = torch.randn(len(voxels), 13, generator=torch.Generator().manual_seed(0)).requires_grad_()
    positions = (voxels + 2 * torch.sin(voxels / 9.0)).requires_grad_()
    return backwards(dense, lambda: average_splat(source, positions, lattice.shape).values.square().sum())


def fields_work(side: float, dense: bool) -> Work:
    """F1 and F2, and the cosines at a time."""
    lattice = lattice_of(int(side))
    method = make_method(lattice, int(side), dense, effects=("motion", "view_dependence"))

    def work() -> Tensor:
        return method.radiance().values.sum() + method.motion.flow(method.radiance, TIME).sum()

    return backwards(dense, work)


def inpaint_work(side: float, dense: bool) -> Work:
    """The U-Net and the up-layer on the ball's box, or on all of it, without the warp."""
    lattice = lattice_of(int(side))
    method = make_method(lattice, int(side), dense, effects=("view_dependence", "upsampler", "inpainter"))
    warped = method.radiance().with_values(method.radiance().values.detach())
    return backwards(dense, lambda: method._inpaint(warped, None)[0]["inpainted"].values.square().mean())


def render_work(rays: float, dense: bool, step: float = 0.5) -> Work:
    """One rendering of a lattice of 128 voxels an axis; the work is the number of rays."""
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
    """A whole fine step: the paper's, the optimiser's included."""
    module, batch = make_module(int(side), dense, rays=rays, box=box)
    optimizer, factors = module.configure_optimizers(), module.objective.factors(0)

    def step() -> None:
        with implementation("reference") if dense else nullcontext():
            optimizer.zero_grad()
            total(module.look(batch, factors), factors, {})[0].backward()
            optimizer.step()

    return step


def frame_work(size: float, dense: bool, first: bool = True, side: int = 64, plain: bool = False) -> Work:
    """A whole picture of ``size`` squared pixels; not the ``first`` of its time: the warped grid is there.

    ``plain`` has neither U-Net nor up-sampler, as ``preset=fast``.
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
