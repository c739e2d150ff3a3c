"""Small NeRF, T-NeRF, D-NeRF, Nerfies and HyperNeRF of the sliding square; how large grids grow."""

import math
from functools import partial

import torch

from forewarp.data.module import SceneDataModule
from forewarp.methods.dnerf import DNeRF
from forewarp.methods.hypernerf import HyperNeRF
from forewarp.methods.method import Start, parameter_count
from forewarp.methods.nerf import NeRF
from forewarp.methods.nerfies import Nerfies
from forewarp.methods.rays import Sampling
from forewarp.methods.tnerf import TNeRF
from forewarp.scene.box import Lattice
from forewarp.scene.view import Batch, Moment, Observation, View
from forewarp.training.objective import Objective
from forewarp.training.schedule import StageSettings
from forewarp.training.stages import Stage
from tests.support.still_cameras import camera, moving_scene, static_ceiling
from tests.support.tiny_scene import make_run

SMALL = {"width": 32, "layers": 3, "skip": None, "position_frequencies": 3, "direction_frequencies": 1}
WARP = {"warp_width": 24, "warp_layers": 3, "warp_skip": None}
GENTLE = {"density": "softplus", "open_end": False}
KINDS = {
    "nerf": partial(NeRF, **SMALL),
    "tnerf": partial(TNeRF, **SMALL, time_frequencies=2),
    "dnerf": partial(DNeRF, **SMALL, time_frequencies=2),
    "nerfies": partial(Nerfies, **SMALL, **WARP, elastic_samples=64),
    "hypernerf": partial(HyperNeRF, **SMALL, **WARP, slice_width=16),
}


def start(scene=None):
    return Start(scene or moving_scene(), "fine", {})


def method(kind, seed=0, still=None, **sampling):
    torch.manual_seed(seed)
    asked = Sampling(**({"samples": 12, "fine_samples": 12} | sampling))
    return KINDS[kind](start(moving_scene(still)), sampling=asked)


def batch(time=0.5):
    rgb = torch.rand(144, 3, generator=torch.Generator().manual_seed(0))
    return Batch((Observation(Moment(time), View(camera()), rgb, torch.ones(3)),), 0)


def shown(made, time, points=None):
    """Density and colour at some points."""
    points = torch.randn(64, 3, generator=torch.Generator().manual_seed(3)) if points is None else points
    directions = torch.tensor([0.0, 0.6, 0.8]).expand_as(points)
    return made.fields(Moment(time, camera=0))[1].radiance(points, directions)


def psnr_after(model, folder, weights, *, read=moving_scene, rays=96, seed=0, **stage):
    """Train a method for some steps: the PSNR of the pixels of all training pictures.

    Squared errors are pooled, as in ``static_ceiling``: a mean of PSNRs has no ceiling, since one picture may
    be shown exactly.
    """
    settings = StageSettings.of("fine", **{"lr": {"network": 5e-3}, "curriculum": {"all_in": 0.0}} | stage)
    data = SceneDataModule(read, rays=rays, seed=seed)
    module = make_run(folder, [Stage(settings, Objective(weights))], data=data, model=model, seed=seed).fit()
    psnr = torch.stack([module.psnr_of(target).double() for target in data.targets("train")])
    return float(-10 * torch.log10((10 ** (-psnr / 10)).mean()))


def learns_what_moves(model, folder, weights, **how):
    """Check that two of three seeds reach 3 dB more than anything that stands still can.

    One seed in a few starts where no ray meets matter, and which one it is depends on the processor.
    """

    def learns(seed):
        try:
            psnr = psnr_after(model, folder / str(seed), weights, seed=seed, **how)
        except ValueError as error:
            if "a dead start" not in str(error):
                raise
            return False
        return psnr > static_ceiling() + 3

    first = [learns(seed) for seed in (0, 1)]
    return all(first) or (any(first) and learns(2))


def at_full_size(made, num_voxels):
    """How many parameters NDVG or TiNeuVox has with about so many voxels."""
    marched = made.marching_lattice(num_voxels)
    if hasattr(made, "canonical"):
        grids = [(made.canonical, Lattice.of_count(made.box, num_voxels)), (made.deformation, marched)]
    else:
        grids = [(made.grid, marched)]
    count = parameter_count(made)
    for grid, lattice in grids:
        channels = sum(parameter.shape[1] for parameter in grid.parameters())
        count += channels * math.prod(lattice.shape) - parameter_count(grid)
    return count
