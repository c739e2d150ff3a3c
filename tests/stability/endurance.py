"""Fit many seeds from bad starting values, at learning rates up to ten times the default."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch

RATES = (1.0, 3.0, 10.0)
SEEDS, STEPS = 20, 500
# The demo scene made small: 32 pixels, 24 frames, lattices of about 20^3 and 26^3 voxels, 512 rays.
SMALL = (
    "experiment=demo",
    "data.synthesis.size=32",
    "data.synthesis.frames=24",
    "data.synthesis.test_views=[3,3,2]",
    "data.synthesis.val_views=1",
    "data.synthesis.samples_per_pixel=2",
    "budget.minutes=null",
    "preset.rays=512",
    "preset.nodes=10",
    "stage.coarse.num_voxels=[[0,8000]]",
    "stage.fine.num_voxels=[[0,12000],[0.45,17576]]",
    "callbacks.pictures=null",
    "callbacks.scalars=null",
    "callbacks.progress=null",
    "logger=none",
    "trainer=cpu",
    "evaluate=false",
    "threads=1",
)


def overrides(seed: int, rate: float, steps: int, data: Path, folder: Path) -> list[str]:
    """Return the overrides of one trial."""
    kinds = {"density": 0.1, "color": 0.1, "flow": 3e-3}, {"density": 0.1, "color": 0.1, "flow": 1e-3}
    rates = [
        f"stage.{stage}.lr.{kind}={value * rate:g}"
        for stage, values in zip(("coarse", "fine"), kinds)
        for kind, value in values.items()
    ]
    own = [
        f"seed={seed}",
        f"budget.iterations={steps}",
        f"data.root={data}",
        "data.scene=vehicle32",
        f"run={folder}",
    ]
    return [*SMALL, *rates, *own]


def hostile(method: torch.nn.Module, seed: int) -> None:
    """Spoil a method's starting values: random flow and density noise.

    The deviation of the flow grows with the seed from 0 to a fifth of the scene, that of raw density to 6.
    """
    share = (seed % SEEDS) / (SEEDS - 1)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        density = method.radiance.parameter("density")
        density += 6 * share * torch.randn(density.shape, generator=generator)
        if method.motion is not None:
            last = method.motion.trajectory.network[-1].weight
            last += 0.2 * share * torch.randn(last.shape, generator=generator)


def trial(seed: int, rate: float, steps: int, data: Path) -> dict:
    """Fit once from bad starting values; return PSNR of the test views, and what went wrong, if anything."""
    from hydra import compose, initialize_config_dir

    from forewarp.runs.build import build_run
    from forewarp.runs.config_files import configurations
    from forewarp.training.module import DynamicSceneModule

    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        with initialize_config_dir(str(configurations()), version_base="1.3"):
            config = compose("train", overrides(seed, rate, steps, data, Path(folder)))
        run = build_run(config)
        fit_stage = run._fit_stage

        def from_a_hostile_start(stage, module: DynamicSceneModule, *rest) -> None:
            if stage is run.stages[0]:
                hostile(module.method, seed)
            fit_stage(stage, module, *rest)

        run._fit_stage = from_a_hostile_start
        wrong, psnr = None, None
        try:
            module = run.fit()
            bad = [name for name, p in module.named_parameters() if not p.isfinite().all()]
            wrong = f"{bad[0]} is not finite" if bad else None
            psnr = _psnr(module, run.datamodule)
        except ValueError as error:
            wrong = str(error)
    return {
        "seed": seed,
        "rate": rate,
        "steps": steps,
        "psnr": psnr,
        "wrong": wrong,
        "seconds": time.perf_counter() - begin,
    }


def _psnr(module, datamodule) -> float:
    scores = []
    for target in datamodule.targets("test"):
        drawn = module.render(target.view, target.moment, target.background)
        error = (drawn.rgb.clamp(0, 1).reshape(target.rgb.shape) - target.rgb).square().mean()
        scores.append(float(-10 * torch.log10(error.clamp(min=1e-10))))
    return sum(scores) / len(scores)


def read_trials(path: Path, steps: int) -> list[dict]:
    """Read the finished trials of this many steps; skip a line that an interruption cut."""
    done = []
    for line in path.read_text().splitlines() if path.is_file() else ():
        try:
            done.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return [trial for trial in done if trial["steps"] == steps]


def endure(
    path: Path, *, seconds: float, seeds: int = SEEDS, steps: int = STEPS, rates: Sequence[float] = RATES
) -> list[dict]:
    """Run trials that are not in ``path`` yet (a line each), for at most ``seconds``; return all of them."""
    from forewarp.progress import time_text

    path.parent.mkdir(parents=True, exist_ok=True)
    begin, begun = time.perf_counter(), len(read_trials(path, steps))
    wanted = [(seed, rate) for seed in range(seeds) for rate in rates]
    for seed, rate in wanted:
        done = read_trials(path, steps)
        if any((t["seed"], t["rate"]) == (seed, rate) for t in done):
            continue
        spent = time.perf_counter() - begin
        if spent > seconds:
            break
        found = trial(seed, rate, steps, path.parent)
        with path.open("a") as file:
            file.write(json.dumps(found) + "\n")
        each = (time.perf_counter() - begin) / (len(done) + 1 - begun)
        left = time_text(each * (len(wanted) - len(done) - 1))
        score = f"{found['psnr']:.2f} dB" if found["wrong"] is None else found["wrong"]
        print(
            f"{len(done) + 1}/{len(wanted)} seed {seed}, rates x{rate:g}: {score} | {left} left", flush=True
        )
    return read_trials(path, steps)
