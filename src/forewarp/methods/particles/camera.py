"""A scene's camera as the operators of particles read it."""

from __future__ import annotations

import torch

from forewarp.ops.gaussians import Pinhole
from forewarp.scene.camera import Camera

_NEAR, _LEAST = 0.1, 0.02  # of the camera's near, and at least of its far: closer particles fill the picture
_BESIDE = 0.125  # share of the longer side; what lies farther beside the picture is left out
_SLACK = 1.3  # of the square from the axis that a lens's picture reaches
_BORDER = 16  # points along each side of a picture


class Pinholes:
    """Makes the ``Pinhole`` of a camera, once. ``blur``: square pixels added to every splat."""

    def __init__(self, blur: float) -> None:
        self.blur = blur
        self._known: dict[int, tuple[Camera, Pinhole]] = {}

    def __call__(self, camera: Camera) -> Pinhole:
        """The pinhole; a camera is known by its identity."""
        found = self._known.get(id(camera))
        if found is None or found[0] is not camera:
            if len(self._known) > 4096:
                self._known.clear()
            found = self._known[id(camera)] = camera, pinhole_of(camera, self.blur)
        return found[1]


def pinhole_of(camera: Camera, blur: float) -> Pinhole:
    """See ``Pinholes``."""
    pose = camera.camera_to_world.double()
    lens = camera.lens
    return Pinhole(
        tuple(pose[:3, :3].T.flatten().tolist()),
        tuple(pose[:3, 3].tolist()),
        (camera.fx, camera.fy),
        (camera.cx, camera.cy),
        (camera.width, camera.height),
        max(_NEAR * camera.near, _LEAST * camera.far),
        skew=camera.skew,
        blur=blur,
        margin=_BESIDE * max(camera.width, camera.height),
        radial=(0.0, 0.0, 0.0) if lens is None else lens.k,
        tangential=(0.0, 0.0) if lens is None else lens.p,
        reach=1e8 if lens is None else _reach(camera),
    )


def _reach(camera: Camera) -> float:
    """How far from the axis, squared, the plane's points lie that the picture shows, and a little more."""
    share = torch.linspace(0, 1, _BORDER, dtype=torch.float64)
    across, down = share * camera.width, share * camera.height
    zero = torch.zeros_like(share)
    u = torch.cat([across, across, zero, zero + camera.width])
    v = torch.cat([zero, zero + camera.height, down, down])
    y = (v - camera.cy) / camera.fy
    x = (u - camera.cx - camera.skew * y) / camera.fx
    return _SLACK * float(camera.lens.straighten(torch.stack([x, y], -1)).square().sum(-1).max())
