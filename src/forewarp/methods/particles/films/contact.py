"""Where what moves begins in a film of one camera: standing on what rests.

One camera cannot tell how far away a thing is that moves by itself: neighbouring images agree on a depth that
its own motion feigns, and later images do not correct it. But things stand, lie or roll on a ground, whose
depth is known from many images: that of the ground right below the lower edge of a thing is about its own.
What flies is set on what lies below it in the image, and what something hides below on that.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from forewarp.methods.particles.start import SMALL_MOVERS, first_values
from forewarp.ops.grid import dilate
from forewarp.scene.cloud import Cloud
from forewarp.scene.frame import Frame, Scene, where_seen
from forewarp.scene.view import Rendering

# Share of an image's pixels, below which a patch of a mask is no thing.
_SMALLEST = 1e-3
# Share of a thing's height, above its lowest row, within which columns end that touch the ground.
_LOWEST = 0.2
# Shares of an image's height: by which a look goes below a thing's lower edge; by which its mask is enlarged,
# as what stood in for it is blurred; and between new particles, whose deviation is ``_ROUND`` of that.
_BELOW, _EDGE, _STEP, _ROUND = 8e-3, 6e-3, 4e-3, 0.7
# Shares of the ground's distance, from which on particles lie behind a thing, and beside it.
_BEHIND, _BESIDE = 1.05, 0.95
_OPACITY = 2.0  # logit, of a new particle
_SEEN = 0.5  # opacity from which on the ground is known


@torch.no_grad()
def place_on_ground(
    values: dict[str, Tensor],
    scene: Scene,
    draw: Callable[[Frame], Rendering],
    light_of: Callable[[Frame], Tensor | None],
) -> dict[str, Tensor]:
    """Put what the canonical image's mask says moves at the distance of the ground that it stands on.

    What has no ground in sight, as it (nearly) reaches the lower edge of the image, stays as it is.

    Args:
        values: of the N first particles, by name.
        scene: of one camera, with masks of what moves and no measured depth; else nothing changes.
        draw: renders the particles of the stage before, which were fitted at rest and show the ground, as an
            image shows them, (H, W).
        light_of: returns gain and bias (2, 3) of an image's colours; None: 1 and 0.

    Returns:
        the values, without particles that stood in for these things, and with new ones last; ``is_placed``,
        bool of each, says which are new, and ``body_of``, int64, which body each is of, -1: of none. Bodies
        are things of films whose movers are small: what fills an image, as a hand, is mostly not rigid. Where
        nothing changes, the values as they are.

    Cost: an image is rendered.
    """
    frame = min(scene.train, key=lambda frame: abs(frame.time - scene.canonical_time))
    if frame.load_moving is None or frame.load_sensed is not None or not scene.has_one_camera:
        return values
    camera, height = frame.camera, frame.camera.height
    means, moving = values["means"], frame.load_moving()
    depth = known_depth(draw(frame))
    if frame.load_valid is not None:
        depth[~frame.load_valid()] = 0.0
    step, edge = max(1, round(_STEP * height)), max(1, round(_EDGE * height))
    row, column, visible = where_seen(camera, means)
    row, column = row.clamp(0, height - 1), column.clamp(0, camera.width - 1)
    away, gone = (means - camera.center.float()).norm(dim=-1), torch.zeros(len(means), dtype=torch.bool)
    ground = torch.zeros_like(depth)  # of pixels on whose grid new particles lie
    bulge, things = torch.zeros_like(depth), torch.full(depth.shape, -1)
    for thing, distance in things_on_the_ground(moving, depth):
        if bool(thing[::step, ::step].any()):
            ground[thing], things[thing] = distance, int(things.max()) + 1
            bulge[thing] = distance / camera.fx * _bulge(thing)[thing]
            beside = dilate(thing, edge) & ~moving
            gone |= visible & thing[row, column] & (away < _BEHIND * distance)
            gone |= visible & beside[row, column] & (away < _BESIDE * distance)
    if not bool(ground.any()):
        return values
    if "shared" in values:
        gone &= values["shared"] < 0
    fresh, kept = _pieces(frame, ground, bulge, step, light_of(frame)), {}
    count = len(fresh["means"])
    for name, value in values.items():
        if name == "exposure":
            kept[name] = value
        else:
            empty = value.new_full((count, *value.shape[1:]), -1 if name == "shared" else 0)
            kept[name] = torch.cat([value[~gone], fresh.get(name, empty)])
    of = things[::step, ::step][ground[::step, ::step] > 0]
    if float(moving.float().mean()) > SMALL_MOVERS:
        of = torch.full_like(of, -1)
    kept["body_of"] = torch.cat([torch.full((len(kept["means"]) - count,), -1), of])
    kept["is_placed"] = torch.arange(len(kept["means"])) >= len(kept["means"]) - count
    return kept


def known_depth(drawn: Rendering) -> Tensor:
    """Return the depth along rays of what is drawn, world units; 0 where it is less than half opaque."""
    return torch.where(drawn.opacity > _SEEN, drawn.depth, 0.0)


def things_on_the_ground(moving: Tensor, depth: Tensor) -> list[tuple[Tensor, float]]:
    """Tell the things that move in an image apart, and how far away the ground is that each stands on.

    Args:
        moving: (H, W) bool, what moves.
        depth: (H, W) distances along rays to what rests, world units, 0 where not known.

    Returns:
        masks (H, W) bool, and distances; nothing of what reaches the lower edge of the image, or stands
        mostly on what is not known.
    """
    height, found = len(depth), []
    below = max(1, round(_BELOW * height))
    for thing in _patches_of(moving):
        rows = thing.any(1).nonzero()[:, 0]
        top, bottom = int(rows[0]), int(rows[-1])
        if bottom + below >= height:
            continue
        lowest = torch.where(thing, torch.arange(height)[:, None], -1).amax(0)  # of each column
        columns = (lowest >= bottom - _LOWEST * (bottom - top)).nonzero()[:, 0]
        at = lowest[columns] + below
        ground = torch.where(moving[at, columns], 0.0, depth[at, columns])
        known = ground[ground > 0]
        if 2 * len(known) >= len(ground):
            found.append((thing, float(known.median())))
    return found


def _patches_of(moving: Tensor) -> list[Tensor]:
    """Tell the patches of a mask (H, W) bool apart: a mask of each that is not tiny."""
    from scipy.ndimage import label  # late, as its import takes time

    labels = torch.from_numpy(label(moving.numpy(), torch.ones(3, 3))[0])
    large = labels.flatten().bincount() >= _SMALLEST * labels.numel()
    return [labels == number for number in large.nonzero()[:, 0].tolist() if number]


def _bulge(thing: Tensor) -> Tensor:
    """Return how far the middle of a thing (H, W) bool stands out before its edge, pixels: as of a ball.

    Of what is flat, an image does not tell which way it turns; what is solid bulges towards the camera.
    """
    from scipy.ndimage import distance_transform_edt  # late, as above

    inside = torch.from_numpy(distance_transform_edt(thing.numpy())).float()
    radius = float(inside.amax())
    return (radius**2 - (radius - inside) ** 2).sqrt()


def _pieces(
    frame: Frame, ground: Tensor, bulge: Tensor, step: int, light: Tensor | None
) -> dict[str, Tensor]:
    """Make particles at the distances (H, W), not 0, of every ``step``-th pixel, less the ``bulge`` (H, W),
    coloured like an image without its ``light``.
    """
    camera = frame.camera
    rows, columns = (step * ground[::step, ::step].nonzero()).unbind(-1)
    rays, distance = camera.rays(rows * camera.width + columns), ground[rows, columns]
    colors = frame.load()[rows, columns, :3].float() / 255
    if light is not None:
        gain, bias = light.cpu()
        colors = (colors - bias) / gain
    spacing = step * distance / camera.fx
    distance = distance - bulge[rows, columns]
    cloud = Cloud(
        rays.origins + distance[:, None] * rays.directions, colors, distance, float(spacing.median())
    )
    values = first_values(cloud, _ROUND * spacing)
    values["opacity"] += _OPACITY
    return values
