"""Find ``conf/`` and ``sweeps/``, in a checkout or in the installed package, and the ``conf/`` of others.

Without Hydra, whose import takes half a second, until a command composes its configuration.
"""

from __future__ import annotations

import os
import sys
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

ROOT_VARIABLE = "FOREWARP_ROOT"
ENTRY_POINTS = "forewarp.methods"  # the group in which packages name themselves
PACKAGE = Path(__file__).resolve().parents[1]


def project_root() -> Path:
    """Return the folder that holds ``conf/`` and ``sweeps/``.

    The folder that ``FOREWARP_ROOT`` names, else the installed package, else the checkout.

    Raises:
        ValueError: if that folder has no ``conf/``.
    """
    named = os.environ.get(ROOT_VARIABLE)
    installed = PACKAGE if _holds_conf(PACKAGE) else PACKAGE.parents[1]
    root = Path(named).expanduser().resolve() if named else installed
    if not _holds_conf(root):
        advice = f"install forewarp again, or set {ROOT_VARIABLE} to a checkout"
        raise ValueError(f"{root / 'conf'}: expected the configuration files, but got none; {advice}")
    return root


def configurations() -> Path:
    """Return ``conf/``, ready for Hydra: ``sweeps=NAME`` and sections are options, and ``paths.root`` is set.

    ``paths.root`` is the checkout, or the current folder for an installed package.
    """
    from forewarp.runs.sections import serve

    root = project_root()
    if root != PACKAGE:
        os.environ[ROOT_VARIABLE] = str(root)
    serve(root / "sweeps")
    return root / "conf"


def installed() -> dict[str, Path]:
    """Return the ``conf/`` of each installed package that declares an entry point of ``ENTRY_POINTS``, by the
    package's name; warn of a package without one.

    No package is imported here: code of theirs runs where a config that was typed names it.
    """
    found = {}
    for entry in sorted(entry_points(group=ENTRY_POINTS), key=lambda entry: entry.value):
        package = entry.value.partition(":")[0].strip()
        if folders := [folder for folder in _folders(package) if folder.is_dir()]:
            found[package] = folders[0]
        else:
            expected = f"entry point {entry.name} of {ENTRY_POINTS}: expected a package that has conf/"
            advice = "install that package again, or mend its pyproject.toml"
            _warn(f"{expected}, but got {package!r}; {advice}")
    return found


def _folders(package: str) -> list[Path]:
    top, *inner = package.split(".")
    try:
        spec = find_spec(top)  # of a name with a dot it would import what lies above
    except (ImportError, ValueError):
        return []
    places = (spec and spec.submodule_search_locations) or []
    return [Path(place, *inner, "conf").resolve() for place in places]


@cache  # once a process, however often a config is composed
def _warn(line: str) -> None:
    print(f"warning: {line}", file=sys.stderr)


def _holds_conf(folder: Path) -> bool:
    return (folder / "conf" / "train.yaml").is_file()
