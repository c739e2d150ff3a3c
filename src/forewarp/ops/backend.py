"""Which implementation of an operator runs: the PyTorch reference everywhere, Numba's on the CPU where installed.

``FOREWARP_NUMBA=0`` switches Numba off. Both are held to each other in values and gradients by the tests.
"""

from __future__ import annotations

import importlib.util
import os
from functools import cache

from torch import Tensor


@cache
def numba_installed() -> bool:
    """True where Numba can be imported and ``FOREWARP_NUMBA`` is not 0."""
    return os.environ.get("FOREWARP_NUMBA", "1") != "0" and importlib.util.find_spec("numba") is not None


def use_numba(tensor: Tensor) -> bool:
    """True where the Numba kernel serves ``tensor``."""
    return tensor.device.type == "cpu" and numba_installed()
