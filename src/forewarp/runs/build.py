"""Build a run from its config, on the device that the config names."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial, reduce
from operator import getitem
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning.pytorch.profilers import AdvancedProfiler, SimpleProfiler
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig, OmegaConf

from forewarp.clock import Clock
from forewarp.data.files import mismatch, one_of, threads_of
from forewarp.data.films import FOLDER
from forewarp.evaluation.curves import AccuracyCurve
from forewarp.provenance import RESULTS
from forewarp.runs.config import (
    IDENTITY,
    IDENTITY_IF_SET,
    is_swept,
    plain,
    saved_config,
    set_value,
    trust_of,
)
from forewarp.runs.devices import device_for
from forewarp.runs.overrides import constant, key_of, typed_overrides
from forewarp.scene.cloud import Handover
from forewarp.training.callbacks import StageProgress
from forewarp.training.checkpoints import load_handover
from forewarp.training.environment import SingleProcess
from forewarp.training.loggers import Labels, RunLoggers, redacted
from forewarp.training.module import DynamicSceneModule
from forewarp.training.schedule import StagePlan, seconds_after, share_out
from forewarp.training.stages import Run
from forewarp.training.stopping import StopRule

PROFILERS = {"simple": SimpleProfiler, "advanced": AdvancedProfiler}  # Lightning's
_LEVELS = 4  # that a run may lie below the folder of all runs
_FOLLOWS = re.compile(r"\$\{(\w[\w.]*)\}")  # one key that has the value of another one
_PLACES = re.compile(r"data\.root|paths\.|trainer\.(accelerator|devices)")  # where, not what
_PRECISIONS = ("None", "32", "32-true", "bf16", "bf16-mixed")
# Arguments of Lightning's trainer that a config may set, and what to type in place of others.
_TRAINER = (
    "_target_",
    "_partial_",
    "accelerator",
    "devices",
    "num_nodes",
    "strategy",
    "precision",
    "profiler",
)
_TRAINER += ("benchmark", "deterministic", "detect_anomaly")
_INSTEAD = dict.fromkeys(("max_steps", "max_epochs", "min_steps", "min_epochs"), "use budget.iterations=N")
_INSTEAD |= {
    "max_time": "use budget.minutes=N",
    "callbacks": "use +callbacks.NAME",
    "logger": "use logger=NAME",
}
_INSTEAD |= dict.fromkeys(
    ("fast_dev_run", "limit_train_batches", "overfit_batches"), "use debug=fast or overfit"
)
PROFILE = "profile"  # of a file's name: fit-profile.txt


def build_run(config: DictConfig) -> Run:
    """Build a run from its config; nothing is read or computed yet.

    Raises:
        ValueError: naming the wrong key of the config.
    """
    if config.threads is not None:
        torch.set_num_threads(threads_of(config.threads))
    check_trainer(config.trainer)
    device = partial(device_for, config)
    data = instantiate(config.data, _convert_="all")
    data.frames_folder = frames_folder(config)
    plans = {name: stage_of(name, stage) for name, stage in config.stage.items() if stage is not None}
    factories = instantiate(config.callbacks, _convert_="all")
    trainer = instantiate(config.trainer, _convert_="all")
    name = config.trainer.get("profiler")
    one_of(name, "trainer.profiler", *PROFILERS, None)
    profiler = PROFILERS.get(name)  # writes a table of calls into the stage's folder

    def make_trainer(folder: Path, callbacks: list, loggers: list):
        own = {"callbacks": callbacks, "logger": loggers, "default_root_dir": str(folder)}
        own["profiler"] = profiler and profiler(dirpath=str(folder), filename=PROFILE)
        off = dict.fromkeys(("enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)
        off |= {"limit_val_batches": 0, "num_sanity_val_steps": 0}
        off |= {"max_epochs": 1, "max_steps": -1, "plugins": [SingleProcess()]}
        # With auto, Lightning would choose a Mac's GPU, which lacks float64.
        return made("trainer", trainer, accelerator=device().type, **own, **off)

    def make_callbacks(name: str, folder: Path) -> list:
        known = {f"callbacks.{key}": make for key, make in factories.items() if make is not None}
        callbacks = [made(key, make) for key, make in known.items()]
        for callback in callbacks:
            if isinstance(callback, StageProgress):
                callback.later = seconds_after(run.stages, name)
            if isinstance(callback, AccuracyCurve) and name == run.stages[-1].settings.name:
                callback.target = run.target
        return callbacks

    run = Run(
        datamodule=data,
        model=model_of(config.model),
        stages=share_out(plans, minutes=config.budget.minutes, iterations=config.budget.iterations),
        folder=Path(config.run),
        make_trainer=make_trainer,
        callbacks=make_callbacks,
        seed=config.seed,
        checkpoint_seconds=config.checkpoint_seconds,
        skip=(config.get("sentinel") or {"skip": 0})["skip"],
        tell=partial(print, flush=True),
        clock=Clock(config.budget.clock).kind,
        place=device,
        loggers=loggers_of(config),
        start=start_of(config),
        packages=packages_of(config),
        target=target_of(config),
    )
    run.check()
    return run


def made(key: str, make: Callable, **options) -> object:
    """Call what a key of the config names, with the values below it.

    Raises:
        ValueError: naming the key, for values of a kind that it does not take.
    """
    try:
        return make(**options)
    except (TypeError, AttributeError, OverflowError, MisconfigurationException) as error:
        got = " ".join(str(error).split())
        raise ValueError(
            f"{key}: expected values of the kinds that it takes, but got others: {got}"
        ) from error


def frames_folder(config: DictConfig) -> Path:
    """Say where a run keeps decoded frames of films: ``.frames`` in the folder of all runs, which share them,
    or beside a run that lies elsewhere; where a folder above the run has one already, there.

    Not beside the data, which may be read-only or on a slow disk, nor where a key says: a run's config may
    come from anyone.
    """
    run = Path(config.run).resolve()
    runs = Path(OmegaConf.select(config, "paths.runs") or run.parent).resolve()
    above = list(run.parents[:_LEVELS])
    known = (folder for folder in above if (folder / FOLDER).is_dir() and not (folder / FOLDER).is_symlink())
    return next(known, runs if runs in above else run.parent) / FOLDER


def start_of(config: DictConfig) -> Callable[[], tuple[DynamicSceneModule, Handover]] | None:
    """Return what opens the run that ``start`` names; None where a run begins from images."""
    if config.get("start") is None:
        return None
    changes = OmegaConf.create({"trust": list(trust_of(config.get("trust")))})

    def opened() -> tuple[DynamicSceneModule, Handover]:
        saved = saved_config(str(config.start), changes, "start")
        if saved.get("start") is not None:
            got = f"{config.start}, which begins from another one; set start={saved.start}"
            raise ValueError(f"start: expected a run that begins from images, but got {got}")
        run = build_run(saved)
        return run.load(), load_handover(run.stage_folder(run.stages[-1]))

    return opened


def target_of(config: DictConfig) -> StopRule:
    """Return what ends training before its budget.

    Raises:
        ValueError: for a key that there is not.
    """
    keys = plain(config.get("target")) or {}  # a run of before has none
    if unknown := keys.keys() - StopRule.__dataclass_fields__.keys():
        raise mismatch("target", "psnr and plateau", ", ".join(sorted(unknown)))
    return StopRule(**keys)


def loggers_of(config: DictConfig) -> RunLoggers:
    """Make the loggers of a run, each by its name.

    Raises:
        ValueError: for a logger without a name.
        ImportError: naming what to install.
    """
    named = config.get("logger") or {}
    if "_target_" in named or not all(OmegaConf.is_dict(node) for node in named.values()):
        expected = "loggers by name, as logger: {csv: {_target_: ...}}"
        raise mismatch("logger", expected, "one without", "write its keys below a name")
    makers = instantiate(named, _convert_="all")
    runs = OmegaConf.select(config, "paths.runs") or Path(config.run).parent
    own = config.get("trackers") or {}
    labels = Labels(
        config.data.get("scene"), sweep_of(), tuple(own.get("tags") or ()), own.get("config", False)
    )
    return RunLoggers(makers, Path(config.run), Path(runs), partial(hyperparameters, config), labels)


def sweep_of() -> str | None:
    """Name the sweep that this is a job of: ``sweeps=``, else the folder of a typed ``hydra.sweep.dir``, else
    the keys that jobs differ in; None where it is none, or only seeds differ.
    """
    if not is_swept():
        return None
    hydra = HydraConfig.get()
    if "hydra.sweep.dir" in map(key_of, hydra.overrides.hydra):
        name = Path(hydra.sweep.dir).name
    else:
        own = [key for key in map(key_of, typed_overrides()) if key not in {*constant, "seed"}]
        name = ",".join(dict.fromkeys(own))
    return hydra.runtime.choices.get("sweeps") or name or None


def packages_of(config: DictConfig) -> list[str]:
    """List the packages whose code a config names, forewarp first; but for those that ``versions`` has."""

    def targets(node: object) -> Iterator[str]:
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            if key == "_target_":
                yield str(value).partition(".")[0]
            elif isinstance(value, dict | list):
                yield from targets(value)

    named = {*targets(OmegaConf.to_container(config))} - {"forewarp", *RESULTS}
    return ["forewarp", *sorted(named)]


def hyperparameters(config: DictConfig) -> dict[str, object]:
    """List what makes a run what it is, for the tables of its loggers: keys and values as they are typed.

    Each is there once: a key that follows another one stands there as that other one. Folders of data and
    runs are left out.

    ``command`` is the command, ``sweeps`` the sweep that the run is a job of. All are ``redacted``.
    """
    found: dict[str, object] = {"command": command} if (command := config.get("command")) else {}
    if HydraConfig.initialized() and (sweep := HydraConfig.get().runtime.choices.get("sweeps")):
        found["sweeps"] = sweep
    if tags := (config.get("trackers") or {}).get("tags"):
        found["trackers.tags"] = json.dumps(plain(tags))
    unresolved = OmegaConf.to_container(config)

    def followed(value: object) -> tuple[object, str] | None:
        """Return what a key follows, and its name; None where it is resolved in place."""
        if isinstance(value, str) and (match := _FOLLOWS.fullmatch(value)):
            with suppress(KeyError, TypeError):  # of a key below another interpolation, or in a list
                return reduce(getitem, match[1].split("."), unresolved), match[1]
        return None

    def walk(value: object, name: str) -> None:
        if (other := followed(value)) is not None:
            walk(*other)
        elif isinstance(value, dict):
            for key, inner in value.items():
                # A stored config has copies of the objectives in place of what follows them.
                copied = key == "objective" and inner == unresolved.get("objective", {}).get(name[6:])
                if not copied and not (key.startswith("_") and (key != "_target_" or _is_fixed(inner))):
                    walk(inner, f"{name}.{key}")
        elif not _PLACES.match(name) and not OmegaConf.is_missing(config, name):
            value = plain(OmegaConf.select(config, name))
            found[name] = value if isinstance(value, bool | int | float | str) else json.dumps(value)

    set_keys = [key for key in IDENTITY_IF_SET if set_value(config, key) is not None]
    for key in (*IDENTITY, *set_keys, "capture", "variant", "threads", "trainer"):
        if unresolved.get(key) is not None:
            walk(unresolved[key], key)
    return redacted(found)


def _is_fixed(target: object) -> bool:
    """Tell whether a class is one that every run has in its place."""
    return str(target).startswith(("forewarp.training.", "lightning."))


def model_of(config: DictConfig) -> Callable:
    """Return the function that makes a stage's method, from the ``model`` part of a config."""
    content = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    content.pop("name", None)
    model = instantiate(OmegaConf.create({"model": content}).model, _convert_="all")  # errors name the key
    if not callable(model):
        got = type(model).__name__
        raise mismatch("model", "a method that waits for its start", got, "add _partial_: true")
    return model


