"""What pages see of a scene, or of two runs of it side by side: images, trajectories, training views."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from forewarp.drawing.images import depth_colors, flow_colors, in_a_row, with_wheel
from forewarp.evaluation.images import compare, image_flow
from forewarp.evaluation.layers import LAYERS, layer_of
from forewarp.evaluation.trajectories import Trajectories
from forewarp.methods.method import HasEllipsoids, HasLayers, HasMatter, HasTrajectories, Method, Snapshot
from forewarp.scene.camera import Camera, focus_point, mean_up
from forewarp.scene.film import FilmPath
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Moment, Rendering, View
from forewarp.training.module import DynamicSceneModule
from forewarp.viewer.queue import Cancelled, RenderQueue

SPLATS = "splats"  # drawn by the browser; all other channels are images that the method renders
_MIN_NEAR = 0.01  # of the box's diagonal: nothing nearer to the camera is drawn
_SOLID = 0.5  # opacity from which a pixel shows something that can be followed
_SNAPSHOTS = 2  # that are kept: of the time shown, and of the canonical time
_PATHS, _POINTS = 4, 64  # sets of followed points that are kept, which pages share, and single ones
_FOLLOWED = {"tail": 1.0, "width": 0.008}  # how the trajectory of a followed point is drawn
_MIN_FULL_ROWS = 400  # rows of an image at rest, if the training images have fewer
_SECONDS = 4.0  # in which the whole time of other scenes than films passes
_DARK, _EDGE = 0.05, (1.0, 0.72, 0.42)  # what is around a film's frame, and around what was not filmed
_GAP = 4  # white pixels between two images

Point = tuple[float, float, float]
IsStale = Callable[[], bool]


@dataclass(frozen=True, eq=False)
class ViewState:
    """Where a page stands, and what it wants to see from there.

    Attributes:
        pose: ``camera_to_world`` (4, 4), float64.
        fov: vertical, radians.
        time: in [0, 1].
        channel: one of ``SceneRenderer.channels``.
        layer: one of ``Viewer.layers``; a training view is always compared as a whole.
        trajectories: draw trajectories of points all over the moving surface.
        followed: points, each with the time at which it is there, whose trajectories are drawn.
        training_view: the training view that is compared with its image; None: none.
        lean: degrees to the right and upwards from where a film's camera was at the time; the image then has
            the film's frame, and ``pose`` and ``fov`` follow. None: the page flies freely.
        zoom: by which a film's frame is narrowed, at least 1.
    """

    pose: Tensor
    fov: float
    time: float = 0.0
    channel: str = "colour"
    layer: str = LAYERS[0]
    trajectories: bool = False
    followed: tuple[tuple[Point, float], ...] = ()
    training_view: int | None = None
    lean: tuple[float, float] | None = None
    zoom: float = 1.0

    @property
    def drawn_by_browser(self) -> bool:
        """Whether the browser draws it by itself; a training view is always compared in an image."""
        return self.channel == SPLATS and self.training_view is None

    @classmethod
    def first(cls, scene: Scene) -> ViewState:
        """Stand where the first test image was taken, at its time; without one, the first training image."""
        frame = first_frame(scene)
        return cls(frame.camera.camera_to_world, vertical_fov(frame.camera), frame.time)


def vertical_fov(camera: Camera) -> float:
    """Return the angle that a camera's image spans from top to bottom, radians."""
    return 2 * math.atan(0.5 * camera.height / camera.fy)


def first_frame(scene: Scene) -> Frame:
    """Return the first test image; without one, the first training image."""
    return (scene.test or scene.train)[0]


def camera_of(state: ViewState, width: int, height: int, scene: Scene) -> Camera:
    """Make the pinhole camera of a page, ``width`` x ``height`` pixels.

    Its near and far are those of the training cameras, and wider where the box begins nearer or ends farther.
    """
    center, cameras = state.pose[:3, 3], [frame.camera for frame in scene.train]
    low, high = (torch.tensor(corner, dtype=torch.float64) for corner in (scene.box.low, scene.box.high))
    outside = float(torch.maximum(low - center, center - high).clamp(min=0).norm())
    farthest = float(torch.maximum((center - low).abs(), (center - high).abs()).norm())
    near = min(*(camera.near for camera in cameras), max(outside, _MIN_NEAR * scene.box.diagonal))
    far = max(farthest, *(camera.far for camera in cameras))
    focal = 0.5 * height / math.tan(0.5 * state.fov)
    return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, state.pose, near, far)


