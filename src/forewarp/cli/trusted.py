"""Configs that come from a run's folder: read as data, and refused where they could do more than a config."""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

MOST_BYTES, MOST_LEVELS = 1 << 20, 40
# Beside the classes that modules of forewarp define. Whole names: through a prefix all of torch is reached.
ELSEWHERE = {
    "lightning.Trainer",
    "lightning.pytorch.Trainer",
    "lightning.pytorch.loggers.TensorBoardLogger",
}
_RESERVED = {"_target_", "_partial_", "_recursive_", "_convert_"}
_PARTS = {"name", "version", "sub_dir"}  # of the path that a logger writes to


def trusted_config(text: str, where: Path) -> DictConfig:
    """A resolved config from its YAML.

    Raises:
        ValueError: for what is no YAML, no mapping, uses aliases or interpolations, is nested too deeply, or
            names a ``_target_`` that is neither a class of forewarp, by the module that defines it, nor in
            ``ELSEWHERE``, or sends a logger out of the folder of its stage.
    """
    try:
        _check_events(text, where)
        config = OmegaConf.create(text)
        content = OmegaConf.to_container(config) if isinstance(config, DictConfig) else None
    except (yaml.YAMLError, UnicodeError, OmegaConfBaseException, TypeError, AssertionError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{where}: expected YAML, but got {reason}; delete the run's folder") from None
    except (ValueError, RecursionError, OverflowError) as error:
        if str(error).startswith(f"{where}: "):
            raise
        raise ValueError(f"{where}: expected YAML, but got {error}; delete the run's folder") from None
    if content is None:
        raise ValueError(f"{where}: expected a mapping, but got another kind; delete the run's folder")
    _check(content, where, "")
    return config


def _check_events(text: str, where: Path) -> None:
    """Refuse what grows when it is built: aliases and endless nesting; of text too long nothing is parsed."""
    if len(text) > MOST_BYTES:
        raise ValueError(f"{where}: expected at most {MOST_BYTES} characters, but got {len(text)}")
    level = 0
    for event in yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(f"{where}: expected no aliases, but got *{event.anchor}; write it out")
        level += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if level > MOST_LEVELS:
            raise ValueError(f"{where}: expected at most {MOST_LEVELS} levels, but got more")


def _check(node: object, where: Path, key: str) -> None:
    if isinstance(node, dict):
        for name, value in node.items():
            inner = f"{key}.{name}" if key else str(name)
            if name == "_target_":
                _check_target(value, where, inner)
                _check_logger(node, where, key)
            elif str(name).startswith("_") and name not in _RESERVED:
                raise ValueError(f"{where}: {inner}: expected no key of this name; delete it")
            _check(value, where, inner)
    elif isinstance(node, list):
        for i, value in enumerate(node):
            _check(value, where, f"{key}[{i}]")
    elif isinstance(node, str) and "${" in node:
        raise ValueError(f"{where}: {key}: expected a plain value, but got {node[:80]}; write the value")


def _check_target(name: object, where: Path, key: str) -> None:
    if isinstance(name, str) and name in ELSEWHERE:
        return
    refusal = (
        f"{where}: {key}: expected a class of forewarp, or one of {', '.join(sorted(ELSEWHERE))}, "
        f"but got {name!r:.80}"
    )
    if not isinstance(name, str) or not name.startswith("forewarp."):
        raise ValueError(refusal)
    home, _, last = name.rpartition(".")
    try:
        found = getattr(importlib.import_module(home), last)
    except Exception as error:  # what imports raise
        raise ValueError(f"{refusal} ({type(error).__name__})") from None
    # Not what a module imports: ``forewarp.cli.entry.Path`` begins with a name of ours and is none of ours.
    if not inspect.isclass(found) or found.__module__ != home:
        raise ValueError(refusal)


def _check_logger(node: dict, where: Path, key: str) -> None:
    """A logger joins what it is given to the folder of the stage."""
    for name in _PARTS & node.keys() if node["_target_"].endswith("Logger") else ():
        if not re.fullmatch(r"(\w[\w.-]*)?", str(node[name])):
            raise ValueError(
                f"{where}: {key}.{name}: expected the name of a folder, but got {node[name]!r:.80}"
            )
