"""Refuse a capture of which nothing good would come, and say what to film otherwise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from forewarp.capture.pictures import Pictures
from forewarp.capture.sparse import Sparse
from forewarp.data.cameras import check_lens
from forewarp.data.files import SceneError

FEW_FEATURES = 60  # of a picture, in the median
STILL = 0.01  # share of a picture's longer side: a camera that stands shifts less
BLURRED = 2.5  # pixels of a picture 640 wide, as ``sharpness.edge_width`` has them
TURNED = 0.06  # share of the shift that no turn of the camera explains
LEAST_MODEL, LEAST_REGISTERED = 3, 0.5  # pictures; share of them, where poses are searched for
WIDEST = 130.0  # degrees
WORST_ERROR = 2.5  # pixels
LEAST_PARALLAX = 0.01  # the extent of the cameras' places as a share of the distance of what they see
_AROUND = "it only turns, or moves before something flat: walk around the subject, not along a wall"
_PAIRS = 60  # of pictures that are looked at
_SHIFTS = 0.03, 0.4  # of pairs in which a turn and a step can be told apart
_FOCAL = (0.6, 0.8, 1.0, 1.25, 1.6, 2.0)  # shares of the longer side that are tried


@dataclass(frozen=True)
class Evidence:
    """What features and matches tell: the median number of ``features`` of a picture; ``shift``, how far the
    matches of a pair are apart, the most in any pair, and ``unturned``, the share of it that no turn of the
    camera explains (1: not known); both as shares of the longer side and of the shift.
    """

    features: float
    shift: float
    unturned: float


def refuse_matches(database: Path, pictures: Pictures) -> None:
    """Refuse pictures without features, and cameras that stand or only turn.

    Raises:
        ValueError: with what was found, and advice.
    """
    found = evidence_of(database)
    if found.features < FEW_FEATURES:
        raise ValueError(f"{_sentence(found, pictures)}; {_advice(found, pictures)}")
    if found.shift < STILL:
        raise ValueError(
            f"camera: expected one that moves, but got matches that shift by {100 * found.shift:.1f} % of "
            "the picture at most; walk around the subject while filming"
        )
    if found.unturned < TURNED:
        raise ValueError(
            "camera: expected one that moves around things near and far, but got one where "
            f"{100 - 100 * found.unturned:.0f} % of all shift is explained by turning it; {_AROUND}"
        )


def refuse_poses(sparse: Sparse | None, pictures: Pictures, database: Path | None = None) -> None:
    """Refuse poses of too few pictures, of a fisheye, of cameras that hardly move, and those that do not fit.

    Args:
        sparse: None: nothing was found.
        pictures: which were to be registered.
        database: of features and matches, from which advice comes.

    Raises:
        ValueError: with what was found, and advice.
    """
    registered, total = 0 if sparse is None else len(sparse.cameras), len(pictures.times)
    if database is None and registered < LEAST_MODEL:
        raise ValueError(
            f"colmap: expected a model of at least {LEAST_MODEL} pictures, but got {registered}; set another"
        )
    if database is not None and registered < max(LEAST_MODEL, LEAST_REGISTERED * total):
        advice = _advice(evidence_of(database), pictures)
        raise ValueError(
            f"poses: expected most of {total} pictures registered, but got {registered}; {advice}"
        )
    if not len(sparse.seen):
        raise ValueError(
            "poses: expected points that cameras see, but got none; keep points3D and its tracks in it"
        )
    for camera in sparse.cameras.values():
        if (camera.width, camera.height) != pictures.size:
            expected, got = "{} x {}".format(*pictures.size), f"{camera.width} x {camera.height}"
            raise ValueError(
                f"colmap: expected cameras of {expected} pixels, as the pictures, but got {got}; set images= "
                "to the pictures that the model was made from"
            )
    degrees = np.degrees(2 * np.arctan(camera.width / (2 * camera.fx)))
    try:
        check_lens(camera, "lens")
        if degrees > WIDEST:
            raise SceneError(f"lens: expected at most {WIDEST:.0f} degrees, but got {degrees:.0f}")
    except SceneError as error:
        text = str(error).partition(";")[0]
        raise ValueError(
            f"{text}; if it is a fisheye, film without it or undistort first; else {_AROUND}"
        ) from error
    centers = np.stack([np.asarray(one.center) for one in sparse.cameras.values()])
    extent = float(np.linalg.norm(centers - np.median(centers, axis=0), axis=1).max())
    parallax = extent / float(np.median(sparse.distances()))
    if parallax < LEAST_PARALLAX:
        raise ValueError(
            f"camera: expected one that moves around things near and far, but got places that are "
            f"{100 * parallax:.2f} % of the distance apart; {_AROUND}"
        )
    if sparse.error > WORST_ERROR:
        raise ValueError(
            f"poses: expected a reprojection error of at most {WORST_ERROR} pixels, but got "
            f"{sparse.error:.1f}; give masks= of what moves"
        )


def evidence_of(database: Path) -> Evidence:
    """Read what a database tells of its pictures.

    Cost: of some 60 pairs, under a second.
    """
    import pycolmap

    with pycolmap.Database.open(database) as base:
        images = {image.image_id: image for image in base.read_all_images()}
        camera = base.read_all_cameras()[0]
        side, middle = max(camera.width, camera.height), np.array([camera.width, camera.height]) / 2
        counts = [base.num_keypoints_for_image(number) for number in images]
        pairs = []
        for first, second, matches in _some(base):
            ends = [
                (base.read_keypoints(n)[rows, :2] - middle) / side
                for n, rows in zip((first, second), matches.T)
            ]
            pairs.append(ends)
    shifts = [float(np.median(np.linalg.norm(b - a, axis=1))) for a, b in pairs]
    useful = [pair for pair, shift in zip(pairs, shifts) if _SHIFTS[0] <= shift <= _SHIFTS[1]]
    rest = [min(unturned(a, b, focal) for focal in _FOCAL) for a, b in useful]
    return Evidence(
        float(np.median(counts)), max(shifts, default=1.0), float(np.median(rest)) if rest else 1.0
    )


def _some(base):
    """Yield some verified pairs: both images and the rows (M, 2) of their features that match."""
    keys, counts = base.read_two_view_geometry_num_inliers()
    import pycolmap

    good = [pycolmap.pair_id_to_image_pair(key) for key, count in zip(keys, counts) if count >= 2 * 15]
    every = max(1, len(good) // _PAIRS)
    for first, second in good[::every]:
        yield first, second, base.read_two_view_geometry(first, second).inlier_matches


def unturned(first: np.ndarray, second: np.ndarray, focal: float) -> float:
    """The share of the shift of matches that no turn of the camera explains, in the median.

    Args:
        first, second: (M, 2) from the middle of the picture, as shares of its longer side.
        focal: in that unit.

    The best turn of the rays is fitted to the better half of them again and again, as others may be wrong.
    """
    rays = [np.concatenate([ends, np.full((len(ends), 1), focal)], 1) for ends in (first, second)]
    a, b = (one / np.linalg.norm(one, axis=1, keepdims=True) for one in rays)
    kept = np.arange(len(a))
    for _ in range(4):
        u, _, v = np.linalg.svd(b[kept].T @ a[kept])
        turn = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
        off = np.linalg.norm(a @ turn.T - b, axis=1)
        kept = np.argsort(off)[: max(3, len(off) // 2)]
    return float(np.median(off) / max(np.median(np.linalg.norm(b - a, axis=1)), 1e-9))


def _sentence(found: Evidence, pictures: Pictures) -> str:
    return f"pictures: expected hundreds of features to match, but got {found.features:.0f} in a picture"


def _advice(found: Evidence, pictures: Pictures) -> str:
    """The advice that the evidence calls for."""
    if pictures.edges > BLURRED:
        return (
            f"edges are {pictures.edges:.0f} pixels wide (of 640): the pictures are blurred; film slower, "
            "and in more light"
        )
    if found.features < FEW_FEATURES and pictures.masks is not None:
        return "there is no texture but on what the masks call moving; put textured things around it"
    if found.features < FEW_FEATURES:
        return "there is hardly any texture; put textured things around the subject, as newspapers"
    more = "take more pictures" if pictures.originals else "take more frames (frames=)"
    return (
        f"film slower and with more of what stands still in the picture, {more}, or give masks= of what moves"
    )
