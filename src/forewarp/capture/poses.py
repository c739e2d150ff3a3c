"""Step two of a capture: find cameras and points, or read those of a COLMAP model; refuse bad ones."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import torch

from forewarp.capture.frames import Frames, Progress
from forewarp.data.cameras import check_lens
from forewarp.data.directions import inverted, opposite, other_readings
from forewarp.data.files import SceneError, composed, mismatch, opened
from forewarp.data.images import by
from forewarp.files import MOST_FILM, memory_within
from forewarp.scene.camera import Camera, Lens

pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value  # print nothing but what ends it

_OVERLAP = 6  # of sequential matching: the next six images, and those at 1, 2, 4 ... 512
_FEW = 40  # images of which every pair is matched
_FEATURE_SIDE = 1600  # pixels of the longer side in which features are looked for
_LOOK = 24  # images, at most, that are looked at before all
_BATCH, _PAIR_BATCH = 8, 48  # images and pairs between two updates of the progress
# Of the last adjustment: a point is sure from so many views and up to so many pixels of error; a camera keeps
# its other points if it has fewer sure ones; an error of so many pixels hardly counts.
_SURE_VIEWS, _SURE_ERROR, _MIN_POINTS, _LOSS_SCALE = 4, 1.5, 30, 0.5
# Of a search: degrees between rays of the first two images, whether lenses bend rays from the start or
# by the last adjustment alone, and another seed. COLMAP's own first; a share of many images is enough.
_TRIES = (16.0, True, 0), (16.0, False, 0), (8.0, True, 0), (6.0, False, 1), (16.0, True, 2)
_ALL = 0.9
_START_VIEWS, _START_ERROR = 3, 1.5  # of points that particles begin from
# In pixels of an image up to 640 wide: shift up to which a match stands still, from which on it moves, and
# distance from lines through one point up to which matches may be of a camera that does not turn.
_STILL, _MOVES, _STRAIGHT = 1.0, 5.0, 2.0
_CELLS, _BURNT_PAIRS = 32, 240  # along the longer side; pairs that are looked at
# A cell is burnt in if it has matches that stand still in such a share of the pairs and in so many, and they
# are such a share of its matches. Films without have 0.02 at most, captions 0.1 to 0.4, logos 1.
_BURNT_SHARE, _BURNT_LEAST, _BURNT_MATCHES = 0.04, 5, 0.5
_BURNT_MOST = 0.3  # share of the image: more than that is the world behind something that moves
# Camera models of Brown's distortion; a ``k`` of another, as of SIMPLE_DIVISION, is another lens.
_MODELS = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"}
_READINGS = {  # what else may be in a model
    "they are camera-to-world (invert them)": inverted,
    "their axes are OpenGL's (negate the camera's y and z)": opposite,
}
_SAME_PLACE = 1e-6  # of the distance from the origin; models have six digits or more
_ROOM = 1 << 30  # bytes that reading a model may take beside twenty times its files
_PARTS = "cameras", "images", "points3D"  # files of a model
_SAME = 1e-3  # share by which two models of the same images may differ; some write six digits
_PLACES = ("", "sparse/0", "sparse", "colmap/sparse/0")  # of a model in a folder that is given
Pairs = Sequence[tuple[str, str]]  # of images, by their names
_PARAMETERS = {"f", "fx", "fy", "cx", "cy", "k", "k1", "k2", "k3", "p1", "p2"}


@dataclass(frozen=True)
class Reconstruction:
    """Cameras and points.

    Attributes:
        cameras: by the image's name, in the order of time, near and far 0.
        points: (N, 3).
        colors: (N, 3) uint8.
        errors: (N,), reprojection errors in pixels.
        views: (N,), how many images see each point.
        seen: (M, 2), which camera sees which point.
        error: mean over all observations, pixels; of a search of ours, before doubtful points were deleted.
        absent: images of the model that were left out, as there is no picture of them.
    """

    cameras: dict[str, Camera]
    points: np.ndarray
    colors: np.ndarray
    errors: np.ndarray
    views: np.ndarray
    seen: np.ndarray
    error: float
    absent: Sequence[str] = ()

    @property
    def centers(self) -> np.ndarray:
        """Where the cameras are (C, 3)."""
        return np.stack([np.asarray(camera.center) for camera in self.cameras.values()])

    def distances(self) -> np.ndarray:
        """From each camera to each point that it sees (M,)."""
        return np.linalg.norm(self.points[self.seen[:, 1]] - self.centers[self.seen[:, 0]], axis=1)

    def sure(self) -> np.ndarray:
        """Choose the points (K, 3) that are sure enough to begin with; all, if none is."""
        sure = (self.views >= _START_VIEWS) & (self.errors <= _START_ERROR)
        return self.points[sure] if sure.any() else self.points

    def moved(self, rotation: np.ndarray, center: np.ndarray, scale: float) -> Reconstruction:
        """Map the world by ``X -> scale * rotation @ (X - center)``."""
        cameras = {}
        for name, camera in self.cameras.items():
            pose = camera.camera_to_world.clone()
            pose[:3, :3] = torch.from_numpy(rotation) @ pose[:3, :3]
            pose[:3, 3] = torch.from_numpy(scale * rotation @ (np.asarray(camera.center) - center))
            cameras[name] = replace(camera, camera_to_world=pose)
        return replace(self, cameras=cameras, points=scale * (self.points - center) @ rotation.T)

    @classmethod
    def of(cls, model: pycolmap.Reconstruction, absent: Sequence[str] = ()) -> Reconstruction:
        """Take cameras and points out of a model of pycolmap's, whose images' names sort by time, leaving
        out the ``absent`` images.

        Raises:
            ValueError: for a camera model that pinhole cameras with Brown's distortion do not cover.
        """
        there = (image for image in model.images.values() if image.has_pose and image.name not in absent)
        images = sorted(there, key=lambda image: image.name)
        cameras = {image.name: _camera(image) for image in images}
        points = list(model.points3D.values())
        number = {image.image_id: row for row, image in enumerate(images)}
        seen = [
            (number[element.image_id], row)
            for row, point in enumerate(points)
            for element in point.track.elements
            if element.image_id in number
        ]
        return cls(
            cameras,
            np.array([p.xyz for p in points]).reshape(-1, 3),
            np.array([p.color for p in points], dtype=np.uint8).reshape(-1, 3),
            np.array([p.error for p in points]),
            np.array([p.track.length() for p in points]),
            np.unique(np.array(seen, dtype=np.int64).reshape(-1, 2), axis=0),
            float(model.compute_mean_reprojection_error()) if points else float("nan"),
        )


def _camera(image: pycolmap.Image) -> Camera:
    camera, pose = image.camera, np.eye(4)
    names = (name.strip() for name in camera.params_info.split(","))
    values = dict(zip(names, map(float, camera.params)))
    beyond = any(value != 0 for name, value in values.items() if name not in _PARAMETERS)
    if beyond or camera.model_name not in _MODELS:
        advice = "undistort the pictures (colmap image_undistorter)"
        raise mismatch(image.name, "a camera model with k1 k2 k3 p1 p2, as OPENCV", camera.model_name, advice)
    fx, fy = (values.get(name, values.get("f", 0.0)) for name in ("fx", "fy"))
    k = values.get("k1", values.get("k", 0.0)), values.get("k2", 0.0), values.get("k3", 0.0)
    p = values.get("p1", 0.0), values.get("p2", 0.0)
    pose[:3] = image.cam_from_world().inverse().matrix()
    inner = camera.width, camera.height, fx, fy, values["cx"], values["cy"]
    return Camera(*inner, torch.from_numpy(pose), 0.0, 0.0, lens=Lens(k, p) if any(k + p) else None)


def read_model(folder: Path, originals: Mapping[str, str] | None = None) -> Reconstruction:
    """Read a COLMAP model, binary or text.

    Args:
        folder: of the model, or one with ``sparse/0``, ``sparse`` or ``colmap/sparse/0`` in it.
        originals: names of images in the model by those that they are to have; None: they stay.

    Raises:
        ValueError: where there is none, or one that cannot be read, or that has other images, or both kinds
            with cameras that differ.
    """
    places = {place: _kinds(place) for place in (folder / place for place in _PLACES)}
    folder = next((place for place, kinds in places.items() if kinds), folder)
    if not (kinds := places[folder]):
        expected = "a folder with cameras.bin, images.bin and points3D.bin (or .txt)"
        raise mismatch("colmap", expected, folder, "it is often called sparse/0")
    model, *others = (_stored(folder, kind) for kind in kinds)
    for other in others:
        if (name := _differing(model, other)) is not None:
            got = f"cameras.bin, images.bin and cameras.txt, images.txt that differ, of {name}"
            raise mismatch(folder, "one model", got, "move the three files that are not meant elsewhere")
    if originals is None:
        return Reconstruction.of(model)
    ours = {composed(original): name for name, original in originals.items()}
    for image in model.images.values():
        image.name = composed(image.name)
    posed = {image.name for image in model.images.values() if image.has_pose}
    absent = sorted(posed - ours.keys())
    if len(absent) == len(posed):
        advice = "set images= to the folder where its names begin, or rename them"
        got = min(ours, default="none")
        raise mismatch("images", f"pictures as {absent[0]}, as the model has", got, advice)
    for image in model.images.values():
        image.name = ours.get(image.name, image.name)
    return replace(Reconstruction.of(model, absent), absent=absent)


def _kinds(folder: Path) -> list[str]:
    """List the kinds of model that are whole in a folder, bin before txt."""
    return [k for k in ("bin", "txt") if all((folder / f"{part}.{k}").is_file() for part in _PARTS)]


def _stored(folder: Path, kind: str) -> pycolmap.Reconstruction:
    """Read a model of a kind; SceneError for one that cannot be read."""
    files = [folder / f"{part}.{kind}" for part in _PARTS]
    for file in files:
        with opened(file, MOST_FILM):
            pass
    model, rows = pycolmap.Reconstruction(), _rows(files[1]) if kind == "txt" else []
    try:
        with memory_within(_ROOM + 20 * sum(file.stat().st_size for file in files)):  # it believes lengths
            (model.read_binary if kind == "bin" else model.read_text)(folder)
        for row in rows:  # of a name with blanks it took what is before the first
            model.images[int(row[0])].name = row[9].rstrip()
    except (RuntimeError, ValueError, LookupError, OverflowError, MemoryError) as error:
        text = (str(error).strip().splitlines() or ["a file that cannot be read"])[-1]
        raise mismatch(folder, "a COLMAP model", text, "export it again") from error
    return model


def _rows(file: Path) -> list[list[str]]:
    """Split the first line of each image in ``images.txt``; SceneError where its second one is missing."""
    rows = []
    with file.open(encoding="utf-8", errors="replace") as lines:
        numbered = enumerate(lines, 1)
        for number, line in numbered:
            if not line.strip() or line.lstrip()[0] == "#":
                continue
            rows.append(line.split(maxsplit=9))
            second = next(numbered, (0, ""))[1]  # three numbers for each point; it may be empty
            points = second.split(maxsplit=10)
            if len(points) == 10 or (len(points) > 10 and not _is_number(points[10].split()[-1])):
                expected = "two lines an image (the second may be empty)"
                got = f"poses in line {number} and {number + 1}"
                raise mismatch(file, expected, got, "add an empty line after each that has none")
    return rows


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _differing(model: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> str | None:
    """Name the first image whose camera differs in two models, or is in one alone; None where none does."""
    first, second = ({i.name: _camera(i) for i in m.images.values() if i.has_pose} for m in (model, other))
    centers = np.stack([np.asarray(camera.center) for camera in first.values()] or [np.zeros(3)])
    reach = max(float(np.abs(centers - centers.mean(0)).max()), _SAME)

    def is_same(a: Camera, b: Camera) -> bool:
        inner = [(*c.inner[:6], *(c.lens.k + c.lens.p if c.lens else (0,) * 5)) for c in (a, b)]
        turned = float((a.camera_to_world - b.camera_to_world)[:3, :3].abs().max())
        apart = float((a.center - b.center).norm())
        return np.allclose(*inner, _SAME, _SAME) and turned < _SAME and apart < _SAME * reach

    names = sorted(first.keys() | second.keys())
    return next((n for n in names if not (n in first and n in second and is_same(first[n], second[n]))), None)


@dataclass(frozen=True)
class Search:
    """How poses are searched for.

    Args:
        matching: sequential, exhaustive, or auto, by the number of images.
        lens: pycolmap's name of the camera model that all images share.
        features: most features of an image.
        seed: of all random choices.
        threads: None: one for each processor.
    """

    matching: str = "auto"
    lens: str = "RADIAL"
    features: int = 4096
    seed: int = 0
    threads: int | None = None


def find_features(
    folder: Path,
    images: Path,
    masks: Path | None,
    search: Search,
    progress: Progress,
    every: int | None = None,
    names: Sequence[str] | None = None,
) -> Path:
    """Find the features of all images, or of each ``every``-th, that have none yet; return the database.

    Args:
        folder: of the database.
        images: folder of images of one size; or of a folder for each camera, whose images have one size.
        masks: folder of ``<image's name>.png``; features on black are left out.
        search: how to search.
        progress: called with images done and all.
        every: of ``first_look``; None: all. The numbers of images in the database are the same.
        names: of those to look at, from ``images`` on, of a camera all at once; None: all that are there.
    """
    database = folder / "database.db"
    names = sorted(names or (path.name for path in images.iterdir()))
    mode = pycolmap.CameraMode.PER_FOLDER if "/" in names[0] else pycolmap.CameraMode.SINGLE
    reader = pycolmap.ImageReaderOptions(camera_model=search.lens)
    if masks is not None:
        reader.mask_path = masks
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=search.threads or -1)
    options.max_image_size = _FEATURE_SIDE
    options.sift.max_num_features = search.features
    with pycolmap.Database.open(database) as base:
        numbers = {image.name: image.image_id for image in base.read_all_images()}
        done = {name for name, number in numbers.items() if base.exists_keypoints(number)}
    if new := [name for name in names if name not in numbers]:
        pycolmap.import_images(database, images, camera_mode=mode, image_names=new, options=reader)
    chosen = names[::every]
    left = [name for name in chosen if name not in done]
    how = {"camera_mode": mode, "reader_options": reader, "extraction_options": options}
    for some in _batches(left, _BATCH, len(chosen), progress):
        pycolmap.extract_features(database, images, some, **how, device=pycolmap.Device.cpu)
    return database


def _batches(left: Sequence, size: int, total: int, progress: Progress) -> Iterator[Sequence]:
    """Yield what is left of ``total`` in batches, and tell after each how much is done."""
    progress(total - len(left), total)
    for start in range(0, len(left), size):
        yield left[start : start + size]
        progress(total - max(0, len(left) - start - size), total)


def first_look(count: int) -> int:
    """Choose every how many of ``count`` images are looked at first: about 24, spread over all.

    >>> first_look(24), first_look(120)
    (1, 8)
    """
    return 2 ** math.ceil(math.log2(max(1.0, count / _LOOK)))


def match(
    database: Path, search: Search, progress: Progress, every: int | None = None, named: Pairs | None = None
) -> None:
    """Match and verify the pairs of images that are not matched yet: those ``named``; None: see ``pairs_of``,
    or a few of each ``every``-th image.
    """
    with pycolmap.Database.open(database) as base:
        images = {image.name: image.image_id for image in base.read_all_images()}
        pairs = named
        if named is None:
            names, rows = sorted(images), pairs_of(len(images), search.matching)
            if every is not None:  # 1, 2, 4 ... of those further
                rows = [(i, j) for i, j in rows if i % every == j % every == 0 and not (j - i) & (j - i - 1)]
            pairs = [(names[i], names[j]) for i, j in rows]
        left = [pair for pair in pairs if not base.exists_two_view_geometry(*map(images.get, pair))]
    options = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=search.threads or -1)
    verification, listed = pycolmap.TwoViewGeometryOptions(), database.with_name("pairs.txt")
    verification.ransac.random_seed = search.seed
    pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
    for some in _batches(left, _PAIR_BATCH, len(pairs), progress):
        listed.write_text("".join(f"{first} {second}\n" for first, second in some))
        pycolmap.match_image_pairs(database, options, pairing, verification, pycolmap.Device.cpu)


def burnt_in(database: Path) -> np.ndarray:
    """Find what is burnt into the images, as a logo or a caption: it stands still while the world moves.

    Pairs of images count if most of their sure matches move, and not along lines through one point: things
    far away stand still too if the camera does not turn. What is found is grown by a cell.

    Returns:
        (H, W) bool, true where something is burnt in.

    Cost: of 240 pairs, one to two seconds.
    """
    with pycolmap.Database.open(database) as base:
        camera = base.read_all_cameras()[0]
        size = np.array([camera.width, camera.height])
        unit, cell = max(1.0, size.max() / 640), -(-size.max() // _CELLS)
        numbers = [image.image_id for image in base.read_all_images()]
        places = {number: base.read_keypoints(number)[:, :2].clip(0, size - 1) for number in numbers}
        pairs = [pycolmap.pair_id_to_image_pair(key) for key in base.read_two_view_geometry_num_inliers()[0]]
        count, still_pairs, still, seen = 0, *np.zeros((3, *-(-size // cell)))
        for pair in pairs[:: max(1, len(pairs) // _BURNT_PAIRS)]:
            sure = base.read_two_view_geometry(*pair).inlier_matches.T
            first, second = (places[image][rows] for image, rows in zip(pair, sure))
            moves = np.linalg.norm(second - first, axis=1) > _MOVES * unit
            if moves.sum() < max(_MIN_INLIERS, len(moves) / 2):
                continue
            first, second = first[moves], second[moves]
            if off_lines(first - size / 2, second - size / 2) < _STRAIGHT * unit:
                continue
            count += 1
            every = [places[image][rows] for image, rows in zip(pair, base.read_matches(*pair).T)]
            stands = every[0][np.linalg.norm(every[1] - every[0], axis=1) < _STILL * unit]
            here, there = np.zeros((2, *still.shape))
            np.add.at(here, tuple((stands // cell).astype(int).T), 1)
            np.add.at(there, tuple((first // cell).astype(int).T), 1)
            still, seen, still_pairs = still + here, seen + here + there, still_pairs + (here > 0)
    burnt = (still_pairs >= max(_BURNT_LEAST, _BURNT_SHARE * count)) & (still > _BURNT_MATCHES * seen)
    grown = torch.nn.functional.max_pool2d(torch.from_numpy(burnt.T)[None].float(), 3, 1, 1)[0].bool().numpy()
    full = grown.repeat(cell, 0).repeat(cell, 1)[: size[1], : size[0]]
    return full & (full.mean() < _BURNT_MOST)


def off_lines(first: np.ndarray, second: np.ndarray) -> float:
    """Return how far matches lie from lines through one point, in the median.

    A camera that moves but does not turn shifts all it sees along such lines. The point is fitted repeatedly
    to the better half of the matches, as others may be wrong.

    Args:
        first, second: (M, 2) from the middle of the image.
    """
    scale = float(np.abs(first).max())
    a, b = (np.concatenate([ends / scale, np.ones((len(ends), 1))], 1) for ends in (first, second))
    normals, kept = np.cross(a, b), np.arange(len(a))
    for _ in range(4):
        lines = np.cross(np.linalg.svd(normals[kept], full_matrices=False)[2][-1], a)
        distances = np.abs((lines * b).sum(1)) / np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-9)
        kept = np.argsort(distances)[: max(3, len(distances) // 2)]
    return scale * float(np.median(distances))


def leave_out(database: Path, burnt: np.ndarray) -> None:
    """Remove all matches of what is burnt in, and what was verified with them, which ``match`` does anew.

    Args:
        database: of features and matches.
        burnt: (H, W) bool, true where something is burnt in.
    """
    with pycolmap.Database.open(database) as base:
        kept = {}
        for image in base.read_all_images():
            ends = base.read_keypoints(image.image_id)[:, :2].clip(0, np.array(burnt.shape[::-1]) - 1)
            columns, rows = ends.astype(int).T
            kept[image.image_id] = ~burnt[rows, columns]
        for key, matches in zip(*base.read_all_matches()):
            pair = pycolmap.pair_id_to_image_pair(key)
            good = kept[pair[0]][matches[:, 0]] & kept[pair[1]][matches[:, 1]]
            if not good.all():
                base.delete_two_view_geometry(*pair)
                base.delete_matches(*pair)
                base.write_matches(*pair, matches[good])


def pairs_of(count: int, matching: str) -> list[tuple[int, int]]:
    """Choose which pairs of ``count`` images in a row are matched.

    >>> pairs_of(3, "exhaustive"), len(pairs_of(100, "sequential"))
    ([(0, 1), (0, 2), (1, 2)], 859)
    """
    near = {*range(1, _OVERLAP + 1), *(2**i for i in range(10))}
    every = matching == "exhaustive" or (matching == "auto" and count <= _FEW)
    return [(i, j) for i in range(count) for j in range(i + 1, count) if every or j - i in near]


def reconstruct(
    database: Path, images: Path, search: Search, progress: Progress, names: Sequence[str] | None = None
) -> pycolmap.Reconstruction | None:
    """Find cameras and points; return the model of the most images, or None.

    Args:
        database: of features and matches.
        images: folder of the images.
        search: how to search.
        progress: called with images done and all.
        names: of a rig, the images to find, of which two are a model; None: all. Its cameras are few and far
            apart, so that all hangs on the pair that is begun with: others are tried until all are found.
    """
    with pycolmap.Database.open(database) as base:
        total = len(names or base.read_all_images())
    least, tries = (MIN_MODEL, _TRIES[:1]) if names is None else (2, _TRIES)
    done, best, folder = 1, None, database.with_name("models")
    shutil.rmtree(folder, ignore_errors=True)

    def count() -> None:
        nonlocal done
        done += 1
        progress(min(done, total), total)

    for row, (angle, has_lens, seed) in enumerate(tries):
        options, seed = pycolmap.IncrementalPipelineOptions(), search.seed + seed
        options.num_threads, options.min_model_size = search.threads or -1, least
        options.image_names = list(names or ())
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
        options.mapper.init_min_tri_angle = angle
        options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = has_lens
        pycolmap.set_random_seed(seed)
        place, done = folder / str(row), 1
        place.mkdir(parents=True)
        told = {"initial_image_pair_callback": count, "next_image_callback": count}
        models = pycolmap.incremental_mapping(database, images, place, options, **told)
        best = max((*filter(None, [best]), *models.values()), key=lambda m: m.num_reg_images(), default=None)
        if best is not None and best.num_reg_images() >= (_ALL if total > _FEW else 1.0) * total:
            break
    return best


def adjust(
    model: pycolmap.Reconstruction, search: Search, progress: Progress, sure_views: int = _SURE_VIEWS
) -> float:
    """Adjust all cameras once more to the points that are sure, and so that outliers hardly count.

    What moves leaves points that few images agree on, and the mapper's squares of errors let them bend the
    poses. They are deleted, but those of cameras that would be left with too few. A point is sure from
    ``sure_views`` on.

    Returns:
        the mean reprojection error in pixels before it, of all points, so that nothing flatters it.
    """
    progress(0, 1)
    error = float(model.compute_mean_reprojection_error())
    points = model.points3D.items()
    doubtful = {n for n, p in points if p.track.length() < sure_views or p.error > _SURE_ERROR}
    needed = set()
    for image in model.reg_image_ids():
        seen = {point.point3D_id for point in model.images[image].points2D if point.has_point3D()}
        if len(seen - doubtful) < _MIN_POINTS:
            needed |= seen
    for number in doubtful - needed:
        model.delete_point3D(number)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _LOSS_SCALE
    options.ceres.solver_options.num_threads = search.threads or -1
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Not pycolmap.bundle_adjustment, which prints whatever the level of its log.
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    progress(1, 1)
    return error


MIN_FEATURES = 60  # of an image, in the median
STILL = 0.01  # share of an image's longer side: a camera that stands shifts less
BLURRED = 2.5  # pixels of an image 640 wide, as ``frames.edge_width`` has them
TURNED = 0.017  # share of shift that no rotation explains: turned by hand 0.011, moved with a long lens 0.028
MIN_MODEL, MIN_REGISTERED = 3, 0.5  # images; share of them, where poses are searched for
MAX_DEGREES = 130.0
MAX_ERROR = 2.5  # pixels
MIN_PARALLAX = 0.01  # the extent of the cameras' places as a share of the distance of what they see
_PAIRS, _MIN_INLIERS = 60, 30  # of images that are looked at; matches of each
_SHIFTS = 0.03, 0.4  # of pairs in which a rotation and a step can be told apart
_FOCAL_LENGTHS = (0.6, 0.8, 1.0, 1.25, 1.6, 2.0)  # shares of the longer side that are tried
_MOVES_AROUND = "one that moves around things near and far"
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


def refuse_matches(database: Path, frames: Frames, force: bool = False) -> None:
    """Refuse images without features and, unless ``force``, cameras that stand or only turn.

    Raises:
        ValueError: with what was found, and advice.
    """
    evidence = evidence_of(database)
    if evidence.features < MIN_FEATURES:
        got = f"{evidence.features:.0f} in a picture"
        raise mismatch("pictures", "hundreds of features to match", got, _advice(evidence, frames))
    if force:
        return
    if evidence.shift < STILL:
        got = f"matches that shift by {100 * evidence.shift:.1f} % of the picture at most"
        advice = "walk around the subject while filming, or go on with force=true"
        raise mismatch("camera", "one that moves", got, advice)
    if evidence.unrotated < TURNED:
        got = f"one where {100 - 100 * evidence.unrotated:.0f} % of all shift is explained by turning it"
        raise mismatch("camera", _MOVES_AROUND, got, f"{_WALK}, or go on with force=true")


class TooFewRegistered(ValueError):
    """Poses of too few images were found; of a film, more frames may help."""


def refuse_poses(
    found: Reconstruction | None, frames: Frames, database: Path | None = None, force: bool = False
) -> None:
    """Refuse poses of too few images, of a fisheye, of cameras that hardly move, and those that do not fit.

    Known poses without points in front of them are refused where all cameras stand in one place, or look at
    one thing only if they were written in another way than COLMAP's.

    Args:
        found: None: nothing was found.
        frames: which were to be registered.
        database: of features and matches, from which advice comes; None: the poses were known.
        force: take known poses as they are.

    Raises:
        TooFewRegistered, ValueError: with what was found, and advice.
    """
    registered, total = 0 if found is None else len(found.cameras), len(frames.times)
    if database is None and registered < MIN_MODEL:
        raise mismatch("colmap", f"a model of at least {MIN_MODEL} pictures", registered, "set another")
    if database is not None and registered < max(MIN_MODEL, MIN_REGISTERED * total):
        advice = _advice(evidence_of(database), frames)
        expected = f"most of {total} pictures registered"
        raise TooFewRegistered(str(mismatch("poses", expected, registered, advice)))
    for name, camera in found.cameras.items():
        size = camera.width, camera.height
        if size != frames.sizes[name]:
            advice = "set images= to the pictures that the model was made from"
            expected = f"cameras of {by(frames.sizes[name])} pixels, as the pictures"
            raise mismatch("colmap", expected, by(size), advice)
    refuse_lenses(found)
    if database is None and not force and not _has_points_ahead(found):
        poses = [camera.camera_to_world for camera in found.cameras.values()]
        if ways := other_readings(poses, _READINGS):
            got = f"cameras that look at one thing only if {', or if '.join(ways)}"
            advice = "write them anew, or force=true if they are right"
            raise mismatch("colmap", "world-to-camera poses with OpenCV's axes", got, advice)
        if float(np.abs(found.centers - found.centers[0]).max()) <= _SAME_PLACE * np.abs(found.centers).max():
            got = "all in one place, which tells nothing of depth"
            raise mismatch("colmap", "cameras that move", got, "compare the poses, or force=true if it is so")
    refuse_misfit(found)


def refuse_lenses(found: Reconstruction) -> None:
    """Refuse cameras of a fisheye, or that no lens explains.

    Raises:
        ValueError: with what was found, and advice.
    """
    for camera in {(c.width, c.fx, c.lens): c for c in found.cameras.values()}.values():
        degrees = np.degrees(2 * np.arctan(camera.width / (2 * camera.fx)))
        try:
            check_lens(camera, "lens")
            if degrees > MAX_DEGREES:
                raise mismatch("lens", f"at most {MAX_DEGREES:.0f} degrees", f"{degrees:.0f}")
        except SceneError as error:
            advice = f"if it is a fisheye, film without it or undistort first; else {_WALK}"
            raise ValueError(f"{str(error).partition(';')[0]}; {advice}") from error


def refuse_misfit(found: Reconstruction) -> None:
    """Refuse cameras that are hardly apart, and those whose points do not fit.

    Raises:
        ValueError: with what was found, and advice.
    """
    if not len(found.seen):  # of known poses alone; the reader derives what points would tell
        return
    extent = np.linalg.norm(found.centers - np.median(found.centers, axis=0), axis=1).max()
    parallax = extent / np.median(found.distances())
    if parallax < MIN_PARALLAX:
        got = f"places that are {100 * parallax:.2f} % of the distance apart"
        raise mismatch("camera", _MOVES_AROUND, got, _WALK)
    if found.error > MAX_ERROR:
        expected = f"a reprojection error of at most {MAX_ERROR} pixels"
        raise mismatch("poses", expected, f"{found.error:.1f}", "give masks= of what moves")


def _has_points_ahead(found: Reconstruction) -> bool:
    """Tell whether most points lie before the cameras that see them."""
    if not len(found.seen):
        return False
    axes = np.stack([np.asarray(camera.camera_to_world)[:3, 2] for camera in found.cameras.values()])
    rows, points = found.seen.T
    return bool((((found.points[points] - found.centers[rows]) * axes[rows]).sum(1) > 0).mean() > 0.5)


def errors_of(model: pycolmap.Reconstruction) -> dict[str, float]:
    """Return the mean distance, in pixels, between where each image has its points and where they fall."""
    errors = {}
    for image in model.images.values():
        ends = [(p.xy, model.points3D[p.point3D_id].xyz) for p in image.points2D if p.has_point3D()]
        if image.has_pose and ends:
            pairs = ((xy, image.project_point(xyz)) for xy, xyz in ends)
            away = [np.linalg.norm(xy - fallen) for xy, fallen in pairs if fallen is not None]
            errors[image.name] = float(np.mean(away))
    return errors


def evidence_of(database: Path) -> Evidence:
    """Read what a database tells of its images.

    Cost: of some 60 pairs, under a second.
    """
    shifts, shares = [], []
    with pycolmap.Database.open(database) as base:
        every = [image.image_id for image in base.read_all_images()]
        numbers = [number for number in every if base.exists_keypoints(number)]
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
        told = f"edges are {frames.edges:.0f} pixels wide (of 640): the pictures are blurred"
        return f"{told}; film slower, and in more light"
    if evidence.features < MIN_FEATURES and frames.masks is not None:
        return "there is no texture but on what the masks call moving; put textured things around it"
    if evidence.features < MIN_FEATURES:
        return "there is hardly any texture; put textured things around the subject, as newspapers"
    more = "take more pictures" if frames.originals else "take more frames (frames=)"
    slower = "film slower and with more of what stands still in the picture"
    return f"{slower}, {more}, or give masks= of what moves"
