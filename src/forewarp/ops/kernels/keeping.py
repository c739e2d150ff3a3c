"""Where compiled kernels are kept, so that the next process need not compile them."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import numba


def can_keep() -> bool:
    """Tell whether Numba has a folder for kernels: NUMBA_CACHE_DIR, beside the code, or the user's cache."""
    try:
        numba.njit(cache=True)(can_keep)  # looks for the folder, and compiles nothing
    except RuntimeError:
        return False
    return True


def private_folder() -> Path | None:
    """Make this user's folder for kernels below the temporary one; None where that cannot be, or others may
    write into it, as what lies in it is run.
    """
    with suppress(OSError, AttributeError):  # no temporary folder; no users
        folder = Path(tempfile.gettempdir()) / f"forewarp-kernels-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        about = folder.lstat()
        if stat.S_ISDIR(about.st_mode) and about.st_uid == os.getuid() and not about.st_mode & 0o022:
            return folder
    return None


def keep() -> bool:
    """Find a folder for compiled kernels; say where, unless Numba has one. Tell whether there is one."""
    if can_keep():
        return True
    if (folder := private_folder()) is not None:
        numba.config.CACHE_DIR = str(folder)
        if can_keep():
            print(f"kernels: kept in {folder}, as no other folder can be written", file=sys.stderr)
            return True
    advice = "set NUMBA_CACHE_DIR to a folder that can be written"
    print(f"kernels: compiled anew by each process, as no folder can be written; {advice}", file=sys.stderr)
    return False


KEPT = keep()
