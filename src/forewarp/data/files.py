"""Reading and writing the small files of a dataset, with errors that name file and key."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from reprlib import repr as short

from forewarp.scene.errors import SceneError


def read_json(path: Path) -> dict:
    """The object a JSON file holds.

    Raises:
        SceneError: where the file is missing, does not parse (with the line) or holds no object.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneError(f"{path}: expected a readable file, but got {error.strerror or error}") from error
    except json.JSONDecodeError as error:
        raise SceneError(f"{path}: line {error.lineno}: expected JSON, but got {error.msg}") from error
    except (ValueError, RecursionError) as error:  # bytes that are no text, absurd numbers or nesting
        raise SceneError(f"{path}: expected JSON, but got {short(str(error))}") from error
    if not isinstance(content, dict):
        raise SceneError(f"{path}: expected a JSON object at the top, but got {type(content).__name__}")
    return content


def replace_file(path: Path, content: bytes) -> None:
    """Write a file so that nobody ever sees half of it: beside its place first, then renamed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(content)
    os.replace(partial, path)


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


def inside(folder: Path, name: object, where: str) -> Path:
    """The path ``name`` says, relative to ``folder``; leaving the folder is an error.

    Judged by the text alone, so a folder may link to where its images really are.
    """
    if not isinstance(name, str) or not name or "\0" in name:
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
        raise SceneError(
            f"{root / scene}: expected a scene with {marker}, but got none; scenes in {root}: {there}"
        )
    return root / scene
