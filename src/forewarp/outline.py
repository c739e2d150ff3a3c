"""Of which kind each part of a run's config is, whoever wrote it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from reprlib import repr as short

# Parts that have keys of their own, those that may be null instead, and those whose parts are of either kind.
_SECTIONS = ("model", "data", "budget", "preset", "trainer", "callbacks", "stage")
_OPTIONAL = ("objective", "logger", "target", "trackers", "sentinel", "variant", "paths")
_OF_SECTIONS = ("callbacks", "stage")
_OF_STAGES = ("curriculum", "objective", "model")
_TEXTS = ("run", "model.name", "preset.name")
_FLAGS = ("_partial_", "_recursive_")
_MOST = 1 << 63  # larger whole numbers fit into no tensor


def check_outline(config: Mapping, where: str = "") -> None:
    """Refuse a config whose parts are of another kind than every run's, before they are used.

    Args:
        config: as dicts and lists, its interpolations resolved or not; absent parts are not missed.
        where: stands before the key in errors.

    Raises:
        ValueError: naming the key.

    >>> check_outline({"stage": None}, "run/config.yaml: ")
    Traceback (most recent call last):
    ValueError: run/config.yaml: stage: expected keys of its own, but got None; write them below it
    """
    if not isinstance(config, Mapping):
        raise ValueError(f"{where}expected a mapping, but got {short(config)}")

    def check_section(key: str, value: object, *, optional: bool) -> None:
        if isinstance(value, Mapping) or (value is None and optional) or str(value)[:2] == "${":
            return
        expected = "keys of its own" + (" or null" if optional else "")
        raise ValueError(f"{where}{key}: expected {expected}, but got {short(value)}; write them below it")

    for key in (*_SECTIONS, *_OPTIONAL):
        if key in config:
            check_section(key, config[key], optional=key in _OPTIONAL)
    for key in _OF_SECTIONS:
        parts = config.get(key)
        for name, part in parts.items() if isinstance(parts, Mapping) else ():
            check_section(f"{key}.{name}", part, optional=True)
            for inner in _OF_STAGES if key == "stage" and isinstance(part, Mapping) else ():
                if inner in part:
                    check_section(f"stage.{name}.{inner}", part[inner], optional=inner != "curriculum")
    for key, value in _leaves(config):
        is_place = key.startswith("paths.") and value is not None
        if (key in _TEXTS or is_place) and not isinstance(value, str):
            raise ValueError(f"{where}{key}: expected a text, but got {short(value)}")
        if key.rpartition(".")[2] in _FLAGS and type(value) is not bool:
            raise ValueError(f"{where}{key}: expected true or false, but got {short(value)}")
        if key == "trackers.tags" and not isinstance(value, list | None):
            raise ValueError(f"{where}{key}: expected a list of texts, but got {short(value)}")
        if key.endswith("objective.every"):
            check_section(key, value, optional=True)
        if isinstance(value, int) and abs(value) > _MOST:
            raise ValueError(f"{where}{key}: expected a number of at most 64 bits, but got {short(value)}")


def _leaves(node: object, key: str = "") -> Iterator[tuple[str, object]]:
    """Yield every value, lists and mappings too, with its dotted key."""
    if key:
        yield key, node
    if isinstance(node, Mapping):
        for name, value in node.items():
            yield from _leaves(value, f"{key}.{name}" if key else str(name))
    elif isinstance(node, list | tuple):
        for i, value in enumerate(node):
            yield from _leaves(value, f"{key}[{i}]")
