"""What moves in a film: pixels whose way through neighbouring images no point at rest explains.

Optical flow (DIS, of OpenCV) leads from each image to those before and after it. Where the cameras are known,
a point at rest lies on all rays through the pixels that show it; what misses them moves. Nothing is asked of
any fitted model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch

from forewarp.capture.frames import Progress
from forewarp.data.images import read_image
from forewarp.scene.camera import Camera

_SIDE, _STEP = 480, 4  # pixels of the longer side in which flow is measured; between two pixels looked at
_LEAST_SIDE, _FAR = 32, 1e6  # pixels that the flow needs; distance at which nothing shifts
_REACH = 5  # images before and after that a pixel is followed through
_AGREE, _SLOPPY = 0.5, 0.05  # pixels, and share of the flow, by which there and back may differ
_LEAST = 4  # images of a pixel's way from which on it is known
_TELLS = 0.3  # share of an image's pixels that must be known; of photos far apart hardly one is
_OFF, _CREPT = 2.0, 3.0  # pixels by which a point at rest may miss its way: of a few images, of a whole film
_LOOKS = 40  # images of a whole film in which a way is looked at
# Of 255: least change of what moves before a fixed camera, and how many deviations of a pixel's noise it is.
_CHANGE, _NOISE = 14.0, 5.0
_SPECK, _GAP = 3, 5  # of the grid: smaller spots, and smaller holes, are noise
_OWN_SIDE = 320  # pixels of the longer side in which a camera's own motion is looked for
# Gradient of texture; pixels of 640; share that rests if a camera is fixed.
_EDGES, _RESTS, _AT_REST = 20.0, 1.0, 0.5


def moving_masks(
    paths: Sequence[Path], cameras: Sequence[Camera], progress: Progress = lambda *_: None
) -> list[np.ndarray] | None:
    """Tell which pixels of each image of a film move, bool (h, w) at most 480 wide or high: none of an image
    in which too few can be followed to tell. None where most images are such, as photos far apart.

    What is not followed far enough, as it disappears or lies on the border, is as the nearest pixel that is.
    A thing that stays at rest for ``_REACH`` images before and after does not move in these; nor does what
    moves exactly along the rays of a camera that stands, or what a camera follows as if it were far away.

    Args:
        paths: images of one size, in the order of time.
        cameras: of each.
        progress: called with images done and all.

    Cost: for an image of 480 x 360 about 40 ms of flow and 50 ms of geometry on one core, 200 with a lens.
    """
    film, masks = _Film(paths, cameras), []
    for i in range(len(paths)):
        masks.append(film.where(_OFF, film.tracks(i, range(i - _REACH, i + _REACH + 1))))
        progress(len(masks), len(paths))
    known = [mask for mask in masks if mask is not None]
    if 2 * len(known) <= len(masks):
        return None
    return [np.zeros_like(known[0]) if mask is None else mask for mask in masks]


def resting_masks(
    paths: Sequence[Path], cameras: Sequence[Camera], which: Sequence[int]
) -> list[np.ndarray | None]:
    """Tell which pixels of some images rest in the whole film, bool (h, w), as far as they can be followed;
    None for an image in which too few can. A way of seconds is not exact to a pixel: what creeps may count
    as resting. See ``moving_masks``.

    Cost: for each of them the flow of all images that a pixel is followed to, 25 ms an image.
    """
    film, every, masks = _Film(paths, cameras), max(1, len(paths) // _LOOKS), []
    for i in which:
        tracks = film.tracks(i, range(len(paths))).items()
        moves = film.where(_CREPT, {j: t for j, t in tracks if abs(j - i) <= _REACH or (j - i) % every == 0})
        masks.append(None if moves is None else ~moves)
    return masks


class _Film:
    """A film's images, made small, and the flow between neighbours."""

    def __init__(self, paths: Sequence[Path], cameras: Sequence[Camera]) -> None:
        scale = min(1.0, _SIDE / max(cameras[0].width, cameras[0].height))
        sides = cameras[0].width, cameras[0].height
        self.paths, self.size = paths, [max(_LEAST_SIDE, round(scale * length)) for length in sides]
        self.cameras = [camera.resized(*self.size) for camera in cameras]
        self.search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self.grey = lru_cache(maxsize=2 * _REACH + 2)(self._grey)
        self.flow = lru_cache(maxsize=4 * _REACH + 4)(self._flow)

    def _grey(self, i: int) -> np.ndarray:
        return _small_grey(read_image(self.paths[i]).numpy()[..., :3], self.size)

    def _flow(self, i: int, j: int) -> np.ndarray:
        return self.search.calc(self.grey(i), self.grey(j), None)

    def tracks(self, i: int, among: range) -> dict[int, tuple]:
        """Follow a grid of pixels of an image to those ``among`` that there are: see ``_followed``."""
        y, x = np.mgrid[_STEP // 2 : self.size[1] : _STEP, _STEP // 2 : self.size[0] : _STEP]
        first = x.astype(np.float32), y.astype(np.float32), np.ones(x.shape, bool)
        tracks = {i: first}
        for direction in (1, -1):
            track, j = first, i + direction
            while j in among and 0 <= j < len(self.paths) and track[2].any():
                before = j - direction
                track = tracks[j] = _followed(track, self.flow(before, j), self.flow(j, before))
                j += direction
        return tracks

    def where(self, off: float, tracks: dict) -> np.ndarray | None:
        """Tell which pixels (h, w) are more than ``off`` pixels away from where they would be at rest; None
        where too few are known.
        """
        error, is_known = _errors(tracks, self.cameras)
        if is_known.mean() < _TELLS:
            return None
        moves = _whole(error > off, is_known).astype(np.float32)
        return cv2.resize(moves, self.size, interpolation=cv2.INTER_LINEAR) > 0.5


@dataclass(frozen=True)
class Still:
    """What a fixed camera sees where nothing moves: ``image`` (h, w, 3) of 255, at most 480 wide or high, and
    how much each of its pixels must change to move (h, w).
    """

    image: np.ndarray
    least: np.ndarray

    @classmethod
    def of(cls, images: Sequence[np.ndarray]) -> Still:
        """Take the median of a few images (H, W, 3) uint8 over time, and of the changes from it."""
        small = np.stack([_reduced(image) for image in images])
        middle = np.median(small, axis=0)
        noise = 1.4826 * np.median([_changes(image, middle) for image in small], axis=0)
        return cls(middle, np.maximum(_CHANGE, _NOISE * noise))

    def moves(self, image: np.ndarray) -> np.ndarray:
        """Tell which pixels (h, w) of an image (H, W, 3) uint8 differ from the still, but for specks.

        A change of the light as a whole does not count; shadows do.

        **Cost** 3 ms.
        """
        changed = _changes(_reduced(image), self.image) > self.least
        return _whole(changed, np.ones(changed.shape, bool))


def is_fixed(images: Sequence[np.ndarray]) -> bool:
    """Tell whether a camera stands: what has texture rests between most of its images (H, W, 3) uint8.

    Movers may fill some of the image, the median over the textured pixels does not heed them.
    """
    scale = _OWN_SIDE / max(images[0].shape[:2])
    size = [max(_LEAST_SIDE, round(scale * length)) for length in images[0].shape[1::-1]]
    first, *others = (_small_grey(image, size) for image in images)
    textured = np.hypot(*(cv2.Sobel(first, cv2.CV_32F, *axis) for axis in ((1, 0), (0, 1)))) > _EDGES
    looked_at, rests = textured if textured.mean() > 0.01 else ..., []
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    for other in others:
        lengths = np.hypot(*search.calc(first, other, None).transpose(2, 0, 1))[looked_at]
        rests.append(float((lengths * 640 / _OWN_SIDE < _RESTS).mean()))
    return float(np.median(rests)) > _AT_REST


def _small_grey(image: np.ndarray, size: Sequence[int]) -> np.ndarray:
    """Make a small grey image (h, w) of (H, W, 3) uint8; ``size`` is (w, h)."""
    return cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)


