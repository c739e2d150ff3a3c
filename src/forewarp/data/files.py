"""Read the small files of a dataset, check what they hold, and take a fingerprint of all its files."""

from __future__ import annotations

import glob
import hashlib
import json
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from math import inf, isfinite
from numbers import Integral
from pathlib import Path
from reprlib import repr as short
from typing import BinaryIO
from unicodedata import category, normalize
from urllib.parse import unquote

from forewarp.files import MOST_BYTES, check_size, load_json

MOST_FRAMES = 1_000_000
_MOST_SHARED = 100_000_000  # keys that all frames of a file share, times frames
MOST_THREADS = max(256, os.cpu_count() or 1)  # beyond, libraries fail without a word
LAYOUTS = {  # what people call a layout: a file or folder that every scene of it has, and what reads it
    "HyperNeRF": ("dataset.json", "experiment=hypernerf"),
    "NHR": ("CamPose.inf", "experiment=nhr"),
    "D-NeRF": ("transforms_train.json", "experiment=dnerf"),
    "nerfstudio": ("transforms.json", "experiment=video_with_poses"),
    "COLMAP": ("sparse", "forewarp-capture images=<its images> colmap=<its sparse/0>"),
    "DyNeRF": ("poses_bounds.npy", "experiment=multicam"),
    "LLFF": ("poses_bounds.npy", "experiment=video_with_poses"),  # one camera: a row for each of images/
}
# What other programs leave: who, files or folders by which it is known, and the way from there.
_WRITE = "write its cameras and images as transforms.json (docs/own-data.md says how)"
_FOREIGN = (
    ("Polycam's raw data", "keyframes/", "ns-process-data polycam --data {0} --output-dir OUT, then OUT"),
    ("Record3D's EXR export", "EXR_RGBD/", "export .r3d instead, for forewarp-capture video=SCAN.r3d"),
    ("Record3D's export", "rgbd/", "zip it to SCAN.r3d with metadata, for forewarp-capture video=SCAN.r3d"),
    ("MegaSaM", "*_droid.npz", f"{_WRITE}: images, cam_c2w (OpenCV's axes), intrinsic, depths"),
    ("MegaSaM", "*sgd_cvd*.npz", f"{_WRITE}: images, cam_c2w (OpenCV's axes), intrinsic, depths"),
    ("ARKitScenes", "lowres_wide*/", _WRITE),
    ("TUM's RGB-D data", "groundtruth.txt", _WRITE),
    ("CMU Panoptic for Dynamic 3D Gaussians", "train_meta.json", _WRITE),
    ("light field videos", "models.json", _WRITE),
    ("NeuS or IDR", "cameras*.npz", _WRITE),
    ("3D Gaussian Splatting's output", "cameras.json", _WRITE),
    (
        "Metashape",
        "*.xml",
        "ns-process-data metashape --data IMAGES --xml {0}/FILE.xml --output-dir OUT, then OUT",
    ),
    ("an archive", "*.npz", f"{_WRITE}, if it has cameras"),
)
SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
# Suffixes of images that are not read.
UNREAD = {".webp", ".tif", ".tiff", ".heic", ".heif", ".avif", ".bmp", ".gif", ".jxl", ".jp2", ".exr"}
# Names of files, folders and keys of masks and depth, as programs call them.
SIDE = re.compile(
    r"(?i)(?:^|[^a-z])(?:dynamic_?|motion_?|resized_?)?(mask|depth|disparity|disp|matte|segm?|segmentation)"
    r"(?:s|_?maps?)?(?![a-z])"
)
# Words of names of files that go with an image, and words that may stand in their place in the image's name.
_BESIDE = re.compile(
    r"(?i)(?<![a-z])(?:dynamic_?|motion_?)?(mask|depth|disparity|disp|matte|segm?|segmentation|alpha|normal"
    r"|flow|thumb(?:nail)?)(?:s|_?maps?)?(?![a-z])"
)
_PICTURE = re.compile(r"(?i)(?<![a-z])(?:colou?r|rgb|image|img|frame|picture|pic)s?(?![a-z])")
RECORD = "synthesis.json"  # of every synthesised scene, or folder of them
LOCK = ".lock"  # of every folder of a run
_UNPRINTABLE = {"Cc", "Cs", "Zl", "Zp"}  # control characters, surrogates, line and paragraph separators
# What a fingerprint takes: the content of small files, name and size of large ones.
_READ = {".json", ".inf", ".txt", ".csv"}
_LISTED = {".png", ".jpg", ".jpeg", ".npy", ".npz", ".ply", ".obj", ".mp4", ".mov", ".mkv", ".avi", ".webm"}


