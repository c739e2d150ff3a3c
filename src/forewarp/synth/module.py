"""Procedural scenes as data: written whole at their first use, then read like any other."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

from filelock import FileLock

from forewarp.data.files import read_json
from forewarp.data.fingerprint import LOCK, RECORD
from forewarp.data.module import (
    DNeRFDataModule,
    HyperNeRFDataModule,
    LegoCompleteDataModule,
    NHRDataModule,
)
from forewarp.scene.errors import SceneError
from forewarp.synth import dome, lego_complete, rig, scenes

WRITERS = {
    "dnerf": scenes.synthesize,
    "lego_complete": lego_complete.synthesize,
    "hypernerf": rig.synthesize,
    "nhr": dome.synthesize,
}


def write_whole(
    folder: Path,
    dataset: str,
    arguments: Mapping,
    *,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Synthesise beside ``folder``, then rename: it appears whole or not at all; what was there is replaced.

    Args:
        folder: the scene's own.
        dataset: a key of ``WRITERS``.
        arguments: of its writer; kept in ``synthesis.json`` beside the scene.
        workers, progress: of its writer; what is written does not depend on them.
    """
    beside = folder.with_name(f".{folder.name}.part-{os.getpid()}")
    try:
        WRITERS[dataset](beside, **arguments, workers=workers, progress=progress)
        (beside / RECORD).write_text(json.dumps({"dataset": dataset, **arguments}, indent=2) + "\n")
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(beside, folder)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return folder


def is_scene(folder: Path) -> bool:
    """Whether a synthesised scene lies there."""
    return (folder / RECORD).is_file()


class Synthetic:
    """What a data module needs to synthesise what it reads, where that is absent.

    Args:
        root, scene: the scene's place.
        synthesis: arguments of its writer; a scene already there must have been made with the same.
        arguments: of the data module that reads it.
    """

    dataset = "dnerf"

    def __init__(self, root: str | Path, scene: str, *, synthesis: Mapping, **arguments) -> None:
        super().__init__(root, scene, **arguments)
        self.folder, self.synthesis = self._folder(Path(root), scene), dict(synthesis)
        reader = self._read
        self._read = lambda: (self.prepare(), reader())[1]

    def prepare(self) -> None:
        """Make sure that the scene is there; of several runs that need it at once one writes it."""
        if not is_scene(self.folder):
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            with FileLock(self.folder.with_name(f".{self.folder.name}{LOCK}")):
                self._write()
        self._check()

    def _write(self) -> None:
        if is_scene(self.folder):
            return
        if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
            raise SceneError(
                f"{self.folder}: expected a synthesised scene or nothing, but got something else; "
                "use another data.root or data.scene"
            )
        from forewarp.progress import Counted

        with Counted(f"writing {self.folder.name}") as progress:
            write_whole(self.folder, self.dataset, self.synthesis, progress=progress)

    def _folder(self, root: Path, scene: str) -> Path:
        return root / scene

    def _check(self) -> None:
        record = self.folder / RECORD
        before = {"dataset": "dnerf", **read_json(record)}
        for key, value in {"dataset": self.dataset, **self.synthesis}.items():
            if key in before and before[key] != value:
                got = f"{before[key]}; use another data.scene or delete the scene"
                raise SceneError(f"{record}: {key}: expected {value}, but got {got}")


class SyntheticDataModule(Synthetic, DNeRFDataModule):
    """The procedural scene ``root/scene`` in D-NeRF's layout."""


class SyntheticLegoCompleteDataModule(Synthetic, LegoCompleteDataModule):
    """One of the procedural scenes in ``root``, which are synthesised together."""

    dataset = "lego_complete"

    def _folder(self, root: Path, scene: str) -> Path:
        return root


class SyntheticHyperNeRFDataModule(Synthetic, HyperNeRFDataModule):
    """The procedural capture ``root/scene`` of a two-phone rig in a room."""

    dataset = "hypernerf"


class SyntheticNHRDataModule(Synthetic, NHRDataModule):
    """The procedural recording ``root/scene`` of a dome of cameras."""

    dataset = "nhr"
