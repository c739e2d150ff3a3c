"""The last step of a capture: place the world, propose its limits, write the scene, say what was found."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from forewarp.capture.frames import Frames, Progress, Source, read_mask, write_mask, write_smaller
from forewarp.capture.motion import moving_masks, resized_mask, resting_masks
from forewarp.capture.poses import Reconstruction
from forewarp.data.images import by, common_header, read_image
from forewarp.data.posed_video import SCALES, PosedShot, write_scene
from forewarp.drawing.images import draw_discs, sample_lines
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, mean_up
from forewarp.scene.frame import middle_of

# Points beyond these quantiles are taken for outliers, unless they lie close to the rest.
_QUANTILES, _SLACK, _MARGIN = (0.02, 0.98), 0.25, 0.05
_LEAST_NEAR = 0.01  # of the points' median distance: what is burnt into a film lies before it
_NEAR, _FAR = 0.5, 1.25  # of the nearest and the farthest points, as what moves may be nearer
_ROLL = 0.01  # mean square of the sine by which a hand rolls a camera, and some more
_LEVEL = 1e-3  # sine of the angle between up and ahead below which all cameras look up or down
_MIDWAY = 0.5  # share of its points' median distance from which on a camera's view belongs to the box
_MIN_SIDE = 96  # pixels: smaller copies are of no use
_RESTING = 2  # images around the middle that say what rests in the whole film; one may be held out
MASK = "masks/burnt_in.png"  # in the scene's folder: dark where something is burnt in
_DRAWING, _BORDER = 640, 0.06  # pixels of each drawing; share of it that stays free at its ends
_TITLE, _EDGE, _LETTERS = 48, 16, 0.45  # pixels above the drawings, left of texts; size of letters
_FIRST, _LAST, _BOX = (0.10, 0.25, 0.75), (0.85, 0.20, 0.15), (0.55, 0.55, 0.55)  # colours of cameras, box
_FRUSTA = 24  # cameras drawn with their view
_MOSTLY = 0.5  # share of pixels that move, beyond which masks may be the other way round


@dataclass(frozen=True)
class Limits:
    """``near`` and ``far`` along the unit ray, and a ``box`` around all that is seen; ``has_nearer`` says
    that points lie so near that they can be no part of the scene.
    """

    near: float
    far: float
    box: Box
    has_nearer: bool = False


def placed(found: Reconstruction) -> Reconstruction:
    """Rotate upwards to z and the mean direction of view to y, put the points' median into the origin, and
    make the median distance between a camera and a point that it sees 1. Without points it stays as it is.
    """
    if not len(found.seen):
        return found
    cameras = list(found.cameras.values())
    up = upwards(cameras)
    ahead = np.mean([np.asarray(camera.camera_to_world)[:3, 2] for camera in cameras], 0)
    right = np.cross(ahead, up)
    if np.linalg.norm(right) < _LEVEL:
        right = np.eye(3)[np.abs(up).argmin()]
        right = right - (right @ up) * up
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(up, right), up])
    return found.moved(rotation, np.median(found.points, axis=0), 1 / float(np.median(found.distances())))


def upwards(cameras: list[Camera]) -> np.ndarray:
    """Estimate the direction away from the ground (3,), unit length.

    A hand tilts a camera up and down, but holds it level: upwards is across all images' horizontal axes, as
    far as they tell, and else the mean of the images' upward axes.
    """
    mean = mean_up(cameras).numpy()
    level = np.stack([np.asarray(camera.camera_to_world)[:3, 0] for camera in cameras])
    up = np.linalg.solve(level.T @ level / len(level) + _ROLL * np.eye(3), _ROLL * mean)
    return up / np.linalg.norm(up)


def limits_of(found: Reconstruction) -> Limits | None:
    """Propose limits from the points, whose outliers do not count, and from where the cameras look; None
    without points: the reader derives them.

    What moves has hardly a point. It is before what stands still, so the box also holds the middle of every
    camera's view from half the distance of its points on.
    """
    if not len(found.seen):
        return None
    distances, midway = found.distances(), []
    for row, camera in enumerate(found.cameras.values()):
        of_camera = distances[found.seen[:, 0] == row]
        if len(of_camera):
            u, v = torch.tensor(camera.width / 2), torch.tensor(camera.height / 2)
            step = _MIDWAY * float(np.median(of_camera)) * np.asarray(camera.directions(u, v))
            midway.append(np.asarray(camera.center) + step)
    low, high = bounds_of(found.sure())
    pad = _MARGIN * float((high - low).max())
    ends = np.array([low, high, *midway])
    nearest, farthest = np.quantile(distances, _QUANTILES)
    box = Box(tuple(ends.min(0) - pad), tuple(ends.max(0) + pad))
    least = _LEAST_NEAR * float(np.median(distances))
    near = max(_NEAR * float(nearest), least)
    return Limits(near, _FAR * float(farthest), box, has_nearer=near == least)


def bounds_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bound points (N, 3) without their outliers: low (3,) and high (3,).

    The quantiles, and what lies within a quarter of their span beyond them.

    >>> line = np.linspace(0, 1, 101)[:, None].repeat(3, 1)
    >>> [end.tolist() for end in bounds_of(np.concatenate([line, [[90.0, 0.5, 0.5]]]))]
    [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]
    """
    low, high = np.quantile(points, _QUANTILES, axis=0)
    slack = _SLACK * (high - low)
    inside = ((points >= low - slack) & (points <= high + slack)).all(1)
    kept = points[inside] if inside.any() else points
    return kept.min(0), kept.max(0)


