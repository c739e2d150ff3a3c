"""Draw a scene, fitted or in training: truth, prediction and error, depth, flow; and its videos."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import lightning
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from forewarp.drawing.images import (
    area_means,
    depth_colors,
    error_colors,
    flow_colors,
    in_a_row,
    with_wheel,
    write_png,
)
from forewarp.methods.method import HasTrajectories, Method, Snapshot
from forewarp.ops.backend import is_number
from forewarp.scene.camera import Camera, focus_point, mean_up, orbit, swing
from forewarp.scene.film import FilmPath
from forewarp.scene.frame import Frame, spread
from forewarp.scene.view import Moment, Rendering, Target, View
from forewarp.training.module import DynamicSceneModule

FILMED = ("as_filmed", "stabilised", "lean")  # paths of videos that follow the camera of a film
PATHS = (*FILMED, "fixed", "swing", "orbit", "both", "trajectories")
_LOOP = 6.0  # seconds of a lean's figure of eight, in the films' length
_SEEN = 0.02  # show the motion of pixels at least this opaque

Shot = tuple[Camera, float]  # camera and time
Paint = Callable[[Tensor, Rendering, Camera, float], Tensor]


def sized(camera: Camera, size: int) -> Camera:
    """Resize a camera to ``size`` pixels along its longer side."""
    scale = size / max(camera.width, camera.height)
    return camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def within(camera: Camera, size: int | None) -> Camera:
    """Resize a camera to at most ``size`` pixels along its longer side."""
    return camera if size is None or max(camera.width, camera.height) <= size else sized(camera, size)


def images_of(module: DynamicSceneModule, target: Target, size: int | None = None) -> dict[str, Tensor]:
    """Draw one view: images (h, w, 3) in [0, 1] by name.

    ``compare`` is truth | prediction | error; near points are bright in ``depth``; ``flow``, for methods
    with trajectories, is the displacement in the image from the canonical time to the target's time: hue is
    the direction, saturation the length.
    """
    parts = parts_of(module, target, size)
    compared = in_a_row([parts[name] for name in ("truth", "prediction", "error")])
    images = {"compare": compared, "depth": parts["depth"]}
    if isinstance(module.method, HasTrajectories):
        camera = within(target.frame.camera, size)
        images["flow"] = with_wheel(flow_colors(*image_flow(module, camera, target.moment.time)))
    return images


def parts_of(module: DynamicSceneModule, target: Target, size: int | None = None) -> dict[str, Tensor]:
    """Draw ``truth``, ``prediction``, ``error`` and ``depth`` of one view, each (h, w, 3) in [0, 1]."""
    camera = within(target.frame.camera, size)
    compared, drawn = compare(module, target, camera)
    shape = (camera.height, camera.width)
    depth = depth_colors(drawn.depth.reshape(shape), drawn.opacity.reshape(shape))
    return dict(zip(("truth", "prediction", "error", "depth"), [*compared, depth]))


def compare(
    module: DynamicSceneModule, target: Target, camera: Camera, snapshot: Snapshot | None = None
) -> tuple[list[Tensor], Rendering]:
    """Draw truth, prediction and error, each (h, w, 3) in [0, 1], of an image; return the rendering too.

    Args:
        module: the fitted scene.
        target: the image.
        camera: its camera, resized to (h, w).
        snapshot: of the image's moment, if already made.
    """
    shape = (camera.height, camera.width)
    drawn = module.render(camera, target.moment, target.background, snapshot)
    predicted = drawn.rgb.reshape(*shape, 3).clamp(0, 1)
    truth = area_means(target.rgb.to(predicted), shape)
    return [truth, predicted, error_colors(truth, predicted)], drawn


@torch.no_grad()
def image_flow(
    module: DynamicSceneModule, camera: Camera, time: float, snapshot: Snapshot | None = None
) -> tuple[Tensor, Tensor]:
    """Render the canonical scene and follow the visible points to ``time``.

    ``snapshot``: of the canonical time, if already made.

    Returns:
        flow (H, W, 2) in pixels, opacity (H, W).
    """
    view = View(camera)
    canonical = Moment(module.curriculum.canonical_time)
    drawn = module.render(view, canonical, torch.zeros(3), snapshot)
    rays = view.rays().to(module.device)
    seen = drawn.opacity > _SEEN
    at = rays.origins[seen] + drawn.depth[seen, None] * rays.directions[seen]
    moved = module.method.trajectories(at, torch.tensor([time], device=at.device))[:, 0]
    flow = drawn.rgb.new_zeros(len(seen), 2)
    flow[seen] = (camera.project(moved)[0] - camera.project(at)[0]).to(flow)
    shape = (camera.height, camera.width)
    return flow.reshape(*shape, 2), drawn.opacity.reshape(shape)


def validation_psnr(module: DynamicSceneModule, targets: Sequence[Target], rays: int) -> float:
    """Return the mean PSNR (dB) of images, each from ``rays`` random pixels, the same in all."""
    values = []
    for target in targets:
        count = target.frame.camera.width * target.frame.camera.height
        pixels = torch.randperm(count, generator=torch.Generator().manual_seed(0))[:rays]
        values.append(float(module.psnr_of(target, pixels)))
    return sum(values) / len(values)


def make_shots(
    path: str,
    frames: int,
    time: float,
    camera: Camera,
    cameras: Sequence[Camera],
    film: FilmPath | None = None,
    seconds: float | None = None,
) -> list[Shot]:
    """Return camera and time of each frame of a video.

    Args:
        path: one of ``PATHS``. ``as_filmed`` goes where the film's camera went, ``stabilised`` smoothly,
            ``lean`` in a figure of eight about it, within the angle that is trusted. ``fixed`` and
            ``trajectories`` go through time, ``orbit`` once around at ``time``, ``both`` once around while
            time passes, ``swing`` to and fro meanwhile, as far as the training cameras stand; of a film
            ``fixed``, ``trajectories`` and ``swing`` stay within the angle that is trusted.
        frames: number of frames.
        time: the time of ``orbit``, in [0, 1].
        camera: camera of the first frame, and its size that of all.
        cameras: the training cameras, from which focus and up direction are computed.
        film: the path of the film's camera, if one took all images.
        seconds: how long the film lasts, if that is known.

    Raises:
        ValueError: for one of ``FILMED`` without ``film``.
    """
    views, times = [camera] * frames, torch.linspace(0, 1, frames).tolist()
    if path in FILMED:
        if film is None:
            expected = f"path: expected {', '.join(PATHS[len(FILMED) : -1])} or {PATHS[-1]}"
            raise ValueError(f"{expected}, as no one camera filmed all of this scene, but got {path!r}")
        views = [film.at(t) if path == "as_filmed" else film.stabilised(t) for t in times]
        if path == "lean":
            loops = max(1, round((seconds or _LOOP) / _LOOP))
            angles = [2 * math.pi * loops * t for t in times]
            eight = [(film.degrees * math.sin(a), 0.5 * film.degrees * math.sin(2 * a)) for a in angles]
            leaning = [film.lean(view, *degrees) for view, degrees in zip(views, eight)]
            views = [film.within(view, t) for view, t in zip(leaning, times)]
        if path != "as_filmed":
            views = film.zoomed(views, times)
        return [(view.resized(camera.width, camera.height), t) for view, t in zip(views, times)]
    if path in ("orbit", "both", "swing"):
        # Leave out the full turn, which repeats the first frame, so that the video loops smoothly.
        turns, cameras = torch.arange(frames, dtype=torch.float64) / frames, list(cameras)
        about = focus_point(cameras), mean_up(cameras)
        views = swing(camera, cameras, *about, turns) if path == "swing" else orbit(camera, *about, turns)
    if film is not None and path in ("fixed", "swing", "trajectories"):
        views = [film.within(view, t) for view, t in zip(views, times)]
    return list(zip(views, [time] * frames if path == "orbit" else times))


def shots_of_views(frames: Sequence[Frame], count: int, size: int) -> list[Shot]:
    """Return camera and time of at most ``count`` images, ``size`` pixels along the longer side, of a film of
    test views.

    They are the views in the order of their times where these are a path: no two at one time, and from one to
    the next less than half as far as between any two, in the mean. Else the first camera, through time.
    """
    ordered = sorted(frames, key=lambda frame: frame.time)
    if len({frame.time for frame in ordered}) == len(ordered) > 2:
        centers = torch.stack([frame.camera.center.double() for frame in ordered])
        step = (centers[1:] - centers[:-1]).norm(dim=-1).mean()
        if step <= torch.pdist(centers).mean() / 2:
            chosen = [ordered[i] for i in spread(len(ordered), min(count, len(ordered)))]
            return [(within(frame.camera, size), frame.time) for frame in chosen]
    camera = within(frames[0].camera, size)
    return make_shots("fixed", count, 0.0, camera, [camera])


@dataclass(frozen=True)
class Filled:
    """Give holes of an image, before a ``background`` (3,), the colours around them, the nearest first; see
    ``video``.
    """

    background: Tensor

    def __call__(self, image: Tensor, drawn: Rendering, camera: Camera, time: float) -> Tensor:
        """Return an image (H, W, 3) without holes."""
        behind, shape = self.background.to(image)[:, None, None], image.shape[:2]
        opacity = drawn.opacity.reshape(1, *shape).clamp(0, 1).to(image)
        seen = torch.cat([image.permute(2, 0, 1) - (1 - opacity) * behind, opacity])[None]
        smaller = seen
        while max(smaller.shape[2:]) > 1:
            smaller = avg_pool2d(smaller, 2, ceil_mode=True)
            around = interpolate(smaller, shape, mode="bilinear", align_corners=False)
            seen = seen + (1 - seen[:, 3:]) * around
        return (seen[0, :3] + (1 - seen[0, 3:]) * behind).permute(1, 2, 0).clamp(0, 1)


def video(
    module: DynamicSceneModule, shots: Sequence[Shot], background: Tensor, paints: Sequence[Paint] = ()
) -> Iterator[Tensor]:
    """Render the images (H, W, 3) in [0, 1] of a video one by one, with one snapshot for each time.

    Args:
        module: the fitted scene.
        shots: camera and time of each image.
        background: colour (3,).
        paints: draw over each image, in their order; see ``Trajectories``, ``Fade``.
    """
    snapshot = None
    for camera, time in shots:
        moment = Moment(time)
        with torch.no_grad():
            if snapshot is None or not snapshot.holds(moment):
                snapshot = module.method.at(moment)
            drawn = snapshot.render(View(camera), background)
            image = drawn.rgb.reshape(camera.height, camera.width, 3).clamp(0, 1)
            for paint in paints:
                image = paint(image, drawn, camera, time)
        yield image


@torch.no_grad()
def moving_share(method: Method, moving: Tensor, camera: Camera, time: float) -> Tensor:
    """Render which share (H, W) in [0, 1] of each pixel is what moves, the particles ``moving`` (N,) bool."""
    share = method.at(Moment(time)).share(View(camera), moving)
    return share.reshape(camera.height, camera.width)


class TrainingImages(lightning.Callback):
    """Draw one view at a few moments of a stage, and log ``val/psnr`` of a few validation views.

    Images go to the loggers and into the stage's ``images/``. Training is not changed: the clock is paused
    and no random number is drawn.

    Args:
        moments: fractions of the stage at which to draw.
        view: index of the validation image, or of the training image if there are none; None: the middle.
        size: most pixels of the longer side.
        psnr_views: validation views, spread over the split, for ``val/psnr``; 0: no ``val/psnr``.
        psnr_rays: pixels rendered of each of these views.
    """

    def __init__(
        self,
        *,
        moments: Sequence[float] = (0.1, 0.25, 0.5, 0.75, 1.0),
        view: int | None = None,
        size: int = 400,
        psnr_views: int = 4,
        psnr_rays: int = 4096,
    ) -> None:
        are_numbers = isinstance(moments, Sequence) and all(map(is_number, moments))
        if not are_numbers or not all(0 <= moment <= 1 for moment in moments):
            expected = "callbacks.pictures.moments: expected a list of numbers in [0, 1]"
            raise ValueError(f"{expected}, but got {moments!r:.80}")
        if psnr_views < 0 or psnr_rays < 1:
            expected, got = "psnr_views >= 0 and psnr_rays >= 1", f"{psnr_views=}, {psnr_rays=}"
            raise ValueError(f"callbacks.pictures: expected {expected}, but got {got}")
        self.moments, self.view, self.size = sorted(moments), view, size
        self.psnr_views, self.psnr_rays = psnr_views, psnr_rays
        self._due: list[float] = []

    def on_train_start(self, trainer, module) -> None:
        """Drop the moments that a resumed run is past."""
        done = module.fraction
        self._due = [moment for moment in self.moments if moment >= done]

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Draw if a moment is reached."""
        self._draw_if_due(trainer, module)

    def on_train_end(self, trainer, module) -> None:
        """Draw the last images: a stage bounded by minutes ends between two steps."""
        self._draw_if_due(trainer, module)

    def _draw_if_due(self, trainer, module) -> None:
        passed = [moment for moment in self._due if moment <= module.fraction]
        if not passed:
            return
        self._due = self._due[len(passed) :]
        folder, number = Path(trainer.default_root_dir) / "images", f"{round(100 * passed[-1]):03d}"
        with module.clock.paused():
            for name, image in images_of(module, self._target(trainer.datamodule), self.size).items():
                write_png(folder / f"{number}_{name}.png", image)
                module.trackers.log_image(f"images/{name}", image, module.global_step)
            views = trainer.datamodule.targets("val")
            count = min(self.psnr_views, len(views))
            if trainer.loggers and count:
                chosen = [views[i * len(views) // count] for i in range(count)]
                psnr = validation_psnr(module, chosen, self.psnr_rays)
                module.trackers.log({"val/psnr": psnr}, module.global_step)

    def _target(self, datamodule) -> Target:
        targets = datamodule.targets("val" if datamodule.scene.val else "train")
        view, last = len(targets) // 2 if self.view is None else self.view, len(targets) - 1
        if not 0 <= view <= last:
            raise ValueError(f"callbacks.pictures.view: expected 0 to {last}, but got {view}; use null")
        return targets[view]
