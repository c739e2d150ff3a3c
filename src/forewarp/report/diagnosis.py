"""Say where the error of a run's test views lies, what may be behind it, and the key to try.

Squared errors add up, so that shares of them say what a part accounts for. What a finding ``brings`` at most
is the gain of PSNR, of the mean squared error over all views, if the part were as good as the rest, or the
cause were gone. Findings overlap; their gains do not add up. They describe one run: ``time_blocks`` keeps
from naming what chance may do to views whose neighbours err alike, and nothing is said of other runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import fmean

from forewarp.report.results import KINDS, Row
from forewarp.report.statistics import Estimate, lies_below
from forewarp.report.time_blocks import TENTHS, drop_over_chance, mean_over_chance, tenth_of, worst_stretch

LEAST = 0.3  # dB that a finding must promise
BLURS = 4  # that are tried
# Asked of a run, sharing 5 % of false findings: tenths of the time; between, far; moving, still, outline;
# exposure; blurs.
QUESTIONS = TENTHS + 2 + 3 + 1 + BLURS
FEWEST = 3  # views of a group
WORST = 5  # views that are listed
MOST = 6  # findings that are shown
_BETWEEN = 0.25  # steps from a training time, from which on a view is between two
_FAR, _SPACINGS = 5.0, 2.0  # degrees, and times the spacing of the training cameras
_BEHIND = 2.5 / 255  # by which the colour of a subject differs from that behind it
_MANY_STEPS = 1000.0  # a training image, beyond which more bring ever less
_FEW_STEPS = 10.0  # a training image, below which a curve says nothing about what more would bring


@dataclass(frozen=True)
class Finding:
    """What accounts for a part of the error.

    Attributes:
        kind: one of ``KEYS``.
        text: what it is, in a sentence or two.
        share: of the squared error, in [0, 1], that goes if the cause is gone.
        brings: dB, the same as a gain of PSNR.
        try_: what to type; ``advice`` says what it does.
    """

    kind: str
    text: str
    share: float
    brings: float
    try_: str
    advice: str

    def line(self) -> str:
        """Say it in a line of a terminal."""
        return f"{self.brings:.1f} dB at most: {self.text} Try {self.try_} ({self.advice})."


@dataclass(frozen=True)
class Split:
    """A part of the views or pixels: its shares of them and of the squared error, and its PSNR (dB)."""

    name: str
    of: str
    part: float
    error: float
    psnr: float


@dataclass(frozen=True)
class Diagnosis:
    """Findings, those that may bring most first; ``splits`` of the error; the ``worst`` views; ``views`` that
    the pixels were looked at of, and the training's ``fit``, as far as there is one.
    """

    findings: Sequence[Finding]
    splits: Sequence[Split]
    worst: Sequence[dict]
    views: int
    fit: Mapping[str, float]

    def lines(self) -> list[str]:
        """Say the findings in lines, or that nothing stands out."""
        if not self.findings:
            return [f"why it is not better: {self.nothing}"]
        return ["why it is not better:", *(f"  {f.line()}" for f in self.findings)]

    @property
    def nothing(self) -> str:
        """Say what was looked for in vain, and what was not looked at."""
        text = f"nothing stands out; no part of the error that was looked at would bring {LEAST} dB."
        skipped = ["pixels of test views"] * (not self.views) + ["training images"] * ("psnr" not in self.fit)
        return text + (f" Not looked at: {', '.join(skipped)} (render=false)." if skipped else "")

    def data(self) -> dict:
        """Return all of it as JSON holds it."""
        data = asdict(self)
        data["findings"] = [{key.rstrip("_"): value for key, value in f.items()} for f in data["findings"]]
        return data


def diagnose(
    row: Row, views: Mapping[str, Mapping] | None = None, fit: Mapping[str, float] | None = None
) -> Diagnosis | None:
    """Find out where the error is.

    Args:
        row: the run, as of ``read_story``.
        views: by the name of a test view what there is beside its scores: ``sums`` and ``ratio`` of its
            pixels, as of ``metrics.errors.split_errors``, ``degrees`` to the nearest training camera and
            ``gap``, steps to the nearest training time.
        fit: number of training ``images``, ``spacing`` of their cameras (degrees), ``psnr`` (dB) that they
            are reached to.

    Returns:
        None of a run without scores of views.
    """
    if not row["images"]:
        return None
    views, fit = views or {}, {k: v for k, v in (fit or {}).items() if v is not None}
    images = [image | dict(views.get(image["name"], {})) for image in row["images"]]
    of_views = _Views(images)
    measured = [image for image in images if "sums" in image]
    causes: list[tuple[str, str, float]] = []  # kind, text, share of the error
    splits: list[Split] = []
    flagged: set[str] = set()
    for kind, name, text, chosen, is_sure in _groups(images, fit, of_views):
        if (split := of_views.split(name, chosen)) is None:
            continue
        if split not in splits:
            splits.append(split)
        if is_sure:
            causes.append((kind, f"{text}: {_holds(split, 'views')}", of_views.excess(chosen)))
            flagged |= {image["name"] for image, is_in in zip(images, chosen) if is_in}
    for kind, text, split, share in _of_pixels(measured):
        splits.append(split)
        if share is not None:
            causes.append((kind, text, share))
    causes += _of_causes(measured)
    # An exposure of their own tells test views from training images, too.
    lit = max([share for kind, _, share in causes if kind == "exposure"], default=0.0)
    causes += _of_fit(row, images, fit, flagged, _decibels(1 - lit))
    best: dict[str, tuple[str, str, float]] = {}
    for kind, text, share in causes:  # of each kind the one that may bring most
        if kind not in best or share > best[kind][2]:
            best[kind] = kind, text, share
    findings, steps, limit = [], steps_of(row, fit), limit_of(row, fit)
    for kind, text, share in best.values():
        share = min(max(share, 0.0), 1.0)
        if (brings := _decibels(1 - share)) >= LEAST:
            findings.append(Finding(kind, text, share, brings, *advice(kind, row["config"], steps, limit)))
    findings.sort(key=lambda finding: -finding.brings)
    ranked = sorted(images, key=lambda image: (image["psnr"], image["name"]))[:WORST]
    listed = "name", "time", "psnr", "ability", "degrees", "gap"
    worst = [{key: image[key] for key in listed if key in image} for image in ranked]
    return Diagnosis(findings[:MOST], splits, worst, len(measured), fit)


def errors_on_sheets(row: Row) -> dict[str, dict]:
    """Split the errors of the views that have a sheet: ``sums`` and ``ratio`` by name, for ``diagnose``.

    Of a scene measured before white or black the subject is what has another colour.
    """
    from forewarp.drawing.images import read_image
    from forewarp.metrics.errors import split_errors
    from forewarp.report.figures import sheets_of, thirds

    behind = {"white": 1.0, "black": 0.0}.get(row["metrics"].get("protocol", {}).get("background"))
    views = {}
    for name in {image["name"] for image in row["images"]} & {*(sheets := sheets_of(row["folder"]))}:
        truth, prediction, _ = thirds(read_image(sheets[name]))
        if (file := row["folder"] / "images" / f"{name}.png").is_file():  # sheets repeat pixels
            height = read_image(file).shape[0]
            by = max(1, truth.shape[0] // height)
            truth, prediction = truth[::by, ::by], prediction[::by, ::by]
        foreground = None if behind is None else (truth - behind).abs().amax(-1) > _BEHIND
        sums, ratio = split_errors(prediction, truth, foreground=foreground)
        views[name] = {"sums": sums, "ratio": ratio}
    return views


class _Views:
    """Test views: groups of them against the others. All count alike, as in a mean of PSNR."""

    def __init__(self, images: Sequence[Mapping]) -> None:
        self.psnr = [image["psnr"] for image in images]
        self.errors = [10 ** (-psnr / 10) for psnr in self.psnr]
        self.times = [image["time"] for image in images]
        # Views of a static camera have the very same angle.
        self.cameras = [round(image.get("degrees", i), 6) for i, image in enumerate(images)]

    def split(self, name: str, chosen: Sequence[bool]) -> Split | None:
        """Return what a group's share is; None if it, or the rest, has too few views."""
        count, total = sum(chosen), sum(self.errors)
        if min(count, len(chosen) - count) < FEWEST:
            return None
        inside = sum(error for error, is_in in zip(self.errors, chosen) if is_in)
        return Split(name, "views", count / len(chosen), inside / total, _decibels(inside / count))

    def excess(self, chosen: Sequence[bool]) -> float:
        """Return the share of the error by which a group is worse than the rest."""
        inside, rest = (
            [e for e, is_in in zip(self.errors, chosen) if is_in is side] for side in (True, False)
        )
        return (sum(inside) - len(inside) * fmean(rest)) / sum(self.errors)

    def is_below(self, chosen: Sequence[bool]) -> bool:
        """Tell whether a group lies below the rest in every tenth of the time, beyond chance."""
        return drop_over_chance(self.psnr, self.times, chosen, QUESTIONS) > 1

    def is_below_by_camera(self, chosen: Sequence[bool]) -> bool:
        """Tell the same of cameras: where they are static, each of them is one sample."""
        if len(set(self.cameras)) == len(self.cameras):
            return self.is_below(chosen)
        means: dict[bool, list[float]] = {True: [], False: []}
        for camera in set(self.cameras):
            views = [i for i, name in enumerate(self.cameras) if name == camera]
            means[chosen[views[0]]].append(fmean(self.psnr[i] for i in views))
        inside, rest = Estimate.of(means[True]), Estimate.of(means[False])
        return bool(inside and rest) and lies_below(inside, rest, QUESTIONS)


