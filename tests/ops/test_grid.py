import numpy as np
import pytest
import torch

from forewarp.ops import grid
from tests.support.reference import lattice_cells, patch_roughness, trilinear_read, variation

SHAPE = (3, 4, 5)


def random_points(count=20, seed=1, low=-1.0, high=5.0):
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(count, 3, generator=generator, dtype=torch.float64)


def test_equals_the_slow_twin(backend, sparse):
    values, index, fill = sparse
    points = random_points()
    read = grid.trilinear(values, index, points, fill)
    torch.testing.assert_close(read, trilinear_read(values, index, points, fill))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_implementations_agree(sparse, dtype, two_threads):
    pytest.importorskip("numba")
    results = []
    for read in (grid.trilinear, grid.trilinear_reference):
        values, fill = sparse[0].to(dtype).requires_grad_(), sparse[2].to(dtype)
        points = random_points(50).to(dtype).requires_grad_()
        out = read(values, sparse[1], points, fill)
        (out * torch.arange(100, dtype=dtype).reshape(50, 2)).sum().backward()
        results.append((out.detach(), values.grad, points.grad))
    for ours, reference in zip(*results):
        torch.testing.assert_close(ours, reference, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("moving", [False, True])
def test_large_values_are_held_only_where_points_need_a_gradient(sparse, moving):
    pytest.importorskip("numba")
    values, points, held = sparse[0].requires_grad_(), random_points().requires_grad_(moving), []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: held.append(t.data_ptr()) or t, lambda t: t):
        read = grid.trilinear(values, sparse[1], points, sparse[2])
    read.sum().backward()
    assert values.grad.sum() > 0
    assert (values.data_ptr() in held) == moving


def test_points_outside_read_the_border_and_feel_no_pull(backend, sparse):
    values, index, fill = sparse
    far = torch.tensor([[-9.0, 1.2, 2.2], [1e30, 1.2, 2.2], [float("inf"), 1.2, 2.2]], dtype=torch.float64)
    near = torch.tensor([[0.0, 1.2, 2.2], [2.0, 1.2, 2.2], [2.0, 1.2, 2.2]], dtype=torch.float64)
    far.requires_grad_()
    read = grid.trilinear(values, index, far, fill)
    torch.testing.assert_close(read, grid.trilinear(values, index, near, fill))
    read.sum().backward()
    assert (far.grad[:, 0] == 0).all()
    assert far.grad.isfinite().all()


def test_no_points_and_no_voxels(backend):
    values = torch.zeros(0, 2, requires_grad=True)
    index = torch.full(SHAPE, -1, dtype=torch.int32)
    fill = torch.tensor([1.0, 2.0])
    read = grid.trilinear(values, index, torch.ones(3, 3), fill)
    assert read.tolist() == [[1.0, 2.0]] * 3
    read.sum().backward()
    assert values.grad.shape == (0, 2)
    assert grid.trilinear(values, index, torch.ones(0, 3), fill).shape == (0, 2)


