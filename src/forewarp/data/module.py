"""Data modules: one does the work, the others name a reader and its arguments."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from inspect import signature
from pathlib import Path

import torch
from lightning import LightningDataModule
from torch import Tensor

from forewarp.data import dnerf, hypernerf, multicam, nhr, posed_video
from forewarp.data.batches import Sampler, Targets, color_of
from forewarp.data.checks import check_seen
from forewarp.data.files import RECORD, fingerprint, mismatch, one_of, whole
from forewarp.data.films import STORE, films_of
from forewarp.data.images import CACHE
from forewarp.data.windows import cut
from forewarp.ops.backend import is_number
from forewarp.scene.frame import Scene, Truth, middle_of, spread
from forewarp.scene.view import Target

WATCHED = 8  # validation views at most that a run's PSNR curve measures where no views are held out
_SAME_TIME = 1e-6
_WINDOW = 0.08  # share of the sequence on either side of a time whose silhouettes are looked at
_SIDE = 100  # pixels of an image's shorter side that are enough to tell how spread out it is
_FAR = 0.2  # share by which an end of the sequence counts less than its middle


def hold_out(scene: Scene, count: int) -> Scene:
    """Move ``count`` training frames, evenly spaced over the sequence, to ``held``; always the same ones.

    The first and the last time and the canonical one keep all their frames: nothing lies beyond what was seen
    to compare with, and a stage starts from the canonical time. Where there is only one time, any of its
    frames may be held out.

    Args:
        scene: as read.
        count: frames; 0: none. At most half of those that may be held out.

    Raises:
        SceneError: where that is more than the scene can spare.
    """
    if whole(count, "data.held_out", 0) == 0:
        return scene
    kept = {scene.times[0], scene.times[-1], scene.canonical_time} if len(scene.times) > 1 else set()
    frames = sorted((f.time, i) for i, f in enumerate(scene.train) if f.time not in kept)
    if count > (most := len(frames) // 2):
        expected = f"at most {most} of the {len(scene.train)} training frames of {scene.name}"
        raise mismatch("data.held_out", expected, count, f"set data.held_out={most}")
    chosen = {frames[(2 * i + 1) * len(frames) // (2 * count)][1] for i in range(count)}
    train = tuple(frame for i, frame in enumerate(scene.train) if i not in chosen)
    held = tuple(scene.train[i] for i in sorted(chosen))
    return replace(scene, train=train, held=held, protocol={**scene.protocol, "held_out": count})


def only(scene: Scene, count: int | None) -> Scene:
    """Keep ``count`` training frames: the nearest to the canonical time, and others evenly spread; None: all.

    Raises:
        SceneError: for a number that is not whole, or below 1.
    """
    if count is None or whole(count, "data.train_views", 1) >= len(scene.train):
        return scene
    times = [frame.time for frame in scene.train]
    first = min(range(len(times)), key=lambda i: abs(times[i] - scene.canonical_time))
    order = sorted((i for i in range(len(times)) if i != first), key=lambda i: times[i])
    kept = {first, *(order[i] for i in spread(len(order), count - 1))}
    train = tuple(frame for i, frame in enumerate(scene.train) if i in kept)
    return replace(scene, train=train, protocol={**scene.protocol, "train_views": count})


def with_canonical(scene: Scene, canonical: str | float | None) -> Scene:
    """Make another training time canonical.

    Known trajectories are kept where they hold that time, which then comes first; else they are dropped.
    Kinds of test views keep their names: ``canonical`` is still the format's own time.

    Args:
        scene: as read.
        canonical: ``first``; ``middle``, the time nearest to the middle; ``spread``, the one whose
            silhouettes are most spread out (``spread_time``; ``middle`` where images have no alpha); a time
            in [0, 1]: the training time nearest to it. None changes nothing, nor does the time that is
            canonical already.

    Raises:
        SceneError: for anything else.
    """
    if canonical is None:
        return scene
    is_time = is_number(canonical) and 0 <= canonical <= 1
    if canonical not in ("first", "middle", "spread") and not is_time:
        raise mismatch("data.canonical", "first, middle, spread, a time in [0, 1] or null", repr(canonical))
    if is_time:
        time = min(scene.times, key=lambda t: abs(t - canonical))
    elif canonical == "first":
        time = scene.times[0]
    else:
        time = spread_time(scene) if canonical == "spread" and scene.has_alpha else middle_of(scene.times)
    if time == scene.canonical_time:
        return scene
    truth = None
    if scene.truth is not None:
        is_other = (scene.truth.times - time).abs() >= _SAME_TIME
        order = is_other.argsort(stable=True)
        truth = None if is_other.all() else Truth(scene.truth.points[:, order], scene.truth.times[order])
    protocol = {**scene.protocol, "canonical_time": time}
    return replace(scene, canonical_time=time, truth=truth, protocol=protocol)


def spread_time(scene: Scene) -> float:
    """Choose the time whose silhouettes are most spread out; of much the same, the one nearest to the middle.

    Parts that touch or hide each other in the canonical shape cannot be told apart later. Spread is the
    length of a silhouette's outline over the square root of its area, the mean over the frames within
    ``_WINDOW`` of the time; the first and the last time count ``_FAR`` less than the middle one, as motion
    is learned outwards.

    Cost: every training image is decoded, as training does anyway, and a third of a millisecond each.
    """
    spreads = []
    for frame in scene.train:
        mask = frame.load()[..., 3] > 127
        step = max(1, min(mask.shape) // _SIDE)
        spreads.append((frame.time, outline(mask[::step, ::step])))
    spreads.sort()
    first, last = spreads[0][0], spreads[-1][0]
    length = max(last - first, _SAME_TIME)

    def score(time: float) -> float:
        near = [value for t, value in spreads if abs(t - time) <= _WINDOW * length]
        return sum(near) / len(near) * (1 - _FAR * abs(2 * (time - first) / length - 1))

    return max(scene.times, key=lambda time: round(score(time), 9))


def outline(mask: Tensor) -> float:
    """Length of a silhouette's outline (H, W) over the square root of its area; 0 for an empty one.

    >>> import torch
    >>> square = torch.zeros(6, 6, dtype=torch.bool)
    >>> square[1:5, 1:5] = True
    >>> outline(square)  # 12 of its 16 pixels
    3.0
    """
    inside = torch.nn.functional.max_pool2d((~mask)[None].float(), 3, 1, 1)[0] == 0
    area = int(mask.sum())
    return float((mask & ~inside).sum()) / area**0.5 if area else 0.0


def _of_batches(name: str, meaning: str) -> property:
    """Make a property that is the stream's attribute ``name``."""

    def assign(self, value) -> None:
        setattr(self.batches, name, value)

    return property(lambda self: getattr(self.batches, name), assign, doc=meaning)


