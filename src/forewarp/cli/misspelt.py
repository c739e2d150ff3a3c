"""Words of a command line that are nearly right: a key with a slip in it, a folder without its key."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from forewarp.runs.folders import configurations

FOLDERS = {"evaluate": "run", "render": "run", "train": "resume"}


def with_keys(name: str, words: list[str]) -> list[str]:
    """The words, with ``run=`` (of ``train``: ``resume=``) put before a bare folder.

    Args:
        name: of the command.
        words: as typed, without the command.
    """
    key, before = FOLDERS.get(name), ["", *words]
    bare = [
        key and "=" not in word and word[:1] not in "-+~" and before[i][:1] != "-" and Path(word).is_dir()
        for i, word in enumerate(words)
    ]
    return [f"{key}={word}" if is_bare else word for is_bare, word in zip(bare, words)]


def unknown_key(error: Exception, name: str, words: list[str]) -> str | None:
    """One line for a key that the configuration has not, with the nearest that it has; None: it is not that.

    Args:
        error: what Hydra raised.
        name: of the configuration's file.
        words: of the command line.
    """
    from hydra.errors import HydraException

    found = re.match(r"Could not override '([^'@]+)'", str(error))
    if found is None or not isinstance(error, HydraException):
        return None
    key, conf = found[1], configurations()
    known = [*_keys(_composed(conf, name, [w for w in words if w.split("=")[0] != key])), *_groups(conf)]
    near = difflib.get_close_matches(key, known, 1, cutoff=0.8)
    advice = f"did you mean {near[0]}?" if near else f"forewarp-{name} --cfg job prints all that there are"
    return f"{key}: expected a key of the configuration, but got none of this name; {advice}"


def _composed(conf: Path, name: str, words: list[str]):
    """The configuration that the other words make, or the plain one where they make none."""
    import hydra
    from hydra.core.global_hydra import GlobalHydra

    GlobalHydra.instance().clear()
    dirs = [word.partition("=")[2] for word in words if word.startswith("--config-dir=")]
    dirs += [after for before, after in zip(words, words[1:]) if before == "--config-dir"]
    more = [f"hydra.searchpath=[{','.join(f'file://{Path(d).resolve()}' for d in dirs)}]"] if dirs else []
    with hydra.initialize_config_dir(str(conf), version_base="1.3"):
        with suppress(Exception):  # the mistakes in them are not the one that is told
            return hydra.compose(name, [*more, *(w for w in words if "=" in w and w[:1] != "-")])
        return hydra.compose(name)


def _keys(node, prefix: str = "") -> Iterator[str]:
    from omegaconf import DictConfig

    for key in (key for key in node if not str(key).startswith("_")):
        yield f"{prefix}{key}"
        inner = node._get_node(key)
        if isinstance(inner, DictConfig) and not (inner._is_none() or inner._is_missing()):
            yield from _keys(inner, f"{prefix}{key}.")


def _groups(conf: Path) -> Iterator[str]:
    yield from (path.relative_to(conf).as_posix() for path in conf.rglob("*") if path.is_dir())
