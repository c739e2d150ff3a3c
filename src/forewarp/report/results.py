"""Read runs into one table, a row a run, from which every page is a selection and a pivot.

A row is a dictionary: what tells runs apart (``KEY``), scores by metric, ``NUMBERS`` and ``TEXTS``, None
where unknown. The row of a run's folder also holds what its files say (see ``read_run``); a CSV file keeps
rows of earlier runs without these.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
import shlex
import statistics
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from forewarp.files import (
    check_command,
    load_json,
    load_yaml,
    read_json,
    read_rows,
    refuse_links,
    replace_file,
)
from forewarp.metrics.registry import described_own, metric_of, take_described
from forewarp.outline import check_outline
from forewarp.report.settings import (
    CONDITIONS,
    SAME,
    configuration,
    digest_of,
    grouped,
    key_of,
    name_settings,
    repeated,
    words_of,
)
from forewarp.report.statistics import NETS, Estimate

Row = dict

KEY = ("method", "preset", "scene", "minutes", "seed", *CONDITIONS, "overrides", "digest")
EARLIER = ("density", "steps_per_picture")  # columns of earlier tables, which ``overrides`` tells
DESCRIBED = "described"  # column of what tables need to know of other packages' metrics, where there are any
SCORES = ("psnr", "ssim", "lpips")  # that a table has, whether measured or not
NUMBERS = ("steps", "step", "frame", "parameters", "memory", "ends", "motion_error")
NUMBERS += ("psnr_space", "psnr_time", "psnr_canonical", "size", "wall", "processor")
TEXTS = ("dataset", "day", "commit", "departures", "faults", "views", "curve", "command", "files", "note")
# Kinds of test view, and parts of their pixels, that scores are of.
KINDS = {"space": "at training times", "time": "between training times", "canonical": "at the canonical time"}
KINDS |= {"space_time": "of cameras and between times held out", "all": "all"}
KINDS |= {"moving": "what moves", "still": "what is still"}
KINDS |= {"crossed": "what rests, crossed", "crossed_own": "the same pixels, not crossed"}
COUNTERPART = "counterpart of "  # begins the dataset of synthetic scenes that stand in for its own
# What pages tell of a run's protocol.
PROTOCOL = ("half_resolution", "scale", "split", "frames", "views", "train_frames", "train_views")
PROTOCOL += ("test_views", "test_cameras", "test_moments", "test_frames", "window", "measured", "held_out")
PROTOCOL += ("canonical_time", "mask_box", "exposure", "images", "megabytes")
OWN = "run|sheets|paths.runs|paths.data"  # keys that say where a run's files are, not what it is
# What stands for the folders of whoever types a command again.
PLACES = {"paths.scenes": "DATASETS", "data.root": "SCENES", "lpips_weights": "WEIGHTS"}
UNREADABLE = OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError
ENDS = 0.1  # share of the time that counts as its first and last part
_LIMITS = "minutes", "iterations"  # of a budget
_EARLY, _LATE = 0.95, 1.5  # of its minutes: less was ended by steps, more had a last step that took long


class Point(NamedTuple):
    """A row of ``accuracy_time.csv``: PSNR (dB) of the held-out views after ``seconds`` of training.

    ``epe`` is the error of moving points in world units; None if the truth is unknown.
    """

    seconds: float
    psnr: float
    step: int
    epe: float | None = None


class Runs(list[Row]):
    """Rows, to select, group and average."""

    def where(self, **equal: object) -> Runs:
        """Select the rows that have these values; of a set or a tuple, one of its values."""
        wanted = {n: value if isinstance(value, set | tuple) else (value,) for n, value in equal.items()}
        return Runs(row for row in self if all(row[name] in values for name, values in wanted.items()))

    def by(self, *names: str) -> dict:
        """Group rows that are equal in ``names``, in the order of these: the value, or the values -> Runs."""
        groups: dict[tuple, Runs] = {}
        for row in self:
            groups.setdefault(key_of(row, names), Runs()).append(row)
        keys = sorted(groups, key=_order)
        return {key[0] if len(names) == 1 else key: groups[key] for key in keys}

    def by_time(self) -> list[tuple[float, float]]:
        """Average the PSNR of views over the rows: (time, PSNR) of each time, in order."""
        views = grouped(chain(*(pairs(row["views"]) for row in self)))
        return [(time, statistics.fmean(views[time])) for time in sorted(views)]

    def estimate(self, name: str) -> Estimate | None:
        """Estimate a number over the rows that have it; None if none has."""
        return Estimate.of(row.get(name) for row in self)

    def mean(self, name: str) -> float | None:
        """Average a number over the rows that have it; None if none has."""
        estimate = self.estimate(name)
        return estimate and estimate.mean

    def summary(self, **more: object) -> Row:
        """Make one row of runs that differ in the seed: estimates of numbers, else what the first has.

        Args:
            more: more cells.
        """
        estimates = {name: self.estimate(name) for name in (*self.scores(), *NUMBERS, "epe")}
        return self[0] | {"seeds": len({row["seed"] for row in self})} | estimates | more

    def paired(self, others: Runs) -> list[tuple[Row, Row]]:
        """Pair the rows with those of ``others`` of the same seed."""
        of_seed = {row["seed"]: row for row in others}
        return [(row, of_seed[row["seed"]]) for row in self if row["seed"] in of_seed]

    def scores(self) -> list[str]:
        """List the metrics of the rows in the order of tables: ``SCORES``, then those that were added."""
        return list(dict.fromkeys([*SCORES, *(name for row in self for name in row["scores"])]))

    def machines(self, more: str | None = None) -> str:
        """Say in one line what runs were computed on: device, threads, and torch or the words of ``more``.

        >>> row = {"device": "a cpu", "threads": 2.0, "torch": "2"}
        >>> Runs([row, row | {"threads": None, "torch": None}]).machines()
        'a cpu, 2 threads, torch 2; a cpu'
        """
        lines = {}
        for row in (row for row in self if row["device"]):
            threads = f"{row['threads']:g} thread{'s' * (row['threads'] != 1)}" if row["threads"] else ""
            last = more.format(**row) if more is not None else row["torch"] and f"torch {row['torch']}"
            lines[", ".join(filter(None, (row["device"], threads, last)))] = None
        return "; ".join(lines) or "unknown"

    def days(self) -> str:
        """Say when rows were measured: a day, or from the first to the last."""
        days = sorted({row["day"] for row in self if row["day"]})
        return " to ".join(dict.fromkeys([*days[:1], *days[-1:]]))

    def taken(self) -> tuple[bool, str]:
        """Tell whether runs of equal minutes ended before these by their steps; and say so, or that they took
        longer.

        >>> Runs([{"clock": "wall", "wall": 301.0, "minutes": 20.0}]).taken()
        (True, ' (ended after 5 min)')
        >>> Runs([{"clock": "wall", "wall": 36.2, "minutes": 1 / 6}]).taken()  # a last step that took long
        (False, ' (took 36 s)')
        """
        seconds, minutes = self.mean(self[0]["clock"]), self[0]["minutes"]
        if seconds is None or _EARLY * minutes <= seconds / 60 <= _LATE * minutes:
            return False, ""
        early = seconds / 60 < minutes
        return early, f" ({'ended after' if early else 'took'} {length(seconds / 60)})"

    def command(self) -> dict | None:
        """Return the words that the runs' commands share, without seeds, and the values of each other key.

        A sweep's clock and threads, which are not typed, are added. None if no command is known.

        >>> row = {"command": "forewarp-train seed=1 scene=s model=a run=r", "clock": "wall", "threads": 2}
        >>> Runs([row, row | {"command": "forewarp-train scene=s model=b"}]).command()
        {'shared': 'forewarp-train scene=s threads=2', 'varied': ['`model=a,b`']}
        """
        commands = []
        for row in self:
            if "#" not in (row["command"] or "#"):  # this sign begins a comment in place of a lost command
                typed = re.sub(r"\s(seed|budget\.clock|threads)=\S+", "", portable(row["command"]))
                typed += f" budget.clock={row['clock']}" if row["clock"] != "wall" else ""
                typed += f" threads={row['threads']:g}" if row["threads"] else ""
                commands.append(words_of(typed))
        words = dict.fromkeys(chain(*commands))
        shared = [word for word in words if all(word in command for command in commands)]
        varied = grouped(word.partition("=")[::2] for word in words if word not in shared)
        listed = [f"`{key}={','.join(values)}`" for key, values in varied.items()]
        return {"shared": " ".join(shared), "varied": listed} if commands else None


def read_runs(root: Path, needed: Sequence[str] = ("metrics.json",)) -> tuple[Runs, list[str]]:
    """Read all runs below a folder but those for debugging, which are too short to be compared, and a plan's
    short fits; with their commands as of ``portable``.

    Args:
        root: folder to search for ``config.yaml``.
        needed: files that a run must hold.

    Returns:
        the runs in the order of their folders, and a line for each run that cannot be used, and one for all
        for debugging.

    Raises:
        ValueError: if the folder is not there, or there is no run at all.
    """
    runs, left_out, debugging = Runs(), [], 0
    do = "make some with forewarp-train, or set runs=..."
    if not Path(root).is_dir():
        got = "a file" if Path(root).exists() else "which is not there"
        raise ValueError(f"runs: expected a folder with runs, but got {root}, {got}; {do}")
    for folder in sorted(path.parent for path in Path(root).rglob("config.yaml")):
        if folder.name == "still" and (folder.parent / "plan.yaml").is_file():
            continue
        absent = [name for name in needed if not (folder / name).is_file()]
        try:
            row = read_run(folder)
            row["command"] = portable(row["command"])
        except ValueError as error:
            left_out.append(f"{folder.relative_to(root)}: cannot be read ({error})")
            continue
        if row["config"].get("debug"):
            debugging += 1
        elif absent:
            again = "run its command again"
            if absent == ["accuracy_time.csv"]:  # no views were held out
                again = "run its command with data.held_out=8 into another folder"
            left_out.append(f"{folder.relative_to(root)}: no {', '.join(absent)}; {again}")
        else:
            runs.append(row)
    left_out += [f"left out: debug runs: {debugging}"] if debugging else []
    if not runs and not left_out:
        raise ValueError(f"{root}: expected folders of runs, but got none; {do}")
    name_settings(runs)
    return _without_repeated(runs, left_out, root)


def _without_repeated(
    runs: Runs, left_out: Sequence[str], root: Path | None = None
) -> tuple[Runs, list[str]]:
    """Leave out runs that were made again, and add a line for each."""
    older = {id(row) for row in repeated(runs)}
    folders = [row["folder"] for row in runs if id(row) in older]
    names = [folder if root is None else folder.relative_to(root) for folder in folders]
    lines = [f"{name}: another run of the same is newer" for name in names]
    return Runs(row for row in runs if id(row) not in older), [*left_out, *lines]


def read_folders(roots: Sequence[Path]) -> tuple[Runs, list[str]]:
    """Read all runs below several folders as ``read_runs`` does, and name them among all."""
    runs, left_out = Runs(), []
    for root in roots:
        of_root, others = read_runs(root)
        runs += of_root
        left_out += [f"{root}: {line}" if len(roots) > 1 else line for line in others]
    runs = Runs({row["folder"].resolve(): row for row in runs}.values())
    name_settings(runs)
    return _without_repeated(runs, left_out)


def nothing(root: Path, runs: Sequence[Row], left_out: Sequence[str], takes: str, make: str) -> ValueError:
    """Make the error that a report found no run it takes; ``make``: a command that makes some.

    >>> print(nothing(Path("runs"), [], ["a: no metrics.json"], "runs of minutes", "do"))
    runs: expected runs of minutes below it, but got none among 1 folder of a run (a: no metrics.json); do
    """
    count = len(runs) + len(left_out)
    why = f" ({left_out[0]})" if left_out else ""
    among = f"none among {count} folder{'s' * (count != 1)} of a run{why}"
    return ValueError(f"{root}: expected {takes} below it, but got {among}; {make}")


@contextmanager
def refused(before: str = "", after: str = "") -> Iterator[None]:
    """Say in one line, as a ValueError, what is wrong with a run's files; with words around it."""
    try:
        yield
    except UNREADABLE as error:
        why = f"no key {error}" if isinstance(error, KeyError) else str(error).split("\n")[0]
        raise ValueError(f"{before}{why}{after}") from error