def stage_of(name: str, config: DictConfig) -> StagePlan:
    """Make a stage, without budget; a stage with a ``model`` has a method of its own."""
    content = OmegaConf.to_container(config, resolve=True)
    own = content.pop("model", None)
    if "_target_" not in content:
        got = f"only {', '.join(content)}, which is of another method's; leave out what sets it"
        raise ValueError(f"stage.{name}: expected a stage of the method, but got {got}")
    plan = instantiate(content, _convert_="all")
    if not isinstance(plan, StagePlan):
        raise mismatch(f"stage.{name}", "a stage (StagePlan)", type(plan).__name__, "mend its _target_")
    plan.model = None if own is None else model_of(OmegaConf.create(own))
    return plan


def check_trainer(trainer: DictConfig) -> None:
    """Refuse arguments of Lightning's trainer with which no run can be trained, or that other keys stand for.

    Float16 does not hold an inpainter's gradients over constant volumes, and no method is tested in other
    precisions. One process trains a run, as the run's folder and its clock are those of one process.

    Raises:
        ValueError: naming the key.
    """
    of_lightning = str(trainer.get("_target_")).startswith("lightning.")
    for key in trainer:
        if of_lightning and key not in _TRAINER:
            known = f"one of {', '.join(name for name in _TRAINER if name[0] != '_')}"
            raise mismatch(f"trainer.{key}", known, "another argument", _INSTEAD.get(key, "leave it out"))
    precision = trainer.get("precision")
    if str(precision) not in _PRECISIONS:
        is_half = "16" in str(precision)
        why = ", as float16 does not hold the gradients" if is_half else ""
        advice = f"use trainer.precision={'bf16-mixed' if is_half else '32-true'}"
        raise ValueError(
            f"trainer.precision: expected 32-true or bf16-mixed{why}, but got {precision}; {advice}"
        )
    devices, nodes = trainer.get("devices", 1), str(trainer.get("num_nodes", 1))
    count = len(devices) if OmegaConf.is_list(devices) or isinstance(devices, list | tuple) else devices
    if (str(count), nodes) != ("1", "1") or trainer.get("strategy", "auto") != "auto":
        got = f"{devices}" if nodes == "1" else f"{devices} on {nodes} nodes"
        got += "" if trainer.get("strategy", "auto") == "auto" else f" with strategy={trainer.strategy}"
        advice = "one process trains a run, --multirun launcher=joblib trains several at once"
        raise mismatch("trainer.devices", "1, or the number of one GPU as [0]", got, advice)
