"""Arguments of the generators, checked: one line that names the key."""

from __future__ import annotations

from collections.abc import Sequence

from forewarp.data.files import whole
from forewarp.scene.errors import SceneError
from forewarp.synth.motions import MOTIONS
from forewarp.synth.specimens import SPECIMENS


def check_numbers(**numbers: tuple[int, int]) -> None:
    """Refuse what is no whole number or too small; ``numbers`` are (value, least) by name."""
    for name, (value, least) in numbers.items():
        whole(value, name, least)


def check_workers(workers: int | None) -> None:
    """Refuse a number of processes that is neither None nor a whole number of at least 1."""
    if workers is not None:
        whole(workers, "workers", 1)


def check_motion(motion: str, name: str = "motion", *, specimens: bool = False) -> None:
    """Refuse a motion that ``motions.MOTIONS`` does not have, nor, where they will do, ``SPECIMENS``."""
    known = [*MOTIONS, *(SPECIMENS if specimens else ())]
    if not isinstance(motion, str) or motion not in known:
        raise SceneError(f"{name}: expected one of {', '.join(known)}, but got {motion!r}; set {name}")


def check_counts(name: str, counts: Sequence[int], meaning: str) -> None:
    """Refuse what is not three whole numbers, some of them above 0; ``meaning`` says what they count."""
    try:
        good = [whole(n, name, 0) for n in counts]
    except TypeError:
        good = []
    if len(good) != 3 or not any(good):
        raise SceneError(
            f"{name}: expected three numbers ({meaning}), not all 0, but got {counts!r}; set {name}"
        )
