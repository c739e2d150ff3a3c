"""Sections of the page of minutes: what holds when there is more of something, and what others reach."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence

from forewarp.metrics.gain import Estimate
from forewarp.report.run_rows import ABILITIES, CONDITIONS, another_length, estimate, key_of, length, telling
from forewarp.report.tables import Cell, Column, Table

NOISE = 0.2  # dB that chance may take: with more of something PSNR may be this much lower
SCORES = (Column("PSNR"), Column("SSIM", 4), Column("LPIPS", 4))
_MAY_BE_UNKNOWN = ("device", "measured", "pictures")  # of tables of earlier versions
_REDUCED = re.compile(r"(\d+)x(\d+) reduced (\d+)x\3")

Group = list[dict]  # rows that differ in the seed alone


def alike(rows: Iterable[dict]) -> list[Group]:
    """Group rows that differ in the seed alone; by scene, minutes and number of particles or voxels."""
    groups: dict[tuple, Group] = {}
    for row in rows:
        groups.setdefault(key_of(row, ("method", "preset", "scene", "minutes", *CONDITIONS)), []).append(row)
    return sorted(groups.values(), key=lambda group: (group[0]["label"], group[0]["minutes"], size_in(group)))


def minutes_of(group: Group) -> str:
    """The minutes of a group's runs; where they took others, how many.

    >>> minutes_of([{"clock": "wall", "wall": 301.0, "minutes": 20.0}])
    '20 (ended after 5 min)'
    """
    return length(group[0]["minutes"]).removesuffix(" min") + another_length(group)


def size_in(group: Group) -> float:
    """The mean number of particles or voxels, or, where it is unknown, the density or 0."""
    found = estimate(group, "size")
    return found.mean if found else group[0]["density"] or 0.0


def is_plain(row: dict) -> bool:
    """Whether a row belongs to the main tables: of the preset's own density, pictures scored as they are."""
    return row["density"] is None and not _REDUCED.search(row["pictures"] or "")


def labelled(rows: Sequence[dict]) -> list[dict]:
    """The rows with a ``label``: the scene and, where its plain rows differ in preset or ``CONDITIONS``, in
    what; likewise their dataset.
    """
    plain, found = [row for row in rows if is_plain(row)], []
    for row in rows:
        others = [one for one in plain if (one["scene"], one["method"]) == (row["scene"], row["method"])]
        words = telling(row, others, ("preset", *CONDITIONS)) if is_plain(row) else []
        named = {"label": row["scene"], "dataset": row["dataset"] or ""}
        found.append(row | {name: ", ".join([text, *words]) for name, text in named.items()})
    return found


def more_minutes(rows: Sequence[dict]) -> list[str]:
    """The section on whether more minutes make it worse; none where each scene has one number of minutes."""
    about = (
        f"Means over the seeds. More minutes hold if PSNR is at most {NOISE} dB below that of fewer. Where "
        "runs ended by their steps (in brackets), more minutes change nothing.\n"
    )
    lines = _steps(
        [row for row in rows if is_plain(row)],
        lambda group: key_of(group[0], ("scene", "preset", *_without("density"))),
        lambda group: group[0]["minutes"],
    )
    columns = [*_begins(), *SCORES, Column("against fewer minutes")]
    table = Table(columns, [[*_begin(g), *_scores(g), verdict] for g, verdict in lines])
    return ["## More minutes\n", about, table.markdown()] if lines else []


def more_density(rows: Sequence[dict]) -> list[str]:
    """The section of runs that differ in density; none without such runs."""
    about = (
        "Runs that differ in density alone (empty: the preset's own), fewest first; means over "
        f"the seeds. More hold if PSNR is at most {NOISE} dB below that of fewer.\n"
    )
    lines = _steps(
        [row for row in rows if row["size"] and not _REDUCED.search(row["pictures"] or "")],
        lambda group: key_of(group[0], ("scene", "preset", "minutes", *_without("density"))),
        size_in,
    )
    columns = [*_begins(), Column("density", 0), Column("particles", 0), *SCORES, Column("against fewer")]
    table = Table(
        columns,
        [[*_begin(g), g[0]["density"], size_in(g) or None, *_scores(g), verdict] for g, verdict in lines],
    )
    return ["## More particles\n", about, table.markdown()] if lines else []


