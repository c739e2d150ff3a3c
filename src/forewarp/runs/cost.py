"""Estimate the cost of jobs before they run, from jobs measured on this machine, else from the price list.

``prices.csv`` is the price list, written from the tables in ``docs/results`` by ``python -m
tests.bench.prices``. Each finished job of this machine adds a row of the same columns to ``own_file()``.
"""

from __future__ import annotations

import csv
import json
import math
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from datetime import date
from hashlib import sha256
from heapq import heapreplace
from itertools import chain
from pathlib import Path
from statistics import median
from time import perf_counter, process_time

from filelock import FileLock
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from forewarp.data.files import RECORD
from forewarp.files import own_folder, read_json, read_rows, written_whole
from forewarp.runs.config import hashed, plain

FILE_VARIABLE = "FOREWARP_TIMES"
PRICES = Path(__file__).with_name("prices.csv")
_KEPT = 1000  # rows of the user's file
# Keys of data that change no test view.
_OF_TRAINING = ("seed", "held_out", "train_views", "rays", "background")
_views: dict[str, tuple[int | None, int | None]] = {}  # of each scene that was read
_FEW = 50  # steps
_ALIKE = 3  # most similar jobs, whose median is the estimate


@dataclass(frozen=True)
class Row:
    """What a job took; None where that is unknown.

    Attributes:
        model, preset, scene: of the job.
        numbers: digest of all that the method was given, but for seed and budget.
        device, threads, day: what it ran on, with how many threads, when.
        steps, seconds, processor: optimiser steps; seconds of training, as if nothing else ran, and of all
            threads together.
        views, pixels: test views that were measured, and pixels of one.
        frame, scoring: seconds to render a view, and to score it.
        rest: seconds of all else: reading, compiling, curves, checkpoints, what is measured of a whole run.
        memory, disk: GiB at the peak; bytes of the run's folder.
    """

    model: str
    preset: str
    scene: str = ""
    numbers: str = ""
    device: str = ""
    threads: float | None = None
    day: str = ""
    steps: float | None = None
    seconds: float | None = None
    processor: float | None = None
    views: float | None = None
    pixels: float | None = None
    frame: float | None = None
    scoring: float | None = None
    rest: float | None = None
    memory: float | None = None
    disk: float | None = None


NAMES = [part.name for part in fields(Row)]
_TEXTS = ("model", "preset", "scene", "numbers", "device", "day")


@dataclass
class Job:
    """What is known of a job before it runs.

    Attributes:
        folder: its run's folder.
        like: its model, preset, scene, numbers, device, threads, views and pixels.
        minutes, iterations, clock: its budget.
        state: "" if it is to be run, else ``finished`` or ``skipped``, as its scene is missing.
        may_end: whether it may end before its budget.
        evaluate: whether test views are measured.
        plans: whether its effects are planned first.
        alike: whether it was not looked at, but is taken to be like another one, and not finished.
    """

    folder: Path
    like: Row
    minutes: float | None
    iterations: int | None
    clock: str
    state: str = ""
    may_end: bool = False
    evaluate: bool = True
    plans: bool = False
    alike: bool = False


@dataclass
class Cost:
    """What a job will take: seconds by both clocks and of training, GiB, bytes; None where unknown.

    Attributes:
        unknown: what is not in it.
        source: which rows it is from: ``this machine``, or the price list's machine and date; "" for none.
    """

    wall: float | None
    processor: float | None
    training: float | None
    memory: float | None
    disk: float | None
    source: str = ""
    unknown: list[str] = field(default_factory=list)


def own_file() -> Path:
    """Return the file of this machine's jobs: the one that ``FOREWARP_TIMES`` names, else the user's."""
    if named := os.environ.get(FILE_VARIABLE):
        return Path(named).expanduser()
    return own_folder() / "times.csv"


def read_costs(file: Path) -> list[Row]:
    """Read rows of jobs, but for broken ones; none of a file that is missing or something else."""
    rows, found = [], []
    with suppress(OSError, ValueError):
        rows = read_rows(file)
    for row in rows:
        with suppress(ValueError, KeyError, TypeError):
            numbers = {name: float(row[name]) if row[name] else None for name in NAMES if name not in _TEXTS}
            found.append(Row(**{name: row[name] for name in _TEXTS}, **numbers))
    return found


