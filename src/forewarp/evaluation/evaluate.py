"""Measure a fitted scene on its test views: images, scores by image and ability, flow error, a table."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch
from rich import box
from rich.console import Console
from rich.table import Table
from torch import Tensor

from forewarp.clock import now
from forewarp.drawing.files import write_png
from forewarp.drawing.images import at_least, error_colors, in_a_row
from forewarp.files import write_json
from forewarp.methods.effect import switched
from forewarp.methods.method import HasTrajectories, parameter_count
from forewarp.metrics.flow import end_point_error
from forewarp.metrics.lpips import find_lpips
from forewarp.metrics.registry import METRICS
from forewarp.metrics.suite import ImageSuite, summarise
from forewarp.ops.grid import block_means, reduced_depth
from forewarp.progress import Counted, time_text
from forewarp.scene.frame import Scene, spread
from forewarp.scene.view import Rendering, Target
from forewarp.training.module import DynamicSceneModule
from forewarp.training.stages import Run

_LEAST = 0.5 / 255  # alpha that 8 bits round to 0, where stored colours are 0 too


def reduced_rendering(
    rendering: Rendering, shape: tuple[int, int], by: int, background: Tensor, *, straight: bool
) -> Rendering:
    """Average each block of ``by`` x ``by`` pixels of a whole rendered picture.

    Pictures with alpha are stored straight and averaged before the alpha is applied, which darkens
    silhouettes; so is the rendering then, or it would be compared with another outline than it was fitted to.

    Args:
        rendering: of the whole picture, over ``background``.
        shape: its (height, width).
        by: side of a block; it divides both.
        background: colour (3,) behind the picture.
        straight: whether the scene's pictures have alpha.
    """
    rgb = rendering.rgb.clamp(0, 1).reshape(*shape, 3)
    opacity = rendering.opacity.clamp(0, 1).reshape(*shape, 1)
    alpha = block_means(opacity, by)
    if straight:
        color = (rgb - (1 - opacity) * background) / opacity.clamp(min=_LEAST)
        color = torch.where(opacity < _LEAST, 0.0, color).clamp(0, 1)
        rgb = block_means(color, by) * alpha + (1 - alpha) * background
    else:
        rgb = block_means(rgb, by)
    depth = reduced_depth(rendering.depth.reshape(shape), by)
    return Rendering(rgb.reshape(-1, 3), depth.flatten(), alpha.flatten())


_SHEET_SIDE = 300  # least pixels of the shorter side of a picture on a sheet
_PACKAGES = ("forewarp", "torch", "lightning", "torchmetrics", "numba")  # what results depend on
_PROCESSOR = Path("/proc/cpuinfo")  # Linux only


@dataclass(frozen=True)
class Shown:
    """A rendered view.

    Attributes:
        number: index of the view in the split.
        target: the view and the true picture.
        renderings: renderings by name, the best last.
        seconds: time of the best rendering, including the snapshot if the view before had another time.
        seconds_again: time of the best rendering without the snapshot.
    """

    number: int
    target: Target
    renderings: dict[str, Rendering]
    seconds: float
    seconds_again: float


def draw(
    module: DynamicSceneModule, targets: Sequence[Target], numbers: Sequence[int] | None = None
) -> Iterator[Shown]:
    """Render views in the order of their times, so that each time needs one snapshot.

    Args:
        module: the fitted scene.
        targets: views to render; times are read from ``targets.frames``, without decoding pictures.
        numbers: indices of the views to render; None: all.
    """
    snapshot, wanted = None, range(len(targets)) if numbers is None else numbers
    for number in sorted(wanted, key=lambda i: targets.frames[i].time):
        target = targets[number]
        begin, view = now(), target.view
        with torch.no_grad():
            if snapshot is None or not snapshot.holds(target.moment):
                snapshot = module.method.at(target.moment)
            view.rays()
            behind, drawn, warped = target.background.to(module.device), {}, now() - begin
            for name in snapshot.renderings:
                begin = now()
                drawn[name] = snapshot.render(view, behind, name)
                again = now() - begin
        yield Shown(number, target, drawn, warped + again, again)


def evaluate(
    module: DynamicSceneModule,
    datamodule,
    folder: Path,
    suite: ImageSuite,
    *,
    protocol: Mapping | None = None,
    finished: Mapping[str, Mapping] | None = None,
    sheets: int = 6,
    views: int | None = None,
    reduce: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict:
    """Measure a fitted scene on its test views; all numbers but the seconds are reproducible.

    Write ``images/<name>.png`` (the best rendering), for some views ``images/sheets/<name>.png`` (truth |
    prediction | error), ``per_image.json``, and last ``metrics.json``.

    Args:
        module: the fitted scene, on the device to use.
        datamodule: serves ``scene`` and ``targets("test")``.
        folder: the run's folder.
        suite: computes the metrics of an image.
        protocol: further entries of ``protocol``: how the run was made.
        finished: the ``done.json`` of each stage (``Run.finished``).
        sheets: number of sheets to write, spread over the views.
        views: most test views to measure, evenly spread; None: all.
        reduce: average so many pixels a side of each view and of the truth, then score; None: as they are.
        progress: called with (images done, all images) after each image.

    Returns:
        the content of ``metrics.json``.
    """
    scene, targets, finished = datamodule.scene, datamodule.targets("test"), finished or {}
    targets = targets if reduce is None else targets.reduced(reduce)
    chosen = middles(len(targets), views)
    on_sheets = {chosen[i] for i in spread(len(chosen), sheets)}
    rows: dict[int, dict] = {}
    for shown in draw(module, targets, chosen):
        shown = shown if reduce is None else _reduced(shown, reduce, scene.has_alpha)
        rows[shown.number] = _score(shown, suite)
        _save(shown, Path(folder) / "images", shown.number in on_sheets)
        if progress is not None:
            progress(len(rows), len(chosen))
    for number, frame in enumerate(targets.frames):  # pictures of an earlier choice of views
        for written, place in ((number in rows, "images"), (number in on_sheets, "images/sheets")):
            if not written:
                (Path(folder) / place / f"{frame.name}.png").unlink(missing_ok=True)
    per_image = [rows[number] for number in sorted(rows)]
    if len(chosen) < len(targets):
        measured = f"{len(chosen)} of {len(targets)} test views, evenly spread"
        protocol = {**(protocol or {}), "measured": measured}
    if reduce is not None:
        protocol = {**(protocol or {}), "reduced": reduce}
    metrics = {
        "protocol": _protocol(module, scene, per_image, {**_trained_by(finished), **(protocol or {})}),
        "seconds": _seconds(per_image, finished),
        "clocks": _clocks(finished),
        "steps": {name: int(noted["steps"]) for name, noted in finished.items()},
        "peak_memory_bytes": max((int(s["peak_memory_bytes"]) for s in finished.values()), default=None),
        "parameters": parameter_count(module.method),
        "size": dict([module.method.size]),
        "effects": switched(module.method),
        **_means(per_image),
    }
    if (flow := flow_error(module, scene)) is not None:
        metrics["flow"] = flow
    write_json(Path(folder) / "per_image.json", {"images": per_image})
    write_json(Path(folder) / "metrics.json", metrics)
    return metrics


def middles(count: int, wanted: int | None) -> list[int]:
    """Choose the middles of ``wanted`` equal parts of ``count`` views, so that ends count no more than in all
    of them; None, or more than there are: all.

    >>> middles(20, 5), middles(3, None)
    ([2, 6, 10, 14, 18], [0, 1, 2])
    """
    if wanted is None or wanted >= count:
        return list(range(count))
    return [(2 * i + 1) * count // (2 * wanted) for i in range(wanted)]


def mean_scores(module: DynamicSceneModule, targets: Sequence[Target], suite: ImageSuite) -> dict[str, float]:
    """Return the mean scores of the views' best renderings; write nothing."""
    rows = [_score(shown, suite)["scores"] for shown in draw(module, targets)]
    return summarise(("all", row) for row in rows).get("all", {})