def _groups(images: Sequence[Mapping], fit: Mapping, views: _Views):
    """Give groups of views: kind, name, words, the views in it, and whether it is surely worse."""
    tenths = [tenth_of(time) for time in views.times]
    worst = worst_stretch(views.psnr, views.times, QUESTIONS, FEWEST) or []
    ends = {"both ends": [0, TENTHS - 1], "the beginning": [0], "the end": [TENTHS - 1]}
    stretches = {f"{name} of the time": stretch for name, stretch in ends.items()}
    others = [
        *([i] for i in range(1, TENTHS - 1)),
        *([worst] if worst and worst not in ends.values() else []),
    ]
    stretches |= {_span(stretch): stretch for stretch in others}
    for name, stretch in stretches.items():
        kind = "ends" if stretch in ends.values() else "stretch"
        chosen = [tenth in stretch for tenth in tenths]
        yield kind, name, f"{name[0].upper()}{name[1:]}", chosen, stretch == worst
    if all("gap" in image for image in images):
        between = [image["gap"] > _BETWEEN for image in images]
    else:
        between = [image["ability"] in ("time", "space_time") for image in images]
    yield "between", KINDS["time"], "Between training times", between, views.is_below(between)
    if all("degrees" in image for image in images):
        least = max(_FAR, _SPACINGS * fit.get("spacing", 0.0))
        chosen = [image["degrees"] > least for image in images]
        words = f"more than {least:.0f} degrees from every training camera"
        yield "far", words, f"Test cameras {words}", chosen, views.is_below_by_camera(chosen)


