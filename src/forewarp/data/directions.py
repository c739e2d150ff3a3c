"""Tell by what cameras look at whether their poses were written in another way than they are read."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations

import torch

from forewarp.data.cameras import FLIP
from forewarp.data.files import mismatch

_Change = Callable[[torch.Tensor], torch.Tensor]  # of poses (N, 4, 4)
_LEAST_CAMERAS = 4  # of which can be told whether they look at something in common
_ALL = 0.9  # share of cameras before which a common point must lie
_MET = 0.05  # miss of axes that meet where a program made all cameras look
_RISE = 0.05  # sine of the angle by which cameras are above or below what they look at
_KEEP = "set data.axes=opengl if they are right"
_OUTWARDS = "set data.axes=opencv, or data.axes=opengl if they do look outwards"
_CONVERT = "convert poses of Unity (left-handed) or PyTorch3D (docs/own-data.md)"
_MEET, _MISS = 0.15, 0.5  # miss of the axes in shares of the distance: they meet in a point, they do not
_CLOSER = 5.0  # times as close axes meet in another way, from which on it is likelier
_BOTH = f"cameras look at about one thing, and {_CLOSER:g} times closer or more if {{}}"


def check_directions(
    poses: Sequence[torch.Tensor], where: str, *, inverse: bool, advice: str = ""
) -> list[str]:
    """Refuse poses that make sense only if they were written in another way than assumed; say in a line where
    they make more sense so.

    Args:
        poses: as ``transforms.pose_in`` reads them where ``data.axes`` is null.
        where: the file, for errors.
        inverse: whether they were taken for world-to-camera matrices.
        advice: what to do, where keys would not mend it.

    Raises:
        SceneError: if all cameras look away from one point, as OpenCV's axes read as OpenGL's do, or have
            nothing in common but their inverses have, or their x axes: naming the key that mends it.
    """
    if len(poses) < _LEAST_CAMERAS:
        return []
    poses = torch.stack([*poses])
    miss, ahead, _ = _meeting(poses)
    missed, before, _ = _meeting(x_ahead(poses))
    expected = "cameras that look at what they surround (OpenGL's axes: x right, y up, looking along -z)"
    got = ""
    if (miss >= _MEET or ahead == 0) and missed < min(_MET, miss / 2) and before == 1:
        got = "cameras that look at one point only if x is ahead, as of ROS and Isaac"
        mended = f"convert them (docs/own-data.md), or {_KEEP}"
    elif miss < _MEET and ahead == 0:
        got, mended = "cameras that all look away from one point", _OUTWARDS
        if _rise(opposite(poses)) <= _RISE:  # as of a mirrored world, in which axes meet, too
            mended = f"{_CONVERT}; else {_OUTWARDS}"
    elif miss < _MEET and ahead < _ALL:
        expected, got = "cameras that look at one thing", f"{1 - ahead:.0%} of them that look away from it"
        mended = f"write all in the same axes, or {_KEEP}"
    if got:
        raise mismatch(where, expected, got, advice or mended)
    if inverse:
        return []
    expected, got = "camera-to-world matrices", "cameras that look at nothing in common, as their inverses do"
    if keys := other_readings(poses, _KEYS):
        raise mismatch(where, expected, got, advice or f"set {keys[0].replace(' and ', ' ')}, or {_KEEP}")
    if keys := closer_readings(poses, _KEYS):
        advice = advice or f"set {keys[0].replace(' and ', ' ')}, or {_KEEP}"
        return [f"{where}: {_BOTH.format(f'read with {keys[0]}')}; {advice}"]
    return refuse_other_readings(poses, _HALVES, where, expected, advice or f"write them so, or {_KEEP}")


def refuse_other_readings(
    poses: Sequence[torch.Tensor],
    changes: Mapping[str, _Change],
    where: object,
    expected: str,
    advice: str = "convert them",
) -> list[str]:
    """Refuse poses that make sense only in other ways; say in a line where they make more sense so.

    Args:
        poses, changes: see ``other_readings``.
        where, expected, advice: of the error.

    Raises:
        SceneError: naming these ways.
    """
    if ways := other_readings(poses, changes):
        raise mismatch(
            where, expected, f"cameras that look at one thing only if {', or if '.join(ways)}", advice
        )
    return doubt_readings(poses, changes, where, advice)


def doubt_readings(
    poses: Sequence[torch.Tensor], changes: Mapping[str, _Change], where: object, advice: str
) -> list[str]:
    """Say in a line in which other ways poses make more sense.

    Args:
        poses, changes: see ``other_readings``.
        where, advice: of the line.
    """
    said = "cameras do not look at one thing, as all of them do if {}"
    ways = other_readings(poses, changes)
    if not ways:
        said, ways = _BOTH, closer_readings(poses, changes)
    return [f"{where}: {said.format(', or if '.join(ways))}; if so, {advice}"] if ways else []


def other_readings(poses: Sequence[torch.Tensor], changes: Mapping[str, _Change]) -> list[str]:
    """Name the changes by which all cameras look at one point, in each way that needs the fewest.

    There are none if poses may be right as they are: if their cameras look at about one point or, whatever is
    changed, at none.

    Args:
        poses: camera-to-world (4, 4) with OpenCV's axes, as read.
        changes: of poses (N, 4, 4), by name; several are applied in this order, and joined by "and".
    """
    if len(poses) < _LEAST_CAMERAS:
        return []
    miss, ahead, _ = _meeting(poses := torch.stack([*poses]))
    are_none = (miss < _MEET and ahead == 0) or miss >= _MISS
    return _readings_within(poses, changes, _MEET) if are_none else []


def closer_readings(poses: Sequence[torch.Tensor], changes: Mapping[str, _Change]) -> list[str]:
    """Name the changes by which cameras that look at about one point all look at one many times closer, in
    each way that needs the fewest; none of poses that are likely right.

    Args:
        poses, changes: see ``other_readings``.
    """
    if len(poses) < _LEAST_CAMERAS:
        return []
    miss, _, _ = _meeting(poses := torch.stack([*poses]))
    return _readings_within(poses, changes, miss / _CLOSER) if _MEET <= miss < _MISS else []


def _readings_within(poses: torch.Tensor, changes: Mapping[str, _Change], most: float) -> list[str]:
    """Name the fewest changes of poses (N, 4, 4) by which axes miss a point by less than ``most``, and all
    cameras have it ahead.
    """
    for count in range(1, len(changes) + 1):
        ways = []
        for names in combinations(changes, count):
            changed = poses
            for name in names:
                changed = changes[name](changed)
            miss, ahead, _ = _meeting(changed)
            ways += [" and ".join(names)] if miss < most and ahead == 1 else []
        if ways:
            return ways
    return []


def opposite(poses: torch.Tensor) -> torch.Tensor:
    """Take poses (N, 4, 4) with OpenGL's axes for those of OpenCV, or the other way round."""
    return poses @ torch.from_numpy(FLIP)


