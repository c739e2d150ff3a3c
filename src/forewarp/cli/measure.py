"""Evaluation with a progress line, and the table it ends with."""

from __future__ import annotations

import time
from pathlib import Path

import torch
from omegaconf import DictConfig
from rich import box
from rich.console import Console
from rich.table import Table

from forewarp.metrics.lpips import find_lpips
from forewarp.metrics.suite import METRICS, ImageSuite
from forewarp.training.evaluation import evaluate
from forewarp.training.module import DynamicSceneModule
from forewarp.training.progress import ProgressLine, time_text
from forewarp.training.stages import Run

FAMILIES = ("lpips", "ms_ssim", "depth")


def measure(run: Run, module: DynamicSceneModule, config: DictConfig) -> dict:
    """Evaluate a fitted run into its folder and print the table."""
    extra = config.lpips_weights
    nets = find_lpips(extra=[extra] if isinstance(extra, str) else extra)
    suite = ImageSuite(nets, mask_box=run.datamodule.scene.protocol.get("mask_box", False))
    module.to(device_of(config.trainer.accelerator))
    protocol = {"method": method_name(config), "preset": config.preset.name, "seed": config.seed}
    protocol |= {"minutes": config.budget.minutes, "iterations": config.budget.iterations}
    with Progress("test views") as progress:
        metrics = evaluate(
            module,
            run.datamodule,
            run.folder,
            suite,
            protocol=protocol,
            finished=run.finished(),
            sheets=config.sheets,
            progress=progress,
        )
    show(metrics, run.folder, suite.absent)
    return metrics


def method_name(config: DictConfig) -> str:
    """Name the method that was measured: the last stage's own, or else the run's."""
    own = [stage.get("model") for stage in config.stage.values() if stage is not None][-1]
    return (own or config.model).get("name", config.model.name)


def device_of(accelerator: str) -> torch.device:
    """The device that runs use under this ``trainer.accelerator``: with ``auto`` a CUDA GPU, or else the CPU.

    Others, Apple's among them, have no float64, which cameras and the cosine basis are computed in.
    """
    if accelerator not in ("auto", "cpu", "gpu", "cuda"):
        raise ValueError(
            f"trainer.accelerator: expected auto, cpu, gpu or cuda, but got {accelerator}; use trainer=auto"
        )
    if accelerator in ("gpu", "cuda") and not torch.cuda.is_available():
        raise ValueError("trainer.accelerator: expected a GPU, but found none; use trainer=cpu")
    wanted = accelerator in ("gpu", "cuda") or (accelerator == "auto" and torch.cuda.is_available())
    return torch.device("cuda" if wanted else "cpu")


def check_precision(precision: object) -> None:
    """Refuse float16: the slopes of an inpainter over constant volumes leave its range."""
    if "16" in str(precision) and "bf16" not in str(precision):
        raise ValueError(
            f"trainer.precision: expected 32-true or bf16-mixed, but got {precision}; "
            "float16 does not hold the gradients, use trainer.precision=bf16-mixed"
        )


class Progress:
    """``progress(done, total)`` as a line with the time left; a context, after which all is as it was."""

    def __init__(self, title: str, stream=None) -> None:
        self.line, self.begin, self.done, self.total = (
            ProgressLine(title, stream=stream),
            time.perf_counter(),
            0,
            1,
        )

    def __call__(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` are done, where it is time to."""
        self.done, self.total = done, total
        if self.line.due():
            spent = time.perf_counter() - self.begin
            self.line.show(done / total, spent / done * (total - done) if done else None, f"{done}/{total}")

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *error) -> None:
        spent = time_text(time.perf_counter() - self.begin)
        self.line.close(self.done / self.total, f"{self.done}/{self.total} in {spent}")


def show(metrics: dict, folder: Path, absent: dict[str, str]) -> None:
    """Print what was measured and where it is."""
    console = Console()
    console.print(table_of(metrics))
    seconds, flow = metrics["seconds"], metrics.get("flow")
    others = ("train", "render_per_frame", "render_again_per_frame")
    stages = ", ".join(f"{name} {time_text(s)}" for name, s in seconds.items() if name not in others)
    lines = [
        f"trained {time_text(seconds['train'])} ({stages}), {seconds['render_per_frame']:.2f} s a frame, "
        f"{seconds['render_again_per_frame']:.2f} s another at the same time"
    ]
    if flow and flow["epe_moving"] is not None:
        error, motion = flow["epe_moving"], flow["motion_mean"]
        lines.append(
            f"flow: moving points off by {error:.4f}, {error / motion:.0%} of their motion {motion:.4f}"
        )
    if absent:
        lines.append(without(absent))
    images = Path(folder) / "images"
    lines += [f"numbers  {Path(folder) / 'metrics.json'}", f"pictures {images}"]
    if (images / "sheets").is_dir():
        lines.append(f"sheets   {images / 'sheets'}: truth | prediction | error")
    console.print("\n".join(lines), highlight=False, soft_wrap=True)


def without(absent: dict[str, str]) -> str:
    """One line of the metrics that are left out and why; a family of them, all left out, is named once."""
    reasons: dict[str, str] = {}
    for name, reason in absent.items():
        family = next((f for f in FAMILIES if name.startswith(f)), name)
        whole = all(metric in absent for metric in METRICS if metric.startswith(family))
        reasons.setdefault(family if whole else name, reason)
    return "without " + ", ".join(f"{name} ({reason})" for name, reason in reasons.items())


def table_of(metrics: dict) -> Table:
    """A row for every rendering and kind of test view, a column for every metric."""
    blocks = {key: value for key, value in metrics.items() if key.split("_")[0] == "test"}
    names = [m for m in METRICS if any(m in scores for block in blocks.values() for scores in block.values())]
    table = Table(
        title=f"{metrics['protocol']['scene']}, {metrics['protocol'].get('method', '')}",
        title_justify="left",
        box=box.SIMPLE,
    )
    table.add_column("test views")
    for name in names:
        table.add_column(name.replace("depth_delta_", "depth<"), justify="right")
    for key, block in blocks.items():
        suffix = key.removeprefix("test").replace("_", " ")
        for ability, scores in block.items():
            cells = [
                f"{scores[n]:.2f}" if n.startswith("psnr") else f"{scores[n]:.4f}" if n in scores else ""
                for n in names
            ]
            table.add_row(ability + suffix, *cells)
    return table
