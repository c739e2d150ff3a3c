"""Where ``conf/`` and ``sweeps/`` are: in a checkout at its top, from a wheel inside the package."""

from __future__ import annotations

import os
from pathlib import Path

ROOT_VARIABLE = "FOREWARP_ROOT"
PACKAGE = Path(__file__).resolve().parents[1]


def project_root() -> Path:
    """The folder that holds ``conf/`` and ``sweeps/``: what ``FOREWARP_ROOT`` names, the package of a wheel,
    or the checkout.

    Raises:
        ValueError: where there is no ``conf/``.
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
    """The folder ``conf/``, ready to be composed from: ``sweeps=`` finds its options, and ``paths.root`` is
    the checkout; from a wheel it stays the current folder.
    """
    root = project_root()
    if root != PACKAGE:
        os.environ[ROOT_VARIABLE] = str(root)
    _offer(root / "sweeps")
    return root / "conf"


def _holds_conf(folder: Path) -> bool:
    return (folder / "conf" / "train.yaml").is_file()


def _offer(folder: Path) -> None:
    """Make a folder's files options of the group of its name.

    On Hydra's search path the folder above would have to stand, and with it all that lies there.
    """
    from hydra.core.config_store import ConfigStore
    from omegaconf import OmegaConf

    store = ConfigStore.instance()
    for file in sorted(folder.glob("*.yaml")):
        store.store(file.stem, OmegaConf.load(file), folder.name, "_global_", provider="forewarp")
