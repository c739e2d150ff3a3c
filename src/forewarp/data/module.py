"""Data modules: one does all the work, the others name a reader and its arguments."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

from lightning import LightningDataModule

from forewarp.data import dnerf
from forewarp.data.batches import RayBatches, Targets, color_of
from forewarp.scene.batch import Target
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Scene


class SceneDataModule(LightningDataModule):
    """Serves one scene: ray batches to train on, whole images to compare with.

    The streams are handed out as they are, without a ``DataLoader``: a batch is a millisecond of tensor work,
    so worker processes would only cost.

    Args:
        read: gives the scene; called once, at the first use.
        rays: per batch.
        background: behind training rays: white, black or random (a colour per ray, needs alpha).
        eval_background: behind whole images: white or black.
        seed: of the pixels, the background colours and the default choice of frames.

    ``picker`` may be set at any time: a callable that says from which training frame the next batch comes.
    """

    def __init__(
        self,
        read: Callable[[], Scene],
        *,
        rays: int = 8192,
        background: str = "white",
        eval_background: str = "white",
        seed: int = 0,
    ) -> None:
        super().__init__()
        self._read = read
        self._draw = {"rays": rays, "background": background, "seed": seed}
        self.eval_background = eval_background

    @cached_property
    def scene(self) -> Scene:
        """The scene, whose protocol names the background that it is measured on."""
        scene = self._read()
        behind = self.eval_background if scene.has_alpha else "none"
        return replace(scene, protocol={**scene.protocol, "background": behind})

    @cached_property
    def batches(self) -> RayBatches:
        """The one stream of training batches."""
        return RayBatches(self.scene, **self._draw)

    @property
    def picker(self) -> Callable[[], int] | None:
        """Says from which training frame the next batch comes; None is uniformly at random."""
        return self.batches.picker

    @picker.setter
    def picker(self, picker: Callable[[], int] | None) -> None:
        self.batches.picker = picker

    def setup(self, stage: str | None = None) -> None:
        """Read the scene, once, and refuse settings that it does not allow."""
        color_of(self.eval_background)
        _ = self.batches

    def targets(self, split: str) -> Targets:
        """The whole images of ``train``, ``val`` or ``test``."""
        if split not in ("train", "val", "test"):
            raise SceneError(f"split: expected train, val or test, but got {split!r}")
        return Targets(getattr(self.scene, split), color_of(self.eval_background), self.scene.has_alpha)

    def train_dataloader(self) -> RayBatches:
        """The stream of batches, each of one time."""
        return self.batches

    def val_dataloader(self) -> Iterable[Target]:
        """The validation images one by one; nothing where the scene has none."""
        # An empty iterator, as Lightning warns of what has the length 0.
        return self.targets("val") if self.scene.val else iter(())

    def test_dataloader(self) -> Targets:
        """The test images one by one."""
        return self.targets("test")

    def restart(self, number: int) -> None:
        """Let the next batches be those of stream ``number``, whatever was drawn before."""
        self.batches.restart(number)

    def state_dict(self) -> dict:
        """What an interrupted run needs to draw on bit for bit."""
        return self.batches.state_dict()

    def load_state_dict(self, state_dict: dict) -> None:
        """Draw on where ``state_dict`` was taken."""
        self.batches.load_state_dict(state_dict)


class DNeRFDataModule(SceneDataModule):
    """The D-NeRF scene ``root/scene``; arguments as in ``dnerf.read_scene`` and ``SceneDataModule``."""

    def __init__(
        self,
        root: str | Path,
        scene: str,
        *,
        half_resolution: bool | str = "auto",
        box: Sequence[float] | None = None,
        near: float = 2.0,
        far: float = 6.0,
        **common,
    ) -> None:
        options = {"half_resolution": half_resolution, "box": box, "near": near, "far": far}
        super().__init__(partial(dnerf.read_scene, root, scene, **options), **common)
