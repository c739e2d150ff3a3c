"""The one list of image metrics, how tables show them, and the suite that computes and averages them."""

from __future__ import annotations

import json
import logging
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from forewarp.metrics.limits import LPIPS_LEAST_SIDE, MS_SSIM_LEAST_SIDE, NETS, SSIM_LEAST_SIDE, THRESHOLDS

if TYPE_CHECKING:  # so that reports and refusals wait for no torch
    from torch import Tensor

    from forewarp.metrics.lpips import LPIPS
    from forewarp.scene.view import Target

LPIPS_METRICS = tuple(f"lpips_{net}" for net in NETS)
ABILITIES = ("space", "time", "space_time", "canonical", "all")
PARTS = ("moving", "still")  # of images whose masks say what moves
CROSSED = ("crossed", "crossed_own")  # what rests, in the geometry of another time, and in its own

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Metric:
    """A metric of an image.

    Attributes:
        name: its key in ``metrics.json``.
        title: its heading in tables.
        digits: decimals in tables.
        higher_is_better: False for distances.
        unit: shown beside the title where there is room.
        summary: False: only tables of a single run show it.
        score: computes it from the prediction (H, W, 3), the ``Target`` and the rendered depth (H, W) or
            None; gives None for an image that does not allow it. None: ``ImageSuite`` has it otherwise.
        needs_depth: only computed where both the rendered and the true depth are known.
        needs_covisible: only computed where it is known what training images show too; of these pixels alone.
        needs_foreground: None tells that the image has no foreground.
        least_side: fewest pixels that a side of the image must have.
        dissimilarity_of: a similarity before it in the list, of which it is half of what is missing to 1.
    """

    name: str
    title: str
    digits: int = 4
    higher_is_better: bool = True
    unit: str = ""
    summary: bool = True
    score: Callable[[Tensor, Target, Tensor | None], float | None] | None = None
    needs_depth: bool = False
    needs_covisible: bool = False
    needs_foreground: bool = False
    least_side: int = 0
    dissimilarity_of: str = ""

    @property
    def heading(self) -> str:
        """The title with its unit."""
        return f"{self.title} ({self.unit})" if self.unit else self.title


def _of_image(name: str, *fields: str):
    """Score by a function of ``metrics.image``, which gets these fields of the target too."""

    def score(prediction: Tensor, target: Target, depth: Tensor | None) -> float | None:
        from forewarp.metrics import image

        return getattr(image, name)(prediction, target.rgb, *(getattr(target, field) for field in fields))

    return score


def _psnr_of(chosen: Tensor | None, prediction: Tensor, target: Target) -> float | None:
    """PSNR of chosen pixels (H, W), None: of all; gives None where none is chosen."""
    from forewarp.metrics.image import psnr

    if chosen is None:
        return psnr(prediction, target.rgb)
    return psnr(prediction[chosen][None], target.rgb[chosen][None]) if bool(chosen.any()) else None


def _psnr_where(chosen: str):
    """Score the PSNR of the pixels that a field of the target chooses."""
    return lambda prediction, target, depth: _psnr_of(getattr(target, chosen), prediction, target)


def scores_of_parts(prediction: Tensor, target: Target) -> dict[str, dict[str, float]]:
    """Return the PSNR of what moves and of what is still, of the pixels that count; other metrics make no
    sense of a part of an image.

    Args:
        prediction: (H, W, 3) in [0, 1].
        target: the true image and, where it is known, what moves.

    Returns:
        ``{part: {"psnr": ...}}`` without parts that have no pixel.
    """
    if target.moving is None:
        return {}
    valid = True if target.valid is None else target.valid
    chosen = zip(PARTS, (valid & target.moving, valid & ~target.moving))
    found = {part: _psnr_of(pixels, prediction, target) for part, pixels in chosen}
    return {part: {"psnr": value} for part, value in found.items() if value is not None}


def _psnr_in_box(prediction: Tensor, target: Target, depth: Tensor | None) -> float | None:
    """PSNR in the bounding rectangle of the foreground."""
    from forewarp.metrics.image import psnr

    if target.foreground is None or not bool(target.foreground.any()):
        return None
    rows, columns = (target.foreground.any(axis).nonzero()[:, 0] for axis in (1, 0))
    box = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    return psnr(prediction[box], target.rgb[box])


def _depth_within(threshold: float):
    def score(prediction: Tensor, target: Target, depth: Tensor | None) -> float | None:
        from forewarp.metrics.geometry import depth_delta

        shares = depth_delta(depth, target.depth, target.foreground, (threshold,))
        return shares and shares[0]

    return score


