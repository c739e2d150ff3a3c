"""Particles on a small scene, as many tests begin with them."""

from functools import partial

import torch

from forewarp.methods.particles.model import Particles
from tests.contract.fitting import module_of
from tests.contract.scenes import data_of, write_dnerf
from tests.contract.table import METHODS

MOVING = {"motion": "spline", "rotation": True, "view_dependence": 1}
EVERY = MOVING | {"color_over_time": 2, "opacity_over_time": 2, "background": 0.03}


def small_data(folder):
    """The data of a small scene with a moving ball, written into a folder."""
    write_dnerf(folder / "dnerf")
    return data_of("dnerf", folder)


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
    if method.skin is not None:
        method.skin.let_go(torch.arange(len(method.means)) % 3 == 0)
    return module


def look(module, data, index=None, factors=None):
    """What a module's next step gives, of the training picture ``index``."""
    if index is not None:
        data.picker = lambda: index
    batch = next(iter(data.train_dataloader()))
    factors = {"photo": 1.0, "rigid": 3.0, "smooth": 0.1} if factors is None else factors
    return module.method.look(batch, factors, module.generator)
