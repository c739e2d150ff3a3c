import pytest
import torch

from forewarp.methods.method import HasEllipsoids
from forewarp.methods.particles.model import pinhole_of
from forewarp.ops.gaussians import Gaussians, project, project_reference
from forewarp.scene.view import Moment
from tests.support.gaussians import NO_TINTS, still
from tests.support.particles import EVERY, module_with, shaken


@pytest.fixture(params=["every effect", "nothing moves"])
def method(request, data):
    """Particles whose parameters are all random; some of them rest."""
    options = EVERY | {"view_dependence": 2} if request.param == "every effect" else {"motion": None}
    return shaken(module_with(data, **options)).method


@pytest.mark.parametrize("time", [0.0, 0.6])
@pytest.mark.parametrize("by", [project, project_reference])
def test_ellipsoids_are_seen_as_the_particles_are(method, data, time, by):
    assert isinstance(method, HasEllipsoids)
    snapshot = method.at(Moment(time))
    pinhole = pinhole_of(data.scene.train[0].camera, snapshot.blur)
    cloud = method.ellipsoids(time)
    scales, quaternions = cloud.axes
    bare = Gaussians(
        cloud.centers, scales.log(), quaternions, cloud.opacity.logit()[:, None], cloud.harmonics
    )
    found = by(bare, still(bare), pinhole, NO_TINTS, torch.ones(1))
    wanted = by(snapshot.gaussians, snapshot.warp, pinhole, snapshot.color_basis, snapshot.opacity_basis)
    torch.testing.assert_close(found.values, wanted.values.detach(), rtol=1e-3, atol=1e-3)
    assert int((wanted.values[:, 5] > 0).sum()) > 50
