import torch

from forewarp.fields.occupancy import Occupancy
from forewarp.scene.box import Box

BOX = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


def ball(points, time):
    """A ball of radius 0.3 that moves along x."""
    center = torch.tensor([-0.5 + time, 0.0, 0.0])
    return 50.0 * ((points - center).norm(dim=-1) < 0.3)


def looked(times, looks=200):
    lattice, draw = Occupancy(BOX, side=16, patience=16), torch.Generator().manual_seed(0)
    for _ in range(looks):
        lattice.look(ball, times, draw)
    return lattice


def test_at_first_everything_in_the_box_may_be_matter():
    lattice = Occupancy(BOX, side=8)
    points = 3 * torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) - 1.5
    assert lattice(points).equal((points.abs() < 1).all(-1))


def test_all_matter_of_all_times_is_kept_and_most_of_the_rest_is_not():
    times = [0.0, 0.5, 1.0]
    lattice = looked(times)
    points = 2 * torch.rand(4000, 3, generator=torch.Generator().manual_seed(1)) - 1
    there = torch.stack([ball(points, time) > 0 for time in times]).any(0)
    assert lattice(points)[there].all()
    assert lattice(points)[~there].float().mean() < 0.25


def test_what_is_gone_is_forgotten():
    lattice, draw = looked([0.0], 40), torch.Generator().manual_seed(2)
    for _ in range(2400):
        lattice.look(lambda points, time: torch.zeros(len(points)), [0.0], draw)
    assert not lattice(torch.tensor([[-0.5, 0.0, 0.0]])).item()


def test_it_is_kept_in_a_checkpoint():
    lattice = looked([0.0], 20)
    other = Occupancy(BOX, side=16)
    other.load_state_dict(lattice.state_dict())
    points = 2 * torch.rand(100, 3) - 1
    assert other(points).equal(lattice(points))


def test_it_settles_by_a_look_at_all_times_and_bounds_what_it_found():
    lattice = Occupancy(BOX, side=16)
    assert lattice.bounds(0.1) is None
    lattice.settle(ball, [0.0, 1.0])
    points = 2 * torch.rand(4000, 3, generator=torch.Generator().manual_seed(1)) - 1
    there = torch.stack([ball(points, time) > 0 for time in (0.0, 1.0)]).any(0)
    assert lattice(points)[there].all()
    assert lattice(points)[~there].float().mean() < 0.25
    assert lattice.cells.sum() == lattice.occupied.sum()
    box = lattice.bounds(0.1)
    for low, high, ends in zip(box.low, box.high, ((-0.8, 0.8), (-0.3, 0.3), (-0.3, 0.3))):
        assert ends[0] - 0.26 < low < ends[0]
        assert ends[1] < high < ends[1] + 0.26
