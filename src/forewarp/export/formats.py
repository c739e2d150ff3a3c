"""The registry of ``forewarp-export``'s formats, and the folder that an export fills; loads no torch."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from forewarp.evaluation.layers import LAYERS
from forewarp.files import folder_written_whole, write_json

if TYPE_CHECKING:
    from forewarp.export.tracks import Progress, Source

ABOUT = "about.json"  # in every folder of an export, which may then be replaced
_AXES = "the data's own world, right-handed, in its own unit of length; turned about its origin if up says so"
_SHIFTED = "; data = files, turned back by rotation, plus shift"


class Format(NamedTuple):
    """A format ``x``, written by ``export_x`` of a ``module`` of this package with some ``options``; it may
    need a ``package`` of an ``extra``, and is of some ``times`` unless it holds all.
    """

    module: str
    options: tuple[str, ...]
    package: str | None = None
    extra: str | None = None
    times: bool = True


FORMATS = {
    "ply": Format("ply", ("degree", "up", "compressed")),
    "glb": Format("glb", ("quality", "seconds"), times=False),
    "usd": Format("usd", ("degree", "up", "seconds"), "pxr", "usd"),
    "mesh": Format("ply", ("resolution", "level", "files", "up"), "skimage", "export"),
    "gltf": Format("tracks", ("points", "seconds")),
    "html": Format("html", ("quality", "seconds"), times=False),
    "npz": Format("tracks", ("points", "views")),
}
# The values that an option may have: words, or numbers from a least to a most.
CHOICES = {
    "compressed": (False, True),
    "layer": LAYERS,
    "quality": ("compact", "lossless"),
    "files": ("ply", "obj"),
    "up": ("world", "y", "-y", "z"),
}
WHOLE_NUMBERS = {"degree": (0, 3), "resolution": (8, 512), "points": (1, 10**6), "views": (1, 100)}
NUMBERS = {"level": (0.01, 0.99), "seconds": (0.1, 3600)}


def require(kind: str) -> None:
    """Refuse a format whose package is not installed.

    Raises:
        ImportError: naming the extra to install.
    """
    package, extra = FORMATS[kind].package, FORMATS[kind].extra
    if package is not None and find_spec(package) is None:
        raise ImportError(
            f"format={kind}: expected the package {package}, but got none; install forewarp[{extra}]"
        )


def check_option(key: str, value: object) -> None:
    """Refuse a value that an option cannot have.

    Raises:
        ValueError: naming the values that it can have.
    """
    if value is None and key == "seconds":
        return
    if key in CHOICES:
        choices = CHOICES[key]
        good = type(value) is type(choices[0]) and value in choices
        expected = " or ".join(str(choice).lower() for choice in choices)
    else:
        whole = key in WHOLE_NUMBERS
        least, most = WHOLE_NUMBERS[key] if whole else NUMBERS[key]
        good = type(value) in ((int,) if whole else (int, float)) and least <= value <= most
        expected = f"a {'whole number' if whole else 'number'} from {least} to {most}"
    if not good:
        raise ValueError(f"{key}: expected {expected}, but got {value}")


def write(
    kind: str, source: Source, folder: Path, about: Mapping[str, object], progress: Progress, **options
) -> dict:
    """Write a scene in a format: all files or none.

    Args:
        kind: a key of ``FORMATS``.
        source: the scene and its times.
        folder: takes the files; an earlier export in it is replaced.
        about: what ``about.json`` says first.
        progress: called after each time with the number done and the total.
        options: those of the format.

    Returns:
        the content of ``about.json``.

    Raises:
        ValueError: for a method that the format cannot be made of, or a folder of other files.
        ImportError: see ``require``.
    """
    require(kind)
    export = getattr(import_module(f"forewarp.export.{FORMATS[kind].module}"), f"export_{kind}")
    with folder_written_whole(folder, ABOUT) as part:
        if kind in ("ply", "gltf", "npz") and not source.follows:
            expected = "a method whose points can be followed, as particles, forward or backward"
            raise ValueError(f"format={kind}: expected {expected}, but got {source.model}")
        facts = export(source, part, progress, **options)
        files = sorted(file for file in part.rglob("*") if file.is_file())
        sizes = {file.relative_to(part).as_posix(): file.stat().st_size for file in files}
        times = {"times": list(source.times)} if FORMATS[kind].times else {}
        places = {"axes": _AXES + _SHIFTED * any(source.shift), "shift": list(source.shift)}
        places["normalisation"] = {"center": list(source.world.center), "scale": source.world.scale}
        content = {"format": kind, **about, **times, **places, **facts, "bytes": sizes}
        write_json(part / ABOUT, content)
    return content
