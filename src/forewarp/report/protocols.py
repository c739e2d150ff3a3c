"""Say under which conditions runs were measured, and number the conditions of a table."""

from __future__ import annotations

from collections.abc import Sequence

from forewarp.report.collect import Result

# Entries of a run's protocol that pages show.
TOLD = ("half_resolution", "scale", "split", "frames", "views", "train_frames", "test_views", "test_frames")
TOLD += ("measured", "held_out", "canonical_time", "mask_box")


def protocol_of(run: Result) -> str:
    """Say in a line what a run was trained and measured on."""
    known = run.metrics.get("protocol", {})
    words = [run.dataset, pictures_in_words(run) or "background unknown"]
    words += [f"{key.replace('_', ' ')} {_text(known[key])}" for key in TOLD if known.get(key)]
    return ", ".join(word for word in [*words, known.get("note", "")] if word)


def pictures_in_words(run: Result) -> str | None:
    """Say how large a run's pictures are and over which background; None if the run does not tell."""
    known = run.metrics.get("protocol", {})
    sizes = known.get("resolution", [])
    sizes = sizes if sizes and isinstance(sizes[0], list) else [sizes]
    words = [" and ".join("x".join(map(str, sides)) for sides in sizes)]
    if by := known.get("reduced"):
        words[0] = f"{words[0]} reduced {by}x{by}".strip()
    words += [f"background {known['background']}"] if "background" in known else []
    return ", ".join(filter(None, words)) or None


def numbered(runs: Sequence[Result]) -> dict[str, str]:
    """Return the number of each protocol, from 1, in the order of the runs."""
    protocols = dict.fromkeys(protocol_of(run) for run in runs)
    return {protocol: str(number) for number, protocol in enumerate(protocols, 1)}


def _text(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {part}" for name, part in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
