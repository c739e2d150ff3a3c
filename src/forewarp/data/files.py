"""Reading and writing the small files of a dataset, with errors that name file and key."""

from __future__ import annotations

import errno
import json
import math
import operator
import os
import stat
from pathlib import Path
from reprlib import repr as short
from unicodedata import category

from forewarp.files import MOST_BYTES
from forewarp.scene.errors import SceneError

MOST_FRAMES = 1_000_000
MARKERS = {  # by the reader: the file that every scene of its format has
    "dnerf": "transforms_train.json",
    "lego_complete": "transforms_train.json",
    "hypernerf": "dataset.json",
    "nhr": "CamPose.inf",
    "posed_video": "transforms.json",
}
_UNPRINTABLE = {"Cc", "Cs", "Zl", "Zp"}  # controls, halves of characters, separators of lines


def read_bytes(path: Path, most: int = MOST_BYTES, what: str = "a readable file") -> bytes:
    """What a file holds; nothing is read of one that is larger than ``most`` bytes, or no file but a pipe.

    Raises:
        SceneError: where it cannot be read, naming ``what`` was expected.
    """
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):
            got = os.strerror(errno.EISDIR) if stat.S_ISDIR(about.st_mode) else "a device or a pipe"
            raise SceneError(f"{path}: expected {what}, but got {got}")
        if about.st_size > most:
            raise SceneError(f"{path}: expected at most {most} bytes, but got {about.st_size}")
        return path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path}: expected {what}, but got {error.strerror or error}") from error


def frames_of(content: dict, path: Path) -> list:
    """The list ``frames`` of a file, which has from one to a million entries."""
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise SceneError(f"{path}: frames: expected a list of at least one frame, but got {short(frames)}")
    if len(frames) > MOST_FRAMES:
        raise SceneError(f"{path}: frames: expected at most {MOST_FRAMES} frames, but got {len(frames)}")
    return frames


def read_json(path: Path) -> dict:
    """The object a JSON file holds.

    Raises:
        SceneError: where the file is missing, too large, does not parse (with the line) or holds no object.
    """
    try:
        content = json.loads(read_bytes(path).decode())
    except SceneError:  # which is a ValueError too
        raise
    except json.JSONDecodeError as error:
        raise SceneError(f"{path}: line {error.lineno}: expected JSON, but got {error.msg}") from error
    except (ValueError, RecursionError) as error:  # bytes that are no text, absurd numbers or nesting
        raise SceneError(f"{path}: expected JSON, but got {short(str(error))}") from error
    if not isinstance(content, dict):
        raise SceneError(f"{path}: expected a JSON object at the top, but got {type(content).__name__}")
    return content


def number(value: object, where: str, low: float = -math.inf, high: float = math.inf) -> float:
    """A finite number of a file, ``low <= value <= high``; ``where`` names file and key.

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


def whole(value: object, where: str, least: int, multiple: int = 1) -> int:
    """A whole number of at least ``least`` that ``multiple`` divides; ``where`` names the key to set.

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
    """The path ``name`` says, relative to ``folder``; leaving the folder is an error.

    Judged by the text alone, so a folder may link to where its images really are. A backslash, which
    elsewhere divides folders, is refused.
    """
    if not isinstance(name, str) or not name or any(category(c) in _UNPRINTABLE or c == "\\" for c in name):
        raise SceneError(f"{where}: expected a path inside the scene folder, but got {short(name)}")
    normal = os.path.normpath(name)
    if os.path.isabs(normal) or normal.split(os.sep)[0] in ("..", "."):
        raise SceneError(f"{where}: expected a path inside the scene folder, but got {name!r}")
    return folder / normal


def scene_folder(root: str | Path, scene: str, marker: str) -> Path:
    """The folder ``root/scene``, which must hold the file ``marker``.

    Raises:
        SceneError: with the scenes that are there, where this one is not.
    """
    root = Path(root)
    if not root.is_dir():
        raise SceneError(f"data.root: expected an existing folder, but got {root}; set data.root")
    if not scene or not (root / scene / marker).is_file():
        there = ", ".join(sorted(p.name for p in root.iterdir() if (p / marker).is_file())) or "none"
        advice = f"scenes in {root}: {there}"
        if (root / marker).is_file():
            folder = root.resolve()
            advice = f"did you mean data.root={folder.parent} data.scene={folder.name}?"
        raise SceneError(f"{root / scene}: expected a scene with {marker}, but got none; {advice}")
    return root / scene
