"""Find the configuration files: ``conf/`` and ``sweeps/``, in a checkout or in the installed package."""

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
    root = project_root()
    if root != PACKAGE:
        os.environ[ROOT_VARIABLE] = str(root)
    from forewarp.runs.sections import serve_sections

    serve_sections()
    _register(root / "sweeps")
    return root / "conf"


def _holds_conf(folder: Path) -> bool:
    return (folder / "conf" / "train.yaml").is_file()


def _register(folder: Path) -> None:
    """Make the files of a folder options of a config group named after it.

    Adding the folder above to Hydra's search path would make everything in it a config group.
    """
    from hydra.core.config_store import ConfigStore

    from forewarp.runs.sections import parsed

    store = ConfigStore.instance()
    for file in sorted(folder.glob("*.yaml")):
        store.store(
            file.stem, parsed(file.read_text("utf-8")).content, folder.name, "_global_", provider="forewarp"
        )
