"""Write the pages of methods under one clock, from CSV tables that later runs add to.

Functions that write search a folder for measured runs, write to ``out``, and return the files written.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

from forewarp.files import load_yaml, read_rows, read_text, replace_file
from forewarp.metrics.registry import metric_of
from forewarp.report import figures
from forewarp.report.results import Row, Runs, add_rows, in_words, length, nothing, read_runs
from forewarp.report.settings import CONDITIONS, grouped, key_of
from forewarp.report.statistics import LEAST, Estimate, by_chance, paired_change, rank, verdict
from forewarp.report.stored import is_stored
from forewarp.report.tables import Column, Table, rendered, score_columns

OTHERS = Path(__file__).with_name("published.yaml")  # results of others
LENGTHS = 3  # of training, at least: two points make no curve
TASK = ("scene", "preset", "minutes", "setting", *CONDITIONS)
BEGIN = {"label": "scene", "took": Column("minutes", 0)}
DENSITY = r"stage\.\w+\.density"  # of particles; the last stage's tells
COSTS = {"processor": Column("processor (s)", 0), "wall": Column("wall (s)", 0), "steps": Column("steps", 0)}
COSTS |= {"ms": Column("ms a step", 1), "frame": Column("seconds per image", 3)}
COSTS |= {"parameters": Column("parameters (M)"), "memory": Column("GiB")}
REDUCED = re.compile(r"(\d+)x(\d+) reduced (\d+)x\3")
# Words of a picture of methods on an earlier page.
SHOWN = re.compile(r"[^\[\]]* after (?P<minutes>\S+) minutes: (?P<methods>[^\[\]]*)$")


class Published(NamedTuple):
    """A result of others: PSNR (dB) on a dataset after ``seconds`` on some hardware."""

    name: str
    seconds: float
    psnr: float
    hardware: str
    source: str
    dataset: str


def read_published(path: Path | None = None) -> list[Published]:
    """Read a YAML list of entries with the keys of ``Published``; None: ``OTHERS``.

    Raises:
        ValueError: if the file is no YAML, or an entry has other keys.
    """
    path = path or OTHERS
    try:
        return [Published(**entry) for entry in load_yaml(path)]
    except TypeError as error:
        expected, got = f"entries with the keys {', '.join(Published._fields)}", str(error).splitlines()[0]
        raise ValueError(f"{path}: expected {expected}, but got {got}") from None


def write_minutes(folder: Path, out: Path, published: Path | None = None) -> list[Path]:
    """Write ``<method>.md``, ``.csv`` (a row a run) and ``.png`` (PSNR by view) of each method in the runs,
    and ``accuracy-time.md`` of them all, with the results of others in the file ``published`` (``OTHERS``).

    Rows of a table that is there already stay, unless a run of the same ``results.KEY`` replaces them: runs
    may be made one day after the other. Each page compares its method with the others, so that the pages of
    methods with a table in ``out`` are written anew too.
    """
    others = read_published(published)
    runs, left_out = _timed(folder)
    methods, written = {row["method"] for row in runs}, []
    for file in out.glob("*.csv"):  # of earlier calls
        named = {row.get("method") for row in read_rows(file)}
        methods |= named if named == {file.stem} and file.with_suffix(".md").is_file() else set()
    if not runs and not (is_stored(folder) and methods):
        raise _nothing(folder, runs, left_out)
    rows = {name: added(out / f"{name}.csv", runs.where(method=name)) for name in sorted(methods)}
    tables = {method: labelled(own) for method, own in rows.items()}
    for method, own in tables.items():
        rivals = {other: found for other, found in tables.items() if other != method}
        page, picture = out / f"{method}.md", out / f"{method}.png"
        replace_file(page, rendered("minutes.md.j2", left_out=left_out, **_of_method(method, own, rivals)))
        scenes = {}
        for group in alike(plain(own)):
            label = f"{length(group[0]['minutes'])}, {len(group)} seed{'s' * (len(group) > 1)}"
            points = group.by_time()
            scenes.setdefault(group[0]["label"], {}).update({label: points} if points else {})
        figures.draw_by_time(picture, scenes)
        written += [page, out / f"{method}.csv", picture]
    return written + _write_lengths(tables, out, others)


def _timed(folder: Path) -> tuple[Runs, list[str]]:
    """Read the measured runs of so many minutes, and a line for each other run.

    A table in place of a folder has no further runs: rows of tables are those in ``out``.
    """
    runs, left_out = (Runs(), []) if is_stored(folder) else read_runs(folder)
    endless = [f"{row['folder'].relative_to(folder)}: no budget.minutes" for row in runs.where(minutes=None)]
    return Runs(row for row in runs if row["minutes"] is not None), left_out + endless


def _nothing(folder: Path, runs: Runs, left_out: Sequence[str]) -> ValueError:
    takes = "runs of budget.minutes with a config.yaml and metrics.json"
    return nothing(folder, runs, left_out, takes, "make some with forewarp-train --multirun sweeps=minutes")


def labelled(runs: Runs) -> Runs:
    """Give rows a ``label``: the scene and, where its plain rows differ in what ``TASK`` has more, in what;
    and likewise a ``group``: the dataset, of whose scenes there is a mean.
    """
    found, names = Runs(), ("preset", "changed", *CONDITIONS)
    for row in runs:
        others, is_plain = plain(runs.where(scene=row["scene"])), bool(plain(Runs([row])))
        words = in_words(row, others, names) if is_plain else []
        label, group = (", ".join([name, *words]) for name in (row["scene"], row["dataset"] or ""))
        found.append(row | {"label": label, "group": group})
    return found


def added(file: Path, rows: Iterable[Row]) -> Runs:
    """Add rows as ``add_rows`` does; give all their ``density`` and, where settings differ in more, what else
    was ``changed``.
    """
    runs = add_rows(file, rows)
    for row in runs:
        of_density = {key: word for key, word in row["words"].items() if re.fullmatch(DENSITY, key)}
        others = [word for key, word in row["words"].items() if key not in of_density]
        numbers = [float(word.rpartition("=")[2]) for word in of_density.values()]
        row |= {"density": numbers[-1] if numbers else None, "changed": " ".join(others) or None}
    return runs


def plain(runs: Runs) -> Runs:
    """Select the rows of the main tables: of the preset's own density, pictures scored as they are."""
    return Runs(r for r in runs if r["density"] is None and not REDUCED.search(r["pictures"] or ""))


