"""``python -m tests.stability.report [--long]``: write the tables of docs/stability.md."""

from __future__ import annotations

import argparse
import math
import re
import statistics
from collections.abc import Sequence
from pathlib import Path

from forewarp.cli.entry import quiet
from forewarp.runs.config_files import project_root
from tests.stability.endurance import RATES, SEEDS, STEPS, endure
from tests.stability.twin import BACKENDS, rows

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
    for row in rows():
        lines.append([row["operator"], row["input"], *(error_text(row[c]) for c in COLUMNS)])
        print("  ".join(lines[-1]), flush=True)
    return table(["operator", "input", *COLUMNS], lines)


def endurance_table(trials: Sequence[dict]) -> str:
    """Summarise PSNR by learning rate, and how many runs failed."""
    lines = []
    for rate in sorted({t["rate"] for t in trials}):
        own = [t for t in trials if t["rate"] == rate]
        scores = [t["psnr"] for t in own if t["wrong"] is None]
        spread = [f"{f(scores):.2f}" for f in (min, statistics.median, max)] if scores else [""] * 3
        deviation = f"{statistics.pstdev(scores):.2f}" if scores else ""
        lines.append([f"x{rate:g}", str(len(own)), str(len(own) - len(scores)), *spread, deviation])
    return table(["lr", "seeds", "not finite", "least PSNR", "median", "most", "deviation"], lines)


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


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and write the tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.stability.report", description=__doc__)
    parser.add_argument(
        "--long",
        action="store_true",
        help="also fit many seeds at high learning rates; continues where it stopped",
    )
    parser.add_argument(
        "--no-operators", dest="operators", action="store_false", help="keep the table of operators"
    )
    parser.add_argument("--seconds", type=float, default=math.inf, help="most seconds for the long runs")
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument(
        "--trials", type=Path, default=Path("runs/stability/trials.jsonl"), help="file of the long runs"
    )
    parser.add_argument("--document", type=Path, default=None, help="instead of docs/stability.md")
    given = parser.parse_args(arguments)
    quiet()
    document = given.document or project_root() / "docs" / "stability.md"
    if given.operators:
        replace_section(document, "operators", operator_table())
    if given.long:
        trials = endure(given.trials, seconds=given.seconds, seeds=given.seeds, steps=given.steps)
        text = endurance_table(trials)
        wanted = given.seeds * len(RATES)
        if len(trials) < wanted:
            text += f"\n\n{len(trials)} of {wanted} done; the same command goes on."
        replace_section(document, "long runs", text)
    print(document)


if __name__ == "__main__":
    main()