def _check_kind(file: Path, values: Iterable[tuple[str, object]], kind: str = "number") -> None:
    """Refuse values that are neither null nor of a kind, ``number`` or ``text``, naming the key."""
    types = {"number": (int, float), "text": (str,)}[kind]
    for key, value in values:
        if value is not None and (isinstance(value, bool) or not isinstance(value, types)):
            raise ValueError(
                f"{file}: {key}: expected a {kind}, but got {value!r:.80}; measure the run again"
            )


@refused()
def read_run(folder: Path) -> Row:
    """Read a run's folder; files that are missing are empty.

    Beside the columns of tables the row has the content of the files (``config``, ``stages`` by name,
    ``metrics``, ``plan``, ``points`` of the curve), and

    * ``images``: ``name``, ``time``, ``ability``, ``psnr`` and ``scores`` of measured test views;
    * ``ablation``: name of the run's choice, None without one; ``about`` it; ``against``: the variant to
      compare with; ``configuration`` as of ``settings``, with its ``digest``, which names among several runs
      each one's ``overrides``, ``setting`` and ``variant``;
    * ``ability``: the kind of test view that scores are of: ``all``, else ``time`` (between training times),
      else the first; ``test``: the scores of every kind; ``tested``: number of views scored, None: all;
    * ``train`` (seconds), ``epe`` (world units), ``torch``, ``effects``, ``protocol``;
    * ``counterpart``: whether the scene is synthetic; ``origin``: its dataset without ``COUNTERPART``.
    """
    refuse_links(folder)
    config = load_yaml(folder / "config.yaml")
    check_command(config.get("command"), f"{folder / 'config.yaml'}: command")
    check_outline(config, f"{folder / 'config.yaml'}: ")
    stages = {file.parent.name: load_json(file) for file in sorted(folder.glob("*/done.json"))}
    metrics = load_json(folder / "metrics.json") if (folder / "metrics.json").is_file() else {}
    take_described(metrics.get("metrics"))
    files = [folder / name for name in ("metrics.json", "score.json") if (folder / name).is_file()]
    measured_at = files[0].stat().st_mtime_ns if files else 0
    plan = load_yaml(folder / "plan.yaml") if (folder / "plan.yaml").is_file() else {}
    points, images = read_points(folder), []
    for image in (read_json(folder / "per_image.json") or {}).get("images", []):
        scores = {name: float(value) for name, value in image["scores"].items() if value is not None}
        scores = {name: value for name, value in scores.items() if math.isfinite(value)}
        if "psnr" in scores and math.isfinite(time := float(image["time"])):
            of_image = {"name": str(image.get("name")), "time": time, "ability": str(image.get("ability"))}
            images.append(of_image | {"psnr": scores["psnr"], "scores": scores})
    images.sort(key=lambda image: image["name"])

    kept = "protocol", "test", "flow", "size", "trust"
    protocol, test, flow, sizes, trust = (metrics.get(key) or {} for key in kept)
    scores = [
        (f"test.{kind}.{name}", value) for kind, of_kind in test.items() for name, value in of_kind.items()
    ]
    _check_kind(folder / "metrics.json", [*scores, *((f"trust.{part}", at) for part, at in trust.items())])
    budget, variant, method = config["budget"], config.get("variant") or {}, config["model"]["name"]
    _check_kind(folder / "config.yaml", [(f"budget.{key}", budget.get(key)) for key in _LIMITS])
    # A name may be what was typed, as the command has it, in folders of earlier versions.
    named = str(variant.get("name") or "")
    ablation = named if set(variant) - {"name"} or re.fullmatch(r"[^=~]+", named) else None
    command = str(config.get("command") or f"forewarp-train # as {folder / 'config.yaml'}")
    preset, dataset = config["preset"]["name"], str(protocol.get("dataset", ""))
    synthetic = bool(protocol.get("synthetic")) or ".Synthetic" in str(config["data"].get("_target_", ""))
    stands_in = synthetic and not dataset.startswith("counterpart")
    frames, tested = protocol.get("test_frames"), str(protocol.get("measured", "")).split(" ")[0]
    row = {"folder": folder, "config": config, "stages": stages, "metrics": metrics, "images": images}
    row |= {"points": points, "plan": plan, "test": test, "trust": trust, "measured_at": measured_at}
    row |= {"method": method, "preset": preset, "command": command, "ablation": ablation}
    planned = (row["plan"] or {}).get("overrides") or ()
    row["configuration"] = configuration(config, read_json(folder / "data.json"), planned)
    row["digest"] = digest_of(row["configuration"])
    is_recipe = any(key.startswith("data.synthesis.") for key in row["configuration"])  # which counts
    row["files"] = None if is_recipe else row["configuration"].get("data.files")
    row |= {"about": variant.get("about", ""), "against": variant.get("against")}
    row |= {"scene": str(config["data"]["scene"]), "seed": int(config["seed"])}
    row |= {"minutes": budget["minutes"], "iterations": budget.get("iterations")}
    row |= {"clock": protocol.get("clock") or budget.get("clock") or "wall"}
    copied = ("threads", "device", "commit", "departures", "faults", "train_views")
    row |= {name: protocol.get(name) for name in copied}
    row |= {"torch": protocol.get("versions", {}).get("torch")}
    _check_kind(folder / "metrics.json", [(key, row[key]) for key in ("device", "torch", "commit")], "text")
    _check_kind(folder / "metrics.json", [("threads", row["threads"])])
    row |= {"held_out": protocol.get("held_out") or None}
    row |= {"measured": protocol.get("measured", f"all {frames} test views" if frames else None)}
    row |= {"tested": int(tested) if tested.isdigit() else None}  # as of "10 of 30 test views, evenly spread"
    row |= {"counterpart": synthetic, "dataset": COUNTERPART * stands_in + dataset}
    row["origin"] = dataset.removeprefix(COUNTERPART)
    row |= {"day": datetime.fromtimestamp(measured_at / 1e9, timezone.utc).date().isoformat()}
    row |= {"effects": ", ".join(name for name, on in (metrics.get("effects") or {}).items() if on)}
    row |= {"curve": " ".join(f"{point.seconds:.1f}:{point.psnr:.2f}" for point in points)}
    views = sorted((image["time"], image["psnr"]) for image in images)
    row |= {"views": " ".join(f"{time:.4f}:{psnr:.2f}" for time, psnr in views), "ends": ends_below(views)}
    keys = [key for key in PROTOCOL if protocol.get(key) or (key == "canonical_time" and key in protocol)]
    parts = [f"{key.replace('_', ' ')} {_text(protocol[key])}" for key in keys]
    row["pictures"] = pictures_in_words(protocol)
    formats = [(name, protocol.get(name)) for name in ("half_resolution", "scale", "background")]
    row["image_format"] = ", ".join(f"{name.replace('_', ' ')} {v}" for name, v in formats if v is not None)
    words = [dataset, row["pictures"] or "background unknown", *parts, protocol.get("note")]
    row["protocol"] = ", ".join(filter(None, words))

    row |= {f"psnr_{kind}": test.get(kind, {}).get("psnr") for kind in ("space", "time", "canonical")}
    row |= {clock: metrics.get("clocks", {}).get(clock) for clock in ("wall", "processor")}
    row |= {"epe": flow.get("epe_moving"), "steps": sum(done["steps"] for done in stages.values())}
    row["motion_error"] = flow["epe_moving"] / flow["motion_mean"] if flow.get("motion_mean") else None
    row["size"] = next(map(float, sizes.values()), None)
    row |= dict.fromkeys(("train", "step", "frame", "memory", "parameters"))
    if metrics:
        row["train"], row["frame"] = (metrics["seconds"].get(n) for n in ("train", "render_per_frame"))
        row["step"] = row["train"] / row["steps"] if row["steps"] else None
        row["memory"] = metrics["peak_memory_bytes"] / 2**30 if metrics.get("peak_memory_bytes") else None
        row["parameters"] = metrics["parameters"] / 1e6 if "parameters" in metrics else None
    # The metrics that tables of many runs show; of LPIPS that of one net.
    row["ability"] = [*(kind for kind in ("all", "time") if kind in test), *test, "all"][0]
    scores = test.get(row["ability"], {})
    shown = {n: score for n, score in scores.items() if metric_of(n).summary and not n.startswith("lpips_")}
    scores = dict.fromkeys(SCORES) | shown | {"lpips": score_of(scores, "lpips")}
    row |= scores | {"scores": scores}
    name_settings([row])
    return row