def _span(stretch: Sequence[int]) -> str:
    return f"time {stretch[0] / TENTHS:.1f} to {(stretch[-1] + 1) / TENTHS:.1f}"


def _of_pixels(measured: Sequence[Mapping]):
    """Give groups of pixels: kind, words, split, and the share of the error by which it is worse, if any."""
    pairs = ("moving", "moving", "still"), ("still", "still", "moving")
    for kind, name, other in (*pairs, ("outline", "outline", "inside"), ("beside", "beside", None)):
        if name == "still" and any("inside" in image["sums"] for image in measured):
            continue  # of a subject before nothing, what is still is no background
        views = [i for i in measured if name in i["sums"] and (other is None or other in i["sums"])]
        both = [image["sums"] for image in views]
        if not both:
            continue
        total, pixels = (sum(sums["all"][i] for sums in both) for i in (0, 1))
        error, count = (sum(sums[name][i] for sums in both) for i in (0, 1))
        if not total:
            continue
        split = Split(PARTS[name], "pixels", count / pixels, error / total, _decibels(error / count))
        if other is None:
            text, share = f"Beside the subject, where nothing is: {_holds(split, 'pixels')}", error / total
            yield kind, text, split, share if len(both) >= FEWEST else None
            continue
        rest = sum(sums[other][0] for sums in both) / sum(sums[other][1] for sums in both)
        worse = [_mean(sums[other]) - _mean(sums[name]) for sums in both]
        text = f"{PARTS[name][0].upper()}{PARTS[name][1:]}: {_holds(split, 'pixels')}"
        text = f"{text[:-1]}, {_decibels(rest) - split.psnr:.1f} dB below {PARTS[other]}."
        yield kind, text, split, (error - count * rest) / total if _surely_above_0(worse, views) else None


