"""Render videos of a fitted scene: through time, around it, or both at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from forewarp.scene.camera import Camera, focus_point, mean_up, orbit, swing
from forewarp.scene.view import Moment, Rendering, View
from forewarp.training.module import DynamicSceneModule

PATHS = ("fixed", "swing", "orbit", "both", "trajectories")

Shot = tuple[Camera, float]  # camera and time
Paint = Callable[[Tensor, Rendering, Camera, float], Tensor]


def make_shots(path: str, frames: int, time: float, camera: Camera, cameras: Sequence[Camera]) -> list[Shot]:
    """Return camera and time of each frame of a video.

    Args:
        path: ``fixed`` and ``trajectories`` go through time, ``orbit`` once around at ``time``, ``both`` once
            around while time passes, ``swing`` to and fro meanwhile, as far as the training cameras stand.
        frames: number of frames.
        time: the time of ``orbit``, in [0, 1].
        camera: camera of the first frame.
        cameras: the training cameras, from which focus and up direction are computed.

    Raises:
        ValueError: for another path.
    """
    if path not in PATHS:
        raise ValueError(f"path: expected one of {', '.join(PATHS)}, but got '{path}'")
    views, times = [camera] * frames, torch.linspace(0, 1, frames).tolist()
    if path in ("orbit", "both", "swing"):
        # Leave out the full turn, which repeats the first frame, so that the video loops smoothly.
        turns, cameras = torch.arange(frames, dtype=torch.float64) / frames, list(cameras)
        about = focus_point(cameras), mean_up(cameras)
        views = swing(camera, cameras, *about, turns) if path == "swing" else orbit(camera, *about, turns)
    return list(zip(views, [time] * frames if path == "orbit" else times))


def video(
    module: DynamicSceneModule, shots: Sequence[Shot], background: Tensor, paint: Paint | None = None
) -> Iterator[Tensor]:
    """Render the images (H, W, 3) in [0, 1] of a video one by one, with one snapshot for each time.

    Args:
        module: the fitted scene.
        shots: camera and time of each image.
        background: colour (3,).
        paint: draws over an image; see ``Trajectories``.
    """
    snapshot = None
    for camera, time in shots:
        moment = Moment(time)
        with torch.no_grad():
            if snapshot is None or not snapshot.holds(moment):
                snapshot = module.method.at(moment)
            drawn = snapshot.render(View(camera), background)
            image = drawn.rgb.reshape(camera.height, camera.width, 3).clamp(0, 1)
            image = image if paint is None else paint(image, drawn, camera, time)
        yield image