def score_of(scores: dict, name: str) -> float | None:
    """Return a score of a kind of test view; ``lpips`` is of the first net whose weights were there.

    >>> score_of({"psnr": 30.0, "lpips_alex": 0.25}, "lpips"), score_of({"psnr": 30.0}, "lpips")
    (0.25, None)
    """
    names = [f"lpips_{net}" for net in NETS] if name == "lpips" else [name]
    return next((scores[name] for name in names if scores.get(name) is not None), None)


def read_compared(folders: Sequence[str | Path]) -> dict[str, Runs]:
    """Read runs, those together that differ in the seed alone; name them by their methods if these differ,
    else by their settings, or by as much of their folders as needed.

    Raises:
        ValueError: if there is no folder, or one that holds no measured run.
    """
    if not folders:
        raise ValueError("runs: expected folders of runs, but got none; set runs=[FOLDER,FOLDER]")
    rows, paths = [], [Path(folder) for folder in folders]
    for path in paths:
        if not path.is_dir():
            raise ValueError(f"runs: expected folders of runs, but got {path}, which is not there")
        again, numbers = f"forewarp-evaluate {shlex.quote(f'run={path}')}", path / "metrics.json"
        if not numbers.is_file():
            raise ValueError(f"{numbers}: expected a run's numbers, but got none; make them with {again}")
        with refused(f"{path}: expected a measured run, but got ", f"; measure it with {again}"):
            rows.append(read_run(path))
    name_settings(rows)
    again = {id(row) for row in repeated(rows)}  # what is named twice stands beside itself
    apart = grouped(((key_of(row, (*SAME, "setting")), id(row) in again), row) for row in rows)
    groups = [Runs(sorted(of_group, key=lambda row: row["seed"])) for of_group in apart.values()]
    methods = [
        of_group[0]["metrics"].get("protocol", {}).get("method", of_group[0]["folder"].name)
        for of_group in groups
    ]
    places = [of_group[0]["folder"].as_posix() for of_group in groups]
    names = [of_group[0]["folder"].resolve().name for of_group in groups]
    settings = [of_group[0]["variant"] for of_group in groups]
    scenes = [f"{of_group[0]['scene']} {variant}" for of_group, variant in zip(groups, settings)]
    choices = [methods, settings, scenes] if len(groups) < len(rows) else [methods, names]
    choices += [places, [f"{number} {place}" for number, place in enumerate(places, 1)]]
    return dict(zip(next(names for names in choices if len(set(names)) == len(names)), groups))


