"""Write files whole or not at all; read them only up to a size."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

MOST_BYTES = 1 << 26  # what a file that is parsed may have; parsing takes up to thirty times as much memory
MOST_CONFIG = 1 << 20  # of a config or a plan; ours have a few thousand


@contextmanager
def written_whole(path: Path, *, synced: bool = False) -> Iterator[Path]:
    """Give a place beside ``path`` to write to, which becomes ``path`` at the end; make its folder.

    Args:
        path: what appears whole or not at all. What was there is replaced.
        synced: wait until the bytes are on the disk before the file takes its name.

    Raises:
        OSError: naming ``path``, where it cannot be written; nothing is then left beside it.
    """
    beside = path.with_name(f".{path.name}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield beside
        if synced:
            with beside.open("rb+") as file:
                os.fsync(file.fileno())
        os.replace(beside, path)
    except OSError as error:  # a full disk does not say which file
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        with suppress(OSError):
            beside.unlink()


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
    """Read the object of a JSON file; None where there is none that is whole and within ``MOST_BYTES``."""
    try:
        content = json.loads(read_text(path))
    except (FileNotFoundError, NotADirectoryError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


def read_text(path: Path, most: int = MOST_BYTES) -> str:
    """Read a file as UTF-8; bytes that are none are replaced.

    Raises:
        OSError: where it cannot be read.
        ValueError: where it has more than ``most`` bytes; nothing is then read.
    """
    if (size := path.stat().st_size) > most:
        raise ValueError(f"{path}: expected at most {most} bytes, but got {size}")
    return path.read_bytes().decode(errors="replace")
