"""Choose the implementation of an operator, and check its arguments.

Numba's kernels run on the CPU if Numba is installed, PyTorch otherwise. ``FOREWARP_NUMBA=0`` switches Numba
off. Tests hold both to the same values and gradients.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import threading
from functools import cache
from typing import Any

import torch
from torch import Tensor

_MATCHED = threading.local()  # Numba, too, counts the threads of each thread


@cache
def numba_installed() -> bool:
    """Return whether Numba is installed and ``FOREWARP_NUMBA`` is not 0."""
    return os.environ.get("FOREWARP_NUMBA", "1") != "0" and importlib.util.find_spec("numba") is not None


def has_kernels(device: torch.device) -> bool:
    """Return whether there are kernels for tensors on a device."""
    return device.type == "cpu" and numba_installed()


def use_numba(tensor: Tensor) -> bool:
    """Return whether to use the Numba kernel for ``tensor``."""
    return has_kernels(tensor.device)


def arrays(*tensors: Tensor) -> tuple:
    """Return NumPy views for kernels, contiguous; without a gradient."""
    return tuple(t.detach().contiguous().numpy() for t in tensors)


def cores() -> int:
    """Return how many cores this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def match_threads() -> int:
    """Let Numba use as many threads as PyTorch; return their number.

    Cost: next to nothing where PyTorch has as many as at the last call of the same thread.
    """
    asked = torch.get_num_threads()
    if getattr(_MATCHED, "asked", None) == asked:
        return _MATCHED.wanted
    import numba

    wanted = max(1, min(asked, numba.config.NUMBA_NUM_THREADS))
    if numba.get_num_threads() != wanted:
        numba.set_num_threads(wanted)
    if torch.get_num_threads() != asked:  # Numba's first call starts all threads of the OpenMP they share
        torch.set_num_threads(asked)
    _MATCHED.asked, _MATCHED.wanted = asked, wanted
    return wanted


def is_number(value: Any) -> bool:
    """Return whether a value, as a config may hold any, is a finite number; true and false are none.

    >>> is_number(1), is_number(True), is_number(10**400)
    (True, False, False)
    """
    is_real = isinstance(value, int | float) and not isinstance(value, bool)
    return is_real and abs(value) <= sys.float_info.max  # an integer may be beyond every float


def check_shape(name: str, tensor: Tensor, shape: tuple[int | str, ...]) -> None:
    """Raise ValueError unless ``tensor`` has ``shape``.

    A letter stands for any size, "..." in front for any number of sizes.

    >>> import torch
    >>> check_shape("points", torch.zeros(4, 3), ("P", 3))
    """
    if tensor.shape == shape:
        return
    sizes = tuple(tensor.shape)
    last = shape[1:] if shape[:1] == ("...",) else shape
    ends = sizes[-len(last) :] if last is not shape else sizes
    if len(ends) != len(last) or not all(isinstance(s, str) or s == n for s, n in zip(last, ends)):
        wanted = ", ".join(str(s) for s in shape)
        raise ValueError(f"{name}: expected shape ({wanted}), but got {sizes}")
