import pytest
import torch

from forewarp.fields.grids import Activation, RadianceGrid
from forewarp.methods.voxel.effects import (
    LearnedUpsampler,
    TrilinearUpsampler,
    densify,
    interpolate_dense,
    occupied_crop,
    refined,
    sparsify,
)
from forewarp.scene.box import Box, Lattice
from tests.support.hard_cases import index_with

LATTICE = Lattice(Box((0, 0, 0), (2, 3, 4)), (3, 4, 5))


def grid(present=None):
    present = torch.ones(LATTICE.shape, dtype=torch.bool) if present is None else present
    index = index_with(present)
    values = torch.randn(int(present.sum()), 4, generator=torch.Generator().manual_seed(0))
    return RadianceGrid(LATTICE, index, values, Activation(-4.6, 0.5))


def corner():
    present = torch.zeros(LATTICE.shape, dtype=torch.bool)
    present[:2, 1:3, 2] = True
    return present


POINTS = torch.rand(50, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([2.0, 3.0, 4.0])


def answers(radiance):
    at = radiance.lattice.to_lattice(POINTS)
    return torch.cat([radiance.density(at)[:, None], radiance.features(at)], -1)


def test_refined_divides_the_spacing():
    assert refined(LATTICE, 2).shape == (5, 7, 9)
    assert refined(LATTICE, 2).spacing == (0.5, 0.5, 0.5)
    assert refined(LATTICE, 1.5).shape == (4, 5, 7)


@pytest.mark.parametrize("make", [grid, lambda: grid(corner())])
def test_coarse_voxels_keep_their_values(make):
    coarse = make()
    fine = TrilinearUpsampler(scale=2)(coarse)
    for at in (coarse.index >= 0).nonzero():
        row = fine.index[tuple((2 * at).tolist())]
        torch.testing.assert_close(fine.values[row], coarse.values[coarse.index[tuple(at.tolist())]])


def test_interpolation_in_occupied_cells_equals_that_of_the_whole_box():
    coarse = grid(corner())
    crop = occupied_crop(coarse.index, 9)
    dense = interpolate_dense(densify(coarse, crop), crop, 2)
    whole = sparsify(coarse, refined(LATTICE, 2), crop.scaled(2), dense)
    fine = TrilinearUpsampler(scale=2)(coarse)
    assert len(fine.values) < len(whole.values)
    torch.testing.assert_close(answers(fine), answers(whole), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("present", [None, corner()])
def test_the_learned_layer_starts_as_plain_interpolation_to_the_bit(present):
    coarse = grid(present)
    learned = LearnedUpsampler(scale=2, channels=4)
    crop = occupied_crop(coarse.index, learned.margin)
    plain = interpolate_dense(densify(coarse, crop), crop, 2)
    fine = learned.alone(coarse)
    assert torch.equal(fine.values, sparsify(coarse, fine.lattice, crop.scaled(2), plain).values)
    fine.values.sum().backward()
    assert learned.head.weight.grad.abs().sum() > 0


def stepped(recompute):
    """Detail, every gradient, and the bytes that the backward pass held, of a layer that has learned."""
    torch.manual_seed(0)
    learned = LearnedUpsampler(scale=2, channels=4, width=8, features=6, recompute=recompute)
    torch.nn.init.normal_(learned.head.weight)
    features = torch.randn(1, 6, *LATTICE.shape, requires_grad=True)
    held = {}

    def hold(kept):
        place = id(kept) if kept.is_mkldnn else kept.data_ptr()
        held[place] = kept.numel() * kept.element_size()
        return kept

    with torch.autograd.graph.saved_tensors_hooks(hold, lambda kept: kept):
        detail = learned.residual(features, occupied_crop(grid().index, 0))
    detail.square().sum().backward()
    return detail.detach(), [features.grad, *(p.grad for p in learned.parameters())], sum(held.values())


def test_recomputing_holds_less_and_changes_nothing():
    (detail, gradients, held), (plain, plain_gradients, plain_held) = stepped(True), stepped(False)
    assert torch.equal(detail, plain)
    assert len(gradients) == len(plain_gradients) == 13
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(gradients, plain_gradients))
    assert all(gradient.abs().sum() > 0 for gradient in gradients[:-2])
    assert held < 0.5 * plain_held
