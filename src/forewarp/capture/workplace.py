"""A folder beside the result in which a capture is made, so that an interrupted one goes on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from forewarp.files import read_json, write_json

_ABOUT = "about.json"


@contextmanager
def workplace(out: Path, about: Mapping[str, object]) -> Iterator[Path]:
    """Give the folder ``.<name of out>.work`` beside ``out``, with what an interrupted call left in it.

    Args:
        out: of the result.
        about: what the work depends on; work about anything else is removed first.

    It is removed at the end, and where the work is refused (``_refused``), with the folders that were made
    for it; it stays after Ctrl-C, a kill, errors of the system and bugs.

    Raises:
        ValueError: where another call is at work.
    """
    place = out.with_name(f".{out.name}.work")
    made = [folder for folder in place.parents if not folder.exists()]
    place.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(place.with_name(place.name + ".lock"))
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ValueError(
            f"{out}: expected one capture at a time, but got another at work; wait for it"
        ) from None
    stays = False
    try:
        place.mkdir(exist_ok=True)
        wanted = json.loads(json.dumps(about, default=str))
        if read_json(place / _ABOUT) != wanted:
            shutil.rmtree(place)
            place.mkdir()
            write_json(place / _ABOUT, wanted)
        yield place
    except BaseException as error:
        stays = not _refused(error)
        raise
    finally:
        if not stays:  # under the lock: what another call begins afterwards is its own
            shutil.rmtree(place, ignore_errors=True)
            Path(lock.lock_file).unlink(missing_ok=True)
        lock.release()
        if not stays:
            for folder in made:
                with suppress(OSError):  # not empty: the result is in it
                    folder.rmdir()


def _refused(error: BaseException) -> bool:
    """Tell a refusal, which says what it got, from a bug, as a ``ValueError`` of NumPy's."""
    return isinstance(error, ImportError) or (isinstance(error, ValueError) and " but got " in str(error))
