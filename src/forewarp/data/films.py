"""Videos whose frames are decoded when needed: into memory where all fit, else into files on disk."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import stat
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from filelock import FileLock, Timeout
from torch import Tensor

from forewarp import files
from forewarp.clock import left_out
from forewarp.data.files import mismatch, number
from forewarp.data.images import CACHE, by
from forewarp.data.video import extracted, start_of
from forewarp.files import read_json, write_json, written_whole
from forewarp.progress import Counted

FOLDER = ".frames"  # hidden, so that it belongs to no scene's fingerprint
_SUFFIX = ".rgb"
_BLOCKS, _BLOCK = 64, 1 << 16  # of a video, evenly spread, and bytes of each, that its fingerprint reads
_IN_USE_S = 3600  # a file is in use that was read since
_RESERVE = 1 << 29  # bytes of a disk that stay free
_WAIT_S = 1.0  # between two looks whether another process is done


class Film:
    """A video whose frames are decoded when they are needed.

    Args:
        path: of the video.
        stamps: seconds of its frames.
        size: (width, height), to which they are reduced.
        bytes_of_all: of the decoded frames of all cameras. Where there is room in memory to keep them, the
            first frame that is needed has all of its video decoded; else they lie in ``STORE``; where that
            may hold none each is sought in the file, which takes a tenth of a second and more.
    """

    def __init__(self, path: Path, stamps: np.ndarray, size: tuple[int, int], bytes_of_all: int) -> None:
        self.path, self.stamps, self.size, self.bytes_of_all = path, stamps, size, bytes_of_all
        self.images = tuple(FilmImage(self, number) for number in range(len(stamps)))

    @property
    def is_stored(self) -> bool:
        """Whether its frames belong on disk, as not all fit into memory."""
        return self.bytes_of_all > CACHE.limit and STORE.limit > 0

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame on disk."""
        return 3 * self.size[0] * self.size[1]

    @cached_property
    def key(self) -> str:
        """Name what is decoded: a hash of the video's size, time, 64 of its blocks and the size of frames."""
        about = self.path.stat()
        return _digest(self.path, f"1 {about.st_size} {about.st_mtime_ns} {by(self.size)}")[:24]

    def decoded(self, start: int, count: int) -> Iterator[np.ndarray]:
        """Decode ``count`` frames from number ``start`` on: uint8 (H, W, 3) each.

        Raises:
            SceneError: where one is not there, or of another size.
        """
        # ffmpeg averages several times as fast.
        images = extracted(self.path, None, max(self.size), start=start_of(self.stamps, start))
        for index in range(start, start + count):
            pixels = next(images, None)
            if pixels is None:
                expected = f"{len(self.stamps)} frames, as its index says"
                raise mismatch(self.path, expected, index, "convert the video")
            if pixels.shape[1::-1] != self.size:
                raise mismatch(f"{self.path}: frame {index}", by(self.size), by(pixels.shape[1::-1]))
            yield pixels
        images.close()


class FilmImage:
    """Frame ``number`` of a film, uint8 (H, W, 4), alpha 255; read-only.

    One from ``STORE`` is not kept in memory: the system keeps what was read, and gives it up for others.
    """

    def __init__(self, film: Film, number: int) -> None:
        self.film, self.number = film, number

    def __call__(self) -> Tensor:
        """Give the pixels; SceneError as ``Film.decoded`` and ``FilmStore.fill``."""
        if not self.film.is_stored:
            return CACHE.get(self, self._decode)
        with left_out():  # reading images is no training
            return _opaque(STORE.frame(self.film, self.number))

    def _decode(self) -> Tensor:
        if self.film.bytes_of_all > CACHE.limit:
            (pixels,) = self.film.decoded(self.number, 1)
            return _opaque(pixels)
        for image, pixels in zip(self.film.images, self.film.decoded(0, len(self.film.images))):
            if image is self:
                own = _opaque(pixels)
            else:
                CACHE.keep(image, _opaque(pixels))
        return own


