"""Pictures of any size train with the same preset: a step of the same particles says the same of all."""

import copy
from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp.data.module import SceneDataModule
from forewarp.methods.particles.model import Particles
from forewarp.ops.gaussians import BLUR
from tests.contract.fitting import module_of
from tests.contract.table import METHODS
from tests.support.particles import EVERY, look, shaken
from tests.support.tiny_scene import ball_scene

pytestmark = pytest.mark.stability

SMALL = ball_scene(frames=6, size=48)
FACTOR = 2


def enlarged(scene):
    """The scene with every training picture's pixels repeated, and cameras to match."""

    def grown(frame):
        image = frame.load().repeat_interleave(FACTOR, 0).repeat_interleave(FACTOR, 1)
        camera = frame.camera.resized(FACTOR * frame.camera.width, FACTOR * frame.camera.height)
        return replace(frame, camera=camera, load=lambda: image)

    return replace(scene, train=tuple(map(grown, scene.train)))


def made(scene):
    """A module with all effects, and the data that it is to train on."""
    data, numbers = SceneDataModule(lambda: scene, rays=1), {"jitter": 0.0, "density": 20.0}
    return module_of(METHODS["particles"], data, model=partial(Particles, **EVERY), numbers=numbers), data


def variance_of(method, camera):
    """That of the median particle in a picture, square pixels."""
    far = (method.means.data - camera.center.to(method.means)).norm(dim=-1)
    return float((method.log_scales.data.exp().mean(-1) * camera.fx / far).square().median())


def test_pictures_of_two_sizes_say_the_same():
    """The photo term, and the gradients of all terms together, of the same particles.

    What is in pixels is the blur alone: 0.1 square pixels of either picture, so that a particle with the
    variance s^2 in the smaller one is narrower by the share 0.1 (1 - 1 / 4) / s^2 in the larger. Twice that
    is allowed for, as the loss is also a sum over four places of each pixel in place of its middle.
    """
    module, data = made(SMALL)
    twin, twins_data = made(enlarged(SMALL))
    assert float(twin.method.covered) == FACTOR**2 * float(module.method.covered)
    assert float(twin.method.most) == pytest.approx(FACTOR * float(module.method.most), rel=0.02)
    most = 2 * BLUR * (1 - FACTOR**-2) / variance_of(module.method, SMALL.train[3].camera)
    assert 0.005 < most < 0.02  # neither demands the impossible nor lets much pass
    method = shaken(module).method
    method.nodes.seen.copy_(torch.tensor([0.0, 1.0]))
    other = copy.deepcopy(method)
    other.covered.copy_(twin.method.covered)
    twin.method = other
    step, larger = look(module, data, 3), look(twin, twins_data, 3)
    terms, others = ({name: float(value()) for name, value in s.terms.items()} for s in (step, larger))
    assert terms["photo"] > 0.01
    assert others["photo"] == pytest.approx(terms["photo"], rel=most)
    assert (others["rigid"], others["smooth"]) == (terms["rigid"], terms["smooth"])  # know no pictures
    assert step.gradients.keys() == dict(method.named_parameters()).keys()
    for name, gradient in step.gradients.items():
        assert float((larger.gradients[name] - gradient).norm() / gradient.norm()) < most, name
