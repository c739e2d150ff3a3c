"""Tell without truth by how many degrees one may lean from where a film was taken before its images break.

A held-out image's camera is turned about what it looks at, and what the run shows there is compared with the
photo, carried over by that image's own depth. Matter that stands before what the photo shows is wrong, as
the photo would show it. What the photo does not see is left out: it may be hidden honestly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from statistics import fmean

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from forewarp.evaluation.crossed import image_at
from forewarp.methods.method import HasMovingGaussians, Method
from forewarp.scene.camera import Camera
from forewarp.scene.film import leaned
from forewarp.scene.frame import Scene, spread
from forewarp.scene.view import Rendering, Target

ANGLES = (3.0, 5.0, 7.0, 10.0, 15.0)  # degrees
_IMAGES = 4  # held out, from which one leans
# Of an angle that is good, against the first: by how large a share of pixels more may stand before what the
# photo shows, as uncertain depth does at any angle; and by how many decibels less it may be like the photo.
_FRONT, _FALL = 0.1, 3.0
_CLEAR = 30.0  # dB, from which on two images are the same: photos are interpolated
_MOST_DROP = 5.0  # dB from the own to the crossed score, from which on no angle is good
_SAME = 0.03  # share of a distance within which two are the same
_FEW = 100  # pixels that are too few to say anything
PARTS = "subject", "rest"


@torch.no_grad()
def trust_of(
    method: Method, scene: Scene, targets: Sequence[Target], numbers: Sequence[int], drop: float | None
) -> dict[str, float]:
    """Return the angles, degrees, to which images of a run are good: of what moves (``subject``), where masks
    tell it, of the ``rest``, and the smaller one, ``degrees``; at most the last of ``ANGLES``.

    Args:
        method: the fitted method.
        scene: its scene.
        targets: the held-out images.
        numbers: those of them that may be used.
        drop: from the own to the crossed score, dB (``crossed.drop_of``); None: not known.

    Returns:
        the angles; {} for methods that are not made of Gaussians, and scenes that are cut out.

    Cost: some 40 images.
    """
    if scene.has_alpha or not isinstance(method, HasMovingGaussians):
        return {}
    found: dict[str, list[list[tuple[float, float]]]] = {part: [[] for _ in ANGLES] for part in PARTS}
    for target, plain, camera, angle in leaned_views(method, targets, numbers):
        for part, seen in compared(method, target, plain, camera).items():
            found[part][ANGLES.index(angle)].append(seen)
    angles = {part: angle_of(seen) for part, seen in found.items() if all(seen)}
    if drop is not None and drop > _MOST_DROP:
        angles = dict.fromkeys(angles, 0.0)
    return {"degrees": min(angles.values()), **angles} if angles else {}


def leaned_views(
    method: Method, targets: Sequence[Target], numbers: Sequence[int]
) -> Iterator[tuple[Target, Rendering, Camera, float]]:
    """Give some of the images, what the method shows from where they were taken, and cameras that lean from
    there by each of ``ANGLES``: to both sides, of every second image up and down.
    """
    for turn, i in enumerate(spread(len(numbers), _IMAGES)):
        target = targets[numbers[i]]
        plain = image_at(method, target.frame, target.frame.time, target.background.to(method.device))
        pivot = pivot_of(target, plain)
        for angle in ANGLES:
            for degrees in (-angle, angle):
                across, upward = (0.0, degrees) if turn % 2 else (degrees, 0.0)
                yield target, plain, leaned(target.frame.camera, pivot, across, upward), angle


def pivot_of(target: Target, drawn: Rendering) -> Tensor:
    """Return the point (3,) on a camera's axis as far away as what moves in its image, else as all of it."""
    camera, depth = target.frame.camera, drawn.depth
    if target.moving is not None and int(target.moving.sum()) >= _FEW:
        depth = depth[target.moving]
    middle = torch.tensor([camera.width / 2]), torch.tensor([camera.height / 2])
    return camera.center + float(depth.median()) * camera.directions(*middle)[0]


def compared(
    method: Method, target: Target, plain: Rendering, camera: Camera
) -> dict[str, tuple[float, float]]:
    """Compare what a leaned camera sees with a photo: by part the PSNR of what the photo shows too, and the
    share of pixels that stand before it.

    Args:
        method: the fitted method.
        target: the photo.
        plain: what the method shows from where it was taken.
        camera: the leaned one.
    """
    filmed, size = target.frame.camera, (camera.height, camera.width)
    drawn = image_at(method, target.frame, target.frame.time, target.background.to(method.device), camera)
    rays = camera.rays()
    places = rays.origins + drawn.depth.reshape(-1, 1) * rays.directions
    pixels, ahead = filmed.project(places)
    grid = 2 * pixels / pixels.new_tensor([filmed.width, filmed.height]) - 1
    inside = ((grid.abs() < 1).all(-1) & (ahead > 0)).reshape(size) & (drawn.depth > 0)
    grid = grid.float().nan_to_num(2.0).reshape(1, *size, 2)

    def carried(planes: Tensor, mode: str = "bilinear") -> Tensor:
        return grid_sample(planes[None].float(), grid, mode=mode, align_corners=False)[0]

    photo = carried(target.rgb.permute(2, 0, 1)).permute(1, 2, 0)
    stands = carried(plain.depth[None])[0]
    away = (places - filmed.center.to(places)).norm(dim=-1).reshape(size)
    front, behind = away < (1 - _SAME) * stands, away > (1 + _SAME) * stands
    moving = torch.zeros(target.rgb.shape[:2]) if target.moving is None else target.moving
    subject = carried(moving[None], "nearest")[0] > 0.5
    if target.valid is not None:
        inside &= carried(target.valid[None], "nearest")[0] > 0.5
    error, found = (drawn.rgb - photo).square().mean(-1), {}
    for part, chosen in zip(PARTS, (inside & subject, inside & ~subject)):
        shown = chosen & ~behind
        if int(shown.sum()) >= _FEW:
            decibels = -10 * math.log10(max(float(error[shown].mean()), 1e-10))
            found[part] = decibels, float((chosen & front).sum() / chosen.sum())
    return found


def angle_of(seen: Sequence[Sequence[tuple[float, float]]]) -> float:
    """Return the angle, degrees, up to which images are good, from what was seen at each of ``ANGLES``.

    >>> angle_of([[(25.0, 0.02)], [(24.0, 0.05)], [(23.0, 0.15)], [(20.0, 0.3)], [(18.0, 0.4)]])
    6.4
    """
    first = fmean(min(decibels, _CLEAR) for decibels, _ in seen[0])
    uncertain = fmean(front for _, front in seen[0])
    before, worse_before = 0.0, 0.0
    for angle, images in zip(ANGLES, seen):
        fall = first - fmean(min(decibels, _CLEAR) for decibels, _ in images)
        more = fmean(front for _, front in images) - uncertain
        worse = max(more / _FRONT, fall / _FALL)  # 1 where it is no longer good
        if worse > 1:
            return round(before + (angle - before) * (1 - worse_before) / (worse - worse_before), 1)
        before, worse_before = angle, worse
    return ANGLES[-1]
