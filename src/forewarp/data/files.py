"""Read the small files of a dataset, check what they hold, and take a fingerprint of all its files."""

from __future__ import annotations

import glob
import hashlib
import math
import operator
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from reprlib import repr as short
from typing import BinaryIO
from unicodedata import category

from forewarp.files import MOST_BYTES, check_size, load_json


class SceneError(ValueError):
    """The user's input or files are wrong; the message is one line."""


MOST_FRAMES = 1_000_000
MARKERS = {  # by reader: the file that every scene of its format has
    "dnerf": "transforms_train.json",
    "lego_complete": "transforms_train.json",
    "hypernerf": "dataset.json",
    "nhr": "CamPose.inf",
    "posed_video": "transforms.json",
}
_UNPRINTABLE = {"Cc", "Cs", "Zl", "Zp"}  # control characters, surrogates, line and paragraph separators


@contextmanager
def refused(path: Path, what: str) -> Iterator[None]:
    """Turn errors of reading a file into SceneErrors; an OSError is told as ``what`` was expected."""
    try:
        yield
    except OSError as error:
        raise SceneError(f"{path}: expected {what}, but got {error.strerror or error}") from error
    except SceneError:
        raise
    except ValueError as error:
        raise SceneError(str(error)) from error


@contextmanager
def opened(path: Path, most: int = MOST_BYTES, what: str = "a readable file") -> Iterator[BinaryIO]:
    """Open a regular file of at most ``most`` bytes.

    Raises:
        SceneError: where it cannot be read, naming ``what`` was expected.
    """
    with refused(path, what):
        check_size(path, most)
        with path.open("rb") as stream:
            yield stream


def read_bytes(path: Path, most: int = MOST_BYTES, what: str = "a readable file") -> bytes:
    """Read a file; SceneError as ``opened``."""
    with opened(path, most, what) as stream:
        return stream.read()


def frames_of(content: dict, path: Path) -> list:
    """Check the list ``frames`` of a file, which has from one to a million entries."""
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise SceneError(f"{path}: frames: expected a list of at least one frame, but got {short(frames)}")
    if len(frames) > MOST_FRAMES:
        raise SceneError(f"{path}: frames: expected at most {MOST_FRAMES} frames, but got {len(frames)}")
    return frames


def read_json(path: Path) -> dict:
    """Read the object of a JSON file.

    Raises:
        SceneError: where the file is missing, too large, does not parse (with the line) or holds no object.
    """
    with refused(path, "a readable file"):
        return load_json(path)


