import numpy as np
import pytest
import torch

from forewarp.ops.grid import (
    huber_variation,
    neighbour_pairs,
    patch_variation,
    second_variation,
    total_variation,
)
from tests.support.reference import patch_roughness, variation


def test_hand_worked():
    index = torch.arange(4, dtype=torch.int32).reshape(2, 2, 1)
    values = torch.tensor([[0.0], [1.0], [5.0], [3.0]])
    # x: |5 - 0|, |3 - 1| -> 3.5; y: |1 - 0|, |3 - 5| -> 1.5; z has one voxel.
    assert total_variation(values, neighbour_pairs(index)).item() == 5.0


def test_equals_the_slow_twin(sparse):
    values, index, _ = sparse
    padded = np.concatenate([values.numpy(), np.full((1, 2), np.nan)])
    expected = variation(padded[index.numpy()])
    assert total_variation(values, neighbour_pairs(index)).item() == pytest.approx(expected)


def test_a_constant_has_none_and_lonely_voxels_too(sparse):
    _, index, _ = sparse
    assert total_variation(torch.ones(40, 2), neighbour_pairs(index)).item() == 0
    alone = torch.full((3, 4, 5), -1, dtype=torch.int32)
    alone[1, 1, 1] = 0
    values = torch.ones(1, 2, requires_grad=True)
    assert total_variation(values, neighbour_pairs(alone)).item() == 0


def test_patches_equal_the_slow_twin():
    depth, opacity = torch.rand(3, 5, 5), torch.rand(3, 5, 5)
    assert patch_variation(depth, opacity).item() == pytest.approx(patch_roughness(depth, opacity))


def test_transparent_patches_do_not_count_and_opacity_is_not_pulled():
    depth = torch.rand(2, 4, 4, requires_grad=True)
    opacity = torch.rand(2, 4, 4, requires_grad=True)
    assert patch_variation(depth, torch.zeros(2, 4, 4)).item() == 0
    patch_variation(depth, opacity).backward()
    assert opacity.grad is None
    assert depth.grad.abs().sum() > 0


def test_second_differences_of_a_ramp_are_none_and_of_a_square_are_two():
    axes = torch.meshgrid(*map(torch.arange, (3, 4, 5)), indexing="ij")
    ramp = (axes[0] + 2 * axes[1] - 3 * axes[2]).float()[..., None]
    assert second_variation(ramp).item() == 0
    assert second_variation((axes[1] ** 2).float()[..., None]).item() == pytest.approx(2 / 3)
    with pytest.raises(ValueError, match="expected 3 points an axis or more, but got"):
        second_variation(torch.zeros(3, 2, 3, 1))


def test_the_slope_of_hubers_variation_is_the_difference_up_to_one():
    volume = torch.zeros(2, 1, 1, 1, dtype=torch.float64)
    for value, slope, total in ((0.5, 0.5, 0.125), (3.0, 1.0, 2.5)):
        volume[1] = value
        leaf = volume.clone().requires_grad_()
        found = huber_variation(leaf)
        found.backward()
        assert found.item() == pytest.approx(total)
        assert leaf.grad.flatten().tolist() == pytest.approx([-slope, slope])


def test_variations_of_volumes_gradcheck():
    volume = torch.randn(3, 4, 5, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(second_variation, (volume,))
    assert torch.autograd.gradcheck(huber_variation, (0.2 * volume,))
