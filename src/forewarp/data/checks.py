"""Doubt a scene before it is trained on: what its cameras, box, alpha, masks and points say of each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from forewarp.data.cameras import nine_pixels
from forewarp.data.files import mismatch
from forewarp.data.transforms import common_point
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, focus_point
from forewarp.scene.frame import Scene, sightings, spread

_LOOKED_AT = 8  # training images whose alpha is looked at
_PIXELS = 4000  # of each
_OPAQUE = 127  # alpha above it is of the subject
_EDGE, _LEFT_OUT = 0.9, 0.02  # shares of an inverted image: subject along its edges, background at least
_CUT_OFF, _FEW = 0.1, 0.5  # share of the subject beyond the box; of pixels and points that is too few


def remarks(scene: Scene) -> Iterator[str]:
    """Say what in a scene is probably not what was meant, a line each, with what mends it.

    That is a range or box without the point that all cameras look at, or without a part of the subject;
    inverted, empty or opaque alpha and masks; masks that leave little; points that no camera sees.

    Raises:
        SceneError: if no image that is looked at shows anything.

    Cost: eight training images are decoded, which training does anyway.
    """
    aim = common_point([frame.camera.camera_to_world for frame in scene.train])
    if aim is not None:
        yield from _aimed(scene, aim)
    if scene.has_alpha:
        yield from _silhouettes(scene)
    if masked := [frame.load_valid for frame in scene.train if frame.load_valid is not None]:
        share = sum(float(masked[i]().float().mean()) for i in spread(len(masked), _LOOKED_AT))
        share /= min(len(masked), _LOOKED_AT)
        if share < _FEW:
            yield (
                f"masks leave {share:.0%} of the pixels to train on; if dark is what lies beside the "
                "subject, set data.masks=alpha, if it is the subject, invert them"
            )
    if scene.still is not None:
        cameras = [scene.train[i].camera for i in spread(len(scene.train), 8 * _LOOKED_AT)]
        some = scene.still[:: max(1, len(scene.still) // _PIXELS)].double()
        seen = sightings(some, cameras, [torch.ones(c.height, c.width) > 0 for c in cameras])[1]
        if (share := float((seen > 0).double().mean())) < _FEW:
            yield (
                f"training cameras see {share:.0%} of the {len(scene.still)} points that never move, as if "
                "they were in other units or axes; remove them, or write them anew"
            )


def _aimed(scene: Scene, aim: Tensor) -> Iterator[str]:
    """Compare near, far and the box with the point (3,) that the cameras look at, in the file's units."""
    point = f"the point that all cameras look at, {_in_file(scene, aim.tolist())},"
    cameras = [frame.camera for frame in scene.train]
    away = torch.stack([(aim - camera.center).norm() for camera in cameras])
    near, far = (torch.tensor([getattr(camera, end) for camera in cameras]) for end in ("near", "far"))
    for key, bound, beyond in (("near", near, away < near), ("far", far, away > far)):
        if float(beyond.double().mean()) > _FEW:
            distance, at = (_length(scene, float(values.median())) for values in (away, bound))
            yield f"{point} is {distance} away, with {key} at {at}; set data.{key}, or mend the file's"
    if not scene.box.scaled(2).holds(aim):
        yield f"{point} lies far outside the box {_bounds(scene)}; set data.box=null"


def _bounds(scene: Scene) -> str:
    """Write the box, in the file's units."""
    return f"{_in_file(scene, scene.box.low)} to {_in_file(scene, scene.box.high)}"


def _length(scene: Scene, length: float) -> str:
    """Write a length of the scene in the file's units."""
    return f"{length / scene.protocol.get('normalisation', {'scale': 1.0})['scale']:.4g}"


def _in_file(scene: Scene, place: Sequence[float]) -> str:
    """Write a place (3,) of the scene in the file's units."""
    file = scene.protocol.get("normalisation", {"center": [0, 0, 0], "scale": 1.0})
    values = (value / file["scale"] + middle for value, middle in zip(place, file["center"]))
    return f"({', '.join(f'{round(value, 9) + 0.0:.4g}' for value in values)})"


