"""Write files whole or not at all; read them only up to a size."""

from __future__ import annotations

import errno
import json
import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from reprlib import repr as short

# The most bytes that are read of a file.
MOST_CONFIG = 1 << 20  # of a config or a plan; ours have a few thousand
MOST_BYTES = 1 << 26  # of a text that is parsed, which takes up to thirty times as much memory
MOST_POINTS = 1 << 28  # of a cloud of points as text
MOST_IMAGE = 1 << 29
MOST_ARRAYS = 1 << 30  # of NumPy's files, also when unpacked


@contextmanager
def written_whole(path: Path, *, synced: bool = False) -> Iterator[Path]:
    """Write to the path that this gives, which is renamed to ``path`` at the end; make its folder.

    Args:
        path: appears whole or not at all; a file or a link already there is replaced.
        synced: wait until the bytes are on the disk before renaming.

    Raises:
        OSError: naming ``path``, where it cannot be written; nothing is then left behind.
    """
    beside = path.with_name(f".{path.name}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield beside
        if synced:
            with beside.open("rb+") as file:
                os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError as error:
        # A full disk names no file, or a temporary one of a library's.
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        if not full and error.filename not in (None, str(beside), str(path)):
            raise
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        with suppress(OSError):
            beside.unlink()


@contextmanager
def folder_written_whole(path: Path, mark: str) -> Iterator[Path]:
    """Fill the folder that this gives, which takes the place of ``path`` at the end.

    Args:
        path: appears whole or not at all. See ``check_replaceable`` for what it may hold.
        mark: name of a file that is in every such folder.

    Raises:
        ValueError: see ``check_replaceable``.
        OSError: where it cannot be written; nothing is then left behind.
    """
    check_replaceable(path, mark)
    beside, before = (path.with_name(f".{path.name}.{end}") for end in ("part", "before"))
    try:
        for old in (beside, before):  # of a call that was killed
            shutil.rmtree(old, ignore_errors=True)
        beside.mkdir(parents=True)
        yield beside
        if path.exists():
            os.replace(path, before)
        os.replace(beside, path)
    finally:
        for old in (beside, before):
            shutil.rmtree(old, ignore_errors=True)


def check_replaceable(path: Path, mark: str) -> None:
    """Refuse a path at which lies what is not ours: a file, a link, or a folder of files without ``mark``.

    Raises:
        ValueError: naming ``path``.
    """
    ours = path.is_dir() and not path.is_symlink() and ((path / mark).is_file() or not any(path.iterdir()))
    if os.path.lexists(path) and not ours:
        raise ValueError(
            f"{path}: expected no folder, an empty one, or one written before (with {mark}), "
            "but got other files; choose another"
        )


def replace_file(path: Path, content: bytes | str) -> None:
    """Write ``content`` as a whole file.

    Raises:
        OSError: naming ``path``, where it cannot be written.
    """
    with written_whole(path) as beside:
        beside.write_bytes(content.encode() if isinstance(content, str) else content)


def write_json(path: Path, content: dict) -> None:
    """Write an object as a whole JSON file.

    Raises:
        OSError: naming ``path``, where it cannot be written.
        ValueError: for numbers that are not finite, which JSON does not have.
    """
    replace_file(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> dict | None:
    """Read the object of a JSON file; None if the file is missing or refused by ``load_json``."""
    try:
        return load_json(path)
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None


def load_json(path: Path) -> dict:
    """Read the object of a JSON file.

    Raises:
        OSError: where it cannot be read.
        ValueError: in one line, if the file is too large, does not parse or holds no object.
    """
    raw = read_bytes(path)
    try:
        content = json.loads(raw.decode())
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: line {error.lineno}: expected JSON, but got {error.msg}") from error
    except (ValueError, RecursionError) as error:  # bytes that are no text, absurd numbers or nesting
        raise ValueError(f"{path}: expected JSON, but got {short(str(error))}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a JSON object at the top, but got {type(content).__name__}")
    return content


def read_text(path: Path, most: int = MOST_BYTES) -> str:
    """Read a file as UTF-8, as ``read_bytes`` does; bytes that are no text are replaced."""
    return read_bytes(path, most).decode(errors="replace")


def read_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """Read a regular file.

    Raises:
        OSError: where it cannot be read.
        ValueError: as ``check_size``; nothing is then read.
    """
    check_size(path, most)
    return path.read_bytes()


def check_size(path: Path, most: int) -> None:
    """Refuse a file that must not be opened.

    Raises:
        OSError: where there is none, or a folder.
        ValueError: for a device, a pipe, and a file of more than ``most`` bytes.
    """
    about = path.stat()
    if stat.S_ISDIR(about.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(about.st_mode):
        raise ValueError(f"{path}: expected a file, but got a device or a pipe")
    if about.st_size > most:
        raise ValueError(f"{path}: expected at most {most} bytes, but got {about.st_size}")
