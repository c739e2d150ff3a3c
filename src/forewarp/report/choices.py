"""Compare runs: accuracy against time, the price list, planned effects, and a few runs side by side.

Functions that write search a folder for measured runs, write to ``out``, and return the files written.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, count
from pathlib import Path
from statistics import mode

from forewarp.files import read_json, replace_file
from forewarp.metrics.registry import METRICS, metric_of
from forewarp.report.benchmark import judged, read_published
from forewarp.report.figures import draw_scene
from forewarp.report.results import KINDS, PLACES, Point, Row, Runs, in_words, nothing, read_runs
from forewarp.report.settings import CONDITIONS, family_of, words_of
from forewarp.report.statistics import (
    FACTORS,
    INTERVALS,
    LEAST,
    Estimate,
    by_chance,
    paired_change,
    rank,
    verdict,
)
from forewarp.report.stored import read_any, stored_csv
from forewarp.report.tables import Column, Table, rendered, score_columns

COSTS = {"epe": Column("EPE", 4), "step": Column("s/step", None), "frame": Column("s/frame", None)}
COSTS |= {"memory": Column("GiB"), "parameters": Column("parameters (M)", 3), "steps": Column("steps", 0)}
NAMED = 4  # variants at most that share a row by name
CHOICES = {"auto": "planned", "base": "the preset", "all_effects": "every effect", "no_effects": "none"}


def seconds_to(points: Sequence[Point], psnr: float) -> float | None:
    """Return the seconds until a PSNR (dB) is first reached that two evaluations in a row have; None if none.

    Between the evaluation before and the first of the two PSNR is taken to grow with the logarithm of time.
    Where the curve begins with these two, its first seconds are returned, as a bound: it got there before.

    >>> curve = [Point(s, p, 0) for s, p in [(1, 20), (2, 25), (4, 24), (16, 26), (32, 27)]]
    >>> seconds_to(curve, 25), seconds_to(curve, 18), seconds_to(curve, 27), seconds_to([], 25)
    (8.0, 1, None, None)
    """
    before = None
    for a, b in zip(points, points[1:]):
        if a.psnr >= psnr and b.psnr >= psnr:
            if before is None or not 0 < before.seconds < a.seconds:
                return a.seconds
            share = (psnr - before.psnr) / (a.psnr - before.psnr)
            return before.seconds * (a.seconds / before.seconds) ** share
        before = a
    return None


def by_variant(runs: Runs, *names: str) -> dict:
    """Group runs by variant, and by ``names`` too, as ``Runs.by`` does; the base first."""
    groups = runs.by("variant", *names)
    return dict(sorted(groups.items(), key=lambda item: item[1][0]["variant"] != "base"))


def _read(folder: Path, needed: Sequence[str] = ("metrics.json",)) -> tuple[Runs, list[str]]:
    """Read runs as ``read_runs`` does; those that differ in conditions are variants of their own, and a scene
    with some of its training views is another scene, unless their number is the choice that is compared.

    Raises:
        ValueError: if there is none.
    """
    runs, left_out = read_any(folder, needed)
    if not runs:
        takes = f"runs with a config.yaml and {' and '.join(needed)}"
        raise nothing(folder, runs, left_out, takes, "make some with forewarp-train --multirun")
    for row in runs:
        told = row["scene"].endswith(" training views)")  # in a table that a page wrote
        if row["train_views"] and "train_views" not in row["variant"] and not told:
            row["scene"] += f" ({row['train_views']} training views)"
    names = [name for name in CONDITIONS if name != "train_views"]
    for same in runs.by("scene", "variant", "minutes").values():
        for row, words in [(row, in_words(row, same, names)) for row in same]:
            row["variant"] = ", ".join([row["variant"], *words])
    return runs, left_out


def write_accuracy_time(
    folder: Path, out: Path, *, target: float | None = None, published: Path | None = None
) -> list[Path]:
    """Write ``accuracy-time.md``, and a picture and a CSV file a scene.

    Args:
        folder, out: see above.
        target: list each variant's seconds to this PSNR (dB); None: the ``target.psnr`` that all runs of a
            scene ended by, else the last whole dB that the base, or else the best run, reached.
        published: file of results of others, drawn as stars; None: ours.
    """
    others = read_published(published)
    runs, left_out = _read(folder, ["accuracy_time.csv", "metrics.json"])
    scenes, written = [], []
    for scene, found in runs.by("scene").items():
        groups = by_variant(found, "minutes")
        name = "accuracy-time-" + re.sub(r"[^\w.-]+", "-", scene).strip("-")
        picture, file = out / f"{name}.png", out / f"{name}.csv"
        beside = [other for other in others if other.dataset == found[0]["dataset"]]
        draw_scene(picture, groups, scene, beside)
        every = variants(groups, target_of(found) if target is None else target)
        replace_file(file, every.csv())
        scenes.append({"name": scene, "picture": picture.name, "tables": [cheapest(groups), every]})
        written += [picture, file]
    datasets = {row["dataset"] for row in runs}
    shown = [other for other in others if other.dataset in datasets]
    about = {"machine": runs.machines(), "published": shown, "left_out": left_out}
    replace_file(out / "accuracy-time.md", rendered("accuracy_time.md.j2", scenes=scenes, **about))
    return [out / "accuracy-time.md", *written]


def target_of(runs: Runs) -> float:
    """Return the ``target.psnr`` that all runs ended by, else the last whole dB that the base reached, or
    without one the best run.
    """
    asked = {(row["config"].get("target") or {}).get("psnr") for row in runs}
    if len(asked) == 1 and None not in asked:
        return float(asked.pop())
    curves = [row["points"] for row in runs.where(variant="base") or runs]
    twice = [min(a.psnr, b.psnr) for curve in curves for a, b in zip(curve, curve[1:] or curve)]
    return float(math.floor(max(twice)))


def reached(runs: Runs, psnr: float) -> Estimate | None:
    """Estimate the seconds to a PSNR over the runs that reach it; its ``count`` is how many do."""
    return Estimate.of(seconds_to(row["points"], psnr) for row in runs)


def begins_at(runs: Runs, psnr: float) -> bool:
    """Whether a run's curve begins at a PSNR already, so that the mean of ``reached`` is a bound."""
    curves = [row["points"] for row in runs if row["points"]]
    return any(seconds_to(curve, psnr) == curve[0].seconds for curve in curves)


