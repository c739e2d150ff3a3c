"""How a stage changes voxel grids: schedules, active voxels, lattices, bounds."""

from functools import partial

import pytest
import torch

from forewarp.fields.grids import DirectRadiance
from forewarp.methods.voxel.backward import Deformation
from forewarp.methods.voxel.structure import VoxelStage, refresh, resample, seen_rows
from forewarp.scene.box import Box, Lattice
from tests.support.tiny_scene import BOX, backward_model, built, forward_model


def test_schedules_hold_until_the_next_entry():
    made = VoxelStage(num_voxels=[[0.2, 10], [0.5, 20], [0.75, 30]])  # the first holds from the beginning
    assert [made.at("num_voxels", f) for f in (0, 0.49, 0.5, 0.74, 0.75, 1)] == [10, 10, 20, 20, 30, 30]
    assert made.at("bases", 0.5) is None


SHAPE = (6, 5, 7)
LATTICE = Lattice(Box((0, 0, 0), (5, 4, 6)), SHAPE)
COMMON = {"features": 3, "alpha_init": 1e-2, "density_scale": 1.0, "alpha_threshold": 0.0}
STAGE = VoxelStage(num_voxels=[[0, 100]], keep_alpha=1e-2, birth_alpha=5e-3)
SOLID, AIR = 8.0, -9.0


def radiance(*solid):
    """All voxels active, a few solid, colours numbered."""
    made = DirectRadiance(LATTICE, torch.ones(SHAPE, dtype=torch.bool), **COMMON)
    made.density.data[:] = AIR
    for at in solid:
        made.density.data[made.index[at].long()] = SOLID
    made.color.data = torch.arange(210.0)[:, None].expand(210, 3).clone()
    return made


def adam(made, unseen=()):
    """An optimiser after one step with gradients numbered by row, 0 in the rows that no view has seen."""
    groups = [{"params": [p], "lr": 0.0} for p in made.parameters()]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), fused=True)
    for p in made.parameters():
        p.grad = torch.arange(1.0, len(p) + 1)[:, None].expand_as(p).clone()
        p.grad[list(unseen)] = 0
    optimizer.step()
    return optimizer


def around(at):
    """The voxels at most one step from ``at``."""
    active = torch.zeros(SHAPE, dtype=torch.bool)
    active[tuple(slice(max(v - 1, 0), v + 2) for v in at)] = True
    return active


def test_refresh_keeps_values_and_moments_in_the_right_rows():
    made = radiance((2, 2, 3))
    optimizer = adam(made)
    refresh(made, STAGE, optimizer, False, None)
    assert torch.equal(made.index >= 0, around((2, 2, 3)))
    x, y, z = made.voxels.unbind(-1)
    number = (x * SHAPE[1] + y) * SHAPE[2] + z
    assert torch.equal(made.color[:, 0], number.float())
    assert int((made.density == SOLID).sum()) == 1
    for parameter in (made.density, made.color):
        moments = optimizer.state[parameter]
        torch.testing.assert_close(moments["exp_avg"][:, 0], 0.1 * (number + 1.0))
        torch.testing.assert_close(moments["exp_avg_sq"][:, 0], 0.01 * (number + 1.0) ** 2)
        assert float(moments["step"]) == 1


def test_refresh_gives_births_to_new_voxels_and_no_moments():
    made = radiance((2, 2, 3))
    optimizer = adam(made)
    refresh(made, STAGE, optimizer, False, None)
    old, density = made.index >= 0, made.density
    refresh(made, STAGE, optimizer, False, None)
    assert made.density is density  # nothing has changed
    made.density.data[made.index[3, 3, 4].long()] = SOLID  # matter has reached a corner of the active set
    refresh(made, STAGE, optimizer, False, None)
    assert torch.equal(made.index >= 0, around((2, 2, 3)) | around((3, 3, 4)))
    new = ~old[made.voxels.unbind(-1)]
    alpha = made.activation.alpha(made.density[new, 0], LATTICE.voxel_size)
    torch.testing.assert_close(alpha, torch.full_like(alpha, 5e-3), rtol=1e-3, atol=0)
    for parameter in made.parameters():
        moments = optimizer.state[parameter]["exp_avg"]
        assert ((moments == 0).all(-1) == new).all()


def test_an_empty_grid_is_left_as_it_is():
    made = radiance()
    before = made.density
    refresh(made, STAGE, adam(made), False, None)
    assert made.density is before


