"""Cast rays exactly into a posed world: lit pictures, depth, surface points and their trajectories."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from forewarp.scene.camera import Camera
from forewarp.scene.frame import Truth
from forewarp.synth.shapes import Surface, color_of
from forewarp.synth.world import World

LIGHT_AT, LIGHT_RADIUS = np.array([2.2, -2.6, 4.6]), 0.45
AMBIENT, SKY, DIFFUSE = 0.60, 0.10, 0.40
# Per sample; four samples per pixel see two dozen points of the light, so shadows show no steps.
SHADOW_RAYS = 6
# Far above the error of float32, which embree computes in, and far below anything visible.
LIFT_OFF = 2e-4


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
        self.world, self.time = world, time
        light = world.light(time)
        self.light, self.there = LIGHT_AT if light is None else light, world.there(time)
        self.corners = world.place(time)[world.faces]  # (F, 3, 3)
        cross = np.cross(self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0])
        self.area = 0.5 * np.linalg.norm(cross, axis=-1)
        self.normal = cross / (2 * self.area[:, None])
        self.corner_normal = _corner_normals(world, cross, self.normal)
        self.finish = np.array([(p.material.gloss, p.material.shine) for p in world.parts])
        self._first = _intersector(self.corners, self.there)
        every = bool(world.casts.all())
        self._first_blocker = self._first if every else _intersector(self.corners, self.there & world.casts)

    def first_hits(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """Find the first hits of rays from ``origins`` (n, 3) along unit ``directions`` (n, 3)."""
        face = self._first(origins, directions)
        ray = np.flatnonzero(face >= 0)
        face = face[ray]
        barycentric = self._barycentric(face, origins[ray], directions[ray])
        point = np.einsum("nc,ncd->nd", barycentric, self.corners[face])
        distance = np.einsum("nd,nd->n", point - origins[ray], directions[ray])
        return Hits(ray, face, barycentric, distance)

    def is_free(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Tell which rays (n, 3), (n, 3) leave the world (n,); parts that cast no shadow are ignored."""
        return self._first_blocker(origins, directions) < 0

    def _barycentric(self, face: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Compute the hits in float64, as embree gives only the face; clamp grazing rays to their face."""
        a, b, c = (self.corners[face, i] for i in range(3))
        normal = 2 * self.area[face, None] * self.normal[face]
        across = np.cross(directions, origins - a)
        scale = np.einsum("nd,nd->n", directions, normal)
        scale = np.where(np.abs(scale) < 1e-15, 1e-15, scale)
        v = np.einsum("nd,nd->n", c - a, across) / scale
        w = -np.einsum("nd,nd->n", b - a, across) / scale
        weights = np.clip(np.stack([1 - v - w, v, w], -1), 0, 1)
        return weights / weights.sum(-1, keepdims=True)

    def color(self, hits: Hits, lights: np.ndarray, directions: np.ndarray | None = None) -> np.ndarray:
        """Light hits: colours (n, 3) in [0, 1]; ``lights`` (L, 3) are points of the area light.

        ``directions`` (R, 3): the rays' directions; without them nothing is glossy.
        """
        normal = np.einsum("nc,ncd->nd", hits.barycentric, self.corner_normal[hits.face])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        point = np.einsum("nc,ncd->nd", hits.barycentric, self.corners[hits.face])
        flat = self.normal[hits.face]
        diffuse = np.zeros(len(point))
        for light in lights:
            towards = light - point
            towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
            cosine = np.einsum("nd,nd->n", normal, towards)
            lit = np.flatnonzero((cosine > 0) & (np.einsum("nd,nd->n", flat, towards) > 0))
            free = self.is_free(point[lit] + LIFT_OFF * flat[lit], towards[lit])
            diffuse[lit] += cosine[lit] * free
        shade = AMBIENT + SKY * normal[:, 2] + DIFFUSE * diffuse / len(lights)
        color = self._albedo(hits) * shade[:, None]
        if directions is not None:
            color += self._glint(hits, normal, directions[hits.ray])[:, None]
        return np.clip(color, 0, 1)

    def _glint(self, hits: Hits, normal: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Compute the highlights of glossy parts (n,): Phong's ``gloss * cos^shine`` of the angle between the
        mirrored ray and the light's middle; shadows are ignored.
        """
        gloss, shine = (self.finish[self.world.part_of_face[hits.face], i] for i in (0, 1))
        mirrored = directions - 2 * np.einsum("nd,nd->n", directions, normal)[:, None] * normal
        cosine = mirrored @ (self.light / np.linalg.norm(self.light))
        return gloss * np.clip(cosine, 0, 1) ** shine

    def _albedo(self, hits: Hits) -> np.ndarray:
        world = self.world
        albedo = np.empty((len(hits.face), 3))
        part_of_hit = world.part_of_face[hits.face]
        for index in np.unique(part_of_hit):
            part, rows = world.parts[index], np.flatnonzero(part_of_hit == index)
            corners = world.rest[world.faces[hits.face[rows]]]
            position = np.einsum("nc,ncd->nd", hits.barycentric[rows], corners)
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
            low, high = part.vertices.min(0), part.vertices.max(0)
            albedo[rows] = color_of(part.material, Surface(position, (position - low) / (high - low), normal))
        return albedo


def render(
    world: World, time: float, camera: Camera, samples_per_pixel: int = 4, shadow_rays: int = SHADOW_RAYS
) -> tuple[np.ndarray, np.ndarray]:
    """Render one picture of the world at any time from any camera.

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
    posed = _posed(world, time)
    count = camera.height * camera.width
    total, hit = np.zeros((count, 3)), np.zeros(count)
    lights = light_points(samples_per_pixel * shadow_rays, posed.light)
    for i in range(samples_per_pixel):
        # The R1 sequence covers the pixel evenly with any number of samples; a single sample is the centre.
        offset = ((i + 0.5) / samples_per_pixel, (0.5 + i * 0.6180339887498949) % 1.0)
        rays = camera_rays(camera, offset)
        hits = posed.first_hits(*rays)
        total[hits.ray] += posed.color(hits, lights[i::samples_per_pixel], rays[1])
        hit[hits.ray] += 1
    rgb = total / np.maximum(hit, 1)[:, None]
    rgba = np.concatenate([rgb, hit[:, None] / samples_per_pixel], -1)
    centre = posed.first_hits(*camera_rays(camera))
    depth = np.zeros(count, dtype=np.float32)
    depth[centre.ray] = centre.distance
    shape = camera.height, camera.width
    return np.rint(255 * rgba).astype(np.uint8).reshape(*shape, 4), depth.reshape(shape)


@lru_cache(1)
def _posed(world: World, time: float) -> Posed:
    """Pose a world once for all cameras of one time."""
    return Posed(world, time)


def camera_rays(camera: Camera, offset: tuple[float, float] = (0.5, 0.5)) -> tuple[np.ndarray, np.ndarray]:
    """Make origins and unit directions (H*W, 3) float64 through one spot of every pixel, row by row."""
    columns = torch.arange(camera.width, dtype=torch.float64) + offset[0]
    rows = torch.arange(camera.height, dtype=torch.float64) + offset[1]
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    directions = camera.directions(u.flatten(), v.flatten()).numpy()
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


def _corner_normals(world: World, cross: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Compute normals (F, 3, 3) at the corners of faces: averaged in smooth parts, else flat."""
    normals = np.repeat(flat[:, None], 3, axis=1)
    faces = world.faces[world.smooth]
    summed = np.zeros((len(world.rest), 3))
    np.add.at(summed, faces, cross[world.smooth][:, None])
    chosen = summed[faces]
    normals[world.smooth] = chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)
    return normals


