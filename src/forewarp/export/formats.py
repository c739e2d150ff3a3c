"""The formats of ``forewarp-export``, and the folder that each of them fills. Nothing here loads torch."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from forewarp.files import folder_written_whole, write_json

if TYPE_CHECKING:
    from forewarp.export.source import Progress, Source

ABOUT = "about.json"  # in every folder of an export, which may then be replaced
_AXES = "the data's own world, right-handed, in its own unit of length; turned about its origin if up says so"


class Format(NamedTuple):
    """A ``function`` of a ``module`` of this package, the ``options`` that it takes, and the ``package`` of
    an ``extra`` that it needs.
    """

    module: str
    function: str
    options: tuple[str, ...]
    package: str | None = None
    extra: str | None = None


FORMATS = {
    "ply": Format("ply", "export_ply", ("degree", "up")),
    "mesh": Format("mesh", "export_mesh", ("resolution", "level", "files", "up"), "skimage", "export"),
    "gltf": Format("gltf", "export_gltf", ("points", "seconds")),
    "html": Format("page", "export_html", ("points", "seconds", "megabytes"), "viser", "viewer"),
    "npz": Format("arrays", "export_npz", ("points", "views")),
}


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


def write(
    kind: str, source: Source, folder: Path, about: Mapping[str, object], progress: Progress, **options
) -> dict:
    """Write a scene in a format: all files or none.

    Args:
        kind: a key of ``FORMATS``.
        source: the scene and its times.
        folder: takes the files; one written before is replaced.
        about: what ``about.json`` says first.
        progress: told after each time.
        options: those of the format.

    Returns:
        the content of ``about.json``.

    Raises:
        ValueError: for a method that the format cannot be made of, or a folder of other files.
        ImportError: see ``require``.
    """
    require(kind)
    made = FORMATS[kind]
    fill = getattr(import_module(f"forewarp.export.{made.module}"), made.function)
    with folder_written_whole(folder, ABOUT) as part:
        noted = fill(source, part, progress, **options)
        files = sorted(file for file in part.rglob("*") if file.is_file())
        sizes = {file.relative_to(part).as_posix(): file.stat().st_size for file in files}
        content = {
            "format": kind,
            **about,
            "times": list(source.times),
            "axes": _AXES,
            **noted,
            "bytes": sizes,
        }
        write_json(part / ABOUT, content)
    return content
