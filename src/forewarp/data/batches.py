"""Draw from a scene: an endless stream of batches to train on, whole images to evaluate on."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.utils.data import IterableDataset

from forewarp.data.files import mismatch, one_of
from forewarp.data.images import StoredImage, composited, reduced
from forewarp.ops.grid import block_means, dilate, reduced_depth
from forewarp.scene.frame import Frame, Scene, instants_of
from forewarp.scene.view import Asks, Batch, Moment, Observation, Target, View

_BESIDE = 0.02  # of an image's width: so far from what it shows is still near it
COLORS = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


def color_of(background: str) -> Tensor:
    """Look up the background colour (3,) white or black."""
    one_of(background, "data.eval_background", *COLORS)
    return torch.tensor(COLORS[background])


def pixels_of(frame: Frame) -> Tensor:
    """Load a frame's image.

    Raises:
        SceneError: unless its reader gives a uint8 tensor (H, W, 4) of the camera's size.
    """
    rgba, shape = frame.load(), (frame.camera.height, frame.camera.width, 4)
    if not (isinstance(rgba, Tensor) and rgba.dtype == torch.uint8 and tuple(rgba.shape) == shape):
        got = f"{type(rgba).__name__} {getattr(rgba, 'dtype', '')} {tuple(getattr(rgba, 'shape', ()))}"
        raise mismatch(frame.name, f"a picture as a torch.uint8 tensor {shape}", got)
    return rgba


class Sampler(IterableDataset):
    """An endless stream of training batches, of what a method ``asks`` for.

    ``picker()`` chooses the next frame, an index into ``scene.train``; None picks uniformly. A batch of
    single pixels has ``rays`` of them (None: the method asks for no such batch). If ``views_per_step`` is
    above 1, the rays are divided among up to that many random frames of the picked frame's time, so one
    snapshot serves them all. ``background`` is white, black or random: a colour per pixel, or one for a whole
    image or crop, drawn at each step. An image without alpha hides the colour, so a random one penalises
    transparency in the rendering. Single pixels are drawn of the valid ones alone. A second ``iter`` goes on
    where the first stopped; ``state_dict`` holds what an exact continuation needs.

    Cost: linear in the pixels, below 2 ms for 8192; under a mask also in those of the whole image. A frame is
    decoded when it is first picked, and kept while there is room.
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
        one_of(background, "data.background", *COLORS, "random")
        for key, count in (("rays", rays), ("views_per_step", views_per_step)):
            if count is not None and int(count) < 1:
                raise mismatch(f"data.{key}", "at least 1", count)
        self.frames, self.background, self.picker, self.asks = scene.train, background, picker, asks or Asks()
        self.rays = None if rays is None else int(rays)
        self.views_per_step = min(int(views_per_step), self.rays or 1)
        self.has_alpha, self._places = scene.has_alpha, {}  # the latter: frame -> (H W,) bool, see _near
        self._times, self._of_time = instants_of(scene.train), {}  # the latter: time -> frames
        for index, time in enumerate(self._times):
            self._of_time.setdefault(time, []).append(index)
        self.seed, self._generator = seed, torch.Generator().manual_seed(seed)

    def __iter__(self) -> Iterator[Batch]:
        while True:
            yield self.draw()

    def __len__(self) -> int:
        # Lightning draws one batch ahead of a stream without a length; a saved state would be ahead too.
        return sys.maxsize

    def draw(self) -> Batch:
        """Draw the next batch."""
        index = self._below(len(self.frames)) if self.picker is None else int(self.picker())
        if not 0 <= index < len(self.frames):
            raise ValueError(f"picker: expected a training frame in [0, {len(self.frames)}), but got {index}")
        time = self._times[index]
        same_time = [i for i in self._of_time[time] if i != index]
        frames = [index]
        if self.views_per_step > 1 and same_time:
            order = torch.randperm(len(same_time), generator=self._generator)
            frames += [same_time[i] for i in order[: self.views_per_step - 1].tolist()]
        if self.asks.neighbours:  # a frame of each of the nearest other times, nearest first
            nearest = sorted(sorted(self._of_time.keys() - {time}), key=lambda t: abs(t - time))
            choices = [self._of_time[t] for t in nearest[: self.asks.neighbours]]
            frames += [choice[self._below(len(choice))] for choice in choices]
        observations = self._pixels(frames) if self.asks.kind == "pixels" else self._areas(frames)
        white, whole = torch.tensor(COLORS["white"]), [index, *same_time][: self.asks.instant]
        instant = (self._observed(i, View(self.frames[i].camera), white) for i in whole)
        return Batch(tuple(observations), index, tuple(instant))

    def restart(self, number: int) -> None:
        """Start random stream ``number`` from its beginning; the first stream is 0."""
        self._generator.manual_seed(self.seed + number)

    def state_dict(self) -> dict[str, Tensor]:
        """Save the random generator's state."""
        return {"generator": self._generator.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue where ``state_dict`` was saved."""
        self._generator.set_state(state["generator"].cpu())

    def _pixels(self, frames: list[int]) -> Iterator[Observation]:
        """Draw random pixels, shared out among frames."""
        if self.rays is None:
            expected, advice = "a number, as the method is trained on single rays", "set preset.rays=2048"
            raise mismatch("data.rays", expected, "null", advice)
        frames = frames[: self.rays]  # none without a pixel
        counts = [self.rays // len(frames) + (i < self.rays % len(frames)) for i in range(len(frames))]
        views = []
        for index, count in zip(frames, counts):
            frame = self.frames[index]
            allowed = None if frame.load_valid is None else frame.load_valid().flatten().nonzero()[:, 0]
            most = frame.camera.width * frame.camera.height if allowed is None else len(allowed)
            pixels = torch.randint(most, (count,), generator=self._generator)
            shares = None
            if self.asks.near > 0 and self.has_alpha and allowed is None:
                pixels, shares = self._near(index, pixels)
            views.append((View(frame.camera, pixels if allowed is None else allowed[pixels]), shares))
        colors = self._colors(self.rays).split(counts) if self.background == "random" else None
        for i, (index, (view, shares)) in enumerate(zip(frames, views)):
            background = color_of(self.background) if colors is None else colors[i]
            yield replace(self._observed(index, view, background), shares=shares)

    def _near(self, index: int, pixels: Tensor) -> tuple[Tensor, Tensor | None]:
        """Replace a share of uniformly drawn pixels (R,) by some near what frame ``index`` shows.

        Returns:
            pixels (R,), and one over how much more often than uniformly each of them is drawn, (R,).
        """
        if index not in self._places:
            rgba = pixels_of(self.frames[index])
            grown = dilate(rgba[..., 3] > 0, max(1, round(_BESIDE * rgba.shape[1])))
            self._places[index] = grown.flatten()
        mask = self._places[index]
        places = mask.nonzero()[:, 0]
        if not len(places):
            return pixels, torch.ones(len(pixels))
        share = self.asks.near
        drawn = torch.randint(len(places), (round(share * len(pixels)),), generator=self._generator)
        pixels = torch.cat([places[drawn], pixels[len(drawn) :]])
        more = len(drawn) / len(pixels)
        often = (1 - more) + more * mask[pixels] * (len(mask) / len(places))
        return pixels, 1 / often

    def _areas(self, frames: list[int]) -> Iterator[Observation]:
        """Draw a crop or the whole of each frame, over one colour."""
        for index in frames:
            camera, side = self.frames[index].camera, self.asks.side
            view = View(camera)
            if self.asks.kind == "crops":
                height, width = min(side, camera.height), min(side, camera.width)
                top, left = self._below(camera.height - height + 1), self._below(camera.width - width + 1)
                view = View(camera, crop=(top, left, height, width))
            yield self._observed(index, view, self._colors(1)[0])

    def _observed(self, index: int, view: View, background: Tensor) -> Observation:
        frame, rows = self.frames[index], slice(None) if view.indices is None else view.indices
        rgba, valid, sensed = pixels_of(frame).reshape(-1, 4)[rows], None, None
        rgb = rgba if self.asks.straight else composited(rgba, background)
        if frame.load_valid is not None and view.pixels is None:
            valid = frame.load_valid().flatten()[rows]
        if self.asks.sensed and frame.load_sensed is not None:
            sensed = frame.load_sensed().flatten(1)[:, rows]
        moment = Moment(frame.time, index, frame.camera_id, filmed=True)
        return Observation(moment, view, rgb, background, valid, sensed)

    def _colors(self, count: int) -> Tensor:
        """Choose colours (count, 3) behind pixels."""
        if self.background != "random":
            return color_of(self.background).expand(count, 3)
        return torch.rand(count, 3, generator=self._generator)

    def _below(self, count: int) -> int:
        return int(torch.randint(count, (), generator=self._generator))


class Targets(Sequence[Target]):
    """The frames as whole images over a constant background; decoded at the first use.

    Args:
        frames, background, has_alpha: of the scene.
        trained: ``frames`` are all training frames in order: a target's place is its index.
        factor: above 1 averages blocks of so many pixels a side: see ``reduced``.
    """

    def __init__(self, frames: Sequence[Frame], background: Tensor, has_alpha: bool, trained=False, factor=1):
        self.frames, self.background, self.has_alpha = frames, background, has_alpha
        self.trained, self.factor = trained, factor

    def reduced(self, factor: int) -> Targets:
        """The same views, true images averaged over ``factor`` x ``factor`` pixels as
        ``data.half_resolution`` of D-NeRF does; a target's view keeps its camera.

        Raises:
            SceneError: where ``factor`` does not divide an image's sides, or a mask cuts an image out.
        """
        for frame in self.frames:
            width, height = frame.camera.width, frame.camera.height
            if width % factor or height % factor:
                expected, got = f"pictures with sides that {factor} divides", f"{width} x {height} pixels"
                advice = "set another number, or leave reduce out"
                raise mismatch("reduce", expected, f"{got} of {frame.name}", advice)
            if isinstance(frame.load, StoredImage) and frame.load.mask is not None:
                got = f"{frame.name} cut out by a mask, whose outline is averaged in another way"
                advice = "use data.half_resolution, or leave reduce out"
                raise mismatch("reduce", "whole pictures", got, advice)
        return Targets(self.frames, self.background, self.has_alpha, self.trained, factor)

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Target:
        frame = self.frames[index]
        loads = frame.load_depth, frame.load_valid, frame.load_moving, frame.load_covisible
        rgba, (depth, *masks) = pixels_of(frame), (load and load() for load in loads)
        if (by := self.factor) > 1:
            rgba, depth = reduced(rgba, by), None if depth is None else reduced_depth(depth, by)
            shares = (1, 0.5, 1)  # of a block, at least
            masks = [m if m is None else block_means(m.float(), by) >= s for m, s in zip(masks, shares)]
        valid, moving, covisible = masks
        foreground = None if depth is None else depth > 0
        if self.has_alpha:
            foreground = rgba[..., 3] > 127  # at least half covered
        place = index % len(self.frames) if self.trained else None
        rgb = composited(rgba, self.background)
        return Target(frame, rgb, self.background, foreground, depth, place, valid, moving, covisible)
