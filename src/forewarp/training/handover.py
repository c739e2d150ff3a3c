"""From one stage to the next: where things are, and, where the preset carries, what they are."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from forewarp.methods.spec import MethodSpec
from forewarp.scene.box import Box, Lattice
from forewarp.scene.frame import Scene
from forewarp.scene.hull import visual_hull
from forewarp.training.settings import StageSettings
from forewarp.training.structure import box_of_all_times, resample


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
    alpha: float = 1e-2,
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
    """Read ``handover.json``."""
    return Handover(**json.loads((folder / "handover.json").read_text()))


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
    if settings.start == "hull":
        active = _hull(scene, lattice, settings, frames)
    method = _build(spec, settings, scene, lattice, active, unit)
    _set_start_density(method.radiance, settings.start_alpha)
    return method, unit


def carried_method(
    spec: MethodSpec, settings: StageSettings, scene: Scene, before: nn.Module, handover: Handover
) -> nn.Module:
    """The next stage's method, continued from the stage before on the tight box's lattice."""
    resample(before.radiance, handover.box, settings.at("voxels", 0.0), keep_alpha=settings.keep_alpha)
    source = before.radiance
    method = _build(spec, settings, scene, source.lattice, source.index >= 0, handover.unit)
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


def _build(
    spec: MethodSpec, settings: StageSettings, scene: Scene, lattice: Lattice, active: Tensor, unit: float
):
    return spec.build(
        lattice,
        active,
        unit=unit,
        scene_box=scene.box,
        frames=len(scene.times),
        canonical_time=scene.canonical_time,
        effects=settings.effects,
        upsample=settings.upsample,
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
    frames = frames[: settings.hull_frames]
    masks = []
    for i in frames:
        pixels = max(1, round(settings.hull_grow * scene.train[i].camera.width))
        alpha = (scene.train[i].load()[..., 3] > 127).float()
        grown = torch.nn.functional.max_pool2d(alpha[None], 2 * pixels + 1, stride=1, padding=pixels)
        masks.append(grown[0].bool())
    points = lattice.to_world(lattice.all_voxels())
    hull = visual_hull(points, [scene.train[i].camera for i in frames], masks, settings.hull_misses)
    hull = hull.reshape(lattice.shape)
    return hull if bool(hull.any()) else torch.ones_like(hull)
