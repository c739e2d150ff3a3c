"""Check the arguments of the generators; an error is one line naming the key."""

from __future__ import annotations

from collections.abc import Sequence

from forewarp.data.files import whole
from forewarp.scene.errors import SceneError
from forewarp.synth.motions import MOTIONS
from forewarp.synth.specimens import SPECIMENS


def check_numbers(**numbers: tuple[int, int]) -> None:
    """Check whole numbers against their least value; ``numbers`` are (value, least) by name."""
    for name, (value, least) in numbers.items():
        whole(value, name, least)


def check_workers(workers: int | None) -> None:
    """Check a number of processes: None or at least 1."""
    if workers is not None:
        whole(workers, "workers", 1)


def check_motion(motion: str, name: str = "motion", *, specimens: bool = False) -> None:
    """Check that a motion is one of ``motions.MOTIONS`` or, if allowed, of ``SPECIMENS``."""
    known = [*MOTIONS, *(SPECIMENS if specimens else ())]
    if not isinstance(motion, str) or motion not in known:
        raise SceneError(f"{name}: expected one of {', '.join(known)}, but got {motion!r}; set {name}")


def check_counts(name: str, counts: Sequence[int], meaning: str) -> None:
    """Check three counts, not all of them 0; ``meaning`` says what they count."""
    try:
        good = [whole(n, name, 0) for n in counts]
    except TypeError:
        good = []
    if len(good) != 3 or not any(good):
        raise SceneError(
            f"{name}: expected three numbers ({meaning}), not all 0, but got {counts!r}; set {name}"
        )
