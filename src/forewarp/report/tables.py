"""Tables of numbers with their intervals over seeds, and pages from templates."""

from __future__ import annotations

import base64
import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from tabulate import tabulate

from forewarp.media import image_bytes
from forewarp.metrics.registry import metric_of
from forewarp.report.statistics import INTERVALS, NETS, Estimate, Factor

TEMPLATES = Path(__file__).with_name("templates")
MARKS = {
    "": {},
    "md": {"best": "**{}**", "second": "<u>{}</u>"},
    "html": {"best": Markup("<b>{}</b>"), "second": Markup("<u>{}</u>")},  # these escape what they hold
    "tex": {"best": "\\textbf{{{}}}", "second": "\\underline{{{}}}"},
}
# Pages say what marks mean.
MARKED = "The best of a column is bold, the second underlined; ties share a mark."
_LATEX = {c: "\\" + c for c in "&%$#_{}"}
_LATEX |= {"²": "$^2$", "\\": r"\textbackslash{}", "^": r"\textasciicircum{}"}
_LATEX |= {"±": r"$\pm$", "δ": r"$\delta$", "<": "$<$", ">": "$>$", "↑": r"$\uparrow$", "↓": r"$\downarrow$"}
_LATEX |= {"~": r"\textasciitilde{}", "×": r"$\times$", "³": "$^3$", "–": "--", "≥": r"$\geq$", "→": r"$\to$"}
_LAST = "ſ"  # of the letters that LaTeX's fonts have
_POWER = re.compile(r"\\textasciicircum\{\}(\d+)")
_MINUS = re.compile(r"(?<![\w.])-(?=\d)")  # of a number, not of a date or a range
_BETWEEN = re.compile(r"(?<!\\)\$\$")  # one formula ends where the next begins


class Difference(float):
    """A number, written with its sign."""


Cell = Estimate | float | int | str | None


@dataclass(frozen=True)
class Column:
    """A column's title and number format.

    ``digits`` after the point, None: as many as a number has, at most four that count, of a mean as many as
    its first three that count need; ``prefix`` stands before numbers; ``spread``: show after a
    mean what ``statistics.INTERVALS`` says.
    """

    name: str
    digits: int | None = 2
    signed: bool = False
    prefix: str = ""
    spread: bool = True

    def text(self, value: Cell) -> str:
        """Format a cell; None is empty.

        >>> [Column("PSNR", signed=True).text(Estimate.of(v)) for v in ([0.4, 0.5, 0.6], [0.4, 0.6], [0.4])]
        ['+0.50 ± 0.25', '+0.50 (+0.40, +0.60)', '+0.40']
        >>> Column("%", 0, signed=True).text(Estimate(-0.3, 1.2, 3))
        '0 ± 3'
        >>> Column("time", prefix="×").text(Factor.of([1.0, 2.0, 2.0]))
        '×1.59 (×0.59 to ×4.29)'
        >>> [Column("minutes", None).text(minutes) for minutes in (0.05, 1.0, 20.0)]
        ['0.05', '1', '20']
        >>> [Column("s/frame", None).text(Estimate(mean, 0.0016, 3)) for mean in (0.00713, 12.0)]
        ['0.00713 ± 0.00397', '12.0 ± 0.0']
        """
        if value is None or isinstance(value, str):
            return value or ""
        if isinstance(value, Estimate):
            if self.digits is None:
                first = math.floor(math.log10(abs(value.mean))) if value.mean else 0
                return replace(self, digits=max(2 - first, 0)).text(value)
            few = f" [{value.count} of {value.asked} seeds]" if value.asked > value.count else ""
            return self.text(value.mean) + (self._spread(value) if self.spread else "") + few
        sign = "+" if self.signed or isinstance(value, Difference) else ""
        form = ".4g" if self.digits is None else f".{self.digits}f"
        text = f"{value:{sign}{form}}"
        return self.prefix + (text if float(text) else text.lstrip("+-"))  # 0 has no sign

    def _spread(self, value: Estimate) -> str:
        if isinstance(value, Factor):
            low, high = (self.text(end) for end in value.ends)
            return f" ({low}{', ' if value.count == 2 else ' to '}{high})" if value.count > 1 else ""
        bar = value.error_bar
        if value.count == 2:
            return f" ({self.text(value.mean - bar)}, {self.text(value.mean + bar)})"
        return f" ± {bar:.{self.digits}f}" if value.count > 2 else ""


