"""Tables of numbers with their spread over repetitions, as Markdown, plain text and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from tabulate import tabulate

from forewarp.metrics.gain import Estimate


class Difference(float):
    """A number, written with its sign."""


Cell = Estimate | float | int | str | None
MARKS = {"best": "**{}**", "second": "<u>{}</u>"}  # in Markdown


@dataclass(frozen=True)
class Column:
    """A column's title and number format; ``prefix`` stands before each number."""

    name: str
    digits: int = 2
    signed: bool = False
    prefix: str = ""

    def text(self, value: Cell) -> str:
        """Format a cell; None is empty.

        >>> Column("PSNR", signed=True).text(Estimate(0.5, 0.1))
        '+0.50 ± 0.10'
        """
        if value is None or isinstance(value, str):
            return value or ""
        if isinstance(value, Estimate):
            deviation = "" if value.deviation is None else f" ± {value.deviation:.{self.digits}f}"
            return self.text(value.mean) + deviation
        sign = "+" if self.signed or isinstance(value, Difference) else ""
        return f"{self.prefix}{value:{sign}.{self.digits}f}"


@dataclass(frozen=True)
class Table:
    """A table with a caption.

    Attributes:
        columns: the columns, from left to right.
        rows: rows of cells, one per column; a published number is a string, as printed.
        caption: text above the table.
        marks: (row, column) -> ``best`` or ``second``.
        rules: indices of rows with a line above, in LaTeX and HTML.
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
        """Return the table for a Markdown page, numbers aligned to the right."""
        escaped = [[cell.replace("|", "\\|") for cell in row] for row in self.texts(MARKS)]
        return (f"{self.caption}\n\n" if self.caption else "") + self._tabulated(escaped, "pipe") + "\n"

    def plain(self) -> str:
        """Return the table for a terminal."""
        return self._tabulated(self.texts({}), "simple")

    def _tabulated(self, texts: list[list[str]], form: str) -> str:
        names = [column.name for column in self.columns]
        sides = ["right" if numeric else "left" for numeric in self.numeric]
        return tabulate(texts, names, form, disable_numparse=True, colalign=sides if texts else None)

    @property
    def numeric(self) -> list[bool]:
        """Whether each column holds only numbers."""
        return [all(_is_number(row[i]) for row in self.rows) for i in range(len(self.columns))]

    def texts(self, marks: Mapping[str, str], escape: Callable[[str], str] = str) -> list[list[str]]:
        """Format all cells.

        Args:
            marks: mark -> format of a marked cell, with ``{}`` for the text.
            escape: function applied to the text of each cell first.
        """
        return [
            [
                marks.get(self.marks.get((i, j)), "{}").format(escape(self.columns[j].text(value)))
                for j, value in enumerate(row)
            ]
            for i, row in enumerate(self.rows)
        ]

    def csv(self) -> str:
        """Return all digits as CSV; the standard deviation of an estimate has a column of its own."""
        spread = [any(isinstance(row[i], Estimate) for row in self.rows) for i in range(len(self.columns))]
        names = [[c.name, f"{c.name} sd"] if s else [c.name] for c, s in zip(self.columns, spread)]
        rows = [[part for v, s in zip(row, spread) for part in _parts(v, s)] for row in self.rows]
        file = io.StringIO()
        csv.writer(file, lineterminator="\n").writerows([[name for pair in names for name in pair], *rows])
        return file.getvalue()


def _is_number(value: Cell) -> bool:
    if not isinstance(value, str) or not value:
        return True
    return value.replace(".", "", 1).isdigit()


def _parts(value: Cell, spread: bool) -> list:
    if isinstance(value, Estimate):
        return [value.mean, "" if value.deviation is None else value.deviation]
    return ["" if value is None else value, *([""] if spread else [])]
