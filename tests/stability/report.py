"""Hard cases of every operator, in float32 against float64: how many digits are left.

``python -m tests.stability.report`` writes them as the table of docs/results/digits.md.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from forewarp.cli.entry import quiet
from forewarp.fields.grids import Activation
from forewarp.ops.backend import numba_installed
from forewarp.ops.curves import dct_basis, spline_basis
from forewarp.ops.encode import positional_encoding
from forewarp.ops.gaussians import Gaussians, ImageLoss, Pinhole, Warp, compare, project, rasterize
from forewarp.ops.grid import neighbour_pairs, patch_variation, total_variation, trilinear
from forewarp.ops.march import accumulate, march, render_weights
from forewarp.ops.nodes import node_maps, pull_nodes, spread_nodes, stiffness
from forewarp.ops.splat import average_splat
from forewarp.runs.config_files import project_root
from tests.support.gaussians import SIZE, crowd, pinhole, still

Case = tuple[str, str, Callable[..., Tensor | tuple[Tensor, ...]], list[Tensor]]
BACKENDS = ("reference", "Numba")
SHAPE = (9, 8, 7)


@contextmanager
def implementation(name: str) -> Iterator[None]:
    """Use the operators' ``reference`` or ``Numba`` implementation inside."""
    before = os.environ.get("FOREWARP_NUMBA")
    os.environ["FOREWARP_NUMBA"] = "1" if name == "Numba" else "0"
    numba_installed.cache_clear()
    try:
        yield
    finally:
        os.environ.pop("FOREWARP_NUMBA")
        if before is not None:
            os.environ["FOREWARP_NUMBA"] = before
        numba_installed.cache_clear()