PARTS = {"moving": "what moves", "still": "what is still", "outline": "outlines of the subject"}
PARTS |= {"inside": "its inside", "beside": "beside the subject"}


def _of_causes(measured: Sequence[Mapping]) -> list[tuple[str, str, float]]:
    """Say what goes with a gain and an offset of each view, and with a truth as blurred as the rendering.

    What is misplaced or noisy is nearer to a blurred truth, too; but then a blurred rendering is nearer to
    the truth. What that would gain is no blur.
    """
    causes = []

    def after(sums: Mapping, name: str) -> float:
        """The error of a view without a cause."""
        of_noise = sums[name.replace("blur_", "blurrier_")][0] if name.startswith("blur_") else math.inf
        return sums[name][0] + max(sums["all"][0] - of_noise, 0.0)

    def gone(name: str) -> float | None:
        """The share of the error that goes with a cause; None if it may be chance."""
        views = [image for image in measured if name in image["sums"] and image["sums"]["all"][0] > 0]
        both = [(image["sums"]["all"][0], after(image["sums"], name)) for image in views]
        better = [10 * math.log10(before / max(left, 1e-12)) for before, left in both]
        if not _surely_above_0(better, views):
            return None
        return 1 - sum(left for _, left in both) / sum(before for before, _ in both)

    if (share := gone("exposure")) is not None:
        ratios = [image["ratio"] for image in measured]
        low, high = min(ratios), max(ratios)
        text = "Exposure: with a gain and an offset of each view's colours"
        bright = f"the truth is {low:.2f} to {high:.2f} times as bright as the rendering"
        causes.append(("exposure", f"{text} {share:.0%} of the squared error would go; {bright}.", share))
    names = sorted({name for image in measured for name in image["sums"] if name.startswith("blur_")})
    shares = {name: share for name in names if (share := gone(name)) is not None}
    if shares:
        name = max(shares, key=shares.__getitem__)
        text = f"Blur: {shares[name]:.0%} of the squared error is what a blur of"
        text += f" {name.removeprefix('blur_')} pixels takes from the truth."
        causes.append(("blur", text, shares[name]))
    return causes


def _of_fit(
    row: Row, images: Sequence[Mapping], fit: Mapping, flagged: set[str], explained: float
) -> list[tuple[str, str, float]]:
    """Say what more training may bring, and what test views that are not ``flagged`` lack against training
    images, beyond so many dB that are ``explained``.
    """
    causes, steps = [], steps_of(row, fit)
    rise = still_rising(row["points"])
    if steps is not None and (gain := more_steps(steps, rise)) >= LEAST:
        rose = f"PSNR rose by {rise:.1f} dB in the last third of the training; " if rise is not None else ""
        text = f"Short training: {steps:.3g} steps for each training image; {rose}"
        times = "four times" if steps < _FEW_STEPS else "twice"
        text += f"judged by other runs of this project, {times} the time may bring {gain:.1f} dB."
        causes.append(("training", text, 1 - 10 ** (-gain / 10)))
    if not {"psnr", "images"} <= fit.keys():
        return causes
    rest = [image for image in images if image["name"] not in flagged]
    limit = max(_FAR, _SPACINGS * fit.get("spacing", 0.0))
    far = [image["degrees"] for image in rest if image.get("degrees", 0.0) > limit]
    lacks = fit["psnr"] - fmean(image["psnr"] for image in rest) if len(rest) >= FEWEST else 0.0
    lacks -= explained
    share = 1 - 10 ** (-lacks / 10)
    reached = f"training images are reached to {fit['psnr']:.1f} dB, {lacks:.1f} dB above"
    if lacks > 0 and len(far) > len(rest) / 2:
        text = (
            f"Test cameras are far: {min(far):.0f} to {max(far):.0f} degrees from the nearest training camera"
        )
        causes.append(("far", f"{text}; {reached} them.", share))
    elif lacks > 0:
        text = f"Gap between training and test views: the {fit['images']:.0f} {reached} test views."
        causes.append(("overfit", text, share))
    return causes