class SceneDataModule(LightningDataModule):
    """Serve one scene: batches to train on, whole images to compare with.

    There is no ``DataLoader``: a batch is a millisecond of tensor work, so worker processes would only cost.

    Args:
        read: gives the scene; called once, at the first use.
        rays: pixels of a batch; None where the method asks for whole images.
        background: behind training pixels: white, black or random (a colour each).
        eval_background: behind whole images: white or black; None: white behind cut-out images; as in
            training behind opaque ones, which do not teach what lies behind (black where that is random).
        seed: seed of the pixels, the background colours and the default choice of frames.
        views_per_step: training frames of one time that share a batch's rays.
        cache_bytes: most bytes of decoded images kept in the process; the last module's number counts.
        disk_cache_bytes: most bytes of decoded frames of films on disk, where they do not all fit into
            ``cache_bytes``; 0: none. They lie in ``frames_folder``, by default ``.frames`` beside the films.
        held_out: training frames that are never trained on (``hold_out``).
        train_views: most training frames to train on, of those that are left (``only``); None: all.
        canonical: another canonical time than the format's own (None): see ``with_canonical``.
        window: the part of a long film that is trained and measured; None: all of it. See ``cut``.
        place: the scene's folder, where it has one.
    """

    suspects: tuple[str, ...] = (  # likeliest causes of a bad fit, for who reads this format
        "numbers too small for the scene: preset=fast in place of preset=demo",
        "a method that needs more training: raise the budget",
        "motion or looks that the method cannot show: see docs, or model=particles",
    )
    picker = _of_batches("picker", "Chooses the training frame of the next batch; None: uniformly at random.")
    asks = _of_batches("asks", "What the trained method wants of a batch.")

    def __init__(
        self,
        read: Callable[[], Scene],
        *,
        rays: int | None = 8192,
        background: str = "white",
        eval_background: str | None = None,
        seed: int = 0,
        views_per_step: int = 1,
        cache_bytes: int = 1_000_000_000,
        disk_cache_bytes: int = 100_000_000_000,
        held_out: int = 0,
        train_views: int | None = None,
        canonical: str | float | None = None,
        window: Sequence[float] | None = None,
        place: str | Path | None = None,
    ) -> None:
        super().__init__()
        self.place = None if place is None else Path(place)
        self._read, self.cache_bytes, self.held_out = read, cache_bytes, held_out
        self.disk_cache_bytes, self.frames_folder = disk_cache_bytes, None
        self._canonical, self._eval_background, self._train_views = canonical, eval_background, train_views
        self._window = window
        self._draw = {"rays": rays, "background": background, "seed": seed, "views_per_step": views_per_step}

    @cached_property
    def scene(self) -> Scene:
        """The scene; its protocol names the background that it is measured on."""
        self._bound_caches()
        scene = with_canonical(cut(self._read(), self._window), self._canonical)
        scene = only(hold_out(scene, self.held_out), self._train_views)
        check_seen(scene)
        protocol = {**scene.protocol, "background": self._background(scene) if scene.has_alpha else "none"}
        if self.place is not None and any((p / RECORD).is_file() for p in (self.place, self.place.parent)):
            protocol["synthetic"] = True  # however it is read
        return replace(scene, protocol=protocol)

    def _background(self, scene: Scene) -> str:
        if self._eval_background is not None:
            return self._eval_background
        trained = "white" if scene.has_alpha else self._draw["background"]
        return "black" if trained == "random" else trained

    @cached_property
    def batches(self) -> Sampler:
        """The stream of training batches."""
        return Sampler(self.scene, **self._draw)

    def setup(self, stage: str | None = None) -> None:
        """Read the scene, once, refuse bad settings, and decode films that do not fit into memory."""
        self._bound_caches()
        _ = self.batches
        color_of(self._background(self.scene))
        trained = () if stage == "test" else (*self.scene.train, *self.scene.held)
        STORE.fill(films_of(frame.load for frame in (*trained, *self.scene.test)))

    def _bound_caches(self) -> None:
        CACHE.resize(self.cache_bytes)
        STORE.resize(self.frames_folder, self.disk_cache_bytes)

    def targets(self, split: str) -> Targets:
        """Give the whole images of ``train``, ``val``, ``test`` or ``held``."""
        one_of(split, "split", "train", "val", "test", "held")
        color = color_of(self._background(self.scene))
        return Targets(getattr(self.scene, split), color, self.scene.has_alpha, split == "train")

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
    _described_by: Callable[..., Scene]  # its keyword arguments are those of the reader

    def __init__(self, root: str | Path, scene: str, **options) -> None:
        names = [n for n, p in signature(self._described_by).parameters.items() if p.kind is p.KEYWORD_ONLY]
        read = {name: options.pop(name) for name in names if name in options}
        super().__init__(partial(self._reader, root, scene, **read), place=Path(root) / scene, **options)


