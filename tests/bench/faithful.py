"""``python -m tests.bench.faithful``: what one step of each method costs with its published numbers.

Writes the table of docs/results/faithful-step.md and the CSV beside it. ``--scene FOLDER`` takes a D-NeRF
scene in place of the procedural vehicle. Each method has a process of its own, one after the other; one that
does not fit into ``--gib`` is measured with half the rays, a quarter, and so on; ``--only`` measures some.
``--device cuda`` measures on a GPU, in one process, for a table and a CSV file of their own.
"""

from __future__ import annotations

import argparse
import csv
import gc
import io
import json
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import torch
from omegaconf import DictConfig
from torch.utils.flop_counter import FlopCounterMode

from forewarp.cli.entry import quiet
from forewarp.clock import now
from forewarp.evaluation.evaluate import device_name
from forewarp.files import read_rows, replace_file
from forewarp.methods.method import parameter_count
from forewarp.runs.build import build_run
from forewarp.runs.config_files import project_root
from forewarp.synth.scenes import synthesize
from forewarp.training.module import DynamicSceneModule
from forewarp.training.objective import set_gradients, total
from forewarp.training.stages import Run, peak_memory_bytes, reset_peak_memory
from tests.stability.report import replace_section, table
from tests.support.configs import composed

PAGE = Path("docs/results/faithful-step.md")
# Without particles, which nobody has published.
METHODS = ("forward", "backward", "nerf", "tnerf", "dnerf", "nerfies", "hypernerf", "neural_volumes")
METHODS += ("ndvg", "tineuvox_s", "tineuvox_b")
FIELDS = ("method", "of", "rays", "flop", "seconds", "bytes", "parameters", "steps", "failed")
CONDITIONS = ("scene", "day")
LEAST = 64  # rays
TIMED = {"cpu": 1, "cuda": 3}  # steps


def configured(method: str, scene: Path, rays: int | None = None, device: str = "cpu") -> DictConfig:
    """Compose the config of a method with its published numbers, or with so many rays a step."""
    data = [f"data.root={scene.parent}", f"data.scene={scene.name}"]
    trainer = "cpu" if device == "cpu" else "gpu"
    words = ["experiment=dnerf", f"model={method}", "preset=faithful", f"trainer={trainer}", "threads=1"]
    return composed(*words, "logger=none", *data, *([] if rays is None else [f"preset.rays={rays}"]))


def measured(method: str, scene: Path, rays: int | None = None, device: str = "cpu") -> dict:
    """Take steps of the last stage, at the end of its schedule: count the first, time those that follow.

    Args:
        method: a ``model=``.
        scene: folder of a D-NeRF scene.
        rays: a step; None: as published.
        device: cpu or cuda.

    Returns:
        ``FIELDS``: rays published and taken, FLOP, seconds of a step (processor time, or the wall clock's
        until a GPU has finished), peak bytes beyond what the process held before (or of the GPU),
        parameters, and the steps of all stages.
    """
    torch.set_num_threads(1)
    run = build_run(configured(method, scene, rays, device))
    run.datamodule.setup("fit")
    torch.manual_seed(0)
    reset_peak_memory()
    before = peak_memory_bytes() if device == "cpu" else 0
    module = run._module(run.stages[-1]).to(device)
    module.method.warm_up()
    optimizer = module.configure_optimizers()
    counter = FlopCounterMode(display=False)
    # All is counted as one: what tells modules apart fails where a loss term differentiates inside a step.
    counter.mod_tracker = SimpleNamespace(parents={"Global"}, __enter__=int, __exit__=int)
    with counter:
        taken = stepped(run, module, optimizer)
    clock = "processor" if device == "cpu" else "wall"
    begun = now(clock)
    for _ in range(TIMED[device]):
        stepped(run, module, optimizer)
    seconds = (now(clock) - begun) / TIMED[device]
    return {
        "method": method,
        "of": configured(method, scene).preset.rays,
        "rays": taken,
        "flop": counter.get_total_flops(),
        "seconds": seconds,
        "bytes": peak_memory_bytes() - before,
        "parameters": parameter_count(module.method),
        "steps": sum(stage.settings.iterations for stage in run.stages),
        "failed": "",
    }


def stepped(run: Run, module: DynamicSceneModule, optimizer: torch.optim.Optimizer) -> int:
    """Take the last step of a stage, forward, backward and optimiser; return the rays of its batch."""
    module.curriculum.fraction, module.curriculum.step = 1.0, module.settings.iterations
    run.datamodule.picker, run.datamodule.asks = module.curriculum, module.method.asks
    last = module.settings.iterations - 1
    module.method.advance(1.0, last, optimizer)
    batch = run.datamodule.batches.draw().to(module.device)
    optimizer.zero_grad()
    factors = module.objective.factors(0)  # every term, also those that count in every tenth step alone
    step = module.look(batch, factors)
    if step.gradients is None:
        total(step, factors)[0].backward()
    else:
        set_gradients(module.method, step.gradients)
    optimizer.step()
    return sum(len(seen.view) for seen in batch.observations)


def on_gpu(method: str, scene: Path) -> dict:
    """Measure on a GPU, in this process, as its memory is freed between methods."""
    try:
        return measured(method, scene, device="cuda")
    except (RuntimeError, ValueError) as error:
        return dict.fromkeys(FIELDS) | {"method": method, "failed": str(error).split("\n")[0]}
    finally:
        gc.collect()
        torch.cuda.empty_cache()


