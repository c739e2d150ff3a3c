"""Build a run from its config, or from its folder, and measure it as the config says."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from forewarp.clock import Clock
from forewarp.evaluation.evaluate import measure
from forewarp.files import read_json
from forewarp.runs.device import device_for
from forewarp.training.callbacks import StageProgress
from forewarp.training.device import check_precision, check_processes
from forewarp.training.module import DynamicSceneModule
from forewarp.training.schedule import StagePlan, seconds_after, share_out
from forewarp.training.stages import Run


def build_run(config: DictConfig) -> Run:
    """Build a run from its config; nothing is read or computed yet.

    Raises:
        ValueError: naming the wrong key of the config.
    """
    if config.threads is not None:
        if not (isinstance(config.threads, int) and config.threads >= 1):
            raise ValueError(f"threads: expected a whole number > 0 or null, but got {config.threads}")
        torch.set_num_threads(config.threads)
    check_precision(config.trainer.get("precision"))
    check_processes(config.trainer.get("devices", 1), config.trainer.get("num_nodes", 1))
    clock, place = Clock(config.budget.clock).kind, partial(device_for, config)
    data = instantiate(config.data, _convert_="all")
    plans = {name: stage_of(name, stage) for name, stage in config.stage.items()}
    watchers = [w for w in instantiate(config.callbacks, _convert_="all").values() if w is not None]
    trainer, logger = (instantiate(config[key], _convert_="all") for key in ("trainer", "logger"))

    def make_trainer(folder: Path, callbacks: list):
        return trainer(
            # With auto, Lightning would choose a Mac's GPU, which lacks float64.
            accelerator=place().type,
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

    run = Run(
        datamodule=data,
        model=model_of(config.model),
        stages=share_out(plans, minutes=config.budget.minutes, iterations=config.budget.iterations),
        folder=Path(config.run),
        make_trainer=make_trainer,
        callbacks=lambda name, folder: _callbacks(run, watchers, name),
        seed=config.seed,
        checkpoint_seconds=config.checkpoint_seconds,
        skip=config.get("sentinel", {"skip": 0})["skip"],
        tell=partial(print, flush=True),
        clock=clock,
        place=place,
    )
    run.check()
    return run


def model_of(config: DictConfig) -> Callable:
    """Return the function that makes a stage's method, from the ``model`` part of a config."""
    content = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    content.pop("name", None)
    model = instantiate(OmegaConf.create({"model": content}).model, _convert_="all")  # errors name the key
    if not callable(model):
        raise ValueError(
            f"model: expected a method that waits for its start, but got {type(model).__name__}; "
            "add _partial_: true"
        )
    return model


def stage_of(name: str, config: DictConfig | None) -> StagePlan | None:
    """Make a stage, without budget; a stage with a ``model`` has a method of its own."""
    if config is None:
        return None
    content = OmegaConf.to_container(config, resolve=True)
    own = content.pop("model", None)
    if "_target_" not in content:
        raise ValueError(
            f"stage.{name}: expected a stage of the method, but got only {', '.join(content)}, which is of "
            "another method's; leave out what sets it, or choose another model"
        )
    plan = instantiate(content, _convert_="all")
    plan.model = None if own is None else model_of(OmegaConf.create(own))
    return plan


def _callbacks(run: Run, watchers: list[Callable], name: str) -> list:
    """Make the callbacks of a stage; tell the progress line how long the later stages may take."""
    made = [watcher() for watcher in watchers]
    for line in made:
        if isinstance(line, StageProgress):
            line.later = seconds_after(run.stages, name)
    return made


def measure_run(run: Run, module: DynamicSceneModule, config: DictConfig) -> dict:
    """Evaluate a fitted run by its config; print and return the numbers."""
    protocol = {"method": method_name(config), "preset": config.preset.name, "seed": config.seed}
    budget = config.budget
    protocol |= {"minutes": budget.minutes, "iterations": budget.iterations, "clock": budget.clock}
    extra = config.lpips_weights
    return measure(
        run,
        module,
        device=run.device,
        protocol=protocol,
        lpips_weights=[extra] if isinstance(extra, str) else extra,
        sheets=config.sheets,
        views=config.get("views"),
        reduce=config.get("reduce"),
    )


def method_name(config: DictConfig) -> str:
    """Name the measured method: the last stage's own method, else the run's."""
    own = [stage.get("model") for stage in config.stage.values() if stage is not None][-1]
    return (own or config.model).get("name", config.model.name)


def is_measured(run: Run) -> bool:
    """Tell whether a run is finished and was measured after that."""
    metrics = Path(run.folder) / "metrics.json"
    return read_json(metrics) is not None and is_current(metrics, run)


def is_current(file: Path, run: Run) -> bool:
    """Tell whether a run is finished and a file was written after that."""
    if not all(run.is_finished(stage) for stage in run.stages):
        return False
    done = [run.stage_folder(stage) / "done.json" for stage in run.stages]
    return file.stat().st_mtime_ns >= max(path.stat().st_mtime_ns for path in done)
