"""Put images that another program rendered into a folder that reports read as a run's.

They are measured on the scene's test views as our own are.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from forewarp.data.batches import COLORS
from forewarp.data.files import mismatch
from forewarp.data.names import in_order
from forewarp.drawing.images import error_colors, write_png
from forewarp.evaluation.evaluate import from_training, middles, show, write_sheet
from forewarp.files import MOST_IMAGE, load_yaml, read_bytes, refuse_links, replace_file, write_json
from forewarp.media import in_srgb, open_image
from forewarp.metrics.lpips import find_lpips
from forewarp.metrics.registry import ImageSuite, absences, described, scores_of_parts, summarise
from forewarp.progress import Counted
from forewarp.provenance import versions
from forewarp.runs.build import frames_folder
from forewarp.runs.config import make_absolute
from forewarp.runs.overrides import command_of_job
from forewarp.runs.session import locked
from forewarp.scene.frame import spread
from forewarp.scene.view import Target

ELSEWHERE = "rendered elsewhere"
_CHECKED = 64  # most views whose order is checked
_SMALL = 16  # pixels of a side, to which images are averaged before they are compared in all pairs
_CLOSER = 1.5  # times as near: another view's truth is clearly more like an image than its own
_MISPLACED = 0.5  # share of the views
_MEASURED_BY = ("forewarp", "torchmetrics")  # whose versions count; others trained and rendered
_FAR, _NEAR = 0.25, 0.1  # mean difference of colours: another background, this background
_ROUNDING = 1.01 / 255  # of any pixel: what writing an image and reading it again may change
_COPIED = 0.5  # share of the views


def measure_elsewhere(config: DictConfig) -> dict:
    """Measure the images of ``renders``; write a run's ``config.yaml``, ``metrics.json`` and images.

    Args:
        config: composed for ``forewarp-evaluate``, with ``renders``, ``name``, ``data`` and ``run``.

    Returns:
        the content of ``metrics.json``.

    Raises:
        SceneError: for images that do not fit the test views.
        ValueError: if the folder ``run`` holds something else.
    """
    folder, renders = Path(config.run), Path(config.renders).expanduser().resolve()
    make_absolute(config)
    stored = {
        "renders": str(renders),
        "command": command_of_job("evaluate"),
        "run": str(folder),
        "model": {"name": config.name},
        "preset": {"name": ELSEWHERE},
        "seed": config.seed,
        "budget": {"minutes": config.minutes, "iterations": None, "clock": "wall"},
        "data": OmegaConf.to_container(config.data, resolve=True, throw_on_missing=True),
    }
    _refuse_another(folder, config.name)
    datamodule = instantiate(config.data, _convert_="all")
    datamodule.frames_folder = frames_folder(config)
    datamodule.setup("test")
    given = {"method": config.name, "preset": ELSEWHERE, "seed": config.seed, "minutes": config.minutes}
    given |= {"clock": "wall", "device": config.device, "megabytes": config.megabytes, "images": ELSEWHERE}
    protocol = {key: value for key, value in given.items() if value is not None}
    mask_box = datamodule.scene.protocol.get("mask_box", False)
    suite = ImageSuite(find_lpips(extra=config.lpips_weights), mask_box=mask_box)
    files = matched(datamodule.targets("test"), renders, config.views, datamodule.targets("train"))
    options = {"protocol": protocol, "minutes": config.minutes, "sheets": config.sheets}
    with locked(folder), Counted("test views") as progress:
        metrics = measure_renders(datamodule, files, folder, suite, progress=progress, **options)
        if (files := datamodule.fingerprint()) is not None:
            write_json(folder / "data.json", files)
        replace_file(folder / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(stored)))
    show(metrics, folder)
    return metrics


def _refuse_another(folder: Path, name: str) -> None:
    """Refuse a folder that holds anything but images of this method, measured before."""
    refuse_links(folder)
    files = [path for path in folder.iterdir() if path.name[0] != "."] if folder.is_dir() else []
    if not files:
        return
    other = load_yaml(folder / "config.yaml") if (folder / "config.yaml").is_file() else None
    if not isinstance(other, dict) or other.get("renders") is None or other.get("model") != {"name": name}:
        expected, got = f"an empty folder, or images of {name}", "one with other files"
        raise mismatch(f"run: {folder}", expected, got, "set run=FOLDER")


def files_of(folder: Path, names: Sequence[str]) -> list[Path]:
    """Find the image of each test view: by its name, else by the order of the numbers in the files' names.

    Args:
        folder: holds PNG files, and may hold others.
        names: of the test views, in order. A name such as ``test/r_000`` is that of ``test/r_000.png`` or of
            ``r_000.png``.

    Raises:
        SceneError: where some views have no image, or neither names nor the number of files fit.
    """
    if not folder.is_dir():
        raise mismatch(
            "renders", "a folder of PNG images, one for each test view", f"{folder}, which is none"
        )
    short = [PurePosixPath(name).name for name in names]
    for called in (names, short) if len(set(short)) == len(short) else (names,):
        files = [folder / f"{name}.png" for name in called]
        there = [file.is_file() for file in files]
        if all(there):
            return files
        if any(there):
            expected, got = f"images of all {len(names)} test views", f"none in {files[there.index(False)]}"
            raise mismatch("renders", expected, got, "render the test views that are missing")
    files = in_order((path for path in folder.iterdir() if path.suffix.lower() == ".png"), lambda p: p.name)
    if len(files) != len(names):
        expected = (
            f"{len(names)} PNG images, one for each test view, called {short[0]}.png or numbered in order"
        )
        raise mismatch(folder, expected, len(files), "render all test views of this scene, and nothing else")
    return files


def read_render(file: Path, target: Target) -> Tensor:
    """Read an image (H, W, 3) in [0, 1]; where it has alpha, its colours, not multiplied by it, lie over the
    target's background.

    Raises:
        SceneError: for another file than a PNG of 8 bits a channel, and one of another size than the target.
    """
    try:
        image = open_image(io.BytesIO(read_bytes(file, MOST_IMAGE)))
        mode, kind = image.mode, image.format
        pixels = np.array(in_srgb(image, "RGBA"))
    except (OSError, SyntaxError, ValueError) as error:
        raise mismatch(file, "a PNG image", f"another file ({error})", "write it anew") from error
    if kind != "PNG" or mode not in ("RGB", "RGBA", "P", "L", "LA"):
        raise mismatch(file, "a PNG of 8 bits a channel", f"{kind} of mode {mode}", "write it anew")
    (height, width), got = target.rgb.shape[:2], pixels.shape[:2]
    if got != (height, width):
        sizes = f"{width} x {height} pixels, as the test view {target.frame.name}", f"{got[1]} x {got[0]}"
        advice = "render at that size, or measure at yours by data.half_resolution=false or data.scale=1"
        raise mismatch(file, *sizes, advice)
    image = torch.from_numpy(pixels).float().div_(255)
    alpha = image[..., 3:]
    return image[..., :3] * alpha + (1 - alpha) * target.background.to(image)


def check_renders(files: Sequence[Path], targets: Sequence[Target], trained: Sequence[Target] = ()) -> None:
    """Refuse images that are clearly the scene's own, of the test views in another order, or on the other
    background.

    An image is out of order if it is far more like the truth of another view than like its own, and no other
    image is as like that truth; refused where this holds of half of the views. It is the scene's own if no
    pixel differs from its view's truth, or from the training view of its name, by more than rounding.

    Args:
        files: an image for each target.
        targets: test views.
        trained: training views.

    Raises:
        SceneError: naming an image and the view that it shows, the key of the background, or what was given
            in place of renders.
    """
    shown, truths, behind, copied = [], [], [], {"test": 0, "training": 0}
    numbers = {PurePosixPath(frame.name).name: n for n, frame in enumerate(trained.frames)} if trained else {}
    for file, target in zip(files, targets):
        image = read_render(file, target)
        if _is_copy(image, target):
            copied["test"] += 1
        elif (number := numbers.get(file.stem)) is not None:
            copied["training"] += _is_copy(image, trained[number])
        shown.append(_averaged(image))
        truths.append(_averaged(target.rgb))
        if target.foreground is not None and not bool(target.foreground.all()):
            behind.append(image[~target.foreground].mean(0))
    for kind, count in copied.items():
        if count > _COPIED * len(shown):
            got = f"the {kind} images themselves ({count} of {len(shown)})"
            advice = "set renders= to the folder of its images, often called renders"
            if (beside := files[0].parent.with_name("renders")).is_dir() and beside != files[0].parent:
                advice = f"set renders={beside}"
            raise mismatch(f"renders: {files[0].parent}", "images of a method", got, advice)
    if behind:
        _check_background(torch.stack(behind).mean(0), targets[0].background, files[0].parent)
    apart = torch.cdist(torch.stack(shown), torch.stack(truths)).square()
    best = apart.argmin(1)
    mutual = apart.argmin(0)[best] == torch.arange(len(best))
    wrong = (mutual & (apart.diagonal() > _CLOSER * apart.gather(1, best[:, None])[:, 0])).nonzero()[:, 0]
    if len(wrong) and len(wrong) >= _MISPLACED * len(best):
        i, of = int(wrong[0]), f"{len(wrong)} of {len(best)} images are like this"
        expected = f"{files[i].name} to show the test view {targets[i].frame.name}"
        got = f"an image of {targets[int(best[i])].frame.name} ({of})"
        raise mismatch(files[i].parent, expected, got, "give images the names of their test views")


def _is_copy(image: Tensor, target: Target) -> bool:
    """Tell whether an image is a target's own; one of a single colour tells nothing."""
    truth = target.rgb
    is_plain = bool((truth == truth[0, 0]).all())
    return not is_plain and image.shape == truth.shape and float((image - truth).abs().max()) <= _ROUNDING


