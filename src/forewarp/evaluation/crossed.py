"""Score where a film took no image, by the film itself: the geometry of one time, from the camera of another.

What rests looks the same at all times. So an image that was held out says how what rests should look in the
geometry of any other time, from where no image of that time was taken: motion that feigns depth fits each
image where it was taken, and breaks here.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from forewarp.methods.method import HasMovingGaussians, Method
from forewarp.metrics.image import psnr
from forewarp.metrics.registry import CROSSED
from forewarp.ops.grid import dilate
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame, Scene, instants_of, spread, where_seen
from forewarp.scene.view import Moment, Rendering, Target, View

LAG = 20  # instants, at least, between geometry and camera
_EACH, _FEW = 8, 3  # instants, and held-out images; of methods that render slowly
_GROWN = 8  # pixels by which masks of what moves are enlarged
_CAMERAS = 4  # of an instant that say what moved, where the image's own camera has none
_LEAST = 5e-3  # share of an image's pixels, of which fewer are not scored


@torch.no_grad()
def crossed_scores(
    method: Method, scene: Scene, targets: Sequence[Target], numbers: Sequence[int]
) -> tuple[list[tuple[str, dict[str, float]]], str | None]:
    """Score held-out images in the geometry of times at least ``LAG`` instants away, in their own light.

    Pixels count that rest in the image, and that nothing hides which moves at the other time: those beside
    the image's own mask and beside the other one's, carried over by the rendered depth.

    Args:
        method: the fitted method.
        scene: its scene.
        targets: the held-out images.
        numbers: those of them that are scored.

    Returns:
        rows for ``summarise``: PSNR of each pair as ``crossed``, and with the image's own geometry, on the
        same pixels, as ``crossed_own``; and why there are none, else None.

    Cost: some 60 images; of methods that do not rasterise a dozen.
    """
    frames = [*scene.train, *(targets.frames[number] for number in numbers)]
    instants = instants_of(frames)
    order = {time: place for place, time in enumerate(sorted({*instants}))}
    masked: dict[int, list[Frame]] = {}
    for frame, time in zip(frames, instants):
        if frame.load_moving is not None:
            masked.setdefault(order[time], []).append(frame)
    shown = [number for number in numbers if targets.frames[number].load_moving is not None]
    if not shown or not masked:
        return [], "no mask says what moves"
    if len(order) <= LAG:
        return [], f"of {len(order)} times, none is {LAG} away from another"
    each = _EACH if isinstance(method, HasMovingGaussians) else _FEW
    rows: list[tuple[str, dict[str, float]]] = []
    of_number = dict(zip(numbers, instants[len(scene.train) :]))
    places = [sorted(masked)[i] for i in spread(len(masked), each)]
    moved: dict[str, Tensor] = {}
    for number in (shown[i] for i in spread(len(shown), each)):
        target = targets[number]
        here, camera, own = order[of_number[number]], target.frame.camera, None
        still = ~dilate(target.moving, _GROWN)
        if target.valid is not None:
            still &= target.valid
        for place in places:
            if abs(place - here) < LAG:
                continue
            chosen = still.clone()
            for frame in _seen_then(masked[place], target.frame.camera_id):
                if frame.name not in moved:
                    moved[frame.name] = moving_places(method, frame)
                chosen &= ~covered(camera, moved[frame.name])
            if int(chosen.sum()) < _LEAST * chosen.numel():
                continue
            background = target.background.to(method.device)
            if own is None:
                own = image_at(method, target.frame, target.frame.time, background).rgb
            other = image_at(method, target.frame, masked[place][0].time, background).rgb
            for kind, image in zip(CROSSED, (other, own)):
                rows.append((kind, {"psnr": psnr(image[chosen][None], target.rgb[chosen][None])}))
    return rows, None if rows else "hardly any pixel rests"


def _seen_then(frames: Sequence[Frame], camera: int | None) -> list[Frame]:
    """Return those of an instant's frames that the same camera took, else some of the others."""
    same = [frame for frame in frames if frame.camera_id == camera]
    return same or [frames[i] for i in spread(len(frames), _CAMERAS)]


def drop_of(test: dict[str, dict[str, float]]) -> float | None:
    """Return by how much less than in their own geometry images score ``crossed``, dB; None if not known."""
    crossed, own = (test.get(kind, {}).get("psnr") for kind in CROSSED)
    return None if crossed is None or own is None else own - crossed


def image_at(
    method: Method, frame: Frame, time: float, background: Tensor, camera: Camera | None = None
) -> Rendering:
    """Render the geometry of a time in the light of a frame, by its camera or another one: (H, W)."""
    camera = camera or frame.camera
    moment = Moment(time, camera=frame.camera_id, filmed=True, lit=frame.time)
    return method.at(moment).render(View(camera), background).shaped(camera.height, camera.width)


def moving_places(method: Method, frame: Frame) -> Tensor:
    """Return where (P, 3) the pixels lie that move in a frame, by the rendered depth."""
    drawn = image_at(method, frame, frame.time, torch.zeros(3, device=method.device))
    pixels = (frame.load_moving() & (drawn.depth > 0)).flatten().nonzero()[:, 0]
    rays = frame.camera.rays(pixels)
    return rays.origins + drawn.depth.flatten()[pixels, None] * rays.directions


def covered(camera: Camera, places: Tensor) -> Tensor:
    """Return the pixels (H, W) bool that places (P, 3) cover, enlarged."""
    row, column, seen = where_seen(camera, places)
    mask = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    mask[row[seen], column[seen]] = True
    return dilate(mask, _GROWN)
