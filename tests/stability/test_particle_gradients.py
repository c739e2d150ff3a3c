"""What a step of particles gives, in float64, against finite differences of its own loss.

Two things are left out of gradients by design (``ops.gaussians``): that a direction turns when a particle
moves, which harmonics of degree 1 and more would see, and that a lens's slopes change then, which the shape
of a splat would see. So where either is on, only what moves nothing is held to finite differences; and with a
lens that which moves, in the numbers of a splat that have nothing to do with the slopes.
"""

from dataclasses import replace

import pytest
import torch
from torch.autograd import gradcheck

from forewarp.methods.particles import model
from forewarp.methods.particles.model import pinhole_of
from forewarp.ops.gaussians import Warp, compare, project
from tests.stability.hard_particles import BEHIND, pixels
from tests.support.gaussians import crowd, pinhole
from tests.support.particles import EVERY, FACTORS, module_with, shaken, small_data

pytestmark = pytest.mark.stability

LENS = {"radial": (0.1, -0.05, 0.01), "tangential": (0.01, -0.02), "reach": 4.0}
RESTING = ("log_scales", "quaternions", "opacity", "colors")  # what moves no particle
PLACE, SHAPE = [0, 1, 5, 6, 7, 8, 9], [2, 3, 4]  # of a splat's numbers: the conic is its shape
STEP = 1e-6


def along(loss, value, slope):
    """The derivative of ``loss()`` while ``value`` is moved along ``slope`` in place."""
    start, sides = value.clone(), []
    for sign in (1, -1):
        value.copy_(start + sign * STEP * slope)
        sides.append(loss())
    value.copy_(start)
    return (sides[0] - sides[1]) / (2 * STEP)


@pytest.mark.parametrize(("degree", "lens"), [(1, {}), (2, {}), (3, LENS)])
def test_splats_by_what_moves_nothing(degree, lens):
    particles, warp, tints, fades = crowd(count=3, degree=degree)

    def numbers(*leaves):
        own = particles._replace(**dict(zip(RESTING, leaves)))
        return project(own, warp, pinhole(**lens), tints, fades).values

    assert int((numbers()[:, 5] > 0).sum()) == 3
    leaves = [getattr(particles, name).clone().requires_grad_() for name in RESTING]
    assert gradcheck(numbers, leaves, atol=1e-6)


def test_places_behind_a_lens():
    """Of colour there is one coefficient, which no direction changes."""
    particles, warp, tints, fades = crowd(count=3, degree=0)

    def numbers(means, maps, weights):
        own = particles._replace(means=means)
        found = project(own, Warp(maps, warp.links, weights), pinhole(**LENS), tints, fades).values
        return found[:, PLACE]

    leaves = [t.clone().requires_grad_() for t in (particles.means, warp.maps, warp.weights)]
    assert gradcheck(numbers, leaves, atol=1e-6)


@pytest.mark.parametrize("lens", [{}, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_a_picture_compared_by_what_moves_nothing(degree, lens):
    particles, warp, tints, fades = crowd(count=6, degree=degree, tints=1)
    rest = (warp, pinhole(**lens), tints, fades, pixels(), BEHIND.double())
    found = compare(particles, *rest).particles
    for name in RESTING:
        value, gradient = getattr(particles, name), getattr(found, name)
        slope = torch.randn(value.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        slopes = [slope]
        if name == "colors":  # each coefficient of direction alone, too
            slopes += [slope * (torch.arange(slope.shape[1]) == k)[:, None] for k in range(slope.shape[1])]
        for one in slopes:
            expected = along(lambda: compare(particles, *rest).loss, value, one)
            assert float((gradient * one).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-6), name


@pytest.fixture(scope="module")
def data():
    return small_data()


# Of which parameters: without view dependence and lens all there are; with either those that move nothing.
STILL = {"scales", "quaternions", "opacity", "colors", "sh", "color_over_time", "opacity_over_time"}
MOVING = {"means", "nodes.translations", "nodes.rotations", "skinning.logits"}
METHODS = {
    "splines": ({"view_dependence": None}, {}, STILL - {"sh"} | MOVING),
    "cosines": ({"view_dependence": None, "motion": "cosines"}, {}, STILL - {"sh"} | MOVING),
    "no rotation": (
        {"view_dependence": None, "rotation": None},
        {},
        STILL - {"sh"} | MOVING - {"nodes.rotations"},
    ),
    "degree 3": ({"view_dependence": 3}, {}, STILL),
    "a lens": ({"view_dependence": 1}, LENS, STILL),
}


def exactly(data, options, lens, monkeypatch):
    """A shaken method in float64, whose camera has a lens or none, and a batch."""
    numbers = {"jitter": 0.0, "density": 1.0, "initial_share": 1.0, "time_offsets": 0}
    module = module_with(data, numbers=numbers, **EVERY | options)
    method = shaken(module).method.double()
    method.nodes.seen_times.copy_(torch.tensor([0.0, 1.0]))  # else the first look continues curves
    monkeypatch.setattr(model, "pinhole_of", lambda camera, blur: replace(pinhole_of(camera, blur), **lens))
    data.picker = lambda: 3
    return method, next(iter(data.train_dataloader())), module.generator


@pytest.mark.parametrize("name", METHODS)
def test_a_step_of_the_method(data, name, monkeypatch):
    """The loss is that of the step itself, all terms weighted; everything is the plain reference.

    With ``sh``, or behind a lens, what moves particles is left out: what that does to directions and to the
    slopes of a lens is left out of their gradients.
    """
    options, lens, names = METHODS[name]
    method, batch, generator = exactly(data, options, lens, monkeypatch)

    def loss():
        terms = method.look(batch, FACTORS, generator).terms
        return sum(FACTORS[term] * float(value()) for term, value in terms.items())

    gradients = method.look(batch, FACTORS, generator).gradients
    parameters = dict(method.named_parameters())
    assert gradients.keys() == parameters.keys()
    assert names == (
        parameters.keys() if names >= MOVING - {"nodes.rotations"} else parameters.keys() - MOVING
    )
    for which in sorted(names):
        draw = torch.Generator().manual_seed(1)
        value, gradient = parameters[which].data, gradients[which]
        assert gradient.dtype == torch.float64
        assert bool(gradient.any()), which
        for _ in range(2):
            slope = torch.randn(value.shape, generator=draw, dtype=torch.float64)
            expected = along(loss, value, slope)
            assert float((gradient * slope).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-7), which
