"""A run's folder while a process works on it: locked, held for one config, its data as they were."""

from __future__ import annotations

import errno
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from forewarp.data.files import LOCK, difference, mismatch, one_of, stamps
from forewarp.files import held, read_json, read_text, refuse_links, replace_file, write_json
from forewarp.ops.backend import is_number
from forewarp.provenance import installed
from forewarp.runs.config import (
    IDENTITY,
    IDENTITY_IF_SET,
    NOT_OF_RUN,
    make_absolute,
    plain,
    read_config,
    set_value,
)
from forewarp.runs.overrides import command_of_job
from forewarp.training.stages import Run

PACKAGES = "packages.txt"  # all that was installed when the run was last trained
UNLOCKED = ("videos", "exports", ".page")  # what is written into a run's folder while another may train it
_SAME_UNIT = 1e-6  # share by which lengths of one unit may differ
# Named first in a refusal, as other differences follow from these.
_TYPED = ("model.name", "data.scene", "data.root", "seed", "preset", "budget")


@contextmanager
def session(run: Run, config: DictConfig, *, finished: bool = False) -> Iterator[None]:
    """Hold the folder of a run whose scene is read: lock it, claim it for ``config``, check its data; at the
    end warn on stderr of files of the scene that have changed meanwhile.

    Args:
        run: the run that ``config`` describes.
        config: the run's config; ``data_changed`` says what to do if the scene's files have changed.
        finished: if true, the stored config stays as it is; see ``claim``.

    Raises:
        ValueError: if another process works on the folder, it holds another run, or its data have changed;
            at the end, if the folder was deleted or moved meanwhile.
        OSError: if the folder cannot be written.
    """
    with locked(run.folder), held(run.folder) as check_folder:
        claim(config, finished=finished)
        check_data(run, config.get("data_changed", "refuse"))
        before = _stamps_of(run)
        if not finished:
            replace_file(run.folder / PACKAGES, installed())
        yield
        check_folder()
        _warn_of_exchanged(run, before)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock a run's folder for the duration of the block; make the folder if it is missing.

    The system holds the lock, so it ends with the process, even if killed. On a file system that does
    not support locks, go on unlocked. ``.lock`` names the process and stays behind.

    Raises:
        ValueError: if another process holds the lock, naming it; if a link lies in the folder.
        OSError: if the folder cannot be made or written; names the key ``run``.
    """
    folder = Path(folder)
    refuse_links(folder)
    holder, lock = folder / LOCK, FileLock(folder / f"{LOCK}.held", timeout=0, fallback_to_soft=False)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire()
        except OSError as error:
            if isinstance(error, Timeout) or error.errno != errno.ENOSYS:  # ENOSYS: no locks here
                raise
        # What a killed process left half-written; videos and exports may be written now, without the lock.
        for part in (*folder.glob(".*.part*"), *folder.glob("*/**/.*.part*")):
            if part.is_file() and not part.relative_to(folder).parts[0].startswith(UNLOCKED):
                part.unlink()
        replace_file(holder, f"process {os.getpid()} on {socket.gethostname()}\n")
    except Timeout:
        process = ""
        with suppress(OSError, ValueError):
            process = read_text(holder, 1000)[:200].strip()
        got, advice = f"one of {process or 'another process'}", "wait for it, or use run=..."
        raise mismatch(folder, "a run that nobody works on", got, advice) from None
    except OSError as error:
        lock.release()
        raise OSError(error.errno, error.strerror, f"run: {error.filename or folder}") from None
    try:
        yield
    finally:
        lock.release()


def claim(config: DictConfig, *, finished: bool = False) -> None:
    """Write the resolved config into the run's folder, unless the folder holds another run.

    Args:
        config: the run's config; the key ``run`` names the folder.
        finished: if true, check but write nothing: a finished run keeps the config it was measured with.

    Raises:
        ValueError: if the folder holds a run of another config, or checkpoints without a config.
    """
    path = Path(config.run) / "config.yaml"
    make_absolute(config)
    if config.get("resume") is None:
        config.command = command_of_job("train") if HydraConfig.initialized() else None
    config.resume = None
    if "trust" in config:  # only who runs the command may trust, never a folder
        config.trust = None
    if "viewer" in config:  # a run that goes on opens no page by itself
        config.viewer = False
    resolved = OmegaConf.create(OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    if any(path.parent.glob("*/last.ckpt")):
        if not path.is_file():
            raise mismatch(path, "the configuration of the run", "none", "use run=... or delete the folder")
        _refuse_another(path, read_config(path, None), resolved)
    if not finished:
        replace_file(path, OmegaConf.to_yaml(resolved))


def _refuse_another(path: Path, stored: DictConfig, config: DictConfig) -> None:
    """Refuse a config that describes another run than the one stored at ``path``; name a differing key."""
    before, now = map(_identity, (stored, config))
    for part in (before["data"], now["data"]):
        for key in NOT_OF_RUN:
            (part or {}).pop(key, None)
    if differ := list(_differences(before, now)):
        key, was, got = min(differ, key=lambda row: [not row[0].startswith(first) for first in _TYPED])
        more = f" (and {len(differ) - 1} more keys)" if len(differ) > 1 else ""
        expected = f"{path}: {key}: expected {was}, as the run that this folder holds"
        raise ValueError(f"{expected}, but got {got}{more}; use run=<another folder>, or delete this one")


def _identity(config: DictConfig) -> dict[str, object]:
    """Return what tells a run apart from others, by its keys."""
    parts = {key: plain(config.get(key)) for key in IDENTITY}
    return parts | {key: set_value(config, key) for key in IDENTITY_IF_SET}


def _differences(old: object, new: object, key: str = "") -> Iterator[tuple[str, object, object]]:
    """Yield the dotted key, the old and the new value wherever two configs differ."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in [*old, *(name for name in new if name not in old)]:
            inner = f"{key}.{name}" if key else name
            if old.get(name) is None and new.get(name) is None:
                continue  # a key that is new since, and null
            yield from _differences(old.get(name, "nothing"), new.get(name, "nothing"), inner)
    elif old != new:
        yield key, old, new


