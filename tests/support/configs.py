"""Compose the project's configurations."""

from copy import deepcopy
from functools import cache
from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from forewarp.runs.config_files import configurations

ROOT = Path(__file__).parents[2]
CONF = ROOT / "conf"


def composed(*overrides: str, name: str = "train", hydra: bool = False) -> DictConfig:
    """Compose a command line's configuration; ``hydra``: with Hydra's own part. Each caller gets a copy."""
    return deepcopy(_composed(overrides, name, hydra))


@cache
def _composed(overrides: tuple[str, ...], name: str, hydra: bool) -> DictConfig:
    with initialize_config_dir(str(configurations()), version_base="1.3"):
        return compose(name, list(overrides), return_hydra_config=hydra)


def options(group: str) -> list[str]:
    """Return the names of a group's option files."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def groups() -> list[str]:
    """Return every group that one chooses from to train.

    Left out: ``dataset`` (it makes scenes), ``launcher`` (it needs packages), and a method's own numbers
    (``model_...``), which follow from the choices.
    """
    folders = [path.relative_to(CONF).as_posix() for path in CONF.rglob("*") if path.is_dir()]
    others = ("/one", "dataset", "launcher")
    chosen = [group for group in folders if options(group) and not group.startswith("model_")]
    return sorted(group for group in chosen if not group.endswith(others))
