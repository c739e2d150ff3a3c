"""Scenes whose every point is known, as exports begin with them."""

import pytest
import torch

from forewarp.export.source import Source
from tests.methods.particles.test_model import EVERY, data, module_with  # noqa: F401
from tests.support.known_ball import known_ball
from tests.support.tiny_scene import ball_scene

TIMES = (0.0, 0.4, 1.0)


@pytest.fixture
def particles(data):  # noqa: F811
    """Particles with every effect whose parameters are random; a third of them rests."""
    module = module_with(data, **EVERY | {"view_dependence": 2})
    generator = torch.Generator().manual_seed(0)
    for p in module.method.parameters():
        p.data += 0.1 * torch.randn(p.shape, generator=generator)
    module.method.opacity.data += 1
    module.method.skin.let_go(torch.arange(len(module.method.means)) % 3 == 0)
    return Source(module, "particles", [frame.camera for frame in data.scene.train], TIMES)


@pytest.fixture
def ball():
    """A ball of voxels that slides along x beside a block at rest; colours follow the canonical place."""
    module = known_ball()
    radiance = module.method.radiance
    radiance.color.data = 2 * module.method.points.clone()
    return Source(module, "forward", [frame.camera for frame in ball_scene().train], TIMES)
