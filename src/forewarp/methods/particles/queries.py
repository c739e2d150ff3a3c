"""Scene queries: point cloud, bounds, trajectories, ellipsoids, layers.

These functions are methods of ``Particles``; see ``methods.method``.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from forewarp.fields.moving import MovingGaussians, NodeMotion
from forewarp.methods.particles.density import most_opaque
from forewarp.methods.particles.nodes import nearest
from forewarp.methods.rows import keep_rows
from forewarp.ops.gaussians import FLAT, Warp, moved, rotations
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.cloud import Cloud, Ellipsoids
from forewarp.scene.frame import Frame, spread

if TYPE_CHECKING:
    from forewarp.methods.particles.model import Particles

_SOLID, _VISIBLE = 0.1, 0.02  # opacity from which matter bounds the scene; from which there is any
_NEIGHBOURS = 4  # particles that a point goes with
_FRAMES, _CAMERAS = 32, 8  # at whose times, and from which of them, motion is looked at
_MOVES = 1.5  # pixels from the mean place, from which on it is seen that a particle moves
_ALIKE = 9  # particles beside each other, whose median counts
_COLLAPSED = 0.05  # of the longest axis: what a blend of maps has pressed flatter is not stretched again


def _visible(particles: Particles) -> Tensor:
    """Return which particles (N,) there is anything to see of; all, if there is of none."""
    visible = torch.sigmoid(particles.opacity.data[:, 0]) > _VISIBLE
    return visible if bool(visible.any()) else torch.ones_like(visible)


@torch.no_grad()
def matter(self: Particles) -> Cloud:
    """See ``HasMatter``: the particles of which there is anything to see, at the canonical time."""
    keep = _visible(self)
    points = moved(self.means.data, self.warp(self.canonical_time))[0]
    colors = (0.5 + FLAT * self.colors.data[keep, 0]).clamp(0, 1)
    size = 2 * float(self.scales.exp().mean())
    return Cloud(points[keep], colors, torch.sigmoid(self.opacity.data[keep, 0]), max(size, 1e-9))


@torch.no_grad()
def ellipsoids(self: Particles, time: float) -> Ellipsoids:
    """See ``HasEllipsoids``: all particles, also those at rest and those that have faded."""
    canonical = template(self)
    centers, linear = moved(canonical.centers, self.warp(time))
    color_basis, opacity_basis = self.time_bases(time)
    harmonics, opacity = canonical.harmonics, self.opacity[:, 0]
    if self.color_over_time is not None:
        harmonics = harmonics.clone()
        harmonics[:, 0] += torch.einsum("t,ntc->nc", color_basis, self.color_over_time) / FLAT
    if self.opacity_over_time is not None:
        opacity = opacity + self.opacity_over_time @ opacity_basis[1:]
    return Ellipsoids(centers, linear @ canonical.roots, torch.sigmoid(opacity), harmonics)


@torch.no_grad()
def template(self: Particles) -> Ellipsoids:
    """See ``HasEllipsoids``: before any motion; nodes move it a little at the canonical time, too."""
    roots = rotations(self.quaternions) * self.scales.exp()[:, None]
    harmonics = self.colors if self.sh is None else torch.cat([self.colors, self.sh], 1)
    return Ellipsoids(self.means.data, roots, torch.sigmoid(self.opacity[:, 0]), harmonics.data)


@torch.no_grad()
def movement(self: Particles, times: Sequence[float]) -> dict[str, Tensor]:
    """See ``HasEllipsoids``. A center goes to ``x + sum_l w_l (D x + d)``, a root to ``(I + sum_l w_l D)
    root``, where l are the nodes in ``links`` (N, L), w ``weights`` (N, L) and ``D | d`` the nodes' ``maps``
    (T, M, 3, 4). ``color_over_time`` (N, K, 3), by ``color_basis`` (T, K), is added to the colour, and
    ``opacity_over_time`` (N, F), by ``opacity_basis`` (T, F), to the opacity's logit. The maps come of
    ``node_shift`` and ``node_turn`` (M, B, 3), by ``node_basis`` (T, B), about ``node_places`` (M, 3).
    What is off is absent.
    """
    parts = {}
    if self.nodes is not None:
        nodes, warps = self.nodes, [self.warp(time) for time in times]
        maps = [torch.cat([w.maps[:, :9].reshape(-1, 3, 3), w.maps[:, 9:, None]], -1) for w in warps]
        parts = {"links": warps[0].links, "weights": warps[0].weights, "maps": torch.stack(maps)}
        parts |= {"node_places": nodes.positions, "node_shift": nodes.translations}
        parts["node_basis"] = torch.stack([nodes.basis(time) for time in times])
        if nodes.rotations is not None:
            parts["node_turn"] = nodes.rotations
    if self.color_over_time is not None:
        parts["color_over_time"] = self.color_over_time
        parts["color_basis"] = self.color_over_time.new_tensor([self.color_basis(time) for time in times])
    if self.opacity_over_time is not None:
        parts["opacity_over_time"] = self.opacity_over_time
        parts["opacity_basis"] = self.opacity_over_time.new_tensor(
            [self.opacity_basis(time) for time in times]
        )
    return {name: value.detach() for name, value in parts.items()}


@torch.no_grad()
def moving(self: Particles) -> MovingGaussians:
    """See ``HasMovingGaussians``: all particles, in their order."""
    motion, nodes = None, self.nodes
    if nodes is not None:
        offsets = nodes.time_offsets
        times = [] if offsets is None else offsets.times
        motion = NodeMotion(
            nodes.positions,
            nodes.translations.data,
            None if nodes.rotations is None else nodes.rotations.data,
            nodes.curve,
            self.skinning.links,
            self.skinning.weights(),
            times,
            [offsets(time) - time for time in times],
        )
    over_time = (self.color_over_time, self.opacity_over_time)
    over_time = [None if part is None else part.data for part in over_time]
    harmonics, opacity = template(self).harmonics, self.opacity.data[:, 0]
    canonical = self.means.data, self.scales.data, self.quaternions.data, opacity, harmonics
    return MovingGaussians(*canonical, *over_time, self.canonical_time, self.blur, motion)


@torch.no_grad()
def in_motion(self: Particles, frames: Sequence[Frame]) -> Tensor:
    """See ``HasLayers``. A particle moves that goes more than ``_MOVES`` pixels from its mean place, in half
    of some cameras' images. Motion along their rays, of which images say little, is none; neither is that at
    times of which no image shows the place. Single particles stray: the median with the nearest others
    counts. What rests, or follows only nodes that have stopped, does not move.

    Cost: 256 places in an image for each particle.
    """
    if self.nodes is None:
        return torch.zeros(len(self.means), dtype=torch.bool, device=self.means.device)
    frames = [frames[number] for number in spread(len(frames), _FRAMES)]
    places = torch.stack([moved(self.means.data, self.warp(frame.time))[0] for frame in frames])
    shown = torch.stack([_in_image(frame.camera, now) for frame, now in zip(frames, places)])  # (F, N)
    ranges = []
    for number in spread(len(frames), _CAMERAS):
        pixels, depth = replace(frames[number].camera, lens=None).project(places)
        mean = (pixels * shown[..., None]).sum(0) / shown.sum(0).clamp(min=1)[:, None]
        away = ((pixels - mean).norm(dim=-1) * shown).amax(0)
        ranges.append(torch.where(((depth > 0) | ~shown).all(0), away, torch.nan))
    ranges = torch.stack(ranges).nanmedian(0).values.nan_to_num()
    beside = nearest(self.means.data, self.means.data, _ALIKE)[1]
    return (ranges[beside].median(-1).values > _MOVES) & (self.skinning.shares.sum(-1) > 0)


def _in_image(camera: Camera, points: Tensor) -> Tensor:
    """Return which points (N, 3) lie before a camera and within its image."""
    pixels, depth = camera.project(points)
    inside = (pixels >= 0) & (pixels < pixels.new_tensor([camera.width, camera.height]))
    return inside.all(-1) & (depth > 0)


@torch.no_grad()
def only(self: Particles, rows: Tensor) -> Particles:
    """See ``HasLayers``."""
    part = copy.deepcopy(self)
    keep_rows(part, rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows)
    return part


@torch.no_grad()
def bounds(self: Particles, times: list[float]) -> Box | None:
    """See ``HasBounds``."""
    solid = torch.sigmoid(most_opaque(self)) > _SOLID
    if not bool(solid.any()):
        return None
    points = torch.cat([moved(self.means.data, self.warp(time))[0][solid] for time in times])
    pad = 2 * float(self.scales[solid].exp().median()) + 1e-3 * float(self.extent)
    low, high = points.amin(0) - pad, points.amax(0) + pad
    return Box(tuple(low.tolist()), tuple(high.tolist()))


@torch.no_grad()
def trajectories(self: Particles, points: Tensor, times: Tensor) -> Tensor:
    """Return where points (P, 3) of the canonical time are at times (T,): (P, T, 3).

    A particle takes a point from where it was beside it then, ``F_t F_c^-1 (y - x_c) + x_t``; those that were
    nearest then are blended by ``1 / d^2``. At the canonical time that is y itself, unless a blend has
    pressed a particle flat.

    Cost: a search among the particles, and all of them moved once for each time.
    """
    if self.nodes is None:
        return points[:, None].expand(-1, len(times), -1).clone()
    keep = _visible(self)
    means, links, weights = self.means.data[keep], self.skinning.links[keep], self.skinning.weights()[keep]

    def at(time: float) -> tuple[Tensor, Tensor]:
        return moved(means, Warp(self.nodes.maps(time), links, weights))

    canonical, linear = at(self.canonical_time)
    points = points.to(canonical)
    squared, rows = nearest(points, canonical, _NEIGHBOURS)
    shares = 1 / (squared + 1e-6 * squared.mean() + 1e-30)
    shares = (shares / shares.sum(-1, keepdim=True))[..., None]
    inverse = torch.linalg.pinv(linear, rtol=_COLLAPSED)
    local = (inverse[rows] @ (points[:, None] - canonical[rows])[..., None])[..., 0]
    paths = []
    for time in times.tolist():
        now, linear = at(time)
        paths.append((shares * ((linear[rows] @ local[..., None])[..., 0] + now[rows])).sum(1))
    return torch.stack(paths, 1) if paths else points.new_zeros(len(points), 0, 3)
