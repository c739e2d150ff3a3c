import pytest
import torch

from forewarp.fields.grids import EMPTY, Activation, RadianceGrid
from forewarp.methods.voxel.effects import Crop, densify, occupied_crop, sparsify
from forewarp.scene.box import Box, Lattice

SHAPE = (5, 6, 7)
LATTICE = Lattice(Box((0, 0, 0), (4, 5, 6)), SHAPE)


def grid(voxels):
    index = torch.full(SHAPE, -1, dtype=torch.int32)
    for row, at in enumerate(voxels):
        index[at] = row
    values = torch.arange(4.0 * len(voxels)).reshape(-1, 4)
    return RadianceGrid(LATTICE, index, values, Activation(0.0, 1.0))


@pytest.mark.parametrize(
    ("voxels", "margin", "low", "high"),
    [
        ([(2, 3, 4)], 0, (2, 3, 4), (3, 4, 5)),
        ([(2, 3, 4)], 1, (1, 2, 3), (3, 4, 5)),
        ([(4, 5, 6)], 0, (3, 4, 5), (4, 5, 6)),
        ([(0, 1, 2), (3, 1, 2)], 9, (0, 0, 0), (4, 5, 6)),
        ([], 2, (0, 0, 0), (4, 5, 6)),
    ],
)
def test_the_crop_holds_all_voxels_and_at_least_two_an_axis(voxels, margin, low, high):
    assert occupied_crop(grid(voxels).index, margin) == Crop(low, high)


def test_dense_and_back():
    sparse = grid([(1, 2, 3), (2, 2, 5)])
    crop = occupied_crop(sparse.index, 1)
    assert crop.shape == (4, 3, 5)
    dense = densify(sparse, crop)
    assert dense.shape == (1, 4, 4, 3, 5)
    assert dense[0, :, 1, 1, 1].tolist() == [0, 1, 2, 3]
    assert dense[0, :, 2, 1, 3].tolist() == [4, 5, 6, 7]
    assert int((dense[0, 0] == EMPTY).sum()) == 4 * 3 * 5 - 2
    back = sparsify(sparse, LATTICE, crop, dense)
    assert int((back.index >= 0).sum()) == 60
    for at in [(1, 2, 3), (2, 2, 5)]:
        assert torch.equal(back.values[back.index[at]], sparse.values[sparse.index[at]])


def test_a_refined_crop_has_its_corners_on_the_same_points():
    crop = Crop((1, 2, 3), (3, 4, 6)).scaled(2)
    assert (crop.low, crop.high, crop.shape) == ((2, 4, 6), (6, 8, 12), (5, 5, 7))