class SceneError(ValueError):
    """The user's input or files are wrong; the message is one line."""


def mismatch(where: object, expected: str, got: object, advice: str = "") -> SceneError:
    """Make the error that something is not as expected; ``where`` names file and key.

    >>> mismatch("a.json: time", "a number", "'noon'", "remove it")
    SceneError("a.json: time: expected a number, but got 'noon'; remove it")
    """
    return SceneError(f"{where}: expected {expected}, but got {got}" + (f"; {advice}" if advice else ""))


@contextmanager
def opened(path: Path, most: int = MOST_BYTES, what: str = "a readable file") -> Iterator[BinaryIO]:
    """Open a regular file of at most ``most`` bytes.

    Raises:
        SceneError: where it cannot be read, naming ``what`` was expected, and for any ValueError within.
    """
    try:
        check_size(path, most)
        with path.open("rb") as stream:
            yield stream
    except OSError as error:
        advice = nearly(path) if isinstance(error, FileNotFoundError) else ""
        raise mismatch(path, what, error.strerror or error, advice) from error
    except ValueError as error:
        raise error if isinstance(error, SceneError) else SceneError(str(error)) from error


def nearly(path: Path) -> str:
    """Say which file or folder is there in place of a missing one, whose name differs by case, by its suffix
    or by zeros in front of numbers; nothing where there is none.
    """
    if not path.parent.is_dir():
        return nearly(path.parent) if path.parent != path else ""

    def core(name: str) -> str:
        stem = re.sub(r"(\.[a-z]\w{2,4})+$", "", name.casefold())
        return re.sub(r"\d+", lambda digits: digits[0].lstrip("0"), stem)

    with suppress(OSError):  # a folder that may not be listed
        for name in sorted(name for name in os.listdir(path.parent) if core(name) == core(path.name)):
            advice = ": convert it to PNG or JPEG" if Path(name).suffix.lower() in UNREAD else ""
            return f"{path.parent.name}/{name} is there{advice}"
    return ""


def read_bytes(path: Path, most: int = MOST_BYTES, what: str = "a readable file") -> bytes:
    """Read a file; SceneError as ``opened``."""
    with opened(path, most, what) as stream:
        return stream.read()


def read_json(path: Path, top: type = dict) -> dict | list:
    """Read the object of a JSON file, or the list where ``top`` is list.

    Raises:
        SceneError: where the file is missing, too large, does not parse (with the line) or holds other data.
    """
    with opened(path):
        return load_json(path, top)


def number(value: object, where: str, low: float = -inf, high: float = inf) -> float:
    """Check a finite number, ``low <= value <= high``; ``where`` names file and key.

    >>> number(1, "a.json: time", 0, 1)
    1.0
    """
    is_real = isinstance(value, int | float) and not isinstance(value, bool)
    # An integer may be beyond every float.
    if not (is_real and abs(value) <= sys.float_info.max and low <= value <= high):
        within = "" if (low, high) == (-inf, inf) else f" in [{low:g}, {high:g}]"
        is_text = isinstance(value, str) and re.fullmatch(r"\s*[-+]?\d*\.?\d+([eE][-+]?\d+)?\s*", value)
        raise mismatch(where, f"a number{within}", short(value), "write it without quotes" if is_text else "")
    return float(value)