def apart(method: str, scene: Path, gib: float) -> dict:
    """Measure in a process of its own, with as many rays as fit; what went wrong is ``failed``."""
    rays = None
    while rays is None or rays >= LEAST:
        command = [sys.executable, "-m", "tests.bench.faithful", "--one", method, "--scene", str(scene)]
        command += ["--gib", str(gib)] + ([] if rays is None else ["--rays", str(rays)])
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return json.loads(done.stdout.splitlines()[-1])
        why = done.stderr.strip().split("\n")[-1] or f"ended by signal {-done.returncode}"
        killed = done.returncode == -signal.SIGKILL  # as the system does where memory is short
        if not killed and "allocate memory" not in done.stderr and "MemoryError" not in done.stderr:
            break
        rays = (rays or configured(method, scene).preset.rays) // 2
        why = f"does not fit into {gib:g} GiB"
    return dict.fromkeys(FIELDS) | {"method": method, "failed": why}


def steps_table(rows: Sequence[dict], device: str = "cpu") -> str:
    """Make the Markdown table; a method that failed has its reason in place of numbers.

    FLOP and seconds of a step with fewer rays than published are multiplied accordingly, and marked so.
    """
    digits = 1 if device == "cpu" else 3
    head = ["method", "rays", "GFLOP", "MFLOP a ray", "s", "GiB", "parameters (M)", "steps", "days for all"]
    lines = []
    for row in rows:
        name = f"`{row['method']}`"
        if row["failed"]:
            lines.append([name, row["failed"], *[""] * (len(head) - 2)])
            continue
        times, whole = row["of"] / row["rays"], row["of"] == row["rays"]
        about, seconds = "" if whole else "≈ ", row["seconds"] * times
        numbers = [
            f"{row['of']:,}" if whole else f"{row['of']:,}, measured with {row['rays']:,}",
            f"{about}{row['flop'] * times / 1e9:,.0f}",
            f"{row['flop'] / 1e6 / row['rays']:,.1f}",
            f"{about}{seconds:.{digits}f}",
            f"{row['bytes'] / 2**30:.1f}" + ("" if whole else f" with {row['rays']:,}"),
            f"{row['parameters'] / 1e6:.2f}",
            f"{row['steps']:,}",
            f"{about}{seconds * row['steps'] / 86400:,.1f}",
        ]
        lines.append([name, *numbers])
    return table(head, lines)


def known_rows(file: Path) -> list[dict]:
    """Read the rows of an earlier call."""
    words = ("method", "failed", *CONDITIONS)

    def known(name: str, cell: str):
        return cell if name in words else json.loads(cell or "null")

    return [{name: known(name, row[name]) for name in (*FIELDS, *CONDITIONS)} for row in read_rows(file)]


def table_file(page: Path, device: str) -> Path:
    """Return the CSV file of a page's table."""
    return page.with_suffix(".csv") if device == "cpu" else page.with_name(f"{page.stem}-gpu.csv")


def write(rows: Sequence[dict], page: Path, device: str = "cpu") -> None:
    """Write the table into the page, and a CSV file beside it."""
    scene, day = (" and ".join(sorted({row[name] for row in rows})) for name in CONDITIONS)
    about = f"Scene: {scene}. Machine: {device_name(torch.device(device))}, one thread, {day}."
    section = "steps" if device == "cpu" else "steps on a GPU"
    replace_section(page, section, f"{about}\n\n{steps_table(rows, device)}")
    file = io.StringIO()
    writer = csv.DictWriter(file, (*FIELDS, *CONDITIONS), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    replace_file(table_file(page, device), file.getvalue())


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure every method, and write the table; with ``--one``, be the process that is measured."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.faithful", description=__doc__)
    parser.add_argument("--scene", type=Path, help="folder of a D-NeRF scene")
    parser.add_argument("--only", nargs="*", default=METHODS)
    parser.add_argument("--gib", type=float, default=12.0, help="most memory of a method")
    parser.add_argument("--device", choices=list(TIMED), default="cpu")
    parser.add_argument("--page", type=Path, default=project_root() / PAGE)
    parser.add_argument("--one", help=argparse.SUPPRESS)
    parser.add_argument("--rays", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    quiet()
    if given.one:
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (int(given.gib * 2**30), hard))
        print(json.dumps(measured(given.one, given.scene.resolve(), given.rays)))
        return
    rows = {row["method"]: row for row in known_rows(table_file(given.page, given.device))}
    with tempfile.TemporaryDirectory() as folder:
        scene = given.scene.resolve() if given.scene else synthesize(Path(folder) / "vehicle")
        if others := {row["scene"] for row in rows.values()} - {scene.name}:
            parser.error(
                f"--scene: expected {', '.join(others)}, as in the table's rows, but got {scene.name}"
            )
        for method in given.only:
            about = {"scene": scene.name, "day": time.strftime("%Y-%m-%d")}
            here = given.device == "cpu"
            rows[method] = (apart(method, scene, given.gib) if here else on_gpu(method, scene)) | about
            print(rows[method], flush=True)
            write([rows[method] for method in METHODS if method in rows], given.page, given.device)
    print(given.page)


if __name__ == "__main__":
    main()
