"""Surface points as a camera must see them: their lit colours, and which of them nothing hides."""

import numpy as np
import torch

from forewarp.synth.raycast import Hits, Posed, light_points


def lit_points(world, faces, barycentric, time, center):
    """Colours (N, 3) in [0, 1] at ``time`` and whether ``center`` (3,), in the vehicle's units, sees them."""
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
    """How far pixels are from the ``colors`` of the points (N, 3) there, (M,) for those in the picture."""
    pixel, depth = camera.project(points.double())
    size = torch.tensor([camera.width, camera.height])
    inside = ((pixel > 0) & (pixel < size)).all(-1) & (depth > 0)
    column, row = pixel[inside].floor().long().unbind(-1)
    seen = rgb[row, column, :3].double().numpy() / 255
    return np.abs(seen - colors[inside.numpy()]).mean(-1)
