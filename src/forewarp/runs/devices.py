"""The device that a run computes on."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from hydra.errors import HydraException
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from forewarp.data.files import mismatch

if TYPE_CHECKING:
    import torch

# What other templates have as trainers: why there is none here, and what to type.
_ONE_PROCESS = "one process trains a run: use trainer=gpu, and --multirun launcher=joblib for several at once"
_NO_TRAINERS = dict.fromkeys(("ddp", "ddp_spawn", "ddp_sim", "fsdp", "deepspeed"), _ONE_PROCESS)
_NO_TRAINERS["mps"] = "Apple's GPUs have no float64, which cameras and the cosine basis need: use trainer=cpu"


def device_for(config: DictConfig) -> torch.device:
    """Return the device of a run: with ``trainer=auto`` a CUDA GPU, unless there is none or ``why_on_cpu``.

    Other accelerators (Apple's, for example) lack float64, which cameras and the cosine basis need.

    Raises:
        ValueError: for another accelerator, or for a GPU where there is none.
    """
    import torch  # here, as a mistake in a command is told without waiting for it

    accelerator = config.trainer.accelerator
    if accelerator not in ("auto", "cpu", "gpu", "cuda"):
        raise mismatch("trainer.accelerator", "auto, cpu, gpu or cuda", accelerator, instead_of(accelerator))
    if accelerator in ("gpu", "cuda") and not torch.cuda.is_available():
        raise ValueError("trainer.accelerator: expected a GPU, but found none; use trainer=cpu")
    if accelerator == "auto":
        accelerator = "cuda" if torch.cuda.is_available() and why_on_cpu(config) is None else "cpu"
    return torch.device("cpu" if accelerator == "cpu" else "cuda")


def why_on_cpu(config: DictConfig) -> str | None:
    """Say in a line why ``trainer=auto`` runs on the CPU beside a GPU; None without a reason or a GPU."""
    import torch

    if config.trainer.accelerator != "auto" or not torch.cuda.is_available():
        return None
    for stage in config.stage.values():
        model = None if stage is None else OmegaConf.select(stage, "model", default=None) or config.model
        if not isinstance(model, DictConfig):
            continue
        with suppress(HydraException, ImportError, ValueError):  # building the method names such a mistake
            why = getattr(get_object(str(model.get("_target_"))), "on_cpu", None)
            if why is not None:
                name = model.get("name", config.model.get("name"))
                return f"model={name} runs on the CPU: {why}; trainer=gpu runs it on the GPU"
    return None


def instead_of(trainer: str) -> str:
    """Say what to type in place of a trainer or accelerator that there is not, and why where it is known."""
    return _NO_TRAINERS.get(trainer, "use trainer=auto")