# What several metrics have in common.
_DECIBEL, _OF_ONE_RUN = {"digits": 2, "unit": "dB"}, {"summary": False}
_COVISIBLE, _OF_SUBJECT = {"needs_covisible": True}, {"needs_foreground": True}
_SSIM, _MS_SSIM = {"least_side": SSIM_LEAST_SIDE}, {"least_side": MS_SSIM_LEAST_SIDE, **_OF_ONE_RUN}
_LPIPS = {"least_side": LPIPS_LEAST_SIDE, "higher_is_better": False}
_DEPTH = {"needs_depth": True, **_OF_SUBJECT, **_OF_ONE_RUN}
# In the order of every table. Another package adds its own: METRICS["sharpness"] = Metric("sharpness", ...).
_LISTED = (
    Metric("psnr", "PSNR", score=_psnr_where("valid"), **_DECIBEL),
    Metric("psnr_box", "PSNR in the box", score=_psnr_in_box, **_DECIBEL, **_OF_SUBJECT, **_OF_ONE_RUN),
    Metric("ssim", "SSIM", score=_of_image("ssim"), **_SSIM),
    Metric("ms_ssim", "MS-SSIM", score=_of_image("ms_ssim"), **_MS_SSIM),
    Metric("ms_ssim_legacy", "MS-SSIM (legacy)", score=_of_image("ms_ssim_legacy"), **_MS_SSIM),
    # Tables of Neural 3D Video's scenes have it so, or of ssim.
    Metric("dssim", "DSSIM", higher_is_better=False, dissimilarity_of="ms_ssim", **_OF_ONE_RUN),
    # Distances of different backbones are not comparable; weights are files, so the suite holds the nets.
    *(Metric(f"lpips_{net}", f"LPIPS ({net})", **_LPIPS) for net in NETS),
    Metric("mpsnr", "mPSNR", score=_psnr_where("covisible"), **_DECIBEL, **_COVISIBLE),
    Metric("mssim", "mSSIM", score=_of_image("masked_ssim", "covisible"), **_SSIM, **_COVISIBLE),
    *(Metric(f"mlpips_{net}", f"mLPIPS ({net})", **_LPIPS, **_COVISIBLE) for net in NETS),
    *(Metric(f"depth_delta_{t:g}", f"depth < {t:g}", score=_depth_within(t), **_DEPTH) for t in THRESHOLDS),
)
METRICS: dict[str, Metric] = {metric.name: metric for metric in _LISTED}


_STORED: dict[str, Metric] = {}  # of packages that are not imported, as runs have them
_DESCRIBED = {"title": str, "digits": int, "higher_is_better": bool, "unit": str, "summary": bool}
_MOST_DIGITS = 10


def described(names: Iterable[str]) -> dict[str, dict]:
    """Describe metrics, as ``metrics.json`` keeps them: how tables show them, and which way is better.

    >>> described(["ssim"])
    {'ssim': {'title': 'SSIM', 'digits': 4, 'higher_is_better': True, 'unit': '', 'summary': True}}
    """
    return {name: {key: getattr(METRICS[name], key) for key in _DESCRIBED} for name in names}


def described_own(names: Iterable[str]) -> str:
    """Describe the metrics of other packages as JSON, for a column of a CSV file; "" if there are none."""
    listed = {"lpips", *(metric.name for metric in _LISTED)}
    own = {name: metric_of(name) for name in names if name not in listed}
    about = {name: {key: getattr(metric, key) for key in _DESCRIBED} for name, metric in own.items()}
    return json.dumps(about) if about else ""


def take_described(content: object) -> None:
    """Let ``metric_of`` know metrics as a run's ``metrics.json`` describes them; those registered stay.

    What is no description, as in a folder from someone else, is passed over.
    """
    for name, about in content.items() if isinstance(content, Mapping) else ():
        known = about if isinstance(about, Mapping) else {}
        known = {key: known[key] for key, kind in _DESCRIBED.items() if type(known.get(key)) is kind}
        if isinstance(name, str) and 0 <= known.get("digits", 0) <= _MOST_DIGITS:
            _STORED[name] = Metric(name, known.pop("title", name.replace("_", " ")), **known)


def metric_of(name: str) -> Metric:
    """Return a metric by name: a registered one; of a package not imported, as a run that was read describes
    it (``take_described``); else one with the defaults.

    ``lpips`` is that of whichever net a table says.

    >>> metric_of("psnr").heading, metric_of("sharp_edges").title
    ('PSNR (dB)', 'sharp edges')
    """
    if name == "lpips":
        return Metric("lpips", "LPIPS", higher_is_better=False)
    return METRICS.get(name) or _STORED.get(name) or Metric(name, name.replace("_", " "))


