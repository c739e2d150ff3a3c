"""Depth beside a scene's images: exact, measured by a sensor, or guessed by another program."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from statistics import median

import numpy as np
import torch
from torch import Tensor

from forewarp.data.agreement import BESIDE, COMPARED, leaning, likeliest_reading, plane_error, small_image
from forewarp.data.arrays import check_shape, load_numpy
from forewarp.data.files import existing, mismatch
from forewarp.data.images import CACHE, by, read_gray16, read_image
from forewarp.ops.grid import reduced_depth
from forewarp.scene.camera import Camera, Lens
from forewarp.scene.frame import Frame, spread

SUFFIXES = (".npy", ".png")
MILLIMETRES = 1e-3
METRIC = ("axis", "ray")  # kinds of depth in a unit of length
LEVELS = 2  # of ARKit's confidence: 0 low, 1 medium, 2 high
_LOOKED_AT = 4  # files that tell the unit
_NEAR, _LEAST, _AGREE, _LINES = 0.05, 10, 0.4, 400  # of a fit: share, points, share of them, lines tried
_VIEWS, _NEXT = 4, (0, 2, 6, 14)  # views that are compared, with others so many later
_MANY, _PAIRS, _OF_TIME = 400, 12, 0.5  # images of which so many pairs are near; distance of times 0 and 1
_LEANS = 0.65, 1.5  # between which the other kind is right
_BEYOND = 2.0  # share of near and far within which the median of depths of the right unit lies
_NOWHERE = 10.0  # multiple of far, beyond which nothing is measured
_REPEATED, _SEVERAL = 0.002, 2  # share and number of pixels of the largest depth, from which on it is none
_ENDS, _GAP = (1.0, 255.0), 0.05  # ends of ranges of real numbers; share below an end in which others lie
_FITTED = 3  # images, at least, that tell whether all are in one unit
_BELOW, _STANDS_OUT = 0.02, 5  # share below the largest, and how many times as often as any depth there it is
_PLACED = 2e-3  # share by which the largest depths of views contradict each other if they are none
_COLORED = 6  # groups of views whose colours are compared, at most
SHOWN = 128  # pixels of the longer side of views whose colours are compared
_UNITS = (1.0, MILLIMETRES, 1e-2, 1e2, 1e3, 2e-4, 1 / 256, 0.0254, 0.3048)  # that depth is written in
_SAME_UNIT = 0.03
_DOUBTED = 0.5  # confidence above which some depths are
_TRUSTED = 8  # files that tell whether confidences are levels, and of which the largest depths are looked at
_TURNED = {  # what else may be in files of depth
    "upside down": lambda camera, away: (camera, away.flip(0)),
    "mirrored": lambda camera, away: (camera, away.flip(1)),
    "turned by half": lambda camera, away: (camera, away.flip(0, 1)),
    "transposed": lambda camera, away: (camera, away.mT if camera.width == camera.height else away),
}
_TURN = "turn them as their images are"
_FACTORS = (0.5, 0.7, 1.4, 2.0)  # by which depths may be off, where near and far allow it


@dataclass(eq=False)
class SensedDepth:
    """Depth of an image and how far to trust it, (2, H, W) float32: the distance along a pixel's ray in world
    units, 0 where there is none, and its confidence in [0, 1]. Read at its first use and kept while there is
    room; it is read-only.

    Args:
        path: .npy (H', W'), (H', W', 1) or (1, H', W'), or grey PNG of 16 bits, of depths; what is 0, not
            finite, or ``nowhere`` within reach of the camera's far, is a hole. Its proportions are the
            image's, of which each pixel takes the nearest.
        camera: of the image.
        scale: world units for one unit of the file.
        confidence: .npy or grey PNG as large: from 0 to 1, or ARKit's levels 0, 1, 2; None: 1 everywhere.
        kind: along the optical ``axis`` or the pixel's ``ray``; or, but for a scale and a shift, ``relative``
            as depth or ``inverse`` as 1 / depth along the axis: what is 0 or below is no hole then, and what
            lies at ``known`` points tells scale and shift.
        known: (N, 3), world units. An image that shows too few of them, or contradicts them, is all holes.
        levels: whole numbers of confidence are ARKit's levels, else bytes; None: as this file alone tells.
        ends: a metric depth that stands out as the image's largest is where the sensor saw nothing, a hole.
    """

    path: Path
    camera: Camera
    scale: float = 1.0
    confidence: Path | None = None
    kind: str = "axis"
    known: Tensor | None = None
    levels: bool | None = None
    ends: bool = False

    def __call__(self) -> Tensor:
        """Give both; SceneError where a file holds anything else."""
        return CACHE.get(self, self._decode)

    def _decode(self) -> Tensor:
        depth = read_depth(self.path, signed=self.kind not in METRIC)
        if self.confidence is None:
            trust = np.ones_like(depth)
        else:
            trust = _read_confidence(self.confidence, self.levels)
        if trust.shape != depth.shape:
            expected = f"{by(depth.shape[::-1])} confidences as {self.path.name}"
            raise mismatch(self.confidence, expected, by(trust.shape[::-1]))
        size = self.camera.height, self.camera.width
        if abs(depth.shape[0] * size[1] - depth.shape[1] * size[0]) > max(*depth.shape, *size):
            expected = f"depths of the proportions of its image, {by(size[::-1])} pixels"
            raise mismatch(self.path, expected, by(depth.shape[::-1]))
        if self.kind in METRIC:
            depth[nowhere(depth, self.camera.far / self.scale, ends=self.ends)] = 0
        else:
            depth = self._fitted(depth)
        return self._placed(depth, trust)

    def largest(self) -> Tensor:
        """Return the distances (H, W) along the rays, world units, of the depths that stand out as the
        largest, 0 elsewhere.
        """
        depth = read_depth(self.path)
        depth[nowhere(depth, self.camera.far / self.scale)] = 0
        return self._placed(np.where(_stands_out(depth), depth, 0), np.ones_like(depth))[0]

    def _placed(self, depth: np.ndarray, trust: np.ndarray) -> Tensor:
        """Make planes of the camera's size of depths and confidences of the file's."""
        depth[depth * self.scale > np.finfo(np.float32).max] = 0
        planes = torch.from_numpy(np.stack([depth * self.scale, trust * (depth > 0)]).astype(np.float32))
        return along_rays(planes, self.camera, self.kind)

    def at_known(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return those of ``values`` (H', W') where the camera sees ``known`` points, and the depths of these
        along the axis, world units, (P,) each.
        """
        pixel, z = self.camera.project(self.known.double())
        size = pixel.new_tensor([self.camera.width, self.camera.height])
        inside = (z > 0) & (pixel >= 0).all(-1) & (pixel < size).all(-1)
        at = (pixel[inside] / size * pixel.new_tensor(values.shape[::-1])).long().numpy()
        return values[at[:, 1], at[:, 0]], z[inside].numpy()

    def _fitted(self, values: np.ndarray) -> np.ndarray:
        """Return depths (H, W) in world units of values up to a scale and a shift, NaN where there is none; 0
        everywhere where points do not tell.
        """
        given, true = self.at_known(values)
        true, there = 1 / true if self.kind == "inverse" else true, np.isfinite(given)
        found = line_through(given[there], true[there])
        if found is None:
            return np.zeros_like(values)
        with np.errstate(invalid="ignore", divide="ignore"):
            depth = found[0] * values + found[1]
            depth = 1 / depth if self.kind == "inverse" else depth
            return np.where(np.isfinite(depth) & (depth > 0), depth, 0.0)