def larger_pictures(rows: Sequence[dict]) -> list[str]:
    """The section of runs on larger pictures, reduced and compared with runs that learned from small ones."""
    groups, lines = alike(row for row in rows if row["density"] is None), []
    names = ("scene", "preset", "minutes", *_without("pictures"))
    for group in groups:
        if (small := _reduced_to(group[0]["pictures"])) is None:
            continue
        lines.append([*_begin(group), group[0]["pictures"], *_scores(group), ""])
        for other in groups:
            if other[0]["pictures"] == small and key_of(other[0], names) == key_of(group[0], names):
                verdict = above(group, other)
                lines[-1][-1] = f"{verdict} the run that learned from {small.split(',')[0]}"
                lines.append([*_begin(other), small, *_scores(other), ""])
    about = (
        "Learned from pictures of the first size; views and truth averaged over blocks of pixels "
        "(`reduce=`), then scored.\n"
    )
    columns = [*_begins(), Column("pictures"), *SCORES, Column("the larger is")]
    return ["## Larger pictures\n", about, Table(columns, lines).markdown()] if lines else []


def beside(method: str, rows: Sequence[dict], others: Sequence[dict]) -> list[str]:
    """A section for each other method that has rows of the same scenes and minutes."""
    found = []
    for other in sorted({row["method"] for row in others}):
        rivals = alike(row for row in others if row["method"] == other and is_plain(row))
        lines = []
        for group in alike(row for row in rows if is_plain(row)):
            for rival in (one for one in rivals if _comparable(group[0], one[0])):
                verdicts = [above(group, rival, name) for name in ("psnr", "ssim", "lpips")]
                seeds = f"{len(group)} and {len(rival)}"
                both = [estimate(one, "psnr") for one in (group, rival)]
                lines.append([group[0]["label"], minutes_of(group), seeds, *both, *verdicts])
        columns = [Column("scene"), Column("minutes", 0), Column("seeds"), Column(f"`{method}`")]
        columns += [Column(f"`{other}`"), Column("PSNR"), Column("SSIM"), Column("LPIPS")]
        about = (
            f"PSNR (dB) of `{method}` and `{other}` after equal minutes, and whether `{method}` is above or "
            "below; for LPIPS, where less is better, whether it is better or worse.\n"
        )
        if lines:
            found += [f"## Beside `{other}`\n", about, Table(columns, lines).markdown()]
    return found


def abilities(rows: Sequence[dict]) -> list[str]:
    """The section on new places, new times, the canonical time and moving points; none without numbers."""
    names = (*(f"psnr_{one}" for one in ABILITIES), "motion_error")
    known = [row for row in rows if is_plain(row) and any(row[name] is not None for name in names)]
    lines = []
    for group in alike(known):
        found = [estimate(group, name) for name in names]
        error = found[-1] and Estimate(*(v and 100 * v for v in (found[-1].mean, found[-1].deviation)))
        about = [group[0]["label"], minutes_of(group), f"`{group[0]['method']}`", len(group)]
        lines.append([*about, *found[:-1], error])
    columns = [Column("scene"), Column("minutes", 0), Column("method"), Column("seeds", 0)]
    columns += [*(Column(one) for one in ABILITIES), Column("moving points (%)", 1)]
    about = (
        "PSNR (dB) of test views of new places at training times (*space*), between training times (*time*) "
        "and at the canonical time. *Moving points*: their mean error as a share of their mean motion, where "
        "it is known.\n"
    )
    return ["## Space, time, motion\n", about, Table(columns, lines).markdown()] if lines else []


