"""Say where the error of a run's test views lies, what may be behind it, and the key to try.

Squared errors add up, so that shares of them say what a part accounts for. What a finding ``brings`` at most
is the gain of PSNR, of the mean squared error over all views, if the part were as good as the rest, or the
cause were gone. Findings overlap; their gains do not add up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import fmean

from forewarp.report.results import ENDS, KINDS, Row
from forewarp.report.statistics import Estimate, lies_below

LEAST = 0.3  # dB that a finding must promise
QUESTIONS = 10  # that are asked of a run, and share the errors of their tests
FEWEST = 3  # views of a group
WORST = 5  # views that are listed
MOST = 6  # findings that are shown
_BETWEEN = 0.25  # steps from a training time, from which on a view is between two
_FAR, _SPACINGS = 5.0, 2.0  # degrees, and times the spacing of the training cameras
_BEHIND = 2.5 / 255  # by which the colour of a subject differs from that behind it
_FEW_STEPS = 10.0  # a training image, below which a curve says nothing about what more would bring


@dataclass(frozen=True)
class Finding:
    """What accounts for a part of the error.

    Attributes:
        kind: one of ``KEYS``.
        text: what was found, in a sentence or two.
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
    the pixels were looked at of, and the training's ``fit`` as far as it is known.
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
        """Say what was looked for in vain."""
        return f"nothing stands out; no part of the error that was looked at would bring {LEAST} dB."

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
        views: by the name of a test view what is known of it beside its scores: ``sums`` and ``ratio`` of its
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
    measured = [image["sums"] for image in images if "sums" in image]
    found: list[tuple[str, str, float]] = []  # kind, text, share of the error
    splits: list[Split] = []
    flagged: set[str] = set()
    for kind, name, text, chosen in _groups(images, fit, row):
        if (split := of_views.split(name, chosen)) is None:
            continue
        splits.append(split)
        if (share := of_views.excess(chosen)) is not None:
            found.append((kind, f"{text}: {_holds(split, 'views')}", share))
            flagged |= {image["name"] for image, is_in in zip(images, chosen) if is_in}
    for kind, text, split, share in _of_pixels(measured):
        splits.append(split)
        if share is not None:
            found.append((kind, text, share))
    found += _of_causes(measured, [image["ratio"] for image in images if "sums" in image])
    # An exposure of their own tells test views from training images, too.
    lit = max([share for kind, _, share in found if kind == "exposure"], default=0.0)
    found += _of_fit(row, images, fit, flagged, -10 * math.log10(max(1 - lit, 1e-10)))
    best: dict[str, tuple[str, str, float]] = {}
    for kind, text, share in found:  # of each kind the one that may bring most
        if kind not in best or share > best[kind][2]:
            best[kind] = kind, text, share
    findings = []
    for kind, text, share in best.values():
        brings = math.inf if share >= 1 else -10 * math.log10(1 - share)
        if brings >= LEAST:
            findings.append(
                Finding(kind, text, share, brings, *advice(kind, row["config"], steps_of(row, fit)))
            )
    findings.sort(key=lambda finding: -finding.brings)
    ranked = sorted(images, key=lambda image: (image["psnr"], image["name"]))[:WORST]
    known = "name", "time", "psnr", "ability", "degrees", "gap"
    worst = [{key: image[key] for key in known if key in image} for image in ranked]
    return Diagnosis(findings[:MOST], splits, worst, len(measured), fit)


