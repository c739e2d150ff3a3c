"""Keep a run's config in its folder, read it back, and tell runs apart by their configs.

Nothing here loads torch, so that a mistyped command is answered at once.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from forewarp.files import MOST_CONFIG, read_text, replace_file
from forewarp.runs.overrides import command_line, key_of, typed_overrides
from forewarp.runs.trust import trust_of, trusted_config

# Two runs differ if these keys differ; device, folder and what is shown do not count.
IDENTITY = ("data", "model", "objective", "stage", "preset", "budget", "seed")
# Named first in a refusal, as other differences follow from these.
TYPED = ("model.name", "data.scene", "data.root", "seed", "preset", "budget")
HASH = "{hash}"
# May be set beside resume=<run>.
MAY_CHANGE = (
    *("trainer", "threads", "lpips_weights", "sheets", "views", "reduce", "evaluate", "checkpoint_seconds"),
    *("sentinel", "data_changed", "score", "viewer", "host", "port"),
)


def hashed(config: DictConfig) -> DictConfig:
    """Replace ``{hash}`` in the key ``run`` by ten digits of a hash of the keys that tell runs apart.

    So each configuration has a folder of its own, and a finished job is found again. A precision other than
    32-true counts too, and for a run bounded by minutes the device and the number of threads.
    """
    if HASH in str(config.run):
        config.run = str(config.run).replace(HASH, content_hash(config))
    return config


def content_hash(config: DictConfig, more: Sequence[str] = (), *others: object) -> str:
    """Return ten digits of a SHA-256 of ``IDENTITY`` and ``more`` keys of a config, and of ``others``."""
    _make_absolute(config)
    content = {key: _plain(config.get(key)) for key in (*IDENTITY, *more)}
    precision = config.trainer.get("precision")
    if config.budget.minutes is not None:
        from forewarp.runs.device import device_for

        content["on"] = [device_for(config).type, precision, config.get("threads")]
    elif precision not in (None, "32-true"):
        content["precision"] = precision
    if others:
        content["others"] = others
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:10]


def _plain(value: object) -> object:
    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


def claim(config: DictConfig, *, finished: bool = False) -> None:
    """Write the resolved config into the run's folder, unless the folder holds another run.

    Args:
        config: the run's config; the key ``run`` names the folder.
        finished: if true, check but write nothing: a finished run keeps the config it was measured with.

    Raises:
        ValueError: if the folder holds a run of another config, or checkpoints without a config.
    """
    folder, path = Path(config.run), Path(config.run) / "config.yaml"
    _make_absolute(config)
    if config.get("resume") is None:
        config.command = command_line("train", typed_overrides()) if HydraConfig.initialized() else None
    config.resume = None
    if "trust" in config:  # only who runs the command may trust, never a folder
        config.trust = None
    if "viewer" in config:  # a run that goes on opens no page by itself
        config.viewer = False
    resolved = OmegaConf.create(OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    begun = folder.is_dir() and any(folder.glob("*/last.ckpt"))
    if begun and not path.is_file():
        raise ValueError(
            f"{path}: expected the configuration of the run, but got none; use run=... or delete the folder"
        )
    if begun:
        _refuse_another(path, read_config(path, None), resolved)
    if not finished:
        replace_file(path, OmegaConf.to_yaml(resolved))


def saved_config(run: str | None, changes: DictConfig, key: str = "run") -> DictConfig:
    """Read the config in a run's folder and apply the changes that the command line may make.

    Args:
        run: the run's folder.
        changes: the command's own config; the keys ``trainer``, ``threads``, ``lpips_weights``, ``sheets``
            and ``data.root`` are applied if they are not null. ``trust`` names packages whose code the run's
            config may name.
        key: name of the key that holds the folder, for errors.

    Raises:
        ValueError: if there is no run, or the config names code that is not trusted.
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
    """With ``resume=<folder>``: return the config in the folder, with the typed keys that may change.

    Raises:
        ValueError: if another key was typed, or the folder holds no run.
    """
    if config.get("resume") is None:
        return config
    trust = OmegaConf.create({"trust": config.get("trust")})
    saved = saved_config(str(config.resume), trust, "resume")
    saved.resume, saved.data_changed = str(config.resume), "refuse"
    for override in typed_overrides(of_sweep=True) if HydraConfig.initialized() else []:
        key = key_of(override)
        if key == "data.root":
            saved.data.root = config.data.root
        elif key.split(".")[0] in MAY_CHANGE:
            saved[key.split(".")[0]] = config[key.split(".")[0]]
        elif key not in ("resume", "trust"):
            raise ValueError(
                f"{key}: expected no such key beside resume=, whose config.yaml holds it, but got "
                f"{override}; beside it go {', '.join(MAY_CHANGE)}, data.root, trust"
            )
    return saved


def read_config(path: Path, trust: Sequence[str] | None = ()) -> DictConfig:
    """Read the config in a run's folder; ``trust`` as in ``trusted_config``.

    Raises:
        ValueError: if the file is no config of a run, is of an earlier version, or names untrusted code.
    """
    return parsed(read_text(path, MOST_CONFIG), path, trust)


def parsed(text: str, path: Path, trust: Sequence[str] | None = ()) -> DictConfig:
    """Parse the text of a config like ``read_config``; ``path`` is named in errors."""
    _refuse_earlier_version(trusted_config(text, path, None), path)
    config = trusted_config(text, path, trust)
    for key in (*IDENTITY, "trainer", "logger", "callbacks"):
        if key not in config and key != "objective":  # a method may have no objective
            raise ValueError(f"{path}: expected the key {key}, but got none; delete the run's folder")
    return config


def _refuse_earlier_version(config: DictConfig, path: Path) -> None:
    def has(part: object, key: str) -> bool:
        return isinstance(part, DictConfig) and key in part

    stages = config.get("stage")
    stages = stages.values() if isinstance(stages, DictConfig) else ()
    old = "0.1" if has(config.get("model"), "warp") else None
    old = old or ("0.2" if any(has(stage, "rates") for stage in stages) else None)
    if old is not None:
        raise ValueError(
            f"{path}: expected a run of forewarp 0.3, but got one of {old}, which version {old}.0 reads; "
            f"run its command again into another folder, or install forewarp {old}.0"
        )


def _make_absolute(config: DictConfig) -> None:
    """Make ``data.root`` absolute, as a run may be evaluated from another folder."""
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
