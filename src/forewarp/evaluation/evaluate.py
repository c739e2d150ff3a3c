"""Measure a fitted scene on its test views: images, scores by image and ability, flow error, a table."""

from __future__ import annotations

import platform
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from pathlib import Path
from statistics import fmean, median

import torch
from rich import box
from rich.table import Table
from torch import Tensor

from forewarp.clock import now
from forewarp.drawing.images import at_least, depth_colors, depth_ends, error_colors, in_a_row, write_png
from forewarp.evaluation.crossed import crossed_scores, drop_of
from forewarp.evaluation.motion import measure_motion
from forewarp.evaluation.trust import trust_of
from forewarp.files import write_json
from forewarp.methods.effect import switched
from forewarp.methods.method import CarriesPixels, HasEllipsoids, HasLayers, HasTrajectories, parameter_count
from forewarp.metrics.geometry import end_point_error
from forewarp.metrics.registry import METRICS, ImageSuite, absences, described, scores_of_parts, summarise
from forewarp.ops.grid import block_means, reduced_depth
from forewarp.progress import TextConsole, time_text
from forewarp.provenance import versions
from forewarp.scene.frame import Scene, spread, walk_of
from forewarp.scene.view import Moment, Rendering, Target, View
from forewarp.training.module import DynamicSceneModule

NOT_PRINTED = ("ms_ssim_legacy", "dssim")  # metrics of others' tables, which metrics.json has
_PAIRS = 24  # of images, between which motion is looked at
PCK = 0.05  # of an image's longer side, within which a keypoint is where it should be
_SHEET_SIDE = 300  # least pixels of the shorter side of an image on a sheet
_LEAST_ALPHA = 0.5 / 255  # 8 bits round it to 0, where stored colours are 0 too
_PROCESSOR = Path("/proc/cpuinfo")  # Linux only


