"""Checkpoints of a stage: written whole or not at all, and refused where they do not fit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import lightning
import torch

from forewarp.files import written_whole
from forewarp.training.archive import read_archive
from forewarp.training.interruption import Interruption
from forewarp.training.module import DynamicSceneModule


class KeepCheckpoint(lightning.Callback):
    """Writes ``last.ckpt`` beside, then renames it, every so many seconds of training.

    Args:
        path: of the checkpoint.
        seconds: between two.
        check: raises where what would be saved is broken; the checkpoint before is then kept.
        interruption: where it was asked for, the step's end is saved and the stage stopped.
    """

    def __init__(
        self,
        path: Path,
        seconds: float,
        check: Callable[[lightning.Trainer], None] = lambda trainer: None,
        interruption: Interruption | None = None,
    ) -> None:
        self.path, self.every, self.check = Path(path), seconds, check
        self.interruption = interruption or Interruption()
        self._next = seconds

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Save when it is time, or the last one."""
        if self.interruption.asked or module.clock.seconds >= self._next:
            self._next = module.clock.seconds + self.every
            with module.clock.paused():
                self.save(trainer)
        if self.interruption.asked:
            raise KeyboardInterrupt

    def on_train_start(self, trainer, module) -> None:
        """Count from where a continued run stands."""
        self._next = module.clock.seconds + self.every

    def save(self, trainer: lightning.Trainer) -> None:
        """Save now."""
        self.check(trainer)
        with written_whole(self.path, synced=True) as beside:
            trainer.save_checkpoint(beside)


def check_checkpoint(path: Path, module: DynamicSceneModule) -> dict:
    """Read a checkpoint and refuse one of another configuration.

    Raises:
        ValueError: naming what does not fit.
    """
    content = _read(path)
    if differ := misfits(module, content["state_dict"]):
        raise ValueError(
            f"{path}: expected a checkpoint of this configuration, but got one that differs in "
            f"{', '.join(differ[:3])}; use another run folder, or the configuration that it was made with"
        )
    return content


def misfits(module: DynamicSceneModule, weights: dict) -> list[str]:
    """The entries of stored weights that a module cannot take: others than its own, of another shape, or such
    as its method says do not fit together.
    """
    own, theirs = _shapes(module.state_dict(), module), _shapes(weights, module)
    differ = sorted(str(k) for k in own | theirs if k not in own or k not in theirs or own[k] != theirs[k])
    if not differ:
        own = {str(k).removeprefix("method."): v for k, v in weights.items()}
        name = module.method.misfit(own)
        differ = [] if name is None else [f"method.{name}"]
    return differ


def _read(path: Path) -> dict:
    try:
        content = read_archive(path)
    except OSError:
        raise
    except ValueError as error:
        raise ValueError(
            f"{path}: expected a checkpoint, but it cannot be read ({error}); delete it"
        ) from None
    if not isinstance(content.get("state_dict"), dict):
        raise ValueError(f"{path}: expected a checkpoint, but it holds no weights; delete it")
    return content


def check_state(path: Path, module: DynamicSceneModule) -> tuple[int, float]:
    """Refuse a checkpoint that a stage cannot go on from, as one of an older version.

    Returns:
        steps and seconds of training that it holds.

    Raises:
        ValueError: naming what is missing.
    """
    content, needed = check_checkpoint(path, module), {}
    found = content.get("forewarp")
    module.on_save_checkpoint(needed)
    missing = sorted(needed["forewarp"].keys() - (found.keys() if isinstance(found, dict) else ()))
    if missing:
        raise ValueError(
            f"{path}: expected a checkpoint of this version, but got one without {', '.join(missing)}; "
            "delete it to begin the stage anew"
        )
    clock = found["clock"]
    steps, seconds = content.get("global_step"), clock.get("seconds") if isinstance(clock, dict) else None
    if type(steps) is not int or type(seconds) not in (int, float):
        raise ValueError(
            f"{path}: expected a checkpoint with its step and seconds, but got {steps} and {seconds}; "
            "delete it to begin the stage anew"
        )
    return steps, seconds


def _shapes(weights: dict, module: DynamicSceneModule) -> dict[str, tuple | None]:
    """Of every entry that must fit; None for those whose shapes a checkpoint says."""
    adopted = {f"method.{name}" for name in module.method.adopted()}

    def shape(name: str, value: object) -> tuple | None:
        if isinstance(value, dict):  # plain numbers by name
            return tuple(sorted(map(str, value)))
        return tuple(value.shape) if torch.is_tensor(value) and name not in adopted else None

    return {name: shape(name, value) for name, value in weights.items()}


def load_weights(module: DynamicSceneModule, path: Path) -> None:
    """Load a finished stage's weights into a module of the same configuration."""
    module.load_state_dict(check_checkpoint(path, module)["state_dict"])
