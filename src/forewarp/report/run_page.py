"""Write the page of one run: what it shows, how good it is, how it came about. It fetches nothing."""

from __future__ import annotations

import base64
import hashlib
import math
import re
import shlex
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

from markupsafe import Markup, escape

from forewarp.files import MOST_ARRAYS, check_size, read_rows, replace_file, write_json
from forewarp.metrics.registry import metric_of
from forewarp.progress import time_text
from forewarp.report.choices import seconds_to
from forewarp.report.diagnosis import Diagnosis, diagnose, errors_on_sheets
from forewarp.report.figures import sheets_of, thirds
from forewarp.report.results import KINDS, Row, read_run, refused
from forewarp.report.tables import TEMPLATES, Column, Table, rendered, score_columns

if TYPE_CHECKING:  # so that what is refused waits for no torch
    from torch import Tensor

WHYS = "best", "median", "worst"  # views to look at, as they are shown
PARTS = "truth", "prediction", "error"  # of a sheet
# Videos in the order in which one of a folder is taken.
FILMS = {
    "lean": "a slow figure of eight about where the camera was, within the angle that is trusted",
    "stabilised": "where the camera was, smoothed",
    "as_filmed": "as it was filmed",
    "both": "once around the scene while its time passes",
    "trajectories": "one camera, with the paths of points on the moving surface",
    "swing": "to and fro between the training cameras while the scene's time passes",
    "fixed": "one camera, through the scene's time",
    "orbit": "once around the scene at one time",
}
DRAWN, LISTED, LOSSES = 400, 1000, 150  # at most: views in a chart and in the table, points of a stage's loss
PICTURES = 0.6  # share of the room that pictures may take; the video has the rest
LADDER = ((800, 92), (640, 90), (480, 88), (320, 80), (200, 70), (120, 60))  # most pixels of a side, quality
THUMB, SMALL = (96, 70), (240, 80)  # of the choice of a view, and of those that are listed as the worst
_POSTER = 320, 60  # of what is shown until the player has come: most pixels of a side, quality
NOTES = 1000  # bytes that are kept for what the page says about sizes


@dataclass(frozen=True)
class Shown:
    """A view: why it is shown, what it is, and its pictures (H, W, 3) in [0, 1]: ``truth``, ``prediction``,
    ``error`` and ``depth``, or some of them. ``side``: pixels of the longer side of the view that was scored,
    where the pictures were rendered smaller; 0: as they are.
    """

    why: str
    about: str
    pictures: Mapping[str, Tensor]
    side: int = 0


@dataclass
class Media:
    """What a page shows: views, the file of a video and what is to be seen in it; what is missing and why.

    ``diagnosis`` says where the error is, and ``worst`` shows the views that it lists, each ``why`` its name.
    A ``player`` is a page that plays the scene, shown in place of a video; ``scripts`` are the hashes of its
    scripts, as a policy names them; ``poster`` is the address of a small image, shown until the player has
    come, and ``shape`` the player's width by its height.
    """

    views: Sequence[Shown] = ()
    video: Path | None = None
    about: str = ""
    missing: Sequence[str] = ()
    player: str = ""
    scripts: Sequence[str] = ()
    poster: str = ""
    shape: float = 1.0
    diagnosis: Diagnosis | None = None
    worst: Sequence[Shown] = ()

    def play(
        self,
        player: str,
        scripts: Sequence[str],
        room: float,
        poster: Tensor | None = None,
        framed: bool = False,
    ) -> bool:
        """Take a player in place of a video, if it is no larger than a video's share of ``room`` bytes.

        Args:
            player, scripts: see the class.
            room: see ``room_of``.
            poster: what it begins with, (H, W, 3) in [0, 1].
            framed: it has the poster's shape, not a square one.
        """
        from forewarp.drawing.images import at_most, jpeg_bytes

        if len(escape(player).encode()) > (1 - PICTURES) * room:
            return False
        self.player, self.scripts, self.video = player, scripts, None
        if poster is not None:
            self.poster = _address("image/jpeg", jpeg_bytes(at_most(poster.cpu(), _POSTER[0]), _POSTER[1]))
            self.shape = poster.shape[1] / poster.shape[0] if framed else 1.0
        return True


