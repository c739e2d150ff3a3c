"""Turn an exception into the one line that the user should read."""

from __future__ import annotations

import errno
import re


def one_line(error: BaseException) -> str | None:
    """Return the line for an error that the user can mend; None for a bug of forewarp."""
    from hydra.errors import HydraException, InstantiationException
    from omegaconf.errors import OmegaConfBaseException

    if isinstance(error, InstantiationException):
        where = _after(str(error), "full_key:")
        if isinstance(error.__cause__, ValueError | OSError | ImportError):
            return one_line(error.__cause__)
        return f"{where or 'config'}: {flat(str(error.__cause__ or error))}"
    missing = re.search(r"Missing mandatory value: ([\w.]+)", str(error))
    if missing and isinstance(error, OmegaConfBaseException):
        return f"{missing[1]}: expected a value, but got none; set {missing[1]}=..."
    if getattr(error, "override", None):  # Hydra could not parse it
        return f"{error.override}: {flat(str(error))}"
    if isinstance(error, HydraException) and (found := _absent_plugin(str(error))):
        kind, plugin = found
        otherwise = ", or use launcher=local" if kind == "launcher" else ""
        expected = f"{kind}: expected the package of hydra/{kind}={plugin}, but got none"
        return f"{expected}; install forewarp[sweeps]{otherwise}"
    if isinstance(error, HydraException | OmegaConfBaseException):
        cause = error.__cause__
        detail = f" ({flat(str(cause))})" if isinstance(cause, OmegaConfBaseException) else ""
        return flat(str(error).split("Config search path")[0]) + detail
    if isinstance(error, OSError):
        return _of_system(error)
    if (
        isinstance(error, MemoryError)
        or "can't allocate memory" in str(error)
        or "out of memory" in str(error)
    ):
        wanted = re.search(r"allocate (\d+ bytes|[\d.]+ .iB)", str(error))
        return (
            f"memory: expected room for {wanted[1] if wanted else 'more'}, but got none; lower "
            "stage.*.density, or with model=forward data.rays or stage.*.num_voxels, and run the same "
            "command again"
        )
    if isinstance(error, TypeError) and "unexpected keyword argument" in str(error):
        return f"config: {error}; leave that key out"
    if isinstance(error, ImportError):
        return flat(str(error)) + ("" if "forewarp[" in str(error) else _to_install(error))
    return flat(str(error)) if isinstance(error, ValueError) else None


def _to_install(error: ImportError) -> str:
    """Say how to get a missing package: one of forewarp's extras, or another."""
    ours = ("numba", "trimesh", "embreex", "scipy", "matplotlib", "tensorboard", "imageio")
    if error.name is None or error.name.partition(".")[0] in ours:
        return "; install it with make install"
    return f"; install {error.name.partition('.')[0]}, or put its folder on PYTHONPATH"


def _absent_plugin(text: str) -> tuple[str, ...] | None:
    found = re.search(r"hydra/(launcher|sweeper)[/'=:\s]+(joblib|ray|submitit_\w+|optuna)", text)
    return found and found.groups()


def _of_system(error: OSError) -> str:
    reason, file = error.strerror or str(error), error.filename
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    advice = (
        "free some room and run the same command again" if full else "check that it exists and may be written"
    )
    expected = "room to write" if full else "a usable file or folder"
    return f"{file or 'a file'}: expected {expected}, but got {reason}; {advice}"


def _after(text: str, mark: str) -> str:
    """Return the rest of the line after ``mark``; empty if it does not occur."""
    return text.split(mark, 1)[1].strip().splitlines()[0] if mark in text else ""


def flat(text: str) -> str:
    """Join the lines of a message into one, without Hydra's own details."""
    lines = [line.strip() for line in text.splitlines()]
    kept = [line for line in lines if line and not line.startswith(("full_key:", "object_type="))]
    return "; ".join(kept).replace(":; ", ": ").replace(".; ", "; ")
