"""What an effect costs a step: on, and off, where it should be nothing. Part of ``make bench``."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import torch

from forewarp.cli.stability import table
from forewarp.cli.timed_cases import Work, milliseconds, timed
from forewarp.cli.workloads import RATES, TIME, WHITE, body, camera, lattice_of, some_rays
from forewarp.fields.radiance import DirectRadiance
from forewarp.fields.trajectory import TrajectoryField
from forewarp.methods.spec import MethodSpec
from forewarp.methods.voxel.effects.background import StaticBackground
from forewarp.methods.voxel.effects.inpaint import UNet3d
from forewarp.methods.voxel.effects.motion import Motion
from forewarp.methods.voxel.effects.upsample import LearnedUpsampler
from forewarp.methods.voxel.effects.view import SphericalHarmonics
from forewarp.methods.voxel.forward_warp import ForwardWarp
from forewarp.renderer import Renderer
from forewarp.scene.batch import Batch
from forewarp.training.curriculum import Curriculum
from forewarp.training.module import DynamicSceneModule
from forewarp.training.objective import Objective
from forewarp.training.settings import StageSettings

EFFECTS: Mapping[str, dict] = {
    "view": {"view": SphericalHarmonics},
    "motion": {"motion": Motion, "trajectory": partial(TrajectoryField, bases=10, padding=0.2)},
    "trajectory features": {
        "motion": Motion,
        "trajectory": partial(TrajectoryField, bases=10, padding=0.2, features=12),
    },
    "background": {"background": partial(StaticBackground, features=3, alpha_init=1e-2, skip_alpha=1e-4)},
    "upsampler": {"upsampler": partial(LearnedUpsampler, width=16)},
    "inpainter": {"inpainter": partial(UNet3d, width=16)},
}


def method_with(choices: Mapping, side: int) -> ForwardWarp:
    """A solid ball in a tenth of a cube of ``side`` voxels along an axis, with the effects of ``choices``."""
    torch.manual_seed(0)
    lattice = lattice_of(side)
    active = body(lattice, 0.55)
    spec = MethodSpec(radiance=partial(DirectRadiance, alpha_init=1e-2, skip_alpha=1e-4), **choices)
    method = spec.build(
        lattice,
        active,
        unit=2 / (side - 1),
        scene_box=lattice.box,
        frames=50,
        canonical_time=0.0,
        effects=("motion", "view", "upsampler", "inpainter", "background"),
        still=(lattice, torch.ones_like(active)),
    )
    with torch.no_grad():
        method.radiance.parameter("density").fill_(6.0)
        if method.background is not None:
            method.background.parameter("density").fill_(-8.0)
    return method


def step_with(choices: Mapping, side: int, rays: int, weights: Mapping[str, float]) -> Work:
    """A step of training as the platform does it."""
    module = DynamicSceneModule(
        method_with(choices, side),
        renderer=Renderer(),
        objective=Objective(weights),
        settings=StageSettings("fine", voxels=[[0, side**3]], rates=RATES, iterations=100),
        curriculum=Curriculum([i / 49 for i in range(50)], 0.0),
        cameras=[camera()],
    )
    optimizer, batch = module.configure_optimizers(), batch_of(rays)

    def step() -> None:
        optimizer.zero_grad()
        module.objective(module.look(batch), 0)[0].backward()
        optimizer.step()

    return step


def step_by_hand(side: int, rays: int) -> Work:
    """The same of a static field without anything, written as if there were no effects and one term."""
    radiance, renderer, batch = method_with({}, side).radiance, Renderer(), batch_of(rays)
    generator = torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(radiance.parameters(), lr=0.1, betas=(0.9, 0.99), eps=1e-8, fused=True)

    def step() -> None:
        optimizer.zero_grad()
        drawn = renderer(radiance(), batch.rays, batch.background, None, generator)
        (drawn.rgb - batch.rgb).square().mean().backward()
        optimizer.step()

    return step


def batch_of(rays: int) -> Batch:
    """Random pixels of a picture of the ball."""
    return Batch(some_rays(rays), torch.full((rays, 3), 0.5), WHITE, TIME, 0)


def free_table(side: int = 48, rays: int = 2048) -> str:
    """Milliseconds of a step, and how many times one that was written without any effect."""
    photo, every = {"photo": 1.0}, dict.fromkeys(Objective({}).terms, 0.0)
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