class FilmStore:
    """Decoded frames on disk: for each film and size a file of raw RGB, frame after frame.

    A file has the name of what it holds (``Film.key``), so that runs share it, and a video that has changed
    gets another. It appears whole or not at all, so that a killed process leaves no wrong frame; films that
    it had finished stay. What it holds is noted in the user's own folder: a file that another user, or the
    maker of the scene, has put there is decoded anew. One process at a time decodes a film; others wait for
    it. Files that nobody has read for an hour make room for new ones, the least recently read first.

    Args:
        folder: of the files; made when needed. None: the films' own, ``.frames`` beside them.
        limit: most bytes of all files in it; 0: none.
    """

    def __init__(self, folder: Path | None = None, limit: int = 100_000_000_000) -> None:
        self.folder, self.limit = folder, limit
        self._noted: dict[str, str] = {}  # by the key of a film; where the user's own folder is not writable
        self._looked_at: dict[Path, tuple[int, int]] = {}  # size and time of a file that holds what was noted

    def resize(self, folder: Path | None, limit: int) -> None:
        """Take this folder, and ``limit`` bytes, from now on.

        Raises:
            SceneError: for anything but a number >= 0.
        """
        self.folder, self.limit = folder, int(number(limit, "data.disk_cache_bytes", 0))

    def frame(self, film: Film, index: int) -> np.ndarray:
        """Read a frame (H, W, 3) uint8, after decoding its whole film where that has not been done.

        Cost: a few milliseconds at 1352 x 1014; it is no mapped page, which would count as the process's.
        """
        path, start = self._path(film), index * film.frame_bytes
        for _ in range(2):
            with suppress(FileNotFoundError):
                is_held = self._has(film, index + 1)
                pixels = np.fromfile(path, np.uint8, film.frame_bytes, offset=start) if is_held else ()
                if len(pixels) == film.frame_bytes:
                    self._use(film)
                    return pixels.reshape(*film.size[::-1], 3)
            self.fill([film])
        raise mismatch(path, f"{len(film.images)} frames", "fewer", "run again")

    def fill(self, films: Iterable[Film]) -> None:
        """Decode those films whose frames belong on disk and are not there; say first what they take.

        Raises:
            SceneError: where that is more than ``limit`` or the disk has room for; as ``Film.decoded``.
            OSError: where the folder cannot be written.
        """
        stored = {film.key: film for film in films if film.is_stored}
        absent = {key: film for key, film in stored.items() if not self._has(film)}
        for film in stored.values():
            self._use(film)
        if not absent:
            return
        folder = self._path(next(iter(absent.values()))).parent
        folder.mkdir(parents=True, exist_ok=True)
        needed = sum(film.frame_bytes * len(film.images) for film in absent.values())
        self._make_room(folder, needed, [film.path.name for film in absent.values()])
        total, done = sum(len(film.images) for film in absent.values()), 0
        with Counted("frames") as progress:
            progress(0, total)
            for film in absent.values():
                with _locked(folder / f"{film.key}.lock", lambda: progress(done, total)):  # noqa: B023
                    if not self._has(film):  # another process may have decoded it
                        self._write(film, lambda n: progress(done + n, total))  # noqa: B023
                done += len(film.images)
                progress(done, total)

    def _path(self, film: Film) -> Path:
        return (self.folder or film.path.parent / FOLDER) / f"{film.key}{_SUFFIX}"

    def _has(self, film: Film, count: int | None = None) -> bool:
        """Tell whether the first frames of a film are there, None: all, as this user has decoded them."""
        with suppress(OSError):
            path, least = self._path(film), film.frame_bytes * (count or len(film.images))
            about = path.lstat()
            if about.st_size % film.frame_bytes or about.st_size < least or not stat.S_ISREG(about.st_mode):
                return False
            if self._looked_at.get(path) != (stamp := _stamp(path)):
                noted = self._noted.get(film.key) or (read_json(_note_of(film)) or {}).get("sha256")
                if noted != _digest(path, f"{film.key} {about.st_size}"):
                    return False
                self._looked_at[path] = stamp
            return True
        return False

    def _note(self, film: Film) -> None:
        """Note what the file of a film holds that was just decoded."""
        path = self._path(film)
        digest = _digest(path, f"{film.key} {path.stat().st_size}")
        self._noted[film.key] = digest
        with suppress(OSError):
            write_json(_note_of(film), {"film": str(film.path.resolve()), "sha256": digest})

    def _use(self, film: Film) -> None:
        """Note that a film is in use, so that its file makes no room for others."""
        with suppress(OSError):  # not there, or another user's
            path = self._path(film)
            is_known = self._looked_at.get(path) == _stamp(path)
            os.utime(path)
            if is_known:
                self._looked_at[path] = _stamp(path)

    def _write(self, film: Film, progress) -> None:
        path = self._path(film)
        for part in path.parent.glob(f".{path.name}.*.part*"):  # of a killed process
            part.unlink(missing_ok=True)
        with written_whole(path, synced=True) as beside, beside.open("wb") as file:
            for index, pixels in enumerate(film.decoded(0, len(film.images))):
                file.write(pixels.data)
                progress(index + 1)
        self._note(film)

    def _make_room(self, folder: Path, needed: int, names: Sequence[str]) -> None:
        """Remove files that nobody uses where room is lacking; say what will be taken, or refuse."""
        kept = []
        for path in filter(_is_ours, folder.iterdir()):
            with suppress(FileNotFoundError):  # another process removes some, too
                kept.append((path.stat().st_mtime, path.stat().st_size, path))
        kept.sort()
        taken = sum(size for _, size, _ in kept)
        free = shutil.disk_usage(folder).free - _RESERVE
        for used, size, path in kept:
            if (taken + needed > self.limit or needed > free) and time.time() - used > _IN_USE_S:
                path.unlink(missing_ok=True)
                taken, free = taken - size, free + size
        what = f"{needed / 1e9:.3g} GB for the decoded frames of {len(names)} film" + "s" * (len(names) > 1)
        fewer = "set a larger data.scale or fewer data.frames"
        if taken + needed > self.limit:
            others = f", {taken / 1e9:.3g} GB of it in use" if taken else ""
            advice = f"raise it, {fewer}, or 0 to seek each frame in its film, which takes seconds"
            least = f"at least {taken + needed} ({what})"
            raise mismatch("data.disk_cache_bytes", least, f"{self.limit}{others}", advice)
        if needed > free:
            got = f"{max(free, 0) / 1e9:.3g} GB free"
            raise mismatch(folder, what, got, f"{fewer}, or run=<a folder on a larger disk>")
        print(f"frames  {what}, in {folder} ({free / 1e9:.3g} GB free)", file=sys.stderr, flush=True)


