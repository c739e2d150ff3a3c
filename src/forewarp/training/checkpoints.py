"""Checkpoints of a stage: written whole or not at all, and refused where they do not fit."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import lightning
import torch

from forewarp.fields.voxel_grid import VoxelGrid
from forewarp.training.module import DynamicSceneModule


class KeepCheckpoint(lightning.Callback):
    """Writes ``last.ckpt`` beside, then renames it, every so many seconds of training.

    Args:
        path: of the checkpoint.
        seconds: between two.
        check: raises where what would be saved is broken; the checkpoint before is then kept.
    """

    def __init__(
        self,
        path: Path,
        seconds: float,
        check: Callable[[lightning.Trainer], None] = lambda trainer: None,
    ) -> None:
        self.path, self.every, self.check = Path(path), seconds, check
        self._next = seconds

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Save when it is time."""
        if module.clock.seconds >= self._next:
            self._next = module.clock.seconds + self.every
            with module.clock.paused():
                self.save(trainer)

    def on_train_start(self, trainer, module) -> None:
        """Count from where a continued run stands."""
        self._next = module.clock.seconds + self.every

    def save(self, trainer: lightning.Trainer) -> None:
        """Save now."""
        self.check(trainer)
        beside = self.path.with_name(self.path.name + ".part")
        try:
            trainer.save_checkpoint(beside)
            with beside.open("rb+") as file:  # on the disk before it takes the other's name
                os.fsync(file.fileno())
            os.replace(beside, self.path)
        except OSError as error:  # a full disk does not say which file
            with suppress(OSError):
                beside.unlink()
            raise OSError(error.errno, error.strerror or str(error), str(self.path)) from error


def check_checkpoint(path: Path, module: DynamicSceneModule) -> dict:
    """Read a checkpoint and refuse one of another configuration.

    Raises:
        ValueError: naming what does not fit.
    """
    content = _read(path)
    own, theirs = _shapes(module.state_dict(), module), _shapes(content["state_dict"], module)
    differ = sorted(k for k in {**own, **theirs} if k not in own or k not in theirs or own[k] != theirs[k])
    if differ:
        raise ValueError(
            f"{path}: expected a checkpoint of this configuration, but got one that differs in "
            f"{', '.join(differ[:3])}; use another run folder, or the configuration that it was made with"
        )
    return content


def _read(path: Path) -> dict:
    try:
        with zipfile.ZipFile(path) as archive:  # torch does not look at the checksums
            if (harmed := archive.testzip()) is not None:
                raise zipfile.BadZipFile(harmed)
        content = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(content["state_dict"], dict):
            raise TypeError
    except OSError:
        raise
    except Exception as error:  # of unpickling alone there are half a dozen kinds
        raise ValueError(
            f"{path}: expected a checkpoint, but it cannot be read ({type(error).__name__}); delete it"
        ) from None
    return content


def check_state(path: Path, module: DynamicSceneModule) -> None:
    """Refuse a checkpoint that a stage cannot go on from, as one of an older version.

    Raises:
        ValueError: naming what is missing.
    """
    found, needed = check_checkpoint(path, module).get("forewarp", {}), {}
    module.on_save_checkpoint(needed)
    missing = sorted(needed["forewarp"].keys() - found.keys())
    if missing:
        raise ValueError(
            f"{path}: expected a checkpoint of this version, but got one without {', '.join(missing)}; "
            "delete it to begin the stage anew"
        )


def _shapes(weights: dict, module: DynamicSceneModule) -> dict[str, tuple | None]:
    """Of every entry that must fit; None for those of voxel grids, which adopt a checkpoint's shapes."""
    grids = [(prefix, m) for prefix, m in module.named_modules() if isinstance(m, VoxelGrid)]
    adopted = {f"{prefix}.{name}" for prefix, m in grids for name in ("voxels", "index", *m.names)}
    return {
        k: tuple(v.shape) if torch.is_tensor(v) and k not in adopted else None for k, v in weights.items()
    }


def load_weights(module: DynamicSceneModule, path: Path) -> None:
    """Load a finished stage's weights into a module of the same configuration."""
    module.load_state_dict(check_checkpoint(path, module)["state_dict"])
