"""Refuse a composed config that cannot work before torch is loaded."""

from __future__ import annotations

from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from forewarp.cli.misspelt import every_key, of_another
from forewarp.data.files import MARKERS, scene_folder
from forewarp.runs.overrides import key_of, refuse_renamed, typed_overrides

# Data modules that are not listed, such as those that make their scene, check for themselves.
READERS = {
    "forewarp.data.module.DNeRFDataModule": "dnerf",
    "forewarp.data.module.LegoCompleteDataModule": "lego_complete",
    "forewarp.data.module.HyperNeRFDataModule": "hypernerf",
    "forewarp.data.module.NHRDataModule": "nhr",
    "forewarp.data.module.PosedVideoDataModule": "posed_video",
}

VOXELS, PARTICLES = "forewarp.methods.voxel.", "forewarp.methods.particles."

# The least whole number, whether null is one too, and the range of a number.
LEAST = {"frames": 2, "view": 0, "points": 1, "size": 16, "views": 1, "sheets": 0, "reduce": 2}
MAY_BE_NULL = ("size", "views", "reduce")
RANGES = {"fps": (0.1, 1000), "time": (0, 1), "tail": (0.01, 1)}


def refuse_all(config: DictConfig) -> None:
    """Refuse what is wrong with a config by itself, whatever the data."""
    refuse_renamed_keys(config)
    refuse_seeds(config)
    refuse_two_models(config)
    refuse_other_methods(config)
    refuse_numbers(config, "views", "sheets", "reduce")


def refuse_renamed_keys(config: DictConfig) -> None:
    """Refuse keys of earlier versions, such as those of a user's own files.

    A method of another package may have keys of these names.
    """
    target = str(config.model.get("_target_"))
    voxel = target.startswith(VOXELS)  # only these methods' options were renamed
    if target.startswith("forewarp."):
        refuse_renamed([key for key in every_key(config) if voxel or not key.startswith("model.")])


def refuse_missing_scene(config: DictConfig) -> None:
    """Refuse a scene whose folder is missing, unless ``absent`` says to skip it.

    Raises:
        SceneError: listing the scenes that are there.
    """
    reader = READERS.get(config.data.get("_target_"))
    if reader is not None and config.get("absent", "refuse") == "refuse":
        scene_folder(Path(config.data.root).expanduser(), str(config.data.scene), MARKERS[reader])


def refuse_seeds(config: DictConfig) -> None:
    """Refuse ``seeds=`` without ``--multirun``, which repeats the run, and in a search by a sweeper."""
    alone = not (HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN)
    if alone and config.get("seeds", 1) != 1:
        raise ValueError(f"seeds: expected --multirun beside seeds={config.seeds}; add it, or use seed=N")
    if not alone and "_optuna_" in str(HydraConfig.get().sweeper.get("_target_")):
        swept = str((HydraConfig.get().sweeper.get("params") or {}).get("seed", ""))
        if config.get("seeds", 1) != 1:
            raise ValueError(f"seeds: expected 1 in a search, but got {config.seeds}; use seed=N")
        if swept.startswith("range"):
            raise ValueError(
                "hydra.sweeper.params.seed: expected one seed, as this sweeper would search among several, "
                f"but got {swept}; add hydra.sweeper.params.seed=0"
            )


def refuse_two_models(config: DictConfig) -> None:
    """Refuse an ablation of another method than ``model``."""
    known = config.get("variant") or {}
    if config.model.name not in known.get("of", [config.model.name]):
        raise ValueError(
            f"model: expected {' or '.join(known.of)}, which {known.name} is a change of, but got "
            f"{config.model.name}; leave one of them out"
        )


def refuse_other_methods(config: DictConfig) -> None:
    """Refuse options of another method: of voxels for particles, and the other way round.

    Effects of voxels are classes, those of particles numbers and words; particles see no single rays.
    """
    target, choices = str(config.model.get("_target_")), {}
    if HydraConfig.initialized():
        choices = HydraConfig.get().runtime.choices
    if not target.startswith((VOXELS, PARTICLES)):
        return
    voxels = target.startswith(VOXELS)
    for group, option in choices.items():
        own = group.startswith("model/") and "@" not in group  # else of a stage's own model
        part = config.model._get_node(group[6:]) if own else None
        if part is None or part._is_none() or isinstance(part, DictConfig) == voxels:
            continue
        raise ValueError(
            of_another(f"{group}={option}", config.model.name, "particles" if voxels else "forward")
        )
    stages = [stage for stage in config.get("stage", {}).values() if stage is not None]
    if not voxels and HydraConfig.initialized() and not any("model" in stage for stage in stages):
        for one in typed_overrides():
            if key_of(one) in ("preset.rays", "data.rays") and not one.endswith("=null"):
                raise ValueError(of_another(one, config.model.name, "forward"))


def refuse_numbers(config: DictConfig, *keys: str) -> None:
    """Refuse values that keys of ``LEAST`` and ``RANGES`` cannot have; a config may lack a key."""
    for key in keys:
        value = config.get(key)
        if key not in config or (value is None and key in MAY_BE_NULL):
            continue
        if key in LEAST and (type(value) is not int or value < LEAST[key]):
            raise ValueError(f"{key}: expected a whole number of at least {LEAST[key]}, but got {value}")
        low, high = RANGES.get(key, (value, value))
        if key in RANGES and (type(value) not in (int, float) or not low <= value <= high):
            raise ValueError(f"{key}: expected a number in [{low}, {high}], but got {value}")