def write(
    folder: Path,
    in_seconds: bool,
    frames: Frames,
    found: Reconstruction,
    limits: Limits | None,
    progress: Progress,
    burnt: np.ndarray | None = None,
) -> dict:
    """Write the scene of all registered images, smaller copies of them, and masks of what moves: those that
    were given, else those of ``motion.moving_masks``; none of several cameras, or where these cannot tell.

    Args:
        folder: to fill.
        in_seconds: the times are seconds.
        frames: the images; the time of the first registered one becomes 0, that of the last 1.
        found: cameras and points, placed.
        limits: near, far and box.
        progress: called with images done and all.
        burnt: (H, W) bool, true where something is burnt into all images; not to be trained on.

    Returns:
        ``scales``, how many times smaller the copies are, and ``moving``, which share of all pixels moves;
        None without masks.
    """
    names = sorted(found.cameras, key=lambda name: frames.times[name])
    paths, cameras = [frames.folder / name for name in names], [found.cameras[name] for name in names]
    times, sizes = [frames.times[name] for name in names], [(c.width, c.height) for c in cameras]
    scales = [s for s in SCALES[1:] if min(map(min, sizes)) // s >= _MIN_SIDE]
    has_alpha = common_header(paths, one_size=False)[0].has_alpha
    is_film = not frames.cameras and len({*times}) == len(names) and len({*sizes}) == 1
    masks, moving_from, share = [None] * len(names), None, 0.0
    if frames.masks is not None:
        moving_from = frames.masks_from
        masks = (read_mask(frames.masks / f"{name}.png") for name in names)
    elif is_film:
        of_film = moving_masks(paths, cameras, lambda done, total: progress(done, 2 * total))
        if of_film is not None:
            masks, moving_from = of_film, "optical flow against the cameras"
    resting = {}
    if moving_from is not None and is_film:
        middle = middle_of(times)
        near = sorted(range(len(names)), key=lambda i: abs(times[i] - middle))[:_RESTING]
        resting = dict(zip(near, resting_masks(paths, cameras, near)))

    def shots() -> Iterator[PosedShot]:
        nonlocal share
        for i, (name, moving) in enumerate(zip(names, masks)):
            if moving is not None:
                moving = resized_mask(moving, sizes[i])
                if burnt is not None:  # it moves against the world, but is none of it
                    moving = moving & ~burnt
                share += float(moving.mean()) / len(names)
            rests = None if resting.get(i) is None else resized_mask(resting[i], sizes[i])
            pixels = read_image(paths[i]).numpy()
            pixels = pixels if has_alpha else pixels[..., :3]
            for scale in scales:
                write_smaller(folder, name, pixels, scale)
            time = (times[i] - times[0]) / (times[-1] - times[0]) if times[-1] > times[0] else 0.0
            rig = {"taken_by": frames.cameras.get(name), "moment": frames.moments.get(name)}
            yield PosedShot(name, cameras[i], pixels, time, moving=moving, resting=rests, **rig)
            progress(len(names) + i + 1, 2 * len(names))

    if burnt is not None:
        for scale in (1, *scales):
            height, width = (n // scale for n in burnt.shape)
            blocks = burnt[: height * scale, : width * scale].reshape(height, scale, width, scale)
            name = MASK if scale == 1 else MASK.replace("/", f"_{scale}/")
            write_mask(folder / name, blocks.any((1, 3)))
    told = {"near": limits.near, "far": limits.far, "aabb": limits.box} if limits else {}
    told |= {"moving_from": moving_from, "mask": None if burnt is None else MASK}
    told["seconds"] = times[-1] - times[0] if in_seconds else None
    write_scene(folder, shots(), points=found.sure(), **told)
    return {"scales": scales, "moving": None if moving_from is None else share}


def draw(found: Reconstruction, limits: Limits, taken_by: Sequence[str] | None = None) -> Tensor:
    """Draw the capture from above (x to the right, y up) and from the side (z up): (H + title, 2 H, 3) in
    [0, 1], with what is to be seen above, and the ends of the box at its edges.

    Cameras go from blue to red; grey is the box. Lines join the places of one camera: of a rig, ``taken_by``
    says which took each of the images.
    """
    image = torch.cat([_drawn(found, limits, axes, taken_by) for axes in ([0, 1], [0, 2])], 1)
    image = torch.cat([torch.ones(_TITLE, image.shape[1], 3), image])
    about = (
        f"{len(found.cameras)} cameras from the first (blue) to the last (red), {len(found.points)} points"
    )
    views = [("from above", (_EDGE, _TITLE)), ("from the side", (_DRAWING + _EDGE, _TITLE))]
    return _lettered(image, [(f"{about}; grey: the box", (_EDGE, _TITLE // 2)), *views])


def _drawn(found: Reconstruction, limits: Limits, axes: list[int], taken_by: Sequence[str] | None) -> Tensor:
    """Draw two axes of the world."""
    cameras, centers = list(found.cameras.values()), found.centers
    low, high = np.array(limits.box.low), np.array(limits.box.high)
    shown = np.concatenate([centers, [low, high]])[:, axes]
    middle, span = (shown.max(0) + shown.min(0)) / 2, float((shown.max(0) - shown.min(0)).max())
    scale = _DRAWING * (1 - 2 * _BORDER) / span

    def pixels(points) -> Tensor:
        flat = (np.asarray(points)[..., axes] - middle) * scale * (1, -1) + _DRAWING / 2
        return torch.from_numpy(np.ascontiguousarray(flat)).float()

    def with_lines(image: Tensor, lines, colors: Tensor, radius: float) -> Tensor:
        """Draw polylines (N, T, 3), each of one colour (N, 3)."""
        points, line = sample_lines(pixels(lines))
        return draw_discs(image, points[:, :2], colors[line], torch.full((len(points),), 0.9), radius)

    inside = ((found.points >= low) & (found.points <= high)).all(1)
    colors = torch.from_numpy(found.colors[inside]).float() / 255
    image = torch.ones(_DRAWING, _DRAWING, 3)
    image = draw_discs(image, pixels(found.points[inside]), colors, torch.full((len(colors),), 0.8), 1.0)
    (x0, y0), (x1, y1) = low[axes], high[axes]
    outline = np.zeros((1, 5, 3))
    outline[0][:, axes] = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
    image = with_lines(image, outline, torch.tensor([_BOX]), 0.6)
    share = torch.linspace(0, 1, len(cameras))[:, None]
    paint = torch.lerp(torch.tensor([_FIRST]), torch.tensor([_LAST]), share)
    whose = np.asarray(taken_by or [""] * len(cameras))
    joined = np.flatnonzero(whose[:-1] == whose[1:])
    if len(joined):
        image = with_lines(image, np.stack([centers[joined], centers[joined + 1]], 1), paint[joined], 0.8)
    every = 1 if taken_by and len({*taken_by}) == len(cameras) else max(1, len(cameras) // _FRUSTA)
    views = np.concatenate([_frustum(camera, 0.08 * span) for camera in cameras[::every]])
    image = with_lines(image, views, paint[::every].repeat_interleave(8, 0), 0.6)
    (left, bottom), (right, top) = pixels(np.array([limits.box.low, limits.box.high])).tolist()
    below, beside, names = bottom + 18, max(left - 44, 2), [" xyz"[axis + 1] for axis in axes]
    texts = [(f"{x0:.2f}", (left, below)), (names[0], ((left + right) / 2, below))]
    texts += [
        (f"{x1:.2f}", (right - 34, below)),
        (f"{y0:.2f}", (beside, bottom)),
        (f"{y1:.2f}", (beside, top)),
    ]
    return _lettered(image, [*texts, (names[1], (left - 14, (bottom + top) / 2))])


def _lettered(image: Tensor, texts: Sequence[tuple[str, tuple[float, float]]]) -> Tensor:
    """Write texts into an image (H, W, 3), each from the left end of its baseline."""
    pixels = (255 * image).byte().numpy()
    for text, (column, row) in texts:
        place = round(column), round(row)
        cv2.putText(pixels, text, place, cv2.FONT_HERSHEY_SIMPLEX, _LETTERS, (60, 60, 60), 1, cv2.LINE_AA)
    return torch.from_numpy(pixels).float() / 255


def _frustum(camera: Camera, depth: float) -> np.ndarray:
    """The eight edges (8, 2, 3) of a camera's view down to a depth."""
    u, v = torch.tensor([0, 1, 1, 0]) * camera.width, torch.tensor([0, 0, 1, 1]) * camera.height
    center = np.asarray(camera.center)
    corners = center + depth * np.asarray(camera.directions(u, v))
    sides = np.stack([np.broadcast_to(center, corners.shape), corners], 1)
    return np.concatenate([sides, np.stack([corners, np.roll(corners, -1, 0)], 1)])


def facts_of(
    source: Source, frames: Frames, found: Reconstruction, limits: Limits | None, burnt: np.ndarray | None
) -> dict:
    """Gather the numbers of ``capture.json``, but for those that ``write`` returns."""
    times = [frames.times[name] for name in found.cameras]
    left_out = sorted(frames.times.keys() - found.cameras.keys())
    return {
        "source": str(source.path),
        "found": frames.found,
        "pictures": len(frames.times),
        "registered": len(found.cameras),
        "searched": source.colmap is None,
        "left_out": [frames.originals.get(name, name) for name in left_out],
        "originals": frames.originals,
        "assumed": frames.assumed,
        "why": frames.why,
        "burnt_in": None if burnt is None else {"share": float(burnt.mean()), "places": _places_of(burnt)},
        "absent": list(found.absent),
        "seconds": max(times) - min(times) if source.video is not None else None,
        "camera": lens_facts(next(iter(found.cameras.values()))),
        # The way of the camera, where the median distance of what it sees is 1.
        "path": float(np.linalg.norm(np.diff(found.centers, axis=0), axis=1).sum()),
        "has_nearer": limits is not None and limits.has_nearer,
        **facts_of_space(found, limits),
    }


def facts_of_space(found: Reconstruction, limits: Limits | None) -> dict:
    """Gather how well points and cameras fit, and the limits, None where they are not known."""
    facts = {"reprojection_error": found.error if limits else None, "points": len(found.points)}
    facts |= {"sure_points": len(found.sure()), "near": limits and limits.near, "far": limits and limits.far}
    return facts | {"box": limits and [*limits.box.low, *limits.box.high]}


def lens_facts(camera: Camera) -> dict:
    """Gather the size of a camera's images, its lens, and how many degrees it sees across."""
    lens, inner = camera.lens, ("width", "height", "fx", "fy", "cx", "cy")
    facts = {name: getattr(camera, name) for name in inner}
    facts |= {"k": list(lens.k) if lens else [0.0] * 3, "p": list(lens.p) if lens else [0.0] * 2}
    return facts | {"degrees": math.degrees(2 * math.atan(camera.width / (2 * camera.fx)))}


def _places_of(mask: np.ndarray) -> list[str]:
    """Name those ninths of an image that hold a fifth or more of what is true in a mask (H, W).

    >>> _places_of(np.arange(81).reshape(9, 9) < 3)
    ['top left']
    """
    parts = [part for rows in np.array_split(mask, 3) for part in np.array_split(rows, 3, axis=1)]
    names = product(("top", "middle", "bottom"), ("left", "middle", "right"))
    return [" ".join(name) for name, part in zip(names, parts) if part.sum() >= 0.2 * mask.sum()]


def space_line(facts: dict) -> str:
    """Say in words how large the box is, and where near and far are."""
    size = by(f"{high - low:.2f}" for low, high in zip(facts["box"][:3], facts["box"][3:]))
    return f"box: {size}, near {facts['near']:.2f}, far {facts['far']:.2f}"


def moving_line(facts: dict) -> list[str]:
    """Say in a line how much moves, where that is known."""
    if facts["moving"] is None:
        return []
    line = f"moving: {facts['moving']:.0%} of the pixels; test frames are scored there and elsewhere"
    advice = "; if what moves is dark in masks=, invert them" if facts["moving"] > _MOSTLY else ""
    return [line + advice]


def summary(facts: dict) -> list[str]:
    """Say what was found in a few lines."""
    camera = facts["camera"]
    registered = f"registered: {facts['registered']} of {facts['pictures']} pictures, "
    registered += f"{camera['width']} x {camera['height']} pixels"
    path = f"camera: {camera['degrees']:.0f} degrees wide; its path is {facts['path']:.2f} long"
    points = "points: none; box, near and far are derived when the scene is read"
    if facts["box"] is not None:
        all_sure = facts["sure_points"] == facts["points"]
        sure = "" if all_sure else f", {facts['sure_points']:,} of them sure"
        registered += f", reprojection error {facts['reprojection_error']:.2f} pixels"
        path += ", where what it sees is 1 away"
        points = f"points: {facts['points']:,}{sure}; {space_line(facts).replace(':', '', 1)}"
    lines = [f"frames: {facts['pictures']} of {facts['found']}; {facts['why']}"] if facts["why"] else []
    lines += [registered, path, points, *moving_line(facts)]
    if absent := facts["absent"]:
        lines.append(f"left out: {len(absent)} cameras whose picture is not there ({absent[0]})")
    if facts["assumed"]:
        lines.append(f"assumed: {facts['assumed']}")
    if burnt := facts["burnt_in"]:
        where = f"{100 * burnt['share']:.1f} % of the images ({', '.join(burnt['places'])})"
        left_out = f"burnt in: a logo or a caption in {where}, left out of poses and not trained on: {MASK}"
        lines.append(f"{left_out}; crop it away before, or set data.masks=off to train on it")
    if facts["has_nearer"]:
        near = f"near: expected points from {facts['near']:.2g} on, but got nearer ones, as captions or logos"
        advice = "give masks= in which these are bright"
        lines.append(f"{near} in the pictures make them, which also bend poses; {advice}")
    if facts["left_out"]:
        few = ", ".join(facts["left_out"][:3])
        advice = "; film slower and with more of what stands still" if facts["searched"] else ""
        lines.append(f"left out: {len(facts['left_out'])} pictures without a pose ({few}){advice}")
    return lines
