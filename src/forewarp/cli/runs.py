"""A run from its config, and its config from its folder."""

from __future__ import annotations

import os
from pathlib import Path

import torch
import yaml
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from forewarp.cli.measure import device_of
from forewarp.training.budget import share_out
from forewarp.training.stages import Run

# What makes two runs different; where they run and what is shown of them does not.
IDENTITY = ("data", "model", "objective", "stage", "renderer", "budget", "seed")


def build_run(config: DictConfig) -> Run:
    """Everything that a run needs, put together; nothing is read or computed yet."""
    if config.threads is not None:
        if not (isinstance(config.threads, int) and config.threads >= 1):
            raise ValueError(f"threads: expected a whole number > 0 or null, but got {config.threads}")
        torch.set_num_threads(config.threads)
    parts = {key: instantiate(config[key], _convert_="all") for key in ("data", "model", "renderer", "stage")}
    watchers = [w for w in instantiate(config.callbacks, _convert_="all").values() if w is not None]
    trainer, logger = (instantiate(config[key], _convert_="all") for key in ("trainer", "logger"))

    def make_trainer(folder: Path, callbacks: list):
        device_of(config.trainer.accelerator)  # refuses a GPU that is not there
        return trainer(
            max_epochs=1,
            max_steps=-1,
            callbacks=callbacks,
            logger=False if logger is None else logger(save_dir=str(folder)),
            default_root_dir=str(folder),
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            limit_val_batches=0,
            num_sanity_val_steps=0,
        )

    return Run(
        datamodule=parts["data"],
        spec=parts["model"],
        stages=share_out(parts["stage"], minutes=config.budget.minutes, iterations=config.budget.iterations),
        renderer=parts["renderer"],
        folder=Path(config.run),
        make_trainer=make_trainer,
        callbacks=lambda name, folder: [watcher() for watcher in watchers],
        seed=config.seed,
        checkpoint_seconds=config.checkpoint_seconds,
    )


def claim(config: DictConfig) -> None:
    """Write the resolved config into the run's folder, or refuse a folder begun with another one."""
    folder, path = Path(config.run), Path(config.run) / "config.yaml"
    _make_absolute(config)
    resolved = OmegaConf.create(OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    begun = folder.is_dir() and any(folder.glob("*/last.ckpt"))
    if begun and not path.is_file():
        raise ValueError(
            f"{path}: expected the configuration of the run, but got none; use run=... or delete the folder"
        )
    if begun:
        _refuse_another(path, _read(path), resolved)
    folder.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".part")
    beside.write_text(OmegaConf.to_yaml(resolved))
    os.replace(beside, path)


def saved_config(run: str | None, changes: DictConfig) -> DictConfig:
    """The config of the run in a folder, with what the command line changed.

    Args:
        run: the run's folder.
        changes: keys of the run's config; those that are null change nothing. Others are left out.
    """
    if run is None:
        raise ValueError("run: expected the folder of a run, but got nothing; set run=runs/...")
    path = Path(run) / "config.yaml"
    if not path.is_file():
        raise ValueError(
            f"{path}: expected the configuration of a run, but got none; set run=<a run's folder>"
        )
    saved = _read(path)
    for key in ("trainer", "threads", "lpips_weights", "sheets"):
        if changes.get(key) is not None:
            saved[key] = changes[key]
    if (changes.get("data") or {}).get("root") is not None:
        saved.data.root = changes.data.root
    saved.run = str(run)
    return saved


def _read(path: Path) -> DictConfig:
    try:
        config = OmegaConf.load(path)
    except (yaml.YAMLError, UnicodeDecodeError, OmegaConfBaseException) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"{path}: expected YAML, but got {reason}; delete the run's folder") from None
    for key in (*IDENTITY, "trainer", "logger", "callbacks"):
        if key not in config:
            raise ValueError(f"{path}: expected the key {key}, but got none; delete the run's folder")
    return config


def _make_absolute(config: DictConfig) -> None:
    """The data's place as seen from anywhere: a run may be evaluated from another folder."""
    if not OmegaConf.is_missing(config.data, "root") and config.data.root is not None:
        config.data.root = str(Path(config.data.root).expanduser().resolve())


def _refuse_another(path: Path, before: DictConfig, now: DictConfig) -> None:
    old, new = ({k: OmegaConf.to_container(c)[k] for k in IDENTITY} for c in (before, now))
    found = next(_differences(old, new), None)
    if found:
        key, was, got = found
        raise ValueError(f"{path}: {key}: expected {was}, but got {got}; use run=... or delete the folder")


def _differences(old, new, key: str = ""):
    if isinstance(old, dict) and isinstance(new, dict):
        for name in [*old, *(n for n in new if n not in old)]:
            inner = f"{key}.{name}" if key else name
            yield from _differences(old.get(name, "nothing"), new.get(name, "nothing"), inner)
    elif old != new:
        yield key, old, new