def uniform(seed: int, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
    """Draw float64 numbers that float32 represents exactly."""
    generator = torch.Generator().manual_seed(seed)
    return (low + (high - low) * torch.rand(shape, generator=generator)).double()


def compositing_cases() -> Iterator[Case]:
    """Yield cases from density to picture."""
    for name, raw in (("-60", -60.0), ("-10: empty space", -10.0), ("0", 0.0), ("30", 30.0), ("1e30", 1e30)):
        inputs = [raw + uniform(0, 50)]
        opacity = lambda r: Activation(-4.6, 0.03).alpha(r, 0.03)  # noqa: E731
        yield "Activation.alpha", f"raw density {name}", opacity, inputs
    ids = torch.arange(64).repeat_interleave(50)
    for name, power in (("1e-12", -12), ("1e-3", -3), ("1", 0), ("1e4", 4), ("1e30", 30)):
        inputs = [uniform(1, 3200) * 10.0**power]
        yield "render_weights", f"optical depth {name}", lambda x: render_weights(x, ids, 64), inputs
    many = torch.arange(10_000).repeat_interleave(50)
    inputs = [uniform(2, 500_000) * 0.1]
    yield "render_weights", "half a million samples", lambda x: render_weights(x, many, 10_000), inputs
    one = torch.zeros(100_000, dtype=torch.int64)
    inputs = [uniform(3, 100_000) * 1e-5, uniform(4, 100_000, 1)]
    yield "accumulate", "1e5 samples on one ray", lambda w, v: accumulate(w, v, one, 1), inputs
    inputs = [uniform(3, 3200) * 1e-20, uniform(4, 3200, 3)]
    yield "accumulate", "weights of 1e-20", lambda w, v: accumulate(w, v, ids, 64), inputs


def splat_cases() -> Iterator[Case]:
    """Yield cases of the averaging splat."""

    def splat(shape: tuple[int, int, int]) -> Callable[..., tuple[Tensor, ...]]:
        return lambda source, positions: average_splat(source, positions, shape)[:2]

    lattice = torch.cartesian_prod(*(torch.arange(float(n)) for n in SHAPE)).double()
    source = uniform(5, len(lattice), 3, low=-5, high=5)
    yield "average_splat", "zero flow", splat(SHAPE), [source, lattice]
    apart = 3.07 * lattice.float().double()
    yield "average_splat", "threefold expansion", splat((27, 24, 21)), [source, apart]
    for sliver in (1e-2, 1e-6):
        at = (lattice + torch.tensor([1 - sliver, 0.5, 0.25])).float().double()
        yield "average_splat", f"coverage {sliver:g}", splat(SHAPE), [source, at]
    inputs = [uniform(6, 100_000, 3, low=-5, high=5), uniform(7, 100_000, 3, low=3.1, high=3.9)]
    yield "average_splat", "1e5 voxels in one cell", splat(SHAPE), inputs
    inputs = [uniform(6, 500, 3, low=-5, high=5), uniform(8, 500, 3, low=250, high=255)]
    yield "average_splat", "far end of 256 voxels", splat((256, 256, 256)), inputs


def lattice_cases() -> Iterator[Case]:
    """Yield cases of trilinear reads, variation and marching."""
    far = "far end of 256 voxels", (256, 256, 256), 250.0, 255.0
    places = ("random places", SHAPE, 0.0, 6.0), far, ("outside the box", SHAPE, 1e3, 1e6)
    for name, shape, low, high in places:
        index = torch.full(shape, -1, dtype=torch.int32)
        index[-6:, -6:, -6:] = torch.arange(216, dtype=torch.int32).reshape(6, 6, 6)
        inputs = [uniform(9, 216, 4, low=-5, high=5), uniform(10, 500, 3, low=low, high=high)]
        yield "trilinear", name, lambda v, p, i=index: trilinear(v, i, p, v.new_full((4,), -1.0)), inputs
    pairs = neighbour_pairs(torch.arange(504, dtype=torch.int32).reshape(SHAPE))
    noise = uniform(11, 504, 1)
    for name, values in (("noise of 1e-6 on 10", 10 + 1e-6 * noise), ("1e4", 1e4 * noise)):
        yield "total_variation", name, lambda v: total_variation(v, pairs), [values.float().double()]
    depth = (0.5 + 1e-4 * uniform(12, 16, 8, 8)).float().double()
    opacity = uniform(13, 16, 8, 8)
    yield "patch_variation", "depths alike to 1e-4", lambda d: patch_variation(d, opacity.to(d)), [depth]
    cells = torch.ones([n - 1 for n in SHAPE], dtype=torch.bool)
    for name, step in (("steps of half a voxel", 0.5), ("steps of 1e-3 voxels", 1e-3)):

        def length(origins: Tensor, directions: Tensor, step: float = step) -> Tensor:
            jitter = origins.new_full((len(origins),), 0.5)
            ids, _ = march(origins, directions, 0.0, 60.0, step, cells, jitter)
            return step * torch.bincount(ids, minlength=len(origins)).to(origins)

        inputs = [uniform(14, 100, 3, low=-20, high=-10), uniform(15, 100, 3, low=0.5, high=1.0)]
        yield "march", f"{name}: length met", length, inputs


def encoding_cases() -> Iterator[Case]:
    """Yield cases of encoded times and positions."""
    beside = 0.5 + 1e-6 * uniform(17, 200)
    for name, times in (("all times", uniform(16, 200)), ("1e-6 beside the canonical", beside)):
        inputs = [times.float().double()]
        yield "dct_basis", f"49 cosines, {name}", lambda t: dct_basis(t, 49, 50, 0.5, 0.2), inputs
    inputs = [uniform(18, 200, 3, low=-1, high=1)]
    yield "positional_encoding", "5 octaves", lambda x: positional_encoding(x, 5), inputs
    yield "positional_encoding", "10 octaves", lambda x: positional_encoding(x, 10), inputs


PLACE = (0.1, -0.2, -4.0)  # of the camera of ``pinhole``
BEHIND = torch.tensor([0.2, 0.5, 0.9])


class Hard(NamedTuple):
    """Particles before a camera, float64 numbers that float32 represents exactly."""

    particles: Gaussians
    warp: Warp
    camera: Pinhole
    color_basis: Tensor
    opacity_basis: Tensor


def changed(camera: Pinhole | None = None, moving: bool = True, **changes) -> Hard:
    """Random particles; of each part that is named the old numbers are replaced by ``change(old)``."""
    particles, warp, *bases = crowd(dtype=torch.float32)
    particles = particles._replace(**{n: change(getattr(particles, n)) for n, change in changes.items()})
    warp = warp if moving else still(particles)
    bases = [basis.double() for basis in bases]
    return Hard(*_as((particles, warp), torch.float64), camera or pinhole(), *bases)


def _as(groups: tuple, kind: torch.dtype, place: torch.device | str = "cpu") -> list:
    moved = lambda t: t.to(place, kind) if t.is_floating_point() else t.to(place)  # noqa: E731
    return [type(group)(*map(moved, group)) for group in groups]


def plus(*numbers: float):
    """Add to a part."""
    return lambda old: old + torch.tensor(numbers)


def only(*numbers: float):
    """Replace a part."""
    return lambda old: torch.tensor(numbers).expand_as(old).contiguous()


def times(*numbers: float):
    """Multiply a part."""
    return lambda old: old * torch.tensor(numbers)


def lying(at: str) -> Hard:
    """Particles about the camera, or all at one point of it."""
    return changed(moving=False, means=plus(*PLACE) if at == "around" else only(*PLACE))


# What is drawn; of the last ones nothing at all.
SEEN = {
    "as they are": changed(),
    "a camera among them": lying("around"),
    "scales of e^-30": changed(log_scales=plus(-30.0)),
    "flat to a point": changed(log_scales=only(-math.inf)),
    "as large as the scene": changed(log_scales=plus(1.5)),
    "larger than all": changed(log_scales=plus(6.0)),
    "needles, 1 to 60,000": changed(log_scales=only(-1.0, -12.0, -12.0)),
    "discs, 1 to 60,000": changed(log_scales=only(-1.0, -1.0, -12.0)),
    "discs of no thickness": changed(log_scales=only(-1.0, -1.0, -math.inf)),
    "opacity 1": changed(opacity=only(1e4, 0.0)),
    "opacity just seen": changed(opacity=only(-5.4, 0.0)),
    "quaternions of length 0": changed(quaternions=only(0.0)),
    "quaternions of length 1e-11": changed(quaternions=times(1e-11)),
    "quaternions of length 1e18": changed(quaternions=times(1e18)),
    "equal depths": changed(moving=False, means=times(1.0, 1.0, 0.0)),
    "all at one point": changed(moving=False, means=only(0.0)),
    "a million times as far": changed(means=plus(0.0, 0.0, 1e6)),
    "colours of 1e6": changed(colors=times(1e6)),
}
UNSEEN = {
    "none at all": Hard(*(lambda c: (c[0], c[1], pinhole(), *c[2:]))(crowd(count=0))),
    "all at the camera": lying("at"),
    "all behind it": changed(means=plus(0.0, 0.0, -9.0)),
    "all outside": changed(means=plus(90.0, 0.0, 0.0)),
    "opacity 0": changed(opacity=only(-1e4, 0.0)),
    "scales of e^40": changed(log_scales=only(40.0)),
    "infinite scales": changed(log_scales=only(math.inf)),
}


def pixels(size: tuple[int, int] = SIZE, seed: int = 0) -> Tensor:
    """A random picture (H W, 4) uint8."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (size[0] * size[1], 4), generator=generator).to(torch.uint8)


def compared(hard: Hard, kind: torch.dtype, place: torch.device | str = "cpu") -> ImageLoss:
    """``compare`` with a random picture, in a precision."""
    particles, warp = _as(hard[:2], kind, place)
    *bases, behind = (t.to(place, kind) for t in (*hard[3:], BEHIND))
    truth = pixels(hard.camera.size).to(place)
    return compare(particles, warp, hard.camera, *bases, truth, behind, by_skin=True)


def drawn(hard: Hard) -> tuple:
    """The function of a case that draws its planes (5, H, W), and the leaves by which they have gradients."""

    def planes(*leaves: Tensor) -> Tensor:
        warp = Warp(leaves[5], hard.warp.links.to(leaves[5].device), leaves[6])
        over_time = (t.to(leaves[0]) for t in hard[3:])
        splats = project(Gaussians(*leaves[:5]), warp, hard.camera, *over_time)
        picture = rasterize(splats, *hard.camera.size)
        return torch.cat([picture.color, picture.depth[None], picture.transmittance[None]])

    return planes, [*hard.particles, hard.warp.maps, hard.warp.weights]


def particle_cases() -> Iterator[Case]:
    """Yield the cases of particles in the table of digits."""
    for name, hard in SEEN.items():
        yield "project, rasterize", name, *drawn(hard)


def node_cases() -> Iterator[Case]:
    """Yield cases of nodes and curves."""
    places, draw = uniform(20, 30, 3, low=-1), torch.Generator().manual_seed(0)
    edges = torch.randint(0, 30, (30, 6), generator=draw)
    shares, motion = uniform(21, 30, 6), uniform(22, 30, 6, low=-1)
    for name, own, at in (
        ("a world of 1", motion, places),
        ("turns of 1e-6", motion * 1e-6, places),
        ("turns of nearly half a circle", motion * 1e3, places),
        ("all at one point", motion, 0 * places),
        ("a hundred worlds beside the origin", motion, places + 100),
    ):
        own, at = own.float().double(), at.float().double()
        yield "node_maps", name, lambda m, p=at: node_maps(m, p.to(m)), [own]
        yield "stiffness", name, lambda m, p=at: stiffness(m, p.to(m), edges, shares.to(m)), [own]
        pulled = lambda m, p=at: pull_nodes(m, p.to(m), m.repeat(1, 2), edges, shares.to(m), 0.7)[0]  # noqa: E731
        yield "pull_nodes", name, lambda m, f=pulled: f(m.detach()), [own]
    shift, bend = uniform(23, 30, 9, 3, low=-1), spline_basis(0.4, 9).double()
    for name, unit in (("a world of 1", 1.0), ("a world of 1e-3", 1e-3), ("a world of 1e3", 1e3)):
        both = lambda s, u=unit: spread_nodes(  # noqa: E731
            s.detach(), None, s.detach()[:, 0].repeat(1, 2), bend.to(s), bend.to(s), 3.0, u
        )
        yield "spread_nodes", name, lambda s, f=both: f(s)[0], [(unit * shift).float().double()]
    yield "spline_basis", "41 times", lambda t: spline_basis(t.detach(), 22), [uniform(24, 41)]


def answers(operator: Callable, inputs: list[Tensor], dtype: torch.dtype) -> tuple[list[Tensor], ...]:
    """Return outputs, and gradients of a fixed random weighting of them, both as float64."""
    leaves = [x.to(dtype).requires_grad_() for x in inputs]
    out = operator(*leaves)
    outputs = out if isinstance(out, tuple) else (out,)
    pulled = sum((o * uniform(i, *o.shape, low=-1).to(dtype)).sum() for i, o in enumerate(outputs))
    gradients = []
    if pulled.requires_grad:
        found = torch.autograd.grad(pulled, leaves, allow_unused=True)
        gradients = [g.double() for g in found if g is not None]
    return [o.detach().double() for o in outputs], gradients


def relative_error(ours: list[Tensor], exact: list[Tensor]) -> float | None:
    """Return the largest error divided by the largest entry, over all tensors; None without tensors.

    NaN where anything is not finite or shapes differ.
    """
    worst = None
    for a, b in zip(ours, exact, strict=True):
        if a.shape != b.shape or not (a.isfinite().all() and b.isfinite().all()):
            return float("nan")
        scale = float(b.abs().amax()) if b.numel() else 0.0
        error = float((a - b).abs().amax()) if b.numel() else 0.0
        worst = max(worst or 0.0, error / scale if scale else error)
    return worst


CASES = (compositing_cases, splat_cases, lattice_cases, encoding_cases, particle_cases, node_cases)


def rows(groups: Iterable[Callable[[], Iterator[Case]]]) -> Iterator[dict[str, float | str | None]]:
    """Yield a row for each case: operator, input, errors of values and gradients by implementation."""
    for cases in groups:
        for operator, name, function, inputs in cases():
            with implementation("reference"):
                exact = answers(function, inputs, torch.float64)
            row: dict[str, float | str | None] = {"operator": operator, "input": name}
            for backend in BACKENDS:
                with implementation(backend):
                    ours = answers(function, inputs, torch.float32)
                row[f"values, {backend}"] = relative_error(ours[0], exact[0])
                row[f"gradients, {backend}"] = relative_error(ours[1], exact[1])
            yield row


COLUMNS = [f"{what}, {backend}" for backend in BACKENDS for what in ("values", "gradients")]


def error_text(error: float | None) -> str:
    """Format an error with one digit.

    >>> error_text(3.14e-7), error_text(0.0), error_text(None), error_text(float("nan"))
    ('3e-07', '0', '', 'not finite')
    """
    if error is None:
        return ""
    return "not finite" if math.isnan(error) else "0" if error == 0 else f"{error:.0e}"


def table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Make a Markdown table."""
    rule = ["---"] * len(header)
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, rule, *lines))


def operator_table() -> str:
    """Measure every operator's errors, and print each."""
    lines = []
    for row in rows(CASES):
        lines.append([row["operator"], row["input"], *(error_text(row[c]) for c in COLUMNS)])
        print("  ".join(lines[-1]), flush=True)
    return table(["operator", "input", *COLUMNS], lines)


def replace_section(path: Path, name: str, text: str) -> None:
    """Replace what is between ``<!-- name -->`` and ``<!-- end of name -->`` in a file by ``text``.

    Raises:
        ValueError: where the marks are missing.
    """
    before = path.read_text()
    marks = re.compile(f"(<!-- {name} -->\n).*?(<!-- end of {name} -->)", re.DOTALL)
    if not marks.search(before):
        raise ValueError(f"{path}: expected the marks of '{name}', but got none; put them back")
    path.write_text(marks.sub(lambda found: f"{found[1]}\n{text}\n\n{found[2]}", before))


def main() -> None:
    """Measure, and write the table."""
    quiet()
    document = project_root() / "docs" / "results" / "digits.md"
    replace_section(document, "operators", operator_table())
    print(document)


if __name__ == "__main__":
    main()