def alike(runs: Runs) -> list[Runs]:
    """Group rows that differ in the seed alone; by scene, minutes and number of particles or voxels."""
    groups = runs.by("method", *TASK).values()
    return sorted(groups, key=lambda group: (group[0]["label"], group[0]["minutes"], size_of(group)))


def size_of(group: Runs) -> float:
    """Return the mean number of particles or voxels, or, where it is unknown, the density or 0."""
    return group.mean("size") or group[0]["density"] or 0.0


def row_of(group: Runs, **more: object) -> dict:
    """Make the row of tables for runs that differ in the seed; ``took``: the minutes that they took."""
    took = length(group[0]["minutes"]).removesuffix(" min") + group.taken()[1]
    step, error = group.mean("step"), group.estimate("motion_error")
    more |= {"ms": step and 1000 * step, "moving": error and error.times(100)}
    more |= {"particles": size_of(group) or None}
    return group.summary(took=took, **more)


def _of_method(method: str, runs: Runs, others: Mapping[str, Runs]) -> dict:
    """Make all that the page of a method shows."""
    groups, scores = alike(plain(runs)), score_columns(runs.scores())
    with_seeds = BEGIN | {"seeds": Column("seeds", 0)}
    size = Column("particles" if method == "particles" else "voxels or parameters", 0, spread=False)
    each = with_seeds | scores | {"ends": Column("ends (dB)", 1, spread=False), "size": size}

    abilities = {"psnr_space": "space", "psnr_time": "time", "psnr_canonical": "canonical"}
    shared = {(row["scene"], row["minutes"]) for row in runs}
    rivals = (row for row in chain(*others.values()) if (row["scene"], row["minutes"]) in shared)
    told = (*abilities, "motion_error")
    known = Runs(row for row in (*runs, *rivals) if any(row[name] is not None for name in told))
    columns = BEGIN | {"name": "method", "seeds": Column("seeds", 0)} | abilities
    columns |= {"moving": Column("moving points (%)", 1)}
    by_ability = [row_of(group, name=f"`{group[0]['method']}`") for group in alike(plain(known))]

    sized = Runs(row for row in runs if row["size"] and not REDUCED.search(row["pictures"] or ""))
    density = with_seeds | {"density": Column("density", 0), "particles": Column("particles", 0)} | scores
    minutes = _against_fewer(plain(runs), "minutes", lambda group: group[0]["minutes"])
    denser = _against_fewer(sized, "density", size_of)
    larger = _larger(runs.where(density=None))
    pictures = with_seeds | {"pictures": "images"} | scores

    def with_chance(rows: list[dict], columns: dict) -> Table:
        return Table.of(rows, columns, by_chance(row["change"] for row in rows))

    costs = BEGIN | {name: replace(column, spread=False) for name, column in COSTS.items()}
    return {
        "method": method,
        "machine": made_on(runs),
        "versions": len({row["commit"] or row["day"] for row in runs}),
        "by_minutes": _by_minutes(plain(runs)),
        "each": Table.of(map(row_of, groups), each),
        "beside": {other: _beside(method, runs, other, found) for other, found in others.items()},
        "abilities": Table.of(by_ability, columns),
        "more_minutes": with_chance(minutes, with_seeds | scores | {"verdict": "against fewer minutes"}),
        "more_density": with_chance(denser, density | {"verdict": "against fewer"}),
        "larger": Table.of(larger, pictures | {"verdict": "the larger is"}),
        "costs": Table.of(map(row_of, groups), costs),
        "command": runs.command(),
    }


