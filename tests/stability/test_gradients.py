"""Gradients of every operator equal finite differences in float64, at random inputs."""

import ast
import importlib
from functools import partial
from pathlib import Path

import pytest
import torch
from torch.autograd import gradcheck

from forewarp import ops
from forewarp.ops import backend, gaussians, grid, nodes
from forewarp.ops.curves import dct_basis
from forewarp.ops.encode import positional_encoding, spherical_harmonics_1
from forewarp.ops.lens import distort, distort_with_jacobian
from forewarp.ops.march import accumulate, dense_weights, midpoints, render_weights, union
from forewarp.ops.splat import average_splat, scatter_reference, with_copies
from tests.support.gaussians import crowd, pinhole
from tests.support.hard_cases import index_with

pytestmark = pytest.mark.stability

LENS = ((0.1, -0.05, 0.01), (0.01, -0.02))
# Why operators have no gradient, and which.
WITHOUT = {
    "a guard or a switch": "check_shapes numba_installed use_numba match_threads warm_up"
    " has_kernels cores compile_backward_kernels is_number check_value",
    "places samples, which no loss pulls at": "march march_reference stratified by_importance clip_to_box",
    "whole numbers, or yes and no": "unfolded index_of dilate occupied_cells neighbour_pairs encoded_size",
    "says that it has none": "trace undistort adam_rows arrays",
    "of times or directions, which are not learned": "spline_basis spline_shares harmonics",
    "gives its own, which test_gaussians and test_nodes compare": "compare compare_reference pull_nodes"
    " spread_nodes",
}


def generic(seed, count, shape):
    """Draw float64 positions (count, 3) inside a lattice, away from whole coordinates, where slopes jump."""
    generator = torch.Generator().manual_seed(seed)
    cell = torch.stack([torch.randint(0, n - 1, (count,), generator=generator) for n in shape], -1)
    return cell + 0.1 + 0.8 * torch.rand(count, 3, generator=generator, dtype=torch.float64)


def draw(seed, *shape):
    generator = torch.Generator().manual_seed(seed + 1)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def sparse(seed):
    """Draw a shape, an index over it with absent voxels, and values (M, 2)."""
    generator = torch.Generator().manual_seed(seed)
    shape = tuple(torch.randint(2, 5, (3,), generator=generator).tolist())
    present = torch.rand(shape, generator=generator) < 0.7
    present[0, 0, 0] = True
    return shape, index_with(present), draw(seed, int(present.sum()), 2)


def ids_of(seed):
    """Sort nine samples of five rays; the last ray has none."""
    return torch.randint(0, 4, (9,), generator=torch.Generator().manual_seed(seed)).sort().values


def of_trilinear(seed, read=grid.trilinear):
    shape, index, values = sparse(seed)
    return lambda v, p: read(v, index, p, draw(seed + 2, 2)), values, generic(seed, 5, shape)


def of_splat(seed, splat=average_splat):
    shape = sparse(seed)[0]
    return lambda s, p: splat(s, p, shape)[:2], draw(seed, 6, 2), generic(seed, 6, shape)


def of_copies(seed):
    shape = sparse(seed)[0]
    cells = torch.cartesian_prod(*(torch.arange(n) for n in shape))[seed % 3 :: 4]
    copied = lambda m, p, s: with_copies(average_splat(m, p, shape), s, cells)[:2]  # noqa: E731
    return copied, draw(seed, 6, 2), generic(seed, 6, shape), draw(seed + 1, len(cells), 2)


def of_total_variation(seed):
    _, index, values = sparse(seed)
    return lambda v: grid.total_variation(v, grid.neighbour_pairs(index)), values


def of_patch_variation(seed):
    return lambda d: grid.patch_variation(d, draw(seed, 2, 3, 3).sigmoid()), draw(seed + 1, 2, 3, 3)


def of_carried(seed):
    carried = lambda a, b: nodes.carry_nodes(a, b, draw(seed, 4), draw(seed, 3, 3))  # noqa: E731
    return carried, draw(seed + 1, 3, 4, 3), draw(seed + 2, 3, 4, 3)


def of_projection(seed, see=gaussians.project):
    """All that a splat is made of: particles, nodes' maps, shares of nodes."""
    particles, warp, *bases = crowd(count=3, degree=0, seed=seed)

    def numbers(*leaves):
        moving = gaussians.Warp(leaves[5], warp.links, leaves[6])
        return see(gaussians.Gaussians(*leaves[:5]), moving, pinhole(), *bases).values

    return numbers, *particles, warp.maps, warp.weights


def of_rasterizing(seed, draw=gaussians.rasterize):
    """Pictures by the numbers of splats."""
    particles, warp, *bases = crowd(4, scale=-1.0, seed=seed)
    splats = gaussians.project(particles, warp, pinhole(), *bases)
    return lambda numbers: draw(gaussians.Splats(numbers, splats.reach), 3, 4), splats.values


def of_stiffness(seed):
    """The strain between nodes by their motion."""
    places, edges = draw(seed, 4, 3), torch.tensor([[1, 2], [2, 3], [3, 0], [0, 1]])
    shares = torch.full((4, 2), 0.5).double()
    return lambda m: nodes.stiffness(m, places, edges, shares), 0.3 * draw(seed + 1, 4, 6)


