"""The canonical Gaussians: what is learned of each, and what an image is made of."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from forewarp.fields.moving import cosines
from forewarp.methods.particles.exposure import lit
from forewarp.ops.gaussians import Gaussians, rotations

_TIMES = 16  # at which opacity over time is looked at
_MOST_OPAQUE = 6.0  # logit: at 17 float32 has no gradient left, and what is opaque there can never fade
_HALF, _APART = 0.6, 0.6  # of the longest axis: a half's length, and how far each is moved along it


class GaussianModel(nn.Module):
    """N Gaussians of the canonical state. Parameters of effects that are off are None.

    Attributes:
        means: (N, 3), world units.
        scales: (N, 3), logarithms of the standard deviations along the axes, world units.
        quaternions: (N, 4), how the axes are rotated: w, x, y, z of any length.
        opacity: (N, 1), logits.
        colors: (N, 1, 3), coefficients of the constant harmonic.
        sh: (N, K, 3), of the other harmonics of the direction of view.
        color_over_time, opacity_over_time: (N, T, 3) and (N, F), of cosines of time.

    Args:
        values: first values by these names; coefficients of effects that are not there, or of which there
            are not as many, begin at 0.
        canonical_time: at which colours and opacity over time add nothing.
        degree: of the harmonics, 0 to 3.
        color_cosines, opacity_cosines: how many over time.
    """

    ROWS = (
        "means",
        "scales",
        "quaternions",
        "opacity",
        "colors",
        "sh",
        "color_over_time",
        "opacity_over_time",
    )

    def __init__(
        self,
        values: Mapping[str, Tensor],
        canonical_time: float,
        *,
        degree: int = 0,
        color_cosines: int = 0,
        opacity_cosines: int = 0,
    ) -> None:
        super().__init__()
        self.canonical_time, count = canonical_time, len(values["means"])
        self.means = nn.Parameter(values["means"])
        self.scales = nn.Parameter(values["scales"])
        self.quaternions = nn.Parameter(values["quaternions"])
        self.opacity = nn.Parameter(values["opacity"])
        self.colors = nn.Parameter(values["colors"])
        self.sh = coefficients(values.get("sh"), count, degree * (degree + 2), 3)
        self.color_over_time = coefficients(values.get("color_over_time"), count, color_cosines, 3)
        self.opacity_over_time = coefficients(values.get("opacity_over_time"), count, opacity_cosines)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the parameters that there are."""
        return tuple(name for name in self.ROWS if getattr(self, name) is not None)

    @property
    def color_names(self) -> list[str]:
        """Names of the parameters of colour that there are, in the operators' order."""
        return [name for name in ("colors", "sh", "color_over_time") if getattr(self, name) is not None]

    @property
    def color_kinds(self) -> list[int]:
        """How many coefficients each of ``color_names`` has."""
        return [getattr(self, name).shape[1] for name in self.color_names]

    def joined(self, light: Tensor | None = None) -> Gaussians:
        """Return them, in a ``light`` or their own, as the operators read them: coefficients of one kind in
        one tensor.
        """
        opacities = [part for part in (self.opacity, self.opacity_over_time) if part is not None]
        colors = _joined([getattr(self, name) for name in self.color_names])
        colors = colors if light is None else lit(colors, light)
        return Gaussians(self.means, self.scales, self.quaternions, _joined(opacities), colors)

    def split(self, found: Gaussians) -> dict[str, Tensor]:
        """Return gradients by the ``joined`` Gaussians, whose colours are in ``color_kinds``, by name."""
        means, scales, quaternions, opacity, by_kind = found
        named = {"means": means, "scales": scales, "quaternions": quaternions, "opacity": opacity[:, :1]}
        named |= dict(zip(self.color_names, by_kind, strict=True))
        return named if self.opacity_over_time is None else named | {"opacity_over_time": opacity[:, 1:]}

    def time_bases(self, time: float) -> tuple[Tensor, Tensor]:
        """Return what a time makes of the coefficients of colour (T,) and of opacity (1 + F,)."""
        counts = (0 if p is None else p.shape[1] for p in (self.color_over_time, self.opacity_over_time))
        color, opacity = (cosines(count, time, self.canonical_time) for count in counts)
        return self.means.new_tensor(color), self.means.new_tensor([1.0, *opacity])

    def most_opaque(self) -> Tensor:
        """Return the logit of each one's opacity (N,) when it is largest."""
        base = self.opacity.data[:, 0]
        if self.opacity_over_time is None:
            return base
        count, canonical = self.opacity_over_time.shape[1], self.canonical_time
        bases = base.new_tensor([cosines(count, i / _TIMES, canonical) for i in range(_TIMES + 1)])  # (T, F)
        return base + (bases @ self.opacity_over_time.data.T).amax(0)

    @torch.no_grad()
    def bound_opacity(self) -> None:
        """Keep the logit of opacity bounded at all times: where time adds to it, by taking from its base.

        Cost: nothing to speak of; with opacity over time about 20 operations a Gaussian and cosine.
        """
        base = self.opacity.data
        if self.opacity_over_time is not None:
            base[:, 0] -= (self.most_opaque() - _MOST_OPAQUE).clamp(min=0)
        base.clamp_(max=_MOST_OPAQUE)

    @torch.no_grad()
    def halve(self, first: Tensor, second: Tensor) -> None:
        """Make two shorter halves, along the longest axis, of those in the rows ``first`` and, copied,
        ``second``.
        """
        longest = self.scales[first].argmax(-1)
        length = self.scales[first].gather(-1, longest[:, None]).exp()
        axes = rotations(self.quaternions[first])
        axis = axes.gather(-1, longest[:, None, None].expand(-1, 3, 1))[..., 0]
        step = _APART * length * axis
        self.means[first] -= step
        self.means[second] += step
        shorter = torch.log(torch.tensor(_HALF))
        for rows in (first, second):
            self.scales[rows, longest] += shorter

    def harmonics(self) -> Tensor:
        """Return the coefficients of all harmonics (N, B, 3), without gradients."""
        return (self.colors if self.sh is None else torch.cat([self.colors, self.sh], 1)).data


def coefficients(before: Tensor | None, *shape: int) -> nn.Parameter | None:
    """Make an effect's coefficients (N, K, ...): those of the stage before, if it has as many, else 0.

    None where the effect is off (K = 0).
    """
    if shape[1] == 0:
        return None
    return nn.Parameter(before if before is not None and before.shape == shape else torch.zeros(shape))


def _joined(kinds: list[Tensor]) -> Tensor:
    return kinds[0] if len(kinds) == 1 else torch.cat(kinds, 1)
