import pytest
import torch

from forewarp.ops import splat
from forewarp.ops.splat import average_splat, with_copies
from tests.support.reference import lattice_cells, splat_sums

SHAPE = (3, 4, 5)
VOXELS = torch.tensor(lattice_cells(SHAPE), dtype=torch.float64)


def random_source(count=60, seed=0):
    return torch.randn(count, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_positions(count=25, seed=3, low=-1.5, high=5.5):
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(count, 3, generator=generator, dtype=torch.float64)


def dense(result, values):
    """Values by cell, NaN where the cell is absent."""
    padded = torch.cat([values, values.new_full(values.shape[1:], float("nan"))[None]])
    return padded[result.index.long()]


def test_equals_the_slow_twin(backend):
    source, positions = random_source(25), random_positions()
    sums, weights = splat_sums(source, positions, SHAPE)
    result = average_splat(source, positions, SHAPE, tau=1e-9)
    reached = weights > 0
    assert torch.equal(result.index >= 0, reached)
    torch.testing.assert_close(dense(result, result.coverage)[reached], weights[reached])
    average = sums[reached] / weights[reached].clamp(min=1e-9)[:, None]
    torch.testing.assert_close(dense(result, result.values)[reached], average)


def test_mass_is_lost_only_outside(backend):
    anywhere = random_positions(40)
    result = average_splat(random_source(40), anywhere, SHAPE)
    out = ((anywhere < 0) | (anywhere > torch.tensor(SHAPE) - 1)).any(-1)
    assert result.dropped == int(out.sum()) > 0
    assert 40 - result.dropped < float(result.coverage.sum()) < 40


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_implementations_agree(dtype, monkeypatch, two_threads):
    pytest.importorskip("numba")
    results = []
    for scatter in (splat._numba_scatter, splat.scatter_reference):
        monkeypatch.setattr(splat, "_numba_scatter", scatter)
        source = random_source(200).to(dtype).requires_grad_()
        positions = random_positions(200).to(dtype)
        positions[7], positions[9, 1] = float("nan"), float("inf")
        positions.requires_grad_()
        result = average_splat(source, positions, SHAPE)
        weight = torch.arange(len(result.values), dtype=dtype)
        ((result.values * weight[:, None]).sum() + (result.coverage * weight).sum()).backward()
        results.append((*(part.detach() for part in result[:3]), source.grad, positions.grad))
    for ours, reference in zip(*results):
        torch.testing.assert_close(ours, reference, rtol=1e-4, atol=1e-3)


def test_sums_in_chunks_are_the_same_each_time(two_threads):
    source, positions = random_source(500).float(), random_positions(500).float()
    first, second = (average_splat(source, positions, SHAPE).values for _ in range(2))
    assert torch.equal(first, second)


def test_nothing_arrives(backend):
    for source, positions in (
        (torch.zeros(0, 2), torch.zeros(0, 3)),
        (torch.ones(4, 2), torch.full((4, 3), 40.0)),
        (torch.ones(4, 2), torch.full((4, 3), float("nan"))),
    ):
        positions.requires_grad_()
        result = average_splat(source, positions, SHAPE)
        assert result.values.shape == (0, 2)
        assert (result.index == -1).all()
        assert result.dropped == len(source)
        result.values.sum().backward()
        assert (positions.grad == 0).all()


def test_copies_are_a_splat_onto_themselves(backend):
    source, moved = random_source(), random_source(seed=1)[:7]
    positions = random_positions(7, low=0.2, high=1.8)
    stays = torch.randperm(60, generator=torch.Generator().manual_seed(4))[:20]
    cells = VOXELS[stays].long()
    together = average_splat(torch.cat([moved, source[:20]]), torch.cat([positions, cells.double()]), SHAPE)
    copied = with_copies(average_splat(moved, positions, SHAPE), source[:20], cells)
    reached = dense(together, together.coverage).nan_to_num() > 0  # a splat notes cells of weight 0 as well
    assert torch.equal((copied.index >= 0) & reached, reached)
    for kind in ("values", "coverage"):
        one, other = (dense(result, getattr(result, kind))[reached] for result in (copied, together))
        torch.testing.assert_close(one, other)


def test_copies_alone_are_the_source(backend):
    nothing = average_splat(random_source()[:0], VOXELS[:0], SHAPE)
    copied = with_copies(nothing, random_source(), VOXELS.long())
    assert torch.equal(copied.values, random_source())
    assert torch.equal(copied.index.reshape(-1), torch.arange(60, dtype=torch.int32))
    assert (copied.coverage == 1).all()