@torch.no_grad()
def flow_error(module: DynamicSceneModule, scene: Scene) -> dict | None:
    """Return end-point errors of the learned trajectories, world units; None without them or true ones."""
    truth = scene.truth
    if truth is None or not isinstance(module.method, HasTrajectories):
        return None
    points, times = truth.points[:, 0].to(module.device), truth.times.float().to(module.device)
    return end_point_error(module.method.trajectories(points, times), truth.points)


def _reduced(shown: Shown, by: int, straight: bool) -> Shown:
    """Average blocks of pixels of all renderings; the target is as small already."""
    behind, shape = shown.target.background, shown.target.view.shape
    smaller = {
        name: reduced_rendering(one, shape, by, behind.to(one.rgb), straight=straight)
        for name, one in shown.renderings.items()
    }
    return replace(shown, renderings=smaller)


def _image(rendering: Rendering, target: Target) -> Tensor:
    return rendering.rgb.clamp(0, 1).reshape(target.rgb.shape).cpu()


def _score(shown: Shown, suite: ImageSuite) -> dict:
    """Make the entry of one image: scores of the best rendering, and of the others by name."""
    target, frame = shown.target, shown.target.frame
    scores = {
        name: suite.score(_image(r, target), target, r.depth.reshape(target.rgb.shape[:2]).cpu())
        for name, r in shown.renderings.items()
    }
    best = list(scores)[-1]
    about = {"name": frame.name, "time": frame.time, "ability": frame.ability, "rendering": best}
    others = {name: values for name, values in scores.items() if name != best}
    seconds = {"seconds": shown.seconds, "seconds_again": shown.seconds_again}
    return {**about, **seconds, "scores": scores[best], "others": others}


