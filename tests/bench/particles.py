"""The particles that are timed: a figure like D-NeRF's hook, its run, its steps and its pictures.

After 2,500 steps hook had 12,616 particles and 200 nodes of 22 coefficients; its pictures of 400 x 400 showed
something at 19,650 pixels, and tiles had 60,000 particles to look at. The figure: 12,000, 200 of 22, 17,000
and 56,000.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from forewarp.data.module import SceneDataModule
from forewarp.methods.method import Start
from forewarp.methods.particles.model import Particles, pinhole_of
from forewarp.ops.gaussians import Gaussians, Warp, project, rasterize
from forewarp.runs.build import build_run
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.cloud import Cloud, Handover
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Moment, View
from forewarp.training.stages import Run
from tests.support.configs import composed

COUNT, SIDE, NODES = 12_000, 400, 200
LEARNED = 2_000  # steps that most particles had learned from by then
TIMES, VIEWS = 100, 8  # training times; different pictures of them
WHITE, MIDDLE = torch.ones(3), 0.5
# From, to and radius of the capsules that the figure consists of: body, head, arms, legs.
LIMBS = (
    ((0.0, 0.0, -0.1), (0.0, 0.0, 0.35), 0.22),
    ((0.0, 0.0, 0.7), (0.0, 0.0, 0.75), 0.14),
    *(((0.22 * s, 0.0, 0.4), (0.75 * s, 0.1, 0.15), 0.07) for s in (-1, 1)),
    *(((0.12 * s, 0.0, -0.25), (0.22 * s, 0.0, -0.95), 0.1) for s in (-1, 1)),
)
BOX = Box((-1.0, -0.5, -1.2), (1.0, 0.5, 1.1))


@dataclass(frozen=True)
class Size:
    """What is timed: so many ``particles`` and ``nodes``, pictures of ``side`` squared pixels; ``zoom`` makes
    the figure larger in them, at 1 it is as large as hook.
    """

    particles: int = COUNT
    side: int = SIDE
    nodes: int = NODES
    zoom: float = 1.0


def figure(count: int) -> tuple[Gaussians, float]:
    """Particles on the figure's surface, and how far they are apart; sizes and opacities as hook's."""
    draw = torch.Generator().manual_seed(0)
    areas = torch.tensor([2 * math.pi * r * (math.dist(a, b) + 2 * r) for a, b, r in LIMBS])
    limb = torch.multinomial(areas, count, replacement=True, generator=draw)
    first, last, radius = (torch.tensor(part)[limb] for part in zip(*LIMBS))
    outward = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=-1)
    along = torch.rand(count, 1, generator=draw)
    means = torch.lerp(first, last, along) + radius[:, None] * outward
    apart = math.sqrt(float(areas.sum()) / count)
    scales = math.log(apart) + torch.tensor([-0.1, -0.8, -1.7]) + 0.7 * torch.randn(count, 3, generator=draw)
    quaternions = torch.randn(count, 4, generator=draw)
    opacity = 1.5 + 2.4 * torch.randn(count, 1, generator=draw)
    colors = torch.cat([torch.randn(count, 1, 3, generator=draw), torch.zeros(count, 3, 3)], 1)
    return Gaussians(means, scales, quaternions, opacity, colors), apart


def camera(side: int, turn: float, zoom: float = 1.0) -> Camera:
    """A camera about the figure, as D-NeRF's are."""
    at = torch.tensor([3.8 * math.cos(6.283 * turn), 3.8 * math.sin(6.283 * turn), 1.4])
    pose = look_at(at, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    focal = 1.39 * side * zoom
    return Camera(side, side, focal, focal, side / 2, side / 2, pose, 2.0, 6.0)


@torch.no_grad()
def photograph(particles: Gaussians, view: Camera) -> Tensor:
    """A picture (H, W, 4) uint8 of particles that nothing moves, in other colours than they have."""
    count = len(particles.means)
    none = torch.zeros(count, 1)
    changed = particles._replace(colors=particles.colors + 0.2)
    still = Warp(torch.zeros(1, 12), none.int(), none)
    splats = project(changed, still, pinhole_of(view, 0.3), torch.zeros(0), torch.ones(1))
    drawn = rasterize(splats, view.width, view.height)
    solid = 1 - drawn.transmittance
    straight = (drawn.color / solid.clamp(min=1e-6)).clamp(0, 1)
    return (255 * torch.cat([straight, solid[None]])).round().to(torch.uint8).permute(1, 2, 0).contiguous()


@cache
def scene_of(count: int, side: int, zoom: float = 1.0) -> Scene:
    """The figure at many times; pictures repeat."""
    particles, _ = figure(count)
    cameras = [camera(side, i / VIEWS, zoom) for i in range(VIEWS)]
    pictures = [photograph(particles, view) for view in cameras]
    frames = tuple(
        Frame(f"r_{i}", i / (TIMES - 1), cameras[i % VIEWS], lambda i=i: pictures[i % VIEWS])
        for i in range(TIMES)
    )
    return Scene("figure", frames, (), (), BOX, 0.0, has_alpha=True)


def run_of(size: Size, steps: int, folder: Path, effects: Sequence[str] = ()) -> Run:
    """A run of the figure by the project's own numbers, but particles stay as many and nothing is drawn.

    ``effects``: overrides that choose other effects than cut-out pictures have by default.
    """
    nodes = size.nodes / math.sqrt(size.particles)
    config = composed(
        "model=particles", "trainer=cpu", "~stage.coarse", "callbacks.pictures=null", f"run={folder}",
        "budget.minutes=null", f"budget.iterations={steps}", f"stage.fine.nodes={nodes}",
        "stage.fine.initial_share=1.0", "stage.fine.density_interval=1.0", "stage.fine.density=1000",
        "stage.fine.crowd_decay=0.0", *effects,  # as hook, which has fewer particles than pixels
    )  # fmt: skip
    run = build_run(config)
    data = SceneDataModule(lambda: scene_of(size.particles, size.side, size.zoom), background="random")
    make = run.model
    return replace(run, datamodule=data, model=lambda start: _made(make, start, size), tell=lambda _: None)


@torch.no_grad()
def _made(make: Callable[[Start], Particles], start: Start, size: Size) -> Particles:
    """The method as it is after some training: particles as the figure has them, nodes that have moved."""
    particles, apart = figure(size.particles)
    cloud = Cloud(particles.means, torch.full_like(particles.means, 0.5), torch.ones(size.particles), apart)
    method = make(replace(start, handover=Handover(BOX, True, TIMES, cloud)))
    if not start.blank:
        method.scales.copy_(particles.log_scales)
        method.quaternions.copy_(particles.quaternions)
        method.opacity.copy_(particles.opacity)
        method.colors.copy_(particles.colors[:, :1])
        if method.nodes is not None:
            draw = torch.Generator().manual_seed(1)
            for curves in filter(
                lambda part: part is not None, (method.nodes.translations, method.nodes.rotations)
            ):
                curves.copy_(0.02 * torch.randn(curves.shape, generator=draw))
            method.nodes.seen_times.copy_(torch.tensor([0.0, 1.0]))
    return method


class Loop:
    """A step of the figure without Lightning: draw, look, optimise.

    Args:
        size: of the figure.
        effects: overrides that choose other effects than cut-out pictures have by default.
        fraction: of the stage that is taken to be done.
        learned: steps that all parameters are taken to have learned from, which the optimiser counts.
    """

    def __init__(
        self, size: Size, effects: Sequence[str] = (), *, fraction: float = 0.7, learned: int = LEARNED
    ) -> None:
        with tempfile.TemporaryDirectory() as folder:
            run = run_of(size, 1000, Path(folder) / "run", effects)
        run.datamodule.setup("fit")
        torch.manual_seed(0)
        self.module = run._module(run.stages[0])
        self.method, self.fraction = self.module.method, fraction
        self.method.warm_up()
        run.datamodule.picker, run.datamodule.asks = self.module.curriculum, self.method.asks
        self.module.curriculum.fraction = fraction
        self.optimizer = self.module.configure_optimizers()
        self.batches = iter(run.datamodule.train_dataloader())
        self.parameters = dict(self.method.named_parameters())
        self.factors = self.module.objective.factors(0)
        self.view = View(camera(size.side, 0.3, size.zoom))
        self.step()
        for state in self.optimizer.state.values():
            state["steps"].fill_(learned)

    def step(self) -> None:
        """Take a whole step."""
        for group in self.optimizer.param_groups:
            group["lr"] = group["base_lr"]
        self.method.advance(self.fraction, 0, self.optimizer)
        gradients = self.module.look(next(self.batches), self.factors).gradients
        for name, p in self.parameters.items():
            p.grad = gradients[name]
        self.optimizer.step()

    def covered(self) -> float:
        """Pixels that show something, on average over the pictures."""
        return float(self.method.covered_pixels)

    @torch.no_grad()
    def picture(self) -> Tensor:
        """Draw a picture of another time."""
        return self.method.at(Moment(MIDDLE)).render(self.view, WHITE).rgb