def _seconds(column: Column, runs: Runs, psnr: float) -> Estimate | str | None:
    """Return the cell of ``reached``: where curves begin at the PSNR, a bound in words."""
    seconds = reached(runs, psnr)
    return f"<= {column.text(seconds.mean)}" if begins_at(runs, psnr) else seconds


def cheapest(groups: Mapping[tuple, Runs]) -> Table:
    """List for every whole dB the variants that reach it first, the fastest first, with its command.

    Variants share a row unless the seeds show that they differ (``statistics.rank``, of the logarithms of
    their seconds); where a curve begins at the PSNR, none is named.
    """
    lines, column = [], Column("seconds", 1)
    values = [point.psnr for group in groups.values() for row in group for point in row["points"]]
    for psnr in range(math.ceil(min(values)), math.floor(max(values)) + 1):
        times = {key: reached(group, psnr) for key, group in groups.items()}
        known = [key for key, seconds in times.items() if seconds and seconds.count == len(groups[key])]
        if not known:
            continue
        known.sort(key=lambda key: times[key].mean)
        fastest = groups[known[0]]
        if any(begins_at(groups[key], psnr) for key in known):
            most = f"<= {column.text(times[known[0]].mean)}"
            lines.append([str(psnr), most, "reached before the first evaluation", ""])
            continue
        logs = {
            key: {row["seed"]: math.log(seconds_to(row["points"], psnr)) for row in groups[key]}
            for key in known
        }
        first, *_ = rank(logs, higher_is_better=False) or [known]
        ranked = [key for key in known if len(logs[key]) >= LEAST]
        names = dict.fromkeys(groups[key][0]["variant"] for key in known if key in first or key not in ranked)
        shown, more = list(names)[:NAMED], len(names) - NAMED
        words = ", ".join(shown) + (f" and {more} more" if more > 0 else "")
        lines.append([str(psnr), times[known[0]], words, f"`{fastest[0]['command']}`"])
    columns = ["for dB", column, "variants", "command of the first"]
    about = "those whose seconds are not shown to differ share a row, the fastest first"
    return Table(columns, lines, f"The cheapest way to each PSNR; {about}:")


