"""On a GPU every operator gives the values and gradients that it gives on the CPU, in float64."""

from collections.abc import Callable

import pytest
import torch

from forewarp.ops.adam import AdamState, adam_rows
from forewarp.ops.curves import dct_basis, spline_basis
from forewarp.ops.encode import positional_encoding, spherical_harmonics_1
from forewarp.ops.gaussians import Gaussians, Splats, Warp, compare, project, rasterize
from forewarp.ops.grid import (
    dilate,
    huber_variation,
    neighbour_pairs,
    occupied_cells,
    patch_variation,
    second_variation,
    total_variation,
    trilinear,
)
from forewarp.ops.lens import distort, undistort
from forewarp.ops.march import (
    accumulate,
    by_importance,
    clip_to_box,
    dense_weights,
    march,
    render_weights,
    stratified,
)
from forewarp.ops.nodes import (
    carry_nodes,
    geman_mcclure,
    move_by_screw,
    pull_nodes,
    skin_weights,
    spread_nodes,
    stiffness,
    stretch,
)
from forewarp.ops.splat import average_splat, with_copies
from tests.support.gaussians import SIZE, crowd, pinhole

GPU = "cuda"
SHAPE = (3, 4, 5)
LENS = (0.1, -0.02, 0.003), (0.01, -0.02)
pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")


def numbers(*shape, seed=0, low=-1.0, high=1.0):
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)


def lattice():
    present = torch.arange(60) % 3 != 0
    index = torch.where(present, present.cumsum(0) - 1, -1).to(torch.int32).reshape(SHAPE)
    return numbers(int(present.sum()), 2), index


def points(count=40):
    return numbers(count, 3, seed=1, low=0.1, high=0.9) * (torch.tensor(SHAPE) - 1)


def ids():
    return torch.arange(30).div(3, rounding_mode="floor")


def links():
    return torch.randint(0, 6, (6, 3), generator=torch.Generator().manual_seed(2))


def splatted(source, positions, still, cells):
    splat = with_copies(average_splat(source, positions, SHAPE), still, cells)
    rows = splat.index[cells.unbind(-1)].long()  # rows have another order on each device
    return splat.values[rows], splat.coverage[rows], splat.index >= 0


def marched(origins, directions, jitter):
    _, index = lattice()
    cells = occupied_cells(index).to(origins.device)
    return march(origins, directions, 0.0, 6.0, 0.17, cells, jitter)


def stepped(value, gradient, steps):
    state = AdamState(value.clone(), gradient, 0 * value, 0 * value, steps.clone(), 0.1)
    adam_rows([state], (0.9, 0.99), 1e-15)
    return state[:1] + state[2:5]


def compared(*tensors):
    *tensors, tints, fades, pixels, behind = tensors
    found = compare(
        Gaussians(*tensors[:5]), Warp(*tensors[5:]), pinhole(), tints, fades, pixels, behind, by_skin=True
    )
    losses = found.maps.new_tensor([found.loss, found.squared])
    return losses, *found.particles, found.maps, found.skin, found.order


def drawn(*tensors):
    *tensors, tints, fades = tensors
    splats = project(Gaussians(*tensors[:5]), Warp(*tensors[5:]), pinhole(), tints, fades)
    return splats.values, *rasterize(Splats(splats.values, splats.reach), *SIZE)


def of_crowd():
    particles, warp, tints, fades = crowd()
    return *particles, *warp, tints, fades


def of_image():
    generator = torch.Generator().manual_seed(3)
    pixels = torch.randint(0, 256, (SIZE[0] * SIZE[1], 4), generator=generator, dtype=torch.uint8)
    return *of_crowd(), pixels, numbers(3)


CELLS = torch.tensor([[0, 1, 1], [2, 3, 4], [1, 1, 1]])


def of_nodes(*names):
    """Nodes: their motion, places, neighbours and weights, curves, and gradients."""
    rotations, maps, bend = numbers(6, 4, 3, seed=1), numbers(6, 12, seed=4), numbers(4, seed=1)
    parts = {"motion": numbers(6, 6), "places": numbers(6, 3, seed=1), "edges": links(), "basis": numbers(4)}
    parts |= {"weights": numbers(6, 3, seed=2, low=0.0), "shift": numbers(6, 4, 3), "rotation": rotations}
    parts |= {"by_maps": maps, "by_motion": numbers(6, 6), "bend": bend}
    return lambda: tuple(parts[name] for name in names)


