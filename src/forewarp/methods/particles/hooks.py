"""Training hooks: what takes part in the training of particles beside their losses, and then leaves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from torch import Tensor, nn

from forewarp.fields.moving import GaussiansSnapshot
from forewarp.methods.particles.deformation import Deformation
from forewarp.methods.particles.gaussians import GaussianModel
from forewarp.methods.particles.nodes import Nodes
from forewarp.ops.gaussians import Gaussians, ImageLoss, Warp
from forewarp.scene.frame import Frame
from forewarp.scene.view import Moment, Observation


class Trained(Protocol):
    """What a hook may use of the particles in training; see ``model.Particles``."""

    gaussians: GaussianModel
    deformation: Deformation
    frames: Mapping[float, Frame]
    progress: float

    def at(self, moment: Moment) -> GaussiansSnapshot:
        """Freeze them at a moment."""

    def light(self, moment: Moment) -> Tensor | None:
        """Return the gain and the bias of the colours of an image."""

    def warp(self, time: float) -> Warp:
        """Return how they move from the canonical state to a time."""

    def compared(
        self, seen: Observation, particles: Gaussians, warp: Warp, time: float, factor: float
    ) -> ImageLoss:
        """Compare some of them, moved by a warp, with an image."""


class TrainingHook(nn.Module):
    """While it ``leads`` it moves nodes in place of their curves, which then do not learn; times do not
    jitter, and no node is frozen. It leaves by fitting the curves to where it moved nodes.
    """

    @property
    def leads(self) -> bool:
        """Whether it moves nodes; once it does not, it is not called any more."""
        raise NotImplementedError

    def before_image(self, particles: Trained, seen: Observation) -> None:
        """Prepare for a whole training image, before a step compares with it."""

    def update(self, particles: Trained, progress: float) -> None:
        """Follow a schedule before a step, at a fraction of the stage; fit the curves and leave where it is
        time.
        """

    def move(self, time: float, motion: Tensor, maps: Tensor) -> None:
        """Set ``motion`` (M, 7) and ``maps`` (M, 12) of the nodes that it moves; see ``ops.nodes``."""
        raise NotImplementedError

    def fit_curves(self, nodes: Nodes) -> None:
        """Fit the curves of nodes, or of a copy of them, to where it moves them."""
        raise NotImplementedError

    def gradients(self, time: float, by_maps: Tensor) -> dict[str, Tensor]:
        """Return the gradients by its own parameters' names, of a loss with ``by_maps`` (M, 12)."""
        return {}

    def after_step(self) -> None:
        """Take over what a step of the optimiser has changed."""

    def param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return what it learns, by the name of its learning rate."""
        return {}
