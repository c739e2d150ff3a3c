"""Lock a run's folder while a process works on it."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from forewarp.data.fingerprint import LOCK


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
        lock.acquire()
    except Timeout:
        name = holder.read_text()[:200].strip() if holder.is_file() else "another process"
        raise ValueError(
            f"{folder}: expected a run that nobody works on, but got one of {name}; wait for it, or "
            "use run=..."
        ) from None
    except OSError as error:
        if error.errno != errno.ENOSYS:
            raise OSError(error.errno, error.strerror, f"run: {error.filename or folder}") from None
    try:
        holder.write_text(f"process {os.getpid()} on {socket.gethostname()}\n")
        yield
    finally:
        lock.release()