def number(value: object, where: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Check a finite number, ``low <= value <= high``; ``where`` names file and key.

    >>> number(1, "a.json: time", 0, 1)
    1.0
    """
    try:
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer beyond every float
        is_number = False
    if not is_number or not low <= value <= high:
        within = "" if math.isinf(low) and math.isinf(high) else f" in [{low:g}, {high:g}]"
        raise SceneError(f"{where}: expected a number{within}, but got {short(value)}")
    return float(value)


def numbers_of(words: list[str], count: int, where: str) -> list[float]:
    """Parse ``count`` finite numbers of a line of text.

    >>> numbers_of(["1", "2.5"], 2, "a.txt: line 1")
    [1.0, 2.5]
    """
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = None
    if values is None or len(values) != count or not all(map(math.isfinite, values)):
        got = f"{len(words)} values" if values and len(values) != count else repr(" ".join(words))[:60]
        raise SceneError(f"{where}: expected {count} finite numbers, but got {got}")
    return values


def numbers(
    content: dict, key: str, count: int, path: Path, low: float = -math.inf, high: float = math.inf
) -> list[float]:
    """Check that a file holds ``count`` finite numbers, ``low <= value <= high``, under ``key``."""
    values = content.get(key)
    if not isinstance(values, list) or len(values) != count:
        raise SceneError(f"{path}: {key}: expected {count} numbers, but got {short(values)}")
    return [number(value, f"{path}: {key}[{i}]", low, high) for i, value in enumerate(values)]


def whole(value: object, where: str, least: int, multiple: int = 1) -> int:
    """Check a whole number of at least ``least`` that ``multiple`` divides; ``where`` names the key to set.

    >>> whole(16, "size", 8)
    16
    """
    try:
        good = operator.index(value) >= least and value % multiple == 0 and not isinstance(value, bool)
    except TypeError:
        good = False
    if not good:
        kind = "a whole number" if multiple == 1 else f"a multiple of {multiple}"
        raise SceneError(f"{where}: expected {kind} of at least {least}, but got {short(value)}; set {where}")
    return operator.index(value)


def inside(folder: Path, name: object, where: str) -> Path:
    """Join a relative path to ``folder``; refuse one that leads out of it.

    Judged by the text alone, so a folder may link to where its images really are. A backslash, which Windows
    takes for a separator, is refused.
    """
    if not isinstance(name, str) or not name or any(category(c) in _UNPRINTABLE or c == "\\" for c in name):
        raise SceneError(f"{where}: expected a path inside the scene folder, but got {short(name)}")
    normal = os.path.normpath(name)
    if os.path.isabs(normal) or normal.split(os.sep)[0] in ("..", "."):
        raise SceneError(f"{where}: expected a path inside the scene folder, but got {name!r}")
    return folder / normal


def scene_folder(root: str | Path, scene: str, marker: str) -> Path:
    """Find the folder ``root/scene``, which must hold the file ``marker``.

    Raises:
        SceneError: where there is none, naming the scenes that there are.
    """
    root = Path(root)
    if not root.is_dir():
        raise SceneError(f"data.root: expected an existing folder, but got {root}; set data.root")
    if not scene or not (root / scene / marker).is_file():
        there = ", ".join(sorted(p.name for p in root.iterdir() if (p / marker).is_file())) or "none"
        advice = f"scenes in {root}: {there}"
        deeper = sorted(root.glob(f"*/{glob.escape(scene)}/{marker}")) if scene else []
        if deeper:
            advice = f"did you mean data.root={deeper[0].parents[len(Path(scene).parts)]}?"
        if (root / marker).is_file():
            folder = root.resolve()
            advice = f"did you mean data.root={folder.parent} data.scene={folder.name}?"
        raise SceneError(f"{root / scene}: expected a scene with {marker}, but got none; {advice}")
    return root / scene


_READ = {".json", ".inf", ".txt", ".csv"}  # small: their content counts
RECORD = "synthesis.json"  # of every synthesised scene, or folder of them
LOCK = ".lock"  # of every folder of a run
_LISTED = {".png", ".jpg", ".jpeg", ".npy", ".npz", ".ply", ".obj"}  # large: name and size count


def fingerprint(folder: Path) -> dict:
    """Hash the scene's files: each text file by name, and the list of names and sizes of all others.

    Also counts the others and their bytes. A text too large to be read is one of them. Hidden files and other
    kinds do not count, nor do runs in folders below the scene's. Symbolic links count as what they point to.

    Cost: reads the text files; about 5 microseconds for every other one.
    """
    texts, listed = {}, []
    for path in _files(folder):
        name, suffix, size = path.relative_to(folder).as_posix(), path.suffix.lower(), path.stat().st_size
        if suffix in _READ and size <= MOST_BYTES:
            texts[name] = hashlib.sha256(read_bytes(path)).hexdigest()
        elif suffix in _READ | _LISTED:
            listed.append((name, size))
    digest = hashlib.sha256(
        "".join(f"{size} {name}\n" for name, size in listed).encode(errors="surrogatepass")
    )
    sizes = [size for _, size in listed]
    return {
        "texts": texts,
        "images": {"count": len(sizes), "bytes": sum(sizes), "sha256": digest.hexdigest()},
    }


def difference(before: dict, now: dict) -> str | None:
    """Say in a few words how two fingerprints differ; None if they are equal."""
    old, new = before.get("texts", {}), now["texts"]
    if changed := sorted(name for name in {*old, *new} if old.get(name) != new.get(name)):
        return ", ".join(changed[:3]) + (f" and {len(changed) - 3} more" if len(changed) > 3 else "")
    old, new = before.get("images", {}), now["images"]
    if old != new:
        return "images: {count} files of {bytes} bytes now".format(**new)
    return None


def _files(folder: Path) -> list[Path]:
    found, been = [], set()
    for place, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        of_a_run = LOCK in names and Path(place) != folder
        if real in been or of_a_run:  # links may form a circle
            folders.clear()
            continue
        been.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        paths = (Path(place) / name for name in sorted(names) if not name.startswith("."))
        found += [path for path in paths if path.is_file()]
    return found
