"""Lock a run's folder while a process works on it."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from forewarp.data.files import LOCK
from forewarp.files import read_text, replace_file


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a run's folder for the duration of the block; make the folder if it is missing.

    The system holds the lock, so it ends with the process, even if killed. On a file system that does
    not support locks, go on unlocked. ``.lock`` names the process and stays behind.

    Raises:
        ValueError: if another process holds the lock; names it.
        OSError: if the folder cannot be made or written; names the key ``run``.
    """
    folder = Path(folder)
    holder, lock = folder / LOCK, FileLock(folder / f"{LOCK}.held", timeout=0, fallback_to_soft=False)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _acquire(lock)
        replace_file(holder, f"process {os.getpid()} on {socket.gethostname()}\n")
    except Timeout:
        raise ValueError(
            f"{folder}: expected a run that nobody works on, but got one of {_holder(holder)}; wait for it, "
            "or use run=..."
        ) from None
    except OSError as error:
        lock.release()
        raise OSError(error.errno, error.strerror, f"run: {error.filename or folder}") from None
    try:
        yield
    finally:
        lock.release()


def _acquire(lock: FileLock) -> None:
    """Acquire a lock, where the file system has locks."""
    try:
        lock.acquire()
    except Timeout:
        raise
    except OSError as error:
        if error.errno != errno.ENOSYS:
            raise


def _holder(path: Path) -> str:
    """Return what a lock's file says of the process that holds it."""
    try:
        return read_text(path, 1000)[:200].strip() or "another process"
    except (OSError, ValueError):
        return "another process"
