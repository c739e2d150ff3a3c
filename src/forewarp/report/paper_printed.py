"""Read the paper's printed tables from YAML."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import yaml

from forewarp.files import MOST_CONFIG, read_text

PAPER = Path(__file__).with_name("paper.yaml")


@dataclass(frozen=True)
class Group:
    """Columns that are a mean over ``scenes`` of a dataset.

    ``ability`` is the kind of test view; None: all, or ``time`` if a scene has several kinds.
    """

    name: str
    dataset: str
    metrics: tuple[str, ...]
    scenes: tuple[str, ...]
    ability: str | None = None


@dataclass(frozen=True)
class Row:
    """A printed row, numbers as text, "" for a missing number.

    ``model`` and ``variant`` name the measured runs to compare with the row; others have no variant.
    """

    name: str
    values: tuple[str, ...]
    variant: str | None = None
    model: str | None = None


@dataclass(frozen=True)
class PaperTable:
    """One of the paper's tables.

    ``variants``: the measured variants to show; ``means``: more groups to compute, as name and scenes.
    """

    key: str
    title: str
    source: str
    variants: tuple[str, ...]
    groups: tuple[Group, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    means: tuple[tuple[str, tuple[str, ...]], ...] = ()

    def printed(self, model: str, variant: str) -> Row | None:
        """Return the row of a method and variant, or None; ``plain`` is compared with ``full``."""
        wanted = "full" if variant == "plain" else variant
        named = (row for row in self.rows if row.model == model)
        return next((row for row in named if (row.variant or "full") == wanted), None)

    @property
    def columns(self) -> list[tuple[Group, str]]:
        """The group and metric of every column."""
        return [(group, metric) for group in self.groups for metric in group.metrics]

    def with_mean(self, name: str, scenes: tuple[str, ...]) -> PaperTable:
        """Add a group: the mean of groups of one scene each; printed rows keep their digits."""
        found = [group for group in self.groups if len(group.scenes) == 1 and group.scenes[0] in scenes]
        metrics = found[0].metrics
        more = Group(name, found[0].dataset, metrics, tuple(scenes))
        rows = []
        for row in self.rows:
            values = dict(zip(self.columns, row.values))
            means = [_mean([values[group, metric] for group in found]) for metric in metrics]
            rows.append(replace(row, values=(*row.values, *means)))
        return replace(self, groups=(*self.groups, more), rows=tuple(rows))


def read_paper(path: Path) -> dict[str, PaperTable]:
    """Read tables by key from a YAML file such as ``PAPER``.

    Raises:
        ValueError: if the file is no YAML or lacks a key, or a row has another length than its table.
    """
    # Read all values as text, so that 30.50 stays as printed.
    try:
        content = yaml.load(read_text(Path(path), MOST_CONFIG), Loader=yaml.BaseLoader)
        return {key: _table(key, entry, content["datasets"]) for key, entry in content["tables"].items()}
    except yaml.YAMLError as error:
        raise ValueError(f"{path}: expected YAML, but got {str(error).splitlines()[0]}") from None
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: expected tables of groups and rows, but got {error!r}") from None


def _table(key: str, entry: dict, datasets: dict) -> PaperTable:
    groups = tuple(
        Group(
            g["name"],
            g["dataset"],
            tuple(g["metrics"]),
            tuple(g.get("scenes", datasets[g["dataset"]])),
            g.get("ability"),
        )
        for g in entry["groups"]
    )
    rows = tuple(_row(entry) for entry in entry["rows"])
    about = [entry[name] for name in ("title", "source")]
    table = PaperTable(key, *about, tuple(entry["variants"]), groups, rows, tuple(entry["notes"]))
    for row in rows:
        if len(row.values) != len(table.columns):
            expected = f"{len(table.columns)} values"
            raise ValueError(f"{key}: {row.name}: expected {expected}, but got {len(row.values)}")
    means = entry.get("means", {}).items()
    return replace(table, means=tuple((name, tuple(scenes)) for name, scenes in means))


def _row(entry: dict) -> Row:
    values = tuple("" if value == "null" else value for value in entry["values"])
    own = "full" if entry["name"].split(" (")[0] == "Ours" else None
    variant = entry.get("variant", own)
    return Row(entry["name"], values, variant, entry.get("model", "forward" if variant else None))


def _mean(values: list[str]) -> str:
    if "" in values:
        return ""
    digits = max(len(value.partition(".")[2]) for value in values)
    return f"{fmean(map(float, values)):.{digits}f}"