STORE = FilmStore()


def films_of(loads: Iterable[object]) -> list[Film]:
    """List the films that images are of, each once.

    Args:
        loads: what loads the frames of a scene; what is of no film is left out.
    """
    return list(dict.fromkeys(load.film for load in loads if isinstance(load, FilmImage)))


def _stamp(path: Path) -> tuple[int, int]:
    about = path.stat()
    return about.st_size, about.st_mtime_ns


def _note_of(film: Film) -> Path:
    return files.own_folder() / "frames" / f"{film.key}.json"


def _digest(path: Path, more: str) -> str:
    """Hash ``more`` and 64 blocks of a file, evenly spread."""
    digest, size = hashlib.sha256(more.encode()), path.stat().st_size
    with path.open("rb") as file:
        for i in range(_BLOCKS):
            file.seek(i * max(size - _BLOCK, 0) // (_BLOCKS - 1))
            digest.update(file.read(_BLOCK))
    return digest.hexdigest()


def _opaque(pixels: np.ndarray) -> Tensor:
    """Give pixels (H, W, 3) an alpha of 255."""
    rgba = np.empty((*pixels.shape[:2], 4), np.uint8)
    rgba[..., 3] = 255
    for channel in range(3):  # five times as fast as all at once
        rgba[..., channel] = pixels[..., channel]
    return torch.from_numpy(rgba)


def _is_ours(path: Path) -> bool:
    """Tell whether a file holds frames, or a part of them that a killed process left."""
    return path.name.lstrip(".")[24:].startswith(_SUFFIX) and path.is_file() and not path.is_symlink()


@contextmanager
def _locked(path: Path, waiting) -> Iterator[None]:
    """Hold a lock, which ends with the process; call ``waiting`` while another has it.

    On a file system without locks go on: what is written has a name of its own until it is whole.
    """
    lock = FileLock(path, fallback_to_soft=False)
    while True:
        try:
            lock.acquire(timeout=_WAIT_S)
        except Timeout:
            waiting()
            continue
        except OSError as error:
            if error.errno != errno.ENOSYS:
                raise
        break
    try:
        yield
    finally:
        lock.release()
