"""Choose the device and the precision that a run uses."""

from __future__ import annotations

import torch


def device_of(accelerator: str) -> torch.device:
    """The device that runs use under this ``trainer.accelerator``: with ``auto`` a CUDA GPU, or else the CPU.

    Others, Apple's among them, have no float64, which cameras and the cosine basis are computed in.
    """
    if accelerator not in ("auto", "cpu", "gpu", "cuda"):
        raise ValueError(
            f"trainer.accelerator: expected auto, cpu, gpu or cuda, but got {accelerator}; use trainer=auto"
        )
    if accelerator in ("gpu", "cuda") and not torch.cuda.is_available():
        raise ValueError("trainer.accelerator: expected a GPU, but found none; use trainer=cpu")
    wanted = accelerator in ("gpu", "cuda") or (accelerator == "auto" and torch.cuda.is_available())
    return torch.device("cuda" if wanted else "cpu")


def check_precision(precision: object) -> None:
    """Refuse float16: the slopes of an inpainter over constant volumes leave its range."""
    if "16" in str(precision) and "bf16" not in str(precision):
        raise ValueError(
            f"trainer.precision: expected 32-true or bf16-mixed, but got {precision}; "
            "float16 does not hold the gradients, use trainer.precision=bf16-mixed"
        )
