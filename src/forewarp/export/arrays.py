"""``format=npz``: trajectories with what some cameras see of them, and the method's own arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forewarp.drawing.images import hidden
from forewarp.evaluation.images import within
from forewarp.export.source import Progress, Source, Tracks, tracks_of
from forewarp.scene.camera import Camera
from forewarp.scene.frame import spread
from forewarp.scene.view import Moment, View

_SIZE = 200  # most pixels of the pictures that tell what is hidden
_SLACK = 1.5  # sizes of a point that it may lie behind the surface


def export_npz(source: Source, folder: Path, progress: Progress, *, points: int, views: int) -> dict:
    """Write ``trajectories.npz`` and ``method.npz``; ``docs/exports.md`` lists what they hold.

    Args:
        source: the scene and its times.
        folder: to write into.
        progress: told after each time.
        points: most points.
        views: number of training cameras that look.

    Returns:
        what ``about.json`` says of it.

    Raises:
        ValueError: for a method whose points cannot be followed.
    """
    source.refuse_without_tracks("npz")
    tracks = tracks_of(source, points)
    numbers = spread(len(source.cameras), views)
    cameras = [source.cameras[i] for i in numbers]
    visible = visible_from(source, tracks, cameras, progress)
    np.savez_compressed(
        folder / "trajectories.npz",
        canonical_time=np.float32(source.module.curriculum.canonical_time),
        points=tracks.points.numpy(),
        times=tracks.times.numpy(),
        positions=tracks.positions.transpose(0, 1).numpy(),
        colors=tracks.colors.expand(len(tracks.times), -1, -1).transpose(0, 1).numpy(),
        opacity=tracks.opacity.expand(len(tracks.times), -1).T.numpy(),
        visible=visible.numpy(),
        cameras=np.array(numbers),
        camera_to_world=torch.stack([c.camera_to_world.double() for c in cameras]).numpy(),
        intrinsics=np.array([[[c.fx, c.skew, c.cx], [0, c.fy, c.cy], [0, 0, 1]] for c in cameras]),
        image_size=np.array([[c.width, c.height] for c in cameras]),
        lens=np.array([(0.0,) * 5 if c.lens is None else (*c.lens.k, *c.lens.p) for c in cameras]),
    )
    state = source.method.state_dict()
    own = {name: value.cpu().numpy() for name, value in state.items() if isinstance(value, Tensor)}
    np.savez_compressed(folder / "method.npz", **own)
    return {
        "points": len(tracks),
        "views": len(cameras),
        "visible": float(visible.float().mean()),
        "colors": "sRGB, as in the pictures",
    }


@torch.no_grad()
def visible_from(source: Source, tracks: Tracks, cameras: list[Camera], progress: Progress) -> Tensor:
    """Which points are seen at which time by which camera, (N, T, V) bool: they lie before it, inside its
    picture, and not behind what it shows by more than 1.5 of their sizes. Pictures of 200 pixels tell.

    Cost: a small picture for each time and camera.
    """
    seen = torch.zeros(len(tracks), len(tracks.times), len(cameras), dtype=torch.bool)
    small, black = [within(camera, _SIZE) for camera in cameras], torch.zeros(3)
    for row, time in enumerate(source.times):
        snapshot = source.method.at(Moment(time))
        places = tracks.positions[row]
        for column, camera in enumerate(small):
            drawn = snapshot.render(View(camera), black.to(source.module.device))
            depth = torch.where(drawn.opacity > 0.5, drawn.depth, float("inf")).cpu()
            pixels, ahead = camera.project(places)
            inside = (pixels >= 0) & (pixels < pixels.new_tensor([camera.width, camera.height]))
            away = (places - camera.center.to(places)).norm(dim=-1)
            behind = hidden(pixels, away, depth.reshape(camera.height, camera.width), _SLACK * tracks.size)
            seen[:, row, column] = (ahead > 0) & inside.all(-1) & ~behind
        progress(row + 1, len(source.times))
    return seen
