"""A capture from a video, a folder of images or a COLMAP model to a scene: frames, poses, checks, scene."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

import cv2
import pycolmap
import torch
from filelock import FileLock, Timeout

from forewarp.capture import poses, scene
from forewarp.capture.frames import TAKEN, Frames, Source, Step, is_hidden, read_mask, take, write_mask
from forewarp.capture.poses import Reconstruction, Search, refuse_matches, refuse_poses
from forewarp.data.files import mismatch
from forewarp.drawing.images import write_png
from forewarp.files import folder_written_whole, read_json, write_json

ABOUT, PICTURE = "capture.json", "capture.png"  # in the scene's folder
_BURNT = "burnt_in.png"  # in the work folder: dark where something is burnt into all images
BEST, KEPT = "best", "error.json"  # in the work folder what was found; in that what is told of it
_AGAIN = "of half as many too few had poses"
_STATE = "about.json"  # what the work in a work folder depends on


def capture(
    source: Source, out: Path, search: Search, step: Step, *, frames: int | None = None, force: bool = False
) -> dict:
    """Make a scene in ``out`` and return what was found, which ``capture.json`` there holds too.

    An interrupted call is gone on with by the next one of the same arguments; see ``work_folder``.

    Args:
        source: what to capture.
        out: the scene's folder; an earlier capture in it is replaced.
        search: how poses are found.
        step: gives a ``Progress`` for each step.
        frames: to choose from a video; None: see ``frames.frames_for``, and twice as many where these do not
            register.
        force: go on where matches say that the camera stands or only turns, or known poses seem wrong.

    Raises:
        ValueError: where nothing good comes of it, with advice; frames, features and matches stay.
    """
    about = {**dataclasses.asdict(source), "frames": frames}
    with work_for(out, search, (source.path, source.masks), **about) as work:
        images = take(work, source, step, frames, search.threads)
        if source.colmap is not None:
            found = poses.read_model(source.colmap, images.originals)
        else:
            try:
                found = find_poses(work, images, search, step, force)
            except poses.TooFewRegistered:
                more = min(images.found, 2 * len(images.times))
                again = frames is None and source.video is not None and images.why != _AGAIN
                if not again or more == len(images.times):
                    raise
                (work / TAKEN).unlink()  # first: without it frames are taken anew
                for left in work.iterdir():
                    if left.name != _STATE:
                        shutil.rmtree(left) if left.is_dir() else left.unlink()
                images = take(work, source, step, more, search.threads, _AGAIN)
                found = find_poses(work, images, search, step, force)
        refuse_poses(found, images, force=force)
        if source.colmap is None:  # a world that is known stays, in its own unit
            found = scene.placed(found)
        limits = scene.limits_of(found)
        with step("what moves, writing") as progress, folder_written_whole(out, ABOUT) as folder:
            burnt = read_mask(work / _BURNT) if (work / _BURNT).exists() else None
            written = scene.write(folder, source.video is not None, images, found, limits, progress, burnt)
            if limits is not None:
                write_png(folder / PICTURE, scene.draw(found, limits))
            facts = scene.facts_of(source, images, found, limits, burnt) | written
            record(folder, facts)
    return facts


def find_poses(work: Path, images: Frames, search: Search, step: Step, force: bool = False) -> Reconstruction:
    """Find poses, unless an earlier call has done so."""
    if (before := kept(work)) is not None:
        return dataclasses.replace(Reconstruction.of(before[0]), **before[1])
    for look, every in (("first ", poses.first_look(len(images.times))), ("", None)):
        with step(f"{look}features") as progress:
            database = poses.find_features(work, images.folder, images.masks, search, progress, every)
        with step(f"{look}matches") as progress:
            poses.match(database, search, progress, every)
        if every is not None:  # before the work that a refusal would waste
            refuse_matches(database, images, force)
    if not (work / _BURNT).exists() and (burnt := poses.burnt_in(database)).any():
        write_mask(work / _BURNT, burnt)
    if (work / _BURNT).exists():
        with step("matches without what is burnt in") as progress:
            poses.leave_out(database, read_mask(work / _BURNT))
            poses.match(database, search, progress)
    refuse_matches(database, images, force)
    with step("poses") as progress:
        model = poses.reconstruct(database, images.folder, search, progress)
    if model is None:
        refuse_poses(None, images, database)
    with step("adjustment") as progress:
        error = poses.adjust(model, search, progress)
    found = dataclasses.replace(Reconstruction.of(model), error=error)
    refuse_poses(found, images, database)
    keep(work, model, {"error": error})
    return found


def keep(work: Path, model: pycolmap.Reconstruction, told: Mapping[str, object]) -> None:
    """Keep what was found in ``work / "best"``, whole."""
    part = work / "part"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    model.write(part)
    write_json(part / KEPT, dict(told))
    shutil.rmtree(work / BEST, ignore_errors=True)
    part.rename(work / BEST)


def kept(work: Path) -> tuple[pycolmap.Reconstruction, dict] | None:
    """Give what an earlier call has kept, and what it told of it."""
    told = read_json(work / BEST / KEPT)
    return None if told is None else (pycolmap.Reconstruction(work / BEST), told)


def record(folder: Path, facts: dict) -> None:
    """Write what was found into a scene's folder, with the size of each file."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    facts["bytes"] = {path.relative_to(folder).as_posix(): path.stat().st_size for path in files}
    write_json(folder / ABOUT, facts)


