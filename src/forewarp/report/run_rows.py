"""A row a run, in a CSV table that later runs add to: the pages of minutes and of methods are made of it."""

from __future__ import annotations

import csv
import io
import re
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path

from forewarp.files import read_rows, read_text, replace_file
from forewarp.metrics.gain import Estimate
from forewarp.report.collect import Result, collect, machines
from forewarp.report.protocols import pictures_in_words
from forewarp.report.sheets import images_of

# Rows that differ in these are not compared.
CONDITIONS = ("clock", "threads", "device", "measured", "pictures", "iterations", "held_out", "density")
CONDITIONS += ("steps_per_picture",)
FORMS = {"clock": "{} clock", "threads": "threads: {:g}"}
FORMS |= {"iterations": "{:g} steps at most", "held_out": "{:g} views held out"}
FORMS |= {"density": "stage.fine.density={:g}", "steps_per_picture": "stage.fine.steps_per_picture={}"}
KEY = ("method", "preset", "scene", "minutes", "seed", *CONDITIONS)  # what tells rows apart
ABILITIES = ("space", "time", "canonical")
NUMBERS = ("psnr", "ssim", "lpips", "steps", "step", "frame", "parameters", "memory", "ends")
NUMBERS += ("motion_error", *(f"psnr_{ability}" for ability in ABILITIES), "size", "wall", "processor")
TEXTS = ("dataset", "day", "commit", "departures", "faults", "views", "curve", "command")
# What stands for the folders of whoever types a command again.
PLACES = {"paths.scenes": "DATASETS", "data.root": "SCENES", "lpips_weights": "WEIGHTS"}
OWN = ("run", "sheets", "paths.runs", "paths.data")  # keys that say where a run's files are, not what it is
NETS = ("vgg", "alex", "squeeze")  # LPIPS is of the first whose weights were there
CLOCKS = """Minutes are of training: setting up counts (a visual hull, a plane sweep), reading pictures and
compiling do not. The processor clock counts processor time of the process, which is the same beside other
work on the machine and, with one thread, equals the wall clock on an idle one."""
DENSITY = re.compile(r"\sstage\.fine\.density=([\d.]+)")  # in a command
STEPS_PER_PICTURE = re.compile(r"\sstage\.fine\.steps_per_picture=(\S+)")
EARLY = 0.95  # of its minutes: a run that took less ended by its steps
LATE = 1.5  # of its minutes: a run that took more had a last step that took long
_ENDS = 0.1  # share of the time that counts as its first and last part
_MOST = 1 << 24  # bytes of a table that is read back


def of_minutes(runs: Path) -> tuple[list[Result], list[str]]:
    """Read the measured runs below a folder that ended after minutes, and a line for each other run.

    Of runs with the same ``KEY`` the one measured last is returned.

    Raises:
        ValueError: if there is no run at all.
    """
    results, without = collect(runs, ["metrics.json"])
    endless = [result for result in results if result.minutes is None]
    without += [f"{result.folder.relative_to(runs)}: no budget.minutes" for result in endless]
    timed = sorted((r for r in results if r.minutes is not None), key=lambda result: result.measured_at)
    newest = {key_of(row_of(result)): result for result in timed}
    older = [result for result in timed if newest[key_of(row_of(result))] is not result]
    without += [f"{result.folder.relative_to(runs)}: another run of the same is newer" for result in older]
    return list(newest.values()), without


