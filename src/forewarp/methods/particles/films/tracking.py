"""Following bodies in a film: where each of them is in an image that no step has used yet.

A body is looked for from where it would be if it went on as before, or where what the nearest image shows of
it is seen again. It is shifted to where a small image shows it; then damped Newton steps fit its pose to
larger images. They hold back what an image tells little about: how far away it is, and how it turns about
axes across the view. Once its shape is known, how large an image shows it tells how far away it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from forewarp.methods.particles.films.bodies import Bodies, Poses
from forewarp.methods.particles.films.contact import known_depth, things_on_the_ground
from forewarp.methods.particles.hooks import Trained, TrainingHook
from forewarp.methods.particles.nodes import Nodes
from forewarp.ops.gaussians import Gaussians, Warp, moved
from forewarp.ops.grid import dilate
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame, where_seen
from forewarp.scene.view import Observation, View

_SIDES = 100, 200, 400  # pixels of the longer side of an image as it is looked at
_SLIDES, _FALL = 10, 0.1  # steps in the first: of a pixel, that fall to this share of it
_MEAN, _SQUARE = 0.8, 0.9  # of the averages of their gradients, from step to step
_STEPS = 3, 2  # Newton steps in the others
_APART = 0.5  # pixels, by which gradients are apart whose difference is a second derivative
_LONGEST = 3.0  # pixels, of a step
_SHORTER = 1.0, 0.4  # shares of a step that are tried in turn
# How much turns, shifts along the ray and all are held back, by the curvature of shifts across the ray.
_TURN, _RAY, _ANY = 0.4, 10.0, 1e-2
_TINY = 1e-6
_ROUNDS = 4  # of fitting distances while bodies lead, the first of them none: shapes are not known yet
_PROBE, _MOST = 0.04, 0.08  # shares of its distance by which a body is moved to see, and at most
# Of an image's longer side, how far around a body is looked for in it; and times the way that it would go on.
_REACH, _FASTER = 0.05, 1.5
_FARTHEST_OFF, _ALIKE = 0.25, 0.3  # of that side, how far at most; the least correlation
_FARTHEST = 3.0  # times the way between the two nearest images that a body may have gone on from the first
_CELL = 0.05  # of an image's longer side: what lies within about one of a body is looked at with it


class PyramidLevel(NamedTuple):
    """An image in one size: given maps (M, 12) of nodes, ``compare`` returns the gradients (M, 12) by these
    of the loss, and the loss; ``focal`` is the camera's focal length, pixels.
    """

    compare: Callable[[Tensor], tuple[Tensor, float]]
    focal: float


class TrackingView(NamedTuple):
    """What bodies are followed in.

    Attributes:
        eye: (3,), the centre of its camera.
        looks: returns it in all sizes, smallest first, with all that is near points (P, 3).
        again: looks in it for what the image of a row shows of bodies, given where they would go on, and
            returns poses there.
    """

    eye: Tensor
    looks: Callable[[Tensor], Sequence[PyramidLevel]]
    again: Callable[[int, Poses], Poses]


class BodyTracking(TrainingHook):
    """Move ``bodies`` of nodes by their poses, up to a share ``until`` of the stage; then fit the curves.

    Args:
        nodes: in groups, each a body.
        times: of training images, distinct.
        until: share of the stage, > 0.
    """

    def __init__(self, nodes: Nodes, times: Sequence[float], until: float) -> None:
        super().__init__()
        self.bodies, self.until = Bodies(nodes, times), until

    @property
    def leads(self) -> bool:
        """See ``TrainingHook``."""
        return bool(self.bodies.lead)

    def move(self, time: float, motion: Tensor, maps: Tensor) -> None:
        """See ``TrainingHook``."""
        self.bodies.carry(self.bodies.at(time), self.bodies.nodes.positions, motion, maps)

    def gradients(self, time: float, by_maps: Tensor) -> dict[str, Tensor]:
        """See ``TrainingHook``."""
        return {"bodies.twists": self.bodies.gradients(time, by_maps)}

    def after_step(self) -> None:
        """See ``TrainingHook``."""
        self.bodies.settle()

    def fit_curves(self, nodes: Nodes) -> None:
        """See ``TrainingHook``."""
        self.bodies.fit_curves(nodes)

    def param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """See ``TrainingHook``."""
        return {"node_bodies": [self.bodies.twists]}

    def update(self, particles: Trained, progress: float) -> None:
        """See ``TrainingHook``."""
        if progress >= self.until:
            self.put_on_ground(particles)
            self.bodies.fit_curves(self.bodies.nodes)
            self.bodies.lead.fill_(False)

    @torch.no_grad()
    def before_image(self, particles: Trained, seen: Observation) -> None:
        """Look for where bodies are in an image; if that was done, fit their distances at times.

        Cost: about 80 comparisons of small images with what is near bodies; two images are loaded.
        """
        bodies, time, camera = self.bodies, seen.moment.time, seen.view.camera
        row, number = bodies.row(time), int(_ROUNDS * particles.progress / self.until)
        known, late = bool(bodies.seen[row]), int(bodies.rounds[row]) < number
        # At the canonical time they are where they were set down.
        late &= row != bodies.row(bodies.nodes.curve.canonical_time)
        bodies.rounds[row] = number
        if known:
            if late:
                _refit(bodies, particles, seen)
            return
        again = partial(_again, bodies, particles, particles.frames, time)
        eye = camera.center.to(bodies.nodes.positions)
        image = TrackingView(eye, partial(_looks, bodies, particles, seen), again)
        found = find(bodies, time, bodies.nodes.positions, image)
        if not all(bool(part.isfinite().all()) for part in found):
            found = bodies.at(time)
        bodies.put(time, found, image.eye)
        if late:
            _refit(bodies, particles, seen)
        load_moving = particles.frames[time].load_moving
        moving = None if load_moving is None else load_moving()
        bodies.bring_before(time, _farthest(bodies, particles, seen, moving))

    @torch.no_grad()
    def put_on_ground(self, particles: Trained) -> None:
        """Make bodies as much larger and farther away as they can be before what rests below them: images
        tell how their distances compare, and little about how far away all of them are.
        """
        gaussians, bodies, nodes = particles.gaussians, self.bodies, self.bodies.nodes
        of, canonical = body_of(particles), bodies.row(nodes.curve.canonical_time)
        eye = _frame_at(particles.frames, bodies.times[canonical]).camera.center.to(bodies.eyes)
        times, bodies.eyes[canonical] = bodies.nearest_to_ground(), eye
        bodies.enlarge(times, eye)
        own, by = of >= 0, bodies.of_node >= 0
        gaussians.means[own] = eye + times[of[own], None] * (gaussians.means[own] - eye)
        gaussians.scales[own] += times[of[own], None].log()
        nodes.positions[by] = eye + times[bodies.of_node[by], None] * (nodes.positions[by] - eye)
        nodes.spacing[by] *= times[bodies.of_node[by]]


def body_tracking(nodes: Nodes, times: Sequence[float], until: float) -> BodyTracking | None:
    """Return what tracks the bodies that groups of nodes are; None where nodes have no groups."""
    return None if nodes.groups is None else BodyTracking(nodes, times, until)


def find(bodies: Bodies, time: float, positions: Tensor, image: TrackingView) -> Poses:
    """Return where bodies are in an image of a time that was not seen, with nodes at rest ``positions``.

    They are looked for where they would go on as before or, if that fits a small image better, where they
    were, turning on, or are seen again.
    """
    rows = bodies.seen.nonzero()[:, 0].tolist()
    near, *others = sorted(rows, key=lambda row: abs(bodies.times[row] - time))
    held = going = Poses(bodies.turns[:, near], bodies.middles[:, near])
    if others:
        before = bodies.times[others[0]]
        share = (time - before) / (bodies.times[near] - before)
        going = bodies.between(others[0], near, min(share, _FARTHEST))
    resting = Poses(going.turns, held.middles)
    again = image.again(near, going)

    places = [_carried(bodies, way, positions)[0] for way in (going, resting, again)]
    first, *looks = image.looks(torch.cat(places))

    def compared(look: PyramidLevel, poses: Poses) -> tuple[Tensor, float]:
        by_maps, loss = look.compare(_carried(bodies, poses, positions)[1])
        return bodies.by_twists(poses, by_maps), loss

    start, least = going, compared(first, going)[1]
    for body in range(len(bodies)):
        for way in (resting, again):
            tried = start.but(body, way)
            if (loss := compared(first, tried)[1]) < least:
                start, least = tried, loss
    poses = start = _slid(bodies, start, image.eye, first, partial(compared, first))
    for look, steps in zip(looks, _STEPS, strict=True):
        poses = _fitted(bodies, poses, start, image.eye, look, partial(compared, look), steps)
    return poses


def fit_distances(poses: Poses, eye: Tensor, compared: Callable[[Poses], float]) -> Poses:
    """Move bodies along their rays from an eye (3,) to where an image shows them in their size: the best of
    four places, which are nearer, as it is, farther, and where a parabola through these losses is lowest or,
    if they bend down, the way they fall; at most ``_MOST`` of its distance away.

    Args:
        poses: of bodies.
        eye: from where they are seen.
        compared: returns the loss of the image.
    """
    now = compared(poses)
    for body in range(len(poses.middles)):
        places = [poses.farther(body, eye, times) for times in (1 - _PROBE, 1 + _PROBE)]
        near, far = losses = [compared(place) for place in places]
        bend = near + far - 2 * now
        step = 0.5 * _PROBE * (near - far) / bend if bend > 0 else math.copysign(_MOST, near - far)
        places.append(poses.farther(body, eye, 1 + min(max(step, -_MOST), _MOST)))
        losses.append(compared(places[-1]))
        for place, loss in zip(places, losses, strict=True):
            if loss < now:
                poses, now = place, loss
    return poses


def _refit(bodies: Bodies, particles: Trained, seen: Observation) -> None:
    """Fit distances of bodies to an image in which they were found."""
    positions, time = bodies.nodes.positions, seen.moment.time
    poses, eye = bodies.at(time), seen.view.camera.center.to(positions)
    (look,) = _looks(bodies, particles, seen, _carried(bodies, poses, positions)[0], _SIDES[-1:])

    def compared(poses: Poses) -> float:
        return look.compare(_carried(bodies, poses, positions)[1])[1]

    bodies.put(time, fit_distances(poses, eye, compared), eye)


def _carried(bodies: Bodies, poses: Poses, positions: Tensor) -> tuple[Tensor, Tensor]:
    """Return where poses take the nodes (P, 3) of bodies, and the maps (M, 12) of all nodes, at rest at
    ``positions`` (M, 3).
    """
    motion, maps = positions.new_zeros(len(positions), 7), positions.new_zeros(len(positions), 12)
    bodies.carry(poses, positions, motion, maps)
    return (positions + motion[:, :3])[bodies.of_node >= 0], maps


def _slid(bodies: Bodies, poses: Poses, eye: Tensor, look: PyramidLevel, compared: Callable) -> Poses:
    """Shift bodies to where a small image shows them: by steps along the gradients, as of Adam, but of one
    length in all directions.
    """
    mean, square = eye.new_zeros(len(bodies), 3), eye.new_zeros(len(bodies), 1)
    for step in range(_SLIDES):
        gradient, done = compared(poses)[0][:, 3:], step + 1
        mean = _MEAN * mean + (1 - _MEAN) * gradient
        square = _SQUARE * square + (1 - _SQUARE) * gradient.square().sum(-1, keepdim=True)
        pixel = (poses.middles - eye).norm(dim=-1, keepdim=True) / look.focal
        length = pixel * (1 - (1 - _FALL) * step / _SLIDES) / (square / (1 - _SQUARE**done)).sqrt().add(1e-15)
        poses = Poses(poses.turns, poses.middles - length * mean / (1 - _MEAN**done))
    return poses


def _fitted(
    bodies: Bodies,
    poses: Poses,
    start: Poses,
    eye: Tensor,
    look: PyramidLevel,
    compared: Callable,
    steps: int,
) -> Poses:
    """Fit poses to an image by damped Newton steps that hold them back where they start.

    Second derivatives are differences of gradients.
    """
    away = poses.middles - eye
    pixel = away.norm(dim=-1, keepdim=True) / look.focal
    ray = torch.nn.functional.normalize(away, dim=-1)
    along = ray[:, :, None] * ray[:, None]
    across = torch.eye(3).to(eye) - along
    axes = torch.eye(6).to(eye)
    gradient, loss = compared(poses)
    for _ in range(steps):
        beside_it = [bodies.moved(poses, _APART * pixel * axis) for axis in axes]
        second = torch.stack([(compared(p)[0] - gradient) / (_APART * pixel) for p in beside_it], -1)
        if not bool(second.isfinite().all()):
            break  # training tells of broken numbers
        second = 0.5 * (second + second.mT)
        values, vectors = torch.linalg.eigh(second)
        second = vectors @ torch.diag_embed(values.clamp(min=0)) @ vectors.mT
        lateral = (across @ second[:, 3:, 3:] @ across).diagonal(dim1=1, dim2=2).sum(-1) / 2
        unit = lateral.maximum(1e-3 * values.abs().amax(-1)).clamp(min=_TINY)[:, None, None]
        hold = torch.zeros_like(second)
        hold[:, :3, :3] = _TURN * unit * axes[:3, :3]
        hold[:, 3:, 3:] = _RAY * unit * along
        off = bodies.apart(poses, start)
        pull = (hold @ off[..., None])[..., 0]
        way = -torch.linalg.solve(second + hold + _ANY * unit * axes, gradient + pull)
        longest = way.reshape(-1, 2, 3).norm(dim=-1).amax(-1, keepdim=True)
        way = way * (_LONGEST * pixel / longest.clamp(min=_TINY * float(pixel.amax()))).clamp(max=1.0)
        before = loss + 0.5 * float((off * pull).sum())
        for share in _SHORTER:
            tried = bodies.moved(poses, share * way)
            found, its = compared(tried)
            off = bodies.apart(tried, start)
            if its + 0.5 * float((off * (hold @ off[..., None])[..., 0]).sum()) < before:
                poses, gradient, loss = tried, found, its
                break
        else:
            break
    return poses


def _looks(
    bodies: Bodies,
    particles: Trained,
    seen: Observation,
    places: Tensor,
    sides: Sequence[int] = _SIDES,
) -> list[PyramidLevel]:
    """Return an image in some sizes, with the particles that are bodies' or near places (P, 3)."""
    camera, moment, skinning = seen.view.camera, seen.moment, particles.deformation.skinning
    means, _ = moved(particles.gaussians.means, particles.warp(moment.time))
    near = near_places(camera, means, places)
    near |= body_of(particles) >= 0
    part = Gaussians(*(values[near] for values in particles.gaussians.joined(particles.light(moment))))
    links, weights, looks = skinning.links[near], skinning.weights()[near], []
    for side in sides:
        small = seen.smaller(max(1.0, max(camera.width, camera.height) / side))

        def compare(maps: Tensor, small: Observation = small) -> tuple[Tensor, float]:
            found = particles.compared(small, part, Warp(maps, links, weights), moment.time, 1.0)
            return found.maps, found.loss

        looks.append(PyramidLevel(compare, small.view.camera.fx))
    return looks


