"""The exception for mistakes in the user's input."""

from __future__ import annotations


class SceneError(ValueError):
    """The user's input or files are wrong; the message is one line."""