class StoredDepth:
    """Exact ray depth (H, W) float32 in world units, 0 on the background; read at each call.

    Args:
        path: .npy, or a grey 16-bit PNG; what is ``nowhere`` in reach of the camera's far is background.
        camera: of the image as stored, whose size the file must have.
        halve: give half the size.
        scale: world units for one of the file; None: 1, refused for a PNG.
        kind: in the file along the optical ``axis`` or each pixel's ``ray``.

    ``ends``, False at first, is as of ``SensedDepth``.
    """

    def __init__(self, path: Path, camera: Camera, halve: bool, scale: float | None, kind: str) -> None:
        if path.suffix == ".png" and scale is None:
            expected = "depth_scale in the transforms file, world units for one step of a 16-bit depth"
            raise mismatch(path, expected, "none")
        self.path, self.camera, self.halve, self.kind, self.ends = path, camera, halve, kind, False
        self.scale = 1.0 if scale is None else scale

    def __call__(self) -> Tensor:
        """Read the depth; SceneError where the file holds anything else."""
        values = read_gray16(self.path) if self.path.suffix == ".png" else load_numpy(self.path)
        size = self.camera.height, self.camera.width
        expected = f"finite depths >= 0 of shape {size}"
        check_shape(values, self.path, expected, *size)
        with np.errstate(invalid="ignore"):
            depth = values.astype(np.float64)
        if not np.isfinite(depth).all() or (depth < 0).any():
            raise mismatch(self.path, expected, f"values from {depth.min()} to {depth.max()}")
        depth[_are_full(values) | nowhere(depth, self.camera.far / self.scale, ends=self.ends)] = 0
        if not (depth.max() * self.scale <= np.finfo(np.float32).max):
            raise mismatch(self.path, expected, f"values up to {depth.max() * self.scale}")
        depth = torch.from_numpy((depth * self.scale).astype(np.float32))
        if self.kind == "axis":
            depth = depth / _cosines(*self.camera.inner)
        return reduced_depth(depth) if self.halve else depth


