"""What moves in a film: pixels whose way through neighbouring images no point at rest explains.

Optical flow (DIS, of OpenCV) leads from each image to those before and after it. Where the cameras are known,
a point at rest lies on all rays through the pixels that show it; what misses them moves. Nothing is asked of
any fitted model.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch

from forewarp.data.images import read_image
from forewarp.scene.camera import Camera

_SIDE, _STEP = 480, 4  # pixels of the longer side in which flow is measured; between two pixels looked at
_REACH = 5  # images before and after that a pixel is followed through
_AGREE, _SLOPPY = 0.5, 0.05  # pixels, and share of the flow, by which there and back may differ
_LEAST = 4  # images of a pixel's way from which on it is known
_TELLS = 0.3  # share of an image's pixels that must be known; of photos far apart hardly one is
_OFF = 2.0  # pixels by which a point at rest may miss its way
_SPECK, _GAP = 3, 5  # of the grid: smaller spots, and smaller holes, are noise


def moving_masks(paths: Sequence[Path], cameras: Sequence[Camera]) -> Iterator[np.ndarray]:
    """Yield for each image which of its pixels move, bool (H, W), in order.

    What is not followed far enough, as it disappears or lies on the border, is as the nearest pixel that is.
    A thing that stays at rest for ``_REACH`` images before and after does not move in these; nor does what
    moves exactly along the rays of a camera that stands.

    Args:
        paths: images of one size, in the order of time.
        cameras: of each.

    Cost: for an image of 480 x 360 about 40 ms of flow and 150 ms of geometry on one core.
    """
    scale = min(1.0, _SIDE / max(cameras[0].width, cameras[0].height))
    size = round(cameras[0].width * scale), round(cameras[0].height * scale)
    small = [camera.resized(*size) for camera in cameras]
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)

    @lru_cache(maxsize=2 * _REACH + 2)
    def grey(i: int) -> np.ndarray:
        image = read_image(paths[i]).numpy()[..., :3]
        return cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)

    @lru_cache(maxsize=4 * _REACH + 4)
    def flow(i: int, j: int) -> np.ndarray:
        return search.calc(grey(i), grey(j), None)

    y, x = np.mgrid[_STEP // 2 : size[1] : _STEP, _STEP // 2 : size[0] : _STEP].astype(np.float32)
    for i, camera in enumerate(cameras):
        ways = {i: (x, y, np.ones(x.shape, bool))}
        for direction in (1, -1):
            way = ways[i]
            for j in range(i, i + direction * _REACH, direction):
                if not 0 <= j + direction < len(paths):
                    break
                way = ways[j + direction] = _followed(way, flow(j, j + direction), flow(j + direction, j))
        off, known = _missed(ways, small)
        moves = _whole(off > _OFF, known).astype(np.float32)
        yield cv2.resize(moves, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR) > 0.5


def _followed(way: tuple, there: np.ndarray, back: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Follow pixels (h, w) to the next image: x, y, and whether they are still in sight: back leads where
    they came from.
    """
    x, y, seen = way

    def at(flow: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return cv2.remap(flow, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e6, 1e6))

    went = at(there, x, y)
    new_x, new_y = x + went[..., 0], y + went[..., 1]
    came = at(back, new_x, new_y)
    off, length = np.hypot(*(went + came).transpose(2, 0, 1)), np.hypot(*went.transpose(2, 0, 1))
    seen = seen & (off < _AGREE + _SLOPPY * length)
    return np.where(seen, new_x, x), np.where(seen, new_y, y), seen


def _missed(ways: dict, cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Return by how many pixels at most the point nearest to all rays of a way misses it (h, w), and whether
    the way is long enough to tell.
    """
    shape = next(iter(ways.values()))[0].shape
    pixels, normal, moment = {}, torch.zeros(*shape, 3, 3).double(), torch.zeros(*shape, 3).double()
    for i, (x, y, seen) in ways.items():
        pixels[i] = torch.from_numpy(np.stack([x, y], -1)) + 0.5, torch.from_numpy(seen)
        ray = cameras[i].directions(*pixels[i][0].unbind(-1))
        across = torch.eye(3).double() - ray[..., :, None] * ray[..., None, :]
        across = across * pixels[i][1][..., None, None]
        normal, moment = normal + across, moment + across @ cameras[i].center.double()
    point = torch.linalg.solve(normal + 1e-9 * torch.eye(3).double(), moment)
    off, count = torch.zeros(shape).double(), torch.zeros(shape)
    for i, (pixel, seen) in pixels.items():
        there, depth = cameras[i].project(point)
        miss = torch.where(depth > 0, (there - pixel).norm(dim=-1), torch.inf)
        off, count = torch.where(seen, torch.maximum(off, miss), off), count + seen
    return off.numpy(), (count >= _LEAST).numpy()


def _whole(moves: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Drop specks of a mask (h, w), give what is not known the value of the nearest that is, fill holes."""

    def away_from(mask: np.ndarray) -> np.ndarray:
        return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)

    def filtered(mask: np.ndarray, kind: int, width: int) -> np.ndarray:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
        return cv2.morphologyEx(mask.astype(np.uint8), kind, disc) > 0

    sure = filtered(moves & known, cv2.MORPH_OPEN, _SPECK)
    if not sure.any() or known.mean() < _TELLS:
        return np.zeros_like(sure)
    mask = away_from(sure) <= away_from(known & ~sure)
    mask = filtered(filtered(mask, cv2.MORPH_OPEN, _SPECK), cv2.MORPH_CLOSE, _GAP)
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros(mask.shape, np.uint8), outlines, -1, 1, cv2.FILLED) > 0
