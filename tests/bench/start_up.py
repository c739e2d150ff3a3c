"""``python -m tests.bench.start_up OVERRIDES``: where the seconds from Enter to the first step go.

Without overrides it starts ``experiment=demo model=particles``, after writing the scene.
"""

from __future__ import annotations

import importlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

BARE = "import torch, lightning, hydra"
USUAL = ("experiment=demo", "model=particles")
MORE_S, FIRST_S = 6.0, 25.0  # the goals: beyond the bare imports; the first time, when kernels are compiled
WHOLE = "**until the first step is done**"
REPEATS = 3
# What calls of a function are counted as; a call within a call counts as its own.
COUNTED = (
    ("forewarp.cli.train", "main", "command line and configuration"),
    ("forewarp.cli.train", "train", "run: folder, lock, checks, loggers, Lightning"),
    ("forewarp.data.module", "SceneDataModule.setup", "reading the scene"),
    ("forewarp.training.stages", "Run._module", "methods: hull or sweep, first points, nodes"),
    ("forewarp.training.module", "DynamicSceneModule.on_train_start", "kernels"),
    ("forewarp.training.module", "DynamicSceneModule.training_step", "first step"),
)


class _Done(BaseException):
    """The first step is done: leave everything."""


class Ledger:
    """Seconds by what they went into, since a process was started at ``began``."""

    def __init__(self, began: float) -> None:
        self.began, self.ended = began, None
        self.spent = {"Python itself": time.time() - began}
        self._inner: list[float] = []

    def now(self) -> float:
        """Read the clock, which stands still once the first step is done."""
        return time.time() if self.ended is None else self.ended

    def counted(self, label: str, work: Callable) -> Callable:
        """Count calls of ``work`` under a label, without calls inside that are counted themselves."""

        def call(*given, **named):
            begin = self.now()
            self._inner.append(0.0)
            try:
                return work(*given, **named)
            finally:
                whole = self.now() - begin
                self.spent[label] = self.spent.get(label, 0.0) + whole - self._inner.pop()
                if self._inner:
                    self._inner[-1] += whole

        return call

    def stop(self, *_) -> None:
        """Note the end and leave."""
        self.ended = time.time()
        raise _Done


def traced(began: float, overrides: Sequence[str]) -> dict[str, float]:
    """Run forewarp-train in this process until its first step is done; return the seconds of its parts."""
    ledger = Ledger(began)
    own = ("forewarp.runs.build", "forewarp.methods.particles.model", *(module for module, *_ in COUNTED))
    for label, names in ((f"`{BARE}`", ("torch", "lightning", "hydra")), ("all other imports", own)):
        ledger.counted(label, lambda names=names: [*map(importlib.import_module, names)])()
    for module, path, label in COUNTED:
        owner, (*classes, name) = sys.modules[module], path.split(".")
        for part in classes:
            owner = getattr(owner, part)
        setattr(owner, name, ledger.counted(label, getattr(owner, name)))
    sys.modules["forewarp.training.module"].DynamicSceneModule.on_train_batch_end = ledger.stop
    sys.argv[1:] = overrides
    with suppress(_Done):
        sys.modules["forewarp.cli.train"].main()
    return ledger.spent | {WHOLE: ledger.now() - began}


def started(overrides: Sequence[str], cache: str | None = None) -> dict[str, float]:
    """The seconds of the parts in a process of its own; ``cache``: a folder for compiled kernels.

    Raises:
        ValueError: with what the command said, where it did not come to a step.
    """
    environment = os.environ | ({} if cache is None else {"NUMBA_CACHE_DIR": cache})
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "answer.json"
        own = [*overrides, "evaluate=false", f"run={folder}/run"]
        command = [
            sys.executable,
            "-m",
            "tests.bench.start_up",
            "--traced",
            str(answer),
            str(time.time()),
            *own,
        ]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if not answer.is_file():
            raise ValueError(f"start-up: expected a first step, but got {done.stdout}{done.stderr}")
        return json.loads(answer.read_text())


def bare_seconds() -> float:
    """Seconds that the bare imports take in a process of their own."""
    begin = time.time()
    subprocess.run([sys.executable, "-c", BARE], check=True)
    return time.time() - begin


def start_table(overrides: Sequence[str] = USUAL, repeats: int = REPEATS) -> str:
    """Measure by the clock, kernels compiled before and not: medians of whole runs; the first, once."""
    from tests.stability.report import table  # which would import torch before it is counted

    started(overrides)  # which writes the scene, and compiles
    bare = statistics.median(bare_seconds() for _ in range(repeats))
    warm = sorted((started(overrides) for _ in range(repeats)), key=lambda run: run[WHOLE])[repeats // 2]
    with tempfile.TemporaryDirectory() as cache:
        cold = started(overrides, cache)
    lines = [[name, *(f"{run.get(name, 0.0):.1f}" for run in (warm, cold))] for name in warm]
    rest = [run[WHOLE] - sum(s for name, s in run.items() if name != WHOLE) for run in (warm, cold)]
    lines.insert(-1, ["all else", *(f"{max(0.0, seconds):.1f}" for seconds in rest)])
    more = warm[WHOLE] - bare
    said = [
        f"`python -c '{BARE}'` took {bare:.1f} s: the first step is done {more:.1f} s later "
        f"(wanted: {MORE_S:g} s, {_verdict(more <= MORE_S)}).",
        f"The first time it is done after {cold[WHOLE]:.1f} s "
        f"(wanted: {FIRST_S:g} s, {_verdict(cold[WHOLE] <= FIRST_S)}).",
    ]
    return table(["s", "kernels in the cache", "compiled"], lines) + "\n\n" + " ".join(said)


def _verdict(good: bool) -> str:
    return "reached" if good else "**missed**"


def main(arguments: Sequence[str]) -> None:
    """Print the table; with ``--traced FILE BEGAN``, be the process that is measured."""
    if arguments[:1] == ["--traced"]:
        Path(arguments[1]).write_text(json.dumps(traced(float(arguments[2]), arguments[3:])))
    else:
        print(start_table(arguments or USUAL))


if __name__ == "__main__":
    main(sys.argv[1:])
