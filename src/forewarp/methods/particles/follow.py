"""Following bodies in a film: where each of them is in an image that no step has used yet.

A body is looked for from where it would be if it went on as before. It is shifted to where a small image
shows it; then damped Newton steps fit its pose to larger images. They hold back what an image tells little
about: how far away it is, and how it turns about axes across the view.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from forewarp.methods.particles.bodies import Bodies, Poses
from forewarp.methods.particles.contact import patches_of, things_on_the_ground
from forewarp.ops.gaussians import Gaussians, Warp, moved
from forewarp.ops.grid import dilate
from forewarp.scene.camera import Camera
from forewarp.scene.frame import where_seen
from forewarp.scene.view import Observation, View

if TYPE_CHECKING:
    from forewarp.methods.particles.model import Particles

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
_FARTHEST = 3.0  # times the way between the two nearest images that a body may have gone on from the first
_CELL = 0.05  # of an image's longer side: what lies within about one of a body is looked at with it
_SEEN = 0.5  # opacity from which on the ground is known


class Look(NamedTuple):
    """An image in one size: given maps (M, 12) of nodes, ``compare`` returns the gradients (M, 12) by these
    of the loss, and the loss; ``focal`` is the camera's focal length, pixels.
    """

    compare: Callable[[Tensor], tuple[Tensor, float]]
    focal: float


class Sight(NamedTuple):
    """What bodies are followed in.

    Attributes:
        eye: (3,), the centre of its camera.
        looks: returns it in all sizes, smallest first, with all that is near points (P, 3).
        patch: returns where a body may have gone by what moves in it, given all middles (B, 3); None: it may
            be where it is.
    """

    eye: Tensor
    looks: Callable[[Tensor], Sequence[Look]]
    patch: Callable[[int, Tensor], Tensor | None] = lambda body, middles: None


@torch.no_grad()
def follow(particles: Particles, seen: Observation, load_moving: Callable[[], Tensor] | None) -> None:
    """Look for where the bodies of particles are in an image; nothing is done if that was done before.

    Args:
        particles: whose bodies lead.
        seen: a whole training image.
        load_moving: gives (H, W) bool, what moves in it; None: that is not known.

    Cost: about 80 comparisons of small images with what is near bodies.
    """
    nodes, time, camera = particles.nodes, seen.moment.time, seen.view.camera
    bodies = nodes.bodies
    if bool(bodies.seen[bodies.row(time)]):
        return
    image = Sight(camera.center.to(nodes.positions), partial(_looks, particles, seen))
    moving = None if load_moving is None else load_moving()
    if moving is not None:
        image = image._replace(patch=partial(onto_patch, moving, camera))
    found = find(bodies, time, nodes.positions, image)
    if not all(bool(part.isfinite().all()) for part in found):
        found = bodies.at(time)
    bodies.put(time, found, image.eye)
    bodies.bring_before(time, _farthest(particles, seen, moving))


def find(bodies: Bodies, time: float, positions: Tensor, image: Sight) -> Poses:
    """Return where bodies are in an image of a time that was not seen, with nodes at rest ``positions``.

    It is looked for from where they would go on as before or, if that fits a small image better, from where
    they were, turning on; and from the nearest of what moves, if they were then beside all of it.
    """
    rows = bodies.seen.nonzero()[:, 0].tolist()
    near, *others = sorted(rows, key=lambda row: abs(bodies.times[row] - time))
    held = going = Poses(bodies.turns[:, near], bodies.middles[:, near])
    if others:
        before = bodies.times[others[0]]
        share = (time - before) / (bodies.times[near] - before)
        going = bodies.between(others[0], near, min(share, _FARTHEST))
    resting = Poses(going.turns, held.middles)
    patches = [(body, image.patch(body, going.middles)) for body in range(len(bodies))]
    jumps = [going.but(b, Poses(going.turns, p.expand(len(bodies), 3))) for b, p in patches if p is not None]

    motion, maps = positions.new_zeros(len(positions), 7), positions.new_zeros(len(positions), 12)
    places = []
    for way in (going, resting, *jumps):
        bodies.carry(way, positions, motion, maps)
        places.append((positions + motion[:, :3])[bodies.of_node >= 0])
    first, *looks = image.looks(torch.cat(places))

    def compared(look: Look, poses: Poses) -> tuple[Tensor, float]:
        bodies.carry(poses, positions, motion, maps)
        by_maps, loss = look.compare(maps)
        return bodies.by_twists(poses, by_maps), loss

    def found(poses: Poses) -> tuple[Poses, float]:
        poses = start = _slid(bodies, poses, image.eye, first, partial(compared, first))
        for look, steps in zip(looks, _STEPS, strict=True):
            poses, loss = _fitted(bodies, poses, start, image.eye, look, partial(compared, look), steps)
        return poses, loss

    start, least = going, compared(first, going)[1]
    for body in range(len(bodies)):
        tried = start.but(body, resting)
        if (loss := compared(first, tried)[1]) < least:
            start, least = tried, loss
    return min((found(way) for way in (start, *jumps)), key=lambda best: best[1])[0]


def _slid(bodies: Bodies, poses: Poses, eye: Tensor, look: Look, compared: Callable) -> Poses:
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
    bodies: Bodies, poses: Poses, start: Poses, eye: Tensor, look: Look, compared: Callable, steps: int
) -> tuple[Poses, float]:
    """Fit poses to an image by damped Newton steps that hold them back where they start; return the loss too.

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
    return poses, loss