def of_moved(seed):
    """Where particles go by their means and the nodes' maps."""
    particles, warp, *_ = crowd(count=3, seed=seed)
    went = lambda means, maps: gaussians.moved(means, warp._replace(maps=maps))  # noqa: E731
    return went, particles.means, warp.maps


# For each operator: what to differentiate, and the tensors by which to do so.
CHECKS = {
    "trilinear": of_trilinear,
    "trilinear_reference": partial(of_trilinear, read=grid.trilinear_reference),
    "corner_weights": lambda s: (lambda p: grid.corner_weights(p, (3, 4, 5))[1], generic(s, 4, (3, 4, 5))),
    "average_splat": of_splat,
    "with_copies": of_copies,
    "scatter_reference": partial(of_splat, splat=lambda *a: scatter_reference(*a)[:1]),
    "render_weights": lambda s: (lambda x: render_weights(x, ids_of(s), 5), draw(s, 9).exp()),
    "accumulate": lambda s: (lambda w, v: accumulate(w, v, ids_of(s), 5), draw(s, 9), draw(s + 1, 9, 3)),
    "dense_weights": lambda s: (dense_weights, draw(s, 3, 4).exp()),
    "midpoints": lambda s: (midpoints, draw(s, 3, 4)),
    "union": lambda s: (union, draw(s, 3, 4), draw(s + 1, 3, 2)),
    "total_variation": of_total_variation,
    "patch_variation": of_patch_variation,
    "dct_basis": lambda s: (lambda t: dct_basis(t, 4, 9, 0.3, 0.2), draw(s, 3).sigmoid()),
    "block_sums": lambda s: (grid.block_sums, draw(s, 4, 6, 2)),
    "block_means": lambda s: (lambda x: grid.block_means(x, 2), draw(s, 4, 6, 2)),
    "reduced_depth": lambda s: (grid.reduced_depth, draw(s, 4, 6).abs() + 0.1),
    "positional_encoding": lambda s: (lambda x: positional_encoding(x, 4), draw(s, 3, 2)),
    "distort": lambda s: (lambda p: distort(p, *LENS), draw(s, 4, 2)),
    "distort_with_jacobian": lambda s: (lambda p: distort_with_jacobian(p, *LENS)[1], draw(s, 4, 2)),
    "spherical_harmonics_1": lambda s: (spherical_harmonics_1, draw(s, 3, 3)),
    "project": of_projection,
    "project_reference": partial(of_projection, see=gaussians.project_reference),
    "rasterize": of_rasterizing,
    "rasterize_reference": partial(of_rasterizing, draw=gaussians.rasterize_reference),
    "stiffness": of_stiffness,
    "skin_weights": lambda s: (partial(nodes.skin_weights, draw(s, 5, 3).exp()), draw(s + 1, 5, 3)),
    "moved": of_moved,
    "move_by_screw": lambda s: (nodes.move_by_screw, draw(s, 3, 3), draw(s + 1, 3, 3), draw(s + 2, 3, 3)),
    "second_variation": lambda s: (grid.second_variation, draw(s, 3, 4, 5, 2)),
    "huber_variation": lambda s: (grid.huber_variation, 2 * draw(s, 3, 4, 5, 2)),
    "stretch": lambda s: (nodes.stretch, torch.eye(3, dtype=torch.float64) + 0.2 * draw(s, 2, 3, 3)),
    "geman_mcclure": lambda s: (partial(nodes.geman_mcclure, scale=0.5), draw(s, 5).square()),
    "rotations": lambda s: (gaussians.rotations, draw(s, 3, 4)),
    "node_maps": lambda s: (lambda m: nodes.node_maps(m, draw(s, 3, 3)), draw(s + 1, 3, 6)),
    "carry_nodes": of_carried,
}

KERNELS = ("trilinear", "average_splat")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("operator", "numba"),
    [
        # Without Numba ``project`` is ``project_reference``.
        *(pytest.param(n, False, marks=pytest.mark.slow if n == "project" else ()) for n in CHECKS),
        *((name, True) for name in KERNELS),
    ],
)
def test_gradients_equal_finite_differences(operator, numba, monkeypatch):
    if numba:
        pytest.importorskip("numba")
    monkeypatch.setattr(backend, "numba_installed", lambda: numba)
    function, *inputs = CHECKS[operator](0)
    assert gradcheck(function, [x.detach().clone().requires_grad_() for x in inputs], atol=1e-6)


def test_every_operator_is_checked_or_has_no_gradient():
    found = set()
    for path in Path(ops.__path__[0]).glob("*.py"):
        if path.stem.startswith("__"):
            continue
        importlib.import_module(f"forewarp.ops.{path.stem}")
        tree = ast.parse(path.read_text())
        found |= {n.name for n in tree.body if isinstance(n, ast.FunctionDef) and n.name[0] != "_"}
    assert found == set(CHECKS) | set(" ".join(WITHOUT.values()).split())