def row_of(result: Result) -> dict:
    """A run's row: ``KEY``, ``NUMBERS`` and ``TEXTS``; what is not known is None.

    ``step`` and ``frame`` are seconds, ``wall`` and ``processor`` those of training by each clock, ``views``
    is time:PSNR of each test view, ``curve`` is seconds:PSNR; ``motion_error`` is the error of moving points
    as a share of their motion, ``size`` the number of particles or voxels, ``density`` and
    ``steps_per_picture`` those of the last stage where they were typed (None: the preset's own).
    """
    views = sorted((one["time"], one["scores"]["psnr"]) for one in images_of(result.folder))
    numbers, scores = result.numbers, result.metrics["test"][result.ability]
    protocol, flow = result.metrics["protocol"], result.metrics.get("flow") or {}
    abilities = {f"psnr_{one}": result.metrics["test"].get(one, {}).get("psnr") for one in ABILITIES}
    typed, steps = DENSITY.search(result.command), STEPS_PER_PICTURE.search(result.command)
    frames = protocol.get("test_frames")
    return {
        "method": result.config["model"]["name"],
        "preset": result.config["preset"]["name"],
        "scene": result.scene,
        "minutes": result.minutes,
        "seed": result.seed,
        "clock": result.clock,
        "threads": protocol.get("threads"),
        "device": protocol.get("device"),
        "measured": protocol.get("measured", frames and f"all {frames} test views"),
        "pictures": pictures_in_words(result),
        "iterations": result.config["budget"].get("iterations"),
        "held_out": protocol.get("held_out") or None,
        "density": float(typed[1]) if typed else None,
        "steps_per_picture": steps and steps[1],
        **{name: numbers.get(name) for name in NUMBERS},
        **abilities,
        **{kind: result.metrics.get("clocks", {}).get(kind) for kind in ("wall", "processor")},
        "motion_error": flow["epe_moving"] / flow["motion_mean"] if flow.get("motion_mean") else None,
        "size": size_of(result),
        "lpips": next((scores[f"lpips_{net}"] for net in NETS if f"lpips_{net}" in scores), None),
        "ends": ends_below(views),
        "dataset": _of_counterpart(result.dataset) if result.is_counterpart else result.dataset,
        "day": result.day,
        "commit": protocol.get("commit"),
        "departures": protocol.get("departures"),
        "faults": protocol.get("faults"),
        "views": " ".join(f"{time:.4f}:{psnr:.2f}" for time, psnr in views),
        "curve": " ".join(f"{point.seconds:.1f}:{point.psnr:.2f}" for point in result.curve),
        "command": portable(result.command),
    }


def size_of(result: Result) -> float | None:
    """The number of particles or voxels; of a run that noted it in its curve alone, the last of that."""
    for count in result.metrics.get("size", {}).values():
        return float(count)
    sizes = [row["size"] for row in read_rows(result.folder / "accuracy_time.csv") if row.get("size")]
    return float(sizes[-1]) if sizes else None


def key_of(row: dict, names: Sequence[str] = KEY) -> tuple:
    """What tells a row from others; where all test views were measured, None, as in an older table."""
    known = row | {"measured": None if (row["measured"] or "").startswith("all ") else row["measured"]}
    return tuple(known[name] for name in names)


def apart(rows: Iterable[dict]) -> list[list[dict]]:
    """Group rows by minutes and ``CONDITIONS``: only rows of one group may be compared."""
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        groups.setdefault(key_of(row, ("minutes", *CONDITIONS)), []).append(row)
    return [groups[key] for key in sorted(groups, key=_order)]


def telling(row: dict, others: Iterable[dict], names: Sequence[str] = CONDITIONS) -> list[str]:
    """Say in a word each which of a row's ``names`` some of the other rows do not share.

    >>> rows = [{"clock": clock, "threads": 1.0, "measured": None} for clock in ("wall", "processor")]
    >>> telling(rows[0], rows, ("clock", "threads"))
    ['wall clock']
    """
    differs = [name for name in names if len({key_of(one, (name,)) for one in (row, *others)}) > 1]
    return [FORMS.get(name, "{}").format(row[name]) for name in differs if row[name] is not None]


def pairs(text: str | None) -> list[tuple[float, float]]:
    """Read what a row has in ``views`` and ``curve``.

    >>> pairs("0.5:30.25 1:31")
    [(0.5, 30.25), (1.0, 31.0)]
    """
    return [tuple(map(float, one.split(":"))) for one in (text or "").split()]


