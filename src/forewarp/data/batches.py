"""What training and evaluation draw from a scene: an endless stream of ray batches, and whole images."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor
from torch.utils.data import IterableDataset

from forewarp.data.images import composited
from forewarp.scene.batch import Batch, Target
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.rays import Rays

COLORS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


def color_of(background: str) -> Tensor:
    """The constant background colour (3,) of a name: white or black."""
    if background not in COLORS:
        raise SceneError(f"data.eval_background: expected white or black, but got {background!r}")
    return torch.tensor(COLORS[background])


def joined(parts: Sequence[Rays]) -> Rays:
    """All rays after one another, with the range that holds for all of them."""
    if len(parts) == 1:
        return parts[0]
    origins, directions = (torch.cat([getattr(p, name) for p in parts]) for name in ("origins", "directions"))
    return Rays(origins, directions, min(p.near for p in parts), max(p.far for p in parts))


class RayBatches(IterableDataset):
    """An endless stream of batches, each ``rays`` random pixels of one time over a background.

    ``picker()`` says of which frame, an index into ``scene.train``; None picks uniformly. With
    ``views_per_step`` above 1 the pixels are shared out among up to so many frames of that frame's time,
    itself and others at random: one warp serves them all. ``background`` is white, black or random: a colour
    per ray, drawn at each step. A pixel without alpha is opaque, so a random colour behind it only says that
    its ray must not let anything through.
    A second ``iter`` goes on where the first stopped; ``state_dict`` holds all there is to continue exactly.

    Cost: linear in ``rays``, below 2 ms for 8192; a frame is decoded when it is first picked, and kept while
    there is room.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        rays: int = 8192,
        background: str = "white",
        seed: int = 0,
        picker: Callable[[], int] | None = None,
        views_per_step: int = 1,
    ) -> None:
        if int(rays) < 1:
            raise SceneError(f"data.rays: expected at least 1, but got {rays}")
        if background not in (*COLORS, "random"):
            raise SceneError(f"data.background: expected white, black or random, but got {background!r}")
        if int(views_per_step) < 1:
            raise SceneError(f"data.views_per_step: expected at least 1, but got {views_per_step}")
        self.frames, self.rays, self.background, self.picker = scene.train, int(rays), background, picker
        self.views_per_step = min(int(views_per_step), self.rays)
        self._of_time: dict[float, list[int]] = {}
        for index, frame in enumerate(scene.train):
            self._of_time.setdefault(frame.time, []).append(index)
        self.seed, self._generator = seed, torch.Generator().manual_seed(seed)

    def __iter__(self) -> Iterator[Batch]:
        while True:
            yield self.draw()

    def __len__(self) -> int:
        # Lightning draws one batch ahead of a stream without a length; a saved state would be ahead too.
        return sys.maxsize

    def draw(self) -> Batch:
        """The next batch."""
        index = self._uniform() if self.picker is None else int(self.picker())
        if not 0 <= index < len(self.frames):
            raise ValueError(f"picker: expected a training frame in [0, {len(self.frames)}), but got {index}")
        views = self._views(index)
        counts = [self.rays // len(views) + (i < self.rays % len(views)) for i in range(len(views))]
        parts = [self._pixels(self.frames[view], count) for view, count in zip(views, counts, strict=True)]
        if self.background == "random":
            background = torch.rand(self.rays, 3, generator=self._generator)
        else:
            background = color_of(self.background)
        rgb = composited(torch.cat([rgba for _, rgba in parts]), background)
        return Batch(joined([rays for rays, _ in parts]), rgb, background, self.frames[index].time, index)

    def restart(self, number: int) -> None:
        """Draw from the beginning of stream ``number``; 0 is the one that is drawn from at first."""
        self._generator.manual_seed(self.seed + number)

    def state_dict(self) -> dict[str, Tensor]:
        """The random generator's state."""
        return {"generator": self._generator.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue where ``state_dict`` was taken."""
        self._generator.set_state(state["generator"].cpu())

    def _views(self, index: int) -> list[int]:
        """The picked frame, and others of its time where a batch may have them."""
        others = [i for i in self._of_time[self.frames[index].time] if i != index]
        if self.views_per_step == 1 or not others:
            return [index]
        order = torch.randperm(len(others), generator=self._generator)
        return [index, *(others[i] for i in order[: self.views_per_step - 1].tolist())]

    def _pixels(self, frame: Frame, count: int) -> tuple[Rays, Tensor]:
        """Random pixels of a frame: their rays and their values (count, 4)."""
        camera = frame.camera
        pixels = torch.randint(camera.width * camera.height, (count,), generator=self._generator)
        return camera.rays(pixels), frame.load().reshape(-1, 4)[pixels]

    def _uniform(self) -> int:
        return int(torch.randint(len(self.frames), (), generator=self._generator))


class Targets(Sequence[Target]):
    """The frames as whole images over a constant background; decoded at the first use."""

    def __init__(self, frames: Sequence[Frame], background: Tensor, has_alpha: bool) -> None:
        self.frames, self.background, self.has_alpha = frames, background, has_alpha

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Target:
        frame = self.frames[index]
        rgba = frame.load()
        depth = frame.load_depth() if frame.load_depth else None
        foreground = None if depth is None else depth > 0
        if self.has_alpha:
            foreground = rgba[..., 3] > 127  # at least half covered
        return Target(frame, composited(rgba, self.background), self.background, foreground, depth)
