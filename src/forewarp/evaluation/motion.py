"""Measure motion and canonical shape of a fitted scene, and store what the paper's figures of them show.

``motion.npz`` in a run's folder has arrays; norms are of world units, NaN where nothing is:

* where the true motion is known, ``times`` (T,), ``place`` and ``point`` (3,); ``true_backward`` at the place
  and ``true_forward`` of the point, and, of methods that have them, ``backward`` and ``forward`` (T,);
  ``shots`` (S, H, W, 3) uint8 at ``shot_times`` with ``marks`` (S, 2, 2), pixels (x, y) of both;
* of V canonical views ``canonical_rgb`` (V, H, W, 3) uint8, ``canonical_depth`` (V, H, W), 0 where it is
  clear, and, where they are known, ``true_rgb`` and ``true_depth``;
* in the first of these views ``paths`` and ``true_paths`` (N, T, 2) of points in pixels (x, y).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forewarp.drawing.images import to_bytes
from forewarp.evaluation.images import within
from forewarp.evaluation.trajectories import moving_points
from forewarp.files import written_whole
from forewarp.methods.method import HasBackwardFlow, HasMatter, HasTrajectories
from forewarp.metrics.geometry import chamfer
from forewarp.metrics.variation import variation
from forewarp.scene.camera import Camera
from forewarp.scene.cloud import far_apart
from forewarp.scene.frame import Frame, Scene, Truth, spread
from forewarp.scene.view import Moment, View
from forewarp.training.module import DynamicSceneModule

FILE = "motion.npz"
COVERED = 0.8  # least share of the times at which followed points cover a place
SIDE = 200  # most pixels of the longer side of a stored picture
_TIMES = 51  # most times of a curve
_CELLS = 40  # along the longest side of the lattice of places, around what moves
_MOVED = 0.25  # least range of a place's flow, as a share of the farthest that any point goes
_ROWS = 200  # most places, and most points, of which medians are taken
_MATTER = 20_000  # most points of matter that are followed
_VIEWS = 2  # canonical pictures
_SHAPE = 10, 1024  # of a chamfer distance: most views, and about so many pixels of each
_PATHS, _STEPS = 60, 41  # drawn trajectories, and their vertices
_SAME = 1e-6


@dataclass(frozen=True)
class Flows:
    """Places that followed points cover in turn, and points that pass them. The first of either is shown.

    Attributes:
        times: (T,) ascending.
        places: (K, 3) float32.
        backward: (K, T), how far what covers a place is from where it was at the canonical time; NaN where no
            point is within ``reach``.
        points: (N, 3) float32, at the canonical time.
        forward: (N, T), how far the points are from there.
        reach: world units.
    """

    times: np.ndarray
    places: np.ndarray
    backward: np.ndarray
    points: np.ndarray
    forward: np.ndarray
    reach: float


def true_flows(truth: Truth) -> Flows | None:
    """Search a lattice of places for those that points of moving surfaces cover at 80 % of the times or more.

    A point covers a place within twice the distance between neighbouring points. Of places whose flow has at
    least a quarter of the range of the motion, that comes first where it jumps most, single times aside; of
    points the one that covers it and goes farthest.

    Returns:
        them, or None if there is no such place.
    """
    from scipy.ndimage import median_filter  # late, as their import takes time
    from scipy.spatial import cKDTree

    order = np.argsort(truth.times.numpy(), kind="stable")
    order = order[spread(len(order), _TIMES)]
    paths = truth.points.double().numpy()
    canonical, paths, times = paths[:, 0], paths[:, order], truth.times.numpy()[order]
    went = np.linalg.norm(paths - canonical[:, None], axis=-1)
    farthest = went.max()
    moving = paths[went.max(1) > 0.1 * farthest]
    if not farthest > 0 or len(paths) < 2:
        return None
    low, high = moving.min((0, 1)), moving.max((0, 1))
    step = (high - low).max() / _CELLS
    axes = [np.arange(begin + step / 2, max(end, begin + step), step) for begin, end in zip(low, high)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    reach = 2 * float(np.median(cKDTree(canonical).query(canonical, 2)[0][:, 1]))
    nearest = [cKDTree(at).query(places, distance_upper_bound=reach)[1] for at in paths.transpose(1, 0, 2)]
    rows = np.stack(nearest, 1)
    covered = rows < len(paths)
    backward = np.where(covered, went[np.minimum(rows, len(paths) - 1), np.arange(len(times))], np.nan)
    scores = {}
    for place in np.flatnonzero(covered.mean(1) >= COVERED):
        norms = backward[place, covered[place]]
        if np.ptp(norms) >= _MOVED * farthest:
            scores[place] = variation(median_filter(norms, 3, mode="nearest")) or 0.0
    if not scores:
        return None
    best = max(scores, key=scores.get)
    others = [place for place in scores if place != best]
    chosen = [best, *(others[i] for i in spread(len(others), _ROWS - 1))]
    passing = np.unique(rows[best, covered[best]])
    point = passing[went[passing].max(1).argmax()]
    others = np.setdiff1d(np.flatnonzero(np.ptp(went, axis=1) >= _MOVED * farthest), point)
    shown = [point, *(others[i] for i in spread(len(others), _ROWS - 1))]
    of_places = places[chosen].astype(np.float32), backward[chosen]
    return Flows(times, *of_places, canonical[shown].astype(np.float32), went[shown], reach)


@torch.no_grad()
def learned_flows(module: DynamicSceneModule, flows: Flows) -> dict[str, np.ndarray]:
    """Return the method's own norms at the same places and points, of the kinds that it has: ``backward``
    (K, T), ``forward`` (N, T).

    A method without a backward flow of its own has that of the matter which it carries to a place.
    """
    method, device = module.method, module.device
    times, places = flows.times.tolist(), torch.from_numpy(flows.places).to(device)
    found = {}
    if isinstance(method, HasTrajectories):
        points = torch.from_numpy(flows.points).to(device)
        paths = method.trajectories(points, torch.tensor(times, device=device).float())
        found["forward"] = (paths - points[:, None]).norm(dim=-1).cpu().double().numpy()
    if isinstance(method, HasBackwardFlow):
        norms = [method.backward_flow(places, time).norm(dim=-1) for time in times]
        found["backward"] = torch.stack(norms, 1).cpu().double().numpy()
    elif isinstance(method, HasTrajectories) and isinstance(method, HasMatter):
        found["backward"] = _carried(module, flows)
    return found


def _carried(module: DynamicSceneModule, flows: Flows) -> np.ndarray:
    """Return how far (K, T) the matter nearest to each place is from where it was; NaN where none is near."""
    from scipy.spatial import cKDTree

    matter = module.method.matter()
    points = matter.points[spread(len(matter.points), _MATTER)]
    if not len(points):
        return np.full(flows.backward.shape, np.nan)
    paths = module.method.trajectories(points, torch.tensor(flows.times, device=points.device).float())
    went = (paths - points[:, None]).norm(dim=-1).cpu().double().numpy()
    reach, norms = max(flows.reach, matter.size), []
    for i, at in enumerate(paths.cpu().double().numpy().transpose(1, 0, 2)):
        rows = cKDTree(at).query(flows.places, distance_upper_bound=reach)[1]
        norms.append(np.where(rows < len(at), went[np.minimum(rows, len(at) - 1), i], np.nan))
    return np.stack(norms, 1)


def median_variation(curves: np.ndarray, known: np.ndarray) -> float | None:
    """Return the median of ``variation`` over curves (K, T), each at the times that ``known`` (K, T) has too.

    None if no curve has enough of them.
    """
    found = []
    for curve, true in zip(curves, known):
        common = np.isfinite(curve) & np.isfinite(true)
        if common.sum() >= COVERED * np.isfinite(true).sum() and (value := variation(curve[common])):
            found.append(value)
    return float(np.median(found)) if found else None


@torch.no_grad()
def shape_error(module: DynamicSceneModule, scene: Scene) -> dict[str, float] | None:
    """Return ``metrics.geometry.chamfer`` between the rendered and the true surface at the canonical time.

    Both are the points that the same rays hit, of test views of that time whose depth is known; a rendered
    ray hits where it is more than half opaque. None where there is no such view, or nothing is hit.
    """
    frames = [f for f in canonical_frames(scene) if f.load_depth is not None]
    if not frames:
        return None
    snapshot, black = module.method.at(Moment(scene.canonical_time)), torch.zeros(3, device=module.device)
    drawn_points, true_points = [], []
    for frame in (frames[i] for i in spread(len(frames), _SHAPE[0])):
        camera = frame.camera
        stride = max(1, round((camera.width * camera.height / _SHAPE[1]) ** 0.5))
        pixels = torch.arange(camera.width * camera.height).reshape(camera.height, camera.width)
        pixels = pixels[stride // 2 :: stride, stride // 2 :: stride].flatten()
        view = View(camera, pixels)
        drawn, depth, rays = snapshot.render(view, black), frame.load_depth().flatten()[pixels], view.rays()
        for points, far, hit in (
            (drawn_points, drawn.depth.cpu(), (drawn.opacity > 0.5).cpu()),
            (true_points, depth, depth > 0),
        ):
            points.append(rays.origins[hit] + far[hit, None] * rays.directions[hit])
    return chamfer(torch.cat(drawn_points), torch.cat(true_points))


def canonical_frames(scene: Scene) -> list[Frame]:
    """List the test frames of the canonical time."""
    return [frame for frame in scene.test if abs(frame.time - scene.canonical_time) < _SAME]


@torch.no_grad()
def measure_motion(module: DynamicSceneModule, datamodule, folder: Path, pictures: bool) -> dict[str, dict]:
    """Return entries of ``metrics.json``; with ``pictures`` also write ``motion.npz``.

    Args:
        module: the fitted scene.
        datamodule: serves ``scene`` and ``targets("test")``.
        folder: the run's folder.
        pictures: whether to search for places, and to draw.

    **Cost** of pictures: about that of six test views of 200 pixels, and a second where the motion is known.
    """
    scene, entries, arrays = datamodule.scene, {}, {}
    if (shape := shape_error(module, scene)) is not None:
        entries["canonical_shape"] = shape
    if not pictures or not scene.test:
        (folder / FILE).unlink(missing_ok=True)  # of an earlier measurement
        return entries
    flows = true_flows(scene.truth) if scene.truth is not None else None
    if flows is not None:
        learned = learned_flows(module, flows)
        truth = {"backward": flows.backward, "forward": flows.forward}
        entries["flow_variation"] = {
            "places": len(flows.places),
            "points": len(flows.points),
            **{f"true_{name}": median_variation(curves, curves) for name, curves in truth.items()},
            **{name: median_variation(curves, truth[name]) for name, curves in learned.items()},
        }
        arrays |= {"times": flows.times, "place": flows.places[0], "point": flows.points[0]}
        arrays |= {f"true_{name}": curves[0] for name, curves in truth.items()}
        arrays |= {name: curves[0] for name, curves in learned.items()}
        arrays |= _shots(module, datamodule, flows)
    arrays |= _canonical(module, datamodule)
    with written_whole(folder / FILE) as beside:
        np.savez_compressed(beside, **arrays)
    return entries


def _drawn(module: DynamicSceneModule, camera: Camera, time: float, background: Tensor):
    """Render an image; return colours (H, W, 3) uint8, and depth (H, W) float32, 0 where it is clear."""
    drawn = module.render(camera, Moment(time), background).shaped(camera.height, camera.width)
    return to_bytes(drawn.rgb), torch.where(drawn.opacity > 0.5, drawn.depth, 0.0).float().numpy()


def _shots(module: DynamicSceneModule, datamodule, flows: Flows) -> dict[str, np.ndarray]:
    """Draw the canonical time, that of the longest backward flow, and the last, seen towards the place."""
    scene, truth = datamodule.scene, datamodule.scene.truth
    longest = float(flows.times[np.nanargmax(flows.backward[0])])
    at = list(dict.fromkeys([scene.canonical_time, longest, float(flows.times[-1])]))
    columns = [int((truth.times - time).abs().argmin()) for time in at]
    place, point = (torch.from_numpy(given[:1]) for given in (flows.places, flows.points))
    row = int((truth.points[:, 0] - point).square().sum(-1).argmin())
    cameras = {tuple(f.camera.center.tolist()): f.camera for f in scene.train}
    occluders = truth.points[:, columns].reshape(-1, 3)

    def hides(camera: Camera) -> tuple[bool, int]:
        """Whether the place is outside the image, and how many points are before it."""
        center = camera.center.to(place)
        ray, away = place[0] - center, occluders - center
        along = away @ ray / ray.square().sum()
        aside = (away - along[:, None] * ray).norm(dim=-1)
        near = (along > 0) & (along < 1 - 2 * flows.reach / float(ray.norm())) & (aside < flows.reach)
        pixel, depth = camera.project(place)
        size = pixel.new_tensor([camera.width, camera.height])
        inside = bool(((pixel > 0.1 * size) & (pixel < 0.9 * size)).all()) and float(depth) > 0
        return not inside, int(near.sum())

    camera = within(min(cameras.values(), key=hides), SIDE)
    background = datamodule.targets("test").background.to(module.device)
    marks = [torch.cat([place, truth.points[row, i][None]]) for i in columns]
    return {
        "shots": np.stack([_drawn(module, camera, time, background)[0] for time in at]),
        "shot_times": np.array(at),
        "marks": np.stack([camera.project(points)[0].numpy() for points in marks]),
    }


def _canonical(module: DynamicSceneModule, datamodule) -> dict[str, np.ndarray]:
    """Draw the canonical time from a few test cameras, with the truth if known, and trajectories."""
    scene, targets = datamodule.scene, datamodule.targets("test")
    true_frames = canonical_frames(scene)
    frames = true_frames or scene.test
    frames = [frames[i] for i in spread(len(frames), _VIEWS)]
    size = frames[0].camera.width, frames[0].camera.height
    frames = [f for f in frames if (f.camera.width, f.camera.height) == size]
    cameras = [within(frame.camera, SIDE) for frame in frames]
    drawn = [
        _drawn(module, camera, scene.canonical_time, targets.background.to(module.device))
        for camera in cameras
    ]
    found = {"canonical_rgb": np.stack([rgb for rgb, _ in drawn])}
    found["canonical_depth"] = np.stack([depth for _, depth in drawn])
    if true_frames:
        found |= _true_views(targets, frames, cameras[0])
    return found | _paths(module, scene, cameras[0])


def _true_views(targets, frames: Sequence[Frame], camera: Camera) -> Mapping[str, np.ndarray]:
    """Return the true images, and depths if known, of frames as large as ``camera``."""
    of_frames = [targets[targets.frames.index(frame)] for frame in frames]
    shape = camera.height, camera.width
    resized = torch.nn.functional.interpolate
    rgb = [
        resized(target.rgb.movedim(-1, 0)[None], shape, mode="area")[0].movedim(0, -1) for target in of_frames
    ]
    found = {"true_rgb": np.stack([to_bytes(image) for image in rgb])}
    if all(target.depth is not None for target in of_frames):
        depth = [
            resized(target.depth[None, None].float(), shape, mode="nearest-exact")[0, 0]
            for target in of_frames
        ]
        found["true_depth"] = torch.stack(depth).numpy()
    return found


def _paths(module: DynamicSceneModule, scene: Scene, camera: Camera) -> dict[str, np.ndarray]:
    """Project trajectories of points of the moving surface, true ones where the motion is known."""
    method, truth, found = module.method, scene.truth, {}
    able = isinstance(method, HasTrajectories)
    times = torch.linspace(0, 1, _STEPS)
    if truth is not None:
        order = truth.times.argsort()
        order = order[spread(len(order), _STEPS)]
        times, paths = truth.times[order].float(), truth.points[:, order]
        reach = (truth.points - truth.points[:, :1]).norm(dim=-1).amax(1)
        moving = (reach > 0.15 * reach.max()).nonzero()[:, 0]
        rows = moving[far_apart(truth.points[moving, 0], _PATHS)]
        points = truth.points[rows, 0]
        found["true_paths"] = paths[rows]
    elif able and isinstance(method, HasMatter):
        points = moving_points(module, [frame.camera for frame in scene.train], _PATHS)
    else:
        return {}
    if able:
        found["paths"] = method.trajectories(points.to(module.device), times.to(module.device)).cpu()
    return {name: camera.project(points)[0].float().numpy() for name, points in found.items()}
