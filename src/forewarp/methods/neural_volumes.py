"""Neural Volumes: pictures of an instant give a code, and it a volume, read through a warp."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain

import torch
from torch import Tensor, nn
from torch.nn import functional

from forewarp.fields.networks import beside, start_as_glorot
from forewarp.methods.method import Start, Step, check_number, those_that_hold
from forewarp.methods.rays import BETWEEN_TIMES, CENTRES, ONE_TIME, DeadStart, RayMethod, RaySnapshot
from forewarp.ops.gaussians import rotations
from forewarp.ops.march import clip_to_box
from forewarp.renderer import in_chunks
from forewarp.scene.camera import Rays
from forewarp.scene.frame import Frame, Scene, spread
from forewarp.scene.view import Batch, Moment, Rendering, View

_MOST = 3  # pictures of an instant, as published
_POINTS = 1 << 19  # read at once for an image
_MEAN, _DEVIATION = 100.0, 25.0  # of pictures in [0, 255]
_SCALE = 0.01  # of the layer that gives the logarithm of the deviation
_SLOPE = 0.2  # of leaky ReLUs
_LEAST = 1e-3  # least total weight of the maps at a point
_SHORT = 1e-5  # added to the squared length of a quaternion
_start_leaky = partial(start_as_glorot, gain=nn.init.calculate_gain("leaky_relu", _SLOPE))


class PictureEncoder(nn.Module):
    """Pictures of an instant (K, 3, H, W) -> mean and logarithm of the deviation of a code, (C,) each.

    Args:
        pictures: K, each with convolutions of its own.
        size: H and W, multiples of ``2**len(tower)``.
        tower: channels of the convolutions (4 x 4, stride 2).
        width: channels of the layer that joins the pictures.
        code: C.
    """

    def __init__(
        self, pictures: int, size: tuple[int, int], *, tower: Sequence[int], width: int, code: int
    ) -> None:
        super().__init__()
        by = 2 ** len(tower)
        if len(size) != 2 or min(size) < by or any(side % by for side in size):
            wanted = f"height and width in multiples of {by}, as the tower halves {len(tower)} times"
            raise ValueError(f"model.picture_size: expected {wanted}, but got {list(size)}")
        steps = list(zip((3, *tower[:-1]), tower))
        self.towers = nn.ModuleList()
        for _ in range(pictures):
            layers = [(nn.Conv2d(i, o, 4, 2, 1), nn.LeakyReLU(_SLOPE)) for i, o in steps]
            self.towers.append(nn.Sequential(*chain(*layers)))
        self.joined = nn.Linear(pictures * tower[-1] * (size[0] // by) * (size[1] // by), width)
        self.mean, self.deviation = nn.Linear(width, code), nn.Linear(width, code)
        self.apply(_start_leaky)
        for last in (self.mean, self.deviation):
            start_as_glorot(last)

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        seen = [tower(one[None]).flatten() for tower, one in zip(self.towers, pictures, strict=True)]
        hidden = functional.leaky_relu(self.joined(torch.cat(seen)), _SLOPE)
        return 0.1 * self.mean(hidden), _SCALE * self.deviation(hidden)


class VolumeDecoder(nn.Module):
    """A code (C,) -> raw values (4, S, S, S), S = ``2**len(channels)``: three of colour, then opacity."""

    def __init__(self, code: int, channels: Sequence[int]) -> None:
        super().__init__()
        self.first = nn.Linear(code, channels[0])
        steps = zip(channels, (*channels[1:], 4))
        self.grow = nn.ModuleList(nn.ConvTranspose3d(i, o, 4, 2, 1) for i, o in steps)
        self.apply(_start_leaky)
        start_as_glorot(self.grow[-1])

    def forward(self, code: Tensor) -> Tensor:
        """See the class."""
        volume = self.first(code).reshape(1, -1, 1, 1, 1)
        for layer in self.grow:
            volume = layer(functional.leaky_relu(volume, _SLOPE))
        return volume[0]


class AffineMixture(nn.Module):
    """An inverse warp: ``W(x) = sum_i g_i(A_i x) A_i x / max(sum_i g_i(A_i x), 0.001)`` with affine maps
    ``A_i x = s_i * R_i (x - t_i)`` and decoded weights ``g_i`` on a lattice, beyond which they are as at its
    border.

    Args:
        code: C.
        maps: their number.
        side: lattice points along an axis of the weights and of W.
        width, weight_width: hidden channels of the maps and of the weights.
        from_identity: add 1 to ``s`` and the identity to ``R``, so that W is near the identity where codes
            are small. As released, scales of either sign and any rotations are mixed at first.
    """

    def __init__(
        self, code: int, *, maps: int, side: int, width: int, weight_width: int, from_identity: bool
    ) -> None:
        super().__init__()
        self.maps, self.side, self.from_identity = maps, side, from_identity

        def head(hidden: int, out: int) -> nn.Sequential:
            return nn.Sequential(nn.Linear(code, hidden), nn.LeakyReLU(_SLOPE), nn.Linear(hidden, out))

        self.scale, self.turn, self.shift = (head(width, maps * size) for size in (3, 4, 3))
        self.weight = head(weight_width, maps * side**3)
        self.apply(_start_leaky)
        for branch in (self.scale, self.turn, self.shift, self.weight):
            start_as_glorot(branch[-1])
        axis = torch.linspace(-1, 1, side)
        z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
        self.register_buffer("lattice", torch.stack([x, y, z], -1), persistent=False)

    def moved(self, code: Tensor, points: Tensor) -> Tensor:
        """Apply each map to points (..., 3): (M, ..., 3)."""
        scale = self.scale(code).reshape(self.maps, 3)
        turn = self.turn(code).reshape(self.maps, 4)
        shift = 0.1 * self.shift(code).reshape(self.maps, 3)
        if self.from_identity:
            scale = 1 + scale
            turn = turn + turn.new_tensor([1.0, 0.0, 0.0, 0.0])
        squared, eye = turn.square().sum(-1)[:, None, None], torch.eye(3).to(turn)
        rotation = eye + (rotations(turn) - eye) * squared / (squared + _SHORT)  # smooth also where turn is 0
        flat = points.reshape(-1, 3) - shift[:, None]
        found = scale[:, None] * (flat @ rotation.mT)
        return found.reshape(self.maps, *points.shape)

    def forward(self, code: Tensor) -> Tensor:
        """Code (C,) -> W at the lattice's points (3, S, S, S)."""
        places = self.moved(code, self.lattice)
        weights = self.weight(code).exp().reshape(self.maps, 1, *[self.side] * 3)
        weights = functional.grid_sample(weights, places, padding_mode="border", align_corners=True)
        weights = weights[:, 0, ..., None]
        whole = (weights * places).sum(0) / weights.sum(0).clamp(min=_LEAST)
        return whole.permute(3, 0, 1, 2)