def steps_of(row: Row, fit: Mapping) -> float | None:
    """Return the steps of all stages for each training image; None if unknown."""
    return row["steps"] / fit["images"] if fit.get("images") else None


def limit_of(row: Row, fit: Mapping) -> str | None:
    """Return the key of the limit that ended the stage of most steps, or the run; None where it is unknown.

    A target that was reached ended the run, whatever its stages had left.
    """
    stages = row["stages"]
    for done in stages.values():
        if reached := (done.get("target") or {}).get("reached"):
            return reached
    if not stages or row.get("unfinished"):
        return None
    name, done = max(stages.items(), key=lambda stage: int(stage[1]["steps"]))
    plans = {key: plan for key, plan in (row["config"].get("stage") or {}).items() if plan is not None}
    plan, budget, limits = plans.get(name, {}), row["config"]["budget"], {}
    part = plan.get("share", 1.0) / (sum(of.get("share", 1.0) for of in plans.values()) or 1.0)
    if budget.get("iterations"):
        limits["budget.iterations"] = budget["iterations"] * part
    if plan.get("steps_per_picture") and fit.get("images"):
        limits[f"stage.{name}.steps_per_picture"] = plan["steps_per_picture"] * fit["images"]
    path = min(limits, key=limits.__getitem__, default=None)
    if path is not None and int(done["steps"]) >= max(1, round(limits[path])):
        return path
    return "budget.minutes" if budget.get("minutes") else None


def still_rising(points: Sequence) -> float | None:
    """Return by how many dB a run's PSNR rose in the last third of its time; None without a curve."""
    curve = [point for point in points if point.seconds > 0 and math.isfinite(point.psnr)]
    before = [point for point in curve if point.seconds <= curve[-1].seconds * 2 / 3]
    return curve[-1].psnr - before[-1].psnr if before else None


def more_steps(steps: float, rise: float | None) -> float:
    """Bound what more training brings, in dB: twice the time, or four times after very few steps.

    Up to 1,000 steps for each training image the bound, 0.5 dB and 40 dB over the steps, at most 5 dB, lies
    above nearly all of what doubling the time brought to this project's runs of eleven methods on nine scenes
    (docs/results). Beyond, where few runs are, its 0.5 dB are taken to fall as steps grow. The rise within a
    run is no measure of it, as learning rates fall at the end of any run: in one run twice the time brought
    1.8 times the rise of the last third. It is taken to bring at most two times that rise.

    >>> [round(more_steps(steps, None), 3) for steps in (5, 100, 1000, 130_000)], more_steps(100, 0.1)
    ([9.5, 0.9, 0.54, 0.004], 0.2)
    """
    doubled = _doubled(steps)
    if steps < _FEW_STEPS:
        return doubled + _doubled(2 * steps)
    return doubled if rise is None else min(doubled, 2 * max(rise, 0.0))


def _doubled(steps: float) -> float:
    return min(5.0, 0.5 * min(1.0, _MANY_STEPS / steps) + 40 / steps) if steps else 5.0


def _surely_above_0(values: Sequence[float], views: Sequence[Mapping]) -> bool:
    """Tell whether the mean of values, a view each, is above 0 beyond chance."""
    return mean_over_chance(values, [view["time"] for view in views], QUESTIONS) > 1