def ends_below(views: Sequence[tuple[float, float]]) -> float | None:
    """By how many dB the mean of the views (time, PSNR) at both ends is below the median of the others.

    >>> ends_below([(0.0, 30.0), (0.05, 31.0), (0.5, 34.0), (0.6, 33.0), (1.0, 32.0)])
    2.5
    """
    ends = [psnr for time, psnr in views if not _ENDS < time < 1 - _ENDS]
    others = [psnr for time, psnr in views if _ENDS < time < 1 - _ENDS]
    return statistics.median(others) - statistics.fmean(ends) if ends and others else None


def merged(file: Path, results: Iterable[Result]) -> list[dict]:
    """Add the rows of runs to those of a table, which is written; return all.

    Of rows with the same ``KEY`` the one measured last stays; a run beats a row of its day.

    Raises:
        ValueError: if there would be no row.
    """
    known = list(csv.DictReader(io.StringIO(read_text(file, _MOST)))) if file.is_file() else []
    rows = [_read(row) for row in known]
    rows += [row_of(result) for result in sorted(results, key=lambda result: result.measured_at)]
    if not rows:
        raise ValueError(
            "runs: expected measured runs that ended after minutes, but got none; set budget.minutes"
        )
    found = {key_of(row): row for row in sorted(rows, key=lambda row: row["day"] or "")}
    rows = [found[key] for key in sorted(found, key=_order)]
    replace_file(file, _csv(rows))
    return rows


def _order(key: tuple) -> list[tuple]:
    """Sort keys by their parts, what is unknown first."""
    return [(part is not None, part) for part in key]


def _read(row: dict) -> dict:
    """A row as ``row_of`` makes it; of an older table some fields are unknown."""
    counted = ("minutes", "threads", "iterations", "held_out", "density", *NUMBERS)
    numbers = {name: float(row[name]) if row.get(name) else None for name in counted}
    named = ("clock", "device", "measured", "pictures", "steps_per_picture", *TEXTS)
    texts = {name: row.get(name) or None for name in named}
    if " scene=counterpart_" in (texts["command"] or ""):
        texts["dataset"] = _of_counterpart(texts["dataset"] or "")
    return row | numbers | texts | {"seed": int(row["seed"]), "clock": texts["clock"] or "wall"}


def _of_counterpart(dataset: str) -> str:
    """Name the dataset of a scene that stands in for its scenes, whose means it does not belong to."""
    return dataset if dataset.startswith("counterpart") else f"counterpart of {dataset}"


def ended_early(rows: Sequence[dict]) -> float | None:
    """The mean minutes that runs took which ended before theirs; None if they took what they had.

    >>> ended_early([{"clock": "processor", "processor": 300.0, "minutes": 20.0}])
    5.0
    """
    minutes = _taken(rows)
    return minutes if minutes is not None and minutes < EARLY * rows[0]["minutes"] else None


def another_length(rows: Sequence[dict]) -> str:
    """Words for runs that took other minutes than theirs: less by their steps, or more by a long last step.

    >>> another_length([{"clock": "wall", "wall": 301.0, "minutes": 20.0}])
    ' (ended after 5 min)'
    >>> another_length([{"clock": "wall", "wall": 36.2, "minutes": 1 / 6}])
    ' (took 36 s)'
    """
    early, taken = ended_early(rows), _taken(rows)
    if early is not None:
        return f" (ended after {length(early)})"
    late = taken is not None and taken > LATE * rows[0]["minutes"]
    return f" (took {length(taken)})" if late else ""


def _taken(rows: Sequence[dict]) -> float | None:
    """The mean minutes that runs took, by the clock that theirs are of; None where none is known."""
    taken = [row[row["clock"]] for row in rows if row[row["clock"]] is not None]
    return statistics.fmean(taken) / 60 if taken else None


