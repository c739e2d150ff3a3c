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

COLORS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


def color_of(background: str) -> Tensor:
    """The constant background colour (3,) of a name: white or black."""
    if background not in COLORS:
        raise SceneError(f"data.eval_background: expected white or black, but got {background!r}")
    return torch.tensor(COLORS[background])


class RayBatches(IterableDataset):
    """An endless stream of batches, each ``rays`` random pixels of one training frame over a background.

    ``picker()`` says which frame, an index into ``scene.train``; None picks uniformly. ``background`` is
    white, black or random: a colour per ray, drawn at each step, which needs images with alpha.
    A second ``iter`` goes on where the first stopped; ``state_dict`` holds all there is to continue exactly.

    Cost: linear in ``rays``, below 2 ms for 8192; a frame is decoded when it is first picked and kept.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        rays: int = 8192,
        background: str = "white",
        seed: int = 0,
        picker: Callable[[], int] | None = None,
    ) -> None:
        if int(rays) < 1:
            raise SceneError(f"data.rays: expected at least 1, but got {rays}")
        if background not in (*COLORS, "random"):
            raise SceneError(f"data.background: expected white, black or random, but got {background!r}")
        if background == "random" and not scene.has_alpha:
            raise SceneError(
                f"data.background: expected white or black, but got random and {scene.name} has images "
                "without alpha; set data.background=white"
            )
        self.frames, self.rays, self.background, self.picker = scene.train, int(rays), background, picker
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
        frame = self.frames[index]
        camera = frame.camera
        pixels = torch.randint(camera.width * camera.height, (self.rays,), generator=self._generator)
        if self.background == "random":
            background = torch.rand(self.rays, 3, generator=self._generator)
        else:
            background = color_of(self.background)
        rgb = composited(frame.load().reshape(-1, 4)[pixels], background)
        return Batch(camera.rays(pixels), rgb, background, frame.time, index)

    def restart(self, number: int) -> None:
        """Draw from the beginning of stream ``number``; 0 is the one that is drawn from at first."""
        self._generator.manual_seed(self.seed + number)

    def state_dict(self) -> dict[str, Tensor]:
        """The random generator's state."""
        return {"generator": self._generator.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue where ``state_dict`` was taken."""
        self._generator.set_state(state["generator"].cpu())

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