def _holds(split: Split, of: str) -> str:
    return f"{split.part:.0%} of the {of} hold {split.error:.0%} of the squared error."


def _mean(sums: Sequence[float]) -> float:
    return _decibels(sums[0] / sums[1])


def _decibels(error: float) -> float:
    """Return the PSNR (dB) of a mean squared error.

    >>> _decibels(0.01)
    20.0
    """
    return -10 * math.log10(max(error, 1e-10))


@dataclass(frozen=True)
class Key:
    """A key to try.

    Attributes:
        path: of the key as it is typed, or of a group of Hydra's, as ``model/motion``.
        change: makes the value to try of the present one; gives None where there is nothing to try.
        advice: what it does.
        models: that have it; () for all.
    """

    path: str
    change: Callable[[object], object]
    advice: str
    models: Sequence[str] = ()


def _times(factor: float) -> Callable[[object], object]:
    """Multiply a number, or all of a list, of [fraction, number] the number; leave 0 and null as they are."""

    def change(value: object) -> object:
        if isinstance(value, list):
            changed = [[v[0], change(v[1])] if isinstance(v, list) else change(v) for v in value]
            return None if None in changed else changed
        if isinstance(value, bool) or not isinstance(value, int | float) or not value:
            return None
        return round(value * factor) if isinstance(value, int) else float(f"{value * factor:.3g}")

    return change


def _if(*before: object, to: object) -> Callable[[object], object]:
    """Change a value to another where it is one of some."""
    return lambda value: to if value in before else None


def _more_share(value: float) -> float:
    """Raise a share of draws.

    >>> [_more_share(value) for value in (0.1, 0.9, 1)]
    [0.3, 1.0, 1.0]
    """
    return round(min(max(value + 0.2, 0.0), 1.0), 3)