@dataclass(frozen=True)
class Table:
    """A table with a caption.

    Attributes:
        columns: the columns, from left to right; a title stands for a column of two digits.
        rows: rows of cells, one per column; a published number is a string, as printed.
        caption: text above the table.
        marks: (row, column) -> ``best`` or ``second``.
        rules: indices of rows with a line above, in LaTeX and HTML.
    """

    columns: Sequence[Column | str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""
    marks: Mapping[tuple[int, int], str] = field(default_factory=dict)
    rules: Sequence[int] = ()

    def __post_init__(self) -> None:
        columns = [Column(column) if isinstance(column, str) else column for column in self.columns]
        object.__setattr__(self, "columns", columns)

    @classmethod
    def of(cls, rows: Iterable[Mapping], columns: Mapping[str, Column | str], caption: str = "") -> Table:
        """Select columns of rows, by name; None is empty."""
        return cls([*columns.values()], [[row.get(name) for name in columns] for row in rows], caption)

    def filled(self) -> Table:
        """Leave out the columns in which no row has anything."""
        return self._of([j for j, column in enumerate(zip(*self.rows)) if set(column) - {None, ""}])

    def _of(self, kept: Sequence[int]) -> Table:
        """Keep some columns."""
        rows = [[row[j] for j in kept] for row in self.rows]
        marks = {(i, kept.index(j)): mark for (i, j), mark in self.marks.items() if j in kept}
        return replace(self, columns=[self.columns[j] for j in kept], rows=rows, marks=marks)

    def cut(self, most: int) -> list[Table]:
        """Cut into tables of ``most`` columns or fewer, each after the first ones of text."""
        first = self.numeric.index(True) if True in self.numeric else len(self.columns)
        pieces = [range(j, min(j + most, len(self.columns))) for j in range(first, len(self.columns), most)]
        return [self._of([*range(first), *piece]) for piece in pieces or [range(0)]]

    def __str__(self) -> str:
        """Return the table for a Markdown page, numbers aligned to the right."""
        escaped = self.texts("md", lambda text: text.replace("|", "\\|"))
        return (f"{self.caption}\n\n" if self.caption else "") + self._tabulated(escaped, "pipe")

    def plain(self) -> str:
        """Return the table for a terminal."""
        return self._tabulated(self.texts(), "simple")

    def _tabulated(self, texts: list[list[str]], form: str) -> str:
        names = [column.name for column in self.columns]
        sides = ["right" if numeric else "left" for numeric in self.numeric]
        return tabulate(texts, names, form, disable_numparse=True, colalign=sides if texts else None)

    @property
    def numeric(self) -> list[bool]:
        """Whether each column holds only numbers."""
        columns = [[row[i] for row in self.rows] for i in range(len(self.columns))]
        texts = [[cell for cell in column if isinstance(cell, str) and cell] for column in columns]
        return [all(text.replace(".", "", 1).isdigit() for text in column) for column in texts]

    def texts(self, form: str = "", escape: Callable[[str], str] = str) -> list[list[str]]:
        """Format all cells.

        Args:
            form: one of ``MARKS``; "": no marks.
            escape: function applied to the text of each cell first.
        """

        def marked(i: int, j: int, text: str) -> str:
            return MARKS[form].get(self.marks.get((i, j)), "{}").format(escape(text))

        texts = [map(Column.text, self.columns, row) for row in self.rows]
        return [[marked(i, j, text) for j, text in enumerate(row)] for i, row in enumerate(texts)]

    def csv(self) -> str:
        """Return all digits as CSV; half the interval of an estimate, and how many values it is of, have
        columns of their own.
        """
        lines = [[] for _ in range(1 + len(self.rows))]
        for i, column in enumerate(self.columns):
            cells = [row[i] for row in self.rows]
            parts = [(column.name, f"{column.name} ci95", f"{column.name} n"), *map(_parts, cells)]
            width = 3 if any(isinstance(cell, Estimate) for cell in cells) else 1
            for line, part in zip(lines, parts):
                line += part[:width]
        file = io.StringIO()
        csv.writer(file, lineterminator="\n").writerows(lines)  # None is empty
        return file.getvalue()


def _parts(cell: Cell) -> tuple:
    return (cell.mean, cell.half_width, cell.count) if isinstance(cell, Estimate) else (cell, None, None)


def score_columns(names: Iterable[str], *, with_unit: bool = False) -> dict[str, Column]:
    """Make a column for each metric, named by its title, or by its heading, which has the unit."""
    metrics = {name: metric_of(name) for name in names}
    return {n: Column(m.heading if with_unit else m.title, m.digits) for n, m in metrics.items()}


_TAG = re.compile(r"<(?!/?u>)(?=[A-Za-z/!?])")  # a run's names and notes may hold any; ours underline


@dataclass(frozen=True)
class Section:
    """A heading with tables, or pictures and a caption, ``facts`` on how they came about, and footnotes."""

    title: str
    tables: Sequence[Table] = ()
    facts: Sequence[str] = ()
    notes: Sequence[str] = ()
    pictures: Sequence[Path] = ()
    caption: str = ""


def rendered(template: str, **values: object) -> str:
    """Fill a template of ``templates/``; in HTML all text is escaped, in Markdown all tags but ours."""
    text = _environment().get_template(template).render(**values)
    return _TAG.sub("&lt;", text) if template.endswith(".md.j2") else text


@cache
def _environment() -> Environment:
    blocks = dict.fromkeys(("trim_blocks", "lstrip_blocks", "keep_trailing_newline"), True)
    environment = Environment(loader=FileSystemLoader(TEMPLATES), undefined=StrictUndefined, **blocks)
    environment.autoescape = lambda name: name.endswith(".html.j2")
    environment.globals |= {"nets": NETS, "intervals": INTERVALS}
    environment.filters |= {
        "tex": latex_text,
        "label": lambda text: "-".join(re.findall("[a-z0-9]+", text.lower())),
        "tex_head": _latex_head,
        "tex_rows": lambda table: table.texts("tex", latex_text),
        "inlined": lambda path: "data:image/png;base64," + base64.b64encode(image_bytes(path)).decode(),
    }
    return environment


def _latex_head(name: str) -> str:
    """Write a column's title for LaTeX: that of a score on two lines, as its numbers are narrow."""
    *group, metric = name.split(" ")
    if not group or metric[-1:] not in ("↑", "↓"):
        return latex_text(name)
    return f"\\shortstack[r]{{{latex_text(' '.join(group))}\\\\{latex_text(metric)}}}"


def latex_text(text: str) -> str:
    """Escape text for LaTeX; powers, and the minus of numbers, are formulas.

    >>> print(latex_text("50 % of a_b: δ<1.25², -0.4 (80^3)"))
    50 \\% of a\\_b: $\\delta<$1.25$^2$, $-$0.4 (80$^{3}$)
    """
    known = (_LATEX.get(c) or (c if c <= _LAST else f"[U+{ord(c):04X}]") for c in text)
    escaped = _POWER.sub(r"$^{\1}$", "".join(known))
    return _BETWEEN.sub("", _MINUS.sub("$-$", escaped))
