"""Keep a page's runs in its CSV file, and read them back, so that the page can be written anew without them.

A file has a row a run. It is of a page whose runs are read from one folder each time; to the tables of
``kind=minutes`` and ``kind=methods`` later runs are added (``results.add_rows``).
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path

from forewarp.files import read_rows
from forewarp.metrics.registry import described_own, take_described
from forewarp.report.results import DESCRIBED, SCORES, Point, Row, Runs, number_in, pairs, read_runs
from forewarp.report.settings import name_settings

TEXTS = ("scene", "variant", "ablation", "against", "about", "method", "preset", "ability", "effects")
TEXTS += ("clock", "device", "torch", "measured", "pictures", "dataset", "origin", "protocol", "day", "curve")
TEXTS += ("image_format", "command", "files")
# Column of the kinds of test view, or other columns, of which it is not known which seed has which value.
UNPAIRED = "unpaired"
WHOLE = ("seed", "iterations", "held_out", "train_views", "tested", "counterpart", "steps")
NUMBERS = ("minutes", "threads", "step", "train", "frame", "memory", "parameters", "epe", "late", *WHOLE)
OF_KIND = "test "  # begins the column of a score of a kind of test view, as in ``test space psnr``


def is_stored(path: Path) -> bool:
    """Whether a path names a CSV file of runs in place of a folder with runs.

    Raises:
        ValueError: if the file is not there.
    """
    if path.suffix == ".csv" and not path.exists():
        raise ValueError(f"runs: expected a CSV file of a page, but got {path}, which is not there")
    return path.suffix == ".csv"


def read_any(path: Path, needed: Sequence[str] = ("metrics.json",)) -> tuple[Runs, list[str]]:
    """Read a folder's runs as ``results.read_runs`` does, or those that ``stored_csv`` wrote to a file."""
    return (read_stored(path), []) if is_stored(path) else read_runs(path, needed)


def stored_csv(runs: Runs) -> str:
    """Return the text of a CSV file with all that pages of choices show of runs."""
    kinds = ((kind, name) for row in runs for kind, scores in row["test"].items() for name in scores)
    of_kind = {f"{OF_KIND}{kind} {name}": (kind, name) for kind, name in kinds}
    file, fields = io.StringIO(), [*TEXTS, "overrides", *NUMBERS, *runs.scores(), *of_kind, "plan"]
    fields += [UNPAIRED] if any(row.get(UNPAIRED) for row in runs) else []
    own = described_own(dict.fromkeys([*runs.scores(), *(name for _, name in of_kind.values())]))
    fields += [DESCRIBED] if own else []
    writer = csv.DictWriter(file, fields, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in runs:
        tested = {column: row["test"].get(kind, {}).get(name) for column, (kind, name) in of_kind.items()}
        plan = json.dumps(row["plan"]) if row["plan"] else None
        writer.writerow(row | tested | {"plan": plan, "counterpart": int(row["counterpart"]), DESCRIBED: own})
    return file.getvalue()


def read_stored(file: Path) -> Runs:
    """Read what ``stored_csv`` wrote; each row is as of ``results.read_run``, without what only folders hold.

    Raises:
        ValueError: if the file is not there, or has no row of such a file.
    """
    rows = read_rows(file)
    if not rows or not {"scene", "variant", "seed"} <= set(rows[0]):
        expected = "a CSV file of a page, with the columns scene, variant and seed"
        raise ValueError(f"runs: expected {expected}, but got {file}; name a folder with runs")
    runs = Runs(_row(line, Path(f"{file}:{number}"), number) for number, line in enumerate(rows, 2))
    name_settings(runs)
    return runs


def _row(line: dict[str, str], place: Path, number: int) -> Row:
    row = {name: line.get(name) or None for name in TEXTS}
    row |= {name: number_in(line, name, str(place)) for name in NUMBERS}
    row |= {name: int(row[name]) for name in WHOLE if row[name] is not None}
    row |= {name: row[name] or "" for name in ("effects", "about", "image_format")}
    row |= {"counterpart": bool(row["counterpart"])}
    row |= {
        "overrides": line.get("overrides"),
        UNPAIRED: line.get(UNPAIRED) or None,
        "folder": place,
        "measured_at": number,
    }
    row |= {"images": [], "config": {}, "metrics": {}}
    row |= {"points": tuple(Point(seconds, psnr, 0) for seconds, psnr in pairs(row["curve"]))}
    row |= {"plan": json.loads(line.get("plan") or "{}"), "test": {}}
    take_described(json.loads(line.get(DESCRIBED) or "{}"))
    others = {*TEXTS, *NUMBERS, "overrides", "plan", DESCRIBED, UNPAIRED}
    scored = [name for name in line if name not in others]
    scores = dict.fromkeys(SCORES) | {name: number_in(line, name, str(place)) for name in scored}
    for column in [name for name in scores if name.startswith(OF_KIND)]:
        kind, name = column.removeprefix(OF_KIND).split(" ", 1)
        if (score := scores.pop(column)) is not None:
            row["test"].setdefault(kind, {})[name] = score
    row |= {f"psnr_{kind}": row["test"].get(kind, {}).get("psnr") for kind in ("space", "time", "canonical")}
    return row | scores | {"scores": scores}
