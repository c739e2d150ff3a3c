"""Frames, the scene they belong to, and what its silhouettes tell before fitting."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from forewarp.ops.grid import dilate
from forewarp.scene.box import Box, Lattice
from forewarp.scene.brief import brief
from forewarp.scene.camera import Camera, focus_point
from forewarp.scene.world import SAME, World


@dataclass(frozen=True)
class Frame:
    """One image with its camera and time.

    ``load()`` gives the image as a uint8 tensor (H, W, 4), straight (not premultiplied) alpha, at the
    camera's size; without an alpha channel on disk alpha is 255. ``load_depth()``, if not None,
    gives exact ray depth (H, W) float32 in world units, 0 on the background. ``ability`` is what a test
    frame measures: ``space``, ``time``, ``space_time`` (both), ``canonical``, or ``all`` if the dataset does
    not say. ``camera_id`` numbers the physical cameras from 0, if the dataset tells them apart; ``moment``
    the instants, where cameras film together but at times of their own.
    ``load_valid()``, if not None, gives (H, W) bool: the pixels, at least one, that count in training and in
    metrics.
    ``load_moving()``, if not None, gives (H, W) bool: the pixels of what moves, which are scored apart;
    ``load_resting()`` those of what rests in the whole film.
    ``load_sensed()``, if not None, gives (2, H, W) float32: ray depth as a sensor measured it, world units, 0
    where it did not, and its confidence in [0, 1]: evidence to train on, not the truth.
    ``load_covisible()``, if not None, gives (H, W) bool: the pixels of what training images show too.
    ``keypoints`` (J, 3): pixel x and y of J points that several frames show, and 1 where it is seen, else 0.
    """

    name: str
    time: float
    camera: Camera
    load: Callable[[], Tensor]
    load_depth: Callable[[], Tensor] | None = None
    ability: str = "all"
    camera_id: int | None = None
    load_valid: Callable[[], Tensor] | None = None
    load_moving: Callable[[], Tensor] | None = None
    load_resting: Callable[[], Tensor] | None = None
    load_sensed: Callable[[], Tensor] | None = None
    load_covisible: Callable[[], Tensor] | None = None
    keypoints: Tensor | None = None
    moment: int | None = None

    __repr__ = brief


@dataclass(frozen=True)
class Truth:
    """Exact trajectories of surface points: ``points`` (N, T, 3) float32 at ``times`` (T,), world units.

    The first column is the canonical time.
    """

    points: Tensor
    times: Tensor

    __repr__ = brief


@dataclass(frozen=True)
class Scene:
    """All frames of one subject, read once.

    ``box`` bounds everything visible; ``canonical_time`` in [0, 1]; ``has_alpha``: the images separate
    foreground from background; ``protocol`` says how numbers are measured, entries of None are left out;
    ``still`` (N, 3) float32: points that never move, world units, if known; ``held``: held-out frames, never
    trained on; ``world``: where the scene lies in the world of its data.
    """

    name: str
    train: tuple[Frame, ...]
    val: tuple[Frame, ...]
    test: tuple[Frame, ...]
    box: Box
    canonical_time: float
    has_alpha: bool
    truth: Truth | None = None
    protocol: dict = field(default_factory=dict)
    still: Tensor | None = None
    held: tuple[Frame, ...] = ()
    world: World = field(default=SAME, repr=False)

    __repr__ = brief

    def __post_init__(self) -> None:
        told = {key: value for key, value in self.protocol.items() if value is not None}
        object.__setattr__(self, "protocol", told)

    @property
    def times(self) -> tuple[float, ...]:
        """The distinct training times, ascending."""
        return tuple(sorted({f.time for f in self.train}))

    @property
    def instants(self) -> tuple[float, ...]:
        """The distinct times of ``instants_of`` the training frames, ascending."""
        return tuple(sorted({*instants_of(self.train)}))

    @property
    def has_one_camera(self) -> bool:
        """Whether one camera took all training images: none has an id of its own, and most times have one."""
        cameras = {frame.camera_id for frame in self.train}
        return len(cameras) == 1 and len(self.train) < 2 * len(self.instants)


def instants_of(frames: Sequence[Frame]) -> list[float]:
    """Return the time of the instant that each frame belongs to: the mean of those of one ``moment``, or its
    own where it has none.
    """
    of_moment: dict[int, list[float]] = {}
    for frame in frames:
        if frame.moment is not None:
            of_moment.setdefault(frame.moment, []).append(frame.time)
    means = {moment: sum(times) / len(times) for moment, times in of_moment.items()}
    return [frame.time if frame.moment is None else means[frame.moment] for frame in frames]


def spread(count: int, wanted: int) -> list[int]:
    """Choose ``wanted`` evenly spaced indices below ``count``, first and last included; all if too few.

    >>> spread(10, 4), spread(2, 4)
    ([0, 3, 6, 9], [0, 1])
    """
    wanted = min(count, wanted)
    return [round(i * (count - 1) / max(wanted - 1, 1)) for i in range(wanted)]


def middle_of(times: Iterable[float]) -> float:
    """Choose the time nearest to the middle between first and last, the earlier of two as near.

    >>> middle_of([0.0, 0.1, 0.2, 0.8, 1.0])
    0.2
    >>> middle_of([0.0, 0.25, 0.75, 1.0])
    0.25
    """
    times = sorted(set(times))
    return min(times, key=lambda time: round(abs(time - 0.5 * (times[0] + times[-1])), 9))


_VIEWS, _SIDE = 40, 40


def visual_hull(points: Tensor, cameras: list[Camera], masks: list[Tensor], misses: int = 0) -> Tensor:
    """Select points inside the silhouette in all but ``misses`` of the views that see them.

    Args:
        points: (N, 3) world units.
        cameras: V cameras.
        masks: V masks (H, W) bool, True on the foreground; dilate them if the scene moves.
        misses: number of views that may disagree.

    Returns:
        (N,) bool. A point that fewer than half of the views see is outside.
    """
    covered, seen = sightings(points, cameras, masks)
    return (2 * seen >= len(cameras)) & (seen > misses) & (seen - covered <= misses)


def sightings(points: Tensor, cameras: list[Camera], masks: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Count the views inside whose silhouette each point lies, and those that see it, (N,) int32 each.

    Arguments are those of ``visual_hull``.
    """
    covered, seen = torch.zeros(2, len(points), dtype=torch.int32)
    for camera, mask in zip(cameras, masks, strict=True):
        row, column, visible = where_seen(camera, points)
        on = mask[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
        covered += (visible & on).int()
        seen += visible.int()
    return covered, seen


def where_seen(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return row and column (N,) of the pixel that shows each point (N, 3), and whether the image has it."""
    pixel, z = camera.project(points)
    column, row = pixel.floor().long().unbind(-1)
    return row, column, (z > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)


def walk_of(scene: Scene) -> tuple[float, float | None] | None:
    """Measure how far the camera of a film goes around what it looks at, the point nearest to all its axes.

    Returns:
        degrees, summed over all training images, and degrees a second where the scene's protocol has the
        film's ``seconds``: dycheck's angular effective multi-view factor, about 10 to 30 of one who walks
        around a subject. None where several cameras film together, or of fewer than three images.

    Source: Gao et al., "Monocular Dynamic View Synthesis: A Reality Check" (2022).
    """
    frames = sorted(scene.train, key=lambda frame: frame.time)
    if len(frames) < 3 or len(scene.instants) < len(frames):
        return None
    towards = focus_point([frame.camera for frame in frames]) - torch.stack([f.camera.center for f in frames])
    towards = torch.nn.functional.normalize(towards.double(), dim=-1)
    steps = torch.linalg.cross(towards[:-1], towards[1:]).norm(dim=-1)  # exact where angles are small
    degrees = float(torch.rad2deg(torch.atan2(steps, (towards[:-1] * towards[1:]).sum(-1))).sum())
    seconds = scene.protocol.get("seconds")
    duration = (seconds or 0.0) * (frames[-1].time - frames[0].time)
    return degrees, degrees / duration if duration > 0 else None


@dataclass(frozen=True)
class Survey:
    """Properties of the training images.

    ``times``: distinct times of the ``frames``. ``cut_out``: share of transparent pixels, 0 without alpha.
    ``spread``: largest angle between two cameras, seen from the scene's middle, degrees. ``disagreement``:
    share of the foreground that no static object can explain, as no point of the visual hull projects there
    (0 without alpha). ``one_camera``: as ``Scene.has_one_camera``.
    """

    frames: int
    times: int
    cut_out: float
    spread: float
    disagreement: float
    one_camera: bool


def survey(scene: Scene) -> Survey:
    """Measure the training frames. Cost: ``_VIEWS`` images, ``_SIDE``^3 points in each."""
    frames = [scene.train[i] for i in spread(len(scene.train), _VIEWS)]
    cut_out = 0.0
    if scene.has_alpha:
        cut_out = sum(float((f.load()[..., 3] < 128).float().mean()) for f in frames) / len(frames)
    middle = torch.tensor(scene.box.center).double()
    towards = torch.stack([frame.camera.center.double() - middle for frame in scene.train])
    towards = torch.nn.functional.normalize(towards, dim=-1)
    # Row by row, as products of all pairs grow with the square of the frames.
    least = min(float((towards @ row).min()) for row in towards)
    angle = math.degrees(math.acos(max(-1.0, min(1.0, least))))
    disagreement = _disagreement(scene, frames) if cut_out > 0 and len(frames) > 1 else 0.0
    return Survey(len(scene.train), len(scene.times), cut_out, angle, disagreement, scene.has_one_camera)


def _disagreement(scene: Scene, frames: Sequence[Frame]) -> float:
    lattice = Lattice.of_count(scene.box, _SIDE**3)
    points, reach = lattice.to_world(lattice.all_voxels()), []
    for frame in frames:  # how many pixels a voxel is wide
        depth = float(frame.camera.project(points.mean(0, keepdim=True))[1])
        reach.append(max(1, math.ceil(lattice.voxel_size * frame.camera.fx / max(depth, 1e-6))))
    foregrounds = [frame.load()[..., 3] > 127 for frame in frames]
    masks = [dilate(foreground, pixels) for foreground, pixels in zip(foregrounds, reach)]
    points, missed = points[visual_hull(points, [frame.camera for frame in frames], masks)], 0
    for frame, foreground, pixels in zip(frames, foregrounds, reach):
        row, column, inside = where_seen(frame.camera, points)
        covered = torch.zeros_like(foreground)
        covered[row[inside], column[inside]] = True
        missed += int((foreground & ~dilate(covered, pixels)).sum())
    return missed / max(sum(int(foreground.sum()) for foreground in foregrounds), 1)
