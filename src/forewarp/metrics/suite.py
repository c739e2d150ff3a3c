"""All metrics of an image, and their means per ability."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping

from torch import Tensor

from forewarp.metrics.lpips import LPIPS
from forewarp.metrics.registry import METRICS, NETS
from forewarp.scene.view import Target

ABILITIES = ("space", "time", "canonical", "all")
LPIPS_METRICS = tuple(f"lpips_{net}" for net in NETS)

log = logging.getLogger(__name__)


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

        Args:
            prediction: (H, W, 3) in [0, 1].
            target: the true image, and its depth and foreground if known.
            predicted_depth: ray depth (H, W), world units; scored if the target has a depth.

        Raises:
            ValueError: naming the frame, for a shape that differs or a colour that is not finite.
        """
        scores = {}
        try:
            for name, metric in METRICS.items():
                lacks_depth = metric.needs_depth and (predicted_depth is None or target.depth is None)
                if name in self.lpips:
                    value = self.lpips[name](prediction, target.rgb)
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
    """Average the scores of images per ability; abilities are never averaged together.

    Args:
        rows: the ability (``space``, ``time``, ``canonical`` or ``all``) and the scores of each image.

    Returns:
        ``{ability: {metric: mean}}`` in fixed order. A metric that some images lack is the mean over
        the others.

    Raises:
        ValueError: for an unknown ability or metric, or a score that is not finite.

    >>> summarise([("time", {"psnr": 30.0}), ("space", {"psnr": 20.0}), ("time", {"psnr": 20.0})])
    {'space': {'psnr': 20.0}, 'time': {'psnr': 25.0}}
    """
    collected: dict[str, dict[str, list[float]]] = {ability: {} for ability in ABILITIES}
    for ability, scores in rows:
        if ability not in ABILITIES:
            raise ValueError(f"ability: expected one of {', '.join(ABILITIES)}, but got {ability!r}")
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


def _reason(name: str, target: Target) -> str:
    """Say why an image lacks a metric."""
    metric, (height, width) = METRICS[name], target.rgb.shape[:2]
    if metric.needs_foreground:
        return f"frame {target.frame.name} has no foreground"
    if min(height, width) < metric.least_side:
        return f"frame {target.frame.name} is {width}x{height} pixels, a side must have {metric.least_side}"
    return f"frame {target.frame.name} does not allow it"
