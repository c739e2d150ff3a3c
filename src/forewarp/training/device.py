"""The machine that a run uses: choose its device and precision; name it, its memory and its packages."""

from __future__ import annotations

import ctypes
import gc
import platform
import resource
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

PACKAGES = ("forewarp", "torch", "lightning", "torchmetrics", "numba")
_PROCESS, _PROCESSOR = Path("/proc/self"), Path("/proc/cpuinfo")  # Linux only


def device_of(accelerator: str) -> torch.device:
    """Return the device for a ``trainer.accelerator``; ``auto`` is a CUDA GPU if there is one, else the CPU.

    Other accelerators (Apple's, for example) lack float64, which cameras and the cosine basis need.

    Raises:
        ValueError: for another accelerator, or for a GPU where there is none.
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
    """Raise ValueError for float16: an inpainter's gradients over constant volumes overflow it."""
    if "16" in str(precision) and "bf16" not in str(precision):
        raise ValueError(
            f"trainer.precision: expected 32-true or bf16-mixed, but got {precision}; "
            "float16 does not hold the gradients, use trainer.precision=bf16-mixed"
        )


def check_processes(devices: object, nodes: object = 1) -> None:
    """Raise ValueError unless one process trains: a run's folder, and its clock, are those of one process.

    Args:
        devices: ``trainer.devices``: 1, or a list of one GPU's number.
        nodes: ``trainer.num_nodes``.
    """
    listed = isinstance(devices, Sequence) and not isinstance(devices, str)
    one = len(devices) == 1 if listed else str(devices) == "1"
    if not (one and str(nodes) == "1"):
        got = f"{devices}" if str(nodes) == "1" else f"{devices} on {nodes} nodes"
        raise ValueError(
            f"trainer.devices: expected 1, or the number of one GPU as [0], but got {got}; one process "
            "trains a run, and --multirun with launcher=joblib trains several runs at once"
        )


def device_name(device: torch.device) -> str:
    """Return the model name of the GPU or of the processor."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = _PROCESSOR.read_text().splitlines()
    except OSError:
        lines = []
    named = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return next(filter(None, named), None) or platform.processor() or platform.machine()


def versions() -> dict[str, str]:
    """Return the versions of Python and of the installed packages that results depend on."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


@cache
def commit() -> str | None:
    """Return the commit of the checkout that the package lies in, with a + where its files or its numbers
    (conf, sweeps) differ; None where there is none. It is looked up once, when a process first asks.
    """
    here = Path(__file__).parents[1]

    def git(*words: str) -> str:
        line = ["git", "-C", str(here), *words]
        return subprocess.run(line, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")  # else the checkout is another project's
        numbers = [str(folder) for name in ("conf", "sweeps") if (folder := here.parents[1] / name).is_dir()]
        changed = git("--no-optional-locks", "status", "--porcelain", "--", ".", *numbers)
        return git("rev-parse", "--short=9", "HEAD") + "+" * bool(changed)
    except (OSError, subprocess.SubprocessError):
        return None


def reset_peak_memory() -> None:
    """Start a new measurement of ``peak_memory_bytes``, on Linux and on CUDA; elsewhere do nothing.

    Return unused memory to the system first, so that a run does not count what earlier runs left behind.
    """
    gc.collect()
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)  # glibc's
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    with suppress(OSError):
        (_PROCESS / "clear_refs").write_text("5")


def peak_memory_bytes() -> int:
    """Return the peak memory in bytes, of the GPU if one was used, else of the process.

    Measured since ``reset_peak_memory``, or since the process began if the system cannot reset the peak.
    """
    if torch.cuda.is_available() and torch.cuda.max_memory_allocated() > 0:
        return torch.cuda.max_memory_allocated()
    try:
        lines = (_PROCESS / "status").read_text().splitlines()
    except OSError:
        lines = []
    for line in lines:
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024  # in KiB
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # elsewhere in KiB