def _check_background(mean: Tensor, wanted: Tensor, folder: Path) -> None:
    named = {name: torch.tensor(color) for name, color in COLORS.items()}
    ours = next((name for name, color in named.items() if torch.equal(color, wanted.float())), "the same")
    for name, color in named.items():
        if float((mean - wanted).abs().mean()) > _FAR and float((mean - color).abs().mean()) < _NEAR:
            advice = f"render on {ours}, or measure on {name}: data.eval_background={name}"
            raise mismatch(
                folder, f"images on {ours}, as test views are measured", f"images on {name}", advice
            )


def matched(
    targets: Sequence[Target], renders: Path, views: int | None = None, trained: Sequence[Target] = ()
) -> dict[int, Path]:
    """Match the images of a folder to the test views to measure, and check them (``check_renders``).

    Args:
        targets: the test views.
        renders: folder of the images, see ``files_of``.
        views: most test views to measure, evenly spread; None: all.
        trained: the training views.

    Returns:
        the image of each view to measure, by the view's index.

    Raises:
        SceneError: for images of other views, sizes, orders or backgrounds, and for the scene's own.
    """
    files = files_of(renders, [frame.name for frame in targets.frames])
    chosen = middles(len(targets), views)
    checked = [chosen[i] for i in spread(len(chosen), _CHECKED)]
    check_renders([files[i] for i in checked], [targets[i] for i in checked], trained)
    return {number: files[number] for number in chosen}


