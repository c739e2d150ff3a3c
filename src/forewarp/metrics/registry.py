"""The one list of image metrics: what is computed, and how every table of the project shows it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # so that reports and refusals wait for no torch
    from torch import Tensor

    from forewarp.scene.view import Target

SSIM_LEAST_SIDE, MS_SSIM_LEAST_SIDE, LPIPS_LEAST_SIDE = 11, 161, 32  # pixels
NETS = "squeeze", "vgg", "alex"  # backbones of LPIPS
THRESHOLDS = (1.02, 1.25, 1.25**2)  # ratios of rendered and true depth


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
        needs_foreground: None tells that the image has no foreground.
        least_side: fewest pixels that a side of the image must have.
    """

    name: str
    title: str
    digits: int = 4
    higher_is_better: bool = True
    unit: str = ""
    summary: bool = True
    score: Callable[[Tensor, Target, Tensor | None], float | None] | None = None
    needs_depth: bool = False
    needs_foreground: bool = False
    least_side: int = 0

    @property
    def heading(self) -> str:
        """The title with its unit."""
        return f"{self.title} ({self.unit})" if self.unit else self.title


def _of_image(name: str):
    def score(prediction: Tensor, target: Target, depth: Tensor | None) -> float | None:
        from forewarp.metrics import image

        return getattr(image, name)(prediction, target.rgb)

    return score


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
        from forewarp.metrics.depth import depth_delta

        shares = depth_delta(depth, target.depth, target.foreground, (threshold,))
        return shares and shares[0]

    return score


# In the order of every table. Another package adds its own: METRICS["sharpness"] = Metric("sharpness", ...).
METRICS: dict[str, Metric] = {
    metric.name: metric
    for metric in (
        Metric("psnr", "PSNR", 2, unit="dB", score=_of_image("psnr")),
        Metric(
            "psnr_box",
            "PSNR in the box",
            2,
            unit="dB",
            summary=False,
            score=_psnr_in_box,
            needs_foreground=True,
        ),
        Metric("ssim", "SSIM", score=_of_image("ssim"), least_side=SSIM_LEAST_SIDE),
        Metric(
            "ms_ssim", "MS-SSIM", summary=False, score=_of_image("ms_ssim"), least_side=MS_SSIM_LEAST_SIDE
        ),
        Metric(
            "ms_ssim_legacy",
            "MS-SSIM (legacy)",
            summary=False,
            score=_of_image("ms_ssim_legacy"),
            least_side=MS_SSIM_LEAST_SIDE,
        ),
        # Distances of different backbones are not comparable; weights are files, so the suite holds the nets.
        *(
            Metric(f"lpips_{net}", f"LPIPS ({net})", higher_is_better=False, least_side=LPIPS_LEAST_SIDE)
            for net in NETS
        ),
        *(
            Metric(
                f"depth_delta_{threshold:g}",
                f"depth < {threshold:g}",
                summary=False,
                score=_depth_within(threshold),
                needs_depth=True,
                needs_foreground=True,
            )
            for threshold in THRESHOLDS
        ),
    )
}


def metric_of(name: str) -> Metric:
    """Return a metric by name; one that is not registered, as of a package not imported, gets the defaults.

    ``lpips`` is that of whichever net a table says.

    >>> metric_of("psnr").heading, metric_of("sharp_edges").title
    ('PSNR (dB)', 'sharp edges')
    """
    if name == "lpips":
        return Metric("lpips", "LPIPS", higher_is_better=False)
    return METRICS.get(name) or Metric(name, name.replace("_", " "))
