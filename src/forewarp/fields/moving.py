"""Gaussians that nodes with curves carry through time: what rendering, queries and files need of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import torch
from torch import Tensor

from forewarp.fields.curves import Curve
from forewarp.fields.networks import beside
from forewarp.ops.gaussians import (
    CHUNK,
    COLUMN,
    FLAT,
    Gaussians,
    Pinhole,
    Warp,
    moved,
    project,
    rasterize,
    rotations,
)
from forewarp.ops.nodes import carry_nodes
from forewarp.scene.brief import brief
from forewarp.scene.camera import Camera
from forewarp.scene.cloud import Cloud, Ellipsoids, nearest
from forewarp.scene.view import Moment, Rendering, View
from forewarp.scene.world import World

# Of the camera's near plane, and at least of its far plane: closer particles would fill the image.
_NEAR, _LEAST_NEAR = 0.1, 0.02
MARGIN = 0.125  # share of an image's longer side; what projects farther outside is left out
_LENS_MARGIN = 1.3  # of the squared distance from the axis that the image's border reaches
_BORDER = 16  # points along each side of an image
_TRANSPARENT = 1e-6  # opacity below which a pixel has no depth
_SHOWN = 0.1  # opacity from which a pixel shows something that can be followed
_VISIBLE = 0.02  # opacity from which there is any matter
_NEIGHBOURS = 4  # particles that a point goes with
_COLLAPSED = 0.05  # of the longest axis: what a blend of maps has pressed flatter is not stretched again
_ROUNDING = 1e-6  # of all time, by which a curve is continued farther than offsets ask for


@lru_cache(maxsize=4096)
def pinhole_of(camera: Camera, blur: float) -> Pinhole:
    """Convert a scene's camera to what the operators read; each camera once, as it takes 0.3 ms.

    Args:
        camera: a camera, with or without a lens.
        blur: square pixels added to the variance of every splat.
    """
    pose, lens = camera.camera_to_world.double(), camera.lens
    rotation, center = tuple(pose[:3, :3].T.flatten().tolist()), tuple(pose[:3, 3].tolist())
    focal, middle, size = (camera.fx, camera.fy), (camera.cx, camera.cy), (camera.width, camera.height)
    near = max(_NEAR * camera.near, _LEAST_NEAR * camera.far)
    others = {"skew": camera.skew, "blur": blur, "margin": MARGIN * max(size)}
    if lens is not None:
        others |= {"radial": lens.k, "tangential": lens.p, "reach": _squared_reach(camera)}
    return Pinhole(rotation, center, focal, middle, size, near, **others)


def _squared_reach(camera: Camera) -> float:
    """Return the squared distance from the axis, at depth 1, up to which a lens may show points.

    Beyond it the lens's polynomial may fold points back into the image.
    """
    along = torch.linspace(0, 1, _BORDER, dtype=torch.float64)
    across, down = along * camera.width, along * camera.height
    zero = torch.zeros_like(along)
    u = torch.cat([across, across, zero, zero + camera.width])
    v = torch.cat([zero, zero + camera.height, down, down])
    y = (v - camera.cy) / camera.fy
    x = (u - camera.cx - camera.skew * y) / camera.fx
    return _LENS_MARGIN * float(camera.lens.straighten(torch.stack([x, y], -1)).square().sum(-1).max())


def cosines(count: int, time: float, canonical_time: float) -> list[float]:
    """Return ``cos(pi k t) - cos(pi k t_c)`` for k = 1 .. count: 0 at the canonical time."""
    rates = [math.pi * k for k in range(1, count + 1)]
    return [math.cos(rate * time) - math.cos(rate * canonical_time) for rate in rates]


def around(times: Sequence[float], time: float) -> dict[int, float]:
    """Return the rows of the one or two of ``times``, which rise, around a time, each with its weight.

    >>> around([0.0, 0.5, 1.0], 0.625), around([0.0, 0.5, 1.0], 1.5)
    ({1: 0.75, 2: 0.25}, {2: 1.0})
    """
    before, after, share = beside(times, time)
    return {before: 1.0} if before == after else {before: 1 - share, after: share}


@dataclass(eq=False)
class GaussiansSnapshot:
    """Gaussians at a moment.

    Attributes:
        moment: the moment.
        gaussians: the canonical ones.
        warp: how they move until then.
        color_basis, opacity_basis: what the time makes of colours (T,) and of opacity (F,).
        blur: square pixels added to the variance of every splat.
        chunk: see ``rasterize``.
    """

    moment: Moment
    gaussians: Gaussians
    warp: Warp
    color_basis: Tensor
    opacity_basis: Tensor
    blur: float
    chunk: int = CHUNK

    __repr__ = brief

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        """Render ``view`` over ``background`` (3,). Pixels and crops are taken from the whole image, which
        costs little.
        """
        color, distance, through = self._drawn(view)
        opacity = 1 - through
        depth = torch.where(opacity > _TRANSPARENT, distance / opacity.clamp(min=_TRANSPARENT), 0.0)
        return Rendering(color + through[:, None] * background.to(color), depth, opacity)

    def _drawn(self, view: View, instead: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return what the pixels of a view show: colour (R, 3), or what each Gaussian has ``instead`` (N, 3)
        of one; distance times coverage (R,); and what is let through (R,).
        """
        pinhole = pinhole_of(view.camera, self.blur)
        splats = project(self.gaussians, self.warp, pinhole, self.color_basis, self.opacity_basis)
        if instead is not None:
            values = torch.cat([splats.values[:, : COLUMN.red], instead, splats.values[:, COLUMN.depth :]], 1)
            splats = splats._replace(values=values)
        color, distance, through = rasterize(splats, *pinhole.size, self.chunk)
        drawn = color.reshape(3, -1).T, distance.reshape(-1), through.reshape(-1)
        if view.indices is None:
            return drawn
        return tuple(part[view.indices.to(part.device)] for part in drawn)

    def carried(self, view: View, places: Tensor) -> Tensor:
        """Return the mean place (R, 3) of what each pixel shows, with the Gaussians at ``places`` (N, 3); NaN
        where it shows next to nothing.
        """
        mean, _, through = self._drawn(view, places)
        opacity = 1 - through[:, None]
        return torch.where(opacity > _SHOWN, mean / opacity, torch.nan)

    def share(self, view: View, rows: Tensor) -> Tensor:
        """Return the share (R,) in [0, 1] of each pixel that is rows (N,) bool, as nothing hides it: render
        these white, all others black.
        """
        flat = torch.where(rows, 0.5, -0.5).to(self.gaussians.colors)[:, None, None] / FLAT
        painted = self.gaussians._replace(colors=flat.expand(-1, 1, 3).contiguous())
        plain = replace(self, gaussians=painted, color_basis=self.color_basis[:0])
        return plain.render(view, flat.new_zeros(3)).rgb[:, 0]

    def pixels(self, camera: Camera) -> Tensor:
        """Return how many pixels' worth (N,) of an image each Gaussian makes up: its shares, summed over all
        pixels.

        Cost: that of the image and its gradients.
        """
        pinhole = pinhole_of(camera, self.blur)
        with torch.no_grad():
            splats = project(self.gaussians, self.warp, pinhole, self.color_basis, self.opacity_basis)
        values = splats.values.clone().requires_grad_()
        with torch.enable_grad():
            color = rasterize(splats._replace(values=values), *pinhole.size, self.chunk).color
            return torch.autograd.grad(color[0].sum(), values)[0][:, COLUMN.red]

    def holds(self, moment: Moment) -> bool:
        """Return whether it is the same time; which camera looks does not matter."""
        return moment.time == self.moment.time