def one_of(value: object, where: str, *allowed: object, advice: str = "") -> None:
    """Refuse a value that is none of those ``allowed``; ``where`` names the key.

    >>> one_of("yes", "data.half", True, False, "auto")
    Traceback (most recent call last):
    forewarp.data.files.SceneError: data.half: expected true, false or auto, but got 'yes'
    >>> one_of(1, "data.half", True, False)
    Traceback (most recent call last):
    forewarp.data.files.SceneError: data.half: expected true or false, but got 1
    """
    if not any(type(value) is type(each) and value == each for each in allowed):
        *texts, last = (json.dumps(each).strip('"') for each in allowed)  # as YAML writes them
        raise mismatch(where, f"{', '.join(texts)} or {last}", short(value), advice)


def whole(value: object, where: str, least: int, multiple: int = 1) -> int:
    """Check a whole number of at least ``least`` that ``multiple`` divides; ``where`` names the key to set.

    >>> whole(16, "size", 8)
    16
    """
    is_whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not is_whole or value < least or value % multiple:
        kind = "a whole number" if multiple == 1 else f"a multiple of {multiple}"
        raise mismatch(where, f"{kind} of at least {least}", short(value), f"set {where}=...")
    return int(value)


def threads_of(value: object, where: str = "threads") -> int:
    """Check a number of threads that a system can begin; ``where`` names the key to set."""
    if (count := whole(value, where, 1)) > MOST_THREADS:
        raise mismatch(where, f"at most {MOST_THREADS}", count, f"set {where}={os.cpu_count()}")
    return count


def numbers_of(words: list[str], count: int, where: str) -> list[float]:
    """Parse ``count`` finite numbers of a line of text.

    >>> numbers_of(["1", "2.5"], 2, "a.txt: line 1")
    [1.0, 2.5]
    """
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not all(map(isfinite, values)):
        got = f"{len(words)} values" if values and len(values) != count else repr(" ".join(words))[:60]
        raise mismatch(where, f"{count} finite numbers", got)
    return values


def inside(folder: Path, name: object, where: str) -> Path:
    """Join a path to ``folder``; refuse one that leads out of it.

    Judged by the text alone, so a folder may link to where its images really are. A backslash separates, as
    files written on Windows have it. A file whose name is there in another Unicode form is that, as is one
    that is only there without the escapes of URLs, ``%20``.
    """
    is_text = isinstance(name, str) and not any(category(c) in _UNPRINTABLE for c in name)
    normal = os.path.normpath(name.replace("\\", "/")) if is_text and name else ".."
    if os.path.isabs(normal):
        for home in (os.path.abspath(folder), os.path.realpath(folder)):
            normal = normal.removeprefix(os.path.join(home, ""))
    is_drive = re.match("[A-Za-z]:", normal)  # of Windows
    if is_drive or os.path.isabs(normal) or normal.split(os.sep)[0] in ("..", "."):
        raise mismatch(where, "a path inside the scene folder", short(name), _end_inside(folder, normal))
    path, plain = existing(folder / normal), unquote(normal)
    if "%" in normal and "%" not in plain and not _is_image(path):
        with suppress(SceneError):
            path = found if _is_image(found := inside(folder, plain, where)) else path
    return path


def _is_image(path: Path) -> bool:
    """Tell whether a file is there, with or without the suffix of an image."""
    return any(os.path.isfile(f"{path}{suffix}") for suffix in ("", *SUFFIXES))


def _end_inside(folder: Path, path: str) -> str:
    """Say which end of a path that leads elsewhere is there in ``folder``; nothing where there is none."""
    parts = [part for part in path.split(os.sep) if part not in ("", "..", ".")]
    ends = (os.path.join(*parts[i:]) for i in range(len(parts)))
    for end in ends:
        if _is_image(folder / end):
            return f"{end} is there: write paths from the scene's folder on"
    return ""


def existing(path: Path) -> Path:
    """Find the file or folder of this name in another Unicode form, as macOS writes it; else the path itself.

    >>> existing(Path("/"))
    PosixPath('/')
    """
    if str(path).isascii() or os.path.lexists(path) or path == path.parent:
        return path
    parent = existing(path.parent)
    with suppress(OSError):
        names = _names_in(str(parent), parent.stat().st_mtime_ns)
        return parent / names.get(composed(path.name), path.name)
    return path


