"""Doubt poses and times of films by the paths of cameras, which are short in order of time and go on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from statistics import median

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from forewarp.data.agreement import small_image
from forewarp.data.files import SceneError
from forewarp.data.names import in_order, read_names
from forewarp.scene.frame import Frame, Scene, spread

_LEAST, _LEAST_TIMES, _LEAST_STEPS = 8, 3, 2  # of a camera: images, times and steps of a kind, that tell
_MOST = 200  # places whose distances are measured
_SHORTER = 0.75  # share of a path's length by time below which that in another order is rather the film's
_PATH = 0.5  # mean step of a path in mean distances of its places, which is about 1 where these are random
_ROUNDING = 1e-12  # of a path in the scene's units
_SHARED = 0.1  # share of a camera's images beyond which more have times of others than by a mistake in one
_COMPARED = 8  # pairs of images that follow each other
_TEXTURED = 0.02  # deviation of grey, of 1, around a pixel that tells whether the camera moves
_CHANGING, _NOISE = 0.25, 1 / 255  # change of images at rest at most: share of others' and of 1


def doubt_paths(scene: Scene) -> Iterator[str]:
    """Say in a line each what is probably wrong with the poses and times of a camera that moves.

    That is a path that is much longer in order of time than in order of names, images of one path that share
    times, and one pose of several images that change as those of a moving camera do.

    Cost: nothing is decoded but some images on both sides of a pose that is repeated.
    """
    frames = {frame.name: frame for frame in (*scene.train, *scene.held, *scene.val, *scene.test)}
    everything = _of_cameras(frames.values())  # each once, also where val is test
    still = [] if scene.has_alpha else everything  # where a background tells whether the camera moves
    for doubt, cameras in ((_out_of_order, everything), (_rounded, everything), (_repeated, still)):
        yield from filter(None, [next(filter(None, map(doubt, cameras)), None)])


def _of_cameras(frames: Iterable[Frame]) -> list[list[Frame]]:
    """Group frames by folder and camera, each in order of time, where names and number tell something."""
    folders: dict[tuple, list[Frame]] = {}
    for frame in sorted(frames, key=lambda frame: (frame.time, frame.name)):
        folders.setdefault((frame.name.rpartition("/")[0], frame.camera_id), []).append(frame)
    groups = []
    for group in folders.values():
        numbers, of_camera = None, {}
        with suppress(SceneError):
            numbers = read_names([frame.name for frame in group], "")
        if numbers is not None:
            for frame, camera in zip(group, numbers.cameras or [None] * len(group)):
                of_camera.setdefault(camera, []).append(frame)
        groups += [group for group in of_camera.values() if len(group) >= _LEAST]
    return groups


def _places(frames: Sequence[Frame]) -> Tensor:
    """Return where the cameras stand: (N, 3) float64."""
    return torch.stack([frame.camera.center for frame in frames]).double()


def _out_of_order(frames: Sequence[Frame]) -> str | None:
    """Say that places of a camera follow its images' names, as numbers or as texts, and not the times."""
    if len({frame.time for frame in frames}) < len(frames):
        return None
    names, places = [frame.name for frame in frames], _places(frames)
    rows = {name: row for row, name in enumerate(names)}
    orders = {"": in_order(names), " as texts": sorted(names)}
    apart = float(torch.pdist(places[spread(len(places), _MOST)]).mean())

    def step(order: Sequence[str]) -> float:
        return float(places[[rows[name] for name in order]].diff(dim=0).norm(dim=-1).mean())

    steps = {how: step(order) for how, order in orders.items()}
    how, due = min(steps, key=steps.get), step(names)
    if steps[how] >= min(_SHORTER * due, _PATH * apart):
        return None
    by_time, by_name = next(pair for pair in zip(names, orders[how]) if pair[0] != pair[1])
    line = f"the camera's path is {due / max(steps[how], _ROUNDING):.2g} times as long in the order of the"
    line += f" times as in that of the images' names{how} ({by_time} and {by_name} are the first to differ)"
    cause = "poses were given to sorted names" if how else "times were given to names in no order"
    return f"{line}, as if {cause}; give each image its own pose and time"


def _rounded(frames: Sequence[Frame]) -> str | None:
    """Say that images of one path share times, of which each goes on where the one before ended."""
    blocks: dict[float, list[Frame]] = {}
    for frame in in_order(frames, lambda frame: frame.name):
        blocks.setdefault(frame.time, []).append(frame)
    are_few = len(frames) - len(blocks) <= _SHARED * len(frames)
    is_rig = len({*map(len, blocks.values())}) == 1
    if are_few or is_rig or len(blocks) < _LEAST_TIMES or [*blocks] != sorted(blocks):
        return None
    ends = [_places([one[0], one[-1], other[0]]) for one, other in pairwise(blocks.values())]
    again, on = (sum(float((end[k] - end[2]).norm()) for end in ends) for k in (0, 1))
    if on >= _SHORTER * again and on > 0:  # as of a rig, which begins anew
        return None
    one, other = next(block for block in blocks.values() if len(block) > 1)[:2]
    line = f"{len(frames)} images of one camera's path have {len(blocks)} times ({one.name} and {other.name}"
    return f"{line} share {one.time:.4g}), as if these were rounded; write them with all digits"


def _repeated(frames: Sequence[Frame]) -> str | None:
    """Say that images have the pose of the one before, but change as those do whose pose changes, too."""
    still, moved = [], []
    for before, after in pairwise(frames):
        one, other = before.camera, after.camera
        if (one.width, one.height) != (other.width, other.height):
            continue  # a phone that was turned
        is_still = torch.equal(one.camera_to_world, other.camera_to_world)
        (still if is_still else moved).append((before, after))
    if min(len(still), len(moved)) < _LEAST_STEPS:
        return None
    steps = ([some[i] for i in spread(len(some), _COMPARED)] for some in (still, moved))
    change, due = (median(_change(*step) for step in some) for some in steps)
    if change <= max(_CHANGING * due, _NOISE):
        return None
    names = f"{still[0][1].name} to {still[-1][1].name}"
    line = f"{len(still)} images have the pose of the one before ({names}), and change as others do whose"
    return f"{line} pose changes, as if tracking was lost; find their poses, or remove these images"


def _change(before: Frame, after: Frame) -> float:
    """Return the median by which pixels with texture change from one image to the next, of 1."""
    one, other = (small_image(frame.load()).mean(-1) for frame in (before, after))
    middle, square = (avg_pool2d(values[None], 3, 1, 1)[0] for values in (one, one**2))
    textured = (square - middle**2).clamp(min=0).sqrt() > _TEXTURED
    return float((one - other).abs()[textured].median()) if bool(textured.any()) else 0.0