class ImageSuite:
    """Score rendered images.

    ``absent`` holds the reason for every metric left out so far; each is logged once.

    Args:
        lpips: ``{"lpips_<net>": LPIPS or None}`` as ``find_lpips`` returns it; None leaves a net out.
        mask_box: also compute ``psnr_box``, in the bounding rectangle of the foreground.

    Raises:
        ValueError: for a name other than ``lpips_<net>`` of the given net.
    """

    def __init__(self, lpips: Mapping[str, LPIPS | None] | None = None, *, mask_box: bool = False) -> None:
        self.mask_box = mask_box
        self.absent: dict[str, str] = {}
        self.lpips: dict[str, LPIPS] = {}
        for name, net in (lpips or {}).items():
            if name not in LPIPS_METRICS or (net is not None and name != f"lpips_{net.net}"):
                got = repr(name) if net is None else f"{name!r} for the net {net.net!r}"
                raise ValueError(f"lpips: expected names of {', '.join(LPIPS_METRICS)}, but got {got}")
            if net is None:
                self._leave_out(name, "no backbone weights were found")
            else:
                self.lpips[name] = net

    def score(
        self, prediction: Tensor, target: Target, predicted_depth: Tensor | None = None
    ) -> dict[str, float]:
        """Compute all metrics that the image's size and truth allow, in the order of ``METRICS``.

        Where some pixels do not count, PSNR is of the others alone; other metrics see the true colour there.

        Args:
            prediction: (H, W, 3) in [0, 1].
            target: the true image, and its depth and foreground if known.
            predicted_depth: ray depth (H, W), world units; scored if the target has a depth.

        Raises:
            ValueError: naming the frame, for a shape that differs or a colour that is not finite.
        """
        scores = {}
        if target.valid is not None and prediction.shape == target.rgb.shape:
            prediction = target.rgb.where(~target.valid[..., None], prediction.to(target.rgb))
        try:
            for name, metric in METRICS.items():
                lacks_depth = metric.needs_depth and (predicted_depth is None or target.depth is None)
                if metric.needs_covisible and target.covisible is None:
                    continue
                if net := self.lpips.get(name.removeprefix("m")):
                    value = net(prediction, target.rgb, target.covisible if metric.needs_covisible else None)
                elif metric.dissimilarity_of in scores:
                    value = (1 - scores[metric.dissimilarity_of]) / 2
                elif metric.score is None or lacks_depth or (name == "psnr_box" and not self.mask_box):
                    continue
                else:
                    value = metric.score(prediction, target, predicted_depth)
                if value is None:
                    self._leave_out(name, _reason(name, target))
                else:
                    scores[name] = value
        except ValueError as error:
            raise ValueError(f"frame {target.frame.name}: {error}") from error
        return scores

    def _leave_out(self, name: str, reason: str) -> None:
        if name not in self.absent:
            self.absent[name] = reason
            log.warning("%s is left out: %s", name, reason)


def summarise(rows: Iterable[tuple[str, Mapping[str, float]]]) -> dict[str, dict[str, float]]:
    """Average the scores of images per ability or part; abilities are never averaged together.

    Args:
        rows: the ability (``space``, ``time``, ``space_time``, ``canonical`` or ``all``) or part (``moving``,
            ``still``, ``crossed``, ``crossed_own``) and the scores of each image.

    Returns:
        ``{ability or part: {metric: mean}}`` in fixed order. A metric that some images lack is the mean over
        the others.

    Raises:
        ValueError: for an unknown ability or metric, or a score that is not finite.

    >>> summarise([("time", {"psnr": 30.0}), ("space", {"psnr": 20.0}), ("time", {"psnr": 20.0})])
    {'space': {'psnr': 20.0}, 'time': {'psnr': 25.0}}
    """
    collected: dict[str, dict[str, list[float]]] = {kind: {} for kind in (*ABILITIES, *PARTS, *CROSSED)}
    for ability, scores in rows:
        if ability not in collected:
            raise ValueError(f"ability: expected one of {', '.join(collected)}, but got {ability!r}")
        for name, value in scores.items():
            if name not in METRICS:
                raise ValueError(f"metric: expected one of {', '.join(METRICS)}, but got {name!r}")
            if not math.isfinite(value):
                raise ValueError(f"{name}: expected a finite score, but got {value}")
            collected[ability].setdefault(name, []).append(float(value))
    return {
        ability: {name: math.fsum(found[name]) / len(found[name]) for name in METRICS if name in found}
        for ability, found in collected.items()
        if found
    }


def absences(scores: Sequence[Mapping[str, float]], reasons: Mapping[str, str]) -> dict[str, str]:
    """Say which metrics all images lack, or some of them, and why; log those that nothing was said of.

    Args:
        scores: of each image.
        reasons: why images lack metrics, where that is known.

    >>> absences([{"psnr": 30.0, "mpsnr": 31.0}, {"psnr": 29.0}], {"lpips_vgg": "no weights"})
    {'lpips_vgg': 'no weights', 'mpsnr': 'only of 1 of 2 images, so it is no mean over the same as others'}
    """
    found = Counter(name for each in scores for name in each)
    absent = dict(reasons)
    for name in (name for name in METRICS if 0 < found[name] < len(scores)):
        line = f"only of {found[name]} of {len(scores)} images, so it is no mean over the same as others"
        absent[name] = f"{line}: {reasons[name]}" if name in reasons else line
        if name not in reasons:
            log.warning("%s: %s", name, line)
    return absent


def _reason(name: str, target: Target) -> str:
    """Say why an image lacks a metric."""
    metric, (height, width) = METRICS[name], target.rgb.shape[:2]
    if metric.needs_covisible and not bool(target.covisible.any()):
        return f"frame {target.frame.name} has no pixel that training images show too"
    if metric.needs_foreground:
        return f"frame {target.frame.name} has no foreground"
    if min(height, width) < metric.least_side:
        return f"frame {target.frame.name} is {width}x{height} pixels, a side must have {metric.least_side}"
    return f"frame {target.frame.name} does not allow it"