def read_points(folder: Path) -> tuple[Point, ...]:
    """Read the rows of a run's ``accuracy_time.csv``; a missing file has none."""
    rows = read_rows(folder / "accuracy_time.csv")
    names = "seconds", "psnr", "step", "epe_moving"
    cells = ([row[name] for name in names] for row in rows)
    return tuple(Point(float(at), float(psnr), int(step), _number(epe)) for at, psnr, step, epe in cells)


def pictures_in_words(protocol: dict) -> str | None:
    """Say how large pictures are and over which background; None if the protocol does not tell.

    >>> pictures_in_words({"resolution": [[90, 60], [80, 60]], "reduced": 2, "background": "white"})
    '90x60 and 80x60 reduced 2x2, background white'
    """
    sizes = protocol.get("resolution", [])
    sizes = sizes if sizes and isinstance(sizes[0], list) else [sizes]
    size = " and ".join("x".join(map(str, sides)) for sides in sizes)
    if by := protocol.get("reduced"):
        size = f"{size} reduced {by}x{by}".strip()
    background = f"background {protocol['background']}" if "background" in protocol else ""
    return ", ".join(filter(None, (size, background))) or None


def _text(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {part}" for name, part in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def ends_below(views: Sequence[tuple[float, float]]) -> float | None:
    """By how many dB the mean of the views (time, PSNR) at both ends is below the median of the others.

    >>> ends_below([(0.0, 30.0), (0.05, 31.0), (0.5, 34.0), (0.6, 33.0), (1.0, 32.0)])
    2.5
    """
    ends = [psnr for time, psnr in views if not ENDS < time < 1 - ENDS]
    others = [psnr for time, psnr in views if ENDS < time < 1 - ENDS]
    return statistics.median(others) - statistics.fmean(ends) if ends and others else None


def add_rows(file: Path, rows: Iterable[Row]) -> Runs:
    """Add rows to those of a CSV file, which is written; return all.

    Of rows with the same ``KEY`` the one measured last stays; a run beats a row of its day, and one of an
    earlier version, which has no ``digest``. Each gets its ``setting`` among all of them.

    Raises:
        ValueError: if a column that holds numbers has something else.
    """
    every = [_read(row, f"{file}:{line}") for line, row in enumerate(read_rows(file), 2)]
    every += sorted(rows, key=lambda row: row["measured_at"])
    name_settings(every)
    last = {key_of(row, KEY): row for row in sorted(every, key=lambda row: row["day"] or "")}
    with_digest = {key[:-1] for key in last if key[-1] is not None}
    kept = [key for key in last if key[-1] is not None or key[:-1] not in with_digest]
    runs = Runs(last[key] for key in sorted(kept, key=_order))
    text, about = io.StringIO(), described_own(runs.scores())
    fields = (*KEY, *runs.scores(), *NUMBERS, *TEXTS, *([DESCRIBED] if about else []))
    writer = csv.DictWriter(text, fields, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(row | {DESCRIBED: about} for row in runs)  # None is empty
    replace_file(file, text.getvalue())
    return runs


def _read(row: dict[str, str], place: str) -> Row:
    """Turn a row of a CSV file, in the line ``place``, into one of ``read_run``; an older table lacks some
    columns.
    """
    take_described(json.loads(row.get(DESCRIBED) or "{}"))
    columns = (*KEY, *SCORES, *NUMBERS, *TEXTS, *EARLIER, DESCRIBED)
    scores = [*SCORES, *(name for name in row if name not in columns)]
    numbers = ("minutes", "threads", "iterations", "held_out", "train_views", *scores, *NUMBERS)
    typed = {name: row.get(name) or None for name in (*KEY, *TEXTS)}
    typed |= {"overrides": row.get("overrides")}  # without any is not unknown
    typed |= {name: number_in(row, name, place) for name in numbers}
    if " scene=counterpart_" in (typed["command"] or "") and not typed["dataset"].startswith("counterpart"):
        typed["dataset"] = COUNTERPART + typed["dataset"]
    typed |= {"ablation": None, "seed": int(number_in(row, "seed", place)), "clock": typed["clock"] or "wall"}
    return typed | {"scores": {name: typed[name] for name in scores}}


def number_in(row: dict[str, str], name: str, place: str) -> float | None:
    """Read a cell of a CSV file; None where it is empty or there is no such column.

    >>> number_in({"psnr": "30.5"}, "psnr", "a.csv:2"), number_in({}, "psnr", "a.csv:2")
    (30.5, None)
    """
    try:
        return _number(row.get(name))
    except ValueError:
        expected = f"expected a number in the column {name}, but got {row[name]!r:.80}"
        advice = "where an earlier version wrote the file, move it away and write the page of its runs"
        raise ValueError(f"{place}: {expected}; {advice}") from None


def _number(text: str | None) -> float | None:
    return float(text) if text else None


def _order(key: tuple) -> list[tuple]:
    """Sort keys by their parts, what is unknown first."""
    return [(part is not None, part) for part in key]


def in_words(row: Row, others: Iterable[Row], names: Iterable[str] = CONDITIONS) -> list[str]:
    """Say in a word each which of a row's ``names`` some of the other rows do not share.

    >>> rows = [{"clock": clock, "threads": 1.0} for clock in ("wall", "processor")]
    >>> in_words(rows[0], rows, ("clock", "threads"))
    ['wall clock']
    """
    differ = [name for name in names if len({key_of(other, (name,)) for other in (row, *others)}) > 1]
    return [CONDITIONS.get(name, "{}").format(row[name]) for name in differ if row[name] is not None]


def pairs(text: str | None) -> list[tuple[float, float]]:
    """Read what a row has in ``views`` and ``curve``.

    >>> pairs("0.5:30.25 1:31")
    [(0.5, 30.25), (1.0, 31.0)]
    """
    return [tuple(map(float, pair.split(":"))) for pair in (text or "").split()]


def length(minutes: float) -> str:
    """Spell a length of training.

    >>> length(1 / 30), length(1.0), length(2.5)
    ('2 s', '1 min', '2.5 min')
    """
    return f"{60 * minutes:.0f} s" if minutes < 1 else f"{round(minutes, 1):g} min"


def portable(command: str) -> str:
    """Write a command without the folders of whoever typed it.

    >>> portable("forewarp-train seed=1 paths.scenes=/data paths.runs=r model=forward")
    'forewarp-train seed=1 paths.scenes=DATASETS model=forward'
    """
    command = re.sub(rf"\s({OWN})=\S+", "", command)
    for key, word in PLACES.items():
        command = re.sub(rf"(\s{re.escape(key)}=)\S+", rf"\g<1>{word}", command)
    return command