def check_data(run: Run, changed: str) -> None:
    """Compare the scene's files with those recorded in the run's ``data.json``; record them at first.

    Args:
        run: the run whose data are compared.
        changed: what to do if files differ: ``refuse``, or ``accept`` and record them anew.

    Raises:
        ValueError: naming what changed.
    """
    one_of(changed, "data_changed", "refuse", "accept")
    path, recorded, now, differs = _compared(run)
    if differs and changed == "refuse":
        raise ValueError(f"{differs}; use run=..., or go on with data_changed=accept")
    if now is not None and now != recorded:
        write_json(path, now)


def warn_if_changed(run: Run) -> None:
    """Warn on stderr if the scene's files differ from those in ``data.json``, and if their unit does."""
    if differs := _compared(run)[-1]:
        print(f"warning: {differs}{_change_of_unit(run)}", file=sys.stderr)


def _change_of_unit(run: Run) -> str:
    """Say by how much lengths in the data there now differ from those that a run was trained on; nothing
    where they are alike, or that is not known.
    """
    protocol = (read_json(Path(run.folder) / "metrics.json") or {}).get("protocol")
    trained = protocol.get("normalisation") if isinstance(protocol, dict) else None
    scale = trained.get("scale") if isinstance(trained, dict) else None
    factor = scale / run.datamodule.scene.world.scale if is_number(scale) else 1.0
    if abs(factor - 1) < _SAME_UNIT:
        return ""
    line = f"exports are in the unit of the data there now, in which lengths are {factor:.4g} times as large"
    return f"; {line}; for those trained on, put the old data back"


def _stamps_of(run: Run) -> dict[str, tuple[int, int]]:
    return {} if run.datamodule.place is None else stamps(run.datamodule.place)


def _warn_of_exchanged(run: Run, before: dict[str, tuple[int, int]]) -> None:
    """Warn on stderr of files of the scene that are not as they were ``before``."""
    now = _stamps_of(run)
    if changed := sorted(name for name in before | now if before.get(name) != now.get(name)):
        got = ", ".join(changed[:3]) + (f" and {len(changed) - 3} more" if len(changed) > 3 else "")
        expected = f"{run.datamodule.place}: expected files that stay as they are while a run works on them"
        advice = "what was trained and measured may mix both: run it again with run=<another folder>"
        print(f"warning: {expected}, but got others: {got}; {advice}", file=sys.stderr)


def _compared(run: Run) -> tuple[Path, dict | None, dict | None, str | None]:
    """Return ``data.json``, the fingerprints in it and of now, and a line if a begun run's differ."""
    path, now = Path(run.folder) / "data.json", run.datamodule.fingerprint()
    recorded = None if now is None else read_json(path)
    begun = recorded is not None and any(path.parent.glob("*/last.ckpt"))
    differs = difference(recorded, now) if begun else None
    line = f"{path}: expected the data that the run was begun with, but got others: {differs}"
    return path, recorded, now, line if differs else None
