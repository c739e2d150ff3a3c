"""Particles and nodes under bad conditions, for the tests of their operators and the table of digits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from forewarp.ops.curves import spline_basis
from forewarp.ops.gaussians import Compared, Gaussians, Pinhole, Warp, compare, project, rasterize
from forewarp.ops.nodes import node_maps, pull_nodes, spread_nodes, stiffness
from tests.stability.twin import Case, uniform
from tests.support.gaussians import SIZE, crowd, pinhole, still

PLACE = (0.1, -0.2, -4.0)  # of the camera of ``pinhole``
BEHIND = torch.tensor([0.2, 0.5, 0.9])


class Hard(NamedTuple):
    """Particles before a camera, float64 numbers that float32 represents exactly."""

    particles: Gaussians
    warp: Warp
    camera: Pinhole
    tints: Tensor
    fades: Tensor


def changed(camera: Pinhole | None = None, moving: bool = True, **changes) -> Hard:
    """Random particles; of each part that is named the old numbers are replaced by ``change(old)``."""
    particles, warp, tints, fades = crowd(dtype=torch.float32)
    particles = particles._replace(**{n: change(getattr(particles, n)) for n, change in changes.items()})
    warp = warp if moving else still(particles)
    return Hard(*_as((particles, warp), torch.float64), camera or pinhole(), tints.double(), fades.double())


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


def compared(hard: Hard, kind: torch.dtype, place: torch.device | str = "cpu") -> Compared:
    """``compare`` with a random picture, in a precision."""
    particles, warp = _as(hard[:2], kind, place)
    tints, fades, behind = (t.to(place, kind) for t in (*hard[3:], BEHIND))
    truth = pixels(hard.camera.size).to(place)
    return compare(particles, warp, hard.camera, tints, fades, truth, behind, by_skin=True)


def drawn(hard: Hard) -> tuple:
    """The function of a case that draws its planes (5, H, W), and the leaves by which they have gradients."""

    def planes(*leaves: Tensor) -> Tensor:
        warp = Warp(leaves[5], hard.warp.links.to(leaves[5].device), leaves[6])
        over_time = (t.to(leaves[0]) for t in hard[3:])
        splats = project(Gaussians(*leaves[:5]), warp, hard.camera, *over_time)
        picture = rasterize(splats, *hard.camera.size)
        return torch.cat([picture.color, picture.depth[None], picture.transmittance[None]])

    return planes, [*hard.particles, hard.warp.maps, hard.warp.weights]


def cases() -> Iterator[Case]:
    """Yield the cases of particles in the table of digits."""
    for name, hard in SEEN.items():
        yield "project, rasterize", name, *drawn(hard)
    yield from node_cases()


def node_cases() -> Iterator[Case]:
    """Yield cases of nodes and curves."""
    places, edges = uniform(20, 30, 3, low=-1), torch.randint(0, 30, (30, 6), generator=_drawer(0))
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


def _drawer(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)