def read_story(folder: Path) -> Row:
    """Read a run's folder; parts whose files are missing are empty.

    Returns:
        the row of ``results.read_run`` with ``unfinished`` stages, ``trained`` (seconds of all stages, or as
        far as the curve goes), ``loss`` by stage (seconds of training, mean loss), and ``consists``: of what
        the method consists and how many there were at the end, as ("particles", 2874); None if unknown.

    Raises:
        ValueError: in one line, if the folder holds no run, several runs, or one that cannot be read.
    """
    if not (config := folder / "config.yaml").is_file():
        runs = sorted(path.parent for depth in ("*", "*/*") for path in folder.glob(f"{depth}/config.yaml"))
        if not runs:
            expected = "the configuration of a run, but got none; set run=<a run's folder>"
            raise ValueError(f"{config}: expected {expected}")
        some = ", ".join(map(str, runs[:3])) + ", ..." * (len(runs) > 3)
        got = f"{folder}, which holds {len(runs)}; choose one: {some}"
        raise ValueError(f"run: expected the folder of one run, but got {got}")
    with refused(f"run: expected a run whose files can be read, but got {folder} (", ")"):
        row = read_run(folder)
        planned = row["config"].get("stage") or row["stages"]
        stages = [name for name, stage in planned.items() if stage is not None]
        if others := [name for name in planned if not re.fullmatch(r"\w[\w-]*", str(name))]:
            raise ValueError(f"stage: expected names of letters, digits, _ and -, but got {others[0]!r:.80}")
        _ = [(d["choice"], d["on"], d["because"]) for d in (row["plan"].get("effects") or {}).values()]
        finished = sum(float(done["seconds"]) for done in row["stages"].values())
        row["trained"] = max([finished, *(point.seconds for point in row["points"])])
        row["unfinished"] = [name for name in stages if name not in row["stages"]]
        row["loss"] = _read_losses(row, stages)
        sizes = row["metrics"].get("size") or {}
        row["consists"] = next((of for of in sizes.items() if of[0] in ("particles", "voxels")), None)
    return row