def _to(record, device):
    """Move the tensors of a record to a device."""
    parts = {field.name: getattr(record, field.name) for field in fields(record)}
    return replace(record, **{name: part.to(device) for name, part in parts.items() if hasattr(part, "to")})


@dataclass(frozen=True)
class NodeMotion:
    """M nodes at ``positions`` (M, 3), and how they and what follows them move.

    Attributes:
        positions: world units.
        translations: (M, K, 3), coefficients of the ``curve``, world units.
        rotations: (M, K, 3) likewise of Gibbs vectors, or (M, K, 4) of quaternions, see ``ops.nodes``; None
            where nodes do not rotate.
        curve: the curve of every node.
        links, weights: (N, L) of N Gaussians: rows of nodes, int32, and their shares, which sum to 1, or are
            all 0 of one at rest.
        times, offsets: of images, ascending, and what is added to them for the time of the motion; linear in
            between and constant beyond. Empty: nothing is added.
    """

    positions: Tensor
    translations: Tensor
    rotations: Tensor | None
    curve: Curve
    links: Tensor
    weights: Tensor
    times: Sequence[float] = ()
    offsets: Sequence[float] = ()

    __repr__ = brief

    def motion_time(self, time: float) -> float:
        """Return the time of the motion that an image of a given time shows."""
        if not self.times:
            return time
        return time + sum(weight * self.offsets[row] for row, weight in around(self.times, time).items())

    def basis(self, time: float) -> Tensor:
        """Return the curve's basis (K,) at a given time."""
        beyond = max(map(abs, self.offsets), default=0.0) + _ROUNDING
        return self.curve(self.motion_time(time), beyond).to(self.positions)

    def warp(self, time: float) -> Warp:
        """Return how all Gaussians move from the canonical state to a time."""
        maps = carry_nodes(self.translations, self.rotations, self.basis(time), self.positions)[1]
        return Warp(maps, self.links, self.weights)

    to = _to