def read(volume: Tensor, points: Tensor, padding: str = "zeros") -> Tensor:
    """Read a volume (C, S, S, S) at points (N, 3) of the cube, trilinearly: (N, C).

    Beyond the cube lies 0, or with padding ``border`` what is nearest.
    """
    at = points.reshape(1, 1, 1, -1, 3)
    return functional.grid_sample(volume[None], at, padding_mode=padding, align_corners=True)[0, :, 0, 0].T


@dataclass(frozen=True)
class Volumes:
    """The scene at one time: ``template`` (4, S, S, S), colour in about [0, 1] and opacity per half side of
    the cube, and ``warp`` (3, W, W, W), where in the template each place of the cube is.
    """

    template: Tensor
    warp: Tensor

    def at(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Points (N, 3) of the cube -> colour (N, 3) and opacity (N,)."""
        found = read(self.template, read(self.warp, points, "border"))
        return found[:, :3], found[:, 3]


class NeuralVolumes(RayMethod):
    """``z = E(pictures(t))``, ``V = D(z)``, seen at x: ``V(W(x; z))`` (Neural Volumes, equations 1 to 12).

    Time enters only through training pictures of the instant, which are kept small in the method itself.
    Where fixed cameras see every instant, up to three of them are looked at; else the one picture of the
    instant, wherever it was taken from. Between training times the codes beside it are interpolated.

    Args:
        start: scene, stage and numbers.
        pictures: of an instant, taken by as many fixed cameras; null: as many as there are, at most 3.
        picture_size, tower, features, code: see ``PictureEncoder``.
        decoder: see ``VolumeDecoder``.
        maps, warp_side, warp_width, weight_width, from_identity: see ``AffineMixture``.
        first_opacity: of the volume before training, > 0; null: as released, about 0.7, with which most rays
            are opaque at first, and the background has no part in them.
        first_deviation: of the code before training, > 0; null: as released, about 1, many times the code.
        step: length of a step along a ray, in half sides of the cube around the scene's box.
        jitter_in_pictures: march from random places in pictures too, as the released code does.

    Raises:
        ValueError: where fewer fixed cameras see every instant than ``pictures`` asks for.
    """

    betas = (0.9, 0.999)  # of Adam, as published
    sees_by_camera = True
    terms = ("photo", "code_prior", "opacity_prior", "opacity_variation")

    def __init__(
        self,
        start: Start,
        *,
        pictures: int | None = None,
        picture_size: Sequence[int] = (512, 384),
        tower: Sequence[int] = (64, 64, 128, 128, 256, 256, 256),
        features: int = 512,
        code: int = 256,
        decoder: Sequence[int] = (1024, 512, 512, 256, 256, 128, 128),
        maps: int = 16,
        warp_side: int = 32,
        warp_width: int = 128,
        weight_width: int = 64,
        step: float = 4 / 256,
        from_identity: bool = False,
        first_opacity: float | None = None,
        first_deviation: float | None = None,
        jitter_in_pictures: bool = True,
    ) -> None:
        super().__init__()
        for key, first in (("opacity", first_opacity), ("deviation", first_deviation)):
            if first is not None:
                check_number(f"model.first_{key}", first, "a number > 0 or null", lambda number: number > 0)
        check_number("model.step", step, "a length in (0, 1]", lambda length: 0 < length <= 1)
        self.step, self.jitter_in_pictures = step, jitter_in_pictures
        self.from_identity = from_identity
        advice = "set it to 0.1, or another seed=N"
        if first_opacity == 0.1:
            advice = f"set another seed=N, or a smaller stage.{start.stage}.lr"
        self.dead_start = DeadStart("preset.first_opacity", "rays that are all clear or all opaque", advice)
        self.first = {"opacity": first_opacity, "deviation of the code": first_deviation}
        scene = start.scene
        self.times = scene.times
        shots = shots_of(scene, pictures)
        size = tuple(picture_size)
        self.encoder = PictureEncoder(len(shots[0]), size, tower=tower, width=features, code=code)
        self.decoder = VolumeDecoder(code, decoder)
        if first_deviation is not None:
            nn.init.constant_(self.encoder.deviation.bias, math.log(first_deviation) / _SCALE)
        if first_opacity is not None:
            nn.init.constant_(self.decoder.grow[-1].bias[3], math.log(math.expm1(first_opacity)))
        shape = {"maps": maps, "side": warp_side, "width": warp_width, "weight_width": weight_width}
        self.warp = AffineMixture(code, **shape, from_identity=from_identity)
        cameras = sorted({frame.camera_id for frame in scene.train} - {None})
        self.rows = {camera: row for row, camera in enumerate(cameras)}
        self.gain = nn.Parameter(torch.ones(len(cameras), 3)) if cameras else None
        self.bias = nn.Parameter(torch.zeros(len(cameras), 3)) if cameras else None
        self.reach = max(scene.box.size) / 2  # half a side of the cube
        self.register_buffer("center", torch.tensor(scene.box.center))
        self.register_buffer("pictures", torch.zeros(len(shots), len(shots[0]), 3, *size, dtype=torch.uint8))
        for row, frames in zip(self.pictures, () if start.blank else shots):
            for place, frame in zip(row, frames):
                place.copy_(fitted_picture(frame.load(), size))

    def encoded(self, row: int) -> tuple[Tensor, Tensor]:
        """Return a training time's code, by its number: mean, and logarithm of the deviation."""
        return self.encoder((self.pictures[row].to(self.center) - _MEAN) / _DEVIATION)

    def code_at(self, time: float) -> Tensor:
        """Return the mean code (C,) of any time."""
        before, after, share = beside(self.times, time)
        mean = self.encoded(before)[0]
        return mean if before == after else torch.lerp(mean, self.encoded(after)[0], share)

    def volumes(self, code: Tensor) -> Volumes:
        """Decode a code (C,)."""
        raw = self.decoder(code)
        color = functional.softplus(_MEAN + _DEVIATION * raw[:3]) / 255
        return Volumes(torch.cat([color, functional.softplus(raw[3:])]), self.warp(code))

    def tint(self, camera: int | None) -> Tensor | None:
        """Return what a camera makes of colour (2, 3): a factor, and what is added then (learned in 1 / 255).

        A camera that took no training picture has the mean of the others; None: no camera is known.
        """
        if self.gain is None:
            return None
        every = torch.stack([self.gain, self.bias / 255])
        return every[:, self.rows[camera]] if camera in self.rows else every.mean(1)

    def march(
        self,
        volumes: Volumes,
        rays: Rays,
        background: Tensor,
        tint: Tensor | None,
        generator: torch.Generator | None = None,
    ) -> Rendering:
        """March R rays through the cube. Opacity adds up along a ray, until it is 1.

        ``tint``: of the camera that looks (2, 3), or of each ray's (2, R, 3); see ``tint``. ``generator``
        draws where a ray begins, and the length of each step; None: as they are on average.
        """
        half, corner = self.reach, torch.ones_like(self.center)
        origins, directions = (rays.origins.to(corner) - self.center) / half, rays.directions.to(corner)
        near, far = clip_to_box(origins, directions, rays.near / half, rays.far / half, -corner, corner)
        met = (far > near).nonzero()[:, 0]
        origins, directions, near, far = origins[met], directions[met], near[met], far[met]
        count = int((1.05 * (far - near).amax() / self.step).ceil()) + 2 if len(met) else 0  # steps vary
        begin, lengths = near - 0.5 * self.step, near.new_full((len(near), count), self.step)
        if generator is not None:
            begin = near - self.step * torch.rand(near.shape, generator=generator).to(near)
            lengths = lengths * (0.01 * torch.randn(lengths.shape, generator=generator)).exp().to(near)
        depths = begin[:, None] + lengths.cumsum(1) - lengths
        inside = (depths >= near[:, None]) & (depths < far[:, None])
        row, _ = inside.nonzero(as_tuple=True)
        color, opacity = volumes.at(origins[row] + depths[inside][:, None] * directions[row])
        optical = torch.zeros_like(depths).masked_scatter(inside, opacity * lengths[inside])
        through = optical.cumsum(1).clamp(max=1)
        weights = through - functional.pad(through, (1, 0))[:, :-1]
        rgb = near.new_zeros(len(near), 3).index_add(0, row, weights[inside][:, None] * color)
        total = weights.sum(1)
        depth = half * (weights * depths).sum(1) / total.clamp(min=1e-6)
        hit = rgb, depth, total
        rgb, depth, total = (x.new_zeros(len(rays), *x.shape[1:]).index_copy(0, met, x) for x in hit)
        if tint is not None:
            rgb = rgb * tint[0] + tint[1]
        return Rendering(rgb + (1 - total)[:, None] * background.to(rgb), depth, total)

    def at(self, moment: Moment) -> VolumesSnapshot:
        """Fix the time; compute nothing yet."""
        return VolumesSnapshot(moment, self)

    def look(self, batch: Batch, factors: Mapping[str, float], generator: torch.Generator) -> Step:
        """See ``Method.look``; a batch holds one time, as no neighbours are asked for, seen by one or
        several cameras.

        Raises:
            ValueError: if every ray is clear or opaque for many steps.
        """
        rays, rgb, background = batch.joined()
        mean, deviation = self.encoded(self.times.index(batch.time))
        noise = torch.randn(mean.shape, generator=generator).to(mean)
        volumes = self.volumes(mean + deviation.exp() * noise)
        seen = self.march(volumes, rays, background, self._tints(batch), generator)
        self.dead_start.look(bool(((seen.opacity > 0) & (seen.opacity < 1)).any()))
        terms = {
            "code_prior": lambda: code_prior(mean, deviation),
            "opacity_prior": lambda: opacity_prior(seen.opacity),
            "opacity_variation": lambda: opacity_variation(volumes.template[3]),
        }
        tensors = {"code": mean, "template": volumes.template, "warp": volumes.warp, "rgb": seen.rgb}
        return self.compared(seen, rgb, terms, tensors)

    def _tints(self, batch: Batch) -> Tensor | None:
        if self.gain is None:
            return None
        seen_by = ((self.tint(one.moment.camera), len(one.view)) for one in batch.observations)
        return torch.cat([tint[:, None].expand(2, count, 3) for tint, count in seen_by], 1)

    def departures(self) -> list[str]:
        """See ``Method``."""
        notes = [f"code from {self.pictures.shape[1]} picture(s) of an instant", CENTRES, ONE_TIME]
        notes += [BETWEEN_TIMES, "no return to earlier weights where the loss jumps"]
        notes += ["the warp starts near the identity"] if self.from_identity else []
        notes += [f"first {name} {value:g}" for name, value in self.first.items() if value is not None]
        return notes + ([] if self.jitter_in_pictures else ["pictures are drawn without random steps"])

    def faults(self) -> list[str]:
        """See ``Method``."""
        kept = {
            "at first most rays are opaque (first_opacity)": self.first["opacity"] is None,
            "pictures are drawn with random steps (jitter_in_pictures)": self.jitter_in_pictures,
        }
        return those_that_hold(kept)


@dataclass(frozen=True, repr=False)
class VolumesSnapshot(RaySnapshot):
    """Such a method at one moment. An image costs decoding once, and its rays' steps."""

    @cached_property
    def _still(self) -> Volumes:
        with torch.no_grad():
            return self.volumes()

    def volumes(self) -> Volumes:
        """Decode the volumes of the moment."""
        return self.method.volumes(self.method.code_at(self.moment.time))

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        """See ``Snapshot.render``; without gradients in chunks of rays, for images of any size."""
        rays, made = view.rays(), self.method
        tint = made.tint(self.moment.camera)
        if torch.is_grad_enabled():
            return made.march(self.volumes(), rays, background, tint)
        draw = torch.Generator().manual_seed(0) if made.jitter_in_pictures else None
        behind, chunk = background.expand(len(rays), 3), max(1, int(_POINTS * made.step / 4))
        volumes = self._still
        return in_chunks(lambda c: made.march(volumes, rays[c], behind[c], tint, draw), len(rays), chunk)


def shots_of(scene: Scene, wanted: int | None) -> list[list[Frame]]:
    """Choose the pictures of each training time: by the same cameras, or one by whichever camera there is."""
    by_time = [[frame for frame in scene.train if frame.time == time] for time in scene.times]
    fixed = sorted(set.intersection(*({frame.camera_id for frame in frames} for frames in by_time)) - {None})
    there = max(len(fixed), 1)
    if wanted is not None and not 1 <= wanted <= there:
        why = f"as so many cameras took training pictures at every instant, but got {wanted}"
        raise ValueError(f"model.pictures: expected at most {there}, {why}; set model.pictures=null")
    if not fixed:
        return [frames[:1] for frames in by_time]
    chosen = [fixed[i] for i in spread(len(fixed), min(wanted or _MOST, there))]
    return [[next(f for f in frames if f.camera_id == camera) for camera in chosen] for frames in by_time]


def fitted_picture(rgba: Tensor, size: tuple[int, int]) -> Tensor:
    """Fit a picture (H, W, 4) uint8, over white, into the middle of a grey (3, *size) one."""
    alpha = rgba[..., 3:].float() / 255
    rgb = (alpha * rgba[..., :3].float() + (1 - alpha) * 255).permute(2, 0, 1)
    factor = min(size[0] / rgb.shape[1], size[1] / rgb.shape[2])
    fits = [max(1, min(most, round(side * factor))) for side, most in zip(rgb.shape[1:], size)]
    small = functional.interpolate(rgb[None], fits, mode="bilinear", antialias=True)[0]
    whole = torch.full((3, *size), int(_MEAN), dtype=torch.uint8)  # what the encoder reads as 0
    top, left = ((most - side) // 2 for most, side in zip(size, fits))
    whole[:, top : top + fits[0], left : left + fits[1]] = small.round().clamp(0, 255).to(torch.uint8)
    return whole


def code_prior(mean: Tensor, deviation: Tensor) -> Tensor:
    """Kullback-Leibler divergence of a code from a standard normal, mean over channels; ``deviation`` is the
    logarithm.
    """
    return (-0.5 - deviation + 0.5 * mean.square() + 0.5 * (2 * deviation).exp()).mean()


def opacity_prior(opacity: Tensor) -> Tensor:
    """Mean of ``log(0.1 + A) + log(1.1 - A) + 2.20727``: 0 for rays (R,) that are clear or opaque."""
    return ((0.1 + opacity).log() + (1.1 - opacity).log()).mean() + 2.20727


def opacity_variation(opacity: Tensor) -> Tensor:
    """Total variation of the logarithm of a volume's opacity (S, S, S), mean over its inner points."""
    value = (1e-5 + opacity).log()
    inner = value[:-1, :-1, :-1]
    steps = (value[1:, :-1, :-1] - inner, value[:-1, 1:, :-1] - inner, value[:-1, :-1, 1:] - inner)
    return (1e-5 + sum(step.square() for step in steps)).sqrt().mean()
