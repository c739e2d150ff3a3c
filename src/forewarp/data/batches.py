"""Draw from a scene: an endless stream of batches to train on, whole images to evaluate on."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor
from torch.utils.data import IterableDataset

from forewarp.data.files import SceneError
from forewarp.data.images import MaskedImage, composited, reduced
from forewarp.ops.grid import reduced_depth
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Asks, Batch, Moment, Observation, Target, View

COLORS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


def color_of(background: str) -> Tensor:
    """Look up the background colour (3,) white or black."""
    if background not in COLORS:
        raise SceneError(f"data.eval_background: expected white or black, but got {background!r}")
    return torch.tensor(COLORS[background])


def pixels_of(frame: Frame) -> Tensor:
    """Load a frame's picture.

    Raises:
        SceneError: unless its reader gives a uint8 tensor (H, W, 4) of the camera's size.
    """
    rgba, shape = frame.load(), (frame.camera.height, frame.camera.width, 4)
    if not (isinstance(rgba, Tensor) and rgba.dtype == torch.uint8 and tuple(rgba.shape) == shape):
        got = f"{type(rgba).__name__} {getattr(rgba, 'dtype', '')} {tuple(getattr(rgba, 'shape', ()))}"
        raise SceneError(f"{frame.name}: expected a picture as a torch.uint8 tensor {shape}, but got {got}")
    return rgba


class Sampler(IterableDataset):
    """An endless stream of training batches, of what a method ``asks`` for.

    ``picker()`` chooses the next frame, an index into ``scene.train``; None picks uniformly. A batch of
    single pixels has ``rays`` of them (None: the method asks for no such batch). If ``views_per_step`` is
    above 1, the rays are divided among up to that many random frames of the picked frame's time, so one
    snapshot serves them all. ``background`` is white, black or random: a colour per pixel, or one for a whole
    picture or crop, drawn at each step. An image without alpha hides the colour, so a random one penalises
    transparency in the rendering. A second ``iter`` goes on where the first stopped; ``state_dict`` holds
    what an exact continuation needs.

    Cost: linear in the pixels, below 2 ms for 8192; a frame is decoded when it is first picked, and kept
    while there is room.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        rays: int | None = 8192,
        background: str = "white",
        seed: int = 0,
        picker: Callable[[], int] | None = None,
        views_per_step: int = 1,
        asks: Asks | None = None,
    ) -> None:
        if rays is not None and int(rays) < 1:
            raise SceneError(f"data.rays: expected at least 1, but got {rays}")
        if background not in (*COLORS, "random"):
            raise SceneError(f"data.background: expected white, black or random, but got {background!r}")
        if int(views_per_step) < 1:
            raise SceneError(f"data.views_per_step: expected at least 1, but got {views_per_step}")
        self.frames, self.background, self.picker, self.asks = scene.train, background, picker, asks or Asks()
        self.rays = None if rays is None else int(rays)
        self.views_per_step = min(int(views_per_step), self.rays or 1)
        self._of_time: dict[float, list[int]] = {}
        for index, frame in enumerate(scene.train):
            self._of_time.setdefault(frame.time, []).append(index)
        self._times = sorted(self._of_time)
        self.seed, self._generator = seed, torch.Generator().manual_seed(seed)

    def __iter__(self) -> Iterator[Batch]:
        while True:
            yield self.draw()

    def __len__(self) -> int:
        # Lightning draws one batch ahead of a stream without a length; a saved state would be ahead too.
        return sys.maxsize

    def draw(self) -> Batch:
        """Draw the next batch."""
        index = self._uniform() if self.picker is None else int(self.picker())
        if not 0 <= index < len(self.frames):
            raise ValueError(f"picker: expected a training frame in [0, {len(self.frames)}), but got {index}")
        frames = [*self._views(index), *self._neighbours(self.frames[index].time)]
        if self.asks.kind == "pixels" and self.rays is None:
            raise SceneError(
                "data.rays: expected a number, as the method is trained on single rays, but got null; set "
                "preset.rays=2048"
            )
        if self.asks.kind == "pixels":
            frames = frames[: self.rays]  # none without a pixel
        drawn = self._pixels(frames) if self.asks.kind == "pixels" else self._areas(frames)
        return Batch(tuple(drawn), index, self._instant(index))

    def restart(self, number: int) -> None:
        """Start random stream ``number`` from its beginning; the first stream is 0."""
        self._generator.manual_seed(self.seed + number)

    def state_dict(self) -> dict[str, Tensor]:
        """Save the random generator's state."""
        return {"generator": self._generator.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue where ``state_dict`` was saved."""
        self._generator.set_state(state["generator"].cpu())

    def _views(self, index: int) -> list[int]:
        """Choose a batch's frames: the picked one; if ``views_per_step`` > 1, also others of its time."""
        others = [i for i in self._of_time[self.frames[index].time] if i != index]
        if self.views_per_step == 1 or not others:
            return [index]
        order = torch.randperm(len(others), generator=self._generator)
        return [index, *(others[i] for i in order[: self.views_per_step - 1].tolist())]

    def _neighbours(self, time: float) -> list[int]:
        """Choose a frame of each of the nearest other times that the method asks for, nearest first."""
        if not self.asks.neighbours:
            return []
        near = sorted((t for t in self._times if t != time), key=lambda other: abs(other - time))
        chosen = [self._of_time[t] for t in near[: self.asks.neighbours]]
        return [frames[self._whole(len(frames))] for frames in chosen]

    def _pixels(self, frames: list[int]) -> Iterator[Observation]:
        """Draw random pixels, shared out among frames."""
        counts = [self.rays // len(frames) + (i < self.rays % len(frames)) for i in range(len(frames))]
        views = []
        for index, count in zip(frames, counts, strict=True):
            camera = self.frames[index].camera
            views.append(
                View(camera, torch.randint(camera.width * camera.height, (count,), generator=self._generator))
            )
        behind = self._behind(self.rays).split(counts) if self.background == "random" else None
        for number, (index, view) in enumerate(zip(frames, views)):
            background = color_of(self.background) if behind is None else behind[number]
            yield self._observed(index, view, background)

    def _areas(self, frames: list[int]) -> Iterator[Observation]:
        """Draw a crop or the whole of each frame, over one colour."""
        for index in frames:
            camera, side = self.frames[index].camera, self.asks.side
            view = View(camera)
            if self.asks.kind == "crops":
                height, width = min(side, camera.height), min(side, camera.width)
                top, left = self._whole(camera.height - height + 1), self._whole(camera.width - width + 1)
                view = View(camera, crop=(top, left, height, width))
            yield self._observed(index, view, self._behind(1)[0])

    def _instant(self, index: int) -> tuple[Observation, ...]:
        """Take whole pictures of the picked time over white, the picked one first."""
        if not self.asks.instant:
            return ()
        others = [i for i in self._of_time[self.frames[index].time] if i != index]
        white = COLORS["white"]
        chosen = [index, *others][: self.asks.instant]
        return tuple(self._observed(i, View(self.frames[i].camera), torch.tensor(white)) for i in chosen)

    def _observed(self, index: int, view: View, background: Tensor) -> Observation:
        frame, rows = self.frames[index], view.indices
        rgba = pixels_of(frame).reshape(-1, 4)
        rgba = rgba if rows is None else rgba[rows]
        rgb = rgba if self.asks.straight else composited(rgba, background)
        return Observation(Moment(frame.time, index, frame.camera_id), view, rgb, background)

    def _behind(self, count: int) -> Tensor:
        """Choose colours (count, 3) behind pixels."""
        if self.background != "random":
            return color_of(self.background).expand(count, 3)
        return torch.rand(count, 3, generator=self._generator)

    def _whole(self, below: int) -> int:
        return int(torch.randint(below, (), generator=self._generator))

    def _uniform(self) -> int:
        return self._whole(len(self.frames))


class Targets(Sequence[Target]):
    """The frames as whole images over a constant background; decoded at the first use.

    ``by`` above 1 averages blocks of so many pixels a side: see ``reduced``.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        background: Tensor,
        has_alpha: bool,
        *,
        trained: bool = False,
        by: int = 1,
    ) -> None:
        self.frames, self.background, self.has_alpha = frames, background, has_alpha
        self.trained = trained  # ``frames`` are all training frames in order: a target's place is its index
        self.by = by  # pictures are this many times smaller than their frame's camera

    def reduced(self, by: int) -> Targets:
        """The same views, true pictures averaged over ``by`` x ``by`` pixels as ``data.half_resolution`` of
        D-NeRF does; a target's view keeps its camera.

        Raises:
            SceneError: where ``by`` does not divide a picture's sides, or a mask cuts a picture out.
        """
        for frame in self.frames:
            width, height = frame.camera.width, frame.camera.height
            if width % by or height % by:
                raise SceneError(
                    f"reduce: expected pictures with sides that {by} divides, but got {width} x {height} "
                    f"pixels of {frame.name}; set another number, or leave reduce out"
                )
            if isinstance(frame.load, MaskedImage):
                raise SceneError(
                    f"reduce: expected whole pictures, but got {frame.name} cut out by a mask, whose outline "
                    "is averaged in another way; use data.half_resolution, or leave reduce out"
                )
        return Targets(self.frames, self.background, self.has_alpha, trained=self.trained, by=by)

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Target:
        frame = self.frames[index]
        rgba = pixels_of(frame)
        depth = frame.load_depth() if frame.load_depth else None
        if self.by > 1:
            rgba, depth = reduced(rgba, self.by), None if depth is None else reduced_depth(depth, self.by)
        foreground = None if depth is None else depth > 0
        if self.has_alpha:
            foreground = rgba[..., 3] > 127  # at least half covered
        place = index % len(self.frames) if self.trained else None
        rgb = composited(rgba, self.background)
        return Target(frame, rgb, self.background, foreground, depth, place)