def variants(groups: Mapping[tuple, Runs], target: float) -> Table:
    """List for every variant the seconds to the target PSNR and the final numbers."""
    columns = {"variant": "variant", "minutes": Column("minutes", None), "seeds": Column("seeds", 0)}
    columns |= {"reached": Column(f"seconds to {target:g} dB", 1), "who": "reached"}
    columns |= {"psnr": "PSNR at the end"} | {name: COSTS[name] for name in ("epe", "steps")}
    caption, lines = _bound(Runs(chain(*groups.values()))), []
    if "target." in caption:
        columns["trained"] = Column("seconds trained", 1)
    for group in groups.values():
        ends = Runs(row["points"][-1]._asdict() for row in group if row["points"])
        at_the_end = {name: ends.estimate(name) for name in ("psnr", "epe")}
        times, cell = reached(group, target), _seconds(columns["reached"], group, target)
        who = f"{times.count if times else 0} of {len(group)}"
        lines.append(group.summary(reached=cell, who=who, trained=group.estimate("train"), **at_the_end))
    return Table.of(lines, columns, caption)


def _bound(runs: Runs) -> str:
    """Say what bounded runs, and what ended some of them before."""
    minutes = list(runs.by("minutes"))
    ended = {}
    for target in (row["metrics"].get("target") or {} for row in runs):
        if key := target.get("reached"):
            ended[f"{key}={target[key.removeprefix('target.')]:g}"] = None
    most = " or ".join("the steps of each" if m is None else f"{m:g}" for m in minutes)
    most += "" if minutes[-1] is None else f" minute{'s' * (minutes != [1])}"
    if ended:
        about = f"Budget of at most {most}; runs ended by {' or '.join(ended)}"
        return f"{about} after the seconds trained, so that PSNR at the end is not at equal minutes:"
    if len(minutes) == 1 and minutes[0] is not None:
        return "At equal minutes; the steps that were done in them:"
    return f"Budget of {most}; the steps that were done:"


def write_price_list(folder: Path, out: Path) -> list[Path]:
    """Write ``price-list-<model>.md`` and ``.csv`` (every run's own numbers), of ``forward`` ``price-list``.

    The model is that of most runs: what is changed one at a time, beside which whole methods may stand.
    """
    runs, left_out = _read(folder)
    scenes = []
    for (scene, minutes), found in runs.by("scene", "minutes").items():
        bound = f"{minutes:g} minutes" if minutes else "bounded by steps"
        scenes.append({"title": f"{scene}, {bound}", "tables": [references(found), changes(found)]})
    model = mode([row["method"] for row in runs] or ["forward"])
    page = out / ("price-list.md" if model == "forward" else f"price-list-{model}.md")
    about = {"machine": runs.machines(), "left_out": left_out}
    about["equal_minutes"] = all(runs.by("minutes"))  # None: steps alone bound them
    replace_file(page, rendered("price_list.md.j2", scenes=scenes, **about))
    replace_file(page.with_suffix(".csv"), stored_csv(runs))
    return [page, page.with_suffix(".csv")]


def measures_of(runs: Runs) -> dict[str, Column]:
    """Return the column of every metric and cost."""
    known = [name for name in runs.scores() if name != "lpips" or runs.mean(name) is not None]
    return score_columns(known, with_unit=True) | COSTS


def against(row: Row, runs: Runs) -> str:
    """Choose the variant to compare a run with: the one it names; else of its own method or the first's the
    one with the most of its words; else the first: the base, or where there is none what was measured first.
    """
    first = min(runs, key=lambda other: (other["variant"] != "base", other["measured_at"]))
    own, found = set(row["words"].items()), {}
    for other in runs:
        words, is_first = set(other["words"].items()), family_of(other) == family_of(first)
        if words < own if family_of(other) == family_of(row) else is_first and words <= own:
            found[other["variant"]] = len(words), is_first
    return row["against"] or max(found, key=found.get, default=first["variant"])


