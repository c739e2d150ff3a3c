import math

import pytest
import torch

from forewarp.scene.box import Box, Lattice

BOX = Box((-1, 0, 2), (1, 3, 6))


def test_hand_worked():
    assert (BOX.size, BOX.center, BOX.diagonal) == ((2, 3, 4), (0, 1.5, 4), pytest.approx(math.sqrt(29)))
    assert BOX.scaled(2) == Box((-2, -1.5, 0), (2, 4.5, 8))
    assert BOX.padded(1) == Box((-2, -1, 1), (2, 4, 7))
    assert BOX.intersection(Box((0, -9, 3), (9, 9, 4))) == Box((0, 0, 3), (1, 3, 4))
    assert BOX.meets(Box((0, -9, 3), (9, 9, 4)))
    for low in (1.0, 5.0):  # a face is shared; nothing is
        assert not BOX.meets(Box((low, 0, 2), (low + 1, 3, 6)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_outermost_points_lie_on_the_faces_and_coordinates_round_trip(dtype):
    lattice = Lattice(BOX, (3, 4, 5))
    world = lattice.to_world(lattice.all_voxels())
    assert world[0].tolist() == list(BOX.low)
    assert world[-1].tolist() == list(BOX.high)
    assert world[1].tolist() == [-1, 0, 3]  # the last axis runs fastest
    assert (lattice.count, lattice.spacing, lattice.voxel_size) == (60, (1, 1, 1), pytest.approx(1))
    points = torch.randn(9, 3, dtype=dtype)
    torch.testing.assert_close(lattice.to_world(lattice.to_lattice(points)), points)
    corners = torch.tensor([[0, 0, 0], [2, 3, 4]], dtype=dtype)
    assert lattice.normalised(corners).tolist() == [[-1, -1, -1], [1, 1, 1]]


@pytest.mark.parametrize("count", [500, 20_000, 300_763])
def test_a_lattice_of_a_count_has_about_that_many_cubic_voxels(count):
    lattice = Lattice.of_count(BOX, count)
    assert lattice.count == pytest.approx(count, rel=0.15)
    assert max(lattice.spacing) / min(lattice.spacing) < 1.2


FLAT = [((0, 0, 0), (1, 1, 0)), ((0, 0, 0), (1, -1, 1)), ((0, 0), (1, 1, 1)), ((0, 0, math.nan), (1, 1, 1))]


@pytest.mark.parametrize(("low", "high"), FLAT)
def test_what_has_no_extent_is_refused(low, high):
    with pytest.raises(ValueError, match="expected finite low < high on three axes, but got low="):
        Box(low, high)
    with pytest.raises(ValueError, match=r"three axes of at least 2 points, but got shape=\(3, 1, 4\)"):
        Lattice(BOX, (3, 1, 4))
