"""What every export begins with: a fitted scene, and the tracks of its points.

``format=npz`` stores these tracks, what cameras see of them, and the method's own arrays; ``format=gltf``
makes them one binary glTF 2.0 file with an animation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forewarp.drawing.images import hidden
from forewarp.evaluation.images import within
from forewarp.evaluation.trajectories import seen_by, surface
from forewarp.glb.container import UINT, Buffer, quaternion_of
from forewarp.methods.method import HasBounds, HasEllipsoids, HasMatter, HasTrajectories, Method
from forewarp.scene.camera import Camera, mean_up
from forewarp.scene.cloud import far_apart
from forewarp.scene.film import FilmPath
from forewarp.scene.frame import spread
from forewarp.scene.view import Moment, View
from forewarp.scene.world import SAME, World
from forewarp.training.module import DynamicSceneModule

Progress = Callable[[int, int], None]  # the number of times done, and of how many

_UP = {"y": (0.0, 1.0, 0.0), "-y": (0.0, -1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_MIN_OPACITY = 0.1  # a particle that never gets as opaque is no point of the surface
_VIEW_SIZE = 200  # most pixels per side of the images that decide what is hidden
_SECONDS = 4.0  # that an animation of other scenes than films lasts
_SLACK = 1.5  # sizes of a point that it may lie behind the surface and still count as visible


def no_progress(done: int, total: int) -> None:
    """Show nothing."""


@dataclass(frozen=True)
class Source:
    """A fitted ``module``, named ``model`` in its config, the ``cameras`` it was trained with, ``times`` in
    [0, 1], the ``background`` (3,) in [0, 1] of its images, the scene's ``name``, and, if known,
    ``image_times``, when each camera took its image. Of a film in windows it is the first one, whose time 0
    and 1 are those of the film in ``span``; ``later`` are the others, each shown from its ``begin`` on.
    ``world`` is where all of this lies in the world of the data. ``trust``: the angle, degrees, up to which
    its images are good beside the path of the cameras, if the run was measured; ``seconds``:
    how long the film lasts, where that is known.
    """

    module: DynamicSceneModule
    model: str
    cameras: Sequence[Camera]
    times: Sequence[float]
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    name: str = "scene"
    image_times: Sequence[float] = ()
    span: tuple[float, float] = (0.0, 1.0)
    begin: float = 0.0
    later: Sequence[Source] = ()
    world: World = SAME
    trust: float | None = None
    seconds: float | None = None

    @property
    def method(self) -> Method:
        """The fitted method."""
        return self.module.method

    @property
    def lasts(self) -> float:
        """How many seconds an animation of it lasts, unless told otherwise: as long as the film, or 4."""
        return self.seconds or _SECONDS

    @cached_property
    def is_film(self) -> bool:
        """Whether one camera filmed it, going smoothly from image to image."""
        known = len(self.image_times) == len(self.cameras)
        return known and FilmPath.of(self.cameras, self.image_times) is not None

    @property
    def shift(self) -> tuple[float, float, float]:
        """What files leave out of the data's coordinates; see ``World.shift``."""
        return self.world.shift(max((camera.far for camera in self.cameras), default=1.0))

    @property
    def in_files(self) -> World:
        """Where the scene lies in its files: in the world of the data, less the ``shift``."""
        return self.world.without(self.shift)

    @property
    def has_ellipsoids(self) -> bool:
        """Whether the scene is a cloud of Gaussians."""
        return isinstance(self.method, HasEllipsoids)

    def rotation_to(self, up: str) -> Tensor:
        """Return the rotation (3, 3) float64 that takes the mean upward direction of the images to an axis.

        Args:
            up: ``y``, ``-y`` or ``z``; ``world``: the identity.
        """
        from scipy.spatial.transform import Rotation

        if up == "world":
            return torch.eye(3, dtype=torch.float64)
        rotation, _ = Rotation.align_vectors([_UP[up]], [mean_up(self.cameras).numpy()])
        return torch.from_numpy(rotation.as_matrix())

    @property
    def follows(self) -> bool:
        """Whether ``tracks_of`` can follow the scene's points."""
        points = isinstance(self.method, HasTrajectories) and isinstance(self.method, HasMatter)
        return self.has_ellipsoids or points

    def without_particles(self, kind: str) -> ValueError:
        """Return the refusal of a format that asks for particles, naming those that there are."""
        others = ["mesh"] if isinstance(self.method, HasBounds) else []
        others += ["gltf", "ply", "npz"] if self.follows else []
        got = self.model + (f"; use format={' or '.join(others)}" if others else "")
        return ValueError(f"format={kind}: expected a method made of particles, but got {got}")


