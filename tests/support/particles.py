"""Particles on a small scene, as many tests begin with them."""

from functools import partial

import torch

from forewarp.data.module import SceneDataModule
from forewarp.methods.particles.model import Particles
from forewarp.methods.particles.options import NAMES
from tests.contract.fitting import module_of
from tests.contract.table import METHODS
from tests.support.tiny_scene import ball_scene

BARE = dict.fromkeys(NAMES)  # no effect at all
MOVING = BARE | {"motion": "spline", "rotation": True, "view_dependence": 1}
EVERY = MOVING | {"color_over_time": 2, "opacity_over_time": 2, "exposure": 1, "background": 0.03}
FACTORS = {"photo": 1.0, "rigid": 3.0, "smooth": 0.1, "static": 0.05}


def data_of(scene):
    """The data of a scene, ready to draw batches."""
    data = SceneDataModule(lambda: scene, rays=1)
    data.setup("fit")
    return data


def small_data(frames=6):
    """The data of a scene of some small images of a moving ball."""
    return data_of(ball_scene(frames=frames, size=20))


def module_with(data, **changes):
    """A module of moving particles with these options; ``numbers`` and ``weights`` are its stage's."""
    changes = MOVING | changes
    of_entry = {key: changes.pop(key) for key in ("numbers", "weights") if key in changes}
    return module_of(METHODS["particles"], data, model=partial(Particles, **changes), **of_entry)


def shaken(module):
    """The same module with random parameters; a third of its particles rests."""
    method, generator = module.method, torch.Generator().manual_seed(0)
    for p in method.parameters():
        p.data += 0.1 * torch.randn(p.shape, generator=generator)
    if method.deformation is not None:
        method.deformation.skinning.release(torch.arange(len(method.gaussians.means)) % 3 == 0)
    return module


def look(module, data, index=None, factors=FACTORS):
    """What a module's next step gives, of the training image ``index``."""
    if index is not None:
        data.picker = lambda: index
    return module.method.look(next(iter(data.train_dataloader())), factors, module.generator)