@dataclass(frozen=True)
class MovingGaussians:
    """N Gaussians of a canonical state, and what time makes of them.

    Attributes:
        means: (N, 3), world units.
        log_scales: (N, 3), of standard deviations along the axes, world units.
        quaternions: (N, 4), how the axes are turned: w, x, y, z of any length.
        opacity: (N,), logits at the canonical time.
        harmonics: (N, B, 3), B one of 1, 4, 9, 16; see ``scene.cloud.Ellipsoids``.
        color_over_time: (N, K, 3); the colour has ``sum_k f_k c_k`` more, ``f`` the ``cosines``. None:
            nothing.
        opacity_over_time: (N, F), of the opacity's logit likewise.
        canonical_time: in [0, 1].
        blur: square pixels added to the variance of every splat.
        motion: None: nothing moves.
    """

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    opacity: Tensor
    harmonics: Tensor
    color_over_time: Tensor | None
    opacity_over_time: Tensor | None
    canonical_time: float
    blur: float
    motion: NodeMotion | None

    __repr__ = brief

    to = _to

    @property
    def device(self) -> torch.device:
        """Where they are."""
        return self.means.device

    @property
    def moves(self) -> bool:
        """Whether there is any motion."""
        return self.motion is not None

    def in_data(self, world: World) -> MovingGaussians:
        """Move them from a scene's world to that of its data; computed in float64, kept as they were."""
        if world.is_same:
            return self
        motion = self.motion
        if motion is not None:
            positions = world.to_data(motion.positions).to(motion.positions)
            motion = replace(motion, positions=positions, translations=motion.translations / world.scale)
        means = world.to_data(self.means).to(self.means)
        return replace(self, means=means, log_scales=self.log_scales - math.log(world.scale), motion=motion)

    def gaussians(self) -> Gaussians:
        """Return them as the operators read them: coefficients of one kind in one tensor."""
        kinds = (self.opacity[:, None], self.opacity_over_time), (self.harmonics, self.color_over_time)
        opacity, colors = (torch.cat([p for p in parts if p is not None], 1) for parts in kinds)
        return Gaussians(self.means, self.log_scales, self.quaternions, opacity, colors)

    def warp(self, time: float) -> Warp:
        """Return how all of them move from the canonical state to a time."""
        if self.motion is not None:
            return self.motion.warp(time)
        zero = self.means.new_zeros(len(self.means), 1)
        return Warp(self.means.new_zeros(1, 12), zero.int(), zero)

    def bases(self, time: float) -> tuple[Tensor, Tensor]:
        """Return what a time makes of the coefficients over time of colour (K,) and of opacity (F,)."""
        counts = [0 if p is None else p.shape[1] for p in (self.color_over_time, self.opacity_over_time)]
        return tuple(self.means.new_tensor(cosines(n, time, self.canonical_time)) for n in counts)

    def at(self, moment: Moment) -> GaussiansSnapshot:
        """Freeze them at a moment."""
        color, opacity = self.bases(moment.time)
        bases = color, torch.cat([opacity.new_ones(1), opacity])
        return GaussiansSnapshot(moment, self.gaussians(), self.warp(moment.time), *bases, self.blur)

    def template(self) -> Ellipsoids:
        """Return them before any motion; nodes move them a little at the canonical time, too."""
        roots = rotations(self.quaternions) * self.log_scales.exp()[:, None]
        return Ellipsoids(self.means, roots, torch.sigmoid(self.opacity), self.harmonics)

    def ellipsoids(self, time: float) -> Ellipsoids:
        """Return them as they are at a time: all, also those at rest and those that have faded."""
        canonical = self.template()
        centers, linear = moved(canonical.centers, self.warp(time))
        color_basis, opacity_basis = self.bases(time)
        harmonics, opacity = self.harmonics, self.opacity
        if self.color_over_time is not None:
            harmonics = harmonics.clone()
            harmonics[:, 0] += torch.einsum("t,ntc->nc", color_basis, self.color_over_time) / FLAT
        if self.opacity_over_time is not None:
            opacity = opacity + self.opacity_over_time @ opacity_basis
        return Ellipsoids(centers, linear @ canonical.roots, torch.sigmoid(opacity), harmonics)

    def movement(self, times: Sequence[float]) -> dict[str, Tensor]:
        """Return, by name, what makes ``ellipsoids`` at T times of the ``template``.

        A center goes to ``x + sum_l w_l (D x + d)``, a root to ``(I + sum_l w_l D) root``, where l are the
        nodes in ``links`` (N, L), w ``weights`` (N, L) and ``D | d`` the nodes' ``maps`` (T, M, 3, 4).
        ``color_over_time`` (N, K, 3), by ``color_basis`` (T, K), is added to the colour, and
        ``opacity_over_time`` (N, F), by ``opacity_basis`` (T, F), to the opacity's logit. The maps come of
        ``node_shift`` (M, B, 3) and ``node_turn`` (M, B, 3 or 4), by ``node_basis`` (T, B), about
        ``node_places`` (M, 3). What is off is absent.
        """
        parts, motion = {}, self.motion
        if motion is not None:
            maps = torch.stack([motion.warp(time).maps for time in times])
            maps = torch.cat([maps[..., :9].unflatten(-1, (3, 3)), maps[..., 9:, None]], -1)
            parts = {"links": motion.links, "weights": motion.weights, "maps": maps}
            parts |= {"node_places": motion.positions, "node_shift": motion.translations}
            parts["node_basis"] = torch.stack([motion.basis(time) for time in times])
            if motion.rotations is not None:
                parts["node_turn"] = motion.rotations
        color_basis, opacity_basis = map(torch.stack, zip(*map(self.bases, times)))
        if self.color_over_time is not None:
            parts |= {"color_over_time": self.color_over_time, "color_basis": color_basis}
        if self.opacity_over_time is not None:
            parts |= {"opacity_over_time": self.opacity_over_time, "opacity_basis": opacity_basis}
        return parts

    def _visible(self) -> Tensor:
        """Return which (N,) there is anything to see of; all, if there is of none."""
        visible = torch.sigmoid(self.opacity) > _VISIBLE
        return visible if bool(visible.any()) else torch.ones_like(visible)

    @torch.no_grad()
    def matter(self) -> Cloud:
        """Return those of which there is anything to see, at the canonical time, as points."""
        keep = self._visible()
        points = moved(self.means, self.warp(self.canonical_time))[0]
        colors = (0.5 + FLAT * self.harmonics[keep, 0]).clamp(0, 1)
        size = 2 * float(self.log_scales.exp().mean())
        return Cloud(points[keep], colors, torch.sigmoid(self.opacity[keep]), max(size, 1e-9))

    @torch.no_grad()
    def trajectories(self, points: Tensor, times: Tensor) -> Tensor:
        """Return where points (P, 3) of the canonical time are at times (T,): (P, T, 3).

        A Gaussian takes a point from where it was beside it then, ``F_t F_c^-1 (y - x_c) + x_t``; those that
        were nearest then are blended by ``1 / d^2``. At the canonical time that is y itself, unless a blend
        has pressed a Gaussian flat.

        Cost: a search among the Gaussians, and all of them moved once for each time.
        """
        if self.motion is None:
            return points[:, None].expand(-1, len(times), -1).clone()
        keep = self._visible()
        motion = replace(self.motion, links=self.motion.links[keep], weights=self.motion.weights[keep])
        means = self.means[keep]
        canonical, linear = moved(means, motion.warp(self.canonical_time))
        points = points.to(canonical)
        squared, rows = nearest(points, canonical, _NEIGHBOURS)
        shares = 1 / (squared + 1e-6 * squared.mean() + 1e-30)
        shares = (shares / shares.sum(-1, keepdim=True))[..., None]
        inverse = torch.linalg.pinv(linear, rtol=_COLLAPSED)
        local = (inverse[rows] @ (points[:, None] - canonical[rows])[..., None])[..., 0]
        paths = []
        for time in times.tolist():
            now, linear = moved(means, motion.warp(time))
            paths.append((shares * ((linear[rows] @ local[..., None])[..., 0] + now[rows])).sum(1))
        return torch.stack(paths, 1) if paths else points.new_zeros(len(points), 0, 3)