@dataclass(frozen=True)
class RenderedView:
    """A rendered view.

    Attributes:
        number: index of the view in the split.
        target: the view and the true image.
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
) -> Iterator[RenderedView]:
    """Render views in the order of their times, so that each time needs one snapshot.

    Args:
        module: the fitted scene.
        targets: views to render; times are read from ``targets.frames``, without decoding images.
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
            background, renderings, warped = target.background.to(module.device), {}, now() - begin
            for name in snapshot.renderings:
                begin = now()
                renderings[name] = snapshot.render(view, background, name)
                again = now() - begin
        yield RenderedView(number, target, renderings, warped + again, again)


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
    prediction | error) and the same of depth, ``images/depth/<name>.png``, where it is known,
    ``per_image.json``, with sheets ``motion.npz``, ``networks.json`` if the method has any to draw, and last
    ``metrics.json``.

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
    scene, targets, images = datamodule.scene, datamodule.targets("test"), folder / "images"
    finished = finished or {}
    protocol = {**trained_by(finished, module.method), **(protocol or {})}
    chosen = middles(len(targets), views)
    if len(chosen) < len(targets):
        protocol["measured"] = f"{len(chosen)} of {len(targets)} test views, evenly spread"
    whole = targets
    if reduce is not None:
        targets, protocol["reduced"] = targets.reduced(reduce), reduce
    on_sheets = {chosen[i] for i in spread(len(chosen), sheets)}
    rows: dict[int, dict] = {}
    for view in draw(module, targets, chosen):
        if reduce is not None:  # the target is as small already
            options = view.target.view.shape, reduce, view.target.background, scene.has_alpha
            small = {name: reduced_rendering(whole, *options) for name, whole in view.renderings.items()}
            view = replace(view, renderings=small)
        begin = now()
        rows[view.number] = _score(view, suite)
        rows[view.number]["seconds_scored"] = now() - begin
        _save(view, images, view.number in on_sheets)
        if progress is not None:
            progress(len(rows), len(chosen))
    for number, frame in enumerate(targets.frames):  # images of an earlier choice of views
        shown = number in on_sheets
        for is_written, place in ((number in rows, ""), (shown, "sheets"), (shown, "depth")):
            place = images / place
            if not is_written:
                (place / f"{frame.name}.png").unlink(missing_ok=True)
    per_image = [rows[number] for number in sorted(rows)]
    parts = [part for row in per_image for part in row["parts"].items()]
    if not scene.has_alpha and len(scene.instants) > 1:
        crossed, absent = crossed_scores(module.method, scene, whole, chosen)
        parts += crossed
        protocol |= {"crossed": f"not measured: {absent}"} if absent else {}
    best, others = per_image[0]["rendering"], list(per_image[0]["others"])
    seconds = {name: float(done["seconds"]) for name, done in finished.items()}
    clocks = [done.get("clocks", {}) for done in finished.values()]
    shared = set.intersection(*map(set, clocks)) if clocks else set()
    about = {"scene": scene.name, **scene.protocol, **from_training(scene), **over_scene(module, scene)}
    about |= {**protocol, **module.method.protocol(), "renderings": [*others, best], "scored": best}
    about |= {"device": device_name(module.device), "threads": torch.get_num_threads()}
    spent = {"train": sum(seconds.values()), **seconds}
    spent["render_per_frame"] = fmean(row["seconds"] for row in per_image)
    spent["render_again_per_frame"] = fmean(row["seconds_again"] for row in per_image)
    metrics = {
        "protocol": about | {"versions": versions()},
        "seconds": spent,
        # Only clocks that all stages were counted by.
        "clocks": {kind: sum(float(clock[kind]) for clock in clocks) for kind in sorted(shared)},
        "steps": {name: int(done["steps"]) for name, done in finished.items()},
        "peak_memory_bytes": max((int(d["peak_memory_bytes"]) for d in finished.values()), default=None),
        "parameters": parameter_count(module.method),
        "size": dict([module.method.size]),
        "effects": switched(module.method),
        "test": summarise(chain(((row["ability"], row["scores"]) for row in per_image), parts)),
    }
    if trust := trust_of(module.method, scene, whole, chosen, drop_of(metrics["test"])):
        metrics["trust"] = trust
    metrics["metrics"] = described(dict.fromkeys(n for scores in metrics["test"].values() for n in scores))
    if lacking := absences([row["scores"] for row in per_image], suite.absent):
        metrics["absent"] = lacking
    if targets := [done["target"] for done in finished.values() if "target" in done]:
        metrics["target"] = targets[-1]
    for name in others:
        metrics[f"test_{name}"] = summarise((row["ability"], row["others"][name]) for row in per_image)
    for name, of_motion in (("flow", flow_error), ("keypoints", keypoint_transfer)):
        if (found := of_motion(module, scene)) is not None:
            metrics[name] = found
    metrics |= measure_motion(module, datamodule, folder, pictures=sheets > 0)
    write_json(folder / "per_image.json", {"images": per_image})
    if networks := module.method.outlines():
        write_json(folder / "networks.json", networks)
    write_json(folder / "metrics.json", metrics)
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


def trained_by(finished: Mapping[str, Mapping], method: object) -> dict:
    """Say which ``code`` trained the last stage, by package, and the ``commit`` of the method's own one."""
    done = list(finished.values())[-1] if finished else {}
    package = type(method).__module__.partition(".")[0]
    code = done.get("code") or {"forewarp": {"commit": done.get("commit")}}  # as earlier runs have it
    commit = code.get(package, {}).get("commit")
    return ({"code": code} if "code" in done else {}) | ({"commit": commit} if commit else {})


