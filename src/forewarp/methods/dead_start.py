"""Notice a run without any gradient, most often from its beginning."""

from __future__ import annotations

_PATIENCE = 20  # steps


class DeadStart:
    """Count steps in a row that show nothing to learn from, at any time of a run.

    The count is no part of a checkpoint: a run that goes on counts anew, and so ends a few steps later. A
    step that is repeated counts twice.

    Args:
        key: where the mend is typed.
        came: what such a step shows.
        advice: what to change.
    """

    def __init__(self, key: str, came: str, advice: str) -> None:
        self.key, self.came, self.advice, self.steps = key, came, advice, 0

    def look(self, alive: bool) -> None:
        """Note whether a step had anything to learn from.

        Raises:
            ValueError: if many steps in a row had nothing.
        """
        self.steps = 0 if alive else self.steps + 1
        if self.steps >= _PATIENCE:
            raise ValueError(
                f"{self.key}: expected matter somewhere, but got {self.came} in each of {_PATIENCE} steps, "
                f"which has no gradient: a dead start; {self.advice}"
            )