def made_on(runs: Runs) -> str:
    """Say in a line on what the runs were computed, by which clock, and when."""
    return "; ".join(filter(None, (runs.machines("minutes by the {clock} clock"), runs.days())))


def _by_minutes(runs: Runs) -> Table:
    """Pivot PSNR by scene and minutes, and its mean over a dataset's scenes where all are there."""
    scenes, minutes = runs.by("label"), list(runs.by("minutes"))
    cells = {key: group.estimate("psnr") for key, group in runs.by("label", "minutes").items()}
    lines = [[scene, *(cells.get((scene, m)) for m in minutes)] for scene in scenes]
    for dataset, found in runs.by("group").items():
        means = [_mean_of_scenes(found.where(minutes=m), list(found.by("label"))) for m in minutes]
        lines += [[f"mean of {dataset}", *means]] if len(found.by("label")) > 1 else []
    early = any(group.taken()[0] for group in alike(runs))
    several = any(len(found.by("label")) > 1 for found in runs.by("group").values())
    about = " A mean of scenes is over the seeds that all have; those of a seed are averaged first." * several
    about += " Some runs ended by their steps, before their minutes: see *Each*." * early
    return Table(["scene", *map(length, minutes)], lines, "PSNR (dB) of test views." + about)


def _mean_of_scenes(runs: Runs, labels: Sequence[str]) -> Estimate | None:
    """Estimate PSNR over the seeds that all scenes have, of the mean over scenes; None if there is none."""
    scores = {(row["label"], row["seed"]): row["psnr"] for row in runs if row["psnr"] is not None}
    seeds = list(dict.fromkeys(seed for _, seed in scores))
    shared = [seed for seed in seeds if all((label, seed) in scores for label in labels)]
    found = Estimate.of(fmean(scores[label, seed] for label in labels) for seed in shared)
    return found and replace(found, asked=len(seeds))


def _against_fewer(runs: Runs, varied: str, order: Callable[[Runs], float]) -> list[dict]:
    """List groups that differ in one thing alone, each with how its PSNR changes from the group before."""
    own = ("setting" if varied == "density" else varied,)  # a setting has the density, and what was changed
    shared, lines = [name for name in (*TASK, "changed") if name not in own], []
    series = grouped((key_of(group[0], shared), group) for group in alike(runs))
    for groups in (sorted(found, key=order) for found in series.values() if len(found) > 1):
        for before, group in zip([None, *groups], groups):
            change = paired_change(group.paired(before), "psnr") if before else None
            lines.append(row_of(group, verdict=above(group, before) if before else "", change=change))
    return lines