def references(runs: Runs) -> Table:
    """List the numbers of the runs that others are compared with."""
    names = {against(row, runs) for row in runs}
    lines = [group.summary() for variant, group in by_variant(runs).items() if variant in names]
    views = {"all": "all test views", "time": "test views between the training times"}
    columns = {"variant": "compared with", "seeds": Column("seeds", 0)} | measures_of(runs)
    kinds = sorted(views.get(kind, kind) for kind in runs.by("ability"))
    return Table.of(lines, columns, f"Of {', '.join(kinds)}:")


def changes(runs: Runs) -> Table:
    """List the changes of every other variant against its reference with the same seed."""
    measures, lines = measures_of(runs), []
    for variant, group in by_variant(runs).items():
        if variant != (other := against(group[0], runs)):
            pairs = group.paired(runs.where(variant=other))
            lines.append([variant, other, len(pairs), *(paired_change(pairs, name) for name in measures)])
    columns = ["variant", "against", Column("seeds", 0)]
    for name, column in measures.items():
        columns.append(Column(column.name, prefix="×") if name in FACTORS else replace(column, signed=True))
    differences = [cell for line in lines for cell, name in zip(line[3:], measures) if name not in FACTORS]
    return Table(columns, lines, f"Changes. {by_chance(differences)}")


def write_effects(folder: Path, out: Path) -> list[Path]:
    """Write ``effects.md`` and ``effects.csv`` (every run) of ``model=forward``, and ``effects-<model>`` of
    any other method.
    """
    runs, left_out = _read(folder)
    chosen, files = runs.where(ablation=tuple(CHOICES)), []
    if not chosen:
        takes = f"runs of ablation={' or '.join(CHOICES)} with a metrics.json"
        raise nothing(folder, runs, left_out, takes, "make some with make effects")
    runs = _labelled(chosen)
    for model, own in runs.by("method").items():
        page = out / ("effects.md" if model == "forward" else f"effects-{model}.md")
        planned = chain(*own.where(ablation="auto").by("scene", "seed").values())
        first = {row["scene"]: row["plan"].get("effects", {}) for row in reversed([*planned])}
        about = {"model": model, "machine": own.machines(), "left_out": left_out}
        decisions = [(scene, *decided) for scene in sorted(first) for decided in first[scene].items()]
        why = [[scene, name.replace("_", " "), d["choice"], d["because"]] for scene, name, d in decisions]
        reasons = Table(["scene", "effect", "choice", "because"], why)
        replace_file(page, rendered("effects.md.j2", **about, table=choices(own), reasons=reasons))
        rows = chain(*own.by("scene", "ablation", "seed").values())
        replace_file(page.with_suffix(".csv"), stored_csv(Runs(rows)))
        files += [page, page.with_suffix(".csv")]
    return files


def _labelled(runs: Runs) -> Runs:
    """Add to the scene of each row in what the rows of its method there differ beside choice, seed and
    minutes.
    """
    found = Runs()
    for row in runs:
        others = runs.where(method=row["method"], scene=row["scene"])
        words = [*row["words"].values(), *in_words(row, others, ("preset", *CONDITIONS))]
        found.append(row | {"scene": ", ".join([row["scene"], *words])})
    return found


def choices(runs: Runs) -> Table:
    """List for every scene the numbers of each choice, mean over seeds, and how the planned one is to the
    best of the others, in pairs by seed.
    """
    present = [name for name in CHOICES if runs.where(ablation=name)]
    columns = ["scene", Column("seeds", 0), Column("minutes", None), *(CHOICES[name] for name in present)]
    columns += [Column("planned - best", signed=True), "", Column("planning, s", 1)]
    lines, changes = [], []
    for (scene, minutes), found in runs.by("scene", "minutes").items():
        by_choice = {name: found.where(ablation=name) for name in present}
        planned = by_choice.get("auto", Runs())
        means = {name: own.mean("psnr") for name, own in by_choice.items() if own and name != "auto"}
        best = max(means, key=means.get) if means and planned else None
        change, words = None, ""
        if best is not None:
            change = paired_change(planned.paired(by_choice[best]), "psnr")
            words = f"{verdict(change, below='**below**')}, {CHOICES[best]}"
            changes.append(change)
        planning = Estimate.of(row["plan"]["seconds"] for row in planned if row["plan"])
        psnr, seeds = [own.estimate("psnr") for own in by_choice.values()], max(map(len, by_choice.values()))
        lines.append([scene, seeds, minutes, *psnr, change, words, planning])
    return Table(columns, lines, by_chance(changes))