def turning_axis(pose: Tensor, up: Tensor) -> Tensor:
    """Return the axis (3,) about which a page turns that stands at ``pose`` (4, 4): the upward direction
    ``up``, bent just so much that the image has the pose's roll.
    """
    right, above = pose[:3, 0], -pose[:3, 1]
    axis = up - (up @ right) * right
    axis = axis if float(axis @ above) > 0 else -axis
    return axis / axis.norm() if float(axis @ above) > 0.05 else above


class SceneRenderer:
    """Render a fitted method, or one in training. Only one thread may call it.

    Args:
        name: what pages call it.
        module: the fitted module.
        datamodule: serves the scene and the training images.
        renewal: seconds after which points of a method in training are chosen anew.
        tracks: ``count`` and ``tail`` of ``Trajectories``.
    """

    def __init__(
        self, name: str, module: DynamicSceneModule, datamodule, renewal: float = math.inf, **tracks: float
    ) -> None:
        self.name, self.module, self.scene = name, module, datamodule.scene
        self.targets = datamodule.targets("train")
        self.background = self.targets.background
        self.renewal, self.tracks = renewal, tracks
        self._snapshots: list[tuple[str, Snapshot]] = []  # with their layers
        self._trajectories: tuple[float, Trajectories] | None = None
        self._part = lru_cache(len(LAYERS))(self._part_of)
        self._canonical = lru_cache(_POINTS)(self.canonical_point)
        self._followed = lru_cache(_PATHS)(self._follow)

    @property
    def can_follow(self) -> bool:
        """Whether the method follows points."""
        return isinstance(self.module.method, HasTrajectories) and isinstance(self.module.method, HasMatter)

    @property
    def channels(self) -> tuple[str, ...]:
        """What can be shown."""
        motion = ("motion",) if isinstance(self.module.method, HasTrajectories) else ()
        splats = (SPLATS,) if isinstance(self.module.method, HasEllipsoids) else ()
        return ("colour", "depth", "opacity", *motion, *splats)

    def method_of(self, layer: str) -> Method:
        """Return the method, or the part of it that is a layer; there may be nothing in that."""
        method = self.module.method
        return method if layer == LAYERS[0] else self._part(method, layer)

    def _part_of(self, method: Method, layer: str) -> Method:
        return layer_of(method, layer, self.scene.train, may_be_empty=True)

    def invalidate(self) -> None:
        """Forget what was computed from the method's parameters, which have changed."""
        self._part.cache_clear()
        self._snapshots.clear()
        self._canonical.cache_clear()
        self._followed.cache_clear()
        if self._trajectories is not None:
            self._trajectories[1].forget()

    @torch.no_grad()
    def snapshot_at(self, moment: Moment, layer: str = LAYERS[0]) -> Snapshot:
        """Return the snapshot of a moment; the last two are kept."""
        snapshot = next((kept for of, kept in self._snapshots if of == layer and kept.holds(moment)), None)
        snapshot = snapshot or self.method_of(layer).at(moment)
        others = [pair for pair in self._snapshots if pair[1] is not snapshot]
        self._snapshots = [(layer, snapshot), *others][:_SNAPSHOTS]
        return snapshot

    @property
    def _canonical_moment(self) -> Moment:
        return Moment(self.module.curriculum.canonical_time)

    def prepare(self, state: ViewState) -> None:
        """Compute what an image needs besides its pixels."""
        if state.training_view is not None:
            self.snapshot_at(self.targets[state.training_view].moment)
            return
        self.snapshot_at(Moment(state.time), state.layer)
        if state.channel == "motion":
            self.snapshot_at(self._canonical_moment, state.layer)

    @torch.no_grad()
    def image(self, state: ViewState, camera: Camera, chunks: int = 1, is_stale: IsStale = bool) -> Tensor:
        """Render what a page shows, (H, W, 3) in [0, 1] on the CPU.

        Args:
            state: what to show.
            camera: from where, and how large.
            chunks: bands of rows that are rendered one by one.
            is_stale: tells whether the image is no longer wanted; called before each chunk.

        Raises:
            Cancelled: if it is no longer wanted.
        """
        shape = camera.height, camera.width
        if state.channel == "motion":
            canonical = self.snapshot_at(self._canonical_moment, state.layer)
            return with_wheel(flow_colors(*image_flow(self.module, camera, state.time, canonical))).cpu()
        rendering = self._render(camera, state, chunks, is_stale)
        if state.channel == "depth":
            image = depth_colors(rendering.depth.reshape(shape), rendering.opacity.reshape(shape))
        elif state.channel == "opacity":
            image = rendering.opacity.clamp(0, 1).reshape(*shape, 1).expand(*shape, 3)
        else:
            image = rendering.rgb.reshape(*shape, 3).clamp(0, 1)
        for trajectories in self._overlays(state):
            image = trajectories(image, rendering, camera, state.time)
        return image.cpu()

    def _render(self, camera: Camera, state: ViewState, chunks: int, is_stale: IsStale) -> Rendering:
        moment, parts = Moment(state.time), []
        snapshot = self.snapshot_at(moment, state.layer)
        for chunk in range(chunks):
            if is_stale():
                raise Cancelled
            top, end = (camera.height * i // chunks for i in (chunk, chunk + 1))
            view = View(camera, crop=None if chunks == 1 else (top, 0, end - top, camera.width))
            parts.append(self.module.render(view, moment, self.background, snapshot))
        return parts[0] if chunks == 1 else Rendering.joined(parts)

    def comparison(self, training_view: int, width: int, height: int) -> list[Tensor]:
        """Render truth, prediction and error of a training view, as large as fits."""
        target = self.targets[training_view]
        camera = target.frame.camera
        scale = min(width / camera.width, height / camera.height)
        camera = camera.resized(*(max(1, int(scale * side)) for side in (camera.width, camera.height)))
        images, _ = compare(self.module, target, camera, self.snapshot_at(target.moment))
        return [image.cpu() for image in images]

    @torch.no_grad()
    def point_at(self, camera: Camera, pixel: tuple[int, int], moment: Moment, layer: str) -> Point | None:
        """Return the world point that a pixel (column, row) shows; None if it shows nothing solid."""
        column, row = (min(max(p, 0), n - 1) for p, n in zip(pixel, (camera.width, camera.height)))
        view = View(camera, torch.tensor([row * camera.width + column]))
        rendering = self.module.render(view, moment, self.background, self.snapshot_at(moment, layer))
        if float(rendering.opacity) < _SOLID:
            return None
        rays = view.rays()
        return tuple((rays.origins[0] + rendering.depth.cpu() * rays.directions[0]).tolist())

    @torch.no_grad()
    def canonical_point(self, point: Point, time: float) -> Tensor:
        """Return the canonical point (3,) of the matter that is nearest to a point at a time."""
        method = self.module.method
        matter = method.matter().points
        now = method.trajectories(matter, matter.new_tensor([time]))[:, 0]
        return matter[(now - now.new_tensor(point)).norm(dim=-1).argmin()]

    def _overlays(self, state: ViewState) -> Iterator[Trajectories]:
        """Yield what is drawn over an image: points all over the moving surface, and those followed."""
        if self.can_follow and state.trajectories:
            now = time.monotonic()
            if self._trajectories is None or now - self._trajectories[0] > self.renewal:
                cameras = [frame.camera for frame in self.scene.train]
                self._trajectories = now, Trajectories(self.module, cameras, **self.tracks)
            yield self._trajectories[1]
        if self.can_follow and state.followed:
            yield self._followed(state.followed)

    def _follow(self, followed: tuple[tuple[Point, float], ...]) -> Trajectories:
        points = torch.stack([self._canonical(*point_and_time) for point_and_time in followed])
        return Trajectories(self.module, (), points=points, **_FOLLOWED)


class Viewer:
    """What all pages share: one scene, one or two renderers of it, and the render queue.

    Args:
        scene: of all renderers.
        renderers: none while a run in training has not begun, else one or two, side by side.
        rows: of an image at rest; None: as the training images have, at least 400.
        trust: degrees beside a film's path to which its images were found to be good; None: not measured.

    Attributes:
        film: the path of the one camera that filmed the scene; None: there was none.
        seconds: in which the whole time passes: those of the film, or 4.
    """

    def __init__(
        self,
        scene: Scene,
        renderers: Sequence[SceneRenderer] = (),
        rows: int | None = None,
        trust: float | None = None,
    ) -> None:
        self.film, self.seconds = FilmPath.of_scene(scene, trust), scene.protocol.get("seconds", _SECONDS)
        self.scene, self.renderers = scene, list(renderers)
        cameras = [frame.camera for frame in scene.train]
        self.rows = rows or max(_MIN_FULL_ROWS, *(camera.height for camera in cameras))
        self.aspect = max(camera.width / camera.height for camera in cameras)
        # The point that pages' cameras turn about, and the upward direction, both (3,).
        self.focus, self.up = focus_point(cameras), mean_up(cameras)
        self.queue = RenderQueue()
        self.note = ""  # what a run in training is doing
        self.pages: tuple = ()  # that are open now

    @property
    def channels(self) -> tuple[str, ...]:
        """What can be shown of all renderers; splats of a single one."""
        if not self.renderers:
            return ("colour",)
        first, *others = (renderer.channels for renderer in self.renderers)
        common = [channel for channel in first if all(channel in channels for channels in others)]
        return tuple(channel for channel in common if channel != SPLATS or not others)

    @property
    def layers(self) -> tuple[str, ...]:
        """Which parts of the scene can be shown alone, beside all of it, by all renderers."""
        has_layers = [isinstance(renderer.module.method, HasLayers) for renderer in self.renderers]
        return LAYERS if has_layers and all(has_layers) else LAYERS[:1]

    @property
    def can_follow(self) -> bool:
        """Whether points can be followed in all renderers."""
        return bool(self.renderers) and all(renderer.can_follow for renderer in self.renderers)

    def supported(self, state: ViewState) -> ViewState:
        """Drop what the present methods cannot show, as those of an earlier stage could."""
        channels = self.channels
        state = state if state.channel in channels else replace(state, channel=channels[0])
        state = state if state.layer in self.layers else replace(state, layer=LAYERS[0])
        return state if self.can_follow else replace(state, trajectories=False, followed=())

    def prepare(self, state: ViewState) -> None:
        """Compute what an image needs besides its pixels."""
        for renderer in self.renderers:
            renderer.prepare(state)

    def image(self, state: ViewState, width: int, height: int, chunks: int = 1) -> Tensor:
        """Render what a page shows, (height, width, 3) in [0, 1]: all renderers side by side; of a training
        view truth, prediction and error, a row for each renderer.

        Raises:
            Cancelled: if the queue's running job, which wants it, is stale.
        """
        count = len(self.renderers)
        if state.training_view is not None:
            cell = (width - 2 * _GAP) // 3, (height - (count - 1) * _GAP) // count
            rows = [in_a_row(r.comparison(state.training_view, *cell), _GAP) for r in self.renderers]
            gap = rows[0].new_ones(_GAP, rows[0].shape[1], 3)
            stacked = torch.cat([part for row in rows for part in (gap, row)][1:])
            return padded(stacked, width, height)
        part, camera = self._part_width(width), self._camera(state, width, height)
        images = [renderer.image(state, camera, chunks, self.queue.is_stale) for renderer in self.renderers]
        if state.lean is not None:
            images = [padded(image, part, height, _DARK) for image in images]
        elif self.beyond(state) > 0:
            images = [edged(image) for image in images]
        return images[0] if count == 1 else padded(in_a_row(images, _GAP), width, height)

    def beyond(self, state: ViewState) -> float:
        """Return by how many degrees a page that flies freely is beside what a film shows; 0: within."""
        if self.film is None or state.lean is not None or state.training_view is not None:
            return 0.0
        beside = self.film.beside(camera_of(state, 1, 1, self.scene), state.time)
        return beside if beside > self.film.degrees else 0.0

    def _part_width(self, width: int) -> int:
        count = len(self.renderers)
        return max(1, (width - (count - 1) * _GAP) // count)

    def _camera(self, state: ViewState, width: int, height: int) -> Camera:
        """Make the camera of one renderer's part of an image; beside another it sees what a square would."""
        count, part = len(self.renderers), self._part_width(width)
        if state.lean is not None:  # all of the film's frame
            camera = self.film.leant(state.time, *state.lean)
            scale = min(part / camera.width, height / camera.height)
            camera = camera.resized(*(max(1, int(scale * side)) for side in (camera.width, camera.height)))
            return replace(camera, fx=state.zoom * camera.fx, fy=state.zoom * camera.fy)
        camera = camera_of(state, part, height, self.scene)
        if count == 1 or part >= height:
            return camera
        return replace(camera, fx=camera.fx * part / height, fy=camera.fy * part / height)

    def point_at(self, state: ViewState, x: float, y: float, width: int, height: int) -> Point | None:
        """Return the world point seen at ``x y``, fractions of the whole image; None: nothing solid."""
        camera = self._camera(state, width, height)
        number = min(int(x * len(self.renderers)), len(self.renderers) - 1)
        part = self._part_width(width)
        column = int(x * width) - number * (part + _GAP) - (part - camera.width) // 2
        pixel, moment = (column, int(y * height) - (height - camera.height) // 2), Moment(state.time)
        return self.renderers[number].point_at(camera, pixel, moment, state.layer)


def padded(image: Tensor, width: int, height: int, shade: float = 1.0) -> Tensor:
    """Put an image (h, w, 3) into the middle of a plain one (height, width, 3)."""
    plain = image.new_full((height, width, 3), shade)
    top, left = (height - image.shape[0]) // 2, (width - image.shape[1]) // 2
    plain[top : top + image.shape[0], left : left + image.shape[1]] = image
    return plain


def edged(image: Tensor) -> Tensor:
    """Draw the edge of an image (H, W, 3) that shows what was not filmed."""
    edge, color = max(2, image.shape[0] // 150), image.new_tensor(_EDGE)
    image = image.clone()
    for side in (image[:edge], image[-edge:], image[:, :edge], image[:, -edge:]):
        side[:] = color
    return image
