"""Compose the project's configurations."""

from copy import deepcopy
from functools import cache
from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from forewarp.runs.config_files import configurations
from forewarp.runs.sections import option_groups

ROOT = Path(__file__).parents[2]
CONF = ROOT / "conf"


def composed(*overrides: str, name: str = "train", hydra: bool = False) -> DictConfig:
    """Compose a command line's configuration; ``hydra``: with Hydra's own part. Each caller gets a copy."""
    return deepcopy(_composed(overrides, name, hydra))


@cache
def _folder() -> str:
    return str(configurations())


@cache
def _composed(overrides: tuple[str, ...], name: str, hydra: bool) -> DictConfig:
    with initialize_config_dir(_folder(), version_base="1.3"):
        return compose(name, list(overrides), return_hydra_config=hydra)


def options(group: str) -> list[str]:
    """Return the names of a group's options."""
    return option_groups(CONF)[group]


def groups() -> list[str]:
    """Return every group that one chooses from to train.

    Left out: ``dataset`` (it makes scenes), ``launcher`` (it needs packages), and what no one chooses.
    """
    others = {"dataset", "launcher", "numbers", "paths", "hydra", "stage/one"}
    return [group for group, names in option_groups(CONF).items() if names and group not in others]