def _csv(rows: list[dict]) -> str:
    file, fields = io.StringIO(), (*KEY, *NUMBERS, *TEXTS)
    writer = csv.DictWriter(file, fields, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: "" if row[name] is None else row[name] for name in fields} for row in rows)
    return file.getvalue()


def length(minutes: float) -> str:
    """Spell a length of training.

    >>> length(1 / 30), length(1.0), length(2.5)
    ('2 s', '1 min', '2.5 min')
    """
    return f"{60 * minutes:.0f} s" if minutes < 1 else f"{round(minutes, 1):g} min"


def estimate(rows: Sequence[dict], name: str) -> Estimate | None:
    """Estimate a number over the rows that have it; None if none has."""
    return Estimate.of([row[name] for row in rows if row[name] is not None])


def made_on(rows: Sequence[dict]) -> str:
    """Say in a line on what the runs were computed, and when."""
    line = machines((row["device"], row["threads"], f"minutes by the {row['clock']} clock") for row in rows)
    days = sorted({row["day"] for row in rows if row["day"]})
    return line + (f"; {' to '.join(dict.fromkeys((days[0], days[-1])))}" if days else "")


def commands(rows: Sequence[dict], sweep: str) -> str:
    """The section with the commands that made the rows: those that differ only in ``model=`` as one.

    Args:
        rows: as of ``row_of``.
        sweep: name of the sweep that gives jobs the processor clock, one thread and a folder each.
    """
    models: dict[str, list[str]] = {}
    for row in (row for row in rows if row["command"]):
        command = _repeated(row, sweep)
        model = re.search(r" model=(\S+)", command)
        command = command.replace(model[0], " model={}", 1) if model else command
        known = models.setdefault(command, [])
        known += [model[1]] if model and model[1] not in known else []
    lines = []
    for command, names in models.items():
        if len(names) > 1 and "--multirun" not in command:
            command = command.replace("forewarp-train", "forewarp-train --multirun", 1)
        lines.append(command.replace("model={}", f"model={','.join(names)}"))
    about = "Each with its `seed=`; words in capitals are folders of your own.\n"
    return "\n".join(["## Commands\n", about, "```bash", *sorted(lines), "```\n"])


def portable(command: str) -> str:
    """A command without the folders of whoever typed it.

    >>> portable("forewarp-train seed=1 paths.scenes=/data paths.runs=r model=forward")
    'forewarp-train seed=1 paths.scenes=DATASETS model=forward'
    """
    command = re.sub(rf"\s({'|'.join(map(re.escape, OWN))})=\S+", "", command)
    for key, word in PLACES.items():
        command = re.sub(rf"(\s{re.escape(key)}=)\S+", rf"\g<1>{word}", command)
    return command


def _repeated(row: dict, sweep: str) -> str:
    """A row's command as another would type it: without seed and folder, as a job of the sweep if it may be.

    >>> row = {"command": "forewarp-train seed=1 scene=s run=r", "clock": "processor", "threads": 1.0}
    >>> _repeated(row, "minutes")
    'forewarp-train --multirun sweeps=minutes scene=s'
    >>> _repeated(row | {"threads": 2.0}, "minutes")
    'forewarp-train scene=s budget.clock=processor threads=2'
    """
    command = re.sub(r"\sseed=\S+", "", portable(row["command"]))
    if row["clock"] == "wall" or "#" in command:
        return command
    command = re.sub(r"\s(budget\.clock|threads)=\S+", "", command)
    if re.search(r" (data\.)?scene=", command) and row["clock"] == "processor" and row["threads"] == 1:
        return command.replace("forewarp-train", f"forewarp-train --multirun sweeps={sweep}", 1)
    threads = f" threads={row['threads']:g}" if row["threads"] else ""
    return f"{command} budget.clock={row['clock']}{threads}"
