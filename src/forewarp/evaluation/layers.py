"""Layers of a scene: what moves in it, and what rests; loads no torch before it is asked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from forewarp.methods.method import Method
    from forewarp.scene.frame import Frame

LAYERS = ("all", "moving", "resting")


def moving_rows(method: Method, frames: Sequence[Frame], key: str = "layer") -> Tensor:
    """Return which particles of a method move, (N,) bool.

    Args:
        method: the fitted method.
        frames: those it was trained with.
        key: what asks for it, for the message.

    Raises:
        ValueError: for a method without particles.
    """
    from forewarp.methods.method import HasLayers

    if not isinstance(method, HasLayers):
        expected = "a run of particles, as they alone tell what moves"
        raise ValueError(f"{key}: expected {expected}, but got one of another method; leave it out")
    return method.in_motion(frames)


def layer_of(method: Method, layer: str, frames: Sequence[Frame], *, may_be_empty: bool = False) -> Method:
    """Return the method itself for ``all``, or a copy that has only the particles of a layer.

    Args:
        method: the fitted method.
        layer: one of ``LAYERS``.
        frames: those it was trained with.
        may_be_empty: whether a layer without any particle will do.

    Raises:
        ValueError: for a method without particles, or a layer without any.
    """
    if layer == "all":
        return method
    rows = moving_rows(method, frames) == (layer == "moving")
    if not may_be_empty and not bool(rows.any()):
        what = "that move" if layer == "moving" else "that rest"
        raise ValueError(f"layer: expected some particles {what}, but got none in this run; leave it out")
    return method.only(rows)