def _looks(particles: Particles, seen: Observation, places: Tensor) -> list[Look]:
    """Return an image in all sizes, with the particles that are bodies' or near places (P, 3)."""
    camera, moment, skinning = seen.view.camera, seen.moment, particles.skinning
    means, _ = moved(particles.means, particles.warp(moment.time))
    near = near_places(camera, means, places)
    near |= particles.nodes.bodies.of_node[skinning.links[:, 0].long()] >= 0
    part = Gaussians(*(values[near] for values in particles.gaussians(particles.light(moment))))
    links, weights, looks = skinning.links[near], skinning.weights()[near], []
    for side in _SIDES:
        small = seen.smaller(max(1.0, max(camera.width, camera.height) / side))

        def compare(maps: Tensor, small: Observation = small) -> tuple[Tensor, float]:
            found = particles.compared(small, part, Warp(maps, links, weights), moment.time, 1.0)
            return found.maps, found.loss

        looks.append(Look(compare, small.view.camera.fx))
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


def onto_patch(moving: Tensor, camera: Camera, number: int, points: Tensor) -> Tensor | None:
    """Return where one of points (B, 3) is if shifted, as far away as it is, onto the middle of the nearest
    patch of what moves in an image, (H, W) bool, that holds no other; None if it lies on one or none is free.
    """
    row, column, seen = (part.cpu() for part in where_seen(camera, points))
    row, column = row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)
    patches = patches_of(moving)
    on = [seen & patch[row, column] for patch in patches]
    free = [patch for patch, held in zip(patches, on) if not bool(held.any())]
    if not free or any(bool(held[number]) for held in on):
        return None
    middles, point = torch.stack([patch.nonzero().float().mean(0) for patch in free]) + 0.5, points[number]
    at = camera.project(point)[0].flip(-1).cpu()
    v, u = middles[(middles - at).norm(dim=-1).argmin()]
    eye = camera.center.to(point)
    return eye + (point - eye).norm() * camera.directions(u, v).to(point)


def _farthest(particles: Particles, seen: Observation, moving: Tensor | None) -> Tensor:
    """Return how far away middles of bodies may be in an image, (B,): as what rests is right below each, or
    below the patch of what moves (H, W) that it is alone in, whichever is farther: shadows move, too.
    """
    camera, bodies, skinning = seen.view.camera, particles.nodes.bodies, particles.skinning
    share = min(1.0, _SIDES[-1] / max(camera.width, camera.height))
    camera = camera.resized(*(max(1, round(share * side)) for side in (camera.width, camera.height)))
    size = camera.height, camera.width
    whole = particles.at(seen.moment)
    rests = skinning.shares.sum(-1) == 0
    still = Warp(whole.warp.maps, whole.warp.links[rests], whole.warp.weights[rests])
    part = replace(whole, gaussians=Gaussians(*(values[rests] for values in whole.gaussians)), warp=still)
    drawn = part.render(View(camera), torch.zeros(3, device=rests.device)).shaped(*size)
    depth = torch.where(drawn.opacity > _SEEN, drawn.depth, 0.0).cpu()
    row, column, shown = where_seen(camera, moved(particles.means, whole.warp)[0])
    of = bodies.of_node[skinning.links[:, 0].long()]
    own = [shown & (of == body) & ~rests for body in range(len(bodies))]
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
