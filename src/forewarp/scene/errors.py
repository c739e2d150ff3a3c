"""The one exception that is the user's business."""

from __future__ import annotations


class SceneError(ValueError):
    """The user's input or files are wrong; the message is one line."""
