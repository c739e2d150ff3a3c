"""Where matter is, how far it reaches, where points go, and the ellipsoids that others draw."""

import pytest
import torch

from forewarp.methods.method import HasEllipsoids
from forewarp.methods.particles.model import pinhole_of
from forewarp.ops.gaussians import Gaussians, moved, project, project_reference
from forewarp.scene.view import Moment
from tests.support.gaussians import NO_TINTS, still
from tests.support.particles import EVERY, module_with, shaken, small_data

DATA = small_data()


@pytest.mark.parametrize(
    "options", [EVERY | {"view_dependence": 2}, {"motion": None}], ids=["every", "still"]
)
@pytest.mark.parametrize("time", [0.0, 0.6])
@pytest.mark.parametrize("by", [project, project_reference])
def test_ellipsoids_are_seen_as_the_particles_are(options, time, by):
    method = shaken(module_with(DATA, **options)).method
    assert isinstance(method, HasEllipsoids)
    snapshot = method.at(Moment(time))
    pinhole = pinhole_of(DATA.scene.train[0].camera, snapshot.blur)
    cloud = method.ellipsoids(time)
    scales, quaternions = cloud.axes
    logits = cloud.opacity.logit()[:, None]
    bare = Gaussians(cloud.centers, scales.log(), quaternions, logits, cloud.harmonics)
    found = by(bare, still(bare), pinhole, NO_TINTS, torch.ones(1)).values
    expected = by(snapshot.gaussians, snapshot.warp, pinhole, snapshot.color_basis, snapshot.opacity_basis)
    torch.testing.assert_close(found, expected.values.detach(), rtol=1e-3, atol=1e-3)
    assert int((found[:, 5] > 0).sum()) > 50


@pytest.mark.parametrize("motion", ["spline", "cosines"])
def test_points_go_with_the_particles_beside_them(motion):
    method, generator = module_with(DATA, motion=motion).method, torch.Generator().manual_seed(0)
    for p in method.nodes.parameters():
        p.data += 0.05 * torch.randn(p.shape, generator=generator)
    method.skinning.logits.data += torch.randn(method.skinning.logits.shape, generator=generator)
    times = torch.tensor([method.canonical_time, 0.7])
    place, later = (moved(method.means.data, method.warp(float(time)))[0] for time in times)
    paths = method.trajectories(place[:20], times)
    torch.testing.assert_close(paths[:, 0], place[:20])
    torch.testing.assert_close(paths[:, 1], later[:20], atol=2e-3, rtol=0)  # others are near, too
    assert float((paths[:, 1] - paths[:, 0]).norm(dim=-1).amin()) > 0.01
    beside = place[:20] + 0.1 * torch.randn(20, 3, generator=generator)
    torch.testing.assert_close(method.trajectories(beside, times[:1])[:, 0], beside)


def test_where_there_is_nothing_to_see_there_are_no_bounds_and_all_particles_are_matter():
    method = module_with(DATA).method
    box = method.bounds([0.0, 1.0])
    assert all(low < high for low, high in zip(box.low, box.high))
    method.opacity.data.fill_(-9.0)
    assert method.bounds([0.0, 1.0]) is None
    assert len(method.matter()) == len(method.means)
