"""The paper's four datasets: what of them lies in a folder, and whether it is complete and as published."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from forewarp.data.files import SceneError, frames_of, inside, mismatch, opened, read_json
from forewarp.files import MOST_IMAGE, decoded
from forewarp.media import open_image

AS_PUBLISHED, COMPLETE, INCOMPLETE, ABSENT = "as published", "complete", "incomplete", "absent"
_PNG, _JPEG = ".png", ".jpg"
_FRAMES = 100  # of an NHR recording that the paper uses
_SPLITS = ("train", "val", "test")
_DIGITS = 32  # of a digest
_MARKS = ("transforms_train.json", "scene.json", "CamPose.inf")  # files of which each scene has one
_DEEP = 3  # levels of folders in which a scene is looked for that is not where it belongs


@dataclass(frozen=True)
class Found:
    """What there is of a scene: its ``state``, one of four, and that in words."""

    scene: str
    state: str
    words: str = ""

    @property
    def is_complete(self) -> bool:
        """Whether it can be trained and measured on."""
        return self.state in (AS_PUBLISHED, COMPLETE)


@dataclass(frozen=True)
class Dataset:
    """A dataset of the paper.

    Attributes:
        name: as the paper has it.
        folder: its own in the folder of all scenes.
        licence: under which its authors gave it away.
        where: its authors keep it.
        scenes: of each what ``check`` compares it with.
        check: of the scene's folder and that; returns state and words, and raises SceneError where it is not
            complete.
    """

    name: str
    folder: str
    licence: str
    where: str
    scenes: Mapping[str, object]
    check: Callable[[Path, object], tuple[str, str]] = field(repr=False)

    def found(self, root: Path) -> Iterator[Found]:
        """Look at each scene below ``root``, the folder of all datasets; see ``check``."""
        places = [root, *_folders_in(root, _DEEP)]
        for scene, wanted in self.scenes.items():
            folder = root / self.folder / scene
            if not _is_scene(folder):
                others = (place / scene for place in places if place / scene != folder)
                if (
                    other := next((p for p in others if self._is_misplaced(p, root, wanted)), None)
                ) is not None:
                    target = folder.relative_to(root).as_posix()
                    words = f"found in {other.relative_to(root).as_posix()}: move it to {target}"
                    if other.parent == root and root.resolve().name == self.folder:
                        words = f"found in {other}: check the folder above, {root.resolve().parent}"
                    yield Found(scene, ABSENT, words)
                    continue
            if not folder.is_dir():
                yield Found(scene, ABSENT)
                continue
            try:
                yield Found(scene, *self.check(folder, wanted))
            except SceneError as error:
                yield Found(scene, INCOMPLETE, str(error))

    def _is_misplaced(self, other: Path, root: Path, wanted: object) -> bool:
        """Tell whether a folder of a scene's name holds it: in the dataset's own folder one of its kind
        does, elsewhere one that is complete, as other datasets have scenes of these names, too.
        """
        if not _is_scene(other):
            return False
        if (root / self.folder) in other.parents:
            return True
        try:
            self.check(other, wanted)
        except SceneError:
            return False
        return True


@dataclass(frozen=True)
class Blender:
    """A scene of one ``transforms_<split>.json`` a split: how many images each has.

    Attributes:
        counts: by split.
        poses, everything: ``digest_of`` the transforms, and of the images too; None: not known.
        size: of the published images.
    """

    counts: Mapping[str, int]
    poses: str | None = None
    everything: str | None = None
    size: tuple[int, int] | None = None


def _is_scene(folder: Path) -> bool:
    return any((folder / name).is_file() for name in _MARKS)


def _folders_in(folder: Path, deep: int) -> Iterator[Path]:
    """Yield the folders in a folder, down to ``deep`` levels, without links, in the order of their names."""
    with suppress(OSError), os.scandir(folder) as entries:
        inner = sorted(entry.path for entry in entries if entry.is_dir(follow_symlinks=False))
        for path in map(Path, inner):
            yield path
            if deep > 1:
                yield from _folders_in(path, deep - 1)


def digest_of(folder: Path, names: Iterable[str]) -> str:
    """Return a digest of files' names and contents: SHA-256 of a line for each, Git's number of the content
    and the name.
    """
    digest = hashlib.sha256()
    for name in sorted(names):
        with opened(folder / name, MOST_IMAGE) as stream:
            content = stream.read()
        blob = hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False)
        digest.update(f"{blob.hexdigest()} {name}\n".encode())
    return digest.hexdigest()[:_DIGITS]


def _check_blender(folder: Path, wanted: Blender) -> tuple[str, str]:
    images = []
    for split, count in wanted.counts.items():
        file = folder / f"transforms_{split}.json"
        frames = frames_of(file, read_json(file))
        if len(frames) != count:
            raise mismatch(f"{file}: frames", f"{count}, as published", len(frames), "get it again")
        paths = (inside(folder, f.get("file_path"), f.where("file_path")) for f in frames)
        images += [path if path.suffix == _PNG else Path(f"{path}{_PNG}") for path in paths]
    sizes = _sizes_of(folder, images)
    words = f"{' + '.join(map(str, wanted.counts.values()))} images of {_by(sizes)}"
    transforms = [f"transforms_{split}.json" for split in wanted.counts]
    if wanted.poses is None:
        return COMPLETE, words
    if digest_of(folder, transforms) != wanted.poses:
        return COMPLETE, f"{words}; transforms_*.json are not the published ones"
    names = [*transforms, *(path.relative_to(folder).as_posix() for path in images)]
    if digest_of(folder, names) == wanted.everything:
        return AS_PUBLISHED, f"{words}, every byte"
    if sizes == {wanted.size}:
        return COMPLETE, f"{words}; poses are the published ones, some images are not"
    is_half = sizes == {tuple(side // 2 for side in wanted.size)}
    as_measured = "half as large, as the protocol measures them" if is_half else "of another size"
    return COMPLETE, f"{words}; poses are the published ones, images {as_measured}"


def _check_hypernerf(folder: Path, wanted: int) -> tuple[str, str]:
    where = folder / "dataset.json"
    ids = read_json(where).get("ids")
    if not isinstance(ids, list) or not ids:
        raise mismatch(f"{where}: ids", "a list of names", "none", "get it again")
    for name in ("metadata.json", "scene.json"):
        read_json(folder / name)
    cameras = [inside(folder / "camera", f"{item}.json", f"{where}: ids") for item in ids]
    _refuse_missing(folder, cameras)
    images = [inside(folder / "rgb" / "2x", f"{item}{_PNG}", f"{where}: ids") for item in ids]
    words = f"{len(ids)} images of {_by(_sizes_of(folder, images))} (rgb/2x)"
    if len(ids) not in (wanted, 2 * wanted):  # of one phone, or of both
        return COMPLETE, f"{words}; the authors' table counts {wanted}"
    return COMPLETE, words


def _check_nhr(folder: Path, wanted: int) -> tuple[str, str]:
    counts = {}
    for name in ("CamPose.inf", "Intrinsic.inf"):
        with opened(folder / name) as stream:
            counts[name] = len(
                [line for line in decoded(stream.read(), folder / name).split("\n") if line.strip()]
            )
    cameras, there = counts["CamPose.inf"], folder / "img"
    numbers = [int(path.name) for path in there.glob("*") if path.name.isdecimal()] if there.is_dir() else []
    numbers = sorted(numbers)[:wanted]
    if len(numbers) < wanted:
        raise mismatch(there, f"{wanted} frames, numbered folders", len(numbers), "get it again")
    names = [f"img_{camera:04d}{_JPEG}" for camera in range(cameras)]
    images = [there / str(number) / name for number in numbers for name in names]
    _refuse_missing(folder, [there / str(number) / "mask" / name for number in numbers for name in names])
    clouds = [folder / "pointclouds" / f"frame{number + 1}.npy" for number in numbers]
    _refuse_missing(folder, [path for path in clouds if not path.with_suffix(".obj").is_file()])
    return COMPLETE, f"{wanted} frames of {cameras} cameras, images of {_by(_sizes_of(folder, images))}"


def _refuse_missing(folder: Path, paths: Sequence[Path]) -> None:
    missing = [path for path in paths if not path.is_file()]
    if missing:
        first = missing[0].relative_to(folder).as_posix()
        got = f"{len(missing)} missing, the first {first}"
        raise mismatch(folder, f"{len(paths)} files", got, "get it again")


def _sizes_of(folder: Path, images: Sequence[Path]) -> set[tuple[int, int]]:
    """Return the sizes of images; SceneError where one is missing, or none."""
    _refuse_missing(folder, images)
    sizes = set()
    for path in images:
        with opened(path, MOST_IMAGE, "an image") as stream:
            try:
                sizes.add(open_image(stream).size)
            except Exception as error:  # whatever Pillow raises
                raise mismatch(path, "a PNG or JPEG", "another file", "get it again") from error
    return sizes


def _by(sizes: set[tuple[int, int]]) -> str:
    return " and ".join(f"{width} x {height}" for width, height in sorted(sizes))


def _of_dnerf(**scenes: tuple[int, int, str, str]) -> dict[str, Blender]:
    made = {}
    for scene, (count, val, poses, everything) in scenes.items():
        made[scene] = Blender(dict(zip(_SPLITS, (count, val, 20))), poses, everything, (800, 800))
    return made


_LEGO = Blender({"train": 50, "test_space": 200, "test_time": 197, "test_canonical": 50})
DATASETS = (
    Dataset(
        "D-NeRF",
        "dnerf",
        "none is stated for the data (the code is MIT), models of others are in it: for research",
        "github.com/albertpumarola/D-NeRF links to it",
        _of_dnerf(
            hellwarrior=(100, 20, "0dfdfb4e5cf297fba98f66930c5981e4", "c49445125b5f7dd16e53c447b2c17b62"),
            mutant=(150, 20, "463a8f9f3184fbc906beef9397af702e", "cc476d11e867b6c8ca5ea334ba6be592"),
            hook=(100, 20, "f233fa21bd807077ab05e6034adae95c", "ebd2ed8f5c34aba955777b438fe5dc49"),
            bouncingballs=(150, 20, "02e7a61e71951cbdb0ea846f230b2aae", "d3efb1845adf769125093751d5234cd3"),
            lego=(50, 11, "9e552560f321c071a0bd064ee5cefb9f", "3f338aaa376915422929500972206ac8"),
            trex=(200, 20, "954f37f819f1a8f264424d1d4933432c", "58fa52c0b3b9f7e6a9eba63058b5980e"),
            standup=(150, 20, "fe9b3e940d1219a190153a2e73186dde", "09c9538a38fd9d7b9c44a18351089d9e"),
            jumpingjacks=(200, 20, "6b495c2c339836bcca546165ecde9316", "c1ebac5cd88bc50f5dae49dd98a9b7e3"),
        ),
        _check_blender,
    ),
    Dataset(
        "HyperNeRF",
        "hypernerf",
        "none is stated for the captures (the code is Apache 2.0)",
        "the releases of github.com/google/hypernerf",
        {"vrig-3dprinter": 207, "broom2": 197, "vrig-chicken": 164, "vrig-peel-banana": 513},
        _check_hypernerf,
    ),
    Dataset(
        "NHR",
        "nhr",
        "CC BY-NC-SA 4.0: not commercial",
        "the page of github.com/wuminye/NHR",
        dict.fromkeys(("sport_1", "sport_2", "sport_3", "basketball"), _FRAMES),
        _check_nhr,
    ),
    Dataset(
        "Lego Complete",
        "lego_complete",
        "the authors' own is unpublished; our counterpart is made here",
        "forewarp-synthesize dataset=lego_complete folder={root}/lego_complete",
        dict.fromkeys(("lift", "lift_tilt", "drive"), _LEGO),
        _check_blender,
    ),
)
