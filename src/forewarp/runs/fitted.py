"""Open a fitted run as an object, for notebooks and scripts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from forewarp.data.batches import color_of
from forewarp.files import read_json
from forewarp.methods.abilities import HasMatter, HasTrajectories
from forewarp.methods.method import Method, Snapshot
from forewarp.runs.build import build_run
from forewarp.runs.config import saved_config
from forewarp.runs.data_check import warn_if_changed
from forewarp.runs.trust import trust_of
from forewarp.scene.camera import Camera
from forewarp.scene.cloud import Cloud
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Moment, View
from forewarp.training.module import DynamicSceneModule
from forewarp.training.stages import Run

SPLITS = ("train", "val", "test", "held")


@dataclass
class Fitted:
    """A fitted scene, as ``forewarp.load(folder)`` returns it.

    >>> import forewarp
    >>> scene = forewarp.load(fitted_run)
    >>> frame = scene.frames("test")[0]
    >>> picture = scene.render(frame.camera, frame.time)
    >>> picture.shape == (frame.camera.height, frame.camera.width, 3)
    True
    >>> points = scene.matter().points[:5]
    >>> scene.trajectories(points, [0.0, 0.5, 1.0]).shape
    torch.Size([5, 3, 3])
    >>> sorted(scene.metrics["test"])
    ['canonical', 'space', 'time']

    Attributes:
        folder: the run's folder.
        config: the run's config.
        module: the fitted module; ``module.method`` is the method.
        scene: cameras, times, box.
    """

    folder: Path
    config: DictConfig
    module: DynamicSceneModule
    scene: Scene
    _snapshot: Snapshot | None = field(default=None, repr=False)

    @property
    def method(self) -> Method:
        """The fitted method."""
        return self.module.method

    @property
    def metrics(self) -> dict:
        """The content of ``metrics.json``; empty if the run was not measured."""
        return read_json(self.folder / "metrics.json") or {}

    def frames(self, split: str = "test") -> tuple[Frame, ...]:
        """List the frames of ``train``, ``val``, ``test`` or ``held``: names, times, cameras, pictures."""
        if split not in SPLITS:
            raise ValueError(f"split: expected one of {', '.join(SPLITS)}, but got {split!r}")
        return getattr(self.scene, split)

    def render(self, camera: Camera, time: float, background: str | Tensor = "white") -> Tensor:
        """Render the scene from a camera at a time: a picture (H, W, 3) in [0, 1], on the CPU.

        Args:
            camera: ``frame.camera``, or one of your own; ``camera.resized(w, h)`` changes the size.
            time: time in [0, 1].
            background: white, black, or a colour (3,) in [0, 1].

        Cost: consecutive pictures of one time share one snapshot.
        """
        if not 0 <= time <= 1:
            raise ValueError(f"time: expected a number in [0, 1], but got {time}")
        behind = color_of(background) if isinstance(background, str) else background
        moment = Moment(float(time))
        with torch.no_grad():
            if self._snapshot is None or not self._snapshot.holds(moment):
                self._snapshot = self.method.at(moment)
            drawn = self._snapshot.render(View(camera), behind.to(self.module.device))
        return drawn.rgb.clamp(0, 1).reshape(camera.height, camera.width, 3).cpu()

    def trajectories(self, points: Tensor, times: Sequence[float]) -> Tensor:
        """Follow canonical points (N, 3), world units, to ``times`` (T,) in [0, 1]; return (N, T, 3)."""
        method = self._able(HasTrajectories, "follows points")
        with torch.no_grad():
            at = torch.as_tensor(times, dtype=torch.float32, device=self.module.device)
            return method.trajectories(points.to(self.module.device), at).cpu()

    def matter(self) -> Cloud:
        """Return the canonical matter as points with colour and opacity."""
        with torch.no_grad():
            return self._able(HasMatter, "tells where matter is").matter()

    def _able(self, ability: type, what: str) -> Method:
        if not isinstance(self.method, ability):
            raise ValueError(f"model: expected a method that {what}, but got {self.config.model.name}")
        return self.method


def opened(config: DictConfig, device: str | torch.device | None = None) -> tuple[Run, DynamicSceneModule]:
    """Open a finished run to look at it; warn if its data have changed since.

    Args:
        config: of ``saved_config``.
        device: None: the one that the config's trainer names.

    Returns:
        the run, and its fitted module.

    Raises:
        ValueError: naming the wrong key of the config, or a stage that is not finished.
    """
    run = build_run(config)
    module = run.load().to(device or run.device)
    warn_if_changed(run)
    return run, module.eval()


def open_run(run: str | Path, *, trust: Sequence[str] | str = (), device: str = "cpu") -> Fitted:
    """Load a finished run from its folder; see ``forewarp.load``."""
    changes = OmegaConf.create({"trust": list(trust_of(trust))})
    config = saved_config(str(run), changes)
    made, module = opened(config, device)
    return Fitted(Path(run), config, module, made.datamodule.scene)