@dataclass(frozen=True)
class Tracks:
    """N points that move, on the CPU.

    Attributes:
        points: (N, 3), at the canonical time, world units.
        times: (T,).
        positions: (T, N, 3), world units.
        colors: (T, N, 3), in [0, 1], sRGB; one row if they do not change.
        opacity: (T, N), in [0, 1]; one row if it does not change.
        size: approximate width of a point, world units.
    """

    points: Tensor
    times: Tensor
    positions: Tensor
    colors: Tensor
    opacity: Tensor
    size: float

    def __len__(self) -> int:
        return len(self.points)

    def in_data(self, world: World) -> Tracks:
        """Move the points from a scene's world to that of its data."""
        points, positions = (world.to_data(places).float() for places in (self.points, self.positions))
        return replace(self, points=points, positions=positions, size=self.size / world.scale)


@torch.no_grad()
def tracks_of(source: Source, count: int, progress: Progress = no_progress) -> Tracks:
    """Follow points of the surface: the centers of Gaussians, or of voxels.

    Args:
        source: the scene and its times.
        count: most points, spread evenly over the surface.
        progress: called after each time.

    Raises:
        ValueError: if no camera sees any.
    """
    module, method = source.module, source.method
    if source.has_ellipsoids:
        opacity = torch.stack([method.ellipsoids(time).opacity for time in source.times]).amax(0)
        cloud, size = method.ellipsoids(module.curriculum.canonical_time), method.matter().size
        seen = (opacity > _MIN_OPACITY) & seen_by(module, source.cameras, cloud.centers, size)
        rows = seen.nonzero()[:, 0]
        points, what = cloud.centers[rows], "particles"
    else:
        cloud = surface(module, source.cameras)
        points, size, what = cloud.points, cloud.size, "matter"
    if not len(points):
        raise ValueError(f"run: expected {what} that a camera sees, but got none; train it longer")
    chosen = far_apart(points, count)
    points = points[chosen]
    frames = []
    for done, time in enumerate(source.times, 1):
        if source.has_ellipsoids:
            now = method.ellipsoids(time)[rows[chosen]]
            frame = now.centers, now.colors, now.opacity
        else:
            moved = method.trajectories(points, points.new_tensor([time]))[:, 0]
            frame = moved, cloud.colors[chosen], cloud.opacity[chosen]
        frames.append([part.float().cpu() for part in frame])
        progress(done, len(source.times))
    positions, *parts = (torch.stack(values) for values in zip(*frames))
    colors, opacity = (part[:1] if bool((part == part[:1]).all()) else part for part in parts)
    times = torch.tensor(source.times, dtype=torch.float32)
    return Tracks(points.float().cpu(), times, positions, colors, opacity, size)


