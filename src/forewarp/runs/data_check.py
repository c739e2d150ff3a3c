"""Record the data that a run begins with, and notice changes."""

from __future__ import annotations

import sys
from pathlib import Path

from forewarp.data.files import difference
from forewarp.files import read_json, write_json
from forewarp.training.stages import Run

FILE = "data.json"
CHOICES = ("refuse", "accept")


def check_data(run: Run, changed: str) -> None:
    """Compare the scene's files with those recorded in the run's ``data.json``; record them at first.

    Args:
        run: the run whose data are compared.
        changed: what to do if files differ: ``refuse``, or ``accept`` and record them anew.

    Raises:
        ValueError: naming what changed.
    """
    if changed not in CHOICES:
        raise ValueError(f"data_changed: expected one of {', '.join(CHOICES)}, but got {changed}")
    path, now = Path(run.folder) / FILE, run.datamodule.fingerprint()
    if now is None:
        return
    before = read_json(path)
    found = _change(run, before, now)
    if found and changed == "refuse":
        raise ValueError(
            f"{path}: expected the data that the run was begun with, but got others: {found}; "
            "use run=..., or go on with data_changed=accept"
        )
    if now != before:
        write_json(path, now)


def warn_if_changed(run: Run) -> None:
    """Warn on stderr if the scene's files differ from those in ``data.json``."""
    path, now = Path(run.folder) / FILE, run.datamodule.fingerprint()
    if now is not None and (found := _change(run, read_json(path), now)):
        print(
            f"warning: {path}: expected the data that the run was begun with, but got others: {found}",
            file=sys.stderr,
        )


def _change(run: Run, before: dict | None, now: dict) -> str | None:
    begun = any(Path(run.folder).glob("*/last.ckpt"))
    return difference(before, now) if before is not None and begun else None
