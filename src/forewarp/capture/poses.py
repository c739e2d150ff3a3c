"""Structure from motion by pycolmap: features, matches, cameras and points; it goes on from its database."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from forewarp.capture.video import Progress

_OVERLAP = 6  # of sequential matching: the next six pictures, and those at 1, 2, 4 ... 512
_FEW = 40  # pictures of which every pair is matched
_SIDE = 1600  # pixels of the longer side in which features are looked for
_LEAST_MODEL = 3
# The last adjustment: a point's least views and greatest error in pixels, a camera's least points; the error
# in pixels from which on a match hardly counts.
_SURE_VIEWS, _SURE_ERROR, _LEAST_POINTS, _LOSS = 4, 1.5, 30, 0.5
_AT_ONCE, _PAIRS_AT_ONCE = 8, 48  # between two updates of the progress


@dataclass(frozen=True)
class Search:
    """How poses are searched for.

    Args:
        matching: sequential, exhaustive, or auto, by the number of pictures.
        lens: pycolmap's name of the camera model that all pictures share.
        features: most features of a picture.
        seed: of all random choices.
        threads: None: one for each processor.
    """

    matching: str = "auto"
    lens: str = "RADIAL"
    features: int = 4096
    seed: int = 0
    threads: int | None = None


def find_features(folder: Path, pictures: Path, masks: Path | None, how: Search, progress: Progress) -> Path:
    """Find the features of all pictures that have none yet; return the database.

    Args:
        folder: of the database.
        pictures: folder of pictures of one size.
        masks: folder of ``<picture's name>.png``; features on black are left out.
        how: how to search.
        progress: called with pictures done and all.
    """
    import pycolmap

    _quiet()
    database, names = folder / "database.db", sorted(path.name for path in pictures.iterdir())
    reader = pycolmap.ImageReaderOptions(camera_model=how.lens)
    if masks is not None:
        reader.mask_path = masks
    options = pycolmap.FeatureExtractionOptions(
        use_gpu=False, max_image_size=_SIDE, num_threads=how.threads or -1
    )
    options.sift.max_num_features = how.features
    with pycolmap.Database.open(database) as base:
        done = {image.name for image in base.read_all_images() if base.exists_keypoints(image.image_id)}
        known = [camera.camera_id for camera in base.read_all_cameras()]
    left = [name for name in names if name not in done]
    progress(len(done), len(names))
    for some in _batches(left, _AT_ONCE):
        if known:
            reader.existing_camera_id = known[0]  # else the others would get one of their own
        pycolmap.extract_features(
            database,
            pictures,
            image_names=some,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
        if not known:
            with pycolmap.Database.open(database) as base:
                known = [camera.camera_id for camera in base.read_all_cameras()]
        done.update(some)
        progress(len(done), len(names))
    return database


def match(database: Path, how: Search, progress: Progress) -> None:
    """Match and verify the pairs of pictures that are not matched yet."""
    import pycolmap

    _quiet()
    with pycolmap.Database.open(database) as base:
        images = sorted((image.name, image.image_id) for image in base.read_all_images())
        pairs = pairs_of(len(images), how.matching)
        left = [
            (images[i][0], images[j][0])
            for i, j in pairs
            if not base.exists_two_view_geometry(images[i][1], images[j][1])
        ]
    options = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=how.threads or -1)
    verify = pycolmap.TwoViewGeometryOptions()
    verify.ransac.random_seed = how.seed
    chosen, done = database.with_name("pairs.txt"), len(pairs) - len(left)
    progress(done, len(pairs))
    for some in _batches(left, _PAIRS_AT_ONCE):
        chosen.write_text("".join(f"{first} {second}\n" for first, second in some))
        pycolmap.match_image_pairs(
            database,
            matching_options=options,
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=chosen),
            verification_options=verify,
            device=pycolmap.Device.cpu,
        )
        done += len(some)
        progress(done, len(pairs))


def pairs_of(count: int, matching: str) -> list[tuple[int, int]]:
    """Choose which pairs of ``count`` pictures in a row are matched.

    >>> pairs_of(3, "exhaustive"), len(pairs_of(100, "sequential"))
    ([(0, 1), (0, 2), (1, 2)], 859)
    """
    near = {*range(1, _OVERLAP + 1), *(2**i for i in range(10))}
    every = matching == "exhaustive" or (matching == "auto" and count <= _FEW)
    return [(i, j) for i in range(count) for j in range(i + 1, count) if every or j - i in near]


def reconstruct(database: Path, pictures: Path, folder: Path, how: Search, progress: Progress):
    """Find cameras and points; return the ``pycolmap.Reconstruction`` of the most pictures, or None."""
    import pycolmap

    _quiet()
    with pycolmap.Database.open(database) as base:
        total = base.num_images()
    done = 1

    def count() -> None:
        nonlocal done
        done += 1
        progress(min(done, total), total)

    options = pycolmap.IncrementalPipelineOptions(
        random_seed=how.seed, num_threads=how.threads or -1, min_model_size=_LEAST_MODEL
    )
    options.mapper.random_seed = options.triangulation.random_seed = how.seed
    pycolmap.set_random_seed(how.seed)
    folder.mkdir(exist_ok=True)
    found = pycolmap.incremental_mapping(
        database, pictures, folder, options, initial_image_pair_callback=count, next_image_callback=count
    )
    return max(found.values(), key=lambda one: one.num_reg_images(), default=None)


def adjust(found, how: Search, progress: Progress) -> float:
    """Adjust all cameras once more to the points that are sure, and so that outliers hardly count.

    What moves leaves points that few pictures agree on, and the mapper's squares of errors let them bend the
    poses. They are deleted, but those of cameras that would be left with too few.

    Returns:
        the mean reprojection error in pixels before it, of all points, so that nothing flatters it.
    """
    import pycolmap

    progress(0, 1)
    error = float(found.compute_mean_reprojection_error())
    doubtful = {
        number
        for number, point in found.points3D.items()
        if point.track.length() < _SURE_VIEWS or point.error > _SURE_ERROR
    }
    needed = set()
    for image in found.reg_image_ids():
        seen = {point.point3D_id for point in found.images[image].points2D if point.has_point3D()}
        if len(seen - doubtful) < _LEAST_POINTS:
            needed |= seen
    for number in doubtful - needed:
        found.delete_point3D(number)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _LOSS
    options.ceres.solver_options.num_threads = how.threads or -1
    what = pycolmap.BundleAdjustmentConfig()
    for number in found.reg_image_ids():
        what.add_image(number)
    what.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Not pycolmap.bundle_adjustment, which prints whatever the level of its log.
    pycolmap.create_default_bundle_adjuster(options, what, found).solve()
    found.update_point_3d_errors()
    progress(1, 1)
    return error


def _batches(things: list, size: int) -> list[list]:
    return [things[i : i + size] for i in range(0, len(things), size)]


def _quiet() -> None:
    """Let pycolmap print nothing but what ends it."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
