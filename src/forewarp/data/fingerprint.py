"""What a scene's files were when a run began."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from forewarp.data.files import read_bytes
from forewarp.files import MOST_BYTES

_READ = {".json", ".inf", ".txt", ".csv"}  # small and decisive: their content counts
RECORD = "synthesis.json"  # of every synthesised scene, or folder of them
LOCK = ".lock"  # of every folder of a run
_LISTED = {".png", ".jpg", ".jpeg", ".npy", ".npz", ".ply", ".obj"}  # name and size


def fingerprint(folder: Path) -> dict:
    """The scene's files in a few numbers: the SHA-256 of each text file by name, and of the list of names and
    sizes of all others, with how many and how large these are together.

    A text larger than any that is read is one of the others. Hidden files and those of other kinds do not
    count, nor does the folder of a run, which may lie below the scene's. Symbolic links to files count as the
    files.

    Cost: reads the text files; a look at every other one, about 5 microseconds.
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
    """In a few words what two fingerprints differ in; None where they do not."""
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
        if real in been or of_a_run:  # been: a link in a circle
            folders.clear()
            continue
        been.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        paths = (Path(place) / name for name in sorted(names) if not name.startswith("."))
        found += [path for path in paths if path.is_file()]
    return found