def test_a_second_derivative_is_refused_and_not_silently_zero(sparse):
    pytest.importorskip("numba")
    values, index, fill = sparse
    points = random_points(3, low=0.1, high=1.9).requires_grad_()
    squared = grid.trilinear(values, index, points, fill).square().sum()
    (gradient,) = torch.autograd.grad(squared, points, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_index_of_inverts_the_list_of_voxels():
    voxels = torch.tensor([[2, 3, 4], [0, 0, 0], [1, 2, 0]])
    index = grid.index_of(voxels, SHAPE)
    assert [int(index[tuple(v)]) for v in voxels.tolist()] == [0, 1, 2]
    assert int((index >= 0).sum()) == 3
    assert (grid.index_of(voxels[:0], SHAPE) == -1).all()


def test_dilate_equals_the_largest_distance():
    mask = torch.zeros(5, 6, 7, dtype=torch.bool)
    mask[0, 2, 6] = mask[4, 5, 0] = True
    cells = np.array(lattice_cells(mask.shape))
    for by in (0, 1, 2):
        distance = [np.abs(cells - np.array(at)).max(1) for at in ((0, 2, 6), (4, 5, 0))]
        expected = (np.minimum(*distance) <= by).reshape(mask.shape)
        assert (grid.dilate(mask, by).numpy() == expected).all()


@pytest.mark.parametrize("keeping", [None, torch.arange(40) % 7 == 3, torch.zeros(40, dtype=torch.bool)])
def test_occupied_cells_have_a_corner_that_is_present_and_kept(sparse, keeping):
    index = sparse[1].clone()
    index[0] = -1
    cells = grid.occupied_cells(index, keeping)
    keep = [True] * 40 if keeping is None else keeping.tolist()
    for x, y, z in lattice_cells((2, 3, 4)):
        rows = index[x : x + 2, y : y + 2, z : z + 2].flatten().tolist()
        assert bool(cells[x, y, z]) == any(row >= 0 and keep[row] for row in rows)


def test_neighbour_pairs_are_all_pairs_at_distance_one(sparse):
    index = sparse[1]
    found = {frozenset(p) for a, b in grid.neighbour_pairs(index) for p in zip(a.tolist(), b.tolist())}
    cells = (index >= 0).nonzero()
    near = (cells[:, None] - cells).abs().sum(-1) == 1
    rows = index[cells.unbind(-1)]
    assert found == {frozenset((int(rows[a]), int(rows[b]))) for a, b in near.nonzero().tolist()}


def test_hand_worked_variation():
    index = torch.arange(4, dtype=torch.int32).reshape(2, 2, 1)
    values = torch.tensor([[0.0], [1.0], [5.0], [3.0]])
    # x: |5 - 0|, |3 - 1| -> 3.5; y: |1 - 0|, |3 - 5| -> 1.5; z has one voxel.
    assert grid.total_variation(values, grid.neighbour_pairs(index)).item() == 5.0


def test_variation_equals_the_slow_twin_and_is_0_of_constants_and_lonely_voxels(sparse):
    values, index, _ = sparse
    padded = np.concatenate([values.numpy(), np.full((1, 2), np.nan)])
    pairs = grid.neighbour_pairs(index)
    assert grid.total_variation(values, pairs).item() == pytest.approx(variation(padded[index.numpy()]))
    assert grid.total_variation(torch.ones(40, 2), pairs).item() == 0
    alone = grid.neighbour_pairs(grid.index_of(torch.tensor([[1, 1, 1]]), SHAPE))
    assert grid.total_variation(torch.ones(1, 2), alone).item() == 0


def test_patches_equal_the_slow_twin_and_opacity_is_not_pulled():
    depth, opacity = torch.rand(3, 5, 5, requires_grad=True), torch.rand(3, 5, 5, requires_grad=True)
    rough = grid.patch_variation(depth, opacity)
    assert rough.item() == pytest.approx(patch_roughness(depth, opacity))
    rough.backward()
    assert opacity.grad is None
    assert depth.grad.abs().sum() > 0
    assert grid.patch_variation(depth, torch.zeros(3, 5, 5)).item() == 0


def test_second_differences_of_a_ramp_are_none_and_of_a_square_are_two():
    axes = torch.meshgrid(*map(torch.arange, (3, 4, 5)), indexing="ij")
    ramp = (axes[0] + 2 * axes[1] - 3 * axes[2]).float()[..., None]
    assert grid.second_variation(ramp).item() == 0
    assert grid.second_variation((axes[1] ** 2).float()[..., None]).item() == pytest.approx(2 / 3)


@pytest.mark.parametrize(("value", "gradient", "total"), [(0.5, 0.5, 0.125), (3.0, 1.0, 2.5)])
def test_the_gradient_of_hubers_variation_is_the_difference_up_to_one(value, gradient, total):
    volume = torch.tensor([0.0, value]).reshape(2, 1, 1, 1).requires_grad_()
    rough = grid.huber_variation(volume)
    rough.backward()
    assert rough.item() == pytest.approx(total)
    assert volume.grad.flatten().tolist() == pytest.approx([-gradient, gradient])
