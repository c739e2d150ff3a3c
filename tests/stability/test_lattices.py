"""Boxes, grids and convolutions of odd and degenerate shapes (cases 10, 11, 15 and 18 to 21)."""

import math
from functools import partial

import pytest
import torch

from forewarp.losses import tv_density, tv_flow
from forewarp.methods.voxel.effects import LearnedUpsampler, TrilinearUpsampler, UNet3d
from forewarp.ops.grid import neighbour_pairs, trilinear
from forewarp.scene.box import Box, Lattice
from tests.support.hard_cases import LATTICE, check_finite, grid, index_with

pytestmark = pytest.mark.stability


@pytest.mark.parametrize("thin", [1e-1, 1e-4, 1e-9, 1e-30])
@pytest.mark.parametrize("axes", [1, 2])
def test_a_flat_box_gets_the_voxels_asked_for_and_no_more(thin, axes):
    """Cubic voxels would need a thousand times as many for a flat box."""
    box = Box((0, 0, 0), (thin, thin if axes == 2 else 2.0, 3.0))
    for count in (1e3, 1e5, 2e6):
        lattice = Lattice.of_count(box, count)
        assert min(lattice.shape) >= 4
        assert 0.4 * count < lattice.count < 2.5 * count
        assert all(s > 0 and math.isfinite(s) for s in (*lattice.spacing, lattice.voxel_size))


def test_a_place_that_is_no_number_reads_no_number(place):
    """A NaN position reads NaN; nothing is masked silently."""
    index = torch.arange(60, dtype=torch.int32, device=place).reshape(LATTICE.shape)
    points = torch.tensor([[math.nan, 1, 1], [1, 1, 1]], device=place)
    read = trilinear(torch.ones(60, 1, device=place), index, points, torch.zeros(1, device=place))
    assert read[:, 0].isnan().tolist() == [True, False]


SIZES = [(1, 1, 1), (1, 1, 2), (2, 1, 1), (3, 5, 7), (5, 4, 9)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    ("value", "precision"),
    [
        *((value, torch.float32) for value in ("constant", "zero", "huge", "random")),
        # No constant volumes: each norm multiplies their slopes by up to 316, too much for bfloat16.
        ("random", torch.bfloat16),
    ],
)
def test_the_unet_on_any_volume(device, size, value, precision):
    torch.manual_seed(0)
    net = UNet3d(channels=4, width=16, levels=3).to(device)
    torch.nn.init.normal_(net.head.weight)
    dense = {"constant": 3.0, "zero": 0.0, "huge": 1e6}.get(value, torch.randn(1, 4, *size))
    dense = (torch.ones(1, 4, *size) * dense).to(device).requires_grad_()
    with torch.autocast(device.type, dtype=precision, enabled=precision != torch.float32):
        out = net.residual(net.features(dense))
    assert out.shape == dense.shape
    check_finite(out, dense, *(p for p in net.parameters()))


def test_half_precision_reads_only_what_was_written(device):
    """Torch's bfloat16 gradient of the weights reads unwritten memory for volumes two voxels deep."""
    net = UNet3d(channels=4, width=16, levels=3).to(device)
    for _ in range(20):
        junk = [torch.full((2**n,), math.nan, device=device) for n in range(4, 20) for _ in range(4)]
        del junk  # the allocator returns this memory next
        with torch.autocast(device.type, dtype=torch.bfloat16):
            out = net.features(torch.randn(1, 4, 3, 5, 7, device=device))
        check_finite(out, *(p for n, p in net.named_parameters() if "head" not in n))


@pytest.mark.parametrize("upsampler", [TrilinearUpsampler, partial(LearnedUpsampler, channels=4, width=16)])
@pytest.mark.parametrize("present", ["none", "one", "all"])
def test_upsampling_of_odd_grids(place, upsampler, present):
    mask = torch.full(LATTICE.shape, present == "all")
    mask[1, 2, 3] |= present == "one"
    field = grid(3.0, index=index_with(mask), device=place)
    made = upsampler().to(place)
    fine = made.alone(field) if isinstance(made, LearnedUpsampler) else made(field)
    check_finite(fine.values, field.values)
    assert fine.lattice.shape == (5, 7, 9)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 4, 1), (2, 1, 3)])
def test_total_variation_on_axes_of_one_voxel(device, shape):
    index = torch.arange(math.prod(shape), dtype=torch.int32, device=device).reshape(shape)
    pairs = neighbour_pairs(index)
    flow = torch.randn(math.prod(shape), 3, device=device, requires_grad=True)
    check_finite(tv_flow(flow, pairs), flow)
    density = flow.detach()[:, 0].clone().requires_grad_()
    check_finite(tv_density(density, pairs), density)
