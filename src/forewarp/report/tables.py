"""Tables of numbers with their spread, as Markdown and CSV."""

from __future__ import annotations

import csv
import io
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Estimate:
    """A mean over repetitions with the sample's standard deviation, None of a single one."""

    mean: float
    deviation: float | None = None

    @classmethod
    def of(cls, values: Sequence[float]) -> Estimate | None:
        """The estimate from values; None where there are none.

        >>> Estimate.of([1.0, 3.0])
        Estimate(mean=2.0, deviation=1.4142135623730951)
        """
        if not values:
            return None
        return cls(statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else None)


class Difference(float):
    """A number that is written with its sign."""


Cell = Estimate | float | int | str | None
MARKS = {"best": "**{}**", "second": "<u>{}</u>"}  # of Markdown


@dataclass(frozen=True)
class Column:
    """A column: its title and how its numbers are written. ``prefix`` stands before each of them."""

    name: str
    digits: int = 2
    signed: bool = False
    prefix: str = ""

    def text(self, value: Cell) -> str:
        """A cell as one reads it; empty where there is nothing.

        >>> Column("PSNR", signed=True).text(Estimate(0.5, 0.1))
        '+0.50 ± 0.10'
        """
        if value is None or isinstance(value, str):
            return value or ""
        if isinstance(value, Estimate):
            spread = "" if value.deviation is None else f" ± {value.deviation:.{self.digits}f}"
            return self.text(value.mean) + spread
        sign = "+" if self.signed or isinstance(value, Difference) else ""
        return f"{self.prefix}{value:{sign}.{self.digits}f}"


@dataclass(frozen=True)
class Table:
    """Columns and rows of as many cells; ``caption`` says what they are.

    ``marks``: (row, column) -> ``best`` or ``second``. ``rules``: rows that a line stands above, where there
    are lines. A number that others printed is a string, as they wrote it.
    """

    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    marks: Mapping[tuple[int, int], str] = field(default_factory=dict)
    rules: Sequence[int] = ()

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"a table: expected rows of {len(self.columns)} cells, but got {row}")

    def markdown(self) -> str:
        """For a page; numbers to the right."""
        lines = [self.caption, ""] if self.caption else []
        lines.append(_line(column.name for column in self.columns))
        lines.append("|" + "|".join("---:" if right else "---" for right in self.numeric) + "|")
        lines += [_line(row) for row in self.texts(MARKS)]
        return "\n".join(lines) + "\n"

    @property
    def numeric(self) -> list[bool]:
        """Which columns hold numbers, and nothing else."""
        return [all(_is_number(row[i]) for row in self.rows) for i in range(len(self.columns))]

    def texts(self, marks: Mapping[str, str], plain: Callable[[str], str] = str) -> list[list[str]]:
        """The cells as one reads them.

        Args:
            marks: the form of a marked cell by its mark, with ``{}`` for the text.
            plain: what the text itself goes through first.
        """
        return [
            [
                marks.get(self.marks.get((i, j)), "{}").format(plain(self.columns[j].text(value)))
                for j, value in enumerate(row)
            ]
            for i, row in enumerate(self.rows)
        ]

    def csv(self) -> str:
        """All digits; an estimate's standard deviation has a column of its own."""
        spread = [any(isinstance(row[i], Estimate) for row in self.rows) for i in range(len(self.columns))]
        names = [[c.name, f"{c.name} sd"] if s else [c.name] for c, s in zip(self.columns, spread)]
        rows = [[part for v, s in zip(row, spread) for part in _plain(v, s)] for row in self.rows]
        file = io.StringIO()
        csv.writer(file, lineterminator="\n").writerows([[name for pair in names for name in pair], *rows])
        return file.getvalue()


def _is_number(value: Cell) -> bool:
    if not isinstance(value, str) or not value:
        return True
    return value.replace(".", "", 1).isdigit()


def _line(cells) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _plain(value: Cell, spread: bool) -> list:
    if not spread:
        return ["" if value is None else value]
    if not isinstance(value, Estimate):
        return ["" if value is None else value, ""]
    return [value.mean, "" if value.deviation is None else value.deviation]