def from_training(scene: Scene) -> dict[str, str]:
    """Say how far in time test frames are from the nearest training frame: steps between the frames, and
    seconds where the scene's protocol has the length of its film; and how fast the film's camera goes around
    what it looks at. {} without steps.

    >>> from types import SimpleNamespace as Of
    >>> train, test = ([Of(time=t) for t in times] for times in ((0.0, 0.2, 0.3, 0.3), (0.1, 0.4, 0.45)))
    >>> from_training(Of(train=train, test=test, protocol={"seconds": 5.0}, instants=(0.0, 0.2, 0.3)))
    {'nearest_training_frame': '1 to 1.5 steps of 0.5 s'}
    """
    train, test = ([frame.time for frame in frames] for frames in (scene.train, scene.test))
    times = sorted({*train, *test})
    if len(times) < 2 or not test:
        return {}
    step = median(b - a for a, b in zip(times, times[1:]))
    gaps = sorted(min(abs(time - at) for at in train) / step for time in test)
    least, most = (f"{gap:.2g}" for gap in (gaps[0], gaps[-1]))
    steps = (least if least == most else f"{least} to {most}") + (" step" if most == "1" else " steps")
    seconds, walk = scene.protocol.get("seconds"), walk_of(scene)
    told = {"nearest_training_frame": f"{steps} of {seconds * step:.3g} s" if seconds else steps}
    if walk is not None and walk[1] is not None:
        told["camera_motion"] = f"{walk[1]:.3g} degrees a second (omega), {walk[0]:.3g} in all"
    return told


@torch.no_grad()
def over_scene(module: DynamicSceneModule, scene: Scene) -> dict[str, str]:
    """Say how many times as fast as what moves the camera of a film goes, by the learned motion; {} where
    there is no film of one camera (``walk_of`` knows no speed), and for methods that do not tell what moves.

    Source: Gao et al., "Monocular Dynamic View Synthesis: A Reality Check" (2022), the full effective
    multi-view factor; here the mean over pairs of images one after the other.
    """
    method, frames = module.method, sorted(scene.train, key=lambda frame: frame.time)
    walk, tells = walk_of(scene), isinstance(method, HasLayers) and isinstance(method, HasEllipsoids)
    if walk is None or walk[1] is None or not tells:
        return {}
    rows, ratios = method.in_motion(scene.train), []
    if not bool(rows.any()):
        return {}
    for i in spread(len(frames) - 1, _PAIRS):
        first, second = frames[i], frames[i + 1]
        before, after = (method.ellipsoids(frame.time).centers[rows] for frame in (first, second))
        went = float((after - before).norm(dim=-1).mean())
        if went > 0:
            ratios.append(float((second.camera.center - first.camera.center).norm()) / went)
    if not ratios:
        return {}
    of = "times as fast as what moves (Omega, by the learned motion)"
    return {"camera_over_scene": f"{fmean(ratios):.2g} {of}"}


def mean_scores(module: DynamicSceneModule, targets: Sequence[Target], suite: ImageSuite) -> dict[str, float]:
    """Return the mean scores of the views' best renderings; write nothing."""
    rows = [_score(view, suite)["scores"] for view in draw(module, targets)]
    return summarise(("all", row) for row in rows).get("all", {})


@torch.no_grad()
def flow_error(module: DynamicSceneModule, scene: Scene) -> dict | None:
    """Return end-point errors of the learned trajectories, world units; None without them or true ones."""
    truth = scene.truth
    if truth is None or not isinstance(module.method, HasTrajectories):
        return None
    points, times = truth.points[:, 0].to(module.device), truth.times.float().to(module.device)
    return end_point_error(module.method.trajectories(points, times), truth.points)


