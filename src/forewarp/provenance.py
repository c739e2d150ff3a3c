"""Say which code ran: versions and commits of packages, and all that is installed."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from contextlib import suppress
from functools import cache
from importlib.metadata import (
    Distribution,
    PackageNotFoundError,
    distribution,
    distributions,
    packages_distributions,
)
from importlib.util import find_spec
from pathlib import Path

RESULTS = ("torch", "lightning", "hydra-core", "numpy", "numba", "torchmetrics")  # what results depend on
NUMBERS = ("conf", "sweeps")  # folders beside a checkout's src that count as code


def import_nothing_from_here() -> None:
    """Let processes that this one starts import nothing from the folder in which one works, where a file may
    be called as a module of Python. Python 3.10 knows no such word: there what a process imports first is.
    """
    os.environ["PYTHONSAFEPATH"] = "1"
    sys.path[:] = [place for place in sys.path if place]


def drop_missing_backend() -> None:
    """Let matplotlib draw where ``MPLBACKEND`` names a module that is not installed here, as a notebook hands
    its own on to commands.
    """
    scheme, _, module = os.environ.get("MPLBACKEND", "").partition("module://")
    if not scheme and module and find_spec(module.partition(".")[0]) is None:
        os.environ["MPLBACKEND"] = "agg"


@cache
def source_of(package: str) -> dict[str, str]:
    """Return ``version`` and ``commit`` of a top-level package or module, each where it is known.

    The commit is of the git checkout that has the package's own files, with a + where they differ from it; or
    else what was noted when it was installed from a repository (PEP 610). Nothing of the package is imported;
    what is found is kept until the process ends.
    """
    installed, place = _distribution(package), _place(package)
    commit = (place and _commit(place)) or (installed and _installed_from(installed))
    found = {"version": installed and installed.version, "commit": commit}
    return {key: value for key, value in found.items() if value}


def versions() -> dict[str, str]:
    """Return the versions of Python, of forewarp and of the installed packages that results depend on."""
    found = {"python": platform.python_version()}
    for package in ("forewarp", *RESULTS):
        with suppress(PackageNotFoundError):
            found[package] = distribution(package).version
    return found


@cache
def installed() -> str:
    """List every installed package, ``name==version`` a line, below the Python and the system."""
    named = {one.name.lower().replace("_", "-"): one for one in reversed([*distributions()]) if one.name}
    lines = [f"{name}=={named[name].version}" for name in sorted(named)]
    return "\n".join([f"# Python {platform.python_version()}, {platform.platform()}", *lines, ""])


def _distribution(package: str) -> Distribution | None:
    """Return what was installed that holds a package; the names of both may differ."""
    with suppress(PackageNotFoundError):
        return distribution(package)
    names = packages_distributions().get(package)
    return distribution(names[0]) if names else None


def _place(package: str) -> Path | None:
    """Return the file of a module, or of a package's ``__init__``; of a package without one, its folder."""
    try:
        spec = find_spec(package)
    except (ImportError, ValueError):
        return None
    if spec is None or spec.origin in ("built-in", "frozen"):
        return None
    places = [spec.origin] if spec.origin else list(spec.submodule_search_locations or ())
    return Path(places[0]).resolve() if places else None


def _commit(place: Path) -> str | None:
    """Return the commit of the checkout that tracks a file or a folder, and + where what belongs to it
    differs; None where no checkout does, as a package may lie, untracked, in another project's.
    """
    here = place if place.is_dir() else place.parent

    def git(*words: str) -> str:
        line = ["git", "-C", str(here), *words]
        return subprocess.run(line, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    belongs = ["."] if place.is_dir() or place.name == "__init__.py" else [place.name]
    if here.parent.name == "src":
        belongs += [str(folder) for name in NUMBERS if (folder := here.parents[1] / name).is_dir()]
    try:
        if not git("ls-files", "--", place.name if place.is_file() else "."):
            return None
        changed = git("--no-optional-locks", "status", "--porcelain", "--", *belongs)
        return git("rev-parse", "--short=9", "HEAD") + "+" * bool(changed)
    except (OSError, subprocess.SubprocessError):
        return None


def _installed_from(installed: Distribution) -> str | None:
    """Return the commit of the repository that a package was installed from, where it was noted."""
    with suppress(ValueError, TypeError, KeyError):
        return json.loads(installed.read_text("direct_url.json") or "{}")["vcs_info"]["commit_id"][:9]
    return None
