"""Thousands of harmed files: each is read or refused in one line, soon and in little memory."""

from __future__ import annotations

import multiprocessing
import resource
import shutil
import signal
import tempfile
import time
import traceback
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

from forewarp.cli.entry import one_line
from tests.stability.fuzz_mutations import mutate
from tests.stability.fuzz_targets import Target, targets

INPUTS, SECONDS, MEMORY = 20_000, 10.0, 1 << 30  # how many, and the most that one may take


@dataclass
class Outcome:
    """What became of one loader's inputs; ``faults`` are the stories of those that it did not survive."""

    name: str
    inputs: int = 0
    read: int = 0
    refused: int = 0
    slowest: float = 0.0
    faults: list[str] = field(default_factory=list)


def fuzz(count: int = INPUTS, workers: int = 1) -> tuple[list[Outcome], int]:
    """Mutate and read ``count`` times, in so many processes of their own; what they found together, and how
    many bytes the one that grew the most grew by.
    """
    counts = [count // workers + (i < count % workers) for i in range(workers)]
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        parts, grown = zip(*pool.map(fuzz_here, counts, range(workers)))
    outcomes = parts[0]
    for part in parts[1:]:
        for ours, theirs in zip(outcomes, part):
            for name in ("inputs", "read", "refused", "faults"):
                setattr(ours, name, getattr(ours, name) + getattr(theirs, name))
            ours.slowest = max(ours.slowest, theirs.slowest)
    return outcomes, max(grown)


def fuzz_here(count: int, seed: int) -> tuple[list[Outcome], int]:
    """Mutate and read ``count`` times, every loader in turn; also how many bytes the process grew by.

    Raises:
        RuntimeError: where what is not mutated cannot be read.
    """
    draw, place = Random(seed), "/dev/shm" if Path("/dev/shm").is_dir() else None
    with tempfile.TemporaryDirectory(dir=place) as root:
        found = targets(Path(root))
        outcomes = {target.name: Outcome(target.name) for target in found}
        stored = {target.name: _content(target.folder) for target in found}
        for target in found:
            target.attempt()
        before = _most_memory()
        with _bounded():
            for i in range(count):
                target = found[i % len(found)]
                _one(target, stored[target.name], outcomes[target.name], draw)
    return list(outcomes.values()), _most_memory() - before


def _one(target: Target, stored: dict[Path, bytes], outcome: Outcome, draw: Random) -> None:
    """One input: some files are changed, read, and put back."""
    touched = draw.sample(list(stored), min(len(stored), draw.choice((1, 1, 2))))
    how = [mutate(path, draw, stored) for path in touched]
    begin, outcome.inputs = time.perf_counter(), outcome.inputs + 1
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        target.attempt()
        outcome.read += 1
    except target.refusals as error:
        outcome.refused += 1
        said = one_line(error) or ""
        if len(said.splitlines()) != 1 or ": expected " not in said:
            outcome.faults.append(f"{target.name}: {how}: says {error}")
    except Exception:
        outcome.faults.append(f"{target.name}: {how}: {traceback.format_exc()}")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        outcome.slowest = max(outcome.slowest, time.perf_counter() - begin)
        for path in touched:
            if path.is_dir():
                shutil.rmtree(path)
            path.write_bytes(stored[path])


def _content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def _most_memory() -> int:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@contextmanager
def _bounded() -> Iterator[None]:
    """Time and memory that one input may take; what exceeds them is an exception."""

    def too_long(*_) -> None:
        raise TimeoutError(f"longer than {SECONDS} s")

    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limits, handler = resource.getrlimit(resource.RLIMIT_AS), signal.signal(signal.SIGALRM, too_long)
    resource.setrlimit(resource.RLIMIT_AS, (now + MEMORY, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
        signal.signal(signal.SIGALRM, handler)