def _reduced(image: np.ndarray) -> np.ndarray:
    """Make an image (H, W, 3) at most 480 wide or high, float32."""
    scale = min(1.0, _SIDE / max(image.shape[:2]))
    size = [max(1, round(scale * length)) for length in image.shape[1::-1]]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _changes(image: np.ndarray, still: np.ndarray) -> np.ndarray:
    """Measure by how much each pixel (h, w) differs in the channel that differs most."""
    change = image - still
    return np.abs(change - np.median(change, axis=(0, 1))).max(-1)


def _followed(track: tuple, forward: np.ndarray, backward: np.ndarray) -> tuple:
    """Follow pixels (h, w) to the next image: x, y, and whether they are still in sight: back leads where
    they came from.
    """
    x, y, seen = track

    def at(flow: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return cv2.remap(flow, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e6, 1e6))

    went = at(forward, x, y)
    new_x, new_y = x + went[..., 0], y + went[..., 1]
    came = at(backward, new_x, new_y)
    off, length = np.hypot(*(went + came).transpose(2, 0, 1)), np.hypot(*went.transpose(2, 0, 1))
    seen = seen & (off < _AGREE + _SLOPPY * length)
    return np.where(seen, new_x, x), np.where(seen, new_y, y), seen


def _errors(tracks: dict, cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Return by how many pixels at most the point nearest to all rays of a track misses it (h, w), or a point
    far along them, where that is less; and whether the track is long enough to tell.

    Of nearly parallel rays the nearest point may lie anywhere, also behind the camera.
    """
    shape = next(iter(tracks.values()))[0].shape
    pixels, normal, eye = {}, torch.zeros(*shape, 3, 3).double(), torch.eye(3).double()
    moment = mean_ray = torch.zeros(*shape, 3).double()
    for i, (x, y, seen) in tracks.items():
        pixels[i] = torch.from_numpy(np.stack([x, y], -1)) + 0.5, torch.from_numpy(seen)
        ray = cameras[i].directions(*pixels[i][0].unbind(-1)) * pixels[i][1][..., None]
        across = eye * pixels[i][1][..., None, None] - ray[..., :, None] * ray[..., None, :]
        normal, moment = normal + across, moment + across @ cameras[i].center.double()
        mean_ray = mean_ray + ray
    nearest = torch.linalg.solve(normal + 1e-9 * eye, moment)
    far = _FAR * torch.nn.functional.normalize(mean_ray, dim=-1)
    errors, count = torch.zeros(2, *shape).double(), sum(seen.int() for _, seen in pixels.values())
    for i, (pixel, seen) in pixels.items():
        shown, depth = cameras[i].project(torch.stack([nearest, far]))
        error = torch.where(depth > 0, (shown - pixel).norm(dim=-1), torch.inf)
        errors = torch.where(seen, torch.maximum(errors, error), errors)
    return errors.amin(0).numpy(), (count >= _LEAST).numpy()


def resized_mask(mask: np.ndarray, size: Sequence[int]) -> np.ndarray:
    """Give a mask (h, w) bool another ``size``, (width, height), by its nearest pixels."""
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def _whole(moves: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Drop specks of a mask (h, w), give what is not known the value of the nearest that is, fill holes."""

    def away_from(mask: np.ndarray) -> np.ndarray:
        return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)

    def filtered(mask: np.ndarray, kind: int, width: int) -> np.ndarray:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
        return cv2.morphologyEx(mask.astype(np.uint8), kind, disc) > 0

    sure = filtered(moves & known, cv2.MORPH_OPEN, _SPECK)
    if not sure.any():
        return sure
    mask = away_from(sure) <= away_from(known & ~sure)
    mask = filtered(filtered(mask, cv2.MORPH_OPEN, _SPECK), cv2.MORPH_CLOSE, _GAP)
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros(mask.shape, np.uint8), outlines, -1, 1, cv2.FILLED) > 0