def _read_losses(row: Row, stages: Sequence[str]) -> dict[str, list[tuple[float, float]]]:
    """Read each stage's loss from what a logger wrote, against seconds of training."""
    losses, before, moments = {}, 0.0, read_rows(row["folder"] / "accuracy_time.csv")
    logged, first = _loss(row["folder"]), 0
    for stage in stages:
        done = row["stages"].get(stage)
        last = math.inf if done is None else first + int(done["steps"])
        loss = [(step - first, value) for step, value in logged if first < step <= last]
        first = last
        # The known moments of a stage: its step -> seconds of training over all stages.
        known = {int(m["step"]): float(m["seconds"]) for m in moments if m.get("stage") == stage}
        known.setdefault(0, before)
        if done is not None:
            before += float(done["seconds"])
            known[int(done["steps"])] = before
        if loss and len(known) > 1:
            steps, many = sorted(known.items()), -(-len(loss) // LOSSES)
            points = [(_between(steps, step), value) for step, value in loss]
            parts = [points[i : i + many] for i in range(0, len(points), many)]
            losses[stage] = [(fmean(t for t, _ in part), fmean(v for _, v in part)) for part in parts]
    return losses


def _loss(run: Path) -> list[tuple[int, float]]:
    """Return (step of the run, loss) of TensorBoard's events, or else of the CSV logger's rows."""
    folder = run / "tensorboard"
    if not folder.is_dir():
        rows = [row for row in read_rows(run / "csv" / "metrics.csv") if row.get("train/loss")]
        return [(int(row["step"]), float(row["train/loss"])) for row in rows]
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    kept = {"scalars": 0, "images": 1, "tensors": 1, "histograms": 1, "audio": 1, "compressedHistograms": 1}
    for file in folder.rglob("*tfevents*"):
        check_size(file, MOST_ARRAYS)
    try:
        events = EventAccumulator(str(folder), size_guidance=kept).Reload()
    except Exception as error:  # of protobuf's and TensorBoard's own kinds
        got = f"others ({type(error).__name__}); delete the folder"
        raise ValueError(f"{folder}: expected events of TensorBoard, but got {got}") from error
    found = events.Scalars("train/loss") if "train/loss" in events.Tags()["scalars"] else []
    return sorted({event.step: event.value for event in found if math.isfinite(event.value)}.items())


def _between(known: Sequence[tuple[int, float]], step: int) -> float:
    """Return the seconds at a step, on straight lines between the known moments and beyond the last."""
    at = min(max(bisect_left(known, (step, -math.inf)), 1), len(known) - 1)
    (low, begin), (high, end) = known[at - 1], known[at]
    return begin + (end - begin) * (step - low) / (high - low)


def best_median_worst(images: Sequence[dict]) -> dict[str, str]:
    """Choose the views to look at: the best, the middle one and the worst by PSNR.

    >>> seen = [{"name": n, "psnr": p} for n, p in (("a", 30), ("b", 20), ("c", 40))]
    >>> best_median_worst(seen), best_median_worst(seen[:2])
    ({'c': 'best', 'a': 'median', 'b': 'worst'}, {'a': 'best', 'b': 'worst'})
    """
    ranked = [image["name"] for image in sorted(images, key=lambda image: (-image["psnr"], image["name"]))]
    names = [ranked[0], ranked[-1], ranked[len(ranked) // 2]] if images else []
    chosen: dict[str, str] = {}
    for why, name in zip(("best", "worst", "median"), names):
        chosen.setdefault(name, why)
    return dict(sorted(chosen.items(), key=lambda item: WHYS.index(item[1])))


def media_of(row: Row, path: str | None = None) -> Media:
    """Return what the folder has: truth, prediction and error of views, where the error is as far as these
    tell, and a video made after training.

    Of the best, the median and the worst view those that have a sheet; then others, named for what they are
    among those with one; without any the last picture that training drew.

    Args:
        row: the run.
        path: the video, one of ``FILMS``; None: the first there is.
    """
    from forewarp.drawing.images import read_image

    sheets, shown = sheets_of(row["folder"]), []
    drawn = [image for image in row["images"] if image["name"] in sheets]
    chosen = {name: f"{why} of {len(drawn)} drawn" for name, why in best_median_worst(drawn).items()}
    chosen |= {name: why for name, why in best_median_worst(row["images"]).items() if name in sheets}
    files = [(why, about(row, name), sheets[name]) for name, why in chosen.items()]
    files.sort(key=lambda file: WHYS.index(file[0].split()[0]))
    for stage in () if files else [*row["config"].get("stage", {})][::-1]:
        for file in sorted((row["folder"] / stage / "images").glob("*_compare.png"))[-1:]:
            told = f"stage {stage} at {int(file.stem.split('_')[0])} %"
            files = files or [("in training", told, file)]
    shown = [Shown(why, told, dict(zip(PARTS, thirds(read_image(file))))) for why, told, file in files]
    media = Media(shown, diagnosis=diagnose(row, errors_on_sheets(row)))
    worst = media.diagnosis.worst if media.diagnosis else ()
    listed = [view["name"] for view in worst if view["name"] in sheets]
    media.worst = [triple(name, *thirds(read_image(sheets[name]))) for name in listed]
    done = max((file.stat().st_mtime_ns for file in row["folder"].glob("*/done.json")), default=0)
    for name in [path] if path else FILMS:
        file = row["folder"] / "videos" / f"{name}.mp4"
        if file.is_file() and file.stat().st_mtime_ns >= done:
            media.video, media.about = file, FILMS[name]
            break
    return media


def triple(name: str, *pictures: Tensor) -> Shown:
    """Show a view that is among the worst: its truth, prediction and error (H, W, 3), made small."""
    from forewarp.drawing.images import at_most

    small = dict(zip(PARTS, (at_most(picture, SMALL[0]) for picture in pictures)))
    return Shown(name, "one of the worst", small)


def about(row: Row, name: str) -> str:
    """Say which view it is: name, time and PSNR."""
    image = next(image for image in row["images"] if image["name"] == name)
    return f"{name}, time {image['time']:.2f}, {image['psnr']:.1f} dB"


def write_run_page(file: Path, row: Row, media: Media, *, megabytes: float) -> int:
    """Write the page of a run, and beside it what its diagnosis says, as ``.json``.

    Args:
        file: of the page.
        row: what the run's folder tells, as of ``read_story``.
        media: what to show of it.
        megabytes: most of the page, in 10^6 bytes; pictures and the video are made smaller, or left out.

    Returns:
        bytes written.

    Raises:
        ValueError: see ``room_of``.
    """
    text = page(row, media, *encoded(media, room_of(row, media, megabytes))).encode()
    replace_file(file, text)
    if media.diagnosis is not None:
        write_json(file.with_suffix(".json"), {"run": near(str(row["folder"])), **media.diagnosis.data()})
    return len(text)


def room_of(row: Row, media: Media, megabytes: float) -> float:
    """Return the bytes that a page of so many 10^6 bytes has for pictures and the video.

    Raises:
        ValueError: in one line, if the text alone is larger, or the run's files hold what no page can show.
    """
    views = [dict.fromkeys([*shown.pictures, "thumb"], "") for shown in (*media.views, *media.worst)]
    with refused(f"run: expected a run whose files can be shown, but got {row['folder']} (", ")"):
        bare = len(page(row, media, views, "data:" if media.video else "").encode()) + NOTES
    room = 1e6 * megabytes - bare
    if room < 0:
        expected = f"room for the page's text, {bare / 1e6:.2f}"
        raise ValueError(f"megabytes: expected {expected}, but got {megabytes}; raise it")
    return room


def encoded(media: Media, room: float) -> tuple[list[dict[str, str]], str, str, str]:
    """Encode pictures and video into at most ``room`` bytes of the page.

    Returns:
        as ``data:`` addresses the pictures and ``thumb`` of each view, the pictures of each of the worst, and
        the video, "" for none; what became of the pictures and of the video so that they fit.
    """
    from forewarp.drawing.images import at_most, jpeg_bytes, video_within

    def jpeg(picture: Tensor, side: int, quality: int) -> str:
        return _address("image/jpeg", jpeg_bytes(at_most(picture.cpu(), side), quality))

    pictures = [picture for shown in (*media.views, *media.worst) for picture in shown.pictures.values()]
    largest = max([*(shown.side for shown in media.views), *(max(p.shape[:2]) for p in pictures)], default=0)
    views, note, left = [], "left out, as the page has no room for them; raise megabytes", room
    for side, quality in LADDER if pictures else ():
        found = []
        for shown in media.views:
            thumb = jpeg(next(iter(shown.pictures.values())), *THUMB)
            found.append({n: jpeg(p, side, quality) for n, p in shown.pictures.items()} | {"thumb": thumb})
        for shown in media.worst:
            found.append({n: jpeg(p, *map(min, SMALL, (side, quality))) for n, p in shown.pictures.items()})
        size = sum(len(text) for view in found for text in view.values())
        if size <= (PICTURES * room if media.video else room):
            smaller = f", scaled from {largest} to {side} pixels" if largest > side else ""
            views, note, left = found, f"JPEG of quality {quality}{smaller}", room - size
            break
    if not media.video:
        return views, "", note, ""
    most = int(0.75 * left) - 100  # base64 takes four bytes for three
    video, video_note = video_within(media.video, most)
    return views, _address("video/mp4", video) if video else "", note, video_note


def _address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def page(
    row: Row, media: Media, views: Sequence[dict], video: str, pictures_note: str = "", video_note: str = ""
) -> str:
    """Return the page as HTML; see ``encoded`` for views, video and notes."""
    script, images = (TEMPLATES / "run_page.js").read_text(), row["images"][:LISTED]
    kinds = [{"kind": KINDS.get(kind, kind), "scores": scores} for kind, scores in row["test"].items()]
    images = [image | {"kind": KINDS.get(image["ability"], image["ability"])} for image in images]
    values = {"row": row, "media": media, "views": list(zip(media.views, views)), "video": video}
    values["worst"] = {shown.why: (shown, v) for shown, v in zip(media.worst, views[len(media.views) :])}
    values |= {"pictures_note": pictures_note, "video_note": video_note, "near": near, "time_text": time_text}
    values |= {"protocol": row["metrics"].get("protocol", {}), "flow": row["metrics"].get("flow") or {}}
    values |= {"by_time": _of_views(row["images"]), "charts": [*_accuracy(row), *_losses(row)]}
    values |= {
        "diagnosis": media.diagnosis,
        "effects": _effects(row),
        "abilities": KINDS,
        "metric_of": metric_of,
    }
    values |= {"budget": row["config"]["budget"], "folder": shlex.quote(near(str(row["folder"])))}
    values |= {"scores": _score_table(kinds, {"kind": "test views"})}
    values |= {"listed": _score_table(images, {"name": "view", "kind": "kind", "time": Column("time", 3)})}
    values |= {"style": Markup((TEMPLATES / "run_page.css").read_text()), "script": Markup(script)}
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return rendered("run_page.html.j2", digest=digest, **values)


def _score_table(rows: Sequence[dict], heads: Mapping[str, Column | str]) -> Table:
    """Make a table of rows with ``scores``, and what they begin with."""
    columns = score_columns(dict.fromkeys(name for row in rows for name in row["scores"]), with_unit=True)
    return Table.of([row["scores"] | row for row in rows], {**heads, **columns})


def near(text: str) -> str:
    """Write folders below the current one relative to it, as a page may be passed on."""
    return re.sub(rf"(?<![\w.:/~-]){re.escape(str(Path.cwd()))}/(?=\w)", "", text)


def _effects(row: Row) -> list[dict]:
    """List the effects, those that are on first: ``name``, ``on``, ``choice`` ("": unknown), ``because``."""
    switched, planned = row["metrics"].get("effects") or {}, row["plan"].get("effects") or {}
    try:
        words = shlex.split(row["command"])
    except ValueError:  # no closing quote
        words = row["command"].split()
    typed = {word.split("=")[0].lstrip("+~"): word for word in words if "=" in word}
    chosen = [typed[key] for key in ("ablation", "experiment", "scene", "preset") if key in typed]
    of = f"with {' '.join(chosen)}" if chosen else "by default"
    default = f"As model={row['method']} has it {of}."
    effects = []
    for name in dict.fromkeys([*planned, *switched]):
        decision = planned.get(name)
        on = switched.get(name, decision["on"] if decision else False)
        if decision is not None and on == decision["on"]:
            choice, because = decision["choice"], str(decision["because"])
        else:
            own = [typed[key] for key in (f"model/{name}", f"model.{name}") if key in typed]
            choice = row["config"]["model"].get(name)
            because = f"Typed: {' '.join(own)}." if own else default
        # Numbers, switches and parts say nothing without their key.
        choice = choice if isinstance(choice, str) and choice != "none" else ""
        effects.append({"name": name.replace("_", " "), "on": on, "choice": choice, "because": near(because)})
    return sorted(effects, key=lambda effect: not effect["on"])


class Axis:
    """An axis of a chart.

    Args:
        title: beside it.
        values: what it must hold; of a logarithmic axis > 0.
        ends: where it begins and ends, in pixels.
        margin: share of the range of the values that is left free.
        log: whether it is logarithmic.
    """

    def __init__(
        self, title: str, values: Sequence[float], ends: tuple[int, int], margin: float, log: bool = False
    ) -> None:
        self.title, self.ends, self.log = title, ends, log
        scaled = [math.log10(value) if log else value for value in values]
        low, high = min(scaled), max(scaled)
        free = margin * (high - low) or max(abs(high), 1) * margin
        self.low, self.high = low - free, high + free

    def at(self, value: float) -> float:
        """Return the place of a value, in pixels."""
        share = ((math.log10(value) if self.log else value) - self.low) / (self.high - self.low)
        return round(self.ends[0] + share * (self.ends[1] - self.ends[0]), 1)

    @property
    def ticks(self) -> list[float]:
        """Round numbers within the axis, at most eight."""
        if self.log:
            decades = range(math.floor(self.low), math.ceil(self.high) + 1)
            values = [many * 10.0**decade for decade in decades for many in (1, 2, 5)]
            values = [round(value, 12) for value in values if self.low <= math.log10(value) <= self.high]
            if len(values) > 7:  # powers of ten alone
                values = [value for value in values if f"{value:e}".startswith("1.0")]
            if len(values) >= 2:
                return values[:: -(-len(values) // 7)]
        low, high = (10**end if self.log else end for end in (self.low, self.high))
        rough = (high - low) / 4
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(power * many for many in (1, 2, 5, 10) if power * many >= 0.75 * rough)
        return [round(i * step, 12) for i in range(math.ceil(low / step), math.floor(high / step) + 1)]


def chart(
    title: str,
    says: str,
    series: Sequence[tuple[str, str, list]],
    axes: tuple[str, str],
    *,
    logs: tuple[bool, bool] = (False, False),
    mean: float | None = None,
) -> dict:
    """Place series in a picture, which the template draws as SVG: without script, in the page's colours.

    Args:
        title: above the picture.
        says: what is to be seen, below it.
        series: name ("" for none in the legend), kind (``line`` or ``dots``) and
            points (x, y, text where the pointer rests, "" for none).
        axes: titles of x and y.
        logs: whether they are logarithmic.
        mean: a dashed line at a value of y.
    """
    points, level = [point for _, _, of in series for point in of], [] if mean is None else [mean]
    x = Axis(axes[0], [point[0] for point in points], (50, 446), 0.02, logs[0])
    y = Axis(axes[1], [*level, *(point[1] for point in points)], (226, 14), 0.06, logs[1])
    placed = [(name, kind, [(x.at(a), y.at(b), text) for a, b, text in of]) for name, kind, of in series]
    # The name of the line stands at the end where fewer points lie.
    close = [a for _, _, of in placed for a, b, _ in of if mean is not None and -4 < y.at(mean) - b < 20]
    left = sum(a < x.ends[0] + 100 for a in close) <= sum(a > x.ends[1] - 100 for a in close)
    return {"title": title, "says": says, "series": placed, "x": x, "y": y, "mean": mean, "left": left}


def _of_views(images: Sequence[dict]) -> list[dict]:
    """Show PSNR of views through the scene's time; nothing without views."""
    if not images:
        return []
    by_time, low = (
        sorted(images, key=lambda image: image["time"]),
        min(images, key=lambda image: image["psnr"]),
    )
    # About ``DRAWN`` views, evenly, the last and the lowest too.
    kept = {*range(0, len(images), -(-len(images) // DRAWN)), len(images) - 1, by_time.index(low)}
    drawn, told = [by_time[i] for i in sorted(kept)], "{name}, time {time:.3f}: {psnr:.2f} dB"
    kinds, series = list(dict.fromkeys(image["ability"] for image in images)), []
    for kind in kinds:
        points = [(v["time"], v["psnr"], told.format(**v)) for v in drawn if v["ability"] == kind]
        series.append((KINDS.get(kind, kind) if len(kinds) > 1 else "", "dots", points))
    fewer = f" {len(drawn)} of the {len(images)} views are drawn." * (len(drawn) < len(images))
    axes, mean = ("time in the scene", "PSNR (dB)"), fmean(image["psnr"] for image in images)
    return [chart("Through the scene's time", f"A dot is a test view.{fewer}", series, axes, mean=mean)]


def _accuracy(row: Row) -> list[dict]:
    """Show PSNR while it trained; nothing with less than two points."""
    curve = [point for point in row["points"] if point.seconds > 0 and math.isfinite(point.psnr)]
    if len(curve) < 2:
        return []
    last, seconds = curve[-1], seconds_to(curve, curve[-1].psnr - 1)
    soon = f"; within 1 dB of that after {seconds:.0f} s" if seconds is not None else ""
    says = f"Of views that are not trained on: {last.psnr:.1f} dB after {last.seconds:.0f} s{soon}."
    points = [(p.seconds, p.psnr, f"{p.seconds:.1f} s, step {p.step}: {p.psnr:.2f} dB") for p in curve]
    axes = ("seconds of training", "PSNR (dB)")
    return [chart("PSNR while it learned", says, [("", "line", points)], axes, logs=(True, False))]


def _losses(row: Row) -> list[dict]:
    """Show the loss of every stage; nothing without any."""
    kept = {stage: [(*p, "") for p in points if min(p) > 0] for stage, points in row["loss"].items()}
    series = [(stage, "line", points) for stage, points in kept.items() if points]
    if not series:
        return []
    ends = ", ".join(f"{name} ends at {points[-1][1]:.3g}" for name, _, points in series)
    says = f"What is minimised, averaged over steps; stages may weigh terms differently: {ends}."
    return [chart("Loss", says, series, ("seconds of training", "loss"), logs=(True, True))]
