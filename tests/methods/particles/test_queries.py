"""Where matter is, how far it reaches, where points go, the ellipsoids that others draw, and layers."""

from dataclasses import replace

import pytest
import torch

from forewarp.methods.method import CarriesPixels, HasEllipsoids, HasLayers
from forewarp.methods.particles.model import pinhole_of
from forewarp.ops.gaussians import Gaussians, moved, project, project_reference
from forewarp.scene.view import Moment, View
from tests.support.gaussians import NO_TINTS, still
from tests.support.particles import EVERY, module_with, shaken, small_data

DATA = small_data()


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["spline", "cosines"])
def test_points_go_with_the_particles_beside_them(motion):
    method, generator = module_with(DATA, motion=motion).method, torch.Generator().manual_seed(0)
    for p in method.deformation.nodes.parameters():
        p.data += 0.05 * torch.randn(p.shape, generator=generator)
    method.deformation.skinning.logits.data += torch.randn(
        method.deformation.skinning.logits.shape, generator=generator
    )
    times = torch.tensor([method.canonical_time, 0.7])
    place, later = (moved(method.gaussians.means.data, method.warp(float(time)))[0] for time in times)
    paths = method.trajectories(place[:20], times)
    torch.testing.assert_close(paths[:, 0], place[:20])
    torch.testing.assert_close(paths[:, 1], later[:20], atol=2e-3, rtol=0)  # others are near, too
    assert float((paths[:, 1] - paths[:, 0]).norm(dim=-1).amin()) > 0.01
    beside = place[:20] + 0.1 * torch.randn(20, 3, generator=generator)
    torch.testing.assert_close(method.trajectories(beside, times[:1])[:, 0], beside)


def test_what_a_pixel_shows_goes_with_the_particles_that_show_it():
    method, generator = module_with(DATA).method, torch.Generator().manual_seed(0)
    assert isinstance(method, CarriesPixels)
    method.deformation.nodes.translations.data += 0.05 * torch.randn(
        method.deformation.nodes.translations.shape, generator=generator
    )
    alone = method.only(torch.tensor([7]))
    alone.gaussians.opacity.data.fill_(9.0)
    first, later = Moment(0.2), Moment(0.7)
    before, after = (
        moved(alone.gaussians.means.data, alone.warp(m.time))[0].detach() for m in (first, later)
    )
    camera = DATA.scene.train[0].camera
    column, row = camera.project(before)[0][0].floor().long().tolist()
    view = View(camera, torch.tensor([row * camera.width + column, 0]))
    carried = alone.carried(view, first, later)
    torch.testing.assert_close(carried[:1], after, rtol=1e-4, atol=1e-4)
    assert bool(carried[1].isnan().all())
    assert float((after - before).norm()) > 0.01


def test_where_there_is_nothing_to_see_there_are_no_bounds_and_all_particles_are_matter():
    method = module_with(DATA).method
    box = method.bounds([0.0, 1.0])
    assert all(low < high for low, high in zip(box.low, box.high))
    method.gaussians.opacity.data.fill_(-9.0)
    assert method.bounds([0.0, 1.0]) is None
    assert len(method.matter()) == len(method.gaussians.means)


def pulled(pixels, where=lambda points: points[:, 0] > 0):
    """Particles of which one side goes to and fro along y, ``pixels`` from its mean place at most."""
    method = module_with(DATA, **EVERY).method
    camera = DATA.scene.train[0].camera
    reach = pixels * float((camera.center - method.gaussians.means.data.mean(0)).norm()) / camera.fx
    moves = where(method.deformation.nodes.positions)
    method.deformation.nodes.translations.data[moves, :, 1] = reach * torch.linspace(
        -1, 1, method.deformation.nodes.curve.count
    )
    method.deformation.skinning.links = method.deformation.skinning.links[
        :, :1
    ].contiguous()  # each follows one node alone
    for name in ("shares", "logits"):
        rows = getattr(method.deformation.skinning, name).data[:, :1]
        part = torch.ones_like(rows) if name == "shares" else torch.zeros_like(rows)
        setattr(method.deformation.skinning, name, part if name == "shares" else torch.nn.Parameter(part))
    return method, moves[method.deformation.skinning.links[:, 0].long()]


@pytest.mark.slow
def test_what_moves_is_seen_to_move_and_what_rests_is_not():
    method, moves = pulled(6.0)
    assert isinstance(method, HasLayers)
    found = method.in_motion(DATA.scene.train)
    assert 0.2 < float(moves.float().mean()) < 0.8
    assert float((found == moves).float().mean()) > 0.9  # but where the median has some of both
    method.deformation.skinning.release(torch.arange(len(moves)) % 2 == 0)
    assert not bool(method.in_motion(DATA.scene.train)[::2].any())
    for calm in (pulled(0.3)[0], module_with(DATA, motion=None).method):
        assert not bool(calm.in_motion(DATA.scene.train).any())


def test_motion_along_the_rays_of_all_cameras_is_none():
    method, _ = pulled(6.0, lambda points: points[:, 0] > -9)
    frame = DATA.scene.train[0]
    pose = frame.camera.camera_to_world.clone()
    pose[:3, 3] -= 200 * pose[:3, 2]  # so far away that its rays are parallel
    camera = replace(frame.camera, camera_to_world=pose, fx=50 * frame.camera.fx, fy=50 * frame.camera.fy)
    ahead = camera.camera_to_world[:3, 2].float()
    translations = method.deformation.nodes.translations.data
    translations.copy_(translations[..., 1:2] * ahead)
    frames = [replace(frame, camera=camera, time=i / 9) for i in range(10)]
    assert not bool(method.in_motion(frames).any())
    translations.copy_(
        translations.norm(dim=-1, keepdim=True).mul(translations[..., :1].sign()) * pose[:3, 0]
    )
    assert float(method.in_motion(frames).float().mean()) > 0.5


def test_a_layer_is_some_of_the_particles_and_shares_of_layers_fill_the_picture():
    method = shaken(module_with(DATA, **EVERY)).method
    rows, view = torch.arange(len(method.gaussians.means)) % 3 == 1, View(DATA.scene.train[1].camera)
    part, whole = method.only(rows), method.at(Moment(0.4))
    for name in ("centers", "roots", "opacity", "harmonics"):
        found, wanted = (getattr(m.ellipsoids(0.4), name) for m in (part, method))
        torch.testing.assert_close(found, wanted[rows])
    assert part.size == ("particles", int(rows.sum()))
    assert len(method.gaussians.means) == len(rows)  # the method itself has all as before
    with torch.no_grad():
        shares = [whole.share(view, which) for which in (rows, ~rows)]
        alone = part.at(Moment(0.4)).render(view, torch.zeros(3)).opacity
        torch.testing.assert_close(sum(shares), whole.render(view, torch.zeros(3)).opacity)
        assert bool((shares[0] <= alone + 1e-6).all())  # others hide it
        assert float((alone - shares[0]).max()) > 0.05
        empty = method.only(torch.zeros(0, dtype=torch.int64)).at(Moment(0.4)).render(view, torch.ones(3))
    assert float(empty.opacity.max()) == 0