def export_npz(source: Source, folder: Path, progress: Progress, *, points: int, views: int) -> dict:
    """Write ``trajectories.npz`` and ``method.npz``; ``docs/exports.md`` lists their arrays.

    Args:
        source: the scene and its times.
        folder: to write into.
        progress: called after each time.
        points: most points.
        views: number of training cameras whose visibility is stored.

    Returns:
        the facts for ``about.json``.
    """
    tracks, world = tracks_of(source, points), source.in_files
    numbers = spread(len(source.cameras), views)
    cameras = [source.cameras[i] for i in numbers]
    visible = visibility(source, tracks, cameras, progress)
    tracks, poses = tracks.in_data(world), [world.to_data(camera.camera_to_world) for camera in cameras]
    np.savez_compressed(
        folder / "trajectories.npz",
        shift=np.array(source.shift),
        canonical_time=np.float32(source.module.curriculum.canonical_time),
        points=tracks.points.numpy(),
        times=tracks.times.numpy(),
        positions=tracks.positions.transpose(0, 1).numpy(),
        colors=tracks.colors.expand(len(tracks.times), -1, -1).transpose(0, 1).numpy(),
        opacity=tracks.opacity.expand(len(tracks.times), -1).T.numpy(),
        visible=visible.numpy(),
        cameras=np.array(numbers),
        camera_to_world=torch.stack(poses).numpy(),
        intrinsics=np.array([[[c.fx, c.skew, c.cx], [0, c.fy, c.cy], [0, 0, 1]] for c in cameras]),
        image_size=np.array([[c.width, c.height] for c in cameras]),
        lens=np.array([(0.0,) * 5 if c.lens is None else (*c.lens.k, *c.lens.p) for c in cameras]),
    )
    state = source.method.state_dict().items()
    arrays = {name: value.cpu().numpy() for name, value in state if isinstance(value, Tensor)}
    np.savez_compressed(folder / "method.npz", **arrays)
    facts = {"points": len(tracks), "views": len(cameras), "visible": float(visible.float().mean())}
    return facts | {"colors": "sRGB, as in the images"}


@torch.no_grad()
def visibility(source: Source, tracks: Tracks, cameras: list[Camera], progress: Progress) -> Tensor:
    """Tell which points are visible at which time from which camera, (N, T, V) bool: in front of it, inside
    its image, and at most 1.5 point sizes behind the surface in an image of 200 pixels.

    Cost: a small image for each time and camera.
    """
    visible = torch.zeros(len(tracks), len(tracks.times), len(cameras), dtype=torch.bool)
    black = torch.zeros(3, device=source.module.device)
    for row, time in enumerate(source.times):
        snapshot, places = source.method.at(Moment(time)), tracks.positions[row]
        for column, camera in enumerate(within(camera, _VIEW_SIZE) for camera in cameras):
            image = snapshot.render(View(camera), black)
            depth = torch.where(image.opacity > 0.5, image.depth, float("inf")).cpu()
            pixels, z = camera.project(places)
            inside = (pixels >= 0) & (pixels < pixels.new_tensor([camera.width, camera.height]))
            distance = (places - camera.center.to(places)).norm(dim=-1)
            surface_depth = depth.reshape(camera.height, camera.width)
            behind = hidden(pixels, distance, surface_depth, _SLACK * tracks.size)
            visible[:, row, column] = (z > 0) & inside.all(-1) & ~behind
        progress(row + 1, len(source.times))
    return visible


# A tetrahedron about the origin, 1 from its centre to its corners; triangles counter-clockwise from outside.
_CORNERS = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 3**0.5
_FACES = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
# A tetrahedron's radius is this share of the median distance of points to their fourth neighbour.
_NEIGHBOUR, _RADIUS = 4, 0.8
_MIN_COLOR_CHANGE = 1 / 255


def export_gltf(
    source: Source, folder: Path, progress: Progress, *, points: int, seconds: float | None
) -> dict:
    """Write ``points.glb``.

    Args:
        source: the scene and its times.
        folder: to write into.
        progress: called after each time.
        points: most points.
        seconds: duration of the animation from time 0 to time 1; None: see ``Source.lasts``.

    Returns:
        the facts for ``about.json``.
    """
    tracks = tracks_of(source, points, progress).in_data(source.in_files)
    radius = _RADIUS * neighbour_distance(tracks.points, tracks.size)
    seconds = source.lasts if seconds is None else seconds
    (folder / "points.glb").write_bytes(glb(tracks, radius, source.rotation_to("y"), seconds, source.shift))
    axes = "y up, by the turn of its only node; places before it are the data's"
    facts = {"points": len(tracks), "radius": radius, "seconds": seconds, "axes in the file": axes}
    return facts | {"colors": "linear, as glTF asks; unlit"}


