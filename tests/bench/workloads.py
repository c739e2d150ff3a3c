"""The work that is timed: the paper's model of a moving ball, sparse as it runs, or dense as printed."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from forewarp.fields.curves import TrajectoryField
from forewarp.fields.grids import EMPTY, FeatureRadiance
from forewarp.methods.voxel.effects import (
    LearnedUpsampler,
    Motion,
    SphericalHarmonics,
    StaticBackground,
    UNet3d,
    ViewNetwork,
    inpaint,
)
from forewarp.methods.voxel.forward import ForwardWarp
from forewarp.methods.voxel.model import VoxelMethod
from forewarp.ops.splat import average_splat
from forewarp.renderer import Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Batch, Moment, Observation, View
from forewarp.training.module import DynamicSceneModule
from forewarp.training.objective import Objective, total
from forewarp.training.schedule import Curriculum, Stage, StageSettings
from tests.stability.report import implementation
from tests.support.tiny_scene import begun, built, forward_model

OCCUPANCY, TIME, SOLID = 0.1, 0.5, 6.0
RADIUS = (6 * OCCUPANCY / math.pi) ** (1 / 3)
WHITE = torch.ones(3)
EFFECTS = ("motion", "view_dependence", "upsampler", "inpainter")
# Weights of the paper's fine stage.
WEIGHTS = {"photo": 1.0, "point_color": 1e-2, "background_entropy": 1e-3, "flow_l1": 1e-5}
WEIGHTS |= {"inpaint_diff": 1e-5, "tv_density": 1e-6, "tv_flow": 1e-3, "tv_depth": 1e-1}
RATES = {"density": 0.1, "color": 0.1, "shading": 0.1, "grid": 0.1, "flow": 1e-3, "network": 1e-3}


class PlainUNet(UNet3d):
    """The same with the channels first, as PyTorch has them by default."""

    def features(self, dense: Tensor) -> Tensor:
        """See ``UNet3d``."""
        return super().features(dense.contiguous())


class PlainUpsampler(LearnedUpsampler):
    """The same with the channels first."""

    def _held(self, part: Callable[[Tensor], Tensor], volume: Tensor) -> Tensor:
        return super()._held(part, volume.contiguous())


def body(lattice: Lattice, radius: float) -> Tensor:
    """Return the mask (X, Y, Z) of a ball around the box's centre."""
    points = lattice.to_world(lattice.all_voxels()) - torch.tensor(lattice.box.center)
    return (points.norm(dim=-1) < radius).reshape(lattice.shape)