def _larger(runs: Runs) -> list[dict]:
    """List runs on larger pictures, reduced to be scored, each before those that learned from small ones."""
    groups, lines = alike(runs), []
    for group in groups:
        pictures = group[0]["pictures"] or ""
        if (reduced := REDUCED.search(pictures)) is None:
            continue
        width, height, by = map(int, reduced.groups())
        size = f"{width // by}x{height // by}"
        small = key_of(group[0] | {"pictures": pictures.replace(reduced[0], size)}, TASK)
        same = [other for other in groups if key_of(other[0], TASK) == small]
        told = f"{above(group, same[-1])}, to the run that learned from {size}" if same else ""
        lines += [row_of(group, verdict=told), *(row_of(other, verdict="") for other in same)]
    return lines


def _beside(method: str, runs: Runs, other: str, rivals: Runs) -> Table:
    """Compare a method with another on the same scenes after equal minutes."""
    names, lines, changes = Runs([*runs, *rivals]).scores(), [], []
    for group in alike(plain(runs)):
        for rival in alike(plain(rivals)):
            rows = group[0], rival[0]
            # What a table of an earlier version lacks is no bar.
            lacking = [n for n in ("device", "measured", "pictures") if None in (rows[0][n], rows[1][n])]
            lacking += ["setting"]  # each has its own; the other method is as its preset
            if rival[0]["changed"]:
                continue
            if len({key_of(row, (name for name in TASK if name not in lacking)) for row in rows}) == 1:
                line = row_of(group)
                seeds, psnr = f"{len(group)} and {len(rival)}", (g.estimate("psnr") for g in (group, rival))
                verdicts = (above(group, rival, name) for name in names)
                lines.append([line["label"], line["took"], seeds, *psnr, *verdicts])
                changes += [paired_change(group.paired(rival), name) for name in names]
    titles = [metric_of(name).title for name in names]
    columns = [*BEGIN.values(), "seeds", f"`{method}`", f"`{other}`", *titles]
    return Table(columns, lines, by_chance(changes))


def above(group: Runs, other: Runs, name: str = "psnr") -> str:
    """Say by how much a metric differs from that of other runs, in pairs by seed, with a verdict where there
    are enough pairs.

    >>> one, two = (Runs({"seed": seed, "psnr": psnr + seed} for seed in range(3)) for psnr in (30.0, 29.5))
    >>> above(one, two), above(Runs(one[:1]), two), above(Runs(one[:1]), Runs(two[1:]))
    ('+0.50 ± 0.00 dB, above', '+0.50 dB', 'no seed in common')
    >>> lpips = [Runs({"seed": seed, "lpips": value} for seed in range(3)) for value in (0.2, 0.1)]
    >>> above(*lpips, "lpips")
    '+0.1000 ± 0.0000, worse'
    """
    if None in (group.mean(name), other.mean(name)):
        return ""
    change, metric = paired_change(group.paired(other), name), metric_of(name)
    return judged(change, metric.digits, metric.higher_is_better, metric.unit)


def judged(change: Estimate | None, digits: int, higher_is_better: bool, unit: str = "") -> str:
    """Write a change, with a verdict where it is of ``LEAST`` pairs or more."""
    if change is None:
        return "no seed in common"
    words = ("above", "below") if higher_is_better else ("worse", "better")
    told = f"{Column('', digits, signed=True).text(change)} {unit}".rstrip()
    return f"{told}, {verdict(change, *words)}" if change.count >= LEAST else told