def write_search(folder: Path, out: Path) -> list[Path]:
    """Write ``search.md``, and a CSV file a scene: the trials of ``sweeps=search``, the best first."""
    runs, left_out = read_runs(folder, ["score.json"])
    scored = Runs(chain(*map(_scored, runs)))
    if not scored:
        takes, make = "runs with a score.json of the metric that their config.yaml names", "make some with"
        raise nothing(folder, runs, left_out, takes, f"{make} forewarp-train --multirun sweeps=search")
    searches, written = [], []
    for (scene, method, metric), found in scored.by(*SEARCHED).items():
        known = metric_of(metric)
        best_first = sorted(found, key=lambda row: row["score"], reverse=known.higher_is_better)
        table = _trials(best_first, Column(known.heading, known.digits))
        title, name = f"{scene}, {method}, by {metric} of {best_first[0]['scored']}", f"search-{scene}"
        name += f"-{method}" * (len(runs.where(scene=scene).by("method")) > 1)
        file = out / f"{name}.csv"
        replace_file(file, table.csv())
        searches.append({"title": title, "table": table, **_again(best_first[0])})
        written.append(file)
    replace_file(out / "search.md", rendered("search.md.j2", searches=searches, left_out=left_out))
    return [out / "search.md", *written]


SEARCHED = ("scene", "method", "metric")  # runs that are equal in these are trials of one search


def _scored(row: Row) -> list[Row]:
    """Return a run with the score that its search went by; nothing where the run has none."""
    stored, metric = read_json(row["folder"] / "score.json") or {}, row["config"].get("score")
    score = (stored.get("scores") or {}).get(metric)
    seconds = sum(float(done["seconds"]) for done in row["stages"].values())
    about = {"metric": metric, "score": score, "scored": stored.get("views"), "seconds": seconds}
    return [row | about] if isinstance(score, int | float) else []


def _trials(trials: Sequence[Row], score: Column) -> Table:
    """List trials by the overrides in which they differ."""
    typed = [dict(word.partition("=")[::2] for word in words_of(row["command"])) for row in trials]
    keys = dict.fromkeys(key for words in typed for key in words if key != "forewarp-train")
    chosen = [key for key in keys if len({words.get(key) for words in typed}) > 1]
    cells = [[_value(words.get(key)) for key in chosen] for words in typed]
    ends = [[row["score"], row["steps"], row["seconds"]] for row in trials]
    rows = [[rank, *begin, *end] for rank, (begin, end) in enumerate(zip(cells, ends), 1)]
    columns = [Column("rank", 0), *(Column(key, None) for key in chosen)]
    return Table([*columns, score, Column("steps", 0), Column("seconds", 1)], rows)


def _again(row: Row) -> dict:
    """Return the command that trains a trial's choices in a folder of their own, and the words in it that
    stand for folders.
    """
    command = row["command"]
    typed = {word.partition("=")[0] for word in words_of(command)}
    if "#" not in command and "experiment" not in typed:  # a sweep's file may have chosen these
        chosen = {"model": row["method"], "preset": row["preset"]}
        command += "".join(f" {key}={name}" for key, name in chosen.items() if key not in typed)
    run = f"runs/best/{row['scene']}/{row['method']}-{row['preset']}-seed{row['seed']}"
    free = next(name for number in count(1) if not Path(name := run + f"-{number}" * (number > 1)).exists())
    command += " " + shlex.quote(f"run={free}")
    return {"command": command, "places": [word for word in PLACES.values() if f"={word}" in command]}


def _value(text: str | None) -> float | str | None:
    try:
        return float(text)
    except (TypeError, ValueError):
        return text


MEASURED = {"steps": ("steps", 0), "train": ("seconds of training", 0), "frame": ("seconds per image", 3)}
# Shown where the runs differ in them, as their numbers then tell little of the methods.
SHOWN_CONDITIONS = {"dataset": "dataset", "scene": "scene", "train_views": "training views"}
SHOWN_CONDITIONS |= {"clock": "clock of the minutes", "threads": "threads", "device": "computed on"}
SHOWN_CONDITIONS |= {"pictures": "pictures", "measured": "test views", "held_out": "views held out"}