def line_through(given: np.ndarray, true: np.ndarray) -> tuple[float, float] | None:
    """Find a > 0 and b by which ``a given + b`` is most of ``true`` (N,) > 0, whatever the others are.

    Of many lines through two points that with the most others within ``_NEAR`` of it is fitted to these by
    least squares. Equal points give the same line.

    Returns:
        None for fewer than ``_LEAST`` points, or where hardly more than some agree with any line.

    >>> line = line_through(np.arange(1.0, 21.0), np.append(3 * np.arange(1.0, 19.0) + 2, [1.0, 500.0]))
    >>> np.round(line, 9).tolist()
    [3.0, 2.0]
    """
    if len(given) < _LEAST:
        return None
    one, other = np.random.default_rng(0).integers(0, len(given), (2, _LINES))
    apart = given[other] - given[one]
    a = (true[other] - true[one]) / np.where(apart == 0, np.inf, apart)
    b = true[one] - a * given[one]
    near = np.abs(a[:, None] * given + b[:, None] - true) < _NEAR * true
    near[a <= 0] = False
    best = near[near.sum(1).argmax()]
    if best.sum() < max(_LEAST, _AGREE * len(given)):
        return None
    columns = np.stack([given[best] / true[best], 1 / true[best]], 1)  # errors count by their share
    a, b = np.linalg.lstsq(columns, np.ones(len(columns)), rcond=None)[0]
    return float(a), float(b)


def nowhere(depth: np.ndarray, far: float, *, ends: bool = False) -> np.ndarray:
    """Tell which depths (H, W) are a program's number for none: the largest, if several pixels have just that
    and it is beyond ``far``, or with ``ends`` stands out, and what is beyond ten times that, unless most
    depths are. Returns bool (H, W).

    >>> nowhere(np.array([[2.0, 3, 65.535, 65.535]]), 10.0).tolist()
    [[False, False, True, True]]
    """
    largest = _repeated(depth) & (depth > far)
    rest = depth[(depth > 0) & ~largest]
    if not rest.size or np.median(rest) > _NOWHERE * far:  # of another unit
        return np.zeros_like(largest)
    none = largest | (depth > _NOWHERE * far)
    return none | _stands_out(np.where(none, 0, depth)) if ends else none


def _stands_out(depth: np.ndarray) -> np.ndarray:
    """Tell which of depths (H, W) are the largest, if many more pixels have just that than any depth a little
    below it, as of a sensor that writes its limit where it sees nothing.
    """
    largest = _repeated(depth)
    if not largest.any() or not ((depth > 0) & ~largest).any():
        return np.zeros_like(largest)
    top = depth.max()
    below = depth[(depth < top) & (depth > (1 - _BELOW) * top)]
    most = np.unique(below, return_counts=True)[1].max(initial=0)
    return largest & bool(largest.sum() > _STANDS_OUT * most)


def _repeated(depth: np.ndarray) -> np.ndarray:
    """Tell which of depths (H, W) are the largest, if several pixels have just that."""
    largest = (depth == depth.max()) & (depth > 0)
    return largest & bool(largest.sum() >= max(_SEVERAL, _REPEATED * depth.size))


