"""``python -m tests.stability.report``: write the table of operators of docs/stability.md."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

from forewarp.cli.entry import quiet
from forewarp.runs.config_files import project_root
from tests.stability import hard_particles
from tests.stability.twin import BACKENDS, CASES, rows

COLUMNS = [f"{what}, {backend}" for backend in BACKENDS for what in ("values", "gradients")]


def error_text(error: float | None) -> str:
    """Format an error with one digit.

    >>> error_text(3.14e-7), error_text(0.0), error_text(None), error_text(float("nan"))
    ('3e-07', '0', '', 'not finite')
    """
    if error is None:
        return ""
    return "not finite" if math.isnan(error) else "0" if error == 0 else f"{error:.0e}"


def table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Make a Markdown table."""
    rule = ["---"] * len(header)
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, rule, *lines))


def operator_table() -> str:
    """Measure every operator's errors, and print each."""
    lines = []
    for row in rows((*CASES, hard_particles.cases)):
        lines.append([row["operator"], row["input"], *(error_text(row[c]) for c in COLUMNS)])
        print("  ".join(lines[-1]), flush=True)
    return table(["operator", "input", *COLUMNS], lines)


def replace_section(path: Path, name: str, text: str) -> None:
    """Replace what is between ``<!-- name -->`` and ``<!-- end of name -->`` in a file by ``text``.

    Raises:
        ValueError: where the marks are missing.
    """
    before = path.read_text()
    marks = re.compile(f"(<!-- {name} -->\n).*?(<!-- end of {name} -->)", re.DOTALL)
    if not marks.search(before):
        raise ValueError(f"{path}: expected the marks of '{name}', but got none; put them back")
    path.write_text(marks.sub(lambda found: f"{found[1]}\n{text}\n\n{found[2]}", before))


def main() -> None:
    """Measure, and write the table."""
    quiet()
    document = project_root() / "docs" / "stability.md"
    replace_section(document, "operators", operator_table())
    print(document)


if __name__ == "__main__":
    main()