def _save(shown: Shown, folder: Path, on_sheet: bool) -> None:
    target, image = shown.target, _image(list(shown.renderings.values())[-1], shown.target)
    name = shown.target.frame.name + ".png"
    write_png(folder / name, image)
    if on_sheet:
        parts = [target.rgb, image, error_colors(target.rgb, image)]
        sheet = in_a_row([at_least(part, _SHEET_SIDE) for part in parts])
        write_png(folder / "sheets" / name, sheet)


def _means(per_image: list[dict]) -> dict[str, dict]:
    """Average the scores of the best rendering (``test``) and of every other (``test_<rendering>``)."""
    means = {"test": summarise((row["ability"], row["scores"]) for row in per_image)}
    for name in per_image[0]["others"]:
        means[f"test_{name}"] = summarise((row["ability"], row["others"][name]) for row in per_image)
    return means


def _seconds(per_image: list[dict], finished: Mapping[str, Mapping]) -> dict[str, float]:
    """Return seconds of training by stage, and of rendering an image: the first of a time, and another."""
    stages = {name: float(noted["seconds"]) for name, noted in finished.items()}
    drawing, again = (sum(r[key] for r in per_image) / len(per_image) for key in ("seconds", "seconds_again"))
    frames = {"render_per_frame": drawing, "render_again_per_frame": again}
    return {"train": sum(stages.values()), **stages, **frames}


def _clocks(finished: Mapping[str, Mapping]) -> dict[str, float]:
    """Return the seconds of training by each clock that all stages were counted by."""
    counted = [noted.get("clocks", {}) for noted in finished.values()]
    shared = set.intersection(*map(set, counted)) if counted else set()
    return {kind: sum(float(one[kind]) for one in counted) for kind in sorted(shared)}


def _protocol(module: DynamicSceneModule, scene: Scene, per_image: list[dict], protocol: Mapping) -> dict:
    first = per_image[0]
    return {
        "scene": scene.name,
        **scene.protocol,
        **protocol,
        **module.method.protocol(),
        "renderings": [*first["others"], first["rendering"]],
        "scored": first["rendering"],
        "device": device_name(module.device),
        "threads": torch.get_num_threads(),
        "versions": versions(),
    }


def _trained_by(finished: Mapping[str, Mapping]) -> dict:
    """The commit by which the last stage was finished, where it was noted."""
    noted = [stage["commit"] for stage in finished.values() if stage.get("commit")]
    return {"commit": noted[-1]} if noted else {}


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
            cells = [f"{scores[name]:.{METRICS[name].digits}f}" if name in scores else "" for name in names]
            table.add_row(ability + suffix, *cells)
    return table


def device_name(device: torch.device) -> str:
    """Return the model name of the GPU or of the processor."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = _PROCESSOR.read_text().splitlines()
    except OSError:
        lines = []
    named = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return next(filter(None, named), None) or platform.processor() or platform.machine()


def versions() -> dict[str, str]:
    """Return the versions of Python and of the installed packages that results depend on."""
    installed = {"python": platform.python_version()}
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            installed[package] = version(package)
    return installed
