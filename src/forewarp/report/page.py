"""Write a report's sections as Markdown, as LaTeX tables, and as one HTML file with its pictures."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

from forewarp.report.tables import Table

STYLE = """
body { font: 15px/1.45 sans-serif; margin: 2em auto; max-width: 75em; padding: 0 1em; color: #222 }
table { border-collapse: collapse; margin: 1em 0; font-size: 13px; display: block; overflow-x: auto }
th, td { padding: .2em .6em; text-align: left; white-space: nowrap } td.n { text-align: right }
th { border-bottom: 1px solid #222 } tr.rule td { border-top: 1px solid #999 }
img { max-width: 100% } .about { font-size: 13px; color: #555 }
"""
LATEX_HEAD = r"""% All tables of one report; each stands for itself and needs booktabs and graphicx.
\documentclass{article}
\usepackage[a4paper, landscape, margin=15mm]{geometry}
\usepackage{booktabs, graphicx}
\begin{document}
"""
_LATEX = {
    **{c: "\\" + c for c in "&%$#_{}"},
    **{"±": r"$\pm$", "δ": r"$\delta$", "<": "$<$", ">": "$>$", "↑": r"$\uparrow$", "↓": r"$\downarrow$"},
    **{
        "\\": r"\textbackslash{}",
        "^": r"\textasciicircum{}",
        "~": r"\textasciitilde{}",
        "²": "$^2$",
        "×": r"$\times$",
    },
}


@dataclass(frozen=True)
class Section:
    """A heading with tables and pictures, ``facts`` on how they came about, and footnotes."""

    title: str
    tables: Sequence[Table] = ()
    facts: Sequence[str] = ()
    notes: Sequence[str] = ()
    pictures: Sequence[Path] = field(default_factory=tuple)


def markdown(title: str, introduction: str, sections: Sequence[Section]) -> str:
    """Return the page as Markdown, with links to its pictures."""
    parts = [f"# {title}\n", introduction + "\n"]
    for section in sections:
        parts += [f"## {section.title}\n", *(table.markdown() for table in section.tables)]
        parts += [f"![{path.stem}]({path.name})\n" for path in section.pictures]
        lines = [f"* {line}" for line in section.facts]
        lines += [f"{number}. {note}" for number, note in enumerate(section.notes, 1)]
        parts += ["\n".join(lines) + "\n"] if lines else []
    return "\n".join(parts)


def html(title: str, introduction: str, sections: Sequence[Section]) -> str:
    """Return the page as HTML that holds its pictures and fetches nothing."""
    parts = [f"<!doctype html>\n<html lang=en><meta charset=utf-8><title>{escape(title)}</title>"]
    parts += [f"<style>{STYLE}</style>", f"<h1>{escape(title)}</h1><p>{escape(introduction)}</p>"]
    for section in sections:
        parts.append(f"<h2>{escape(section.title)}</h2>")
        parts += [html_table(table) for table in section.tables]
        parts += [
            f'<p><img alt="{escape(path.stem)}" src="{_inline(path)}"></p>' for path in section.pictures
        ]
        parts.append("<ul class=about>" + "".join(f"<li>{escape(line)}" for line in section.facts) + "</ul>")
        parts.append("<ol class=about>" + "".join(f"<li>{escape(line)}" for line in section.notes) + "</ol>")
    return "\n".join(parts) + "\n</html>\n"


def latex(sections: Sequence[Section]) -> str:
    """Return a document with every table: booktabs, the best bold, the second underlined."""
    tables = [_latex_table(section, table) for section in sections for table in section.tables]
    return LATEX_HEAD + "\n".join(tables) + "\\end{document}\n"


def latex_text(text: str) -> str:
    """Escape text for LaTeX.

    >>> latex_text("50 % of a_b")
    '50 \\\\% of a\\\\_b'
    """
    return "".join(_LATEX.get(c, c) for c in text)


def _latex_table(section: Section, table: Table) -> str:
    rows = table.texts({"best": "\\textbf{{{}}}", "second": "\\underline{{{}}}"}, latex_text)
    caption = ". ".join(part.rstrip(".:") for part in (section.title, table.caption) if part)
    lines = ["\\begin{table}[p]", "\\centering", f"\\caption{{{latex_text(caption)}}}"]
    lines += ["\\resizebox{\\textwidth}{!}{%", f"\\begin{{tabular}}{{{_aligned(table)}}}", "\\toprule"]
    lines += [" & ".join(latex_text(column.name) for column in table.columns) + " \\\\", "\\midrule"]
    for number, row in enumerate(rows):
        lines += ["\\midrule"] if number in table.rules and number else []
        lines.append(" & ".join(row) + " \\\\")
    lines += ["\\bottomrule", "\\end{tabular}}"]
    lines += [f"\\par\\footnotesize {latex_text(fact)}" for fact in section.facts]
    lines += [f"\\par\\footnotesize $^{{{i}}}$~{latex_text(note)}" for i, note in enumerate(section.notes, 1)]
    return "\n".join([*lines, "\\end{table}", "\\clearpage", ""])


def _aligned(table: Table) -> str:
    return "".join("r" if numeric else "l" for numeric in table.numeric)


def html_table(table: Table) -> str:
    """Return a table, its caption above it, as HTML."""
    marks = {"best": "<b>{}</b>", "second": "<u>{}</u>"}
    head = "".join(f"<th>{escape(column.name)}" for column in table.columns)
    lines = [f"<p>{escape(table.caption)}</p>" if table.caption else "", f"<table><tr>{head}"]
    numeric = table.numeric  # looks at all rows
    for number, row in enumerate(table.texts(marks, escape)):
        cells = "".join(f"<td{' class=n' * n}>{text}" for text, n in zip(row, numeric))
        lines.append(f"<tr{' class=rule' * (number in table.rules)}>{cells}")
    return "\n".join(lines) + "</table>"


def _inline(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
