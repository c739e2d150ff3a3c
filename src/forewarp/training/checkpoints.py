"""What a stage leaves in its folder: checkpoints, written whole or not at all, read safely, and refused if
they do not fit; and the handover to the next stage.

Lightning makes and restores their content. ``KeepCheckpoint`` stands in for its ``ModelCheckpoint``, which
moves the file from the temporary folder, perhaps another disk, without syncing it, and counts wall time.
"""

from __future__ import annotations

import math
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import lightning
import torch

from forewarp.archives import read_archive, write_archive
from forewarp.files import read_json, write_json, written_whole
from forewarp.interrupts import answer, interrupt, listening
from forewarp.methods.method import HasBounds, HasMatter, HasTrajectories, Method
from forewarp.scene.box import Box
from forewarp.scene.cloud import Cloud, Handover
from forewarp.scene.frame import Scene, spread
from forewarp.training.module import DynamicSceneModule


class KeepCheckpoint(lightning.Callback):
    """Save a checkpoint at regular intervals of training time, and after the step that Ctrl-C or a request to
    end interrupts.

    Args:
        path: file of the checkpoint, replaced each time.
        seconds: training seconds between two checkpoints.
        check: called before saving; raises if the state is broken, so that the last checkpoint stays.

    Attributes:
        asked: the signal that came inside ``listening()``; 0: none.
    """

    def __init__(self, path: Path, seconds: float, check: Callable[[lightning.Trainer], None]) -> None:
        self.path, self.every, self.check = Path(path), seconds, check
        self.asked, self._signals = 0, []

    def on_train_start(self, trainer, module) -> None:
        """Count from where a continued run stands."""
        self._next = module.clock.seconds + self.every
        if not self.asked:
            answer(self._signals, self._ask)  # at SIGTERM Lightning would end unsaved, with status 0

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Save if it is time or if asked to end; then end if so."""
        if self.asked or module.clock.seconds >= self._next:
            self._next = module.clock.seconds + self.every
            with module.clock.paused():
                self.save(trainer)
        if self.asked:
            raise KeyboardInterrupt(self.asked)

    def save(self, trainer: lightning.Trainer) -> None:
        """Save now."""
        self.check(trainer)
        with written_whole(self.path, synced=True) as beside:
            trainer.save_checkpoint(beside)

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Let the first Ctrl-C, SIGTERM or SIGHUP only ask to save this step and stop; a second one of its
        kind stops the process at once. See ``interrupts.listening``.
        """
        with listening(self._ask) as self._signals:
            yield

    def _ask(self, number: int, frame: object) -> None:
        self.asked = number
        answer([number], interrupt)
        with suppress(OSError, RuntimeError):  # it may interrupt another print
            name = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name
            says = f"ends this step and saves it; {name} again stops at once"
            print(f"\n{says}", file=sys.stderr, flush=True)


def load_weights(module: DynamicSceneModule, path: Path) -> None:
    """Load a checkpoint's weights into a module of the same configuration; see ``check_checkpoint``."""
    module.load_state_dict(check_checkpoint(path, module)["state_dict"])


def check_checkpoint(path: Path, module: DynamicSceneModule) -> dict:
    """Read a checkpoint and refuse it if its weights do not fit the module.

    Raises:
        ValueError: naming the entries that differ, or saying that the file cannot be read.
    """
    try:
        content = read_archive(path)
    except ValueError as error:
        expected = f"{path}: expected a checkpoint"
        raise ValueError(f"{expected}, but it cannot be read ({error}); delete it") from None
    if not isinstance(content.get("state_dict"), dict):
        raise ValueError(f"{path}: expected a checkpoint, but it holds no weights; delete it")
    content["state_dict"] = module.method.current_names(content["state_dict"], "method.")
    if differ := misfits(module, content["state_dict"]):
        got = f"one that differs in {', '.join(differ[:3])}"
        advice = "use another run folder, or the configuration that it was made with"
        raise ValueError(f"{path}: expected a checkpoint of this configuration, but got {got}; {advice}")
    return content


def check_state(path: Path, module: DynamicSceneModule) -> tuple[int, float]:
    """Check that training can continue from a checkpoint.

    Returns:
        the steps and the seconds of training that it holds.

    Raises:
        ValueError: naming what it should hold.
    """
    content, saved = check_checkpoint(path, module), {}
    module.on_save_checkpoint(saved)
    needed = saved["forewarp"].keys()
    with suppress(KeyError, TypeError, AttributeError):
        state, steps = content["forewarp"], content["global_step"]
        seconds = state["clock"]["seconds"]
        if needed <= state.keys() and type(steps) is int and type(seconds) in (int, float):
            return steps, seconds
    expected = f"{path}: expected a checkpoint with its step and {', '.join(needed)}"
    raise ValueError(f"{expected}, but got one without; delete it to begin the stage anew")


