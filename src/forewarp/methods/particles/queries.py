"""Scene queries: point cloud, bounds, trajectories, ellipsoids, layers."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from forewarp.fields.moving import MovingGaussians, NodeMotion
from forewarp.methods.method import Method
from forewarp.methods.particles.density import most_opaque
from forewarp.methods.rows import keep_rows
from forewarp.ops.gaussians import moved
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.cloud import Cloud, Ellipsoids, nearest
from forewarp.scene.frame import Frame, spread
from forewarp.scene.view import Moment, View

_SOLID = 0.1  # opacity from which matter bounds the scene
_FRAMES, _CAMERAS = 32, 8  # at whose times, and from which of them, motion is looked at
MOVES = 1.5  # pixels from the mean place, from which on it is seen that a particle moves
_ALIKE = 9  # particles beside each other, whose median counts


class Queries(Method):
    """Scene queries of ``Particles``; see ``methods.method``."""

    @torch.no_grad()
    def moving(self) -> MovingGaussians:
        """See ``HasMovingGaussians``: all particles, in their order."""
        motion, nodes = None, self.nodes
        if nodes is not None:
            offsets = nodes.time_offsets
            times = [] if offsets is None else offsets.times
            curves = nodes.translations.data, _data(nodes.rotations), nodes.curve
            skinning = self.skinning.links, self.skinning.weights()
            corrections = [offsets(time) - time for time in times]
            motion = NodeMotion(nodes.positions, *curves, *skinning, times, corrections)
        harmonics = self.colors if self.sh is None else torch.cat([self.colors, self.sh], 1)
        canonical = self.means.data, self.scales.data, self.quaternions.data, self.opacity.data[:, 0]
        over_time = _data(self.color_over_time), _data(self.opacity_over_time), self.canonical_time
        return MovingGaussians(*canonical, harmonics.data, *over_time, self.blur, motion)

    @torch.no_grad()
    def in_motion(self, frames: Sequence[Frame]) -> Tensor:
        """See ``HasLayers``. A particle moves that goes more than ``MOVES`` pixels from its mean place, in
        half of some cameras' images. Motion along their rays, of which images say little, is none; neither is
        that at times of which no image shows the place. Single particles stray: the median with the nearest
        others counts. What rests, or follows only nodes that have stopped, does not move.

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
        return (ranges[beside].median(-1).values > MOVES) & (self.skinning.shares.sum(-1) > 0)

    def common(self) -> Tensor | None:
        """See ``HasCommon``."""
        return None if self.shared is None else self.shared.cpu()

    @torch.no_grad()
    def only(self, rows: Tensor) -> Queries:
        """See ``HasLayers``."""
        part = copy.deepcopy(self)
        keep_rows(part, rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows)
        return part

    @torch.no_grad()
    def bounds(self, times: list[float]) -> Box | None:
        """See ``HasBounds``."""
        solid = torch.sigmoid(most_opaque(self)) > _SOLID
        if not bool(solid.any()):
            return None
        low, high = self.means.new_full((3,), torch.inf), self.means.new_full((3,), -torch.inf)
        for time in times:  # one at a time, as all places of all particles may take gigabytes
            points = moved(self.means.data, self.warp(time))[0][solid]
            low, high = torch.minimum(low, points.amin(0)), torch.maximum(high, points.amax(0))
        pad = 2 * float(self.scales[solid].exp().median()) + 1e-3 * float(self.extent)
        return Box(tuple((low - pad).tolist()), tuple((high + pad).tolist()))

    def matter(self) -> Cloud:
        """See ``HasMatter``."""
        return self.moving().matter()

    def trajectories(self, points: Tensor, times: Tensor) -> Tensor:
        """See ``HasTrajectories``."""
        return self.moving().trajectories(points, times)

    @torch.no_grad()
    def carried(self, view: View, moment: Moment, to: Moment) -> Tensor:
        """See ``CarriesPixels``."""
        return self.at(moment).carried(view, moved(self.means.data, self.warp(to.time))[0])

    def ellipsoids(self, time: float) -> Ellipsoids:
        """See ``HasEllipsoids``."""
        return self.moving().ellipsoids(time)

    def template(self) -> Ellipsoids:
        """See ``HasEllipsoids``."""
        return self.moving().template()

    def movement(self, times: Sequence[float]) -> dict[str, Tensor]:
        """See ``HasEllipsoids``."""
        return self.moving().movement(times)


def _data(parameter: Tensor | None) -> Tensor | None:
    return None if parameter is None else parameter.data


def _in_image(camera: Camera, points: Tensor) -> Tensor:
    """Return which points (N, 3) lie before a camera and within its image."""
    pixels, depth = camera.project(points)
    inside = (pixels >= 0) & (pixels < pixels.new_tensor([camera.width, camera.height]))
    return inside.all(-1) & (depth > 0)