def camera(size: int = 400) -> Camera:
    """Return the camera of a square picture of the ball."""
    pose = look_at(torch.tensor([3.2, 2.0, 1.4]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(size, size, 1.39 * size, 1.39 * size, size / 2, size / 2, pose, 2.0, 6.0)


def some_pixels(count: int, seed: int = 0) -> View:
    """Draw random pixels of the picture."""
    pixels = torch.randint(160_000, (count,), generator=torch.Generator().manual_seed(seed))
    return View(camera(), pixels)


def batch_of(rays: int) -> Batch:
    """Make a batch of grey pixels of the picture."""
    return Batch((Observation(Moment(TIME), some_pixels(rays), torch.full((rays, 3), 0.5), WHITE),), 0)


def module_of(method: VoxelMethod, weights: Mapping[str, float], side: int) -> DynamicSceneModule:
    """Put the method into a training module, in a stage with one camera."""
    settings = StageSettings.of("fine", num_voxels=[[0, side**3]], lr=RATES, iterations=100)
    frame = Frame("0", 0.0, camera(), _no_picture)
    scene = Scene("ball", (frame,), (), (), method.radiance.lattice.box, 0.0, has_alpha=True)
    objective = Objective(weights)
    return DynamicSceneModule(
        begun(method, scene, Stage(settings, objective)),
        objective=objective,
        settings=settings,
        curriculum=Curriculum([i / 49 for i in range(50)], 0.0),
    )


def _no_picture() -> Tensor:
    raise AssertionError("a timed step has its pixels")


def lattice_of(side: int) -> Lattice:
    """Make a lattice of ``side`` voxels per axis in a box of length 2."""
    return Lattice(Box((-1.0,) * 3, (1.0,) * 3), (side,) * 3)


def make_method(side: int, dense: bool, *, effects: tuple[str, ...], shift: float = 2.3) -> ForwardWarp:
    """Make the paper's model of a solid ball in a tenth of a box of length 2.

    At ``TIME`` it has moved by ``shift`` voxels.

    Args:
        side: voxels along the box.
        dense: every voxel is active, nothing is skipped, the U-Net sees the whole lattice, channels first.
        effects: which are on.
    """
    lattice = lattice_of(side)
    ball = body(lattice, RADIUS)
    margin = max(lattice.shape) if dense else 4
    model = partial(
        ForwardWarp,
        radiance=partial(FeatureRadiance, alpha_init=1e-2, alpha_threshold=0.0 if dense else 1e-4),
        motion=Motion,
        trajectory=partial(TrajectoryField, bases=15, nodes=0),
        upsampler=partial(PlainUpsampler if dense else LearnedUpsampler, recompute=False),
        inpainter=partial(PlainUNet if dense else UNet3d, width=16, margin=margin),
        view_dependence=ViewNetwork,
    )
    active = torch.ones_like(ball) if dense else ball
    options = {"density_scale": 2 / (side - 1), "frames": 50, "box": lattice.box, "effects": effects}
    method = built(model, lattice, active, **options)
    _paint(method, ball, shift)
    return method


@torch.no_grad()
def _paint(method: ForwardWarp, ball: Tensor, shift: float) -> None:
    """Set F1 to solid in the ball and empty elsewhere, and F2 to motion along x."""
    torch.manual_seed(0)
    for layer in method.modules():  # draw weights anew, so that they do not depend on the number of voxels
        if hasattr(layer, "reset_parameters") and layer.weight.any():
            layer.reset_parameters()
    radiance = method.radiance
    first, second, last = (layer for layer in radiance.network if hasattr(layer, "weight"))
    for layer in (first, second):  # the first hidden unit passes on the first feature
        layer.weight[0], layer.bias[0] = 0.0, 0.0
    first.weight[0, first.in_features - radiance.features.shape[1]] = 1.0
    second.weight[0, 0] = last.weight[0, 0] = 1.0
    # Air has the colour that absent voxels read, so that skipping it changes nothing.
    last.weight[1:, 0] = 0.1 * torch.randn(len(last.weight) - 1)
    last.bias[0] = EMPTY
    x, y, z = radiance.voxels.unbind(-1)
    # Of all voxels, so that they do not depend on which are active.
    size = (*radiance.lattice.shape, radiance.features.shape[1])
    features = 0.1 * torch.randn(size, generator=torch.Generator().manual_seed(1))
    radiance.features.copy_(features[x, y, z])
    radiance.features[:, 0] = torch.where(ball[x, y, z], SOLID - EMPTY, 0.0)
    if method.motion is not None:
        trajectory = method.motion.trajectory
        basis = trajectory.basis(TIME)[0]
        trajectory.network[-1].bias[0] = shift * radiance.lattice.spacing[0] / (trajectory.scale * basis)


def make_module(
    side: int,
    dense: bool,
    *,
    rays: int,
    shift: float = 2.3,
    threshold: float = 1e-4,
    effects: tuple[str, ...] = EFFECTS,
) -> tuple[DynamicSceneModule, Batch]:
    """Make the paper's fine stage (U-Net of 16 channels, doubled resolution, two renderings), and a batch."""
    method = make_method(side, dense, effects=effects, shift=shift)
    color, early = (0.0, 0.0) if dense else (threshold, 1e-4)
    method.renderer = Renderer(color_threshold=color, early_stop_eps=early)
    return module_of(method, WEIGHTS, side), batch_of(rays)


Work = Callable[[], object]
REPEATS = 5
VERDICTS = {True: "reached", False: "**missed**", None: ""}


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


def slope(amounts: Sequence[float], seconds: Sequence[float]) -> float:
    """Fit the power with which seconds grow with the amount of work.

    >>> round(slope([1, 2, 4, 8], [3, 6, 12, 24]), 6)
    1.0
    """
    x, y = [math.log(a) for a in amounts], [math.log(s) for s in seconds]
    return statistics.linear_regression(x, y).slope


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
    method = make_method(int(side), dense, effects=("motion", "view_dependence"))

    radiance, flow = method.radiance, method.motion.trajectory.flow
    return backwards(dense, lambda: radiance().values.sum() + flow(radiance, TIME).sum())


def inpaint_work(side: float, dense: bool) -> Work:
    """Run the U-Net and the up-layer on the ball's box, or on the whole lattice, without the warp."""
    method = make_method(int(side), dense, effects=("view_dependence", "upsampler", "inpainter"))
    warped = replace(method.radiance(), values=method.radiance().values.detach())
    parts = method.inpainter, method.upsampler
    return backwards(dense, lambda: inpaint(warped, None, *parts)[1].values.square().mean())


def render_work(rays: float, dense: bool, step: float = 0.5) -> Work:
    """Render a lattice of 128^3 voxels; the work is the number of rays."""
    method = make_method(128, dense, effects=("view_dependence",))
    grid, view = method.radiance(), some_pixels(int(rays)).rays()
    values = grid.values.detach().requires_grad_()
    draw, shade = Renderer(step=step, color_threshold=0.0 if dense else 1e-4), method.view_dependence
    return backwards(
        dense, lambda: draw(replace(grid, values=values), view, WHITE, shade).rgb.square().mean()
    )


def step_work(side: float, dense: bool, rays: int = 2048) -> Work:
    """Take a whole fine step of the paper's, with the optimiser."""
    module, batch = make_module(int(side), dense, rays=rays)
    step = training_step(module, batch)

    def work() -> None:
        with implementation("reference") if dense else nullcontext():
            step()

    return work


def training_step(module: DynamicSceneModule, batch: Batch) -> Work:
    """Take a training step as the platform does."""
    optimizer = module.configure_optimizers()

    def step() -> None:
        optimizer.zero_grad()
        factors = module.objective.factors(0)
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
RAYS, PIXELS, PICTURE = (1024, 2048, 4096, 8192), (50, 100, 200, 400), "side of the picture"
CUBE, SQUARE = {"work": lambda side: side**3}, {"work": lambda n: n**2}
CASES = {
    "splat": Case("side of the lattice", SIDES, splat_work, dense_sizes=SIDES, **CUBE),
    "fields": Case("side of the lattice", SIDES, fields_work, dense_sizes=(32, 48), **CUBE),
    "inpaint": Case("side of the lattice", SIDES, inpaint_work, dense_sizes=(32, 48), **CUBE),
    "render by rays": Case("rays", RAYS, render_work, dense_sizes=(1024, 2048)),
    "render by samples": Case(
        "steps a voxel", (1, 2, 4, 8), lambda n, dense: render_work(2048, dense, 1 / n), dense_sizes=(1, 2)
    ),
    "step by lattice": Case("side of the lattice", SIDES, step_work, dense_sizes=(32, 48), **CUBE),
    "step by rays": Case(
        "rays", RAYS, lambda rays, dense: step_work(32, dense, int(rays)), dense_sizes=(1024,)
    ),
    "frame, first of its time": Case(PICTURE, PIXELS, frame_work, dense_sizes=(50, 100), **SQUARE),
    "frame, another of it": Case(PICTURE, PIXELS, partial(frame_work, first=False), **SQUARE),
}

PADDED = partial(TrajectoryField, bases=10, padding=0.2)
# Each effect by itself, for what it costs a step.
ALONE: Mapping[str, dict] = {
    "view_dependence": {"view_dependence": SphericalHarmonics},
    "motion": {"motion": Motion, "trajectory": PADDED},
    "trajectory features": {"motion": Motion, "trajectory": partial(PADDED, features=12)},
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
        method.radiance.density.fill_(6.0)
        if method.background is not None:
            method.background.density.fill_(-8.0)
    return method


def step_with(choices: Mapping, side: int, rays: int, weights: Mapping[str, float]) -> Work:
    """Take a training step with some effects."""
    return training_step(module_of(method_with(choices, side), weights, side), batch_of(rays))


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
