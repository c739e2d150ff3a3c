"""A scene as one method has it: every picture of it that a page can ask for."""

from __future__ import annotations

import time as clock
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import TypeVar

import torch
from torch import Tensor

from forewarp.drawing.images import depth_colors, flow_colors, with_wheel
from forewarp.evaluation.images import compare, image_flow
from forewarp.evaluation.trajectories import Trajectories
from forewarp.methods.method import HasEllipsoids, HasMatter, HasTrajectories, Snapshot
from forewarp.scene.camera import Camera
from forewarp.scene.cloud import Ellipsoids
from forewarp.scene.view import Moment, Rendering, View
from forewarp.training.module import DynamicSceneModule
from forewarp.viewer.desk import Stale, Superseded
from forewarp.viewer.look import SPLATS, Look, Point

_KEPT = 2  # snapshots: of the time shown, and of the canonical time
_KEPT_PATHS = 4  # of followed points, which pages share
_KEPT_POINTS = 64
_FOLLOWED = {"tail": 1.0, "width": 0.008}
Value = TypeVar("Value")
_SOLID = 0.5  # opacity from which a pixel shows something that can be followed


class Subject:
    """A fitted method, or one in training, and its scene. One thread alone may draw it.

    Args:
        name: what pages call it.
        module: the fitted module.
        datamodule: serves the scene and the training images.
        count, tail: see ``Trajectories``.
        fresh: seconds after which points of a method in training are chosen anew.
    """

    def __init__(
        self,
        name: str,
        module: DynamicSceneModule,
        datamodule,
        *,
        count: int = 300,
        tail: float = 0.5,
        fresh: float = float("inf"),
    ) -> None:
        self.name, self.module, self.scene = name, module, datamodule.scene
        self.targets = datamodule.targets("train")
        self.background = self.targets.background
        self.count, self.tail, self.fresh = count, tail, fresh
        self._snapshots: OrderedDict[Moment, Snapshot] = OrderedDict()
        self._trajectories: tuple[float, Trajectories] | None = None
        self._canonical: OrderedDict[tuple[Point, float], Tensor] = OrderedDict()
        self._followed: OrderedDict[tuple, Trajectories] = OrderedDict()

    @property
    def follows(self) -> bool:
        """Whether the method follows points."""
        return isinstance(self.module.method, HasTrajectories) and isinstance(self.module.method, HasMatter)

    @property
    def shows(self) -> tuple[str, ...]:
        """What can be shown of it."""
        more = ("motion",) if isinstance(self.module.method, HasTrajectories) else ()
        return ("colour", "depth", "opacity", *more, *((SPLATS,) if self.has_splats else ()))

    @property
    def has_splats(self) -> bool:
        """Whether a browser can draw it."""
        return isinstance(self.module.method, HasEllipsoids)

    def forget(self) -> None:
        """Forget what was computed from the method's parameters, which have changed."""
        self._snapshots.clear()
        self._canonical.clear()
        self._followed.clear()
        if self._trajectories is not None:
            self._trajectories[1].forget()

    @torch.no_grad()
    def freeze(self, moment: Moment) -> Snapshot:
        """Return the snapshot of a moment; the last two are kept."""
        for known, snapshot in self._snapshots.items():
            if snapshot.holds(moment):
                self._snapshots.move_to_end(known)
                return snapshot
        return kept(self._snapshots, moment, lambda: self.module.method.at(moment), _KEPT)

    def prepare(self, look: Look) -> None:
        """Compute what a picture needs besides its pixels."""
        self.freeze(self._moment(look))
        if look.show == "motion" and look.stand is None:
            self.freeze(self._at_first)

    @property
    def _at_first(self) -> Moment:
        return Moment(self.module.curriculum.canonical_time)

    def _moment(self, look: Look) -> Moment:
        return Moment(look.time) if look.stand is None else self.targets[look.stand].moment

    @torch.no_grad()
    def picture(self, look: Look, camera: Camera, stale: Stale, parts: int = 1) -> Tensor:
        """Draw what a look shows, (H, W, 3) in [0, 1] on the CPU.

        Args:
            look: what to show.
            camera: from where, and how large.
            stale: tells whether the picture is still wanted.
            parts: how many parts to draw it in, between which ``stale`` is asked.

        Raises:
            Superseded: if it is no longer wanted.
        """
        shape = camera.height, camera.width
        if look.show == "motion":
            flow, opacity = image_flow(self.module, camera, look.time, self.freeze(self._at_first))
            return with_wheel(flow_colors(flow, opacity)).cpu()
        drawn = self.render(camera, look.time, stale, parts)
        picture = drawn.rgb.reshape(*shape, 3).clamp(0, 1)
        if look.show == "depth":
            picture = depth_colors(drawn.depth.reshape(shape), drawn.opacity.reshape(shape))
        elif look.show == "opacity":
            picture = drawn.opacity.clamp(0, 1).reshape(*shape, 1).expand(*shape, 3)
        for paint in self._paints(look):
            picture = paint(picture, drawn, camera, look.time)
        return picture.cpu()

    def render(self, camera: Camera, time: float, stale: Stale = bool, parts: int = 1) -> Rendering:
        """Render a whole picture in parts; see ``picture``."""
        moment = Moment(time)
        snapshot, found = self.freeze(moment), []
        for part in range(parts):
            if stale():
                raise Superseded
            top, end = (camera.height * i // parts for i in (part, part + 1))
            view = View(camera) if parts == 1 else View(camera, crop=(top, 0, end - top, camera.width))
            found.append(self.module.render(view, moment, self.background, snapshot))
        if parts == 1:
            return found[0]
        return Rendering.joined(found)

    def compared(self, stand: int, width: int, height: int) -> list[Tensor]:
        """Draw truth, prediction and error of a training view, as large as fits."""
        target = self.targets[stand]
        camera = target.frame.camera
        scale = min(width / camera.width, height / camera.height)
        sized = camera.resized(*(max(1, int(scale * side)) for side in (camera.width, camera.height)))
        pictures, _ = compare(self.module, target, sized, self.freeze(target.moment))
        return [picture.cpu() for picture in pictures]

    @torch.no_grad()
    def point_at(self, camera: Camera, pixel: tuple[int, int], time: float) -> Point | None:
        """Return the world point that a pixel (column, row) shows; None if it shows nothing solid."""
        row = min(max(pixel[1], 0), camera.height - 1)
        column = min(max(pixel[0], 0), camera.width - 1)
        view = View(camera, torch.tensor([row * camera.width + column]))
        drawn = self.module.render(view, Moment(time), self.background, self.freeze(Moment(time)))
        if float(drawn.opacity) < _SOLID:
            return None
        rays = view.rays()
        return tuple((rays.origins[0] + drawn.depth.cpu() * rays.directions[0]).tolist())

    @torch.no_grad()
    def canonical(self, point: Point, time: float) -> Tensor:
        """Return the canonical point (3,) of the matter that is nearest to a point at a time."""

        def nearest() -> Tensor:
            method = self.module.method
            matter = method.matter().points
            now = method.trajectories(matter, matter.new_tensor([time]))[:, 0]
            return matter[(now - now.new_tensor(point)).norm(dim=-1).argmin()]

        return kept(self._canonical, (point, time), nearest, _KEPT_POINTS)

    def ellipsoids(self, time: float) -> Ellipsoids:
        """Return what a browser draws."""
        with torch.no_grad():
            return self.module.method.ellipsoids(time)

    def _paints(self, look: Look) -> list[Trajectories]:
        if not self.follows:
            return []
        found = [self._all_over()] if look.tails else []
        if look.followed:
            found.append(kept(self._followed, look.followed, lambda: self._paths(look), _KEPT_PATHS))
        return found

    def _paths(self, look: Look) -> Trajectories:
        points = torch.stack([self.canonical(*one) for one in look.followed])
        return Trajectories(self.module, (), points=points, **_FOLLOWED)

    def _all_over(self) -> Trajectories:
        now = clock.monotonic()
        if self._trajectories is None or now - self._trajectories[0] > self.fresh:
            cameras = [frame.camera for frame in self.scene.train]
            made = Trajectories(self.module, cameras, count=self.count, tail=self.tail)
            self._trajectories = now, made
        return self._trajectories[1]


def kept(known: OrderedDict[Hashable, Value], key: Hashable, make: Callable[[], Value], most: int) -> Value:
    """Return what is known of a key, or make it; the ``most`` that were used last are kept.

    >>> known = OrderedDict()
    >>> [kept(known, key, lambda: 10 * key, 2) for key in (1, 2, 1, 3)], list(known)
    ([10, 20, 10, 30], [1, 3])
    """
    if key not in known:
        known[key] = make()
    known.move_to_end(key)
    while len(known) > most:
        known.popitem(last=False)
    return known[key]