def composed(name: str) -> str:
    """Return a name in the Unicode form in which names are compared, NFC.

    >>> composed("o\u0308") == "\u00f6"
    True
    """
    return normalize("NFC", name)


@lru_cache(16)
def _names_in(folder: str, changed: int) -> dict[str, str]:
    """Return the names in a folder by their composed form; ``changed`` tells its states apart.

    Where the system's encoding is ASCII, names come as bytes in disguise.
    """
    return {composed(os.fsencode(n).decode(errors="surrogateescape")): n for n in os.listdir(folder)}


@dataclass(frozen=True)
class Entry:
    """Keys of an object in a JSON file, or else those ``common`` to all of its kind in the file.

    ``prefix`` says where in the file the object lies, ``frames[3].`` for example.
    """

    file: Path
    own: Mapping
    prefix: str = ""
    common: Mapping = field(default_factory=dict)

    def where(self, key: str) -> str:
        """Name file and key, for errors."""
        is_shared = key in self.common and key not in self.own
        return f"{self.file}: {'' if is_shared else self.prefix}{key}"

    def get(self, key: str, default: object = None) -> object:
        """Return the value of a key, unchecked."""
        return self.own.get(key, self.common.get(key, default))

    def number(self, key: str, low: float = -inf, high: float = inf, default: object = None) -> float:
        """Check a number as ``number`` does."""
        return number(self.get(key, default), self.where(key), low, high)

    def numbers(self, key: str, count: int, low=-inf, high=inf, default=None) -> list[float]:
        """Check a list of ``count`` numbers."""
        values, where = self.get(key, default), self.where(key)
        if not isinstance(values, list) or len(values) != count:
            raise mismatch(where, f"{count} numbers", short(values))
        return [number(value, f"{where}[{i}]", low, high) for i, value in enumerate(values)]

    def path(self, key: str) -> Path:
        """Check a path that begins at the file's folder and does not lead out of it."""
        return inside(self.file.parent, self.get(key), self.where(key))


def side_files(folders: Iterable[Path], read: Iterable[Path], advice: str) -> list[str]:
    """Say in lines which files and sub-folders look like masks or depth and are not read.

    Args:
        folders: that are looked at.
        read: files and folders that are read; smaller copies (``masks_2``) are, too.
        advice: what to do.
    """
    lines, names = [], {path.name for path in read}
    known = {re.sub(r"_\d+$", "", str(folder)) for path in read for folder in (path, *path.parents)}
    for folder in dict.fromkeys(folders):
        with suppress(OSError):
            there = (e for e in os.scandir(folder) if SIDE.search(e.name) and not e.name.startswith("."))
            there = sorted((e for e in there if e.name not in names), key=lambda e: e.name)
            files = [e.name for e in there if Path(e.name).suffix.lower() in _LISTED and e.is_file()]
            inner = [e for e in there if e.is_dir() and re.sub(r"_\d+$", "", e.path) not in known]
            lines += [f"{e.path}/ is not read, which seems to be masks or depth" for e in inner]
            some = (
                f"{files[0]} and {len(files) - 1} more are"
                if files[1:]
                else f"{'' if not files else files[0]} is"
            )
            lines += [f"{folder}: {some} not read, which seem to be masks or depth"] if files else []
    return [f"{line}; {advice}" for line in lines]


def beside_images(paths: Iterable[Path], folder: Path) -> tuple[list[Path], dict[Path, Path]]:
    """Split files into images, and masks, depth and others that go with one, as ``1_mask.png`` with ``1.png``
    or ``1_rgb.png``; a file without such an image is one itself. Order stays.

    Args:
        paths: of images, and what is beside them; or of films.
        folder: that they are in; names of its sub-folders count, too.

    Returns:
        the images; and the image of each other file.
    """
    names = {path: composed(path.relative_to(folder).with_suffix("").as_posix()) for path in paths}

    def key(name: str) -> str:
        return re.sub(r"[\W_]+", " ", _PICTURE.sub("", _BESIDE.sub("", name))).strip()

    images = {key(name): path for path, name in names.items() if not _BESIDE.search(name)}
    sides = ((path, key(name)) for path, name in names.items() if _BESIDE.search(name))
    others = {path: images[bare] for path, bare in sides if bare in images}
    return [path for path in names if path not in others], others