def doubt_depths(
    frames: Sequence[Frame],
    world: float,
    kind: str | None,
    where: object,
    unit: str,
    *,
    far_key: str = "set data.far",
    usual: str = "axis",
    stretched: str = "write depths of one unit",
) -> list[str]:
    """Say in lines which numbers of metric depths are taken for holes, that hardly any is trusted, and that
    depths are in another unit, in none that images share, or turned; else doubt their kind. What only all
    files together tell is settled for each before: ``levels`` and ``ends`` of ``SensedDepth``.

    Args:
        frames: in the order of time; some of those with depth are read.
        world: scene units for one unit of the file's world.
        kind: as typed, see ``doubt_kind``.
        where: what depths belong to.
        unit: what to do with the number that is the unit, ``set data.depth_scale={}``.
        far_key: what to do where far is wrong.
        usual: the kind if none was typed: axis, as of films, or ray, as of images from all around.
        stretched: what to do with depths that were stretched to a range, each image by itself.

    Raises:
        SceneError: as ``doubt_kind``.
    """
    frames = [frame for frame in frames if frame.load_sensed is not None]
    _settle_levels([frame.load_sensed for frame in frames])
    if kind not in (*METRIC, None) or not frames:
        return []
    limits = _settle_ends([frame.load_sensed for frame in frames], where)
    if how := _apart([frame.load_sensed for frame in frames]):
        return [
            f"{where}: depths of different images seem to have different units, as {how}; {stretched}",
            *limits,
        ]
    loads = [frames[i].load_sensed for i in spread(len(frames), _LOOKED_AT)]
    near, far = loads[0].camera.near / world, loads[0].camera.far / world
    holes, kept, pixels = {"the largest of their type": [], f"beyond far, {far:.4g}": []}, [], 0
    for load in loads:
        values, depth = _numbers_in(load.path), read_depth(load.path)
        away = nowhere(depth, load.camera.far / load.scale)
        depth[load.ends & _stands_out(np.where(away, 0, depth))] = 0
        for found, mask in zip(holes.values(), (_are_full(values), away)):
            found.append(values[mask].astype(np.float64))
        kept.append(depth[(depth > 0) & ~away] * load.scale / world)
        pixels += depth.size
    lines = limits
    for why, found in holes.items():
        if (found := np.concatenate(found)).size:
            most = Counter(found.tolist()).most_common(1)[0][0]
            more = "" if (found == most).all() else " and other numbers"
            line = f"{found.size / pixels:.2%} of the depths looked at are {most:.6g}{more}, {why}"
            advice = f"; {far_key} if they are right" if "far" in why else ""
            lines.append(f"{where}: {line}: taken for holes{advice}")
    trust = max(float(load()[1].max()) for load in loads)
    if any(load.confidence for load in loads) and trust <= _DOUBTED:
        line = f"confidence is at most {trust:.2g}, of 1, in the images looked at, so depth counts little"
        lines.append(f"{where}: {line}; write 1, or 255 or level 2 as whole numbers, where it is sure")
    there = np.concatenate(kept)
    if there.size and not near < (middle := float(np.median(there))) < far:
        got = f"depth is {middle:.4g} in the median, with near at {near:.4g} and far at {far:.4g}"
        told = fitting_unit(middle * world / loads[0].scale, near, far, _told_by_points(loads, world))
        also = "" if loads[0].known is None else ", or data.depth_kind=inverse if it is 1 / depth"
        return [*lines, f"{where}: {got}; {unit.format(told)}{also}"]
    groups = _near_pairs(frames)
    if usual == "axis":
        chosen = {i + n for i in spread(len(frames), _VIEWS) for n in _NEXT if i + n < len(frames)}
        groups = [[frames[i] for i in sorted(chosen)]]
    if doubt := _doubt_colors(frames, groups, world, where, unit, usual):
        return lines + doubt
    return lines + doubt_kind(groups, loads[0].known, kind, where, usual)


def _apart(loads: Sequence[SensedDepth]) -> str:
    """Say by what depths are told to have been stretched to a range, each image by itself; nothing where they
    seem not to be.
    """
    some = [loads[i] for i in spread(len(loads), _TRUSTED)]
    tops = [_end_of_range(_numbers_in(load.path)) for load in some]
    if len(tops) >= _FITTED and None not in tops:
        return f"the largest number of each is {max(tops):.6g}, of few pixels"
    if some[0].known is None or _told_by_points(some, 1.0) is not None:
        return ""
    fits = []
    for load in some:
        values, true = load.at_known(read_depth(load.path))
        fits.append(line_through(values[values > 0], true[values > 0]))
    if len(fits) < _FITTED or None in fits:
        return ""
    return "points that never move fit each with another scale or shift"


