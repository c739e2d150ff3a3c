"""What is fuzzed: tiny scenes of every format, a run's config and its checkpoint, each with what reads it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from forewarp.data import dnerf, hypernerf, lego_complete, nhr, posed_video
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Scene, Truth
from forewarp.scene.lens import Lens
from forewarp.scene.view import Moment, View

_SIZE, _DEPTH = (12, 8), np.full((8, 12), 3.0, np.float32)  # width and height, as images and arrays have them

_SMALL = (
    "experiment=demo",
    "stage.coarse.num_voxels=[[0,64]]",
    "data.root=data",
    "logger=none",
    "trainer=cpu",
)


@dataclass(frozen=True)
class Target:
    """A folder of files that are mutated, and what reads them: ``attempt()`` raises what ``refusals`` are
    where they are not good.
    """

    name: str
    folder: Path
    attempt: Callable[[], None]
    refusals: tuple[type[Exception], ...]


def targets(root: Path) -> list[Target]:
    """All of them, written below ``root``."""
    return [*scene_targets(root), *run_targets(root)]


def scene_targets(root: Path) -> list[Target]:
    """The readers of datasets."""
    kinds = {"dnerf": dnerf, "lego_complete": lego_complete, "hypernerf": hypernerf, "nhr": nhr}
    kinds["video_with_poses"] = posed_video
    found = []
    for name, kind in kinds.items():
        _WRITE[name](root / name)
        read = kind.read_scene
        found.append(
            Target(name, root / name, lambda read=read, name=name: _use(read(root, name)), (SceneError,))
        )
    return found


def run_targets(root: Path) -> list[Target]:
    """The loaders of what a run's folder holds."""
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from forewarp.runs.build import build_run
    from forewarp.runs.config import saved_config
    from forewarp.runs.config_files import configurations
    from forewarp.training.checkpoints import check_state, load_weights

    root.joinpath("config").mkdir()
    root.joinpath("checkpoint").mkdir()
    with initialize_config_dir(str(configurations()), version_base="1.3"):
        config = compose("train", list(_SMALL))
    config = OmegaConf.create(OmegaConf.to_container(config, resolve=True))
    (root / "config" / "config.yaml").write_text(OmegaConf.to_yaml(config))
    scene = dnerf.read_scene(root, "dnerf")
    module = build_run(config).rebuilt("coarse", scene)
    content = {"state_dict": module.state_dict(), "global_step": 7}
    module.on_save_checkpoint(content)
    file = root / "checkpoint" / "last.ckpt"
    torch.save(content, file)
    nothing = OmegaConf.create({})
    camera, white = scene.test[0].camera, torch.ones(3)

    def draw() -> None:
        """Read, take and use it: a kernel that believes what it should not ends the process."""
        check_state(file, module)
        load_weights(module, file)
        module.render(View(camera, torch.arange(4)), Moment(0.5), white)

    return [
        Target("config", root / "config", lambda: saved_config(str(root / "config"), nothing), (ValueError,)),
        Target("checkpoint", file.parent, draw, (ValueError, OSError)),
    ]


def _use(scene: Scene) -> None:
    """Load what a run would, and be sure that it fits together."""
    for frame in (*scene.train, *scene.val, *scene.test):
        camera, pixels = frame.camera, frame.load()
        if tuple(pixels.shape) != (camera.height, camera.width, 4) or not 0 <= camera.near < camera.far:
            raise AssertionError(f"{frame.name}: {tuple(pixels.shape)}, {camera}")
        if not bool(torch.isfinite(camera.rays(torch.arange(3)).directions).all()):
            raise AssertionError(f"{frame.name}: {camera}")
        if frame.load_depth is not None and not bool(torch.isfinite(frame.load_depth()).all()):
            raise AssertionError(f"{frame.name}: depth")


def _cameras(count: int, distance: float = 4.0) -> list[Camera]:
    """Cameras around the origin, the second and every other one with a lens."""
    found = []
    for i in range(count):
        angle = 1.7 * i
        center = distance * torch.tensor([np.cos(angle), np.sin(angle), 0.4], dtype=torch.float64)
        pose = look_at(center, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
        lens = Lens((0.1, -0.05, 0.0), (0.01, 0.0)) if i % 2 else None
        found.append(Camera(*_SIZE, 13.0, 13.0, 6.0, 4.0, pose, 1.0, 7.0, lens=lens))
    return found


def _pixels(channels: int, seed: int) -> np.ndarray:
    shape = (_SIZE[1], _SIZE[0], channels)
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def _truth(times: Sequence[float]) -> Truth:
    points = torch.arange(2.0 * len(times) * 3).reshape(2, len(times), 3) / 10
    return Truth(points, torch.tensor(times, dtype=torch.float64))


def _dnerf(folder: Path, abilities: Sequence[str] = ("all",)) -> None:
    def shots(ability: str, count: int):
        for i, camera in enumerate(_cameras(count)):
            depth = None if ability == "all" else _DEPTH
            time = 0.0 if ability == "canonical" else i / max(count - 1, 1)
            yield dnerf.Shot(f"r_{i}", time, camera.camera_to_world, _pixels(4, i), depth, ability)

    test = [shot for ability in abilities for shot in shots(ability, 1)]
    splits = {"train": shots("all", 3), "val": shots("all", 1), "test": test}
    dnerf.write_scene(folder, splits, camera_angle_x=0.8, trajectories=_truth((0.0, 0.5, 1.0)))


def _hypernerf(folder: Path) -> None:
    shots = (
        hypernerf.RigShot(
            f"{'lr'[i % 2]}_{i}", i // 2, i % 2, ("train", "val")[i % 3 > 1], camera, _pixels(3, i)
        )
        for i, camera in enumerate(_cameras(6))
    )
    about = {"center": (0.1, 0.0, 0.0), "scale": 0.2, "near": 0.2, "far": 1.4, "scales": (1, 2)}
    hypernerf.write_scene(
        folder, shots, points=np.ones((3, 3)), trajectories=_truth((0.5, 0.0, 1.0)), **about
    )


def _nhr(folder: Path) -> None:
    cameras = [Camera(*_SIZE, 13.0, 13.0, 6.0, 4.0, c.camera_to_world, 1.0, 7.0) for c in _cameras(3)]
    mask = np.full(_DEPTH.shape, 255, np.uint8)
    cloud = np.concatenate([np.eye(3), np.full((3, 3), 128.0)], 1).astype(np.float32)
    frames = (nhr.DomeFrame([_pixels(3, f + i) for i in range(3)], [mask] * 3, cloud) for f in range(2))
    nhr.write_scene(folder, cameras, frames, trajectories=_truth((0.0, 1.0)))


def _video(folder: Path) -> None:
    shots = (
        posed_video.PosedShot(f"f_{i}.{'png' if i % 2 else 'jpg'}", camera, _pixels(3, i), i / 8)
        for i, camera in enumerate(_cameras(9))
    )
    posed_video.write_scene(folder, shots, near=1.0, far=7.0)


_WRITE = {
    "dnerf": _dnerf,
    "lego_complete": lambda folder: _dnerf(folder, dnerf.ABILITIES),
    "hypernerf": _hypernerf,
    "nhr": _nhr,
    "video_with_poses": _video,
}
