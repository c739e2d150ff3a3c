"""Cast rays exactly into a posed world: lit images, depth, surface points and their trajectories.

Many images are rendered in several processes if that is faster.
"""

from __future__ import annotations

import pickle
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import get_context

import numpy as np
import torch

from forewarp.ops.backend import cores
from forewarp.provenance import import_nothing_from_here
from forewarp.scene.camera import Camera
from forewarp.synth.shapes import Surface, color_of
from forewarp.synth.world import LIGHT_AT, World

LIGHT_RADIUS = 0.45
AMBIENT, SKY, DIFFUSE = 0.60, 0.10, 0.40
# Per sample; four samples per pixel see two dozen points of the light, so shadows show no steps.
SHADOW_RAYS = 6
# Far above the error of float32, which embree computes in, and far below anything visible.
LIFT_OFF = 2e-4
# Candidates per wanted surface point: about half of the surface is never visible.
_SPARE = 4
# A process takes seconds to start and casts about two million samples a second.
SAMPLES_A_PROCESS = 4e7
# Images per process waiting to be written: enough that no process idles, few enough for the memory.
_AHEAD = 3


@dataclass(frozen=True)
class Hits:
    """The hits of n of the rays given to ``Posed.first_hits``: ``ray`` (n,) their indices, ``face`` (n,),
    ``barycentric`` (n, 3), ``distance`` (n,) along the unit ray, world units.
    """

    ray: np.ndarray
    face: np.ndarray
    barycentric: np.ndarray
    distance: np.ndarray


