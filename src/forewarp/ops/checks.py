"""Guards for callers' mistakes: one line that says what was expected and what came."""

from __future__ import annotations

from torch import Tensor


def check_shape(name: str, tensor: Tensor, shape: tuple[int | str, ...]) -> None:
    """Raise ValueError unless ``tensor`` has ``shape``; a letter stands for any size.

    >>> import torch
    >>> check_shape("points", torch.zeros(4, 3), ("P", 3))
    """
    fits = tensor.dim() == len(shape) and all(
        isinstance(s, str) or s == n for s, n in zip(shape, tensor.shape)
    )
    if not fits:
        wanted = "(" + ", ".join(str(s) for s in shape) + ")"
        raise ValueError(f"{name}: expected shape {wanted}, but got {tuple(tensor.shape)}")