def x_ahead(poses: torch.Tensor) -> torch.Tensor:
    """Take poses (N, 4, 4) that were read as OpenGL's for x ahead, y left and z up."""
    return poses[..., [1, 2, 0, 3]]


def transposed(poses: torch.Tensor) -> torch.Tensor:
    """Invert the rotations of poses (N, 4, 4) alone."""
    changed = poses.clone()
    changed[:, :3, :3] = poses[:, :3, :3].mT
    return changed


def by_translation(poses: torch.Tensor) -> torch.Tensor:
    """Take the places of poses (N, 4, 4) for translations of their inverses."""
    changed = poses.clone()
    changed[:, :3, 3:] = -poses[:, :3, :3] @ poses[:, :3, 3:]
    return changed


def inverted(poses: torch.Tensor) -> torch.Tensor:
    """Take world-to-camera matrices (N, 4, 4) for camera-to-world ones, or the other way round."""
    return torch.linalg.inv(poses)


def _of_file(change: _Change) -> _Change:
    """Change matrices as they are in the file, where they were read as ``matrix @ FLIP``."""
    return lambda poses: opposite(change(opposite(poses)))


_KEYS = {"data.inverse=true": _of_file(inverted), "data.axes=opencv": opposite}
_HALVES = {
    "rotations are transposed": _of_file(transposed),
    "translations are of world-to-camera matrices": _of_file(by_translation),
    "axes are OpenCV's": opposite,
}


_OF_KEYS = {
    "if read with data.inverse=true": _KEYS["data.inverse=true"],
    "if read with data.axes=opencv": opposite,
    "if read with data.inverse=true data.axes=opencv": lambda poses: opposite(
        _KEYS["data.inverse=true"](poses)
    ),
    "if rotations are transposed": _HALVES["rotations are transposed"],
}
_OF_FILES = {"if orientations are transposed": transposed, "if their axes are OpenGL's": opposite}


def readings_of(dataset: str) -> Mapping[str, _Change]:
    """Return in which other ways a film's poses may be written in a format, each with what to say of it."""
    return _OF_KEYS if dataset in ("video_with_poses", "dnerf") else _OF_FILES


def common_point(poses: Sequence[torch.Tensor]) -> torch.Tensor | None:
    """Return the point (3,) that nearly all cameras look at, float64; None where there is none.

    Args:
        poses: camera-to-world (4, 4) with OpenCV's axes.
    """
    if len(poses) < _LEAST_CAMERAS:
        return None
    miss, ahead, point = _meeting(torch.stack([*poses]))
    return point if miss < _MEET and ahead >= _ALL else None


def _rise(poses: torch.Tensor) -> float:
    """Return the sine of the angle by which cameras (N, 4, 4) are above the point that they look at, up being
    the mean of their images' upward axes; 0 where that is none.
    """
    up, (_, _, point) = -poses[:, :3, 1].mean(0), _meeting(poses)
    if point is None or float(up.norm()) < _RISE:
        return 0.0
    away = poses[:, :3, 3] - point
    return float((away @ (up / up.norm()) / away.norm(dim=-1).clamp(min=1e-12)).mean())


def _meeting(poses: torch.Tensor) -> tuple[float, float, torch.Tensor | None]:
    """Return how far the optical axes of poses (N, 4, 4) miss a common point, how many have it ahead, and it.

    The first is the median over cameras of the point's distance from the axis over its distance from the
    camera, infinite where axes are nearly parallel or cameras stand in one place; the second is a share.
    """
    centers, axes = poses[:, :3, 3], poses[:, :3, 2]
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(0)
    if float(torch.linalg.eigvalsh(normal)[0]) < 0.02 * len(poses):  # nearly parallel
        return math.inf, 0.5, None
    point = torch.linalg.solve(normal, (across @ centers[:, :, None]).sum(0)[:, 0])
    away = point - centers
    distance = away.norm(dim=-1)
    if float(distance.median()) < 1e-9 * (1 + float(centers.abs().max())):
        return math.inf, 0.5, None
    miss = (across @ away[:, :, None])[..., 0].norm(dim=-1) / distance.clamp(min=1e-12)
    return float(miss.median()), float(((away * axes).sum(-1) > 0).double().mean()), point