@torch.no_grad()
def keypoint_transfer(module: DynamicSceneModule, scene: Scene) -> dict | None:
    """Return dycheck's PCK-T: the share of keypoints that the method carries from one training frame to
    another, less than 5 % of the longer side from where they are seen there; None without keypoints, or a
    method that carries none. The mean over all pairs of frames that see some in common, a frame and itself
    too, of the mean over these.

    Source: Gao et al., "Monocular Dynamic View Synthesis: A Reality Check" (2022).
    """
    frames = [(i, frame) for i, frame in enumerate(scene.train) if frame.keypoints is not None]
    if not frames or not isinstance(module.method, CarriesPixels):
        return None
    shares = []
    for (i, first), (j, second) in product(frames, repeat=2):
        seen = (first.keypoints[:, 2] > 0) & (second.keypoints[:, 2] > 0)
        if not bool(seen.any()):
            continue
        camera = first.camera
        column, row = first.keypoints[seen, :2].floor().long().unbind(-1)
        pixels = row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
        moments = (Moment(f.time, number, f.camera_id) for number, f in ((i, first), (j, second)))
        places, ahead = second.camera.project(module.method.carried(View(camera, pixels), *moments).cpu())
        near = (places - second.keypoints[seen, :2]).norm(dim=-1) < PCK * max(camera.width, camera.height)
        shares.append(float((near & (ahead > 0)).float().mean()))
    return {"pck_t": fmean(shares), "pairs": len(shares)} if shares else None


def reduced_rendering(
    rendering: Rendering, shape: tuple[int, int], by: int, background: Tensor, straight: bool
) -> Rendering:
    """Average each block of ``by`` x ``by`` pixels of a whole rendered image.

    Images with alpha are stored straight and averaged before the alpha is applied, which darkens
    silhouettes; so is the rendering then, or it would be compared with another outline than it was fitted to.

    Args:
        rendering: of the whole image, over ``background``.
        shape: its (height, width).
        by: side of a block; it divides both.
        background: colour (3,) behind the image.
        straight: whether the scene's images have alpha.
    """
    rgb = rendering.rgb.clamp(0, 1).reshape(*shape, 3)
    opacity = rendering.opacity.clamp(0, 1).reshape(*shape, 1)
    alpha, background = block_means(opacity, by), background.to(rgb)
    if straight:
        color = (rgb - (1 - opacity) * background) / opacity.clamp(min=_LEAST_ALPHA)
        color = torch.where(opacity < _LEAST_ALPHA, 0.0, color).clamp(0, 1)
        rgb = block_means(color, by) * alpha + (1 - alpha) * background
    else:
        rgb = block_means(rgb, by)
    depth = reduced_depth(rendering.depth.reshape(shape), by)
    return Rendering(rgb.reshape(-1, 3), depth.flatten(), alpha.flatten())


def _image(rendering: Rendering, target: Target) -> Tensor:
    return rendering.rgb.clamp(0, 1).reshape(target.rgb.shape).cpu()


def _score(view: RenderedView, suite: ImageSuite) -> dict:
    """Make the entry of one image: scores of the best rendering, and of the others by name."""
    target, frame, scores = view.target, view.target.frame, {}
    for name, rendering in view.renderings.items():
        depth, image = rendering.depth.reshape(target.rgb.shape[:2]).cpu(), _image(rendering, target)
        scores[name] = suite.score(image, target, depth)
    best, score = scores.popitem()
    parts = scores_of_parts(image, target)
    about = {"name": frame.name, "time": frame.time, "ability": frame.ability, "rendering": best}
    seconds = {"seconds": view.seconds, "seconds_again": view.seconds_again}
    return {**about, **seconds, "scores": score, "parts": parts, "others": scores}


def _save(view: RenderedView, folder: Path, is_on_sheet: bool) -> None:
    best, target = list(view.renderings.values())[-1], view.target
    name, truth, image = f"{target.frame.name}.png", target.rgb, _image(best, target)
    write_png(folder / name, image)
    if is_on_sheet:
        parts = {"sheets": (truth, image, error_colors(truth, image))}
        parts |= {"depth": _depth_parts(best, target)} if target.depth is not None else {}
        for place, of_place in parts.items():
            write_sheet(folder / place / name, of_place)


