"""Scenes whose every point is known, as exports begin with them."""

import copy
from dataclasses import replace

import pytest

from forewarp.export import formats
from forewarp.export.tracks import Source
from tests.support.particles import EVERY, module_with, shaken, small_data
from tests.support.tiny_scene import ball_scene, known_ball

TIMES = (0.0, 0.4, 1.0)


def exporter(kind, **defaults):
    """Return ``export(source, folder, **options)``, which writes a format and returns ``about.json``."""

    def export(source, folder, **options):
        return formats.write(kind, source, folder, {}, lambda *done: None, **defaults | options)

    return export


@pytest.fixture(scope="session")
def _particles():
    data = small_data()
    module = shaken(module_with(data, **EVERY | {"view_dependence": 2}))
    module.method.gaussians.opacity.data += 1
    return Source(module, "particles", [frame.camera for frame in data.scene.train], TIMES)


@pytest.fixture
def particles(_particles):
    """Particles with every effect whose parameters are random; a third of them rests."""
    return replace(_particles, module=copy.deepcopy(_particles.module))


@pytest.fixture
def ball():
    """A ball of voxels that slides along x beside a block at rest; colours follow the canonical place."""
    module = known_ball()
    radiance = module.method.radiance
    radiance.color.data = 2 * module.method.points.clone()
    return Source(module, "forward", [frame.camera for frame in ball_scene().train], TIMES)
