"""Texts of one line for records that hold arrays, so that a prompt and a notebook show them as they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

from torch import Tensor

_FEW = 4  # numbers, at most, that are written out


def brief(record) -> str:
    """Say in a line what a dataclass holds, as its ``__repr__``: an array by its shape, records by their
    number; None, nothing and functions are left out.
    """
    held = {part.name: getattr(record, part.name) for part in fields(record) if part.repr}
    texts = [
        f"{name}={_text(value)}"
        for name, value in held.items()
        if not (value is None or callable(value) or (isinstance(value, tuple) and not value))
    ]
    return f"{type(record).__name__}({', '.join(texts)})"


def _text(value) -> str:
    if isinstance(value, Tensor):
        if value.numel() <= _FEW:
            return _text(value.tolist())
        return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return f"<{len(value)} entries>"
    if isinstance(value, list | tuple):
        if len(value) > _FEW or not all(isinstance(part, float | int | str) for part in value):
            return f"<{len(value)} {type(value[0]).__name__}>"
        return "[" + ", ".join(map(_text, value)) + "]"
    return repr(value)
