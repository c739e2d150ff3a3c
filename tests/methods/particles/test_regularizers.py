"""Regularisers are functions of tensors: a name and a weight make them part of a step."""

from functools import partial

import pytest
import torch

from forewarp.fields.curves import Curve
from forewarp.methods.particles.deformation import Deformation
from forewarp.methods.particles.model import Particles
from forewarp.methods.particles.nodes import Nodes
from forewarp.methods.particles.regularizers import REGULARIZERS, RegularizerInput, regularize, static
from tests.contract.fitting import module_of
from tests.contract.table import METHODS
from tests.support.particles import BARE, MOVING, look, module_with, shaken, small_data

DATA = small_data()


def faint(seen):
    """Mean opacity: a regulariser of another package."""
    return torch.sigmoid(seen.gaussians.opacity).mean()


class Fainter(Particles):
    """Particles with one more term."""

    regularizers = REGULARIZERS | {"faint": faint}
    terms = (*Particles.terms, "faint")


def test_a_regulariser_of_another_package_is_a_term_with_its_gradient():
    weights = {"photo": 1.0, "faint": 2.0}
    model = partial(Fainter, **MOVING)
    module = shaken(
        module_of(METHODS["particles"], DATA, model=model, weights=weights, numbers={"jitter": 0.0})
    )
    steps = [look(module, DATA, 3, factors) for factors in ({"photo": 1.0}, weights)]
    opacity = module.method.gaussians.opacity
    expected = faint(module.method)
    expected.mul(2.0).backward()
    assert float(steps[1].terms["faint"]()) == pytest.approx(float(expected.detach()))
    found = {name: steps[1].gradients[name] - gradient for name, gradient in steps[0].gradients.items()}
    torch.testing.assert_close(found.pop("gaussians.opacity"), opacity.grad, atol=1e-7, rtol=1e-3)
    assert not any(bool(gradient.any()) for gradient in found.values())


def test_what_has_no_weight_is_not_called_and_what_is_off_is_none(monkeypatch):
    monkeypatch.setitem(REGULARIZERS, "static", lambda seen: pytest.fail("it was called"))
    look(module_with(DATA, **MOVING), DATA, 0, {"photo": 1.0})
    monkeypatch.undo()
    step = look(module_with(DATA, **BARE), DATA, 0, {"photo": 1.0, "static": 1.0})
    assert all(step.terms[name]() is None for name in ("rigid", "smooth", "static"))


@pytest.mark.parametrize(("kind", "rotates"), [("spline", True), ("spline", False), ("cosines", True)])
def test_nodes_are_pulled_to_their_mean_place_by_a_force_that_does_not_grow(kind, rotates):
    draw = torch.Generator().manual_seed(0)
    nodes = Nodes(torch.randn(12, 3, generator=draw), 12, Curve(kind, 8, 5, 0.0), rotates=rotates)
    for value in (nodes.translations, nodes.rotations):
        if value is not None:
            value.data[:] = 0.3 * torch.randn(value.shape, generator=draw)
    for time in (0.2, 0.0, 1.0):
        nodes.extend(time)
    motion = nodes.motion_and_maps(nodes.curve(0.5))[0].detach()
    times = torch.linspace(0.0, 1.0, 16).tolist()
    mean = sum(nodes.motion_and_maps(nodes.curve(time))[0].detach() for time in times) / 16
    seen = RegularizerInput(None, Deformation(nodes, nodes.positions), motion, 2.0)
    pull = partial(regularize, {"static": static}, {"static": 5.0}, parameters=[])
    values, by_motion, _ = pull(seen)
    sizes = [(motion - mean)[:, :3] / 2.0, nodes.spacing[:, None] * (motion - mean)[:, 3:]]
    sizes = [(d.square().sum(-1) + 3e-3**2).sqrt() - 3e-3 for d in sizes[: 1 + rotates]]
    assert values["static"] == pytest.approx(sum(float(size.mean()) for size in sizes), rel=1e-4)
    rest, _, _ = pull(seen._replace(motion=mean))
    assert rest["static"] == pytest.approx(0.0, abs=1e-6)
    step = 1e-3 * by_motion
    ahead, behind = (pull(seen._replace(motion=motion + s * step))[0]["static"] for s in (1, -1))
    assert 5.0 * (ahead - behind) == pytest.approx(2 * float((by_motion * step).sum()), rel=2e-2)
    _, farther, _ = pull(seen._replace(motion=mean + 100 * (motion - mean)))
    assert float(farther[:, :3].norm(dim=-1).max()) <= 5.0 / 2.0 / 12 * (1 + 1e-5)