def add_cost(row: Row) -> None:
    """Add a row to this machine's; do nothing where its file cannot be written."""
    with suppress(OSError):
        file = own_file()
        file.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{file}.lock", timeout=10):  # of jobs that end at the same time
            write_costs(file, [*read_costs(file), row][-_KEPT:])


def write_costs(file: Path, rows: Iterable[Row]) -> None:
    """Write rows of jobs."""
    with written_whole(file) as beside, beside.open("w", newline="") as out:
        writer = csv.DictWriter(out, NAMES, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            cells = {name: getattr(row, name) for name in NAMES}
            writer.writerow({n: f"{v:.6g}" if isinstance(v, float) else v for n, v in cells.items()})


def job_of(config: DictConfig, rows: Sequence[Row] = (), *, read: bool = True) -> Job:
    """Read from a composed config what a job is; write nothing.

    Args:
        config: composed; its ``run`` is filled in.
        rows: of jobs of this machine, which know the test views of a scene that is not read.
        read: whether to count the test views of a scene that is there, which reads all of it.

    Raises:
        ValueError: for a budget or a target that there cannot be.
    """
    from forewarp.clock import Clock
    from forewarp.training.schedule import check_budget
    from forewarp.training.stopping import StopRule

    budget = config.budget
    check_budget(budget.minutes, budget.iterations)
    Clock(budget.clock)
    config = hashed(config)
    folder, like = Path(str(config.run)), likeness(config)
    state = "finished" if _is_finished(config, folder) else ""
    views, pixels = _views_of(config, state) if read else (None, None)
    if views is None and config.evaluate:
        views, pixels = _views_to_write(config.data)
    if views is None:
        known = [row for row in rows if row.scene == like.scene and row.views]
        views, pixels = (known[-1].views, known[-1].pixels) if known else (None, None)
    if views is not None and config.get("views") is not None:
        views = min(views, config.views)
    if config.get("absent") == "skip" and not state and not _is_there(config):
        state = "skipped"
    stages = [stage for stage in config.stage.values() if stage is not None]
    may_end = any(stage.get("steps_per_picture") is not None for stage in stages)
    may_end |= StopRule(**(plain(config.get("target")) or {})).is_set
    like = Row(**{**vars(like), "views": views, "pixels": pixels})
    plans = config.get("effects") == "auto"
    return Job(
        folder, like, budget.minutes, budget.iterations, budget.clock, state, may_end, config.evaluate, plans
    )


def likeness(config: DictConfig) -> Row:
    """Return what a job is compared by with others."""
    import torch

    from forewarp.evaluation.evaluate import device_name
    from forewarp.runs.devices import device_for

    parts = {key: plain(config.get(key)) for key in ("model", "objective", "stage", "preset")}
    digest = sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()[:10]
    scene = "" if OmegaConf.is_missing(config.data, "scene") else str(config.data.get("scene"))
    threads = config.threads or torch.get_num_threads()
    device = device_name(device_for(config))
    return Row(config.model.name, config.preset.name, scene, digest, device, threads)


def clocks() -> dict[str, float]:
    """Read both clocks, in seconds."""
    return {"wall": perf_counter(), "processor": process_time()}


def measured_cost(
    config: DictConfig, folder: Path, moments: Sequence[Mapping[str, float]], *, pixels: int | None
) -> Row:
    """Return the row of a job that was trained and measured in one go.

    Of both clocks the one that went less counts: other work on the machine stops the processor's, several
    threads speed it up.

    Args:
        config: the run's.
        folder: the run's folder.
        moments: ``clocks()`` when the job began, when it was fitted, and when it was measured.
        pixels: of a test view.
    """
    stages = [read_json(file) or {} for file in folder.glob("*/done.json")]
    trained = {kind: sum(float(done["clocks"][kind]) for done in stages) for kind in moments[0]}
    began, fitted, ended = moments
    measuring = min(ended[kind] - fitted[kind] for kind in began)
    rest = min(fitted[kind] - began[kind] - trained[kind] for kind in began)
    images = (read_json(folder / "per_image.json") or {}).get("images", [])
    views, scoring = len(images), _median(image.get("seconds_scored") for image in images)  # the first loads
    frame = ((read_json(folder / "metrics.json") or {}).get("seconds") or {}).get("render_per_frame")
    memory = max((float(done["peak_memory_bytes"]) for done in stages), default=0.0) / 2**30
    found = {"steps": float(sum(done["steps"] for done in stages)), "seconds": min(trained.values())}
    found |= {"processor": trained["processor"]}
    found |= {"memory": memory, "day": date.today().isoformat()}
    found |= {"disk": float(sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()))}
    if views and frame is not None:
        frame = min(frame, measuring / views)
        scoring = min(scoring or 0.0, measuring / views - frame)
        found |= {"views": float(views), "pixels": pixels and float(pixels), "frame": frame}
        found |= {"scoring": scoring}
        measuring -= views * (frame + scoring)
    found |= {"rest": max(0.0, rest) + max(0.0, measuring)}
    return Row(**{**vars(likeness(config)), **found})