def _intersector(corners: np.ndarray, some: np.ndarray):
    """Make a function (origins, directions) -> index (n,) of the first face hit, of those that the mask
    ``some`` (F,) has; -1 for none.
    """
    try:
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector
    except ImportError as error:
        raise ImportError(
            "making a scene: expected the packages trimesh and embreex, but they are missing; "
            "install forewarp[synth]"
        ) from error
    rows = np.append(np.flatnonzero(some), -1)  # the last is what a ray without a hit gets
    faces = np.arange(3 * (len(rows) - 1)).reshape(-1, 3)
    caster = RayMeshIntersector(trimesh.Trimesh(corners[some].reshape(-1, 3), faces, process=False))

    def first(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        if len(origins) == 0:
            return np.zeros(0, dtype=np.int64)
        return rows[caster.intersects_first(origins, directions)]

    return first


# Candidates per wanted point: about half of the surface is never visible.
_SPARE = 4


def surface_points(
    world: World,
    count: int,
    centers: np.ndarray,
    rng: np.random.Generator,
    time: float = 0.0,
    among: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw points uniformly by area on the surface that is visible at one time.

    Args:
        world: the world.
        count: number of points; fewer are drawn only if hardly anything is visible.
        centers: camera centres (C, 3); a point is visible if at least one camera sees it.
        rng: the same state gives the same points.
        time: time at which points must be visible.
        among: (F,) bool, faces to draw from; None: all that are there.

    Returns:
        faces (N,) and barycentric coordinates (N, 3), which ``World.points`` places at any time.
    """
    posed = Posed(world, time)
    drawn = _SPARE * count
    cumulative = np.cumsum(posed.area * (posed.there if among is None else posed.there & among))
    face = np.searchsorted(cumulative, rng.random(drawn) * cumulative[-1], side="right")
    # The square root makes the density even over the triangle.
    a, b = np.sqrt(rng.random(drawn)), rng.random(drawn)
    barycentric = np.stack([1 - a, a * (1 - b), a * b], -1)
    seen = np.flatnonzero(_is_seen(posed, face, barycentric, centers))[:count]
    return face[seen], barycentric[seen]


def trajectories(world: World, faces: np.ndarray, barycentric: np.ndarray, times: np.ndarray) -> Truth:
    """Follow surface points (N) over ``times`` (T,), the canonical time first; float32 world units."""
    points = np.stack([world.points(faces, barycentric, t) for t in times], 1)
    return Truth(torch.from_numpy(points.astype(np.float32)), torch.from_numpy(np.asarray(times, np.float64)))


def _is_seen(posed: Posed, face: np.ndarray, barycentric: np.ndarray, centers: np.ndarray) -> np.ndarray:
    point = np.einsum("nc,ncd->nd", barycentric, posed.corners[face])
    normal = posed.normal[face]
    seen = np.zeros(len(face), dtype=bool)
    for center in centers:
        towards = center - point
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        rows = np.flatnonzero(~seen & (np.einsum("nd,nd->n", normal, towards) > 0))
        seen[rows] = posed.is_free(point[rows] + LIFT_OFF * normal[rows], towards[rows])
    return seen
