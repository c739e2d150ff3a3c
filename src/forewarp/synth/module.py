"""Data modules of procedural scenes: write the scene at first use, then read the files like any other's."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

from filelock import FileLock

from forewarp.data import module
from forewarp.data.files import LOCK, RECORD, mismatch, read_json
from forewarp.progress import Counted
from forewarp.scene.frame import Scene
from forewarp.synth import recordings, scenes

WRITERS = {
    "dnerf": scenes.synthesize,
    "lego_complete": scenes.synthesize_lego_complete,
    "hypernerf": scenes.synthesize_hypernerf,
    "nhr": scenes.synthesize_nhr,
    "multicam": recordings.synthesize_multicam,
    "iphone": recordings.synthesize_iphone,
}


def write_whole(
    folder: Path,
    dataset: str,
    arguments: Mapping,
    *,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Synthesise a scene in another folder, then rename that, so that ``folder`` is never half written.

    Args:
        folder: folder of the scene; an existing one is replaced.
        dataset: a key of ``WRITERS``.
        arguments: arguments of the writer; recorded in the scene's ``synthesis.json``.
        workers, progress: see ``raycast.render_all``; the files do not depend on them.

    Raises:
        SceneError: for a bad argument, or a folder that cannot be written to.
    """
    beside = folder.with_name(f".{folder.name}.part-{os.getpid()}")
    try:
        WRITERS[dataset](beside, **arguments, workers=workers, progress=progress)
        (beside / RECORD).write_text(json.dumps({"dataset": dataset, **arguments}, indent=2) + "\n")
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(beside, folder)
    except OSError as error:
        raise mismatch(folder, "a folder to write to", error.strerror or error, "set folder") from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return folder


def is_scene(folder: Path) -> bool:
    """Tell whether a folder holds a synthesised scene."""
    return (folder / RECORD).is_file()


class Synthetic:
    """Mix-in for a data module: synthesise the scene first if it is missing.

    Args:
        root, scene: the scene is ``root/scene``.
        synthesis: arguments of the writer; an existing scene must have been made with the same.
        arguments: arguments of the data module that reads the scene.
    """

    dataset = "dnerf"
    suspects = module.SceneDataModule.suspects  # its poses and times are right

    def __init__(self, root: str | Path, scene: str, *, synthesis: Mapping, **arguments) -> None:
        super().__init__(root, scene, **arguments)
        # One call of the Lego Complete writer makes several scenes.
        self.folder = Path(root) if self.dataset == "lego_complete" else Path(root) / scene
        self.synthesis, self._read_files, self._read = dict(synthesis), self._read, self._read_prepared

    def _read_prepared(self) -> Scene:
        self.prepare()
        return self._read_files()

    def prepare(self) -> None:
        """Write the scene if it is missing; if several runs need the scene at once, one writes.

        Raises:
            SceneError: if the folder holds something else, or a scene made with other arguments.
        """
        if not is_scene(self.folder):
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            with FileLock(self.folder.with_name(f".{self.folder.name}{LOCK}")):
                if not is_scene(self.folder):  # else written while this run waited for the lock
                    self._write()
        record = self.folder / RECORD
        before = {"dataset": "dnerf", **read_json(record)}
        for key, value in {"dataset": self.dataset, **self.synthesis}.items():
            if key in before and before[key] != value:
                advice = "use another data.scene or delete the scene"
                raise mismatch(f"{record}: {key}", value, before[key], advice)

    def _write(self) -> None:
        if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
            advice = "use another data.root or data.scene"
            raise mismatch(self.folder, "a synthesised scene or nothing", "something else", advice)
        with Counted(f"writing {self.folder.name}") as progress:
            write_whole(self.folder, self.dataset, self.synthesis, progress=progress)


class SyntheticDataModule(Synthetic, module.DNeRFDataModule):
    """The procedural scene ``root/scene`` in D-NeRF's layout."""


class SyntheticLegoCompleteDataModule(Synthetic, module.LegoCompleteDataModule):
    """The procedural scene ``root/scene``, one of several that are synthesised together into ``root``."""

    dataset = "lego_complete"


class SyntheticHyperNeRFDataModule(Synthetic, module.HyperNeRFDataModule):
    """The procedural capture ``root/scene`` by a rig of two phones in a room."""

    dataset = "hypernerf"


class SyntheticNHRDataModule(Synthetic, module.NHRDataModule):
    """The procedural recording ``root/scene`` by a dome of cameras."""

    dataset = "nhr"