def _write_lengths(tables: Mapping[str, Runs], out: Path, published: Sequence[Published]) -> list[Path]:
    """Write ``accuracy-time.md`` and a picture for each scene that two methods or more have in three lengths
    under the same ``CONDITIONS``; results of others are drawn beside scenes of their dataset.
    """
    runs = Runs(row | {"label": row["scene"]} for found in tables.values() for row in plain(found))
    runs = Runs(row | {"name": " ".join(filter(None, (row["method"], row["changed"])))} for row in runs)
    colors, compared = {name: f"C{number}" for number, name in enumerate(runs.by("name"))}, {}
    for of_task in runs.by("scene", "preset", *CONDITIONS).values():
        lengths = {name: alike(found) for name, found in of_task.by("name").items()}
        lengths = {method: groups for method, groups in lengths.items() if len(groups) >= LENGTHS}
        if len(lengths) > 1:  # the title says in what the scene's rows differ
            words = in_words(of_task[0], runs.where(scene=of_task[0]["scene"]), ("preset", *CONDITIONS))
            compared[", ".join([of_task[0]["scene"], *words])] = lengths
    scenes, pictures, used, shown = [], [], Runs(), {}
    for title, lengths in sorted(compared.items()):
        own = [*chain(*chain(*lengths.values()))]
        beside = [other for other in published if other.dataset == own[0]["dataset"]]
        picture = out / f"accuracy-time-{re.sub(r'[^a-zA-Z0-9]+', '-', title).strip('-')}.png"
        points = {
            method: [[(row[row["clock"]] or 60 * row["minutes"], row["psnr"]) for row in g] for g in groups]
            for method, groups in lengths.items()
        }
        figures.draw_lengths(picture, points, title, beside, colors)
        scenes.append({"title": title, "picture": picture.name, "table": _by_length(lengths)})
        pictures.append(picture)
        used += own
        shown |= dict.fromkeys(beside)
    if not scenes:
        return []
    about = {"machine": made_on(used), "command": used.command()}
    replace_file(out / "accuracy-time.md", rendered("lengths.md.j2", scenes=scenes, published=shown, **about))
    return [out / "accuracy-time.md", *pictures]


def _by_length(lengths: Mapping[str, Sequence[Runs]]) -> Table:
    """Pivot PSNR by method and length; and when the best method passes what each reaches in the end."""
    minutes = sorted({group[0]["minutes"] for groups in lengths.values() for group in groups})
    most = {method: max(group.mean("psnr") for group in groups) for method, groups in lengths.items()}
    best, lines = max(most, key=most.get), []
    for method, groups in lengths.items():
        cells = {}
        for group in groups:
            psnr, words = group.estimate("psnr"), group.taken()[1]
            cells[group[0]["minutes"]] = f"{Column('').text(psnr)}{words}" if words else psnr
        passed = [length(g[0]["minutes"]) for g in lengths[best] if g.mean("psnr") > most[method]]
        seeds = ", ".join(str(len(group)) for group in groups)
        lines.append([f"`{method}`", *map(cells.get, minutes), seeds, passed[0] if passed else None])
    return Table(["method", *map(length, minutes), "seeds", f"passed by `{best}` after"], lines)


def write_methods(folder: Path, out: Path) -> list[Path]:
    """Write ``methods.md``, ``methods.csv`` (a row a run), and two pictures of each scene.

    Rows of a table that is there already stay, as in ``write_minutes``. Views are drawn of the given runs
    alone; a picture that an earlier page shows stays if it has more methods, and the page says which of
    them have other rows by now. Ablations are left out.

    Raises:
        ValueError: if there is no run of a method, and no table with such runs.
    """
    found, left_out = _timed(folder)
    ablations = [row for row in found if row["ablation"] not in (None, "base")]
    left_out += [f"{row['folder'].relative_to(folder)}: an ablation" for row in ablations]
    page, table = out / "methods.md", out / "methods.csv"
    if not found and not table.is_file():
        raise _nothing(folder, found, left_out)
    runs = add_rows(table, (row for row in found if row not in ablations))
    earlier, scenes, written = read_text(page) if page.is_file() else "", [], [page, table]
    for scene, own in runs.by("scene").items():
        several = len(own.by("preset")) > 1
        named = ((row, " ".join([row["method"], *row["words"].values()])) for row in own)
        own = Runs(row | {"name": name + f" ({row['preset']})" * several} for row, name in named)
        pictures, drawn = _pictures(scene, own, out, earlier)
        tables = [_reached(group, own) for group in own.by("minutes", *CONDITIONS).values()]
        scenes.append({"name": scene, "pictures": pictures, "tables": tables})
        written += drawn
    about = {"machine": made_on(runs), "command": runs.command()}
    noted = grouped((row["note"], f"`{row['method']}`") for row in runs if row.get("note"))
    about["notes"] = [f"{', '.join(dict.fromkeys(names))}: {note}" for note, names in noted.items()]
    about |= {"presets": list(runs.by("preset")), "departures": _departures(runs), "left_out": left_out}
    with_steps = (out / "faithful-step.md").is_file()  # by python -m tests.bench.faithful
    replace_file(page, rendered("methods.md.j2", scenes=scenes, with_steps=with_steps, **about))
    return written


