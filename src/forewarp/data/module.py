"""Data modules: one does the work, the others name a reader and its arguments."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cached_property, partial
from inspect import signature
from pathlib import Path

from lightning import LightningDataModule

from forewarp.data import dnerf, hypernerf, lego_complete, nhr, posed_video
from forewarp.data.batches import Sampler, Targets, color_of
from forewarp.data.cache import CACHE
from forewarp.data.fingerprint import RECORD, fingerprint
from forewarp.data.options import hold_out, with_canonical
from forewarp.scene.batch import Asks, Target
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Scene, spread

WATCHED = 8  # validation views at most that a run's PSNR curve measures where no views are held out


class SceneDataModule(LightningDataModule):
    """Serve one scene: batches to train on, whole images to compare with.

    There is no ``DataLoader``: a batch is a millisecond of tensor work, so worker processes would only cost.

    Args:
        read: gives the scene; called once, at the first use.
        rays: pixels of a batch; None where the method asks for whole pictures.
        background: behind training pixels: white, black or random (a colour each).
        eval_background: behind whole images: white or black; None: white behind cut-out pictures; as in
            training behind opaque ones, which do not teach what lies behind (black where that is random).
        seed: seed of the pixels, the background colours and the default choice of frames.
        views_per_step: training frames of one time that share a batch's rays.
        cache_bytes: most bytes of decoded images kept in the process; the last module's number counts.
        held_out: training frames that are never trained on (``hold_out``).
        canonical: another canonical time than the format's own (None): see ``with_canonical``.
        place: the scene's folder, where it has one.

    ``picker`` may be set at any time: a callable that chooses the training frame of the next batch.
    """

    def __init__(
        self,
        read: Callable[[], Scene],
        *,
        rays: int | None = 8192,
        background: str = "white",
        eval_background: str | None = None,
        seed: int = 0,
        views_per_step: int = 1,
        cache_bytes: int = 1_500_000_000,
        held_out: int = 0,
        canonical: str | float | None = None,
        place: str | Path | None = None,
    ) -> None:
        super().__init__()
        self.place = None if place is None else Path(place)
        self._read, self.cache_bytes, self.held_out = read, cache_bytes, held_out
        self._canonical = canonical
        self._draw = {"rays": rays, "background": background, "seed": seed, "views_per_step": views_per_step}
        self._eval_background = eval_background

    @cached_property
    def scene(self) -> Scene:
        """The scene; its protocol names the background that it is measured on."""
        scene = hold_out(with_canonical(self._read(), self._canonical), self.held_out)
        behind = self._behind(scene) if scene.has_alpha else "none"
        protocol = {**scene.protocol, "background": behind}
        if self.place is not None and any((p / RECORD).is_file() for p in (self.place, self.place.parent)):
            protocol["synthetic"] = True  # however it is read
        return replace(scene, protocol=protocol)

    def _behind(self, scene: Scene) -> str:
        if self._eval_background is not None:
            return self._eval_background
        if scene.has_alpha:
            return "white"
        return "black" if self._draw["background"] == "random" else self._draw["background"]

    @cached_property
    def batches(self) -> Sampler:
        """The stream of training batches."""
        return Sampler(self.scene, **self._draw)

    @property
    def picker(self) -> Callable[[], int] | None:
        """Chooses the training frame of the next batch; None: uniformly at random."""
        return self.batches.picker

    @picker.setter
    def picker(self, picker: Callable[[], int] | None) -> None:
        self.batches.picker = picker

    @property
    def asks(self) -> Asks:
        """What the trained method wants of a batch."""
        return self.batches.asks

    @asks.setter
    def asks(self, asks: Asks) -> None:
        self.batches.asks = asks

    def setup(self, stage: str | None = None) -> None:
        """Read the scene, once, and refuse bad settings."""
        CACHE.resize(self.cache_bytes)
        _ = self.batches
        color_of(self._behind(self.scene))

    def targets(self, split: str) -> Targets:
        """Give the whole images of ``train``, ``val``, ``test`` or ``held``."""
        if split not in ("train", "val", "test", "held"):
            raise SceneError(f"split: expected train, val, test or held, but got {split!r}")
        behind = color_of(self._behind(self.scene))
        return Targets(getattr(self.scene, split), behind, self.scene.has_alpha, trained=split == "train")

    def watched(self) -> Targets:
        """Choose the views of a run's PSNR curve: those held out, else up to 8 validation views."""
        if self.scene.held:
            return self.targets("held")
        val = self.targets("val")
        return Targets([val.frames[i] for i in spread(len(val), WATCHED)], val.background, val.has_alpha)

    def train_dataloader(self) -> Sampler:
        """Give the stream of batches."""
        return self.batches

    def val_dataloader(self) -> Iterable[Target]:
        """Give the validation images one by one; nothing where the scene has none."""
        # An empty iterator, as Lightning warns of a length of 0.
        return self.targets("val") if self.scene.val else iter(())

    def test_dataloader(self) -> Targets:
        """Give the test images one by one."""
        return self.targets("test")

    def restart(self, number: int) -> None:
        """Draw the next batches from the beginning of random stream ``number``."""
        self.batches.restart(number)

    def fingerprint(self) -> dict | None:
        """Take the fingerprint of the scene's files; None if there are no files."""
        return None if self.place is None else fingerprint(self.place)

    def state_dict(self) -> dict:
        """Save what an interrupted run needs to continue bit for bit."""
        return self.batches.state_dict()

    def load_state_dict(self, state_dict: dict) -> None:
        """Continue where ``state_dict`` was saved."""
        self.batches.load_state_dict(state_dict)


class _FolderDataModule(SceneDataModule):
    """The scene ``root/scene``; other arguments and their defaults are those of its format's reader and of
    ``SceneDataModule``.
    """

    _reader: Callable[..., Scene]
    _options: tuple[str, ...]  # what the reader takes

    def __init__(self, root: str | Path, scene: str, **options) -> None:
        read = {name: options.pop(name) for name in self._options if name in options}
        super().__init__(partial(self._reader, root, scene, **read), place=Path(root) / scene, **options)


def _options_of(reader: Callable) -> tuple[str, ...]:
    return tuple(name for name, p in signature(reader).parameters.items() if p.kind is p.KEYWORD_ONLY)


class DNeRFDataModule(_FolderDataModule):
    """A D-NeRF scene, as ``dnerf.read_scene`` reads it."""

    _reader, _options = staticmethod(dnerf.read_scene), _options_of(dnerf.read_scene)


class LegoCompleteDataModule(DNeRFDataModule):
    """A Lego Complete scene; options as of D-NeRF's."""

    _reader = staticmethod(lego_complete.read_scene)


class NHRDataModule(_FolderDataModule):
    """An NHR scene, as ``nhr.read_scene`` reads it."""

    _reader, _options = staticmethod(nhr.read_scene), _options_of(nhr.read_scene)


class PosedVideoDataModule(_FolderDataModule):
    """A capture with poses, as ``posed_video.read_scene`` reads it; ``canonical`` is the reader's."""

    _reader, _options = staticmethod(posed_video.read_scene), _options_of(posed_video.read_scene)


class HyperNeRFDataModule(_FolderDataModule):
    """A HyperNeRF capture, as ``hypernerf.read_scene`` reads it."""

    _reader, _options = staticmethod(hypernerf.read_scene), _options_of(hypernerf.read_scene)
