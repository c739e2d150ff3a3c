"""The whole way from a video, a folder of pictures or a COLMAP model to a scene."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

from forewarp.capture import poses
from forewarp.capture.facts import ABOUT, PICTURE, facts_of
from forewarp.capture.look import two_sides
from forewarp.capture.pictures import Pictures, Told, take
from forewarp.capture.place import limits_of, placed
from forewarp.capture.refusals import refuse_matches, refuse_poses
from forewarp.capture.scene import write
from forewarp.capture.sparse import Sparse, read_model, sparse_of
from forewarp.capture.workplace import workplace
from forewarp.drawing.files import write_png
from forewarp.files import folder_written_whole, read_json, write_json

_ERROR = "error.json"  # pixels, before points were deleted


@dataclass(frozen=True)
class Source:
    """What to capture: a ``video``, or a folder of ``images``, with ``colmap`` poses that are known; and a
    folder of ``masks`` of what moves.
    """

    video: Path | None = None
    images: Path | None = None
    colmap: Path | None = None
    masks: Path | None = None

    @property
    def path(self) -> Path:
        """The video or the folder."""
        return self.video or self.images


def capture(
    source: Source,
    out: Path,
    how: poses.Search,
    told: Told,
    *,
    frames: int | None = None,
    size: int | None = 1600,
) -> dict:
    """Make a scene in ``out`` and return what was found, which ``capture.json`` there holds too.

    An interrupted call is gone on with by the next one of the same arguments; see ``workplace``.

    Args:
        source: what to capture.
        out: the scene's folder; an earlier capture in it is replaced.
        how: how poses are found.
        told: gives a ``Progress`` for each step.
        frames: to choose from a video; None: 120, and at most every second one.
        size: most pixels of the longer side; with poses that are known pictures are left as stored.

    Raises:
        ValueError: where nothing good comes of it, with advice; nothing is then left behind.
    """
    about = {**dataclasses.asdict(source), **dataclasses.asdict(how), "frames": frames, "size": size}
    del about["threads"]
    about["files"] = [_state(path) for path in (source.path, source.masks) if path is not None]
    known = source.colmap is not None
    with workplace(out, about) as place:
        pictures = take(
            place,
            source.path,
            video=source.video is not None,
            masks=source.masks,
            count=frames,
            size=None if known else size,
            told=told,
            upright=not known,
            threads=how.threads,
        )
        if known:
            sparse = read_model(source.colmap, pictures.originals)
        else:
            sparse = _found(place, pictures, how, told)
        refuse_poses(sparse, pictures)
        sparse = placed(sparse)
        limits = limits_of(sparse)
        with told("writing") as progress, folder_written_whole(out, ABOUT) as folder:
            scales = write(folder, pictures.folder, sparse, pictures.times, limits, progress)
            write_png(folder / PICTURE, two_sides(sparse, limits))
            facts = facts_of(source, pictures, sparse, limits, scales)
            files = (path for path in sorted(folder.rglob("*")) if path.is_file())
            facts["bytes"] = {path.relative_to(folder).as_posix(): path.stat().st_size for path in files}
            write_json(folder / ABOUT, facts)
    return facts


def _found(place: Path, pictures: Pictures, how: poses.Search, told: Told) -> Sparse:
    """Find poses, unless an earlier call has done so."""
    import pycolmap

    best = place / "best"
    if best.is_dir():
        return replace(sparse_of(pycolmap.Reconstruction(best)), **read_json(best / _ERROR))
    with told("features") as progress:
        database = poses.find_features(place, pictures.folder, pictures.masks, how, progress)
    with told("matches") as progress:
        poses.match(database, how, progress)
    refuse_matches(database, pictures)
    with told("poses") as progress:
        model = poses.reconstruct(database, pictures.folder, place / "models", how, progress)
    sparse = None
    if model is not None:
        with told("adjustment") as progress:
            error = poses.adjust(model, how, progress)
        sparse = replace(sparse_of(model), error=error)
    refuse_poses(sparse, pictures, database)
    part = place / "part"
    part.mkdir(exist_ok=True)
    model.write(part)
    write_json(part / _ERROR, {"error": error})
    part.rename(best)
    return sparse


def _state(path: Path) -> str:
    """A digest of the name, bytes and time of change of a file, or of each file of a folder."""
    files = [path] if path.is_file() else sorted(file for file in path.iterdir() if file.is_file())
    states = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    return hashlib.sha256(repr(states).encode()).hexdigest()