def neighbour_distance(points: Tensor, default: float) -> float:
    """Return the median distance of points (N, 3) to their fourth neighbour; ``default`` for few points."""
    from scipy.spatial import KDTree

    if len(points) <= _NEIGHBOUR:
        return default
    places = points.double().numpy()
    return float(np.median(KDTree(places).query(places, [_NEIGHBOUR + 1])[0])) or default


def linear(colors: Tensor) -> Tensor:
    """Turn sRGB values in [0, 1] into linear ones."""
    return torch.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def glb(
    tracks: Tracks, radius: float, rotation: Tensor, seconds: float, shift: Sequence[float] = ()
) -> bytes:
    """Make a binary glTF: each point is a small tetrahedron, as few programs draw mere points.

    Its corners at the first time are the mesh; every later time is a morph target. The animation lets weights
    rise and fall so that corners go straight from each time to the next. While a point is less opaque than at
    other times its tetrahedron is smaller; colours that change are in the targets too.

    Args:
        tracks: the points.
        radius: of a tetrahedron, world units.
        rotation: (3, 3) of the scene's only node.
        seconds: duration of the animation from time 0 to time 1.
        shift: (3,) that was left out of all places.
    """
    total = len(tracks.times)
    opacity = tracks.opacity / tracks.opacity.amax(0).clamp(min=1e-6)
    scale = radius * opacity.expand(total, -1)[..., None, None]
    corners = (tracks.positions[:, :, None] + scale * _CORNERS).reshape(total, -1, 3)
    colors = linear(tracks.colors).repeat_interleave(4, 1)  # (T or 1, 4 N, 3)
    has_color_change = len(colors) > 1 and float((colors - colors[:1]).abs().max()) > _MIN_COLOR_CHANGE
    buffer = Buffer()
    attributes = {"POSITION": buffer.add(corners[0], bounds=True), "COLOR_0": buffer.add(colors[0])}
    faces = (_FACES + 4 * torch.arange(len(tracks))[:, None, None]).flatten()
    primitive = {"attributes": attributes, "indices": buffer.add(faces, UINT), "material": 0}
    mesh, animation = {"primitives": [primitive]}, {}
    if total > 1:
        primitive["targets"] = targets = []
        for k in range(1, total):
            targets.append({"POSITION": buffer.add(corners[k] - corners[0], bounds=True)})
            if has_color_change:
                targets[-1]["COLOR_0"] = buffer.add(colors[k] - colors[0])
        mesh["weights"] = [0.0] * (total - 1)
        mesh["extras"] = {"targetNames": [f"time {time:.4g}" for time in tracks.times[1:].tolist()]}
        clock = buffer.add((tracks.times - tracks.times[0]) * seconds, bounds=True)
        weights = buffer.add(torch.eye(total)[:, 1:].flatten())  # at each time its own target alone
        sampler = {"input": clock, "output": weights, "interpolation": "LINEAR"}
        channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        animation = {"animations": [{"name": "time", "samplers": [sampler], "channels": [channel]}]}
    extras = {"extras": {"shift": list(shift)}} if any(shift) else {}
    unlit = {"extensions": {"KHR_materials_unlit": {}}, "pbrMetallicRoughness": {"metallicFactor": 0}}
    description = {
        "extensionsUsed": ["KHR_materials_unlit"],
        "nodes": [{"mesh": 0, "rotation": quaternion_of(rotation), "name": "points"} | extras],
        "meshes": [mesh],
        "materials": [unlit],
    }
    return buffer.packed(description | animation)
