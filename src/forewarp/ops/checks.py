"""Check arguments; errors say in one line what was expected and what was given."""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor


def is_number(value: Any) -> bool:
    """Return whether a value, as a config may hold any, is a finite number; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def check_shape(name: str, tensor: Tensor, shape: tuple[int | str, ...]) -> None:
    """Raise ValueError unless ``tensor`` has ``shape``.

    A letter stands for any size, "..." in front for any number of sizes.

    >>> import torch
    >>> check_shape("points", torch.zeros(4, 3), ("P", 3))
    """
    if tensor.shape == shape:
        return
    ends = shape[:1] == ("...",)
    last = shape[1:] if ends else shape
    found = tuple(tensor.shape)[-len(last) :] if ends else tuple(tensor.shape)
    fits = len(found) == len(last) and all(isinstance(s, str) or s == n for s, n in zip(last, found))
    if not fits:
        wanted = "(" + ", ".join(str(s) for s in shape) + ")"
        raise ValueError(f"{name}: expected shape {wanted}, but got {tuple(tensor.shape)}")
