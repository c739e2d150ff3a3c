"""What a Nerfies or HyperNeRF capture says of its items: the split and the times."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from reprlib import repr as short

from forewarp.data.files import MOST_FRAMES, number, read_json
from forewarp.scene.errors import SceneError

_EVERY = 4  # the published interpolation protocol: train on every fourth, test midway between
_MOST_MOMENTS = 1e9


@dataclass(frozen=True)
class Split:
    """``name`` is vrig or interpolation; ``ids`` are all items, perhaps some of neither part."""

    name: str
    ids: list[str]
    train: list[str]
    test: list[str]


def read_split(path: Path) -> Split:
    """The split of a ``dataset.json``.

    Raises:
        SceneError: for lists that are none, name an item twice, an unknown one or one in both parts.
    """
    content = read_json(path)
    lists = {key: content.get(key, []) for key in ("ids", "train_ids", "val_ids")}
    for key, ids in lists.items():
        if not isinstance(ids, list) or not all(isinstance(i, str) for i in ids) or len({*ids}) < len(ids):
            raise SceneError(f"{path}: {key}: expected a list of different names, but got {short(ids)}")
    ids, train, val = lists.values()
    if len(ids) > MOST_FRAMES:
        raise SceneError(f"{path}: ids: expected at most {MOST_FRAMES} items, but got {len(ids)}")
    for key in ("train_ids", "val_ids"):
        if unknown := [i for i in lists[key] if i not in {*ids}]:
            raise SceneError(
                f"{path}: {key}: expected items of ids, but got {short(unknown[0])}; list it in ids"
            )
    if both := {*train} & {*val}:
        raise SceneError(f"{path}: val_ids: expected none of train_ids, but got {short(min(both))}")
    if val and not train:
        raise SceneError(f"{path}: train_ids: expected at least one beside val_ids, but got none")
    if val:
        return Split("vrig", ids, train, val)
    if len(ids) <= _EVERY:
        raise SceneError(
            f"{path}: ids: expected more than {_EVERY} items to test between where val_ids is empty, but got "
            f"{len(ids)}"
        )
    chosen = range(0, len(ids), _EVERY)
    test = [ids[i + _EVERY // 2] for i in chosen[:-1]]
    return Split("interpolation", ids, [ids[i] for i in chosen], test)


def read_times(path: Path, ids: list[str]) -> dict[str, float]:
    """The time in [0, 1] of every item of a ``metadata.json``: ``time_id``, or where none of ``ids`` has one
    ``warp_id``, over the greatest of them. Entries of other items are not looked at.

    Raises:
        SceneError: for an item that is missing or has no time.
    """
    content, numbered = read_json(path), {}
    entries = [content.get(item) for item in ids]
    key = "time_id" if any(isinstance(e, dict) and "time_id" in e for e in entries) else "warp_id"
    for item, entry in zip(ids, entries):
        if not isinstance(entry, dict):
            raise SceneError(f"{path}: {item!r}: expected an object for this item, but got {short(entry)}")
        value = number(entry.get(key), f"{path}: {item!r}.{key}", 0, _MOST_MOMENTS)
        if value % 1:
            raise SceneError(f"{path}: {item!r}.{key}: expected a whole number, but got {value:g}")
        numbered[item] = value
    last = max(numbered.values()) or 1.0
    return {item: value / last for item, value in numbered.items()}


def read_camera_ids(path: Path, ids: list[str]) -> dict[str, int | None]:
    """Tell which camera took every item of a ``metadata.json``: its ``camera_id``; None where it has none.

    Raises:
        SceneError: for one that is no whole number >= 0.
    """
    content, found = read_json(path), {}
    for item in ids:
        entry = content.get(item)
        value = entry.get("camera_id") if isinstance(entry, dict) else None
        if value is not None and number(value, f"{path}: {item!r}.camera_id", 0, _MOST_MOMENTS) % 1:
            raise SceneError(f"{path}: {item!r}.camera_id: expected a whole number, but got {value:g}")
        found[item] = None if value is None else int(value)
    return found
