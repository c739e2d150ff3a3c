"""The procedural scene as data: written whole at its first use, then read like any other."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

from forewarp.data.files import read_json
from forewarp.data.module import DNeRFDataModule
from forewarp.scene.errors import SceneError
from forewarp.synth.scenes import synthesize

RECORD = "synthesis.json"


def write_whole(folder: Path, arguments: Mapping, progress: Callable[[int, int], None] | None = None) -> Path:
    """Synthesise beside ``folder``, then rename: it appears whole or not at all; what was there is replaced.

    Args:
        folder: the scene's own.
        arguments: of ``synthesize``; kept in ``synthesis.json`` beside the scene.
    """
    beside = folder.with_name(f".{folder.name}.part-{os.getpid()}")
    try:
        synthesize(beside, **arguments, progress=progress)
        (beside / RECORD).write_text(json.dumps(dict(arguments), indent=2) + "\n")
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(beside, folder)
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return folder


def is_scene(folder: Path) -> bool:
    """Whether a scene lies there."""
    return (folder / "transforms_train.json").is_file()


class SyntheticDataModule(DNeRFDataModule):
    """The procedural scene ``root/scene``, synthesised where it is absent.

    Args:
        root, scene: its place.
        synthesis: arguments of ``synthesize``; a scene already there must have been made with the same.
        common: as ``DNeRFDataModule``.
    """

    def __init__(self, root: str | Path, scene: str, *, synthesis: Mapping, **common) -> None:
        super().__init__(root, scene, **common)
        self.folder, self.synthesis = Path(root) / scene, dict(synthesis)
        reader = self._read
        self._read = lambda: (self.prepare(), reader())[1]

    def prepare(self) -> None:
        """Make sure that the scene is there."""
        if is_scene(self.folder):
            self._check()
            return
        from forewarp.cli.measure import Progress

        with Progress(f"writing {self.folder.name}") as progress:
            write_whole(self.folder, self.synthesis, progress)

    def _check(self) -> None:
        record = self.folder / RECORD
        before = read_json(record) if record.is_file() else {}
        for key, value in self.synthesis.items():
            if key in before and before[key] != value:
                got = f"{before[key]}; use another data.scene or delete the scene"
                raise SceneError(f"{record}: {key}: expected {value}, but got {got}")
