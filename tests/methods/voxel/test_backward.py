from functools import partial

import pytest
import torch

from forewarp.methods.voxel.backward import Deformation
from forewarp.renderer import Renderer
from forewarp.scene.box import Lattice
from forewarp.scene.view import Moment
from tests.support.tiny_scene import BOX, backward_model, built, camera_at

LATTICE = Lattice(BOX, (24, 20, 18))


def build(shift=(0.0, 0.0, 0.0), frames=5, **numbers):
    """A method in which matter moves by ``shift`` right after its canonical time, 0.3."""
    torch.manual_seed(0)
    active = torch.zeros(LATTICE.shape, dtype=torch.bool)
    active[3:7, 3:7, 3:6] = True
    model = backward_model(deformation=partial(Deformation, width=16, layers=2))
    method = built(model, LATTICE, active, frames=frames, canonical_time=0.3, **numbers)
    for parameter in method.radiance.rows():
        torch.nn.init.normal_(parameter, mean=2.0)
    if method.deformation is not None:
        method.deformation.network[-1].bias.data = -torch.tensor(shift) / method.deformation.scale
    return method


@pytest.mark.parametrize("still", [{"frames": 1}, {"effects": ["background"]}])
def test_one_time_or_a_stage_at_rest_builds_no_deformation(still):
    method, points = build(**still), torch.rand(4, 3)
    assert method.deformation is None
    assert torch.equal(method.trajectories(points, torch.rand(2)), points[:, None].expand(4, 2, 3))


def test_at_the_canonical_time_the_picture_is_the_unwarped_one():
    method = build((0.4, 0.0, 0.0))
    fields = [method.radiance(), *(method.at(Moment(time)).fields["backward"] for time in (0.3, 0.9))]
    rays, shade = camera_at(0.1).rays(), method.view_dependence
    with torch.no_grad():
        unwarped, first, later = (Renderer()(field, rays, torch.ones(3), shade).rgb for field in fields)
    assert torch.equal(first, unwarped)
    assert not torch.equal(later, unwarped)


def test_a_known_translation_moves_density_colour_and_cells():
    method = build((2 * LATTICE.spacing[0], -LATTICE.spacing[1], 0.0))
    canonical, field = method.radiance(), method.at(Moment(0.9)).fields["backward"]
    points = torch.rand(300, 3) * torch.tensor([6.0, 6.0, 4.0]) + torch.tensor([4.0, 1.0, 2.0])
    before = points - torch.tensor([2.0, -1.0, 0.0])
    torch.testing.assert_close(field.density(points), canonical.density(before), atol=1e-4, rtol=1e-4)
    along = torch.nn.functional.normalize(torch.randn(300, 3), dim=-1)
    ours, theirs = (f.colors(at, along, None) for f, at in ((field, points), (canonical, before)))
    torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-4)
    assert field.cells[canonical.cells.roll((2, -1), (0, 1))].all()
    assert field.cells.sum() < field.cells.numel()


def test_paths_invert_the_displacement():
    method = build((0.4, 0.1, -0.2))
    torch.nn.init.normal_(method.deformation.network[-1].weight, std=1e-3)
    points = torch.rand(5, 3) * 0.5
    paths = method.trajectories(points, torch.tensor([0.3, 0.9]))
    assert torch.equal(paths[:, 0], points)  # although a float32 0.3 is not 0.3
    back = paths[:, 1] + method.deformation(paths[:, 1], 0.9)
    torch.testing.assert_close(back, points, atol=1e-5, rtol=0)


def test_a_wild_deformation_leaves_finite_values_and_gradients():
    method = build((float("inf"), 0.0, 0.0))
    field = method.at(Moment(0.9)).fields["backward"]
    density = field.density(torch.rand(20, 3) * 8)
    assert (density == 0).all()
    density.sum().backward()
    assert method.radiance.density.grad.isfinite().all()
    assert field.cells.dtype == torch.bool
