"""Step three of a capture: refuse one of which nothing good would come, and say what to film otherwise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from forewarp.capture.frames import Frames
from forewarp.capture.poses import Reconstruction
from forewarp.data.cameras import check_lens
from forewarp.data.files import SceneError

MIN_FEATURES = 60  # of an image, in the median
STILL = 0.01  # share of an image's longer side: a camera that stands shifts less
BLURRED = 2.5  # pixels of an image 640 wide, as ``frames.edge_width`` has them
TURNED = 0.06  # share of the shift that no rotation of the camera explains
MIN_MODEL, MIN_REGISTERED = 3, 0.5  # images; share of them, where poses are searched for
MAX_DEGREES = 130.0
MAX_ERROR = 2.5  # pixels
MIN_PARALLAX = 0.01  # the extent of the cameras' places as a share of the distance of what they see
_PAIRS, _MIN_INLIERS = 60, 30  # of images that are looked at; matches of each
_SHIFTS = 0.03, 0.4  # of pairs in which a rotation and a step can be told apart
_FOCAL_LENGTHS = (0.6, 0.8, 1.0, 1.25, 1.6, 2.0)  # shares of the longer side that are tried
_WALK = "it only turns, or moves before something flat: walk around the subject, not along a wall"


@dataclass(frozen=True)
class Evidence:
    """What features and matches tell.

    Attributes:
        features: of an image, in the median.
        shift: how far the matches of a pair are apart, the most in any pair; share of the longer side.
        unrotated: share of the shift that no rotation of the camera explains; 1: not known.
    """

    features: float
    shift: float
    unrotated: float


def refuse_matches(database: Path, frames: Frames) -> None:
    """Refuse images without features, and cameras that stand or only turn.

    Raises:
        ValueError: with what was found, and advice.
    """
    evidence = evidence_of(database)
    if evidence.features < MIN_FEATURES:
        raise ValueError(
            "pictures: expected hundreds of features to match, but got "
            f"{evidence.features:.0f} in a picture; {_advice(evidence, frames)}"
        )
    if evidence.shift < STILL:
        raise ValueError(
            f"camera: expected one that moves, but got matches that shift by {100 * evidence.shift:.1f} % of "
            "the picture at most; walk around the subject while filming"
        )
    if evidence.unrotated < TURNED:
        raise ValueError(
            "camera: expected one that moves around things near and far, but got one where "
            f"{100 - 100 * evidence.unrotated:.0f} % of all shift is explained by turning it; {_WALK}"
        )


def refuse_poses(found: Reconstruction | None, frames: Frames, database: Path | None = None) -> None:
    """Refuse poses of too few images, of a fisheye, of cameras that hardly move, and those that do not fit.

    Args:
        found: None: nothing was found.
        frames: which were to be registered.
        database: of features and matches, from which advice comes; None: the poses were known.

    Raises:
        ValueError: with what was found, and advice.
    """
    registered, total = 0 if found is None else len(found.cameras), len(frames.times)
    if database is None and registered < MIN_MODEL:
        raise ValueError(
            f"colmap: expected a model of at least {MIN_MODEL} pictures, but got {registered}; set another"
        )
    if database is not None and registered < max(MIN_MODEL, MIN_REGISTERED * total):
        advice = _advice(evidence_of(database), frames)
        raise ValueError(
            f"poses: expected most of {total} pictures registered, but got {registered}; {advice}"
        )
    if not len(found.seen):
        raise ValueError(
            "poses: expected points that cameras see, but got none; keep points3D and its tracks in it"
        )
    for camera in found.cameras.values():
        if (camera.width, camera.height) != frames.size:
            raise ValueError(
                "colmap: expected cameras of {} x {} pixels, as the pictures, but got {} x {}; set images= to"
                " the pictures that the model was made from".format(*frames.size, camera.width, camera.height)
            )
    degrees = np.degrees(2 * np.arctan(camera.width / (2 * camera.fx)))
    try:
        check_lens(camera, "lens")
        if degrees > MAX_DEGREES:
            raise SceneError(f"lens: expected at most {MAX_DEGREES:.0f} degrees, but got {degrees:.0f}")
    except SceneError as error:
        text = str(error).partition(";")[0]
        raise ValueError(
            f"{text}; if it is a fisheye, film without it or undistort first; else {_WALK}"
        ) from error
    extent = np.linalg.norm(found.centers - np.median(found.centers, axis=0), axis=1).max()
    parallax = extent / np.median(found.distances())
    if parallax < MIN_PARALLAX:
        raise ValueError(
            f"camera: expected one that moves around things near and far, but got places that are "
            f"{100 * parallax:.2f} % of the distance apart; {_WALK}"
        )
    if found.error > MAX_ERROR:
        raise ValueError(
            f"poses: expected a reprojection error of at most {MAX_ERROR} pixels, but got {found.error:.1f}; "
            "give masks= of what moves"
        )


def evidence_of(database: Path) -> Evidence:
    """Read what a database tells of its images.

    Cost: of some 60 pairs, under a second.
    """
    shifts, shares = [], []
    with pycolmap.Database.open(database) as base:
        numbers = [image.image_id for image in base.read_all_images()]
        camera = base.read_all_cameras()[0]
        side, middle = max(camera.width, camera.height), np.array([camera.width, camera.height]) / 2
        features = float(np.median([base.num_keypoints_for_image(number) for number in numbers]))
        keys, counts = base.read_two_view_geometry_num_inliers()
        pairs = [pycolmap.pair_id_to_image_pair(k) for k, n in zip(keys, counts) if n >= _MIN_INLIERS]
        for pair in pairs[:: max(1, len(pairs) // _PAIRS)]:
            matches = base.read_two_view_geometry(*pair).inlier_matches.T
            places = [base.read_keypoints(number)[rows, :2] for number, rows in zip(pair, matches)]
            first, second = ((place - middle) / side for place in places)
            shifts.append(float(np.median(np.linalg.norm(second - first, axis=1))))
            if _SHIFTS[0] <= shifts[-1] <= _SHIFTS[1]:
                shares.append(min(unrotated(first, second, focal) for focal in _FOCAL_LENGTHS))
    return Evidence(features, max(shifts, default=1.0), float(np.median(shares)) if shares else 1.0)


def unrotated(first: np.ndarray, second: np.ndarray, focal: float) -> float:
    """Return the share of the shift of matches that no rotation of the camera explains, in the median.

    Args:
        first, second: (M, 2) from the middle of the image, as shares of its longer side.
        focal: in that unit.

    The best rotation of the rays is fitted repeatedly to the better half of them, as others may be wrong.
    """
    rays = [np.concatenate([ends, np.full((len(ends), 1), focal)], 1) for ends in (first, second)]
    a, b = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
    kept = np.arange(len(a))
    for _ in range(4):
        u, _, v = np.linalg.svd(b[kept].T @ a[kept])
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
        residual = np.linalg.norm(a @ rotation.T - b, axis=1)
        kept = np.argsort(residual)[: max(3, len(residual) // 2)]
    return float(np.median(residual) / max(np.median(np.linalg.norm(b - a, axis=1)), 1e-9))


def _advice(evidence: Evidence, frames: Frames) -> str:
    """Say what the evidence calls for."""
    if frames.edges > BLURRED:
        return (
            f"edges are {frames.edges:.0f} pixels wide (of 640): the pictures are blurred; film slower, "
            "and in more light"
        )
    if evidence.features < MIN_FEATURES and frames.masks is not None:
        return "there is no texture but on what the masks call moving; put textured things around it"
    if evidence.features < MIN_FEATURES:
        return "there is hardly any texture; put textured things around the subject, as newspapers"
    more = "take more pictures" if frames.originals else "take more frames (frames=)"
    return (
        f"film slower and with more of what stands still in the picture, {more}, or give masks= of what moves"
    )