def write_sheet(path: Path, images: Sequence[Tensor]) -> None:
    """Write images (H, W, 3) beside each other as a PNG, small ones enlarged."""
    write_png(path, in_a_row([at_least(image, _SHEET_SIDE) for image in images]))


def _depth_parts(rendering: Rendering, target: Target) -> list[Tensor]:
    """Draw true depth, rendered depth in the same colours, and by what factor they differ: white is 1.25."""
    true = target.depth
    depth, opacity = (x.reshape(true.shape).cpu() for x in (rendering.depth, rendering.opacity))
    solid = (true > 0).to(true)
    ends = depth_ends(true, solid) or (0.0, 0.0)
    ratio = torch.maximum(depth / true, true / depth.clamp(min=1e-6 * ends[1]))
    over = torch.where(true > 0, ratio - 1, 0.0)[..., None]
    drawn = [depth_colors(true, solid, ends), depth_colors(depth, opacity, ends)]
    return [*drawn, error_colors(over, torch.zeros_like(over))]


def show(metrics: dict, folder: Path) -> None:
    """Print what a user asks for first and the paths of the files: ``metrics.json`` has all numbers, what was
    not measured and why (``absent``), and in ``protocol`` what differs from a publication.
    """
    console, seconds, flow = TextConsole(), metrics["seconds"], metrics.get("flow")
    console.print(table_of(metrics))
    others = ("train", "render_per_frame", "render_again_per_frame")
    stages = ", ".join(f"{name} {time_text(s)}" for name, s in seconds.items() if name not in others)
    lines = []
    if "train" in seconds:
        lines.append(f"trained {time_text(seconds['train'])}" + (f" ({stages})" if stages else ""))
    if others[1] in seconds:  # not of images that another program rendered
        frame, again = (f"{seconds[name]:.3g} s" for name in others[1:])
        lines[-1] += f", {frame} a frame, {again} another at the same time"
    if flow and flow["epe_moving"] is not None:
        error, motion = flow["epe_moving"], flow["motion_mean"]
        share = f"{error / motion:.0%} of their motion {motion:.4f}"
        lines.append(f"flow: moving points off by {error:.4f}, {share}")
    if keypoints := metrics.get("keypoints"):
        lines.append(f"keypoints: {keypoints['pck_t']:.1%} carried to within {PCK:.0%} of an image (PCK-T)")
    lines += [f"numbers  {folder / 'metrics.json'}", f"images   {folder / 'images'}"]
    if (sheets := folder / "images" / "sheets").is_dir():
        lines.append(f"sheets   {sheets}: truth | prediction | error")
    console.print("\n".join(lines), highlight=False, soft_wrap=True)


def table_of(metrics: dict) -> Table:
    """Make a table with a row for every rendering and kind of test view, and a column for every metric."""
    kinds = {key: value for key, value in metrics.items() if key.split("_")[0] == "test"}
    measured = {name for kind in kinds.values() for scores in kind.values() for name in scores}
    names = [name for name in METRICS if name in measured - {*NOT_PRINTED}]
    title = f"{metrics['protocol']['scene']}, {metrics['protocol'].get('method', '')}"
    table = Table("test views", title=title, title_justify="left", box=box.SIMPLE)
    for name in names:
        table.add_column(name.replace("depth_delta_", "depth<"), justify="right")
    for key, kind in kinds.items():
        suffix = key.removeprefix("test").replace("_", " ")
        for ability, scores in kind.items():
            cells = [f"{scores[name]:.{METRICS[name].digits}f}" if name in scores else "" for name in names]
            table.add_row(ability + suffix, *cells)
    return table


def device_name(device: torch.device) -> str:
    """Return the model name of the GPU or of the processor."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    about = _PROCESSOR.read_text() if _PROCESSOR.is_file() else ""
    named = re.search(r"^model name\s*:[ \t]*(.*\S)", about, re.MULTILINE)
    return named[1] if named else platform.processor() or platform.machine()
