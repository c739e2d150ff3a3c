"""Render many pictures of moving worlds, in several processes if that is faster."""

from __future__ import annotations

import math
import pickle
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np
import torch

from forewarp.ops.backend import cores
from forewarp.scene.camera import Camera
from forewarp.synth.raycast import SHADOW_RAYS, render
from forewarp.synth.world import World

# A process takes seconds to start and casts about two million samples a second.
_SAMPLES_A_PROCESS = 4e7
# Pictures per process waiting to be written: enough that no process idles, few enough for the memory.
_AHEAD = 3


class ImageSpec(NamedTuple):
    """An image to render: at ``time`` in [0, 1] by ``camera``; ``ability`` as in ``scene.Frame``."""

    name: str
    time: float
    camera: Camera
    ability: str = "all"


@dataclass(frozen=True)
class Exposure:
    """The rays averaged into a pixel, and the shadow rays of each ray."""

    samples_per_pixel: int = 4
    shadow_rays: int = SHADOW_RAYS


class Film:
    """Render pictures in order; a context manager that ends the processes on exit.

    The pictures do not depend on the number of processes. With more than one, a calling script needs
    the guard ``if __name__ == "__main__"``, as always with Python's processes.

    Args:
        exposure: exposure of every picture.
        cameras: cameras of all pictures to come, from which the amount of work is known.
        workers: processes; None: one per processor, fewer for little work; 1: this process.
        progress: called with (pictures done, all pictures) after each.
    """

    def __init__(
        self,
        exposure: Exposure,
        cameras: Iterable[Camera],
        workers: int | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        pixels = [camera.width * camera.height for camera in cameras]
        self.exposure, self.progress, self.done, self.total = exposure, progress, 0, len(pixels)
        self.workers = workers or _worth(sum(pixels) * exposure.samples_per_pixel)
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Film:
        if self.workers > 1:
            self._pool = ProcessPoolExecutor(self.workers, get_context("spawn"), _begin)
        return self

    def __exit__(self, *error) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def pictures(self, world: World, views: Iterable[ImageSpec]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Render each view as ``raycast.render`` does, in order."""
        for picture in self._taken(world, views):
            self.done += 1
            if self.progress is not None:
                self.progress(self.done, self.total)
            yield picture

    def _taken(self, world: World, views: Iterable[ImageSpec]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        exposure = self.exposure.samples_per_pixel, self.exposure.shadow_rays
        if self._pool is None:
            yield from (render(world, view.time, view.camera, *exposure) for view in views)
            return
        waiting: deque = deque()
        for view in views:
            # Pickled here: an executor would send each tensor through a file in shared memory.
            job = pickle.dumps((view.time, view.camera, *exposure))
            waiting.append(self._pool.submit(_take, world.motion, world.has_room, job))
            if len(waiting) > _AHEAD * self.workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _worth(samples: float) -> int:
    """Choose the number of processes by the number of samples."""
    return max(1, min(cores(), math.floor(samples / _SAMPLES_A_PROCESS)))


def _begin() -> None:
    """Set up a new process: leave Ctrl-C to the parent, and use one thread."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)


@lru_cache(4)
def _world(motion: str, has_room: bool) -> World:
    return World(motion, has_room)


def _take(motion: str, has_room: bool, job: bytes) -> tuple[np.ndarray, np.ndarray]:
    return render(_world(motion, has_room), *pickle.loads(job))
