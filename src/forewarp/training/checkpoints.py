"""Checkpoints of a stage: written whole or not at all, read safely, refused if they do not fit.

Lightning makes and restores their content. ``KeepCheckpoint`` stands in for its ``ModelCheckpoint``, which
moves the file from the temporary folder, perhaps another disk, without syncing it, and counts wall time.
"""

from __future__ import annotations

import io
import signal
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import lightning
import torch
from torch import Tensor

from forewarp.files import replace_file, written_whole
from forewarp.training.module import DynamicSceneModule


class Interruption:
    """A context in which the first Ctrl-C only sets ``asked``; a second one stops the process at once.

    Do nothing if the program handles or ignores Ctrl-C itself, or in a thread other than the main one,
    which receives no signals.
    """

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> Interruption:
        self._installed = False
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            with suppress(ValueError):  # raised in another thread
                signal.signal(signal.SIGINT, self._ask)
                self._installed = True
        return self

    def __exit__(self, *error) -> None:
        if self._installed:  # Lightning may have replaced it
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _ask(self, number, frame) -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self.asked = True
        with suppress(OSError, RuntimeError):  # it may interrupt another print
            print("\nends this step and saves it; Ctrl-C again stops at once", file=sys.stderr, flush=True)


class KeepCheckpoint(lightning.Callback):
    """Save a checkpoint at regular intervals of training time, and after the step that Ctrl-C interrupts.

    Args:
        path: file of the checkpoint, replaced each time.
        seconds: training seconds between two checkpoints.
        check: called before saving; raises if the state is broken, so that the last checkpoint stays.
        interruption: once it is ``asked`` for, save after this step and stop.
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

    def on_train_start(self, trainer, module) -> None:
        """Count from where a continued run stands."""
        self._next = module.clock.seconds + self.every

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Save if it is time or if Ctrl-C was pressed; then stop if it was."""
        if self.interruption.asked or module.clock.seconds >= self._next:
            self._next = module.clock.seconds + self.every
            with module.clock.paused():
                self.save(trainer)
        if self.interruption.asked:
            raise KeyboardInterrupt

    def save(self, trainer: lightning.Trainer) -> None:
        """Save now."""
        self.check(trainer)
        with written_whole(self.path, synced=True) as beside:
            trainer.save_checkpoint(beside)


def load_weights(module: DynamicSceneModule, path: Path) -> None:
    """Load a checkpoint's weights into a module of the same configuration; see ``check_checkpoint``."""
    module.load_state_dict(check_checkpoint(path, module)["state_dict"])


def check_checkpoint(path: Path, module: DynamicSceneModule) -> dict:
    """Read a checkpoint and refuse it if its weights do not fit the module.

    Raises:
        ValueError: naming the entries that differ, or saying that the file cannot be read.
    """
    content = _read(path)
    if differ := misfits(module, content["state_dict"]):
        raise ValueError(
            f"{path}: expected a checkpoint of this configuration, but got one that differs in "
            f"{', '.join(differ[:3])}; use another run folder, or the configuration that it was made with"
        )
    return content


def check_state(path: Path, module: DynamicSceneModule) -> tuple[int, float]:
    """Check that training can continue from a checkpoint.

    Returns:
        the steps and the seconds of training that it holds.

    Raises:
        ValueError: naming what is missing, for example in a checkpoint of an older version.
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


def misfits(module: DynamicSceneModule, weights: dict) -> list[str]:
    """Return the names of stored entries that are missing, unknown, of another shape, or inconsistent."""
    own, theirs = _shapes(module.state_dict(), module), _shapes(weights, module)
    differ = sorted(str(k) for k in own | theirs if k not in own or k not in theirs or own[k] != theirs[k])
    if not differ:
        own = {str(k).removeprefix("method."): v for k, v in weights.items()}
        name = module.method.misfit(own)
        differ = [] if name is None else [f"method.{name}"]
    return differ


def _shapes(weights: dict, module: DynamicSceneModule) -> dict[str, tuple | None]:
    """Return shapes (for dicts their keys) by name; None for entries that adopt a checkpoint's shape."""
    adopted = {f"method.{name}" for name in module.method.adopted()}

    def shape(name: str, value: object) -> tuple | None:
        if isinstance(value, dict):  # plain numbers by name
            return tuple(sorted(map(str, value)))
        return tuple(value.shape) if torch.is_tensor(value) and name not in adopted else None

    return {name: shape(name, value) for name, value in weights.items()}


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


def write_archive(path: Path, content: dict) -> None:
    """Write tensors and plain values as a whole file.

    Raises:
        OSError: naming the file, if it cannot be written; nothing is then left beside it.
    """
    packed = io.BytesIO()
    torch.save(content, packed)  # into a file it would hide why the system refused
    replace_file(path, packed.getbuffer())


def read_archive(path: Path) -> dict:
    """Read a dict that ``torch.save`` wrote; execute nothing, and allow no tensor larger than the file.

    Raises:
        OSError: if the file cannot be opened.
        ValueError: with the kind of the fault, if it is no such file, damaged, or compressed.

    Cost: reads the file twice, as torch does not verify the checksums.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            # A stored member is no longer than the file; a compressed one may be, a thousand times.
            packed = any(member.compress_type != zipfile.ZIP_STORED for member in members)
            if packed or sum(member.file_size for member in members) > path.stat().st_size:
                raise zipfile.BadZipFile
            if archive.testzip() is not None:
                raise zipfile.BadZipFile
        content = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(content, dict) or not all(map(_is_whole, _tensors(content))):
            raise TypeError
        return content
    except OSError:
        raise
    except Exception as error:  # unpickling alone raises half a dozen kinds
        raise ValueError(type(error).__name__) from None


def _is_whole(tensor: Tensor) -> bool:
    """Check that every entry is stored in the file, so that a copy of the tensor is no larger."""
    if tensor.layout != torch.strided or tensor.device.type != "cpu":
        return False
    return tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()


def _tensors(content: object) -> Iterator[Tensor]:
    left, seen = [content], set()
    while left:
        node = left.pop()
        if torch.is_tensor(node):
            yield node
        elif isinstance(node, dict | list | tuple | set) and id(node) not in seen:
            seen.add(id(node))  # a container may hold itself
            left += [*node, *node.values()] if isinstance(node, dict) else node
