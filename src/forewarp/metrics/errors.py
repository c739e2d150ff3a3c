"""Split the squared error of an image: by groups of pixels, which add up, and by simple causes."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

SIGMAS = (0.7, 1.2, 2.0, 3.5)  # pixels: deviations of the blur that is tried
_RIM = 0.006  # of the shorter side, at least a pixel: width of an outline to either side of a silhouette
_BLOCKS = 24  # along the shorter side: gain and offset are fitted to the means of blocks
_FEWEST = 12  # blocks that a fit needs
_RIDGE = 1e-3  # pulls a fit towards gain 1 and offset 0
_WHOLE = 0.98  # share of an image from which on its foreground is no subject before a background


class Sums(NamedTuple):
    """The squared errors of pixels, each the mean over channels: their ``total``, and how many there are."""

    total: float
    count: int


def split_errors(
    prediction: Tensor,
    truth: Tensor,
    *,
    foreground: Tensor | None = None,
    moving: Tensor | None = None,
    valid: Tensor | None = None,
) -> tuple[dict[str, Sums], float]:
    """Sum the squared error over groups of pixels, and over all pixels if a cause were taken away.

    Args:
        prediction, truth: (H, W, 3) in [0, 1].
        foreground: (H, W) bool, the subject of a cut-out image; one that covers all but 2 % splits nothing.
        moving: (H, W) bool, the pixels of what moves.
        valid: (H, W) bool, the pixels that count; None: all.

    Returns:
        by name the sums of ``all``; of ``outline`` (the pixels beside the silhouette), ``inside`` and
        ``beside`` the subject; of ``moving`` and ``still``, in the subject where there is one; of all pixels
        again after ``exposure`` (a gain and an offset of each channel, fitted to every other block, applied
        to the others), against a truth ``blur_<sigma>``-ed by so many pixels, and of a prediction that is
        (``blurrier_<sigma>``). Groups that are unknown or empty are left out. And the mean of the truth over
        that of the prediction, inside the subject.
    """
    square = (prediction - truth).square().mean(-1)
    counted = torch.ones_like(square, dtype=torch.bool) if valid is None else valid
    share = 1.0 if foreground is None else float(foreground.float().mean())
    subject = foreground if 0 < share < _WHOLE else None
    groups, examined = {"all": counted}, counted
    if subject is not None:
        reach = max(1, round(_RIM * min(subject.shape)))
        rim = _grown(subject, reach) & _grown(~subject, reach)
        groups |= {"outline": rim & counted, "inside": subject & ~rim & counted}
        groups["beside"] = ~subject & ~rim & counted
        examined = groups["inside"]
    if moving is not None:
        within = counted if subject is None else subject & counted
        groups |= {"moving": moving & within, "still": ~moving & within}
    sums = {name: Sums(float(square[mask].sum()), int(mask.sum())) for name, mask in groups.items()}
    if (lit := _lit(prediction, truth, examined)) is not None:
        after = square.where(~examined, (lit - truth).square().mean(-1))
        sums["exposure"] = Sums(float(after[counted].sum()), sums["all"].count)
    for sigma in SIGMAS:
        for name, pair in (
            ("blur", (prediction, blurred(truth, sigma))),
            ("blurrier", (blurred(prediction, sigma), truth)),
        ):
            after = (pair[0] - pair[1]).square().mean(-1)
            sums[f"{name}_{sigma:g}"] = Sums(float(after[counted].sum()), sums["all"].count)
    ratio = (
        float(truth[examined].mean() / prediction[examined].mean().clamp(min=1e-6)) if examined.any() else 1.0
    )
    return {name: of for name, of in sums.items() if of.count}, ratio


def _grown(mask: Tensor, reach: int) -> Tensor:
    return F.max_pool2d(mask[None].float(), 2 * reach + 1, 1, reach)[0] > 0


def _lit(prediction: Tensor, truth: Tensor, examined: Tensor) -> Tensor | None:
    """Return the prediction (H, W, 3) with the exposure of the truth; None where too little is ``examined``.

    Means of blocks are fitted, as what is misplaced by a few pixels would look like a loss of contrast.
    """
    side = max(1, min(examined.shape) // _BLOCKS)
    weight = F.avg_pool2d(examined[None].float(), side, ceil_mode=True)[0]

    def means(image: Tensor) -> Tensor:
        masked = (image * examined[..., None]).permute(2, 0, 1)
        return F.avg_pool2d(masked, side, ceil_mode=True) / weight.clamp(min=1e-6)

    x, y = means(prediction).double(), means(truth).double()
    odd = (torch.arange(weight.shape[0])[:, None] + torch.arange(weight.shape[1])) % 2 == 1
    place = odd.repeat_interleave(side, 0).repeat_interleave(side, 1)[
        : examined.shape[0], : examined.shape[1]
    ]
    lit = prediction.clone()
    for fitted, applied in ((odd, ~place), (~odd, place)):
        chosen = fitted & (weight > 0.5)
        if int(chosen.sum()) < _FEWEST:
            return None
        for channel in range(3):
            a = torch.stack([x[channel][chosen], torch.ones(int(chosen.sum()), dtype=x.dtype)], -1)
            pull = _RIDGE * len(a) * torch.eye(2, dtype=x.dtype)
            b = a.T @ y[channel][chosen] + pull @ torch.tensor([1.0, 0.0], dtype=x.dtype)
            gain, offset = torch.linalg.solve(a.T @ a + pull, b).tolist()
            lit[..., channel][applied] = (gain * prediction[..., channel][applied] + offset).clamp(0, 1)
    return lit


def blurred(image: Tensor, sigma: float) -> Tensor:
    """Blur an image (H, W, 3) by a Gaussian of ``sigma`` pixels; beyond the border its edge goes on."""
    reach = math.ceil(3 * sigma)
    weights = torch.exp(-torch.arange(-reach, reach + 1.0).square() / (2 * sigma**2))
    weights, planes = (weights / weights.sum()).to(image), image.permute(2, 0, 1)[:, None]
    planes = F.conv2d(F.pad(planes, (reach, reach, 0, 0), "replicate"), weights[None, None, None])
    planes = F.conv2d(F.pad(planes, (0, 0, reach, reach), "replicate"), weights[None, None, :, None])
    return planes[:, 0].permute(1, 2, 0)