def _end_of_range(values: np.ndarray) -> float | None:
    """Return the largest of depths (H, W) if it is the end of a range to which these were stretched; None if
    it is not, or of many pixels, or far above all others, as a number for no depth.
    """
    with np.errstate(invalid="ignore"):
        values = values[np.isfinite(values)].astype(np.float64) if values.dtype.kind == "f" else values
    if not values.size:
        return None
    top, is_real = values.max(), values.dtype.kind == "f"
    ends = _ENDS if is_real else (np.iinfo(values.dtype).max, np.iinfo(values.dtype).max - 1)  # of truncation
    others = values[values < top]
    are_few = len(values.ravel()) - len(others) < max(_SEVERAL, _REPEATED * values.size)
    return float(top) if top in ends and are_few and others.max(initial=0) > (1 - _GAP) * top else None


def _settle_levels(loads: Sequence[SensedDepth]) -> None:
    """Tell once for all depths whether whole numbers of confidence are levels or bytes, by some files."""
    trusted = [load for load in loads if load.confidence is not None]
    looked = [_confidences_in(trusted[i].confidence) for i in spread(len(trusted), _TRUSTED)]
    levels = all(values.max() <= LEVELS for values in looked if values.dtype.kind != "f")
    for load in trusted:
        load.levels = levels


def _settle_ends(loads: Sequence[SensedDepth], where: object) -> list[str]:
    """Take the largest depth of each image for a hole where it stands out in several and cannot be where each
    of them has it; say so in a line, or that it is doubtful where views do not tell.
    """
    some = [loads[i] for i in spread(len(loads), _TRUSTED)]
    ends = [load.largest() for load in some]
    kept = [(load, end) for load, end in zip(some, ends) if bool(end.any())]
    if len(kept) < max(_SEVERAL, len(some) / 2):
        return []
    share = sum(float((end > 0).double().mean()) for end in ends) / len(ends)
    error = plane_error([load.camera for load, _ in kept], [end for _, end in kept])
    tops = [f"{float(np.max(_shown(load))):.6g}" for load, _ in kept]
    top = tops[0] if len({*tops}) == 1 else f"{tops[0]} and the like"
    line = f"{where}: {share:.2%} of the depths looked at are {top}, the largest of their image"
    if error is None or error <= _PLACED:
        is_same = len({*tops}) == 1
        advice = "write 0 there if that is a sensor's limit"
        return [f"{line}; {advice}"] if is_same else []
    for load in loads:
        load.ends = True
    return [f"{line}, where other views do not see it: taken for holes"]


def _shown(load: SensedDepth) -> np.ndarray:
    """Return the depths (P,) of a file within reach of its camera's far."""
    depth = read_depth(load.path)
    return depth[~nowhere(depth, load.camera.far / load.scale)]