def fingerprint(path: Path) -> str:
    """A digest of the name, bytes and time of change of a file, or of each file of a folder."""
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    files = [file for file in files if not is_hidden(file.relative_to(path))]
    states = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    return hashlib.sha256(repr(states).encode()).hexdigest()


def work_for(out: Path, search: Search, inputs: Sequence[Path | None], **about) -> AbstractContextManager:
    """Give the ``work_folder`` of a capture to ``out``, and have it run on as many threads as ``search`` has.

    Args:
        inputs: files and folders that are read.
        about: what else the work depends on, beside ``search``.
    """
    cv2.setNumThreads(search.threads or -1)
    if search.threads is not None:
        torch.set_num_threads(search.threads)
    about |= dataclasses.asdict(search)
    del about["threads"]
    return work_folder(out, about | {"files": [fingerprint(path) for path in inputs if path is not None]})


@contextmanager
def work_folder(out: Path, about: Mapping[str, object]) -> Iterator[Path]:
    """Give the folder ``.<name of out>.work`` beside ``out``, with what an interrupted call left in it.

    Args:
        out: of the result.
        about: what the work depends on; work about anything else is removed first.

    It is removed at the end, and where no frames could be taken, with the folders that were made for it; it
    stays after a refusal of matches or poses, Ctrl-C, a kill, errors of the system and bugs.

    Raises:
        ValueError: where another call is at work.
    """
    work = out.with_name(f".{out.name}.work")
    made = [folder for folder in work.parents if not folder.exists()]
    work.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(work.with_name(work.name + ".lock"))
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise mismatch(out, "one capture at a time", "another at work", "wait for it") from None
    stays = False
    try:
        work.mkdir(exist_ok=True)
        state = json.loads(json.dumps(about, default=str))
        if read_json(work / _STATE) != state:
            shutil.rmtree(work)
            work.mkdir()
            write_json(work / _STATE, state)
        yield work
    except BaseException as error:
        # A refusal says what it got, unlike a bug, as a ``ValueError`` of NumPy's.
        is_refusal = isinstance(error, ValueError) and " but got " in str(error)
        taken = (work / TAKEN).exists()
        stays = taken or not (is_refusal or isinstance(error, ImportError))
        if is_refusal and taken:
            stay = f"what was found stays in {work}, from which the same command goes on"
            raise ValueError(f"{error}; {stay}") from error
        raise
    finally:
        if not stays:  # under the lock: what another call begins afterwards is its own
            shutil.rmtree(work, ignore_errors=True)
            Path(lock.lock_file).unlink(missing_ok=True)
        lock.release()
        if not stays:
            for folder in made:
                with suppress(OSError):  # not empty: the result is in it
                    folder.rmdir()
