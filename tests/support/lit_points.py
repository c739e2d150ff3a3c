"""Expected colours of surface points, and which of them a camera sees."""

import numpy as np
import torch

from forewarp.synth.raycast import Hits, Posed, light_points


def lit_points(world, faces, barycentric, time, center):
    """Return colours (N, 3) in [0, 1] at ``time``, and whether each is visible from ``center`` (3,)."""
    posed = Posed(world, time)
    hits = Hits(np.arange(len(faces)), faces, barycentric, np.zeros(len(faces)))
    points = world.points(faces, barycentric, time)
    away = points - center
    distance = np.linalg.norm(away, axis=-1)
    first = posed.first_hits(np.broadcast_to(center, points.shape), away / distance[:, None])
    visible = np.zeros(len(faces), dtype=bool)
    visible[first.ray] = np.abs(first.distance - distance[first.ray]) < 1e-3
    return posed.color(hits, light_points(24)), visible


def color_errors(rgb, camera, points, colors):
    """Return the colour errors (M,) of the pixels that show the points (N, 3) inside the image."""
    pixel, depth = camera.project(points.double())
    size = torch.tensor([camera.width, camera.height])
    inside = ((pixel > 0) & (pixel < size)).all(-1) & (depth > 0)
    column, row = pixel[inside].floor().long().unbind(-1)
    seen = rgb[row, column, :3].double().numpy() / 255
    return np.abs(seen - colors[inside.numpy()]).mean(-1)