class Posed:
    """A world at one time, ready for ray casting.

    Raises:
        ImportError: if the optional packages of ``forewarp[synth]`` are not installed.
    """

    def __init__(self, world: World, time: float):
        self.world, self.light, self.is_there = world, world.subject.light(time), world.is_there(time)
        self.corners = world.place(time)[world.faces]  # (F, 3, 3)
        cross = _cross(self.corners)
        self.area = 0.5 * np.linalg.norm(cross, axis=-1)
        self.normal = cross / (2 * self.area[:, None])
        # Normals (F, 3, 3) at the corners: averaged in smooth parts, else those of the faces.
        self.corner_normal = np.repeat(self.normal[:, None], 3, axis=1)
        faces, summed = world.faces[world.smooth], np.zeros((len(world.rest), 3))
        np.add.at(summed, faces, cross[world.smooth][:, None])
        self.corner_normal[world.smooth] = _unit(summed[faces])
        self.finish = np.array([(p.material.gloss, p.material.shine) for p in world.parts])
        self._first = _intersector(self.corners, self.is_there)
        casts = self.is_there & world.casts
        self._first_blocker = self._first if world.casts.all() else _intersector(self.corners, casts)

    def first_hits(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """Find the first hits of rays from ``origins`` (n, 3) along unit ``directions`` (n, 3)."""
        face = self._first(origins, directions)
        ray = np.flatnonzero(face >= 0)
        face, origins, directions = face[ray], origins[ray], directions[ray]
        # In float64, as embree gives only the face; grazing rays are clamped to their face.
        a, b, c = (self.corners[face, i] for i in range(3))
        normal = 2 * self.area[face, None] * self.normal[face]
        across = np.cross(directions, origins - a)
        scale = _dot(directions, normal)
        scale = np.where(np.abs(scale) < 1e-15, 1e-15, scale)
        v, w = _dot(c - a, across) / scale, -_dot(b - a, across) / scale
        weights = np.clip(np.stack([1 - v - w, v, w], -1), 0, 1)
        barycentric = weights / weights.sum(-1, keepdims=True)
        point = _blended(barycentric, self.corners[face])
        return Hits(ray, face, barycentric, _dot(point - origins, directions))

    def is_free(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Tell which rays (n, 3), (n, 3) leave the world (n,); parts that cast no shadow are ignored."""
        return self._first_blocker(origins, directions) < 0

    def color(self, hits: Hits, lights: np.ndarray, directions: np.ndarray | None = None) -> np.ndarray:
        """Light hits: colours (n, 3) in [0, 1]; ``lights`` (L, 3) are points of the area light.

        ``directions`` (R, 3): the rays' directions; without them nothing is glossy.
        """
        normal = _unit(_blended(hits.barycentric, self.corner_normal[hits.face]))
        point, flat = _blended(hits.barycentric, self.corners[hits.face]), self.normal[hits.face]
        diffuse = np.zeros(len(point))
        for light in lights:
            towards = _unit(light - point)
            cosine = _dot(normal, towards)
            lit = np.flatnonzero((cosine > 0) & (_dot(flat, towards) > 0))
            diffuse[lit] += cosine[lit] * self.is_free(point[lit] + LIFT_OFF * flat[lit], towards[lit])
        shade = AMBIENT + SKY * normal[:, 2] + DIFFUSE * diffuse / len(lights)
        color = self.albedo(hits) * shade[:, None]
        if directions is not None:
            # Phong's gloss * cos^shine of the angle between the mirrored ray and the light's middle.
            gloss, shine = self.finish[self.world.part_of_face[hits.face]].T
            incoming = directions[hits.ray]
            mirrored = incoming - 2 * _dot(incoming, normal)[:, None] * normal
            cosine = mirrored @ (self.light / np.linalg.norm(self.light))
            color += (gloss * np.clip(cosine, 0, 1) ** shine)[:, None]
        return np.clip(color, 0, 1)

    def albedo(self, hits: Hits) -> np.ndarray:
        """Return the colours (n, 3) of hits before they are lit."""
        albedo, part_of_hit = np.empty((len(hits.face), 3)), self.world.part_of_face[hits.face]
        for index in np.unique(part_of_hit):
            part, rows = self.world.parts[index], np.flatnonzero(part_of_hit == index)
            corners = self.world.rest[self.world.faces[hits.face[rows]]]
            position = _blended(hits.barycentric[rows], corners)
            low, high = part.vertices.min(0), part.vertices.max(0)
            surface = Surface(position, (position - low) / (high - low), _unit(_cross(corners)))
            albedo[rows] = color_of(part.material, surface)
        return albedo


def render(
    world: World, time: float, camera: Camera, samples_per_pixel: int = 4, shadow_rays: int = SHADOW_RAYS
) -> tuple[np.ndarray, np.ndarray]:
    """Render one image of the world at any time from any camera.

    Args:
        world: the world to render.
        time: time in [0, 1].
        camera: gives size, lens and pose; near and far are ignored.
        samples_per_pixel: rays averaged into a pixel, each with ``shadow_rays`` shadow rays.

    Returns:
        rgba (H, W, 4) uint8, straight alpha, alpha the share of the samples that hit; and depth (H, W)
        float32, the distance along the unit ray through the pixel centre, 0 if it hits nothing.

    **Cost** H * W * samples_per_pixel * (1 + shadow_rays) rays at most.
    """
    posed, shape = _posed(world, time), (camera.height, camera.width)
    rgb, alpha = shaded(posed, camera, samples_per_pixel, shadow_rays)
    rgba = np.rint(255 * np.concatenate([rgb, alpha[:, None]], -1)).astype(np.uint8)
    center, depth = posed.first_hits(*camera_rays(camera)), np.zeros(len(rgb), np.float32)
    depth[center.ray] = center.distance
    return rgba.reshape(*shape, 4), depth.reshape(shape)


def shaded(
    posed: Posed, camera: Camera, samples_per_pixel: int, shadow_rays: int, pixels: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Shade pixels: colours (n, 3) in [0, 1], straight, and the shares (n,) of their samples that hit.

    Args:
        samples_per_pixel, shadow_rays: see ``render``.
        pixels: (n,) numbers, row by row; None: all. The colour of one does not depend on the others.
    """
    count = camera.height * camera.width if pixels is None else len(pixels)
    total, hit = np.zeros((count, 3)), np.zeros(count)
    lights = light_points(samples_per_pixel * shadow_rays, posed.light)
    for i in range(samples_per_pixel):
        # The R1 sequence covers the pixel evenly with any number of samples; a single sample is the centre.
        offset = ((i + 0.5) / samples_per_pixel, (0.5 + i * 0.6180339887498949) % 1.0)
        origins, directions = camera_rays(camera, offset, pixels)
        hits = posed.first_hits(origins, directions)
        total[hits.ray] += posed.color(hits, lights[i::samples_per_pixel], directions)
        hit[hits.ray] += 1
    return total / np.maximum(hit, 1)[:, None], hit / samples_per_pixel


_posed = lru_cache(1)(Posed)  # once for all cameras of one time


def camera_rays(
    camera: Camera, offset: tuple[float, float] = (0.5, 0.5), pixels: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Make origins and unit directions (n, 3) float64 through one spot of pixels, numbered row by row; None:
    of all.
    """
    pixels = np.arange(camera.height * camera.width) if pixels is None else pixels
    v, u = (torch.from_numpy(place + at) for place, at in zip(divmod(pixels, camera.width), offset[::-1]))
    directions = camera.directions(u, v).numpy()
    return np.broadcast_to(camera.center.double().numpy(), directions.shape), directions


def light_points(count: int, at: np.ndarray = LIGHT_AT) -> np.ndarray:
    """Place points (count, 3) evenly on the disc of a light at a place (3,), which faces the origin.

    The points are the same for every pixel, so that shadows look alike from all cameras.
    """
    i = np.arange(count)
    radius, angle = LIGHT_RADIUS * np.sqrt((i + 0.5) / count), 2.399963229728653 * i  # golden angle
    axis = at / np.linalg.norm(at)
    across = np.cross(axis, (0, 0, 1.0))
    across /= np.linalg.norm(across)
    disc = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(axis, across)
    return at + radius[:, None] * disc


def surface_points(
    world: World,
    count: int,
    cameras: list[Camera],
    rng: np.random.Generator,
    time: float = 0.0,
    among: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw points uniformly by area on the surface that is visible at one time.

    Args:
        world: the world.
        count: number of points; fewer are drawn only if hardly anything is visible.
        cameras: a point is visible if nothing hides it from at least one of them, whatever way they look.
        rng: the same state gives the same points.
        time: time at which points must be visible.
        among: (F,) bool, faces to draw from; None: all that are there.

    Returns:
        faces (N,) and barycentric coordinates (N, 3), which ``World.points`` places at any time.
    """
    posed, drawn = Posed(world, time), _SPARE * count
    cumulative = np.cumsum(posed.area * (posed.is_there if among is None else posed.is_there & among))
    face = np.searchsorted(cumulative, rng.random(drawn) * cumulative[-1], side="right")
    # The square root makes the density even over the triangle.
    a, b = np.sqrt(rng.random(drawn)), rng.random(drawn)
    barycentric = np.stack([1 - a, a * (1 - b), a * b], -1)
    point, normal = _blended(barycentric, posed.corners[face]), posed.normal[face]
    seen = np.zeros(drawn, bool)
    for camera in cameras:
        towards = _unit(np.asarray(camera.center) - point)
        rows = np.flatnonzero(~seen & (_dot(normal, towards) > 0))
        seen[rows] = posed.is_free(point[rows] + LIFT_OFF * normal[rows], towards[rows])
    rows = np.flatnonzero(seen)[:count]
    return face[rows], barycentric[rows]


def render_all(
    views: Sequence[tuple[World, float, Camera]],
    samples: int = 4,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    shadow_rays: int = SHADOW_RAYS,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Render many views as ``render`` does, in order; the images do not depend on the number of processes.

    With more than one process, a calling script needs the guard ``if __name__ == "__main__"``, as always with
    Python's processes; they end with this generator.

    Args:
        views: world, time in [0, 1] and camera of each.
        samples: rays averaged into a pixel.
        workers: processes; None: one per processor, fewer for little work; 1: this process.
        progress: called with (images done, all images) after each.
        shadow_rays: shadow rays of each ray.
    """
    samples_of_all = samples * sum(camera.width * camera.height for _, _, camera in views)
    jobs = ((*view, samples, shadow_rays) for view in views)
    return counted(by_processes(render, jobs, samples_of_all, workers), len(views), progress)


def counted(images: Iterable, total: int, progress: Callable[[int, int], None] | None) -> Iterator:
    """Yield images, and call ``progress`` with (images done, ``total``) as each comes."""
    for done, image in enumerate(images, 1):
        if progress is not None:
            progress(done, total)
        yield image


def by_processes(function: Callable, jobs: Iterable[tuple], samples: float, workers: int | None) -> Iterator:
    """Yield ``function(*job)`` of each job, in order; with one worker in this process, else in others.

    Args:
        function: of a module, so that other processes find it.
        jobs: taken one by one, a few ahead of what is yielded.
        samples: of all jobs, about.
        workers: processes; None: one per processor, fewer for few samples.
    """
    workers = workers or max(1, min(cores(), int(samples / SAMPLES_A_PROCESS)))
    if workers == 1:
        yield from (function(*job) for job in jobs)
        return
    import_nothing_from_here()
    pool, waiting = ProcessPoolExecutor(workers, get_context("spawn"), _begin), deque()
    try:
        for job in jobs:
            # Pickled here: an executor would send each tensor through a file in shared memory.
            waiting.append(pool.submit(_call, function, pickle.dumps(job)))
            if len(waiting) > _AHEAD * workers:
                yield waiting.popleft().result()
        yield from (future.result() for future in waiting)
    finally:
        pool.shutdown(cancel_futures=True)


def _begin() -> None:
    """Set up a new process: leave Ctrl-C to the parent, and use one thread."""
    import_nothing_from_here()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)


def _call(function: Callable, job: bytes):
    return function(*pickle.loads(job))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nd,nd->n", a, b)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _blended(barycentric: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Blend values (n, 3, 3) at the corners of faces by barycentric coordinates (n, 3): (n, 3)."""
    return np.einsum("nc,ncd->nd", barycentric, corners)


def _cross(corners: np.ndarray) -> np.ndarray:
    """Return the normals (F, 3) of faces (F, 3, 3), twice as long as their areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _intersector(corners: np.ndarray, some: np.ndarray):
    """Make a function (origins, directions) -> index (n,) of the first face hit, of those that the mask
    ``some`` (F,) has; -1 for none.
    """
    try:
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError as error:
        expected = "making a scene: expected the packages trimesh and embreex, but they are missing"
        raise ImportError(f"{expected}; install forewarp[synth]") from error
    rows = np.append(np.flatnonzero(some), -1)  # the last is what a ray without a hit gets
    faces = np.arange(3 * (len(rows) - 1)).reshape(-1, 3)
    caster = RayMeshIntersector(trimesh.Trimesh(corners[some].reshape(-1, 3), faces, process=False))

    def first(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        # Embree refuses an empty list of rays.
        return rows[caster.intersects_first(origins, directions)] if len(origins) else rows[:0]

    return first