OPERATORS: dict[str, tuple[Callable, Callable[[], tuple]]] = {
    "trilinear": (
        lambda values, index, where: trilinear(values, index, where, values.new_tensor([-7.0, 0.5])),
        lambda: (*lattice(), points()),
    ),
    "splat": (splatted, lambda: (numbers(40, 2), points() - 0.3, numbers(3, 2, seed=5), CELLS)),
    "total_variation": (lambda values, index: total_variation(values, neighbour_pairs(index)), lattice),
    "second_variation": (second_variation, lambda: (numbers(3, 4, 5, 2),)),
    "huber_variation": (huber_variation, lambda: (3 * numbers(3, 4, 5, 2),)),
    "patch_variation": (patch_variation, lambda: (numbers(4, 5, 5), numbers(4, 5, 5, seed=1, low=0.0))),
    "dilate": (lambda index: dilate(index >= 0, 2), lambda: lattice()[1:]),
    "march": (marched, lambda: (points() - 1.5, numbers(40, 3, seed=2), numbers(40, seed=3, low=0.0))),
    "clip_to_box": (
        lambda o, d: clip_to_box(o, d, 0.1, 9.0, o.new_zeros(3), o.new_tensor([1.0, 2.0, 3.0])),
        lambda: (2 * numbers(20, 3), numbers(20, 3, seed=1)),
    ),
    "stratified": (
        lambda near, far: stratified(near, far, 7, torch.Generator().manual_seed(0)),
        lambda: (numbers(5, low=0.0), numbers(5, low=2.0, high=3.0)),
    ),
    "by_importance": (
        lambda edges, w: by_importance(edges.sort(1).values, w, 9, torch.Generator().manual_seed(0)),
        lambda: (numbers(5, 8), numbers(5, 7, low=0.0)),
    ),
    "render_weights": (lambda x, ray: render_weights(x, ray, 12), lambda: (numbers(30, low=0.0), ids())),
    "accumulate": (lambda *of: accumulate(*of, 12), lambda: (numbers(30), numbers(30, 4, seed=1), ids())),
    "dense_weights": (dense_weights, lambda: (numbers(6, 8, low=0.0),)),
    "dct_basis": (lambda t: dct_basis(t, 6, frames=12, canonical_time=0.2), lambda: (numbers(7, low=0.0),)),
    "spline_basis": (lambda t: spline_basis(t, 6), lambda: (numbers(7, low=0.0),)),
    "positional_encoding": (lambda x: positional_encoding(x, 4), lambda: (numbers(9, 3),)),
    "spherical_harmonics_1": (spherical_harmonics_1, lambda: (numbers(9, 3),)),
    "distort": (lambda x: distort(x, *LENS), lambda: (0.4 * numbers(9, 2),)),
    "undistort": (lambda x: undistort(x, *LENS), lambda: (0.4 * numbers(9, 2),)),
    "carry_nodes": (carry_nodes, of_nodes("shift", "rotation", "basis", "places")),
    "stiffness": (stiffness, of_nodes("motion", "places", "edges", "weights")),
    "pull_nodes": (
        lambda *tensors: pull_nodes(*tensors, 0.7)[0],
        of_nodes("motion", "places", "by_maps", "edges", "weights"),
    ),
    "spread_nodes": (
        lambda *tensors: spread_nodes(*(x.detach() for x in tensors), 0.3, 2.0)[:2],
        of_nodes("shift", "rotation", "by_motion", "basis", "bend"),
    ),
    "skin_weights": (skin_weights, lambda: (numbers(9, 4, low=0.0), numbers(9, 4))),
    "move_by_screw": (move_by_screw, lambda: (numbers(9, 3), numbers(9, 3, seed=1), numbers(9, 3, seed=2))),
    "stretch": (stretch, lambda: (numbers(9, 3, 3),)),
    "geman_mcclure": (lambda x: geman_mcclure(x, 0.3), lambda: (numbers(9, low=0.0),)),
    "adam_rows": (stepped, lambda: (numbers(9, 4), numbers(9, 4, seed=1), torch.arange(9.0))),
    "project and rasterize": (drawn, of_crowd),
    "compare": (compared, of_image),
}


def found(operator, inputs, device):
    """Return an operator's results on a device, and gradients of their weighted sum, on the CPU."""
    leaves = [x.to(device) for x in inputs]
    leaves = [x.requires_grad_() if x.is_floating_point() else x for x in leaves]
    results = operator(*leaves)
    results = results if isinstance(results, tuple | list) else (results,)
    assert {x.device.type for x in results if x.dim()} <= {torch.device(device).type}
    learned = [x for x in results if x.requires_grad]
    gradients = []
    if learned:
        loss = sum((x * numbers(*x.shape, seed=9).to(x)).sum() for x in learned)
        asked = [x for x in leaves if x.requires_grad]
        gradients = torch.autograd.grad(loss, asked, allow_unused=True)
    return [None if x is None else x.detach().cpu() for x in (*results, *gradients)]


@pytest.mark.parametrize("name", OPERATORS)
def test_a_gpu_gives_what_the_cpu_gives(name):
    operator, inputs = OPERATORS[name]
    ours, theirs = (found(operator, inputs(), device) for device in ("cpu", GPU))
    for here, there in zip(ours, theirs, strict=True):
        torch.testing.assert_close(there, here, rtol=1e-8, atol=1e-9)
