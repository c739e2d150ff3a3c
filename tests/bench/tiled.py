"""``python -m tests.bench.tiled``: a step of particles in plain PyTorch, by tiles, against the kernels."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import torch
from tabulate import tabulate

from forewarp.ops.gaussians import Gaussians, Pinhole, Warp, compare, compare_reference

SIZES = ((10_000, 200), (16_000, 400), (50_000, 800))  # particles, pixels a side
GRADIENTS = ("means", "log_scales", "opacity", "colors")


def crowd(count: int, size: int) -> tuple:
    """Make particles that fill a cube, their camera, and the truth: arguments of ``compare``."""
    torch.manual_seed(0)
    scale = torch.tensor(0.45 / count ** (1 / 3)).log()
    shape, color = torch.full((count, 3), float(scale)), 0.5 * torch.randn(count, 1, 3)
    solid, turn = torch.ones(count, 1), torch.randn(count, 4)
    particles = Gaussians(torch.rand(count, 3) - 0.5, shape, turn, solid, color)
    warp = Warp(torch.zeros(1, 12), torch.zeros(count, 1, dtype=torch.int32), torch.ones(count, 1))
    straight, focal = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), (1.3 * size, 1.3 * size)
    pinhole = Pinhole(straight, (0.0, 0.0, -2.0), focal, (size / 2, size / 2), (size, size), 0.1)
    seen = (particles, warp, pinhole, torch.zeros(0), torch.ones(1))
    return seen, torch.randint(0, 256, (size * size, 4)).to(torch.uint8), torch.ones(3)


def peak() -> float:
    """Return the process' peak memory in GB."""
    return int(re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())[1]) / 1e6


def measure(count: int, size: int) -> str:
    """Measure both in this process: seconds, more memory in GB, and the relative difference of gradients."""
    seen, pixels, behind = crowd(count, size)
    before, cells, results = peak(), [], []
    for step in (
        lambda: compare_reference(seen, pixels, behind, 0.05, 1.0, False, None),
        lambda: compare(*seen, pixels, behind),
    ):
        step()
        if not results:
            cells.append(f"{peak() - before:.2f}")
        begin = time.process_time()
        results.append(step().particles)
        cells.append(f"{time.process_time() - begin:.2f}")
    tiled, kernel = results
    errors = [(getattr(kernel, n) - getattr(tiled, n)).norm() / getattr(kernel, n).norm() for n in GRADIENTS]
    return " ".join([*cells, f"{float(max(errors)):.4f}"])


def main() -> None:
    """Measure each size in a process of its own, and print the table."""
    rows = []
    for count, size in SIZES:
        command = [sys.executable, "-m", __spec__.name, str(count), str(size)]
        memory, tiled, kernel, error = subprocess.check_output(command, text=True).split()
        rows.append([f"{count:,}", f"{size}x{size}", tiled, memory, kernel, error])
    head = ["particles", "image", "tiled, s", "its memory, GB", "kernels, s", "gradients differ by"]
    print(tabulate(rows, head, "github", disable_numparse=True))


if __name__ == "__main__":
    if len(sys.argv) == 3:
        torch.set_num_threads(1)
        print(measure(*map(int, sys.argv[1:])))
    else:
        main()