def _pictures(scene: str, runs: Runs, out: Path, earlier: str) -> tuple[list[dict], list[Path]]:
    """Draw a scene's pictures; return what the page says of them, and the files drawn.

    They are of the rows that may be compared with the most methods and, of equal ones, the most minutes; of a
    method of its first seed.
    """
    groups = runs.by("minutes", *CONDITIONS).values()
    chosen = max(groups, key=lambda group: (len(group.by("name")), group[0]["minutes"]))
    first = {row["name"]: row for row in sorted(chosen, key=lambda row: -row["seed"])}
    seen = {name: row for name, row in first.items() if "folder" in row and figures.sheets_of(row["folder"])}
    seen = dict(sorted(seen.items(), key=lambda item: -(item[1]["psnr"] or 0.0)))
    minutes = f"{chosen[0]['minutes']:g}"
    now = {(row["name"], f"{row['psnr'] or 0.0:.2f}", f"{row['minutes']:g}") for row in runs}
    curves, views = out / f"methods-{scene}.png", out / f"methods-{scene}-views.png"
    pictures, drawn = [], []
    draw_curves = partial(figures.draw_curves, title=f"{scene}, {minutes} minutes")
    for path, words, shown, draw in (
        (curves, "PSNR against seconds of training", first, draw_curves),
        (views, "Test views, the truth first,", seen, figures.draw_views),
    ):
        known = SHOWN.search(earlier.partition(f"]({path.name})")[0]) if path.is_file() else None
        listed = [method.rpartition(" ")[::2] for method in known["methods"].split(", ")] if known else []
        picture = {"file": path.name, "changed": []}
        changed = [name for name, psnr in listed if (name, psnr, known["minutes"]) not in now]
        kept = known and picture | {"words": known[0], "changed": changed}
        if len(listed) > len(shown):
            pictures.append(kept)
            continue
        try:
            if draw(path, shown):
                methods = ", ".join(f"{name} {row['psnr'] or 0.0:.2f}" for name, row in shown.items())
                pictures.append(picture | {"words": f"{words} after {minutes} minutes: {methods}"})
                drawn.append(path)
        except ImportError as error:
            pictures.append(kept or picture | {"missing": str(error)})
    return pictures, drawn


def _reached(runs: Runs, others: Runs) -> Table:
    """List all numbers of the runs of a scene that may be compared, the best PSNR first."""
    groups = sorted(runs.by("name").values(), key=lambda group: -(group.mean("psnr") or 0.0))
    columns = {"title": "method", "seeds": Column("seeds", 0)} | score_columns(others.scores())
    costs = COSTS | {"step": Column("s a step", None), "frame": Column("s a frame", None)}
    names = ("steps", "step", "frame", "parameters", "memory")
    columns |= {name: replace(costs[name], spread=False) for name in names}
    measured = sorted({row["measured"] for row in runs if row["measured"]})
    words = in_words(runs[0], others, [name for name in CONDITIONS if name != "measured"])
    about = ", ".join([runs[0]["scene"], f"{runs[0]['minutes']:g} minutes", *words, *measured])
    paper = {"forward": " (the paper's)"}
    titles = [f"`{group[0]['name']}`{paper.get(group[0]['method'], '')}" for group in groups]
    rows = (group.summary(title=title) for group, title in zip(groups, titles))
    marks = {}
    for name in others.scores():
        scores = {i: {row["seed"]: row.get(name) for row in group} for i, group in enumerate(groups)}
        scores = {i: own for i, own in scores.items() if None not in own.values()}
        best = rank(scores, metric_of(name).higher_is_better)[:1]
        marks |= {(i, list(columns).index(name)): "best" for tied in best for i in tied}
    return replace(Table.of(rows, columns, f"**{about}**"), marks=marks)


def _departures(runs: Runs) -> Table:
    """List what differs from the publications, and the faults kept from released code, with their methods."""
    told = []
    for field, mark in (("departures", ""), ("faults", "kept fault: ")):
        for row in runs:
            parts = filter(None, (row[field] or "").split("; "))
            told += [(mark + part, f"`{row['method']}`") for part in parts]
    lines = [[about, ", ".join(sorted(set(methods)))] for about, methods in grouped(told).items()]
    lines.sort(key=lambda line: (line[0].startswith("kept"), -line[1].count(","), line[0]))
    return Table(["departure", "methods"], lines)