def measure_renders(
    datamodule,
    files: Mapping[int, Path],
    folder: Path,
    suite: ImageSuite,
    *,
    protocol: Mapping,
    minutes: float | None = None,
    sheets: int = 6,
    progress: Callable[[int, int], None] | None = None,
) -> dict:
    """Measure images of the test views; write ``images/``, ``per_image.json`` and ``metrics.json``.

    Args:
        datamodule: serves ``scene`` and ``targets("test")``.
        files: the image of each view to measure, as ``matched`` gives them.
        folder: where results go.
        suite: computes the metrics of an image.
        protocol: how the images were made.
        minutes: of training, where they are known.
        sheets: number of images truth | rendering | error, spread over the views.
        progress: called with (images done, all images) after each image.

    Returns:
        the content of ``metrics.json``.
    """
    scene, targets, chosen = datamodule.scene, datamodule.targets("test"), list(files)
    protocol = dict(protocol)
    if len(chosen) < len(targets):
        protocol["measured"] = f"{len(chosen)} of {len(targets)} test views, evenly spread"
    on_sheets, rows = {chosen[i] for i in spread(len(chosen), sheets)}, []
    for number in chosen:
        target = targets[number]
        image, frame = read_render(files[number], target), target.frame
        about = {"name": frame.name, "time": frame.time, "ability": frame.ability, "rendering": ELSEWHERE}
        rows.append({**about, "scores": suite.score(image, target), "parts": scores_of_parts(image, target)})
        write_png(folder / "images" / f"{frame.name}.png", image)
        if number in on_sheets:
            parts = target.rgb, image, error_colors(target.rgb, image)
            write_sheet(folder / "images" / "sheets" / f"{frame.name}.png", parts)
        if progress is not None:
            progress(len(rows), len(chosen))
    scores = [(row["ability"], row["scores"]) for row in rows]
    test = summarise([*scores, *(part for row in rows for part in row["parts"].items())])
    about = {"scene": scene.name, **scene.protocol, **from_training(scene), **protocol, "scored": ELSEWHERE}
    measured_by = {name: version for name, version in versions().items() if name in _MEASURED_BY}
    metrics = {
        "protocol": about | {"versions": measured_by},
        "seconds": {} if minutes is None else {"train": 60 * minutes},
        "test": test,
        "metrics": described(dict.fromkeys(name for of_kind in test.values() for name in of_kind)),
    }
    if lacking := absences([row["scores"] for row in rows], suite.absent):
        metrics["absent"] = lacking
    write_json(folder / "per_image.json", {"images": rows})
    write_json(folder / "metrics.json", metrics)
    return metrics


def _averaged(image: Tensor) -> Tensor:
    """Average an image (H, W, 3) to one vector of ``_SMALL`` x ``_SMALL`` colours."""
    return torch.nn.functional.adaptive_avg_pool2d(image.permute(2, 0, 1), _SMALL).flatten()
