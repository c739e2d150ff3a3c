"""Where a field has matter at any time: what is kept, what is forgotten, what images rule out."""

import math

import pytest
import torch

from forewarp.fields.occupancy import Occupancy
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.frame import Frame

BOX = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
POINTS = 2 * torch.rand(4000, 3, generator=torch.Generator().manual_seed(1)) - 1


def ball(points, time):
    """A ball of radius 0.3 that moves along x."""
    center = torch.tensor([-0.5 + time, 0.0, 0.0])
    return 50.0 * ((points - center).norm(dim=-1) < 0.3)


def looked(times, looks):
    lattice, draw = Occupancy(BOX, side=16, patience=16), torch.Generator().manual_seed(0)
    for _ in range(looks):
        lattice.look(ball, times, draw)
    return lattice


def assert_keeps_the_ball(lattice, times):
    there = torch.stack([ball(POINTS, time) > 0 for time in times]).any(0)
    assert lattice(POINTS)[there].all()
    assert lattice(POINTS)[~there].float().mean() < 0.25


def test_at_first_everything_in_the_box_may_be_matter():
    points = 1.5 * POINTS
    assert Occupancy(BOX, side=8)(points).equal((points.abs() < 1).all(-1))


def test_all_matter_of_all_times_is_kept_and_most_of_the_rest_is_not():
    times = [0.0, 0.5, 1.0]
    lattice, other = looked(times, 200), Occupancy(BOX, side=16)
    assert_keeps_the_ball(lattice, times)
    other.load_state_dict(lattice.state_dict())
    assert other(POINTS).equal(lattice(POINTS))


@pytest.mark.slow
def test_what_is_gone_is_forgotten():
    lattice, draw = looked([0.0], 40), torch.Generator().manual_seed(2)
    for _ in range(300):
        lattice.look(lambda points, time: torch.zeros(len(points)), [0.0], draw)
    assert not lattice(torch.tensor([[-0.5, 0.0, 0.0]])).item()


def test_it_settles_by_a_look_at_all_times_and_bounds_what_it_found():
    lattice = Occupancy(BOX, side=16)
    assert lattice.bounds(0.1) is None
    lattice.settle(ball, [0.0, 1.0])
    assert_keeps_the_ball(lattice, [0.0, 1.0])
    assert lattice.cells.sum() == lattice.occupied.sum()
    box = lattice.bounds(0.1)
    for low, high, ends in zip(box.low, box.high, ((-0.8, 0.8), (-0.3, 0.3), (-0.3, 0.3))):
        assert ends[0] - 0.26 < low < ends[0]
        assert ends[1] < high < ends[1] + 0.26


def shot(number, count, size=32):
    """A frame from a circle around the ball; alpha is where the ball is."""
    time, angle = number / (count - 1), 2.4 * number
    place = torch.tensor([3 * math.cos(angle), 3 * math.sin(angle), 0.5])
    pose = look_at(place, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    camera = Camera(size, size, 1.4 * size, 1.4 * size, size / 2, size / 2, pose, 2.0, 4.0)
    rays = camera.rays()
    towards = torch.tensor([-0.5 + time, 0.0, 0.0]) - rays.origins
    along = (towards * rays.directions).sum(-1, keepdim=True)
    covered = (towards - along * rays.directions).norm(dim=-1) < 0.3
    image = torch.zeros(size, size, 4, dtype=torch.uint8)
    image[..., 3] = 255 * covered.reshape(size, size)
    return Frame(str(number), time, camera, lambda: image)


def test_what_images_show_as_uncovered_is_empty_from_the_start():
    frames, asked = [shot(number, 24) for number in range(24)], []
    lattice = Occupancy(BOX, side=16)
    lattice.confine(frames, 0.1)
    there = torch.stack([ball(POINTS, f.time) > 0 for f in frames]).float().mean(0)
    assert lattice(POINTS)[there > 0.15].all()
    assert lattice(POINTS)[there == 0].float().mean() < 0.45
    lattice.look(
        lambda points, time: asked.append(points) or points.new_ones(len(points)), [0.0], torch.Generator()
    )
    assert lattice(asked[0]).all()  # a look passes over what is empty for good