def _silhouettes(scene: Scene) -> Iterator[str]:
    """Look at the alpha of a few training images: does it cut out a subject, and is that in the box?"""
    frames = [scene.train[i] for i in spread(len(scene.train), _LOOKED_AT)]
    solid = [frame.load()[..., 3] > _OPAQUE for frame in frames]
    empty = [not bool(mask.any()) for mask in solid]
    if all(empty):
        expected, got = "a subject in some training images", f"none in {len(frames)} of them"
        raise mismatch(frames[0].name, expected, got, "alpha, or masks, are dark everywhere")
    if sum(empty) > _FEW * len(frames):
        yield f"{sum(empty)} of {len(frames)} training images looked at show no subject; mend alpha or masks"
    if all(bool(mask.all()) for mask in solid):
        yield "alpha is opaque in all training images looked at: cut the subject out, or leave alpha out"
    turned = [_is_inverted(mask) for mask in solid]
    if sum(turned) > _FEW * len(frames):
        yield (
            f"in {sum(turned)} of {len(frames)} training images looked at the subject fills all edges, as if "
            "alpha or masks were inverted; invert them"
        )
        return
    missed = total = 0
    for frame, mask in zip(frames, solid):
        pixels = mask.flatten().nonzero()[:, 0]
        pixels = pixels[:: max(1, len(pixels) // _PIXELS)]
        missed, total = missed + int((~meets(frame.camera, scene.box, pixels)).sum()), total + len(pixels)
    if missed > _CUT_OFF * total:
        yield (
            f"{missed / total:.0%} of the subject's pixels see nothing of the box {_bounds(scene)} between "
            "near and far; widen data.box, data.near, data.far, or set them to null"
        )


def _is_inverted(solid: Tensor) -> bool:
    """Tell whether a silhouette (H, W) fills the image's edges and leaves something else out."""
    edges = torch.cat([solid[0], solid[-1], solid[:, 0], solid[:, -1]]).float()
    return float(edges.mean()) > _EDGE and float(solid.float().mean()) < 1 - _LEFT_OUT


def meets(camera: Camera, box: Box, pixels: Tensor) -> Tensor:
    """Tell which pixels, flat indices (P,), see something of a box between near and far: bool (P,)."""
    low, high = (torch.tensor(end, dtype=torch.float64) for end in (box.low, box.high))
    rays = camera.rays(pixels, dtype=torch.float64)
    slabs = torch.stack([(end - rays.origins) / rays.directions for end in (low, high)])
    enter = slabs.amin(0).nan_to_num(-torch.inf).amax(-1).clamp(min=camera.near)
    leave = slabs.amax(0).nan_to_num(torch.inf).amin(-1).clamp(max=camera.far)
    return enter < leave


def check_seen(scene: Scene) -> None:
    """Refuse a box that no training camera sees between its near and far planes.

    Raises:
        SceneError: saying what the cameras look at.
    """
    if blind_frames(scene) < len(scene.train):
        return
    focus = focus_point([frame.camera for frame in scene.train]).tolist()
    near, far = (_length(scene, getattr(scene.train[0].camera, end)) for end in ("near", "far"))
    raise mismatch(
        "data.box, data.near, data.far",
        "a box that cameras see between near and far",
        f"{_bounds(scene)}, near {near}, far {far}; cameras look at {_in_file(scene, focus)}",
        "set data.box=null data.near=null data.far=null, or mend what they are of, as points in other units",
    )


def blind_frames(scene: Scene) -> int:
    """Count the training frames whose camera sees nothing of the box between its near and far planes."""
    cameras = (frame.camera for frame in scene.train)
    return sum(not bool(meets(camera, scene.box, nine_pixels(camera)).any()) for camera in cameras)
