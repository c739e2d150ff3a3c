"""Compare every operator in float32 with float64 on hard inputs: how many digits are left."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from forewarp.fields.grids import Activation
from forewarp.ops.backend import numba_installed
from forewarp.ops.curves import dct_basis
from forewarp.ops.encode import positional_encoding
from forewarp.ops.grid import neighbour_pairs, patch_variation, total_variation, trilinear
from forewarp.ops.march import accumulate, march, render_weights
from forewarp.ops.splat import average_splat

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
        yield (
            "Activation.alpha",
            f"raw density {name}",
            lambda r: Activation(-4.6, 0.03).alpha(r, 0.03),
            inputs,
        )
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
    yield (
        "average_splat",
        "threefold expansion",
        splat((27, 24, 21)),
        [source, 3.07 * lattice.float().double()],
    )
    for sliver in (1e-2, 1e-6):
        at = (lattice + torch.tensor([1 - sliver, 0.5, 0.25])).float().double()
        yield "average_splat", f"coverage {sliver:g}", splat(SHAPE), [source, at]
    inputs = [uniform(6, 100_000, 3, low=-5, high=5), uniform(7, 100_000, 3, low=3.1, high=3.9)]
    yield "average_splat", "1e5 voxels in one cell", splat(SHAPE), inputs
    inputs = [uniform(6, 500, 3, low=-5, high=5), uniform(8, 500, 3, low=250, high=255)]
    yield "average_splat", "far end of 256 voxels", splat((256, 256, 256)), inputs


def lattice_cases() -> Iterator[Case]:
    """Yield cases of trilinear reads, variation and marching."""
    for name, shape, low, high in (
        ("random places", SHAPE, 0.0, 6.0),
        ("far end of 256 voxels", (256, 256, 256), 250.0, 255.0),
        ("outside the box", SHAPE, 1e3, 1e6),
    ):
        index = torch.full(shape, -1, dtype=torch.int32)
        index[-6:, -6:, -6:] = torch.arange(216, dtype=torch.int32).reshape(6, 6, 6)
        inputs = [uniform(9, 216, 4, low=-5, high=5), uniform(10, 500, 3, low=low, high=high)]
        yield "trilinear", name, lambda v, p, i=index: trilinear(v, i, p, v.new_full((4,), -1.0)), inputs
    pairs = neighbour_pairs(torch.arange(504, dtype=torch.int32).reshape(SHAPE))
    for name, values in (
        ("noise of 1e-6 on 10", 10 + 1e-6 * uniform(11, 504, 1)),
        ("1e4", 1e4 * uniform(11, 504, 1)),
    ):
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
    for name, times in (
        ("all times", uniform(16, 200)),
        ("1e-6 beside the canonical", 0.5 + 1e-6 * uniform(17, 200)),
    ):
        inputs = [times.float().double()]
        yield "dct_basis", f"49 cosines, {name}", lambda t: dct_basis(t, 49, 50, 0.5, 0.2), inputs
    inputs = [uniform(18, 200, 3, low=-1, high=1)]
    yield "positional_encoding", "5 octaves", lambda x: positional_encoding(x, 5), inputs
    yield "positional_encoding", "10 octaves", lambda x: positional_encoding(x, 10), inputs


def answers(
    operator: Callable, inputs: list[Tensor], dtype: torch.dtype
) -> tuple[list[Tensor], list[Tensor]]:
    """Return outputs, and gradients of a fixed random weighting of them, both as float64."""
    leaves = [x.to(dtype).requires_grad_() for x in inputs]
    out = operator(*leaves)
    outputs = [o for o in (out if isinstance(out, tuple) else (out,))]
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


CASES = (compositing_cases, splat_cases, lattice_cases, encoding_cases)


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