def cost_of(job: Job, own: Sequence[Row], prices: Sequence[Row]) -> Cost:
    """Estimate what a job will take.

    Rows of this machine are taken where there are any of the job's model and preset, else those of the price
    list; of these the median of the three most alike: in their numbers, scene, threads, pixels and length.
    """
    device = job.like.device
    own = [row for row in own if row.device == device]
    prices = [row for row in prices if _is_gpu(row.device) == _is_gpu(device)]
    # The first of few steps compiles, so these do not tell how long a step takes.
    least = 0 if job.minutes is not None else min(_FEW, (job.iterations or _FEW) / 2)
    for rows, is_own in ((own, True), (prices, False)):
        alike = [row for row in rows if (row.model, row.preset) == (job.like.model, job.like.preset)]
        alike = [row for row in alike if (row.steps or 0) >= least]
        if alike:
            alike = sorted(reversed(alike), key=lambda row: _distance(job, row))[:_ALIKE]
            day = max(row.day for row in alike)
            source = "this machine" if is_own else f"the price list, {alike[0].device}, {day}"
            return _cost_by(job, alike, rows, source)
    return _cost_by(job, [], [], "")


def _cost_by(job: Job, alike: Sequence[Row], others: Sequence[Row], source: str) -> Cost:
    """Estimate a job from the rows most like it; what does not depend on the method, else from ``others``."""
    step = _median(row.seconds / row.steps for row in alike if row.seconds and row.steps)
    ratio = _median(row.processor / row.seconds for row in alike if row.processor and row.seconds)
    busy = ratio or (1 if _is_gpu(job.like.device) else job.like.threads or 1)  # at most
    lengths = []  # seconds of training by the wall clock
    if job.minutes is not None:
        lengths.append(60 * job.minutes / (busy if job.clock == "processor" else 1))
    if job.iterations is not None and step is not None:
        lengths.append(job.iterations * step)
    training, unknown = min(lengths, default=None), []
    rest = _first(alike, others, "rest")
    if rest is None:
        unknown.append("reading and compiling")
    measuring = 0.0
    if job.evaluate:
        frame, scoring = _frame(job, alike), _first(alike, others, "scoring")
        if job.like.views is None:
            unknown.append(f"the test views of {job.like.scene}")
        elif frame is None:
            unknown.append("the test views")
        else:
            measuring = job.like.views * (frame + (scoring or 0.0))
            unknown += [] if scoring is not None else ["scoring"]
    if job.plans:
        unknown.append("plans")
    wall = None if training is None else training + measuring + (rest or 0.0)
    processor = None if training is None else training * busy + measuring + (rest or 0.0)
    memory, disk = (_median(getattr(row, name) for row in alike) for name in ("memory", "disk"))
    unknown += [name for name, value in (("memory", memory), ("disk", disk)) if value is None]
    return Cost(wall, processor, training, memory, disk, source, unknown)


def _distance(job: Job, row: Row) -> tuple:
    like = job.like
    length = 60 * job.minutes if job.minutes else job.iterations
    of_row = row.seconds if job.minutes else row.steps

    def apart(ours: float | None, theirs: float | None) -> float:
        return round(abs(math.log(ours / theirs)), 1) if ours and theirs else math.inf

    differs = [getattr(like, name) != getattr(row, name) for name in ("numbers", "scene", "threads")]
    return (*differs, apart(like.pixels, row.pixels), apart(length, of_row))


