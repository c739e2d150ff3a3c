"""What others ask of particles: where matter is, how far it reaches, and where points go."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from forewarp.methods.method import Method
from forewarp.methods.particles.nodes import nearest
from forewarp.ops.gaussians import FLAT, Warp, moved, rotations
from forewarp.scene.box import Box
from forewarp.scene.cloud import Cloud, Ellipsoids

_SOLID, _SEEN = 0.1, 0.02  # opacity from which matter bounds the scene; from which there is any
_BESIDE = 4  # particles that a point goes with
_COLLAPSED = 0.05  # of the longest axis: what a blend of maps has pressed flatter is not stretched again


@torch.no_grad()
def matter_of(method: Method) -> Cloud:
    """See ``HasMatter``: the particles of which there is anything to see, at the canonical time."""
    keep = _seen(method)
    points = moved(method.means.data, method.warp(method.canonical_time))[0]
    colors = (0.5 + FLAT * method.color.data[keep, 0]).clamp(0, 1)
    size = 2 * float(method.log_scales.exp().mean())
    return Cloud(points[keep], colors, torch.sigmoid(method.opacity.data[keep, 0]), max(size, 1e-9))


@torch.no_grad()
def ellipsoids_of(method: Method, time: float) -> Ellipsoids:
    """See ``HasEllipsoids``: all particles, also those at rest and those that have faded."""
    template = template_of(method)
    centers, linear = moved(template.centers, method.warp(time))
    tints, fades = method.over_time(time)
    harmonics, opacity = template.harmonics, method.opacity[:, 0]
    if method.tint is not None:
        harmonics = harmonics.clone()
        harmonics[:, 0] += torch.einsum("t,ntc->nc", tints, method.tint) / FLAT
    if method.fade is not None:
        opacity = opacity + method.fade @ fades[1:]
    return Ellipsoids(centers, linear @ template.roots, torch.sigmoid(opacity), harmonics)


@torch.no_grad()
def template_of(method: Method) -> Ellipsoids:
    """See ``HasEllipsoids``: what nodes move, at the canonical time a little, too."""
    roots = rotations(method.turns) * method.log_scales.exp()[:, None]
    harmonics = method.color if method.shade is None else torch.cat([method.color, method.shade], 1)
    return Ellipsoids(method.means.data, roots, torch.sigmoid(method.opacity[:, 0]), harmonics.data)


@torch.no_grad()
def movement_of(method: Method, times: Sequence[float]) -> dict[str, Tensor]:
    """See ``HasEllipsoids``. A center goes to ``x + sum_l w_l (D x + d)``, a root to ``(I + sum_l w_l D)
    root``, where l are the nodes in ``links`` (N, L), w ``weights`` (N, L) and ``D | d`` the nodes' ``maps``
    (T, M, 3, 4). ``color_over_time`` (N, K, 3), by ``color_basis`` (T, K), is added to the colour, and
    ``opacity_over_time`` (N, F), by ``opacity_basis`` (T, F), to the opacity's logit. The maps come of
    ``node_shift`` and ``node_turn`` (M, B, 3), by ``node_basis`` (T, B), about ``node_places`` (M, 3).
    What is off is absent.
    """
    found = {}
    if method.nodes is not None:
        warps = [method.warp(time) for time in times]
        maps = [torch.cat([w.maps[:, :9].reshape(-1, 3, 3), w.maps[:, 9:, None]], -1) for w in warps]
        nodes, basis = method.nodes, [method.nodes.basis(time) for time in times]
        found = {"links": warps[0].links, "weights": warps[0].weights, "maps": torch.stack(maps)}
        found |= {"node_places": nodes.places, "node_basis": torch.stack(basis), "node_shift": nodes.shift}
        found |= {} if nodes.turn is None else {"node_turn": nodes.turn}
    for name, over_time, basis in (
        ("color", method.tint, method.tints),
        ("opacity", method.fade, method.fades),
    ):
        if over_time is not None:
            found[f"{name}_over_time"] = over_time
            found[f"{name}_basis"] = over_time.new_tensor([basis(time) for time in times])
    return {name: value.detach() for name, value in found.items()}


@torch.no_grad()
def bounds_of(method: Method, times: list[float]) -> Box | None:
    """See ``HasBounds``."""
    solid = torch.sigmoid(method.most_opaque()) > _SOLID
    if not bool(solid.any()):
        return None
    points = torch.cat([moved(method.means.data, method.warp(time))[0][solid] for time in times])
    pad = 2 * float(method.log_scales[solid].exp().median()) + 1e-3 * float(method.extent)
    low, high = points.amin(0) - pad, points.amax(0) + pad
    return Box(tuple(low.tolist()), tuple(high.tolist()))


@torch.no_grad()
def paths_of(method: Method, points: Tensor, times: Tensor) -> Tensor:
    """Where points (P, 3) of the canonical time are at times (T,): (P, T, 3).

    A particle takes a point from where it was beside it then, ``F_t F_c^-1 (y - x_c) + x_t``; those that were
    nearest then are blended by ``1 / d^2``. At the canonical time that is y itself, unless a blend has
    pressed a particle flat.

    Cost: a search among the particles, and all of them moved once for each time.
    """
    if method.nodes is None:
        return points[:, None].expand(-1, len(times), -1).clone()
    keep, skin = _seen(method), method.skin
    means, links, weights = method.means.data[keep], skin.links[keep], skin.weights()[keep]

    def at(time: float) -> tuple[Tensor, Tensor]:
        return moved(means, Warp(method.nodes.maps(time), links, weights))

    then, turned = at(method.canonical_time)
    points = points.to(then)
    away, rows = nearest(points, then, _BESIDE)
    shares = 1 / (away + 1e-6 * away.mean() + 1e-30)
    shares = (shares / shares.sum(-1, keepdim=True))[..., None]
    back = torch.linalg.pinv(turned, rtol=_COLLAPSED)
    local = (back[rows] @ (points[:, None] - then[rows])[..., None])[..., 0]
    found = []
    for time in times.tolist():
        now, turn = at(time)
        found.append((shares * ((turn[rows] @ local[..., None])[..., 0] + now[rows])).sum(1))
    return torch.stack(found, 1) if found else points.new_zeros(len(points), 0, 3)


def _seen(method: Method) -> Tensor:
    """Which particles (N,) there is anything to see of; all, if there is of none."""
    seen = torch.sigmoid(method.opacity.data[:, 0]) > _SEEN
    return seen if bool(seen.any()) else torch.ones_like(seen)
