"""From one stage to the next: where things are, and, where the preset carries, what they are."""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from forewarp.fields.voxel_grid import VoxelGrid
from forewarp.methods.spec import MethodSpec
from forewarp.ops.grid import dilate
from forewarp.scene.box import Box, Lattice
from forewarp.scene.frame import Scene
from forewarp.scene.hull import visual_hull
from forewarp.training.settings import StageSettings
from forewarp.training.structure import box_of_all_times, resample

MOST_BYTES = 1 << 26  # of a file that is read whole


@dataclass(frozen=True)
class Handover:
    """What a stage leaves to the next: the tight box over all training times and the unit of density.

    ``tight`` is False where the stage found nothing and its own box was kept; ``frames_in_play`` at its end.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    unit: float
    tight: bool
    frames_in_play: int

    @property
    def box(self) -> Box:
        """The next stage's box."""
        return Box(tuple(self.low), tuple(self.high))


def write_json(path: Path, content: dict) -> None:
    """Write beside, then rename, so that half a file is never taken for one."""
    beside = path.with_name(path.name + ".part")
    beside.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n")
    os.replace(beside, path)


def make_handover(
    method: nn.Module,
    scene: Scene,
    unit: float,
    frames_in_play: int,
    *,
    alpha: float,
    pad: float = 2.0,
) -> Handover:
    """The tight box of a fitted stage.

    Args:
        method: fitted.
        alpha: opacity over a voxel that counts as matter.
        pad: voxels of margin.
    """
    lattice = method.radiance.lattice
    box = box_of_all_times(method, list(scene.times), alpha=alpha, pad=pad)
    tight = box is not None
    box = box.intersection(scene.box.scaled(1.05)) if tight else lattice.box
    return Handover(box.low, box.high, unit, tight, frames_in_play)


def save_handover(handover: Handover, folder: Path) -> None:
    """Write ``handover.json``."""
    write_json(folder / "handover.json", asdict(handover))


def load_handover(folder: Path) -> Handover:
    """Read ``handover.json``.

    Raises:
        ValueError: where it is not what ``save_handover`` writes.
    """
    path = folder / "handover.json"
    try:
        handover = Handover(**(read_json(path) or {}))
        numbers = [*handover.box.low, *handover.box.high, handover.unit]
        if len(numbers) == 7 and all(math.isfinite(n) for n in numbers) and handover.unit > 0:
            return handover
    except (TypeError, ValueError):
        pass
    raise ValueError(f"{path}: expected what a stage leaves to the next, but got something else; delete it")


def read_json(path: Path) -> dict | None:
    """The object that a file of a run holds; None where there is no file, or none that is whole."""
    try:
        content = json.loads(path.read_text()) if path.stat().st_size <= MOST_BYTES else None
    except (FileNotFoundError, NotADirectoryError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) else None


def fresh_method(
    spec: MethodSpec, settings: StageSettings, scene: Scene, box: Box, unit: float | None, frames: list[int]
) -> tuple[nn.Module, float]:
    """A method that has seen nothing: active in the box or in the visual hull of ``frames``.

    Returns:
        the method and the unit of density.
    """
    lattice = Lattice.of_count(box, settings.at("voxels", 0.0))
    unit = unit or lattice.pitch
    active = torch.ones(lattice.shape, dtype=torch.bool)
    if settings.start == "hull" or (settings.start == "auto" and scene.has_alpha):
        active = _hull(scene, lattice, settings, frames)
    still = _still(spec, settings, scene, None)
    method = _build(spec, settings, scene, lattice, active, unit, still)
    for grid in (method.radiance, method.background):
        if grid is not None:
            _set_start_density(grid, settings.start_alpha)
    return method, unit


def carried_method(
    spec: MethodSpec, settings: StageSettings, scene: Scene, before: nn.Module, handover: Handover
) -> nn.Module:
    """The next stage's method, continued from the stage before on the tight box's lattice."""
    resample(before.radiance, handover.box, settings.at("voxels", 0.0), keep_alpha=settings.keep_alpha)
    source, still = before.radiance, _still(spec, settings, scene, before.background)
    method = _build(spec, settings, scene, source.lattice, source.index >= 0, handover.unit, still)
    for name in set(source.names) & set(method.radiance.names):
        method.radiance.parameter(name).data.copy_(source.parameter(name).data)
    own, theirs = method.state_dict(), before.state_dict()
    rest = {
        k: v
        for k, v in theirs.items()
        if torch.is_tensor(v) and k in own and own[k].shape == v.shape and not k.startswith("radiance.")
    }
    network = {
        k: v for k, v in theirs.items() if k.startswith("radiance.network") and own[k].shape == v.shape
    }
    own.update(rest | network)
    method.load_state_dict(own)
    return method


def _still(
    spec: MethodSpec, settings: StageSettings, scene: Scene, before: VoxelGrid | None
) -> tuple[Lattice, Tensor] | None:
    """Lattice and active voxels of the static background, continued from the stage before or all active."""
    if spec.background is None or "background" not in settings.effects:
        return None
    box, voxels = scene.box.scaled(1.05), settings.at("background_voxels", 0.0)  # holds every stage's box
    if before is None:
        lattice = Lattice.of_count(box, voxels)
        return lattice, torch.ones(lattice.shape, dtype=torch.bool)
    resample(before, box, voxels, keep_alpha=settings.keep_alpha)
    return before.lattice, before.index >= 0


def _build(
    spec: MethodSpec,
    settings: StageSettings,
    scene: Scene,
    lattice: Lattice,
    active: Tensor,
    unit: float,
    still: tuple[Lattice, Tensor] | None,
) -> nn.Module:
    return spec.build(
        lattice,
        active,
        unit=unit,
        scene_box=scene.box,
        frames=len(scene.times),
        canonical_time=scene.canonical_time,
        effects=settings.effects,
        upsample=settings.upsample,
        still=still,
    )


def _set_start_density(radiance: nn.Module, alpha: float) -> None:
    raw = radiance.activation.raw(alpha, radiance.lattice.pitch)
    with torch.no_grad():
        if "density" in radiance.names:
            radiance.parameter("density").fill_(raw)
        else:
            radiance.network[-1].bias[0] = raw


def _hull(scene: Scene, lattice: Lattice, settings: StageSettings, frames: list[int]) -> Tensor:
    if not scene.has_alpha:
        raise ValueError(
            f"stage.{settings.name}.start: expected box, since the images of '{scene.name}' have no alpha, "
            "but got hull"
        )
    count, times = settings.hull_frames, [scene.train[i].time for i in frames]
    while count < len(frames) and times[count] == times[count - 1]:
        count += 1  # all views of a time that is in: neighbouring cameras alone bound nothing
    frames, masks = frames[:count], []
    for i in frames:
        pixels = max(1, round(settings.hull_grow * scene.train[i].camera.width))
        masks.append(dilate(scene.train[i].load()[..., 3] > 127, pixels))
    points = lattice.to_world(lattice.all_voxels())
    hull = visual_hull(points, [scene.train[i].camera for i in frames], masks, settings.hull_misses)
    hull = hull.reshape(lattice.shape)
    return hull if bool(hull.any()) else torch.ones_like(hull)
