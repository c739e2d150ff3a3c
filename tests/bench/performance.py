"""``python -m tests.bench.performance``: write docs/results/performance.md, as ``make bench`` does."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from forewarp.cli.entry import quiet
from forewarp.methods.voxel.forward import ForwardWarp
from forewarp.ops.march import warm_up
from forewarp.ops.splat import average_splat
from forewarp.runs.config_files import project_root
from forewarp.training.stages import peak_memory_bytes, reset_peak_memory
from tests.bench import particles, start_up
from tests.bench.workloads import (
    ALONE,
    CASES,
    OCCUPANCY,
    REPEATS,
    VERDICTS,
    Case,
    frame_work,
    milliseconds,
    slope,
    splat_work,
    step_by_hand,
    step_with,
    step_work,
    timed,
)
from tests.stability.report import implementation, replace_section, table


def cost_of(case: Case, size: float, dense: bool) -> tuple[float, int]:
    """Return median seconds, and bytes that the work needs at its peak."""
    work = case.make(size, dense)
    reset_peak_memory()
    before = peak_memory_bytes()
    work()
    peak = peak_memory_bytes() - before
    return timed(work, 3 if dense else REPEATS), peak


def growth_tables(cases: Mapping[str, Case] = CASES) -> str:
    """Make a table for each case: median time, memory, the dense version beside it, and the fitted power."""
    warm_up()
    parts = []
    for name, case in cases.items():
        own, lines = [cost_of(case, size, False) for size in case.sizes], []
        for size, (seconds, peak) in zip(case.sizes, own):
            beside = ["", "", ""]
            if size in case.dense_sizes:
                slow, much = cost_of(case, size, True)
                beside = [milliseconds(slow), f"{much / 2**20:.0f}", f"{slow / seconds:.1f}"]
            lines.append([f"{size:g}", milliseconds(seconds), f"{peak / 2**20:.0f}", *beside])
        fitted = slope([case.work(size) for size in case.sizes], [seconds for seconds, _ in own])
        against = {2: "it", 4: "its square", 8: "its cube"}[case.work(2)]
        head = [case.axis, "ms", "MiB", "dense, ms", "dense, MiB", "times cheaper"]
        title = f"**{name}**: seconds grow as {against} to the power {fitted:.2f}"
        parts.append(f"{title}\n\n{table(head, lines)}")
    return "\n\n".join(parts)


def splat_error(side: int = 80) -> float:
    """Measure the largest error of the splat against float64; the source has deviation 1."""
    generator = torch.Generator().manual_seed(0)
    voxels = (torch.rand(side, side, side, generator=generator) < OCCUPANCY).nonzero()
    source = torch.randn(len(voxels), 13, generator=generator)
    positions = voxels + torch.randn(len(voxels), 3, generator=generator)
    with implementation("reference"):
        exact = average_splat(source.double(), positions.double(), (side,) * 3).values
    return float((average_splat(source, positions, (side,) * 3).values - exact).abs().max())


def goals_table(side: int = 80, rays: int = 8192, picture: int = 400, frame_side: int = 128) -> str:
    """Measure the project's goals."""
    step, dense = timed(step_work(side, False, rays=rays)), timed(step_work(side, True, rays=rays), 2)
    printed = by_itself(side, rays)
    splat = timed(splat_work(side, False))
    first, again = (
        timed(frame_work(picture, False, first, frame_side, plain=True)) for first in (True, False)
    )
    full = timed(frame_work(picture, False, side=side), 3)
    against = f"{printed:.1f} s, {printed / step:.1f} times"
    frame, error = f"{picture}^2 picture of {frame_side}^3, first of its time", splat_error(side)
    rows = [
        [f"fine step, {side}^3 to {2 * side}^3, {rays} rays", "< 3.5 s", f"{step:.2f} s", step < 3.5],
        ["the same densely, PyTorch by itself", "12 times that", against, printed > 12 * step],
        ["densely with our large pages", "", f"{dense:.1f} s, {dense / step:.1f} times", None],
        [f"splat of {side}^3, a tenth occupied, and back", "< 0.15 s", f"{splat:.4f} s", splat < 0.15],
        ["its error against float64", "<= 1e-5", f"{error:.0e}", error <= 1e-5],
        [frame, "< 1.5 s", f"{first:.2f} s", first < 1.5],
        ["another view of that time", "< 0.5 s", f"{again:.2f} s", again < 0.5],
        [f"first picture with the U-Net, {side}^3 to {2 * side}^3", "< 1.5 s", f"{full:.2f} s", full < 1.5],
    ]
    return table(["what", "wanted", "measured", ""], [[*r[:3], VERDICTS[r[3]]] for r in rows])


def free_table(side: int = 48, rays: int = 2048) -> str:
    """Time a step with each effect, relative to a step written by hand without the platform."""
    photo, every = {"photo": 1.0}, dict.fromkeys(ForwardWarp.terms, 0.0)
    works = {
        "written without any of it": step_by_hand(side, rays),
        "everything off": step_with({}, side, rays, photo),
        "everything off, every loss term at weight 0": step_with({}, side, rays, every | photo),
        **{f"{name} on": step_with(choice, side, rays, photo) for name, choice in ALONE.items()},
    }
    seconds = {name: timed(work) for name, work in works.items()}
    first = next(iter(seconds.values()))
    return table(
        ["step", "ms", "times"], [[n, milliseconds(s), f"{s / first:.2f}"] for n, s in seconds.items()]
    )


def by_itself(side: int, rays: int) -> float:
    """Time the dense step in a process without the large memory pages that the commands ask for."""
    work = f"step_work({side}, True, rays={rays})"
    code = "from tests.bench.workloads import step_work, timed; "
    plain = {name: value for name, value in os.environ.items() if name != "THP_MEM_ALLOC_ENABLE"}
    call = [sys.executable, "-c", f"{code}print(timed({work}, 2))"]
    return float(subprocess.run(call, env=plain, check=True, capture_output=True, text=True).stdout)


SECTIONS = {
    "growth": growth_tables,
    "goals": goals_table,
    "free": free_table,
    "particles": particles.parts_table,
    "particles, growth": particles.growth_table,
    "particles, effects": particles.effects_table,
    "particles, goals": particles.goals_table,
    "start": start_up.start_table,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and write the tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.performance", description=__doc__)
    parser.add_argument("--document", type=Path, default=None, help="instead of docs/results/performance.md")
    parser.add_argument("--only", nargs="*", default=tuple(SECTIONS))
    given = parser.parse_args(arguments)
    quiet()
    document = given.document or project_root() / "docs" / "results" / "performance.md"
    for name in given.only:
        text = SECTIONS[name]()
        print(f"{name}\n{text}\n", flush=True)
        replace_section(document, name, text)
    print(document)


if __name__ == "__main__":
    before = dict(os.environ)
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads that wait for a busy core spoil the timing
    quiet()
    if os.environ != before:  # all this is read when torch is imported
        os.execv(sys.executable, [sys.executable, "-m", "tests.bench.performance", *sys.argv[1:]])
    main()
