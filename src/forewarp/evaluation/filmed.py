"""Let images fade where they leave what was filmed: beyond all images' edges, and seen from other sides."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from forewarp.scene.camera import Camera
from forewarp.scene.frame import spread
from forewarp.scene.view import Rendering, View

_CAMERAS = 48  # training cameras that are asked
_STEP = 4  # pixels between two places that are looked at
_MARGIN = 0.1  # share of a training image's longer side, outside of which nothing is left
_BESIDE, _ASIDE = 30.0, 60.0  # degrees from the nearest camera's direction: all is left, nothing
_TOLD = 0.01  # share of an image from which on it counts as faded


class Fade:
    """Paint over an image what no training camera has in its view; see ``evaluation.images.video``.

    A pixel fades to black within a tenth of a training image beyond its edge, and from 30 to 60 degrees
    beside the directions from which training cameras saw the place. That something stood before it in all of
    them is not noticed. ``shares`` has the share of each painted image that is faded.

    Args:
        cameras: of training; some are asked where there are many.
    """

    def __init__(self, cameras: Sequence[Camera]) -> None:
        self.cameras = [cameras[i] for i in spread(len(cameras), _CAMERAS)]
        self.shares: list[float] = []

    def __call__(self, image: Tensor, drawn: Rendering, camera: Camera, time: float) -> Tensor:
        """Return an image (H, W, 3), faded."""
        kept = self.kept(drawn, camera)
        self.shares.append(float((kept < 0.5).float().mean()))
        return image * kept[..., None].to(image)

    def kept(self, drawn: Rendering, camera: Camera) -> Tensor:
        """Return how much is left of each pixel, (H, W) in [0, 1]."""
        shape = camera.height, camera.width
        rows = torch.arange(0, camera.height, _STEP)
        columns = torch.arange(0, camera.width, _STEP)
        pixels = (rows[:, None] * camera.width + columns).flatten()
        rays = View(camera, pixels).rays()
        # Where hardly anything is, what there is may stand anywhere.
        depth = torch.where(drawn.opacity > 0.5, drawn.depth, camera.far).cpu()[pixels]
        points = rays.origins + depth[:, None] * rays.directions
        kept = torch.zeros(len(points))
        for filmed in self.cameras:
            places, ahead = filmed.project(points)
            size = torch.tensor([filmed.width, filmed.height]).to(places)
            outside = torch.maximum(-places, places - size).amax(-1) / (_MARGIN * float(size.max()))
            towards = torch.nn.functional.normalize(points - filmed.center.to(points), dim=-1)
            cosine = (towards * rays.directions).sum(-1).clamp(-1, 1)
            beside = (torch.rad2deg(torch.acos(cosine)) - _BESIDE) / (_ASIDE - _BESIDE)
            shown = (1 - outside).clamp(0, 1) * (1 - beside).clamp(0, 1)
            kept = torch.maximum(kept, torch.where(ahead > 0, shown, 0.0).float())
        kept = kept.reshape(1, 1, len(rows), len(columns))
        return interpolate(kept, shape, mode="bilinear", align_corners=False)[0, 0]

    def told(self) -> str | None:
        """Say which images left what was filmed; None where none did."""
        gone = [share for share in self.shares if share > _TOLD]
        if not gone:
            return None
        many, most = f"{len(gone)} of {len(self.shares)} images", f"up to {max(gone):.0%} of one"
        faded = "it fades to black (path=as_filmed stays where it was filmed)"
        return f"{many} show what no training image shows, {most}: {faded}"