def _doubt_colors(
    frames: Sequence[Frame],
    groups: Sequence[Sequence[Frame]],
    world: float,
    where: object,
    unit: str,
    usual: str,
) -> list[str]:
    """Say in a line that colours of views agree by depths only if these are turned, multiplied or inverted.

    Args:
        frames, world, where, unit, usual: see ``doubt_depths``.
        groups: of frames that are compared; of films others are.
    """
    if usual == "axis":
        beside = [max(least, len(frames) // share) if share else 0 for share, least in BESIDE]
        firsts = spread(len(frames), COMPARED)
        groups = [[frames[i + n] for n in beside if i + n < len(frames)] for i in firsts]
    groups, views = groups[:_COLORED], {}
    for frame in {id(frame): frame for group in groups for frame in group}.values():
        image = small_image(frame.load(), SHOWN)
        camera = frame.camera.resized(image.shape[1], image.shape[0])
        views[id(frame)] = (
            camera,
            image,
            replace(frame.load_sensed, camera=camera, confidence=None)._decode()[0],
        )
    readings = {f"depths are {how}": (turned, _TURN) for how, turned in _TURNED.items()}
    for factor in _FACTORS:
        scaled = lambda camera, away, by=factor: (camera, by * away)  # noqa: E731
        advice = unit.format(f"{factor * frames[0].load_sensed.scale / world:.2g}")
        readings[f"depths are about {factor:g} times as far"] = scaled, advice
    inverse = "set data.depth_kind=inverse, or write depth"
    readings["depths are disparities, 1 / depth"] = lambda camera, away: (camera, _inverted(away)), inverse
    views = [[views[id(frame)] for frame in group] for group in groups]
    how = likeliest_reading(views, {how: read for how, (read, _) in readings.items()})
    if how is None:
        return []
    return [f"{where}: colours of neighbouring views agree much better if {how}; {readings[how][1]}"]


def _inverted(away: Tensor) -> Tensor:
    """Return the inverse of distances (H, W), of the same median; 0 stays."""
    middle = away[away > 0].median() if bool((away > 0).any()) else 1.0
    return torch.where(away > 0, middle**2 / away.clamp(min=1e-9), 0.0)


def _near_pairs(frames: Sequence[Frame]) -> list[list[Frame]]:
    """Choose pairs of frames whose cameras stand near each other, at about one time: from elsewhere much is
    hidden.
    """
    frames = [frames[i] for i in spread(len(frames), _MANY)]
    places = torch.stack([frame.camera.center.double() for frame in frames])
    times = torch.tensor([frame.time for frame in frames], dtype=torch.float64)[:, None]
    apart = torch.cdist(places, places) / float((places - places.mean(0)).norm(dim=-1).mean().clamp(min=1e-9))
    apart = (apart + _OF_TIME * (times - times.T).abs()).triu(1)
    apart[apart == 0] = torch.inf
    first, second = torch.unravel_index(apart.flatten().argsort()[:_PAIRS], apart.shape)
    return [[frames[i], frames[j]] for i, j in zip(first.tolist(), second.tolist()) if i < j]


def _told_by_points(loads: Sequence[SensedDepth], world: float) -> float | None:
    """Return how many units of the file's world one of depth is, as points that never move tell; None where
    they do not.
    """
    shares = []
    for load in loads:
        if load.known is not None:
            values, true = load.at_known(read_depth(load.path))
            shares += (true[values > 0] / values[values > 0]).tolist()
    if len(shares) < _LEAST:
        return None
    middle = float(np.median(shares))
    agree = np.abs(np.array(shares) / middle - 1) < 2 * _NEAR
    return middle / world if agree.mean() >= _AGREE else None


def fitting_unit(median: float, near: float, far: float, told: float | None = None) -> str:
    """Write by which number depths are to be multiplied, that their median lies between near and far: usual
    units, or what is ``told`` otherwise, or from where to where.

    >>> fitting_unit(4000.0, 1.0, 10.0), fitting_unit(4.1, 200.0, 300.0)
    ('0.001', '49 to 73')
    """
    if told is not None:
        like = (unit for unit in _UNITS if abs(told / unit - 1) < _SAME_UNIT)
        return f"{next(like, told):.4g}"
    fits = [f"{unit:.4g}" for unit in _UNITS if near < unit * median < far]
    return " or ".join(fits) if fits else f"{near / median:.2g} to {far / median:.2g}"


def doubt_kind(
    groups: Sequence[Sequence[Frame]], known: Tensor | None, kind: str | None, where: object, usual: str
) -> list[str]:
    """Doubt that depth is along the axis, or along the rays, where views agree with the other: refuse it, or
    say so in a line if the kind was typed.

    Args:
        groups: of frames with depth, which are compared, less what moves where that is known.
        known: points (N, 3) that never move, world units.
        kind: as typed; None is ``usual``.
        where: of the error.
        usual: axis or ray.

    Raises:
        SceneError: naming the key.
    """
    taken = kind or usual
    other = METRIC[1 - METRIC.index(taken)]
    leans = []
    for some in groups:
        readings = [[_still(frame, each) for frame in some] for each in (taken, other)]
        leans.append(leaning([frame.camera for frame in some], readings, known))
    leans = [found for found in leans if found is not None]
    if not leans:
        return []
    share, mine, others = map(median, zip(*leans))
    if not _LEANS[0] < share < _LEANS[1] or others > mine:
        return []
    along = {"axis": "along the optical axis", "ray": "along the pixels' rays"}
    got = f"depths of which views differ by {mine:.2%}, and by {others:.2%} if they are {along[other]}"
    if kind is None:
        advice = f"set data.depth_kind={other}, or data.depth_kind={taken} if they are right"
        raise mismatch(where, f"depths {along[taken]}", got, advice)
    return [f"{where}: {got}; unless data.depth_kind={taken} is right, set data.depth_kind={other}"]


def _still(frame: Frame, kind: str) -> Tensor:
    """Return distances (H, W) along the rays, taken for a kind of depth, 0 where something moves."""
    away = replace(frame.load_sensed, kind=kind)()[0]
    return away if frame.load_moving is None else away * ~frame.load_moving()


def depths_beside(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Find the files of images' depth in a folder, by the images' names with or without their own folder.

    Raises:
        SceneError: where there is none at all, and where one is of two images.
    """
    if not folder.is_dir():
        raise mismatch("data.depth", "a folder of depths", folder, "set data.depth=null to do without")
    found = {name: path for name in names if (path := _beside(folder, name)) is not None}
    if not found:
        expected = f"depths named as images, {Path(names[0]).name}.npy or .png"
        raise mismatch(folder, expected, "none of them", "set data.depth=null to do without")
    image_of: dict[Path, str] = {}
    for name, path in found.items():
        if (first := image_of.setdefault(path, name)) != name:
            advice = "put them into folders as the images'"
            raise mismatch(path, "a depth for each image", f"one for {first} and {name}", advice)
    return found


def depths_named(paths: Mapping[str, Path]) -> tuple[dict[str, Path], list[str]]:
    """Keep those files of images' depth that are there; say in a line how many are not.

    Raises:
        SceneError: for one of another kind.
    """
    for path in paths.values():
        if path.suffix not in SUFFIXES:
            advice = "convert it, or set data.depth=off to do without"
            raise mismatch(path, f"a depth in {' or '.join(SUFFIXES)}", path.suffix or "no suffix", advice)
    there = {name: path for name, path in paths.items() if path.is_file()}
    if len(there) == len(paths):
        return there, []
    absent = next(path for name, path in paths.items() if name not in there)
    count = f"{len(paths) - len(there)} of {len(paths)}"
    return there, [f"{absent}: {count} depths are not there: images go without"]


def confidence_of(depth: Path, folder: Path) -> Path | None:
    """Find the confidence of a depth somewhere in ``folder``, by its name from there on in the folder
    ``confidence`` beside that; None without, and where the depth is ``folder`` itself.
    """
    if depth == folder:
        return None
    name = depth.relative_to(folder).with_suffix("").as_posix()
    return _stored(folder.parent / "confidence", name)


def _beside(folder: Path, name: str) -> Path | None:
    stems = name, name.partition("/")[2], name.rpartition("/")[2]
    return next(filter(None, (_stored(folder, stem) for stem in stems if stem)), None)


def _stored(folder: Path, name: str) -> Path | None:
    paths = (existing(folder / f"{name}{suffix}") for suffix in SUFFIXES)
    return next((path for path in paths if path.is_file()), None)


def read_depth(path: Path, *, signed: bool = False) -> np.ndarray:
    """Read depths (H, W) float64 of a file as ``SensedDepth`` takes them, holes as 0; ``signed``: any values,
    holes as NaN. The largest number of their type (65535 of a PNG) is a hole unless ``signed``.

    Raises:
        SceneError: for another shape, and for a depth below 0.
    """
    values = _numbers_in(path)
    depth = values.astype(np.float64)
    if not signed:
        depth[_are_full(values)] = 0
    depth[~np.isfinite(depth)] = np.nan if signed else 0
    if signed:
        return depth
    if (depth < 0).any():
        raise mismatch(path, "depths >= 0", f"{depth.min():g}", "write 0 where there is none")
    return depth


def _numbers_in(path: Path) -> np.ndarray:
    """Read the numbers (H, W) of a file of depths."""
    return _plane(read_gray16(path) if path.suffix == ".png" else load_numpy(path), path, "depths (H, W)")


def _plane(values: object, path: Path, expected: str) -> np.ndarray:
    """Check numbers (H, W), (H, W, 1) or (1, H, W) of a file and return them as (H, W)."""
    shape = getattr(values, "shape", ())
    if len(shape) == 3 and 1 in (shape[0], shape[2]):
        values = values[..., 0] if shape[2] == 1 else values[0]
    check_shape(values, path, expected, None, None)
    if values.dtype.kind != "f":
        return values
    with np.errstate(invalid="ignore"):  # from here on no NaN is of the signalling kind
        return np.where(np.isnan(values), values.dtype.type(np.nan), values)


def _are_full(values: np.ndarray) -> np.ndarray:
    """Tell which numbers are the largest of their type."""
    return values == (np.finfo if values.dtype.kind == "f" else np.iinfo)(values.dtype).max


def _confidences_in(path: Path) -> np.ndarray:
    """Read the numbers (H, W) of a file of confidences."""
    values = read_image(path)[..., 0].numpy() if path.suffix == ".png" else load_numpy(path)
    if getattr(values, "dtype", np.dtype(float)).kind == "b":
        values = values.astype(np.float64)
    return _plane(values, path, "confidences (H, W)")


def _read_confidence(path: Path, levels: bool | None) -> np.ndarray:
    """Read confidences (H, W) in [0, 1]: levels and bytes are whole numbers; see ``SensedDepth``."""
    values = _confidences_in(path)
    levels = values.max() <= LEVELS if levels is None else levels
    most = 1.0 if values.dtype.kind == "f" else float(LEVELS if levels else 255)
    if not (values.min() >= 0 and values.max() <= most):
        got = f"values from {values.min():g} to {values.max():g}"
        expected = "confidences from 0 to 1, or levels 0, 1, 2"
        advice = "write them alike in all files" if values.dtype.kind != "f" else ""
        raise mismatch(path, expected, got, advice)
    return np.asarray(values, np.float64) / most


def along_rays(planes: Tensor, camera: Camera, kind: str = "axis") -> Tensor:
    """Bring planes (C, H', W'), the first of a depth, to a camera's size, each pixel the nearest: (C, H, W);
    depth of a ``kind`` other than ``ray`` becomes the distance along the pixels' rays.
    """
    size = camera.height, camera.width
    planes = torch.nn.functional.interpolate(planes[None], size, mode="nearest-exact")[0]
    if kind != "ray":
        planes[0] /= _cosines(*camera.inner)
    return planes


@lru_cache(maxsize=8)
def _cosines(*inner: float | Lens | None) -> Tensor:
    """Return the depth along the optical axis (H, W) of what is at distance 1, of a camera's ``inner``; once
    for all images of a camera, as undoing a lens takes long.
    """
    camera = Camera.at_origin(*inner)
    return camera.rays(dtype=torch.float64).directions[:, 2].reshape(camera.height, camera.width).float()


def unit_of(paths: Sequence[Path], near: float, far: float) -> tuple[float, list[str]]:
    """Tell the unit of depths by which one puts their median between near and far, and in a line if it is not
    that of the file's world but a thousandth.

    Args:
        paths: of the depths, of which some are read.
        near, far: in units of the file's world.

    Raises:
        SceneError: where neither does, or all are holes.
    """
    depths = [read_depth(paths[i]) for i in spread(len(paths), _LOOKED_AT)]
    shown = [depth[(depth > 0) & ~_repeated(depth)] for depth in depths]
    there = np.concatenate(shown if any(map(len, shown)) else [depth[depth > 0] for depth in depths])
    if not there.size:
        raise mismatch(paths[0].parent, "depths above 0", "holes alone")
    median = float(np.median(there))
    for unit in (1.0, MILLIMETRES):
        if near / _BEYOND <= unit * median <= _BEYOND * far:
            line = "depths are taken for thousandths of the cameras' unit, as near and far say"
            return unit, [] if unit == 1 else [f"{paths[0].parent}: {line}"]
    ends = [_end_of_range(_numbers_in(paths[i])) for i in spread(len(paths), _LOOKED_AT)]
    if len(ends) >= _FITTED and None not in ends:
        got = f"ones whose largest is {max(ends):.6g} in each image, as if each was stretched to a range"
        raise mismatch(paths[0].parent, "depths of one unit", got, "write them so, or set data.depth=null")
    expected = f"depths between near and far, {near:.4g} and {far:.4g} in the cameras' unit, or thousandths"
    advice = f"multiply them by {fitting_unit(median, near, far)}"
    raise mismatch(paths[0].parent, expected, f"{median:.4g} in the median", advice)