def misfits(module: DynamicSceneModule, weights: dict) -> list[str]:
    """Return the names of stored entries that are missing, unknown, of another shape, or inconsistent."""
    adopted = {f"method.{name}" for name in module.method.adopted()}  # take a checkpoint's shape

    def shape(name: str, value: object) -> tuple | None:
        if isinstance(value, dict):  # plain numbers by name
            return tuple(sorted(map(str, value)))
        return tuple(value.shape) if torch.is_tensor(value) and name not in adopted else None

    built, stored = ({k: shape(k, v) for k, v in w.items()} for w in (module.state_dict(), weights))
    differ = sorted(str(k) for k in built | stored if built.get(k, "none") != stored.get(k, "none"))
    if not differ:
        name = module.method.misfit({str(k).removeprefix("method."): v for k, v in weights.items()})
        differ = [] if name is None else [f"method.{name}"]
    return differ


NUMBERS, POINTS = "handover.json", "handover.pt"
_POINTS, _TIMES = 10_000, 16  # at most this many points of the cloud, and times of their paths


@torch.no_grad()
def make_handover(method: Method, scene: Scene, before: Handover | None, frames_in_play: int) -> Handover:
    """Gather what a fitted stage leaves: its box, and points with colours and paths if the method has them.

    Args:
        method: fitted.
        scene: the scene that the method was fitted to.
        before: the handover that the stage began with; None for the first stage.
        frames_in_play: at the stage's end.
    """
    times = list(scene.times)
    box = method.bounds(times) if isinstance(method, HasBounds) else None
    room = scene.box.scaled(1.05)
    if tight := box is not None and box.meets(room):  # what drew nothing may have strayed from it
        box = box.intersection(room)
    else:
        box = scene.box if before is None else before.box
    some = paths = cloud = None
    if isinstance(method, HasMatter):
        cloud = method.matter()
        rows = torch.tensor(spread(len(cloud), _POINTS), dtype=torch.long, device=cloud.points.device)
        cloud = cloud[rows]
        if isinstance(method, HasTrajectories):
            some = torch.tensor([times[i] for i in spread(len(times), _TIMES)])
            paths = method.trajectories(cloud.points, some.to(cloud.points)).cpu()
        cloud = Cloud(cloud.points.cpu(), cloud.colors.cpu(), cloud.opacity.cpu(), cloud.size)
    return Handover(box, tight, frames_in_play, cloud, some, paths, method.notes())


def save_handover(handover: Handover, folder: Path) -> None:
    """Write ``handover.pt`` (points, if there are any), then ``handover.json`` (numbers)."""
    cloud = handover.cloud
    if cloud is not None:
        tensors = {"points": cloud.points, "colors": cloud.colors, "opacity": cloud.opacity}
        if handover.paths is not None:
            tensors |= {"times": handover.times, "paths": handover.paths}
        write_archive(folder / POINTS, {name: t.contiguous() for name, t in tensors.items()})
    numbers = {"low": handover.box.low, "high": handover.box.high, "tight": handover.tight}
    numbers |= {"frames_in_play": handover.frames_in_play, "size": None if cloud is None else cloud.size}
    write_json(folder / NUMBERS, numbers | {"notes": dict(handover.notes)})


def load_handover(folder: Path) -> Handover:
    """Read what ``save_handover`` wrote.

    Raises:
        ValueError: naming the file that is missing, damaged, or something else.
    """
    path = folder / NUMBERS
    with suppress(KeyError, TypeError, ValueError, AttributeError, OSError):
        content = read_json(path) or {}
        box, notes = Box(tuple(content["low"]), tuple(content["high"])), content["notes"]
        if not all(math.isfinite(value) for value in notes.values()):
            raise ValueError
        cloud, times, paths = None, None, None
        if content["size"] is not None:
            path = folder / POINTS
            cloud, times, paths = _points(read_archive(path), float(content["size"]))
        return Handover(box, content["tight"], content["frames_in_play"], cloud, times, paths, notes)
    raise ValueError(f"{path}: expected what a stage leaves to the next, but got something else; delete it")


def _points(content: dict, size: float) -> tuple:
    points, colors, opacity = (content[name] for name in ("points", "colors", "opacity"))
    times, paths = content.get("times"), content.get("paths")
    count = len(points)
    good = points.shape == colors.shape == (count, 3) and opacity.shape == (count,)
    good = good and (paths is None or paths.shape == (count, len(times), 3))
    if not good or not 0 < size < math.inf:
        raise ValueError
    return Cloud(points, colors, opacity, size), times, paths
