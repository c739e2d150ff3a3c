"""What an effect costs a step: on, and off, where it should be nothing. Part of ``make bench``."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import torch

from forewarp.fields.radiance import DirectRadiance
from forewarp.fields.trajectory import TrajectoryField
from forewarp.methods.voxel.effects.background import StaticBackground
from forewarp.methods.voxel.effects.inpaint import UNet3d
from forewarp.methods.voxel.effects.motion import Motion
from forewarp.methods.voxel.effects.upsample import LearnedUpsampler
from forewarp.methods.voxel.effects.view_dependence import SphericalHarmonics
from forewarp.methods.voxel.forward_warp import ForwardWarp
from forewarp.methods.voxel.model import ForwardModel, Ground
from forewarp.methods.voxel.stage import VoxelStage
from forewarp.methods.voxel.terms import TERMS
from forewarp.renderer import Renderer
from forewarp.training.objective import total
from tests.bench.timed_cases import Work, milliseconds, timed
from tests.bench.workloads import batch_of, body, lattice_of, module_of
from tests.stability.report import table

EFFECTS: Mapping[str, dict] = {
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
    """A solid ball in a tenth of a cube of ``side`` voxels along an axis, with the effects of ``choices``."""
    torch.manual_seed(0)
    lattice = lattice_of(side)
    active = body(lattice, 0.55)
    model = ForwardModel(radiance=partial(DirectRadiance, alpha_init=1e-2, alpha_threshold=1e-4), **choices)
    still = (lattice, torch.ones_like(active))
    ground = Ground(lattice, active, 2 / (side - 1), lattice.box, 50, 0.0, still)
    method = model.build(ground, VoxelStage(num_voxels=[[0, side**3]]))
    with torch.no_grad():
        method.radiance.parameter("density").fill_(6.0)
        if method.background is not None:
            method.background.parameter("density").fill_(-8.0)
    return method


def step_with(choices: Mapping, side: int, rays: int, weights: Mapping[str, float]) -> Work:
    """A step of training as the platform does it."""
    module = module_of(method_with(choices, side), weights, side)
    optimizer, batch = module.configure_optimizers(), batch_of(rays)

    def step() -> None:
        optimizer.zero_grad()
        factors = module.objective.factors(0)
        total(module.look(batch, factors), factors, {})[0].backward()
        optimizer.step()

    return step


def step_by_hand(side: int, rays: int) -> Work:
    """The same of a static field without anything, written as if there were no effects and one term."""
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


def free_table(side: int = 48, rays: int = 2048) -> str:
    """Milliseconds of a step, and how many times one that was written without any effect."""
    photo, every = {"photo": 1.0}, dict.fromkeys(TERMS, 0.0)
    works = {
        "written without any of it": step_by_hand(side, rays),
        "everything off": step_with({}, side, rays, photo),
        "everything off, every loss term at weight 0": step_with({}, side, rays, every | photo),
        **{f"{name} on": step_with(choice, side, rays, photo) for name, choice in EFFECTS.items()},
    }
    seconds = {name: timed(work) for name, work in works.items()}
    first = next(iter(seconds.values()))
    return table(
        ["step", "ms", "times"], [[n, milliseconds(s), f"{s / first:.2f}"] for n, s in seconds.items()]
    )