def images_alone(paths: Iterable[Path], folder: Path) -> tuple[list[Path], list[str]]:
    """Leave out what goes with images, see ``beside_images``, and say so in a line.

    Raises:
        SceneError: for two images of one name, as PNG and JPEG.
    """
    images, others = beside_images(paths, folder)
    first: dict[str, Path] = {}
    for path in images:
        other = first.setdefault(composed(path.relative_to(folder).with_suffix("").as_posix()), path)
        if other is not path:
            advice = "remove one of them, of each image"
            raise mismatch(folder, "one image of each name", f"{other.name} and {path.name}", advice)
    return images, left_out(others, folder)


def left_out(others: Mapping[Path, Path], folder: Path) -> list[str]:
    """Say in a line which files of ``folder`` are no images, but go with one: see ``beside_images``."""
    if not others:
        return []
    path, image = next(iter(others.items()))
    more = f" and {len(others) - 1} more are" if len(others) > 1 else " is"
    name, beside = path.relative_to(folder), image.relative_to(folder)
    return [f"{folder}: {name}{more} left out, as what goes with {beside}"]


def stated(content: Mapping) -> dict:
    """Leave out keys whose value is null or an empty text: they say nothing."""
    return {key: value for key, value in content.items() if value is not None and value != ""}


def frames_of(file: Path, content: dict) -> list[Entry]:
    """Check the list ``frames`` of a file, which has from one to a million objects; null counts as absent.

    Args:
        file: for errors.
        content: content of the file: also what a frame has where it does not say otherwise.
    """
    frames, where = content.get("frames"), f"{file}: frames"
    if not isinstance(frames, list) or not frames:
        raise mismatch(where, "a list of at least one frame", short(frames))
    if len(frames) > MOST_FRAMES:
        raise mismatch(where, f"at most {MOST_FRAMES} frames", len(frames))
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise mismatch(f"{where}[{i}]", "an object", short(frame))
    common = stated(content)
    if len(common) * len(frames) > _MOST_SHARED:  # each frame is looked at with all of them
        most, got = _MOST_SHARED // len(frames), f"{len(common)} keys beside {len(frames)} frames"
        raise mismatch(file, f"at most {most} keys beside so many frames", got, "remove what is not needed")
    return [Entry(file, stated(frame), f"frames[{i}].", common) for i, frame in enumerate(frames)]


def scene_folder(root: str | Path, scene: str, layout: str) -> Path:
    """Find the folder ``root/scene``, which must hold the file that every scene of a ``layout`` has.

    Raises:
        SceneError: where there is none, naming the scenes that there are.
    """
    root, (marker, _) = Path(root), LAYOUTS[layout]
    if not root.is_dir():
        raise mismatch("data.root", "an existing folder", root, "set data.root")
    folder = existing(root / scene)
    if scene and ((folder / marker).is_file() or (layout == "nerfstudio" and layout_of(folder) == "LLFF")):
        return folder
    there = ", ".join(sorted(p.name for p in root.iterdir() if (p / marker).is_file())) or "none"
    advice = f"scenes in {root}: {there}"
    if scene and (other := layout_of(folder)):
        advice = f"this is a scene in the layout of {other}: use {LAYOUTS[other][1]}"
    elif scene and (known := way_from(folder)):
        advice = known
    if deeper := sorted(root.glob(f"*/{glob.escape(scene)}/{marker}")) if scene else []:
        advice = f"did you mean data.root={deeper[0].parents[len(Path(scene).parts)]}?"
    if (root / marker).is_file():
        advice = f"did you mean data.root={root.resolve().parent} data.scene={root.resolve().name}?"
    advice = (scene and folder.is_dir() and nearly(folder / marker)) or advice
    raise mismatch(folder, f"a scene with {marker}", "none", advice)