def _is_gpu(device: str) -> bool:
    """Whether a device is a GPU, of which a processor's times say nothing."""
    return bool(re.search("nvidia|geforce|rtx|tesla|radeon", device, re.IGNORECASE))


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None


def _first(alike: Sequence[Row], others: Sequence[Row], name: str) -> float | None:
    known = _median(getattr(row, name) for row in alike)
    return known if known is not None else _median(getattr(row, name) for row in others)


def _frame(job: Job, rows: Sequence[Row]) -> float | None:
    """Return seconds to render a view; they grow with its pixels, where these are known."""

    def scaled(row: Row) -> float | None:
        known = row.frame is not None and job.like.pixels and row.pixels
        return row.frame * job.like.pixels / row.pixels if known else row.frame

    return _median(map(scaled, rows))


def _is_finished(config: DictConfig, folder: Path) -> bool:
    stages = [folder / name / "done.json" for name, stage in config.stage.items() if stage is not None]
    if not all(file.is_file() for file in stages):
        return False
    metrics = folder / "metrics.json"
    newest = max(file.stat().st_mtime_ns for file in stages)
    return not config.evaluate or (metrics.is_file() and metrics.stat().st_mtime_ns >= newest)


def _place(config: DictConfig) -> Path | None:
    data = config.data
    if data.get("root") is None or OmegaConf.is_missing(data, "scene"):
        return None
    return Path(str(data.root)).expanduser() / str(data.get("scene"))


def _is_there(config: DictConfig) -> bool:
    """Tell whether a job's scene is there, or will be written."""
    place = _place(config)
    return place is None or place.is_dir() or "synthesis" in config.data


def _views_of(config: DictConfig, state: str) -> tuple[int | None, int | None]:
    """Count a scene's test views and the pixels of one; None where it is not there or cannot be read."""
    place = _place(config)
    if state or not config.evaluate or (place is not None and not place.is_dir()):
        return None, None
    content = plain(config.data)
    if "synthesis" in content and not any((folder / RECORD).is_file() for folder in (place, place.parent)):
        return None, None  # reading would write it
    content |= {"canonical": None} if "canonical" in content else {}  # choosing one may decode every image
    key = json.dumps({**content, **dict.fromkeys(_OF_TRAINING)}, sort_keys=True, default=str)
    if key not in _views:
        _views[key] = None, None
        with suppress(Exception):  # the run itself says what is wrong with its scene
            frames = instantiate(OmegaConf.create({"data": content}).data, _convert_="all").scene.test
            sizes = [frame.camera.width * frame.camera.height for frame in frames]
            _views[key] = len(frames), max(sizes, default=None)
    return _views[key]


def _views_to_write(data: DictConfig) -> tuple[int | None, int | None]:
    """Count the test views of a procedural scene and the pixels of one, by its config; None where that does
    not say.
    """
    made = plain(data.get("synthesis")) or {}
    if not {"test_views", "size", "frames"} <= made.keys():
        return None, None
    space, time, canonical = made["test_views"]
    if "motions" in made:  # Lego Complete's: views at each training time, and steps between these
        space, time = space * made["frames"], time * (made["frames"] - 1) + 1 if time else 0
    size, half = made["size"], data.get("half_resolution", False)
    if half is True or (half == "auto" and size > 400):
        size //= 2
    return space + time + canonical, size**2


