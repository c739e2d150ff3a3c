"""Gradients of every operator equal finite differences in float64, at random inputs."""

import ast
import importlib
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings, strategies
from torch.autograd import gradcheck

from forewarp import ops
from forewarp.ops import backend
from forewarp.ops.composite import accumulate, dense_weights, render_weights
from forewarp.ops.dct import dct_basis
from forewarp.ops.encode import positional_encoding, spherical_harmonics_1
from forewarp.ops.grid import corner_weights, neighbour_pairs, trilinear, trilinear_reference
from forewarp.ops.lens import distort
from forewarp.ops.nodes import carry_nodes, node_maps, stiffness
from forewarp.ops.project import Gaussians, Splats, Warp, moved, project, project_reference, rotations
from forewarp.ops.rasterize import rasterize, rasterize_reference
from forewarp.ops.samples import midpoints, union
from forewarp.ops.splat import average_splat, scatter_reference, with_copies
from forewarp.ops.variation import patch_variation, total_variation
from tests.support.gaussians import crowd, pinhole
from tests.support.hard_cases import index_with

pytestmark = pytest.mark.stability

MANY = settings(derandomize=True, deadline=None, database=None, max_examples=8)
SEEDS = strategies.integers(0, 10_000)

# Operators without a gradient, and why.
WITHOUT = {
    "check_shape": "a guard",
    "numba_installed": "a switch",
    "use_numba": "a switch",
    "match_threads": "a switch",
    "warm_up": "compiles",
    "march": "places samples; says so",
    "march_reference": "places samples; says so",
    "check_march": "a guard",
    "stratified": "places samples",
    "by_importance": "places samples; says so",
    "clip_to_box": "of rays, which are not learned",
    "map_cells": "whole numbers",
    "unfolded": "a yes or no",
    "trace": "for pictures; says so",
    "index_of": "whole numbers",
    "dilate": "yes or no",
    "occupied_cells": "yes or no",
    "occupied_cells_reference": "yes or no",
    "neighbour_pairs": "whole numbers",
    "undistort": "made once for the rays; says so",
    "adam_rows": "an optimiser's step",
    "compare": "gives its gradients itself: tests/ops/test_compare.py compares them with finite differences",
    "compare_reference": "as compare",
    "pull_nodes": "gives its gradients itself: tests/ops/test_nodes.py compares them with the reference",
    "spread_nodes": "as pull_nodes",
    "whole": "a count",
    "spline_basis": "of times, which are not learned",
    "harmonics": "of directions, which have no gradient in project",
    "sorted_tiles": "whole numbers",
    "kept_for": "room in memory",
    "arrays": "views of tensors",
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


def check_trilinear(seed, read=trilinear):
    shape, index, values = sparse(seed)
    fill = draw(seed + 2, 2)
    inputs = (values.requires_grad_(), generic(seed, 5, shape).requires_grad_())
    assert gradcheck(lambda v, p: read(v, index, p, fill), inputs)


def check_splat(seed):
    shape = sparse(seed)[0]
    inputs = (draw(seed, 6, 2).requires_grad_(), generic(seed, 6, shape).requires_grad_())
    assert gradcheck(lambda s, p: average_splat(s, p, shape)[:2], inputs)


def check_copies(seed):
    shape = sparse(seed)[0]
    cells = torch.cartesian_prod(*(torch.arange(n) for n in shape))[seed % 3 :: 4]
    moving, still = (draw(seed + i, n, 2).requires_grad_() for i, n in enumerate((6, len(cells))))
    inputs = (moving, generic(seed, 6, shape).requires_grad_(), still)
    assert gradcheck(lambda m, p, s: with_copies(average_splat(m, p, shape), s, cells)[:2], inputs)


def check_scatter(seed):
    shape = sparse(seed)[0]
    inputs = (draw(seed, 6, 2).requires_grad_(), generic(seed, 6, shape).requires_grad_())
    assert gradcheck(lambda s, p: scatter_reference(s, p, shape)[0], inputs)


def check_weights(seed):
    ids = torch.randint(0, 4, (9,), generator=torch.Generator().manual_seed(seed)).sort().values
    optical = draw(seed, 9).exp().requires_grad_()
    assert gradcheck(lambda x: render_weights(x, ids, 5), optical)


def check_accumulate(seed):
    ids = torch.randint(0, 4, (9,), generator=torch.Generator().manual_seed(seed)).sort().values
    inputs = (draw(seed, 9).requires_grad_(), draw(seed + 1, 9, 3).requires_grad_())
    assert gradcheck(lambda w, v: accumulate(w, v, ids, 5), inputs)


def check_total_variation(seed):
    _, index, values = sparse(seed)
    pairs = neighbour_pairs(index)
    assert gradcheck(lambda v: total_variation(v, pairs), values.requires_grad_())


def check_dct(seed):
    times = draw(seed, 3).sigmoid().requires_grad_()
    assert gradcheck(lambda t: dct_basis(t, 4, 9, 0.3, 0.2), times)


CHECKS = {
    "trilinear": check_trilinear,
    "trilinear_reference": lambda seed: check_trilinear(seed, trilinear_reference),
    "corner_weights": lambda seed: gradcheck(
        lambda p: corner_weights(p, (3, 4, 5))[1], generic(seed, 4, (3, 4, 5)).requires_grad_()
    ),
    "average_splat": check_splat,
    "with_copies": check_copies,
    "scatter_reference": check_scatter,
    "render_weights": check_weights,
    "accumulate": check_accumulate,
    "dense_weights": lambda seed: gradcheck(dense_weights, draw(seed, 3, 4).exp().requires_grad_()),
    "midpoints": lambda seed: gradcheck(midpoints, draw(seed, 3, 4).requires_grad_()),
    "union": lambda seed: gradcheck(
        union, (draw(seed, 3, 4).requires_grad_(), draw(seed + 1, 3, 2).requires_grad_())
    ),
    "total_variation": check_total_variation,
    "patch_variation": lambda seed: gradcheck(
        lambda d: patch_variation(d, draw(seed, 2, 3, 3).sigmoid()), draw(seed + 1, 2, 3, 3).requires_grad_()
    ),
    "dct_basis": check_dct,
    "positional_encoding": lambda seed: gradcheck(
        lambda x: positional_encoding(x, 4), draw(seed, 3, 2).requires_grad_()
    ),
    "distort": lambda seed: gradcheck(
        lambda p: distort(p, (0.1, -0.05, 0.01), (0.01, -0.02)), draw(seed, 4, 2).requires_grad_()
    ),
    "spherical_harmonics_1": lambda seed: gradcheck(spherical_harmonics_1, draw(seed, 3, 3).requires_grad_()),
}


def check_projection(seed, see=project):
    """Gradients of all that a splat is made of: particles, nodes' maps, shares of nodes."""
    particles, warp, tints, fades = crowd(count=3, degree=0, seed=seed)

    def numbers(*leaves):
        moving = Warp(leaves[5], warp.links, leaves[6])
        return see(Gaussians(*leaves[:5]), moving, pinhole(), tints, fades).numbers

    leaves = [leaf.clone().requires_grad_() for leaf in (*particles, warp.maps, warp.weights)]
    return gradcheck(numbers, leaves, atol=1e-6)


def check_rasterizing(seed, draw=rasterize):
    """Gradients of pictures by the numbers of splats."""
    particles, warp, tints, fades = crowd(4, scale=-1.0, seed=seed)
    splats = project(particles, warp, pinhole(), tints, fades)
    inside = lambda numbers: draw(Splats(numbers, splats.reach), 3, 4)  # noqa: E731
    return gradcheck(inside, splats.numbers.clone().requires_grad_(), atol=1e-6)


def check_stiffness(seed):
    """Gradients of the strain between nodes by their motion."""
    places, edges = draw(seed, 4, 3), torch.tensor([[1, 2], [2, 3], [3, 0], [0, 1]])
    motion = 0.3 * draw(seed + 1, 4, 6)
    return gradcheck(
        lambda m: stiffness(m, places, edges, torch.full((4, 2), 0.5).double()), motion.requires_grad_()
    )


def check_moved(seed):
    """Gradients of where particles go by their means and the nodes' maps."""
    particles, warp, *_ = crowd(count=3, seed=seed)
    leaves = [leaf.clone().requires_grad_() for leaf in (particles.means, warp.maps)]
    return gradcheck(lambda means, maps: moved(means, Warp(maps, warp.links, warp.weights)), leaves)


CHECKS |= {
    "project": check_projection,
    "project_reference": lambda seed: check_projection(seed, project_reference),
    "rasterize": check_rasterizing,
    "rasterize_reference": lambda seed: check_rasterizing(seed, rasterize_reference),
    "stiffness": check_stiffness,
    "moved": check_moved,
    "rotations": lambda seed: gradcheck(rotations, draw(seed, 3, 4).requires_grad_()),
    "node_maps": lambda seed: gradcheck(
        lambda m: node_maps(m, draw(seed, 3, 3)), draw(seed + 1, 3, 6).requires_grad_()
    ),
    "carry_nodes": lambda seed: gradcheck(
        lambda s, t: carry_nodes(s, t, draw(seed, 4), draw(seed, 3, 3)),
        (draw(seed + 1, 3, 4, 3).requires_grad_(), draw(seed + 2, 3, 4, 3).requires_grad_()),
    ),
}

KERNELS = ("trilinear", "average_splat")


@pytest.mark.parametrize(
    ("operator", "numba"), [*((name, False) for name in CHECKS), *((name, True) for name in KERNELS)]
)
def test_gradients_equal_finite_differences(operator, numba, monkeypatch):
    if numba:
        pytest.importorskip("numba")
    monkeypatch.setattr(backend, "numba_installed", lambda: numba)

    @MANY
    @given(SEEDS)
    def check(seed):
        CHECKS[operator](seed)

    check()


def test_every_operator_is_checked_or_has_no_gradient():
    found = set()
    for path in Path(ops.__path__[0]).glob("*.py"):
        if path.stem.startswith(("kernels_", "lanes", "__")):
            continue
        importlib.import_module(f"forewarp.ops.{path.stem}")
        tree = ast.parse(path.read_text())
        found |= {n.name for n in tree.body if isinstance(n, ast.FunctionDef) and n.name[0] != "_"}
    assert found == set(CHECKS) | set(WITHOUT)