def errors_on_sheets(row: Row) -> dict[str, dict]:
    """Split the errors of the views that have a sheet: ``sums`` and ``ratio`` by name, for ``diagnose``.

    Of a scene measured before white or black the subject is what has another colour.
    """
    from forewarp.drawing.images import read_image
    from forewarp.metrics.errors import split_errors
    from forewarp.report.figures import sheets_of, thirds

    behind = {"white": 1.0, "black": 0.0}.get(row["metrics"].get("protocol", {}).get("background"))
    found = {}
    for name in {image["name"] for image in row["images"]} & {*(sheets := sheets_of(row["folder"]))}:
        truth, prediction, _ = thirds(read_image(sheets[name]))
        if (file := row["folder"] / "images" / f"{name}.png").is_file():  # sheets repeat pixels
            height = read_image(file).shape[0]
            by = max(1, truth.shape[0] // height)
            truth, prediction = truth[::by, ::by], prediction[::by, ::by]
        foreground = None if behind is None else (truth - behind).abs().amax(-1) > _BEHIND
        sums, ratio = split_errors(prediction, truth, foreground=foreground)
        found[name] = {"sums": sums, "ratio": ratio}
    return found


class _Views:
    """Test views as samples: groups of them against the others. All count alike, as in a mean of PSNR."""

    def __init__(self, images: Sequence[Mapping]) -> None:
        self.psnr = [image["psnr"] for image in images]
        self.errors = [10 ** (-psnr / 10) for psnr in self.psnr]

    def split(self, name: str, chosen: Sequence[bool]) -> Split | None:
        """Return what a group's share is; None if it, or the rest, has too few views."""
        count, total = sum(chosen), sum(self.errors)
        if min(count, len(chosen) - count) < FEWEST:
            return None
        inside = sum(error for error, is_in in zip(self.errors, chosen) if is_in)
        return Split(name, "views", count / len(chosen), inside / total, _decibels(inside / count))

    def excess(self, chosen: Sequence[bool]) -> float | None:
        """Return the share of the error by which a group is worse than the rest; None if it may be chance."""
        inside, rest = (self._of(self.psnr, chosen, side) for side in (True, False))
        if not lies_below(Estimate.of(inside), Estimate.of(rest), QUESTIONS):
            return None
        inside, rest = (self._of(self.errors, chosen, side) for side in (True, False))
        return (sum(inside) - len(inside) * fmean(rest)) / sum(self.errors)

    @staticmethod
    def _of(values: Sequence[float], chosen: Sequence[bool], side: bool) -> list[float]:
        return [value for value, is_in in zip(values, chosen) if is_in is side]


def _groups(images: Sequence[Mapping], fit: Mapping, row: Row):
    """Give groups of views: kind, name, words, which views belong to it."""
    for first, last, name in (
        (True, True, "both ends"),
        (True, False, "the beginning"),
        (False, True, "the end"),
    ):
        chosen = [(first and i["time"] <= ENDS) or (last and i["time"] >= 1 - ENDS) for i in images]
        yield "ends", f"{name} of the time", f"{name[0].upper()}{name[1:]} of the time", chosen
    if all("gap" in image for image in images):
        between = [image["gap"] > _BETWEEN for image in images]
    else:
        between = [image["ability"] in ("time", "space_time") for image in images]
    yield "between", KINDS["time"], "Between training times", between
    if all("degrees" in image for image in images):
        least = max(_FAR, _SPACINGS * fit.get("spacing", 0.0))
        chosen = [image["degrees"] > least for image in images]
        words = f"more than {least:.0f} degrees from every training camera"
        yield "far", words, f"Test cameras {words}", chosen


def _of_pixels(measured: Sequence[Mapping]):
    """Give groups of pixels: kind, words, split, and the share of the error by which it is worse, if any."""
    pairs = ("moving", "moving", "still"), ("still", "still", "moving")
    for kind, name, other in (*pairs, ("outline", "outline", "inside"), ("beside", "beside", None)):
        if name == "still" and any("inside" in sums for sums in measured):
            continue  # of a subject before nothing, what is still is no background
        both = [sums for sums in measured if name in sums and (other is None or other in sums)]
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
        yield kind, text, split, (error - count * rest) / total if _surely_above_0(worse) else None


PARTS = {"moving": "what moves", "still": "what is still", "outline": "outlines of the subject"}
PARTS |= {"inside": "its inside", "beside": "beside the subject"}


def _of_causes(measured: Sequence[Mapping], ratios: Sequence[float]) -> list[tuple[str, str, float]]:
    """Say what goes with a gain and an offset of each view, and with a truth as blurred as the rendering.

    What is misplaced or noisy is nearer to a blurred truth, too; but then a blurred rendering is nearer to
    the truth. What that would gain is no blur.
    """
    found = []

    def after(sums: Mapping, name: str) -> float:
        """The error of a view without a cause."""
        of_noise = sums[name.replace("blur_", "blurrier_")][0] if name.startswith("blur_") else math.inf
        return sums[name][0] + max(sums["all"][0] - of_noise, 0.0)

    def gone(name: str) -> float | None:
        """The share of the error that goes with a cause; None if it may be chance."""
        both = [
            (sums["all"][0], after(sums, name)) for sums in measured if name in sums and sums["all"][0] > 0
        ]
        better = [10 * math.log10(before / max(left, 1e-12)) for before, left in both]
        if not _surely_above_0(better):
            return None
        return 1 - sum(left for _, left in both) / sum(before for before, _ in both)

    if (share := gone("exposure")) is not None:
        low, high = min(ratios), max(ratios)
        text = "Exposure: with a gain and an offset of each view's colours"
        bright = f"the truth is {low:.2f} to {high:.2f} times as bright as the rendering"
        found.append(("exposure", f"{text} {share:.0%} of the squared error would go; {bright}.", share))
    names = sorted({name for sums in measured for name in sums if name.startswith("blur_")})
    shares = {name: share for name in names if (share := gone(name)) is not None}
    if shares:
        name = max(shares, key=shares.__getitem__)
        text = f"Blur: {shares[name]:.0%} of the squared error is what a blur of"
        text += f" {name.removeprefix('blur_')} pixels takes from the truth."
        found.append(("blur", text, shares[name]))
    return found


def _of_fit(
    row: Row, images: Sequence[Mapping], fit: Mapping, flagged: set[str], explained: float
) -> list[tuple[str, str, float]]:
    """Say what more training may bring, and what test views that are not ``flagged`` lack against training
    images, beyond so many dB that are ``explained``.
    """
    found, steps = [], steps_of(row, fit)
    rise = still_rising(row["points"])
    if steps is not None and (gain := more_steps(steps, rise)) >= LEAST:
        told = f"PSNR rose by {rise:.1f} dB in the last third of the training; " if rise is not None else ""
        text = f"Short training: {steps:.3g} steps for each training image; {told}"
        text += f"runs of this project with as many gained at most about {gain:.1f} dB by "
        text += ("four times" if steps < _FEW_STEPS else "twice") + " the time."
        found.append(("training", text, 1 - 10 ** (-gain / 10)))
    if not {"psnr", "images"} <= fit.keys():
        return found
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
        found.append(("far", f"{text}; {reached} them.", share))
    elif lacks > 0:
        found.append(("overfit", f"Overfitting: the {fit['images']:.0f} {reached} test views.", share))
    return found


def steps_of(row: Row, fit: Mapping) -> float | None:
    """Return the steps of all stages for each training image; None if unknown."""
    return row["steps"] / fit["images"] if fit.get("images") else None


def still_rising(points: Sequence) -> float | None:
    """Return by how many dB a run's PSNR rose in the last third of its time; None without a curve."""
    curve = [point for point in points if point.seconds > 0 and math.isfinite(point.psnr)]
    before = [point for point in curve if point.seconds <= curve[-1].seconds * 2 / 3]
    return curve[-1].psnr - before[-1].psnr if before else None


def more_steps(steps: float, rise: float | None) -> float:
    """Bound what more training brings, in dB: twice the time, or four times after very few steps.

    The bound lies above nearly all of what doubling the time brought to this project's runs of eleven methods
    on nine scenes (docs/results): 0.5 dB and 40 dB over the steps for each training image, at most 5 dB. The
    rise within a run is no measure of it, as learning rates fall at the end of any run: but where the curve
    is flat, twice the time brings no more than the rise.

    >>> round(more_steps(5, None), 2), more_steps(100, None), more_steps(100, 0.1)
    (9.5, 0.9, 0.1)
    """
    doubled = min(5.0, 0.5 + 40 / steps) if steps else 5.0
    if steps < _FEW_STEPS:
        return doubled + (min(5.0, 0.5 + 20 / steps) if steps else 5.0)
    return doubled if rise is None else min(doubled, max(rise, 0.0))


def _surely_above_0(values: Sequence[float]) -> bool:
    """Tell whether the mean of independent values, a view each, is above 0."""
    return bool(values) and Estimate.of(values).sign(QUESTIONS) == 1


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
# Of each kind the first key that the run's model has, and that can be changed.
KEYS: dict[str, Sequence[Key]] = {
    "training": (
        Key("budget.minutes", _times(2), "longer training"),
        Key("budget.iterations", _times(2), "longer training"),
        Key("budget.minutes", lambda value: 10, "longer training"),
    ),
    "moving": (
        Key("model/motion", _if(None, to="spline"), "let it move", ("particles",)),
        Key("model/motion", _if(None, to="dct"), "let it move", ("forward",)),
        Key("stage.fine.knots", _times(2), "curves that bend faster", ("particles",)),
        Key("preset.bases", _times(2), "curves that bend faster", ("forward",)),
        Key("model.deformation.time_frequencies", _times(1.6), "a finer motion in time", ("backward",)),
        Key("preset.time_frequencies", _times(2), "a finer motion in time", ("tnerf", "dnerf")),
        Key("preset.warp_width", _times(2), "a larger network of the motion", ("nerfies", "hypernerf")),
        Key("stage.coarse.deformation_voxels", _times(2), "a finer motion", ("ndvg",)),
        Key("preset.width", _times(2), "a wider network", ("tineuvox_s", "tineuvox_b")),
    ),
    "still": (
        Key("stage.fine.background_num_voxels", _times(2), "more voxels of the background", VOXELS),
        *_LARGER,
    ),
    "ends": (
        Key("data.canonical", _if(None, "first", to="middle"), "learn motion outwards from the middle"),
        Key(
            "stage.fine.curriculum.ends_share",
            lambda value: round(value + 0.2, 3),
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


def advice(kind: str, config: Mapping, steps: float | None = None) -> tuple[str, str]:
    """Return what to type for a kind of finding, and what it does: a key that the run's model has.

    Args:
        kind: one of ``KEYS``.
        config: of the run.
        steps: for each training image, as of ``steps_of``.
    """
    model = config["model"]["name"]
    for key in KEYS[kind]:
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