def compare(groups: Mapping[str, Runs]) -> Table:
    """Make a table with a row for each measure that all runs have, and a column for each group of seeds.

    Metrics are those of the test views; for two groups a column with their difference is added, in pairs by
    seed where both have the same seeds, with verdicts as on all pages. It is empty where they are of
    different scenes or views. Conditions in which the groups differ come last. The caption says why there
    are no differences, or no metrics.

    Args:
        groups: as of ``results.read_compared``.
    """
    lines, two, rows = [], len(groups) == 2, [own[0] for own in groups.values()]
    changes: list[Estimate | None] = []
    same_scene = len({(row["dataset"], row["scene"]) for row in rows}) == 1
    same_views = same_scene and len({row["measured"] for row in rows}) == 1
    seeds = [sorted(row["seed"] for row in own) for own in groups.values()]
    is_paired = two and bool({*seeds[0]} & {*seeds[1]})
    alone = two and max(map(len, seeds)) == 1  # of other seeds, too, there is a difference

    def add(
        name: str,
        value: Callable[[Row], float | None],
        digits: int,
        with_difference: bool = False,
        kind: str = "",
        measure: str = "",
        higher_is_better: bool = False,
    ) -> None:
        values = [[value(row) for row in own] for own in groups.values()]
        if any(None in own for own in values):
            return
        column, told = Column("", digits), None
        if with_difference and two:
            scored = [
                Runs(
                    {"seed": r["seed"], measure: value(r), "images": r["images"], "ability": kind}
                    for r in own
                )
                for own in groups.values()
            ]
            pairs = [(scored[0][0], scored[1][0])] if alone else scored[0].paired(scored[1])
            changes.append(paired_change(pairs, measure))
            told = judged(changes[-1], digits, higher_is_better)
        lines.append([name, *(column.text(Estimate.of(own)) for own in values), *[told] * two])

    every = [row for own in groups.values() for row in own]
    added = (name for row in every for scores in row["test"].values() for name in scores)
    for metric in map(metric_of, dict.fromkeys([*METRICS, *added])):
        for kind, words in KINDS.items() if metric.summary else ():
            name = words if metric.name == "psnr" else f"{metric.heading}, {words}"
            score = partial(_score, kind, metric.name)
            add(name, score, metric.digits, same_views, kind, metric.name, metric.higher_is_better)
    add("moving points' error, % of motion", _motion_share, 0, same_scene, measure="motion_error")
    for name, (words, digits) in MEASURED.items():
        add(words, partial(_measured, name), digits)
    for name, words in SHOWN_CONDITIONS.items():
        absent = "all" if name == "train_views" else "none named"
        values = [absent if row[name] is None else str(row[name]) for row in rows]
        lines += [[words, *values, *[None] * two]] if len(set(values)) > 1 else []
    told = [f"no differences: the runs are of different {'test views' if same_scene else 'scenes'}"]
    told = told if two and not same_views else []
    if max(map(len, seeds)) > 1:
        listed = "; ".join(f"{name}: seeds {', '.join(map(str, own))}" for name, own in zip(groups, seeds))
        told.append(f"{INTERVALS}; {listed}")
        if is_paired and same_views:
            told.append("differences are paired by seed")
        if is_paired and changes:
            told.append(by_chance(changes))
    if alone and same_views and not is_paired:
        told.append("differences are of one run each, of other seeds")
    if not set.intersection(*(set(row["test"]) for row in every)):
        kinds = (f"{name}: {', '.join(own[0]['test']) or 'none'}" for name, own in groups.items())
        told.append(f"no metrics: no kind of test view was measured in all runs ({'; '.join(kinds)})")
    return Table(["PSNR (dB) of test views", *groups, *[" - ".join(groups)] * two], lines, "\n".join(told))


def _score(kind: str, metric: str, row: Row) -> float | None:
    return row["test"].get(kind, {}).get(metric)


def _motion_share(row: Row) -> float | None:
    return None if row["motion_error"] is None else 100 * row["motion_error"]


def _measured(name: str, row: Row) -> float | None:
    return row[name] or None