@dataclass
class Total:
    """What several jobs will take together.

    Attributes:
        jobs, finished, skipped: how many there are, and how many of them are not to be run; of a search it is
            not known which are finished.
        at_once: how many run at the same time.
        wall, processor, training: seconds of those whose time is known.
        memory: GiB of the largest job; None: unknown.
        disk: bytes; None: unknown.
        may_end: whether some may end before their budget.
        alike: how many are taken to be like others.
        untimed: how many jobs have no known time.
        sources, unknown: how many jobs are estimated from each source; how many lack each part.
    """

    jobs: int = 0
    finished: int = 0
    skipped: int = 0
    at_once: int = 1
    wall: float = 0.0
    processor: float = 0.0
    training: float = 0.0
    memory: float | None = None
    disk: float | None = None
    may_end: bool = False
    alike: int = 0
    untimed: int = 0
    sources: Counter = field(default_factory=Counter)
    unknown: Counter = field(default_factory=Counter)

    @property
    def to_do(self) -> int:
        """How many jobs are to be run."""
        return self.jobs - self.finished - self.skipped

    def lines(self) -> list[str]:
        """Return the estimate as a few lines of text."""
        states = {"finished before": self.finished, "without a scene": self.skipped}
        states = [f"{count} {state}" for state, count in states.items() if count]
        first = f"{self.jobs} job{'s' * (self.jobs != 1)}"
        first += f": {', '.join([*states, f'{self.to_do} to do'])}" if states else ""
        first += f"; {self.at_once} at a time" if self.to_do > 1 else ""
        if not self.to_do:
            return [first]
        lines = [first]
        if self.to_do > self.untimed:
            about = "at most about" if self.may_end else "about"
            times = (
                f"{spell(self.wall)} of wall clock on an idle machine, {spell(self.processor)} of processor"
            )
            lines.append(f"{about} {times}, {spell(self.training)} of it training")
        held = [] if self.memory is None else [f"{self.memory:.2g} GiB of memory a job"]
        held += [] if self.disk is None else [f"{self.disk / 1e6:.2g} MB of disk"]
        lines += [", ".join(held)] if held else []
        told = [f"{source} ({count})" for source, count in self.sources.items() if source]
        lines += [f"estimated from runs of {'; of '.join(told)}"] if told else []
        if self.untimed:
            absent = "neither this machine nor the price list has times of this model and preset"
            lines.append(f"unknown: the time of {self.untimed} of them; {absent}")
        if self.alike:
            looked = "assumed to be unfinished and to cost what similar jobs do; plan_only=true checks each"
            lines.append(f"{self.alike} of them are {looked}")
        missing = [f"{part} ({count})" for part, count in self.unknown.items()]
        lines += [f"not included: {', '.join(missing)}"] if missing else []
        return [lines[0], *(f"  {line}" for line in lines[1:])]


def total(costs: Iterable[tuple[Job, Cost]], at_once: int, *, local: bool = True) -> Total:
    """Add up jobs that are run in their order, ``at_once`` at a time; two that share a folder count once.

    Args:
        costs: each job and what it will take.
        at_once: jobs at the same time.
        local: whether they share the cores of this machine.
    """
    each, seen = [], set()
    for job, cost in costs:
        if job.state or job.folder in seen:
            is_skipped = job.state == "skipped"
            each.append(Total(1, finished=not is_skipped, skipped=is_skipped))
            continue
        seen.add(job.folder)
        times = {name: getattr(cost, name) or 0.0 for name in ("wall", "processor", "training")}
        held = {"memory": cost.memory, "disk": cost.disk, "unknown": Counter(cost.unknown)}
        told = {"may_end": job.may_end, "alike": job.alike, "untimed": cost.wall is None}
        each.append(Total(1, sources=Counter([cost.source]), **times, **held, **told))
    return joined([[one] for one in each], at_once, local=local)


def joined(lanes: Sequence[Sequence[Total]], at_once: int, *, local: bool = True) -> Total:
    """Add up lanes of sweeps, ``at_once`` lanes at a time, the sweeps of a lane one after another."""
    found, ends = Total(at_once=max(at_once, 1)), [0.0] * max(at_once, 1)
    for lane in lanes:
        heapreplace(ends, ends[0] + sum(sweep.wall for sweep in lane))  # whoever is free first takes it
    for sweep in chain(*lanes):
        for name in ("jobs", "finished", "skipped", "processor", "training", "may_end", "alike", "untimed"):
            setattr(found, name, getattr(found, name) + getattr(sweep, name))
        for name in ("sources", "unknown"):
            getattr(found, name).update(getattr(sweep, name))
        found.memory = max((m for m in (found.memory, sweep.memory) if m is not None), default=None)
        found.disk = (found.disk or 0.0) + sweep.disk if sweep.disk is not None else found.disk
    found.wall = max(max(ends), found.processor / (os.cpu_count() or 1) if local else 0.0)
    return found


def spell(seconds: float) -> str:
    """Write a duration with the unit that suits it.

    >>> spell(42), spell(432), spell(3 * 3600), spell(60 * 86400)
    ('42 s', '7.2 min', '3.0 h', '60 days')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 48 * 3600 else f"{seconds / 86400:.0f} days"
