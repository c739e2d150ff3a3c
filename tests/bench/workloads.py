"""The scene that is timed: the paper's model of a moving ball, sparse, or dense as printed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial

import torch
from torch import Tensor

from forewarp.fields.curves import TrajectoryField
from forewarp.fields.grids import EMPTY, FeatureRadiance
from forewarp.methods.voxel.effects import LearnedUpsampler, Motion, UNet3d, ViewNetwork
from forewarp.methods.voxel.forward import ForwardWarp
from forewarp.methods.voxel.model import VoxelMethod
from forewarp.renderer import Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import Camera, Rays, look_at
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Batch, Moment, Observation, View
from forewarp.training.module import DynamicSceneModule
from forewarp.training.objective import Objective
from forewarp.training.schedule import Curriculum, Stage, StageSettings
from tests.support.tiny_scene import begun, built

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


def some_rays(count: int) -> Rays:
    """Return the rays through random pixels."""
    return some_pixels(count).rays()


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


def lattice_of(side: int, box: float = 1.0) -> Lattice:
    """Make a lattice of ``side * box`` voxels per axis in a box of length ``2 * box``."""
    return Lattice(Box((-box,) * 3, (box,) * 3), (round(side * box),) * 3)


def make_method(
    lattice: Lattice, side: int, dense: bool, *, effects: tuple[str, ...], shift: float = 2.3
) -> ForwardWarp:
    """Make the paper's model of a solid ball in a tenth of a box of length 2.

    At ``TIME`` it has moved by ``shift`` voxels.

    Args:
        side: voxels along a box of 2.
        dense: every voxel is active, nothing is skipped, the U-Net sees the whole lattice, channels first.
        effects: which are on.
    """
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
    radiance, (first, second, last) = (
        method.radiance,
        [m for m in method.radiance.network if hasattr(m, "weight")],
    )
    for layer in (first, second):  # the first hidden unit passes on the first feature
        layer.weight[0], layer.bias[0] = 0.0, 0.0
    first.weight[0, first.in_features - radiance.features.shape[1]] = 1.0
    second.weight[0, 0] = last.weight[0, 0] = 1.0
    # Air has the colour that absent voxels read, so that skipping it changes nothing.
    last.weight[1:, 0] = 0.1 * torch.randn(len(last.weight) - 1)
    last.bias[0] = EMPTY
    x, y, z = radiance.voxels.unbind(-1)
    radiance.features.copy_(_features(radiance.lattice, radiance.features.shape[1])[x, y, z])
    radiance.features[:, 0] = torch.where(ball[x, y, z], SOLID - EMPTY, 0.0)
    if method.motion is not None:
        trajectory = method.motion.trajectory
        basis = trajectory.basis(TIME)[0]
        trajectory.network[-1].bias[0] = shift * radiance.lattice.spacing[0] / (trajectory.scale * basis)


def _features(lattice: Lattice, channels: int) -> Tensor:
    """Draw features (X, Y, Z, channels) that do not depend on which voxels are active."""
    return 0.1 * torch.randn(*lattice.shape, channels, generator=torch.Generator().manual_seed(1))


def make_module(
    side: int,
    dense: bool,
    *,
    rays: int,
    box: float = 1.0,
    shift: float = 2.3,
    threshold: float = 1e-4,
    effects: tuple[str, ...] = EFFECTS,
) -> tuple[DynamicSceneModule, Batch]:
    """Make the paper's fine stage (U-Net of 16 channels, doubled resolution, two renderings), and a batch."""
    method = make_method(lattice_of(side, box), side, dense, effects=effects, shift=shift)
    method.renderer = Renderer(
        color_threshold=0.0 if dense else threshold, early_stop_eps=0.0 if dense else 1e-4
    )
    return module_of(method, WEIGHTS, side), batch_of(rays)
