"""Find ``conf/`` and ``sweeps/``, in a checkout or in the installed package.

Without Hydra, whose import takes half a second, until a command composes its configuration.
"""

from __future__ import annotations

import os
from pathlib import Path

ROOT_VARIABLE = "FOREWARP_ROOT"
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
        raise ValueError(
            f"{root / 'conf'}: expected the configuration files, but got none; "
            f"install forewarp again, or set {ROOT_VARIABLE} to a checkout"
        )
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


def _holds_conf(folder: Path) -> bool:
    return (folder / "conf" / "train.yaml").is_file()
