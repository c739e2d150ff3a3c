"""A run's config: what of it makes two runs different, and how it is kept in the run's folder and read back.

Nothing here loads torch, so that what is mistyped is answered at once.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from forewarp.runs.renamed import refuse_old
from forewarp.files import MOST_CONFIG, read_text, replace_file
from forewarp.runs.trust import trust_of, trusted_config
from forewarp.runs.overrides import as_typed, key_of, typed_words

# What makes two runs different; where they run and what is shown of them does not.
IDENTITY = ("data", "model", "objective", "stage", "preset", "budget", "seed")
# Named first of what differs, as others follow from these.
TYPED = ("data.scene", "data.root", "seed", "preset", "budget")
HASH = "{hash}"
# What may be set beside resume=<run>.
MAY_CHANGE = (
    *("trainer", "threads", "lpips_weights", "sheets", "evaluate", "checkpoint_seconds"),
    *("sentinel", "data_changed", "score"),
)


def hashed(config: DictConfig) -> DictConfig:
    """The config with ``{hash}`` in ``run`` replaced by ten digits of a SHA-256 of all that tells runs apart.

    So a finished job is known by what it computed, and another config never meets its folder. Where minutes
    bound a run, what it computes with is part of that.
    """
    if HASH in str(config.run):
        config.run = str(config.run).replace(HASH, content_hash(config))
    return config


def content_hash(config: DictConfig, more: Sequence[str] = (), *others: object) -> str:
    """Ten digits of a SHA-256 of what a run computes, of ``more`` keys of its config, and of ``others``."""
    _make_absolute(config)
    content = {key: _plain(config.get(key)) for key in (*IDENTITY, *more)}
    if config.budget.minutes is not None:
        from forewarp.training.device import device_of

        content["on"] = [device_of(config.trainer.accelerator).type, config.trainer.get("precision")]
    if others:
        content["others"] = others
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:10]


def _plain(value: object) -> object:
    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


def claim(config: DictConfig, *, finished: bool = False) -> None:
    """Write the resolved config into the run's folder, unless ``finished``; refuse one of another run."""
    folder, path = Path(config.run), Path(config.run) / "config.yaml"
    _make_absolute(config)
    if config.get("resume") is None:
        config.command = typed()
    config.resume = None
    if "trust" in config:  # said by whoever runs it, never by a folder
        config.trust = None
    resolved = OmegaConf.create(OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    begun = folder.is_dir() and any(folder.glob("*/last.ckpt"))
    if begun and not path.is_file():
        raise ValueError(
            f"{path}: expected the configuration of the run, but got none; use run=... or delete the folder"
        )
    if begun:
        _refuse_another(path, read_config(path, None), resolved)  # compared, and never instantiated
    if finished:  # its numbers are of how it was run, not of what is typed now
        return
    replace_file(path, OmegaConf.to_yaml(resolved))


def typed() -> str | None:
    """The command line of this run alone; None where Hydra was not asked."""
    return as_typed("train", typed_words()) if HydraConfig.initialized() else None


def saved_config(run: str | None, changes: DictConfig, key: str = "run") -> DictConfig:
    """The config of the run in a folder, with what the command line changed.

    Args:
        run: the run's folder.
        changes: keys of the run's config; those that are null change nothing. Others are left out.
            ``trust`` names packages whose code the config may name.
        key: what named the folder.
    """
    if run is None:
        raise ValueError("run: expected the folder of a run, but got nothing; set run=runs/...")
    path = Path(run) / "config.yaml"
    if not path.is_file():
        raise ValueError(
            f"{path}: expected the configuration of a run, but got none; set {key}=<a run's folder>"
        )
    saved = read_config(path, trust_of(changes.get("trust")))
    for name in ("trainer", "threads", "lpips_weights", "sheets"):
        if changes.get(name) is not None:
            saved[name] = changes[name]
    if (changes.get("data") or {}).get("root") is not None:
        saved.data.root = changes.data.root
    saved.run = str(run)
    return saved


def resumed(config: DictConfig) -> DictConfig:
    """With ``resume=<folder>`` the config of the run there, and of what was typed only what may change.

    Raises:
        ValueError: for another key beside it, or a folder that is no run.
    """
    if config.get("resume") is None:
        return config
    trust = OmegaConf.create({"trust": config.get("trust")})
    saved = saved_config(str(config.resume), trust, "resume")
    saved.resume, saved.data_changed = str(config.resume), "refuse"
    words = HydraConfig.get().overrides.task if HydraConfig.initialized() else []
    for word in words:
        key = key_of(word)
        if key == "data.root":
            saved.data.root = config.data.root
        elif key.split(".")[0] in MAY_CHANGE:
            saved[key.split(".")[0]] = config[key.split(".")[0]]
        elif key not in ("resume", "trust"):
            raise ValueError(
                f"{key}: expected no such key beside resume=, whose config.yaml holds it, but got {word}; "
                f"beside it go {', '.join(MAY_CHANGE)}, data.root, trust"
            )
    return saved


def read_config(path: Path, trust: Sequence[str] | None = ()) -> DictConfig:
    """The config in a run's folder; ``trust`` as in ``trusted_config``.

    Raises:
        ValueError: where it is no config of a run, or one that is not to be trusted.
    """
    return parsed(read_text(path, MOST_CONFIG), path, trust)


def parsed(text: str, path: Path, trust: Sequence[str] | None = ()) -> DictConfig:
    """As ``read_config``, of text; ``path`` names it in errors."""
    refuse_old(trusted_config(text, path, None), path)
    config = trusted_config(text, path, trust)
    for key in (*IDENTITY, "trainer", "logger", "callbacks"):
        if key not in config and key != "objective":  # a method may have none of its own
            raise ValueError(f"{path}: expected the key {key}, but got none; delete the run's folder")
    return config


def _make_absolute(config: DictConfig) -> None:
    """The data's place as seen from anywhere: a run may be evaluated from another folder."""
    if not OmegaConf.is_missing(config.data, "root") and config.data.get("root") is not None:
        config.data.root = str(Path(config.data.root).expanduser().resolve())


def _refuse_another(path: Path, before: DictConfig, now: DictConfig) -> None:
    old, new = ({k: OmegaConf.to_container(c).get(k) for k in IDENTITY} for c in (before, now))
    found = list(_differences(old, new))
    if found:
        key, was, got = min(found, key=lambda row: [not row[0].startswith(first) for first in TYPED])
        more = f" (and {len(found) - 1} more keys)" if len(found) > 1 else ""
        raise ValueError(
            f"{path}: {key}: expected {was}, as the run that this folder holds, but got {got}{more}; "
            "use run=<another folder>, or delete this one"
        )


def _differences(old, new, key: str = ""):
    if isinstance(old, dict) and isinstance(new, dict):
        for name in [*old, *(n for n in new if n not in old)]:
            inner = f"{key}.{name}" if key else name
            yield from _differences(old.get(name, "nothing"), new.get(name, "nothing"), inner)
    elif old != new:
        yield key, old, new