def near_places(camera: Camera, points: Tensor, places: Tensor) -> Tensor:
    """Return which points (N, 3) an image shows within about a ``_CELL`` of places (P, 3): bool (N,)."""
    cell = math.ceil(_CELL * max(camera.width, camera.height))
    size = -(-camera.height // cell), -(-camera.width // cell)
    near = torch.zeros(size, dtype=torch.bool, device=points.device)
    row, column, seen = where_seen(camera, places)
    near[row[seen] // cell, column[seen] // cell] = True
    row, column, seen = where_seen(camera, points)
    near = dilate(near)
    return seen & near[row.clamp(0, camera.height - 1) // cell, column.clamp(0, camera.width - 1) // cell]


def _again(
    bodies: Bodies, particles: Trained, frames: Mapping[float, Frame], time: float, row: int, going: Poses
) -> Poses:
    """Look in the image of a time for what that of a row shows of bodies, around where they then were; the
    farther around, the farther they would be if they went on. Return poses turned as they would be, as far
    from the new eye as they were; what is not found stays where it was.
    """
    gaussians = particles.gaussians
    held = Poses(bodies.turns[:, row], bodies.middles[:, row])
    (image, camera), (other, after) = _small(_frame_at(frames, bodies.times[row])), _small(frames[time])
    of, eye, found = body_of(particles), after.center.to(held.middles), Poses(going.turns, held.middles)
    was, here, there = (
        view.project(middles)[0].cpu()
        for view, middles in ((camera, held.middles), (after, held.middles), (after, going.middles))
    )
    for body in range(len(bodies)):
        own = (of == body) & (gaussians.opacity[:, 0] > 0)
        points = (gaussians.means[own] - bodies.rest[body]) @ held.turns[body].T + held.middles[body]
        rows, columns, seen = (part.cpu() for part in where_seen(camera, points))
        mask = torch.zeros(image.shape, dtype=torch.bool)
        mask[rows[seen], columns[seen]] = True
        reach = _REACH * max(image.shape) + _FASTER * float((there - here)[body].norm())
        reach = math.ceil(min(_FARTHEST_OFF * max(image.shape), reach))
        shift = find_shift(image, dilate(mask), other, (here - was)[body].round().long(), reach)
        if shift is not None:
            ray = after.directions(*(was[body] + shift)).to(eye)
            middle = eye + (held.middles[body] - eye).norm() * ray
            found = found.but(body, Poses(going.turns, middle.expand_as(held.middles)))
    return found


def body_of(particles: Trained) -> Tensor:
    """Return the body that each particle is of, (N,); -1: of none, or at rest."""
    skinning = particles.deformation.skinning
    of = particles.deformation.nodes.groups[skinning.links[:, 0].long()]
    return of.where(skinning.shares.sum(-1) > 0, -1)


def _frame_at(frames: Mapping[float, Frame], time: float) -> Frame:
    """Return the frame nearest to a time."""
    return frames[min(frames, key=lambda other: abs(other - time))]


def _small(frame: Frame) -> tuple[Tensor, Camera]:
    """Return a frame's image in grey (h, w), as large as the largest that is looked at, and its camera."""
    camera = _shrunk(frame.camera)
    grey = frame.load()[..., :3].float().mean(-1) / 255
    size = camera.height, camera.width
    return torch.nn.functional.interpolate(grey[None, None], size, mode="area")[0, 0], camera


def _shrunk(camera: Camera) -> Camera:
    """Return a camera of as large images as the largest that are looked at."""
    share = min(1.0, _SIDES[-1] / max(camera.width, camera.height))
    return camera.resized(*(max(1, round(share * side)) for side in (camera.width, camera.height)))


def find_shift(image: Tensor, mask: Tensor, other: Tensor, around: Tensor, reach: int) -> Tensor | None:
    """Find by how far what an image (H, W) shows in a mask (H, W) is shifted in another one (h, w): to where
    both correlate best, whatever their light, and half of the mask is inside.

    Args:
        image, mask, other: the images, and what is looked for.
        around: (2,) int64, x and y: a shift.
        reach: by how many pixels at most it may differ from that.

    Returns:
        (2,) int64, x and y; None if nothing is alike.
    """
    if not bool(mask.any()):
        return None
    (top, left), (bottom, right) = (f(mask.nonzero(), 0) for f in (torch.amin, torch.amax))
    part, inside = (values[top : bottom + 1, left : right + 1].float() for values in (image, mask))
    columns, rows = (
        torch.arange(int(low + off) - reach, int(high + off) + reach + 1)
        for low, high, off in zip((left, top), (right, bottom), around)
    )
    field = other[rows.clamp(0, len(other) - 1)][:, columns.clamp(0, other.shape[1] - 1)]
    is_inside = ((rows >= 0) & (rows < len(other)))[:, None] & (columns >= 0) & (columns < other.shape[1])

    def summed(values: Tensor, kernel: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(values[None, None], kernel[None, None])[0, 0]

    part = (part - (part * inside).sum() / inside.sum()) * inside
    spread = summed(field.square(), inside) - summed(field, inside).square() / inside.sum()
    alike = summed(field, part) / (spread.clamp(min=_TINY).sqrt() * part.norm().clamp(min=_TINY))
    alike = alike.where(summed(is_inside.float(), inside) >= 0.5 * inside.sum(), -1.0)
    row, column = divmod(int(alike.argmax()), alike.shape[1])
    if float(alike[row, column]) < _ALIKE:
        return None
    return around + torch.tensor([column - reach, row - reach])


def _farthest(bodies: Bodies, particles: Trained, seen: Observation, moving: Tensor | None) -> Tensor:
    """Return how far away middles of bodies may be in an image, (B,): as what rests is right below each, or
    below the patch of what moves (H, W) that it is alone in, whichever is farther: shadows move, too.
    """
    skinning = particles.deformation.skinning
    camera = _shrunk(seen.view.camera)
    size = camera.height, camera.width
    whole = particles.at(seen.moment)
    rests = skinning.shares.sum(-1) == 0
    still = Warp(whole.warp.maps, whole.warp.links[rests], whole.warp.weights[rests])
    part = replace(whole, gaussians=Gaussians(*(values[rests] for values in whole.gaussians)), warp=still)
    drawn = part.render(View(camera), torch.zeros(3, device=rests.device)).shaped(*size)
    depth = known_depth(drawn).cpu()
    row, column, shown = where_seen(camera, moved(particles.gaussians.means, whole.warp)[0])
    of = body_of(particles)
    own = [shown & (of == body) for body in range(len(bodies))]
    masks = torch.zeros(len(bodies), *size, dtype=torch.bool)
    for mask, which in zip(masks, own):
        mask[row[which].cpu(), column[which].cpu()] = True
    found = torch.full((len(bodies),), -torch.inf)
    for body, mask in enumerate(masks):
        for _, distance in things_on_the_ground(dilate(mask), depth):
            found[body] = max(float(found[body]), distance)
    if moving is not None:
        moving = torch.nn.functional.interpolate(moving[None, None].float(), size, mode="nearest")[0, 0] > 0
        for thing, distance in things_on_the_ground(moving, depth):
            inside = (masks & thing).sum((1, 2)) > 0.5 * masks.sum((1, 2)).clamp(min=1)
            if int(inside.sum()) == 1:
                found[inside] = found[inside].clamp(min=distance)
    return torch.where(found.isinf(), torch.inf, found).to(bodies.middles)
