"""Which device a run computes on: the one that its config names, or its methods belong on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import torch
from hydra.errors import HydraException
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from forewarp.training.device import device_of


def device_for(config: DictConfig) -> torch.device:
    """Return the device of a run; with ``trainer=auto`` the CPU if one of its methods belongs there.

    Raises:
        ValueError: see ``device_of``.
    """
    return device_of("cpu" if why_on_cpu(config) else config.trainer.accelerator)


def why_on_cpu(config: DictConfig) -> str | None:
    """Say in a line why ``trainer=auto`` leaves a GPU aside; None where it does not, or there is none."""
    if config.trainer.accelerator != "auto" or not torch.cuda.is_available():
        return None
    for model in _models(config):
        with suppress(HydraException, ImportError, ValueError):  # building the method names such a mistake
            why = getattr(get_object(str(model.get("_target_"))), "on_cpu", None)
            if why is not None:
                name = model.get("name", config.model.get("name"))
                return f"model={name} leaves the GPU aside: {why}; trainer=gpu runs it there all the same"
    return None


def _models(config: DictConfig) -> Iterator[DictConfig]:
    """The model of each stage: its own, or the run's."""
    for stage in config.stage.values():
        model = None if stage is None else OmegaConf.select(stage, "model", default=None) or config.model
        if isinstance(model, DictConfig):
            yield model