class DNeRFDataModule(_FolderDataModule):
    """A D-NeRF scene, as ``dnerf.read_scene`` reads it."""

    _reader = _described_by = staticmethod(dnerf.read_scene)
    suspects = (
        "poses in other axes, or world-to-camera: data.axes=opencv, data.inverse=true",
        "a box, near or far that misses the subject: data.box=null data.near=null data.far=null",
        "times or poses that belong to other images: compare file_path, time and transform_matrix of a frame",
    )


class LegoCompleteDataModule(DNeRFDataModule):
    """A Lego Complete scene; options as of D-NeRF's."""

    _reader = staticmethod(dnerf.read_lego_complete)


class NHRDataModule(_FolderDataModule):
    """An NHR scene, as ``nhr.read_scene`` reads it."""

    _reader = _described_by = staticmethod(nhr.read_scene)
    suspects = (
        "images of another size than the intrinsics: data.half_resolution=false",
        "point clouds that miss the subject: data.box=[x0,y0,z0,x1,y1,z1]",
        "frames of the cameras that are not of one moment: compare the images of a number",
    )


class MulticamDataModule(_FolderDataModule):
    """A rig of fixed cameras, as ``multicam.read_scene`` reads it."""

    _reader = _described_by = staticmethod(multicam.read_scene)
    suspects = (
        "rows of poses_bounds.npy that belong to other cameras: they are in the order of the videos' names",
        "cameras that did not begin at one moment: compare the frames of a number",
        "near and far that miss the subject: data.near, data.far, data.box",
    )


class PosedVideoDataModule(_FolderDataModule):
    """A capture with poses, as ``posed_video.read_scene`` reads it."""

    _reader = _described_by = staticmethod(posed_video.read_scene)
    suspects = (
        "poses in other axes, or world-to-camera: data.axes=opencv, data.inverse=true",
        "poses found on what moves, or on captions: look at them with forewarp-view, mask what moves",
        "times that are not those of the images: give every frame its time in transforms.json",
    )


class HyperNeRFDataModule(_FolderDataModule):
    """A HyperNeRF capture, as ``hypernerf.read_scene`` reads it."""

    _reader = _described_by = staticmethod(hypernerf.read_scene)
    suspects = (
        "camera files in other axes: orientation is world-to-camera with OpenCV's axes",
        "scene.json's scale, center, near and far are not those of the cameras: data.box=null",
        "warp_id in metadata.json does not count the moments",
    )
