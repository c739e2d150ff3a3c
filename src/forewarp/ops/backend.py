"""Choose the implementation of an operator, and check its arguments.

Numba's kernels run on the CPU if Numba is installed, PyTorch otherwise. ``FOREWARP_NUMBA=0`` switches Numba
off. Tests hold both to the same values and gradients.
"""

from __future__ import annotations

import importlib.util
import os
import re
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
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


def check_value(key: str, given: Any, wanted: str, good: Callable[[Any], bool], advice: str = "") -> None:
    """Raise ValueError unless a value is ``good``: name its key, what is wanted, what came, what to do.

    A value of a kind that ``good`` cannot compare, as null with a number, is none.

    >>> check_value("model.width", 2, "a number > 0", lambda number: number > 0)
    """
    is_good = False
    with suppress(TypeError, AttributeError, LookupError, OverflowError):
        is_good = good(given)
    if not is_good:
        raise ValueError(f"{key}: expected {wanted}, but got {given!r}" + (f"; {advice}" if advice else ""))


@cache
def _parsed(shapes: str) -> list[tuple[str, list[int | str]]]:
    """Return the names and the sizes that ``check_shapes`` is told."""
    parts = re.findall(r"([\w.]+) \((.*?)\)", shapes)
    return [(name, [int(s) if s.isdigit() else s for s in sizes.split(", ")]) for name, sizes in parts]


def check_shapes(shapes: str, *tensors: Tensor, **sizes: int) -> None:
    """Raise ValueError unless tensors have the named ``shapes``, as "points (P, 3), weights (P)".

    A letter stands for any size, or for that in ``sizes``, but for the same one wherever it stands; "..." in
    front stands for any number of sizes, as the first letter does.

    >>> import torch
    >>> check_shapes("points (P, 3), colors (P, C)", torch.zeros(4, 3), torch.zeros(4, 1))
    """
    known: dict = dict(sizes)
    for (name, wanted), tensor in zip(_parsed(shapes), tensors, strict=True):
        found, expected = tuple(tensor.shape), [known.get(size, size) for size in wanted]
        if wanted[0] == "...":
            front = known.setdefault("...", found[: max(0, len(found) - len(wanted) + 1)])
            expected = [*front, *expected[1:]]
        if len(found) != len(expected) or any(isinstance(e, int) and e != n for e, n in zip(expected, found)):
            raise ValueError(f"{name}: expected shape ({', '.join(map(str, expected))}), but got {found}")
        known |= {size: n for size, n in zip(expected, found) if isinstance(size, str)}
