"""The sparse step that is timed computes what the dense one does, with less work."""

from functools import cache

import pytest
import torch

from forewarp.training.objective import total
from tests.bench.timed_cases import CASES
from tests.bench.workloads import make_module
from tests.stability.twin import implementation

SIDE, RAYS = 20, 400


@cache
def taken(dense, threshold=0.0):
    """Take a step; return its pictures, the step, the features' gradient (X, Y, Z, C) and the radiance."""
    module, batch = make_module(SIDE, dense, rays=RAYS, shift=2.0, threshold=threshold)
    with implementation("reference" if dense else "Numba"):
        factors = module.objective.factors(0)
        step = module.look(batch, factors)
        total(step, factors)[0].backward()
    radiance = module.method.radiance
    gradient = torch.zeros(*radiance.lattice.shape, 12)
    x, y, z = radiance.voxels.unbind(-1)
    gradient[x, y, z] = radiance.features.grad
    drawn = {name.removesuffix(".rgb"): t.detach() for name, t in step.tensors() if name.endswith(".rgb")}
    return drawn, step, gradient, radiance


# The one saving that is not exact: no colour for samples of less weight than 1e-4.
@pytest.mark.parametrize(("threshold", "most"), [(0.0, 1e-4), (1e-4, 5e-4)])
def test_a_step_on_what_is_occupied_draws_what_the_dense_one_draws(threshold, most):
    pictures, step, _, radiance = taken(False, threshold)
    exact, whole, _, everything = taken(True)
    assert len(radiance.voxels) < 0.12 * len(everything.voxels)
    assert step.noted["samples"] < 0.5 * whole.noted["samples"]
    assert exact.keys() == pictures.keys() == {"upsampled", "inpainted"}
    for name, picture in exact.items():
        assert picture.std() > 0.05
        torch.testing.assert_close(pictures[name], picture, atol=most, rtol=0)


def test_a_step_on_what_is_occupied_learns_what_the_dense_one_learns():
    inside, everywhere = taken(False)[2], taken(True)[2]
    present = inside.abs().amax(-1) > 0
    assert int(present.sum()) > 100
    scale = everywhere.abs().max()
    assert float((inside - everywhere)[present].abs().max()) < 1e-3 * scale


@pytest.mark.parametrize("dense", [False, True])
@pytest.mark.parametrize("name", ["splat", "fields", "inpaint"])
def test_every_operator_can_be_timed(name, dense):
    seen = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: seen.append(t) or t, lambda t: t):
        CASES[name].make(12, dense)()
    assert seen  # the gradient is timed too
