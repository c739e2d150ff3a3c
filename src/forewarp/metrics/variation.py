"""How unsteady a curve is; reading this loads no torch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def variation(values: Sequence[float]) -> float | None:
    """Divide the total variation of a curve by its range: 1 where it only rises or only falls, more the more
    often it jumps to and fro; None of a constant, or of fewer than two values.

    >>> variation([0.0, 1.0, 4.0]), variation([0.0, 4.0, 1.0, 4.0])
    (1.0, 2.5)
    """
    values = np.asarray(values, np.float64)
    extent = float(np.ptp(values)) if len(values) > 1 else 0.0
    return float(np.abs(np.diff(values)).sum()) / extent if extent > 0 else None