def test_what_no_view_has_seen_is_forgotten_where_asked():
    made = radiance((0, 0, 0), (5, 4, 6))
    assert seen_rows(made, torch.optim.Adam(made.parameters())).all()  # nothing is known yet
    optimizer = adam(made, unseen=[0])
    assert seen_rows(made, optimizer).logical_not().nonzero().tolist() == [[0]]
    refresh(made, STAGE, optimizer, True, None)
    assert torch.equal(made.index >= 0, around((5, 4, 6)))


def test_voxels_are_born_only_where_allowed():
    made, allowed = radiance((2, 2, 3)), torch.zeros(SHAPE, dtype=torch.bool)
    allowed[3:] = True
    refresh(made, STAGE, adam(made), False, allowed)
    expected = around((2, 2, 3)) & allowed
    expected[2, 2, 3] = True  # matter itself stays
    assert torch.equal(made.index >= 0, expected)


def test_resample_follows_what_is_occupied():
    made = radiance(*map(tuple, around((2, 2, 3)).nonzero().tolist()))
    optimizer = adam(made, unseen=[0])
    before = made().density(torch.tensor([[2.0, 2.0, 3.0]]))
    place = LATTICE.to_world(torch.tensor([[2, 2, 3]]))
    resample(made, STAGE, optimizer, Lattice.of_count(Box((0, 0, 1), (5, 4, 6)), 1500), only_seen=True)
    assert made.lattice.count == pytest.approx(1500, rel=0.2)
    torch.testing.assert_close(made().density(made.lattice.to_lattice(place)), before)
    reach = (made.lattice.to_world(made.voxels) - place).abs().amax(-1).max()
    assert 1.2 < reach < 2.5  # the block and a little more, not the whole box
    assert all(optimizer.state[p]["exp_avg"].shape == p.shape for p in made.parameters())
    made().values.sum().backward()
    optimizer.step()


def test_resample_does_not_lose_the_border_to_rounding():
    box = Box((-0.3, -0.3, -0.7), (0.3, 0.9, 1.1))  # its last coarser point is read at 5.0000005 of 5
    made = DirectRadiance(Lattice(box, SHAPE), torch.ones(SHAPE, dtype=torch.bool), **COMMON)
    made.density.data[:] = AIR
    made.density.data[made.index[-1].flatten().long()] = SOLID
    resample(made, STAGE, None, Lattice.of_count(box, 800))
    assert (made.index[-2:] >= 0).all()
    assert (made.index[:-2] < 0).all()


def test_resample_of_an_empty_field_keeps_all_voxels():
    made = radiance()
    resample(made, STAGE, None, Lattice.of_count(LATTICE.box, 400))
    assert (made.index >= 0).all()


@pytest.mark.parametrize("kind", ["forward", "backward"])
def test_the_box_of_all_times_of_a_known_translation(kind):
    backward = backward_model(deformation=partial(Deformation, width=8, layers=2))
    model, shift = backward if kind == "backward" else forward_model(), torch.tensor([0.7, -0.3, 0.0])
    method = built(model, Lattice(BOX, (12, 9, 8)), density_scale=0.2, frames=2)
    radiance = method.radiance
    radiance.density.data[:] = AIR
    radiance.density.data[radiance.index[3, 4, 4].long()] = SOLID
    if kind == "backward":
        method.deformation.network[-1].bias.data = -shift / method.deformation.scale
    else:  # of two frames: one basis, b(1) - b(0) = -sqrt(2)
        trajectory = method.motion.trajectory
        trajectory.network[-1].bias.data = shift / (-(2**0.5) * trajectory.scale)
    home, margin = radiance.lattice.to_world(torch.tensor([3.0, 4.0, 4.0])), 2 * radiance.lattice.voxel_size
    for times, moved in (([0.0], torch.zeros(3)), ([0.0, 1.0], shift)):
        box = method.bounds(times)
        assert box.low == pytest.approx((home + moved.clamp(max=0) - margin).tolist(), abs=1e-5)
        assert box.high == pytest.approx((home + moved.clamp(min=0) + margin).tolist(), abs=1e-5)


def test_nothing_has_no_box():
    method = built(forward_model(), Lattice(BOX, (12, 9, 8)))
    torch.nn.init.constant_(method.radiance.density, AIR)
    assert method.bounds([0.0, 1.0]) is None
