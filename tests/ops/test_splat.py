import pytest
import torch
from torch.autograd import gradcheck

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


def test_hand_worked(backend):
    # Two voxels meet between cells 0 and 1 of the z axis: weights 3/4 + 1/4 and 1/4 + 3/4.
    source = torch.tensor([[8.0], [4.0]])
    positions = torch.tensor([[0, 0, 0.25], [0, 0, 0.75]])
    result = average_splat(source, positions, (2, 2, 2))
    assert dense(result, result.values)[0, 0, :, 0].tolist() == [7.0, 5.0]
    assert dense(result, result.coverage)[0, 0].tolist() == [1.0, 1.0]


def test_equals_the_slow_twin(backend):
    source, positions = random_source(25), random_positions()
    sums, weights = splat_sums(source, positions, SHAPE)
    result = average_splat(source, positions, SHAPE, tau=1e-9)
    reached = weights > 0
    assert torch.equal(result.index >= 0, reached)
    torch.testing.assert_close(dense(result, result.coverage)[reached], weights[reached])
    average = sums[reached] / weights[reached].clamp(min=1e-9)[:, None]
    torch.testing.assert_close(dense(result, result.values)[reached], average)


def test_zero_flow_is_the_identity(backend):
    source = random_source()
    result = average_splat(source, VOXELS, SHAPE)
    assert torch.equal(result.index.reshape(-1), torch.arange(60, dtype=torch.int32))
    assert torch.equal(result.values, source)
    assert (result.coverage == 1).all()
    assert result.dropped == 0


@pytest.mark.parametrize("shift", [(1, 0, 0), (0, -2, 0), (0, 1, 3), (2, 3, -4)])
def test_a_whole_voxel_shift_is_a_roll(backend, shift):
    source = random_source()
    result = average_splat(source, VOXELS + torch.tensor(shift), SHAPE)
    target = dense(result, result.values)
    target[dense(result, result.coverage).nan_to_num() == 0] = float("nan")
    expected = source.reshape(*SHAPE, 2).clone()
    for axis, by in enumerate(shift):
        expected = expected.roll(by, axis)
        if by:
            gone = range(by) if by > 0 else range(SHAPE[axis] + by, SHAPE[axis])
            expected.index_fill_(axis, torch.tensor(list(gone)), float("nan"))
    assert torch.equal(target.isnan(), expected.isnan())
    assert torch.equal(target.nan_to_num(), expected.nan_to_num())
    assert result.dropped == int(expected[..., 0].isnan().sum())


def test_mass_inside_the_box_is_conserved_and_lost_only_outside(backend):
    inside = random_positions(40, low=0.0, high=2.0)
    assert average_splat(random_source(40), inside, SHAPE).coverage.sum().item() == pytest.approx(40)
    anywhere = random_positions(40)
    result = average_splat(random_source(40), anywhere, SHAPE)
    out = ((anywhere < 0) | (anywhere > torch.tensor(SHAPE) - 1)).any(-1)
    assert result.dropped == int(out.sum()) > 0
    assert 40 - result.dropped < float(result.coverage.sum()) < 40


def test_an_average_stays_between_its_sources(backend):
    positions = random_positions(60, low=0.0, high=2.0)
    result = average_splat(torch.full((60, 1), 3.0, dtype=torch.float64), positions, SHAPE)
    solid = result.coverage >= 1e-2
    torch.testing.assert_close(result.values[solid], torch.full_like(result.values[solid], 3.0))


def test_gradcheck(backend):
    positions = torch.cat([random_positions(6, low=0.1, high=1.9), torch.full((1, 3), float("nan")).double()])
    where = positions[:6].clone().requires_grad_()
    source = random_source(7).requires_grad_()

    def run(source, where):
        result = average_splat(source, torch.cat([where, positions[6:]]), SHAPE, tau=1e-2)
        return result.values, result.coverage

    assert gradcheck(run, (source, where))


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
        results.append(
            (result.index, result.values.detach(), result.coverage.detach(), source.grad, positions.grad)
        )
    for ours, reference in zip(*results):
        torch.testing.assert_close(ours, reference, rtol=1e-4, atol=1e-3)


def test_sums_in_chunks_are_the_same_each_time(two_threads):
    source, positions = random_source(500).float(), random_positions(500).float()
    first, second = (average_splat(source, positions, SHAPE).values for _ in range(2))
    assert torch.equal(first, second)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e30])
def test_a_lost_position_contributes_nothing(backend, bad):
    source, positions = random_source(6), random_positions(6, low=0.0, high=2.0)
    without = average_splat(source[1:], positions[1:], SHAPE)
    positions[0, 1] = bad
    source.requires_grad_()
    positions.requires_grad_()
    result = average_splat(source, positions, SHAPE)
    assert torch.equal(result.values, without.values)
    assert result.dropped == 1
    result.values.square().sum().backward()
    assert source.grad.isfinite().all()
    assert positions.grad.isfinite().all()
    assert (source.grad[0] == 0).all()
    assert (positions.grad[0] == 0).all()


def test_the_slope_at_a_sliver_of_coverage_is_bounded_by_tau(backend):
    positions = torch.tensor(
        [[1.0 + 2e-7, 1.0, 1.0], [1.0, 2.0, 3e-9]], dtype=torch.float64, requires_grad=True
    )
    for tau in (1e-2, 1e-3):
        values = average_splat(random_source(2), positions, SHAPE, tau).values
        (slope,) = torch.autograd.grad(values.abs().sum(), positions)
        assert float(slope.abs().max()) < 10 / tau


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


def test_refuses_other_shapes():
    with pytest.raises(ValueError, match=r"source: expected shape \(N, C\)"):
        average_splat(torch.zeros(4), torch.zeros(4, 3), SHAPE)
    with pytest.raises(ValueError, match=r"positions: expected shape \(4, 3\), but got \(5, 3\)"):
        average_splat(torch.zeros(4, 2), torch.zeros(5, 3), SHAPE)


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


def test_copies_refuse_other_shapes():
    nothing = average_splat(random_source()[:0], VOXELS[:0], SHAPE)
    with pytest.raises(ValueError, match="cells"):
        with_copies(nothing, random_source(), VOXELS[:3].long())