VOXELS = "forward", "backward"
NETWORKS = "nerf", "tnerf", "dnerf", "nerfies", "hypernerf"
LATTICES = "tineuvox_s", "tineuvox_b", "ndvg"
_LARGER = (
    Key("preset", _if("demo", to="fast"), "numbers for real scenes"),
    Key("stage.fine.density", _times(2), "twice as many particles", ("particles",)),
    Key("stage.fine.num_voxels", _times(2), "more voxels", VOXELS),
    Key("preset.voxels", _times(2), "more voxels", LATTICES),
    Key("preset.width", _times(2), "a wider network", NETWORKS),
    Key("preset.features", _times(2), "a larger network", ("neural_volumes",)),
)
_MORE_VIEWS = (
    Key("++data.train_views", lambda value: None if value is None else "null", "all training images"),
    Key("data.held_out", lambda value: 0 if value else None, "train on the views that are held out"),
)
_MOTION = (
    Key("model/motion", _if(None, to="spline"), "let it move", ("particles",)),
    Key("model/motion", _if(None, to="dct"), "let it move", ("forward",)),
    Key("stage.fine.knots", _times(2), "curves that bend faster", ("particles",)),
    Key("preset.bases", _times(2), "curves that bend faster", ("forward",)),
    Key("model.deformation.time_frequencies", _times(1.6), "a finer motion in time", ("backward",)),
    Key("preset.time_frequencies", _times(2), "a finer motion in time", ("tnerf", "dnerf")),
    Key("preset.warp_width", _times(2), "a larger network of the motion", ("nerfies", "hypernerf")),
    Key("stage.coarse.deformation_voxels", _times(2), "a finer motion", ("ndvg",)),
    Key("preset.width", _times(2), "a wider network", ("tineuvox_s", "tineuvox_b")),
)
# Of each kind the first key that the run's model has, and that can be changed.
KEYS: dict[str, Sequence[Key]] = {
    "training": (
        Key("budget.minutes", _times(2), "longer training"),
        Key("budget.iterations", _times(2), "longer training"),
        Key("budget.minutes", lambda value: 10, "longer training"),
    ),
    "moving": _MOTION,
    "stretch": (
        *_MOTION,
        Key("stage.fine.curriculum.error_share", _more_share, "train what has large errors more often"),
    ),
    "still": (
        Key("stage.fine.background_num_voxels", _times(2), "more voxels of the background", VOXELS),
        *_LARGER,
    ),
    "ends": (
        Key("data.canonical", _if(None, "first", to="middle"), "learn motion outwards from the middle"),
        Key(
            "stage.fine.curriculum.ends_share",
            _more_share,
            "train the ends more often",
        ),
    ),
    "between": (
        Key("objective.fine.weights.smooth", _times(4), "smoother motion", ("particles",)),
        Key("preset.bases", _times(0.6), "smoother motion", ("forward",)),
        Key("model.deformation.time_frequencies", _times(0.6), "a smoother motion", ("backward",)),
        Key("preset.time_frequencies", _times(0.5), "a smoother motion", ("tnerf", "dnerf")),
    ),
    "far": (
        *_MORE_VIEWS,
        Key(
            "model/view_dependence",
            lambda value: None if value is None else "none",
            "colours that do not depend on direction; else only more cameras help",
            ("particles", *VOXELS),
        ),
        Key(
            "objective.fine.weights.rigid",
            _times(3),
            "stiffer motion; else only more cameras help",
            ("particles",),
        ),
    ),
    "exposure": (
        Key("model/exposure", _if(None, to="cosines"), "where one camera's exposure drifts", ("particles",)),
        Key("model.exposure", _times(2), "a faster drift", ("particles",)),
        Key("preset.camera", _if(False, to="true"), "colours by camera", ("tineuvox_s", "tineuvox_b")),
    ),
    "outline": _LARGER,
    "blur": _LARGER,
    "beside": (
        Key(
            "preset.background",
            _if("white", "black", to="random"),
            "so that what is empty must be transparent",
        ),
        Key(
            "stage.fine.opacity_decay",
            lambda value: value * 2 or 1e-3,
            "what no image asks for fades",
            ("particles",),
        ),
        Key("objective.fine.weights.background_entropy", _times(3), "opaque or empty", (*VOXELS, *LATTICES)),
    ),
    "overfit": (
        *_MORE_VIEWS,
        Key("objective.fine.weights.rigid", _times(3), "stiffer motion", ("particles",)),
        Key("objective.fine.weights.tv_flow", _times(3), "smoother motion", ("forward",)),
    ),
}


def advice(
    kind: str, config: Mapping, steps: float | None = None, limit: str | None = None
) -> tuple[str, str]:
    """Return what to type for a kind of finding, and what it does: a key that the run's model has.

    Args:
        kind: one of ``KEYS``.
        config: of the run.
        steps: for each training image, as of ``steps_of``.
        limit: that ended the training, as of ``limit_of``.
    """
    model, keys = config["model"]["name"], KEYS[kind]
    if kind == "training" and limit is not None:
        beyond = (lambda value: "null") if limit.startswith("target.") else _times(2)
        keys = (Key(limit, beyond, "longer training"), *keys)
    for key in keys:
        if key.models and model not in key.models:
            continue
        value, is_there = _at(config, key.path)
        if not is_there:
            continue
        changed = key.change(value)
        if kind == "training" and steps is not None and steps < _FEW_STEPS and changed is not None:
            changed = key.change(changed)  # twice as long, twice
        if changed is not None and changed != value:
            return f"{key.path}={str(changed).replace(' ', '')}", key.advice
    if kind == "exposure":
        return "model=particles model/exposure=cosines", "where one camera's exposure drifts"
    if model == "particles":
        return "preset=faithful", "a longer fit by larger numbers"
    return "model=particles", "the most accurate method here"


def _at(config: Mapping, path: str) -> tuple[object, bool]:
    """Return the present value of a key, and whether there is one; of a preset its name."""
    if path == "preset":
        return config["preset"]["name"], True
    value: object = config
    for name in path.lstrip("+").replace("/", ".").split("."):
        if not isinstance(value, Mapping) or name not in value:
            return None, False
        value = value[name]
    return value, True
