"""Whose a run's folder is while it is worked on, and what data it was begun with."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from forewarp.data.fingerprint import LOCK, difference

if TYPE_CHECKING:
    from forewarp.training.stages import Run

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

DATA = "data.json"
CHOICES = ("refuse", "accept")


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Work on a run's folder, made if need be, while nobody else does.

    The lock is the kernel's: it ends with the process, however that ends. Where the system has no ``flock``
    nothing is locked.

    Raises:
        ValueError: where another process works on it, naming that.
        OSError: where it cannot be made or written, naming the key ``run``.
    """
    with _lock_file(folder) as file:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                raise ValueError(
                    f"{folder}: expected a run that nobody works on, but got one of "
                    f"{file.read(200).strip() or 'another process'}; wait for it, or use run=..."
                ) from None
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield


def _lock_file(folder: Path) -> TextIO:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return open(folder / LOCK, "a+")
    except OSError as error:
        raise OSError(error.errno, error.strerror, f"run: {error.filename}") from None


def same_data(run: Run, changed: str) -> None:
    """Note what the scene's files are when a run begins; refuse to go on where they have changed since.

    Args:
        run: whose data are read.
        changed: ``refuse``, or ``accept`` what they are now.

    Raises:
        ValueError: naming what changed.
    """
    from forewarp.files import read_json, write_json

    if changed not in CHOICES:
        raise ValueError(f"data_changed: expected one of {', '.join(CHOICES)}, but got {changed}")
    path, now = Path(run.folder) / DATA, run.datamodule.fingerprint()
    if now is None:
        return
    before = read_json(path)
    found = _change(run, before, now)
    if found and changed == "refuse":
        raise ValueError(
            f"{path}: expected the data that the run was begun with, but got others: {found}; "
            "use run=..., or go on with data_changed=accept"
        )
    if now != before:
        write_json(path, now)


def tell_other_data(run: Run) -> None:
    """Say so where the scene's files are no longer those that a run was begun with."""
    from forewarp.files import read_json

    path, now = Path(run.folder) / DATA, run.datamodule.fingerprint()
    if now is not None and (found := _change(run, read_json(path), now)):
        print(
            f"warning: {path}: expected the data that the run was begun with, but got others: {found}",
            file=sys.stderr,
        )


def _change(run: Run, before: dict | None, now: dict) -> str | None:
    begun = any(Path(run.folder).glob("*/last.ckpt"))
    return difference(before, now) if before is not None and begun else None
