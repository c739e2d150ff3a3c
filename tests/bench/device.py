"""``python -m tests.bench.device``: print a device's seconds per step and frame, and PSNR against seconds."""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Sequence
from pathlib import Path

import lightning
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from forewarp.cli.entry import quiet
from forewarp.evaluation.accuracy_time import FILE, read_rows
from forewarp.report.published import PAPER
from forewarp.runs.build import build_run
from forewarp.runs.config import claim
from forewarp.runs.config_files import configurations
from forewarp.training.clock import now
from forewarp.training.device import device_name, device_of, peak_memory_bytes, versions
from forewarp.training.module import DynamicSceneModule
from forewarp.training.stages import Run

GOALS = (
    "goals on an H200: faithful step 30 ms, fast step 8 ms, kept frame 15 ms, the paper's PSNR in 10 minutes"
)
TINY = (
    *("experiment=demo", "data.scene=tiny", "data.synthesis.size=32", "data.synthesis.frames=8"),
    *("data.synthesis.val_views=1", "data.synthesis.samples_per_pixel=2", "budget.minutes=null"),
    *("preset.nodes=10", "logger=none", "trainer=cpu", "threads=1"),
    *("callbacks.pictures=null", "callbacks.scalars=null", "callbacks.progress=null", "evaluate=false"),
    *("data.synthesis.test_views=[1,1,1]", "preset.rays=64", "preset.inpainter_width=16"),
    *("stage.coarse.num_voxels=[[0,1000]]", "stage.fine.num_voxels=[[0,1500]]"),
    "callbacks.accuracy.first=0.05",
)


class StepTimes(lightning.Callback):
    """Record the seconds between the ends of steps, by stage, with the GPU synchronised."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = {}

    def on_train_start(self, trainer, module) -> None:
        """Start the clock of a stage."""
        self._since = now()

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx) -> None:
        """Record the seconds since the step before."""
        before, self._since = self._since, now()
        self.seconds.setdefault(module.settings.name, []).append(self._since - before)

    def __bool__(self) -> bool:
        return bool(self.seconds)

    def __str__(self) -> str:
        # Of the second half: the first compiles, and has growing lattices and few frames.
        medians = {name: statistics.median(taken[len(taken) // 2 :]) for name, taken in self.seconds.items()}
        return ", ".join(f"{name} {1e3 * seconds:.1f} ms" for name, seconds in medians.items())


def fit(overrides: Sequence[str]) -> tuple[Run, DynamicSceneModule, StepTimes]:
    """Fit the run that these overrides of ``forewarp-train`` compose, or what is left of it."""
    with initialize_config_dir(str(configurations()), version_base="1.3"):
        config = compose("train", list(overrides))
    run, times = build_run(config), StepTimes()
    claim(config)  # refuses a folder that was fitted with another config
    own = run.callbacks
    run.callbacks = lambda name, folder: [*own(name, folder), times]
    module = run.fit()
    return run, module.to(device_of(config.trainer.accelerator)), times


def frames(run: Run, module: DynamicSceneModule, size: int, repeats: int = 5) -> tuple[float, float]:
    """Return median seconds of a square picture: the first of its time, and another from the kept grid."""
    target = run.datamodule.targets("test")[0]
    view, first, again = target.frame.camera.resized(size, size), [], []
    for _ in range(repeats + 1):
        begin = now()
        snapshot = module.method.at(target.moment)
        module.render(view, target.moment, target.background, snapshot)
        middle = now()
        module.render(view, target.moment, target.background, snapshot)
        first.append(middle - begin)
        again.append(now() - middle)
    return statistics.median(first[1:]), statistics.median(again[1:])


def papers(scene: str) -> str:
    """Return the paper's PSNR of a D-NeRF scene as text; empty for other scenes."""
    printed = OmegaConf.load(PAPER).tables.dnerf_scenes
    ours = next(row["values"] for row in printed.rows if row["name"] == "Ours")
    columns = {group["scenes"][0]: 3 * i for i, group in enumerate(printed.groups)}
    return f", the paper {ours[columns[scene]]:.2f}" if scene in columns else ""


def report(run: Run, module: DynamicSceneModule, times: StepTimes, size: int) -> None:
    """Print seconds per step and per frame."""
    first, again = frames(run, module, size)
    print(f"  steps: {times or 'fitted before'}; peak memory {peak_memory_bytes() / 2**30:.2f} GiB")
    print(
        f"  {size}x{size}: {1 / first:.1f} frames/s ({1e3 * first:.0f} ms), of a kept grid {1 / again:.1f} ",
        end="",
    )
    print(f"({1e3 * again:.0f} ms)", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.device", description=__doc__)
    parser.add_argument("--device", default="gpu", help="gpu, or cpu as a trial")
    parser.add_argument("--minutes", type=float, default=10.0, help="of training for each scene")
    parser.add_argument("--steps", type=int, default=240, help="with preset=faithful, a sixth of them coarse")
    parser.add_argument(
        "--data", default=None, help="folder of D-NeRF scenes; default: the procedural vehicle"
    )
    parser.add_argument("--scenes", nargs="*", default=["jumpingjacks", "hook"])
    parser.add_argument("--folder", type=Path, default=Path("runs/bench-gpu"))
    parser.add_argument("--small", action="store_true", help="everything tiny")
    given = parser.parse_args(arguments)
    quiet()
    device = device_of(given.device)
    small = [*TINY, f"data.root={given.folder}"] if given.small else []
    common = [*small, f"trainer={given.device}", "evaluate=false"]
    print(f"{device_name(device)}; {versions()}\n{GOALS}")
    bounds = ["budget.iterations=12"] if given.small else [f"budget.minutes={given.minutes}"]
    for scene in given.scenes if given.data else ["vehicle"]:
        data = ["experiment=dnerf", f"data.root={given.data}", f"data.scene={scene}"] if given.data else []
        preset = ["preset=fast", "data.held_out=2" if given.small else "data.held_out=8"]
        where = given.folder / scene
        name = f"fast-{given.minutes:g}min"
        run, module, times = fit([*data, *common, *preset, *bounds, f"run={where / name}"])
        print(f"{scene}, fast")
        report(run, module, times, 40 if given.small else 400)
        for row in read_rows(where / name / FILE):
            print(f"  after {float(row['seconds']):6.1f} s: {float(row['psnr']):.2f} dB of views set aside")
        scores = [float(module.psnr_of(target)) for target in run.datamodule.targets("test")]
        print(f"  test views: {statistics.mean(scores):.2f} dB{papers(scene)}")
        steps = ["preset=faithful", f"budget.iterations={12 if given.small else given.steps}"]
        run, module, times = fit([*data, *common, *steps, "budget.minutes=null", f"run={where / 'faithful'}"])
        print(f"{scene}, faithful")
        report(run, module, times, 40 if given.small else 400)


if __name__ == "__main__":
    main()