def made_when(rows: Sequence[dict]) -> str | None:
    """Say of which versions of the code the columns of a table are, where these are several."""
    found: dict[float, set[str]] = {}
    for row in rows:
        made = f"commit {row['commit']}" if row["commit"] else row["day"] or "a day unknown"
        found.setdefault(row["minutes"], set()).add(made)
    if len(set.union(set(), *found.values())) < 2:
        return None
    told = [f"{minutes:g} min of {', '.join(sorted(found[minutes]))}" for minutes in sorted(found)]
    return (
        "The runs may be of different versions of the code, which may then explain differences. By "
        f"commit where it was noted, else by day: {'; '.join(told)}.\n"
    )


def above(group: Group, other: Group, name: str = "psnr") -> str:
    """Say by how much a mean is above or below another.

    >>> above([{"psnr": 30.0}], [{"psnr": 29.5}]), above([{"lpips": 0.2}], [{"lpips": 0.1}], "lpips")
    ('above by 0.50 dB', 'worse by 0.1000')
    """
    own, its = estimate(group, name), estimate(other, name)
    if own is None or its is None:
        return ""
    difference = own.mean - its.mean
    words, digits, unit = (("worse", "better"), 4, "") if name == "lpips" else (("above", "below"), 4, "")
    digits, unit = (2, " dB") if name == "psnr" else (digits, unit)
    if not round(abs(difference), digits):
        return "equal"
    return f"{words[difference < 0]} by {abs(difference):.{digits}f}{unit}"


def held(before: float, now: float) -> str:
    """Say whether a PSNR (dB) holds against the one before.

    >>> held(30.0, 29.85), held(30.0, 29.5), held(30.0, 31.0)
    ('holds (-0.15 dB)', 'falls by 0.50 dB', 'holds (+1.00 dB)')
    """
    change = now - before
    return f"holds ({change:+.2f} dB)" if change >= -NOISE - 1e-9 else f"falls by {-change:.2f} dB"


def _steps(
    rows: Sequence[dict], same: Callable[[Group], tuple], order: Callable[[Group], float]
) -> list[tuple[Group, str]]:
    """The groups of which ``same`` has several, in their order, each with how it is to the one before."""
    series: dict[tuple, list[Group]] = {}
    for group in alike(rows):
        series.setdefault(same(group), []).append(group)
    found = []
    for groups in (sorted(one, key=order) for one in series.values() if len(one) > 1):
        means = [estimate(group, "psnr") for group in groups]
        for number, (group, mean) in enumerate(zip(groups, means)):
            before = means[number - 1] if number else None
            found.append((group, held(before.mean, mean.mean) if before and mean else ""))
    return found


def _comparable(row: dict, other: dict) -> bool:
    """Whether rows of two methods are of one task; what a table of an earlier version lacks is no bar."""
    names = ("scene", "preset", "minutes", *CONDITIONS)
    unknown = [name for name in _MAY_BE_UNKNOWN if None in (row[name], other[name])]
    kept = [name for name in names if name not in unknown]
    return key_of(row, kept) == key_of(other, kept)


def _reduced_to(pictures: str | None) -> str | None:
    """The words of pictures that are as small as reduced ones.

    >>> _reduced_to("800x800 reduced 2x2, background white")
    '400x400, background white'
    """
    found = _REDUCED.search(pictures or "")
    if found is None:
        return None
    width, height, by = map(int, found.groups())
    return pictures.replace(found[0], f"{width // by}x{height // by}")


def _without(name: str) -> list[str]:
    return [one for one in CONDITIONS if one != name]


def _begins() -> list[Column]:
    return [Column("scene"), Column("minutes", 0), Column("seeds", 0)]


def _begin(group: Group) -> list[Cell]:
    return [group[0]["label"], minutes_of(group), len(group)]


def _scores(group: Group) -> list[Cell]:
    return [estimate(group, name) for name in ("psnr", "ssim", "lpips")]
