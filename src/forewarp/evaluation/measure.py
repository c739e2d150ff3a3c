"""Evaluate a run with a progress line, and print the table of its numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from rich import box
from rich.console import Console
from rich.table import Table

from forewarp.evaluation.evaluate import evaluate
from forewarp.metrics.lpips import find_lpips
from forewarp.metrics.suite import METRICS, ImageSuite
from forewarp.progress import Counted, time_text
from forewarp.training.module import DynamicSceneModule
from forewarp.training.stages import Run

FAMILIES = ("lpips", "ms_ssim", "depth")


def measure(
    run: Run,
    module: DynamicSceneModule,
    *,
    device: torch.device,
    protocol: Mapping,
    lpips_weights: Sequence[str] | None = None,
    sheets: int = 6,
    views: int | None = None,
    reduce: int | None = None,
) -> dict:
    """Evaluate a fitted run into its folder and print the table.

    Args:
        run: the run to measure.
        module: the fitted scene.
        device: device to render on.
        protocol: further entries of ``protocol``: how the run was made.
        lpips_weights: files or folders of backbone weights, searched before the usual places.
        sheets, views, reduce: numbers of sheets and of test views, and pixels to average; see ``evaluate``.
    """
    suite = ImageSuite(
        find_lpips(extra=lpips_weights), mask_box=run.datamodule.scene.protocol.get("mask_box", False)
    )
    module.to(device)
    with Counted("test views") as progress:
        metrics = evaluate(
            module,
            run.datamodule,
            run.folder,
            suite,
            protocol=protocol,
            finished=run.finished(),
            sheets=sheets,
            views=views,
            reduce=reduce,
            progress=progress,
        )
    show(metrics, run.folder, suite.absent)
    return metrics


def show(metrics: dict, folder: Path, absent: dict[str, str]) -> None:
    """Print the numbers and the paths of the files."""
    console = Console()
    console.print(table_of(metrics))
    seconds, flow = metrics["seconds"], metrics.get("flow")
    others = ("train", "render_per_frame", "render_again_per_frame")
    stages = ", ".join(f"{name} {time_text(s)}" for name, s in seconds.items() if name not in others)
    lines = [
        f"trained {time_text(seconds['train'])} ({stages}), {seconds['render_per_frame']:.3g} s a frame, "
        f"{seconds['render_again_per_frame']:.3g} s another at the same time"
    ]
    if flow and flow["epe_moving"] is not None:
        error, motion = flow["epe_moving"], flow["motion_mean"]
        lines.append(
            f"flow: moving points off by {error:.4f}, {error / motion:.0%} of their motion {motion:.4f}"
        )
    lines += notes_of(metrics["protocol"])
    if absent:
        lines.append(without(absent))
    images = Path(folder) / "images"
    lines += [f"numbers  {Path(folder) / 'metrics.json'}", f"pictures {images}"]
    if (images / "sheets").is_dir():
        lines.append(f"sheets   {images / 'sheets'}: truth | prediction | error")
    console.print("\n".join(lines), highlight=False, soft_wrap=True)


def notes_of(protocol: Mapping) -> list[str]:
    """Say in a line each what a method does otherwise than published, and which faults it keeps, if any."""
    return [f"{key}: {protocol[key]}" for key in ("departures", "faults") if key in protocol]


def without(absent: dict[str, str]) -> str:
    """Say in one line which metrics are missing and why; name a whole family once."""
    reasons: dict[str, str] = {}
    for name, reason in absent.items():
        family = next((f for f in FAMILIES if name.startswith(f)), name)
        whole = all(metric in absent for metric in METRICS if metric.startswith(family))
        reasons.setdefault(family if whole else name, reason)
    return "without " + ", ".join(f"{name} ({reason})" for name, reason in reasons.items())


def table_of(metrics: dict) -> Table:
    """Make a table with a row for every rendering and kind of test view, and a column for every metric."""
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