def layout_of(folder: Path) -> str | None:
    """Name the layout of a scene's folder by the file that every scene of it has; None: of none known."""
    name = next((name for name, (marker, _) in LAYOUTS.items() if (folder / marker).exists()), None)
    is_one_camera = name == "DyNeRF" and (folder / "images").is_dir() and not any(folder.glob("cam*"))
    return "LLFF" if is_one_camera else name


def way_from(folder: Path) -> str:
    """Say which program left a folder, or files of its name beside, and how to come from there to a scene;
    nothing where that is not known.
    """
    for who, mark, way in _FOREIGN:
        beside = folder.parent.glob(f"{glob.escape(folder.name)}{mark}") if mark.startswith("*") else ()
        paths = (*folder.glob(mark.rstrip("/")), *beside)
        found = next((path for path in paths if path.is_dir() == mark.endswith("/")), None)
        if found is not None:
            return f"{found.name} is of {who}: {way.format(found.parent)}"
    return ""


def way_from_file(path: Path) -> str:
    """Say as ``way_from`` which program left a file."""
    known = ((who, way) for who, mark, way in _FOREIGN if not mark.endswith("/") and path.match(mark))
    return next((f"it is of {who}: {way.format(path.parent)}" for who, way in known), "")


def remove(folder: Path, *patterns: str) -> None:
    """Remove the files of a scene that is to be replaced, in the order of the patterns; others stay."""
    for pattern in patterns:
        for stale in folder.glob(pattern):
            stale.unlink()


def fingerprint(folder: Path) -> dict:
    """Hash the scene's files: each text file by name, and the list of names and sizes of all others.

    Also counts the others and their bytes. A text too large to be read is one of them. Hidden files and other
    kinds do not count, nor do runs in folders below the scene's. Symbolic links count as what they point to.

    Cost: reads the text files; about 5 microseconds for every other one.
    """
    texts, names, sizes = {}, [], []
    for path in _files(folder):
        name, suffix, size = path.relative_to(folder).as_posix(), path.suffix.lower(), path.stat().st_size
        if suffix in _READ and size <= MOST_BYTES:
            texts[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        elif suffix in _READ | _LISTED:
            names.append(f"{size} {name}\n")
            sizes.append(size)
    digest = hashlib.sha256("".join(names).encode(errors="surrogatepass")).hexdigest()
    return {"texts": texts, "images": {"count": len(sizes), "bytes": sum(sizes), "sha256": digest}}


def stamps(folder: Path) -> dict[str, tuple[int, int]]:
    """Return size and time of the last change, in ns, of each of a scene's files by name.

    Cost: about 5 microseconds a file.
    """
    found = {}
    for path in _files(folder):
        with suppress(FileNotFoundError):
            about = path.stat()
            found[path.relative_to(folder).as_posix()] = (about.st_size, about.st_mtime_ns)
    return found


def difference(before: dict, now: dict) -> str | None:
    """Say in a few words how two fingerprints differ; None if they are equal."""
    old, new = before.get("texts", {}), now["texts"]
    if changed := sorted(name for name in {*old, *new} if old.get(name) != new.get(name)):
        return ", ".join(changed[:3]) + (f" and {len(changed) - 3} more" if len(changed) > 3 else "")
    if before.get("images", {}) != now["images"]:
        return "images: {count} files of {bytes} bytes now".format(**now["images"])
    return None


def _files(folder: Path) -> list[Path]:
    """List the files of a folder and of those below it, in the order of their names."""
    files, visited = [], set()
    for place, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        if real in visited or (LOCK in names and Path(place) != folder):  # links may form a circle
            folders.clear()
            continue
        visited.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        paths = (Path(place) / name for name in sorted(names) if not name.startswith("."))
        files += filter(Path.is_file, paths)
    return files
