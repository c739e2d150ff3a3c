"""A guard for what a configuration leaves behind."""

from __future__ import annotations

from torch import nn


def check_effect(name: str, effect: object, choose: str) -> None:
    """Raise ValueError unless ``effect`` is a module or None: an option switched off may leave a dict behind.

    Args:
        name: its key in ``model``.
        effect: what was given.
        choose: the choice that mends it.
    """
    if effect is not None and not isinstance(effect, nn.Module):
        raise ValueError(
            f"model.{name}: expected a module or null, but got {type(effect).__name__}; choose {choose}"
        )
