"""Particles: canonical Gaussians, moved forward by nodes and rasterised."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from forewarp.fields.curves import Curve
from forewarp.methods.method import Method, Snapshot, Start, Step
from forewarp.methods.particles import density, queries
from forewarp.methods.particles.nodes import Nodes, Skin, TimeOffsets
from forewarp.methods.particles.options import EFFECTS, Effects, Numbers, ParticlesPlanning, view_share
from forewarp.methods.particles.start import (
    compile_kernels,
    covered_pixels,
    first_points,
    first_values,
    widths,
)
from forewarp.methods.rows import RowsAdam
from forewarp.ops.backend import has_kernels
from forewarp.ops.gaussians import (
    BLUR,
    FEASIBLE,
    Compared,
    Gaussians,
    Pinhole,
    Warp,
    compare,
    project,
    rasterize,
    smaller,
)
from forewarp.ops.nodes import pull_nodes
from forewarp.scene.camera import Camera
from forewarp.scene.cloud import Cloud
from forewarp.scene.frame import Scene, spread
from forewarp.scene.view import Asks, Batch, Moment, Observation, Rendering, View

# Of the camera's near plane, and at least of its far plane: closer particles would fill the image.
_NEAR, _LEAST_NEAR = 0.1, 0.02
_MARGIN = 0.125  # share of the longer side; what projects farther outside the image is left out
_LENS_MARGIN = 1.3  # of the squared distance from the axis that the image's border reaches
_BORDER = 16  # points along each side of an image
_TRANSPARENT = 1e-6  # opacity below which a pixel has no depth
_COUNTED_IMAGES = 12  # whose covered pixels are counted before a run
_SLACK = 0.98  # of a side, as smaller images are not covered to exactly the same share


@lru_cache(maxsize=4096)
def pinhole_of(camera: Camera, blur: float) -> Pinhole:
    """Convert a scene's camera to what the operators read; each camera once, as it takes 0.3 ms.

    Args:
        camera: a camera, with or without a lens.
        blur: square pixels added to the variance of every splat.
    """
    pose, lens = camera.camera_to_world.double(), camera.lens
    return Pinhole(
        tuple(pose[:3, :3].T.flatten().tolist()),
        tuple(pose[:3, 3].tolist()),
        (camera.fx, camera.fy),
        (camera.cx, camera.cy),
        (camera.width, camera.height),
        max(_NEAR * camera.near, _LEAST_NEAR * camera.far),
        skew=camera.skew,
        blur=blur,
        margin=_MARGIN * max(camera.width, camera.height),
        radial=(0.0, 0.0, 0.0) if lens is None else lens.k,
        tangential=(0.0, 0.0) if lens is None else lens.p,
        reach=1e8 if lens is None else _squared_reach(camera),
    )


def _squared_reach(camera: Camera) -> float:
    """Return the squared distance from the axis, at depth 1, up to which a lens may show points.

    Beyond it the lens's polynomial may fold points back into the image.
    """
    along = torch.linspace(0, 1, _BORDER, dtype=torch.float64)
    across, down = along * camera.width, along * camera.height
    zero = torch.zeros_like(along)
    u = torch.cat([across, across, zero, zero + camera.width])
    v = torch.cat([zero, zero + camera.height, down, down])
    y = (v - camera.cy) / camera.fy
    x = (u - camera.cx - camera.skew * y) / camera.fx
    return _LENS_MARGIN * float(camera.lens.straighten(torch.stack([x, y], -1)).square().sum(-1).max())


@dataclass(eq=False)
class ParticlesSnapshot(Snapshot):
    """Particles at a moment.

    Attributes:
        moment: the moment.
        gaussians: the canonical particles.
        warp: how they move until then.
        color_basis, opacity_basis: what the time makes of colours (T,) and of opacity (F,).
        blur: square pixels added to the variance of every splat.
    """

    moment: Moment
    gaussians: Gaussians
    warp: Warp
    color_basis: Tensor
    opacity_basis: Tensor
    blur: float

    def render(self, view: View, background: Tensor, rendering: str | None = None) -> Rendering:
        """See ``Snapshot``. Pixels and crops are taken from the whole image, which costs little."""
        pinhole = pinhole_of(view.camera, self.blur)
        splats = project(self.gaussians, self.warp, pinhole, self.color_basis, self.opacity_basis)
        color, distance, through = rasterize(splats, *pinhole.size)
        color, distance, through = color.reshape(3, -1).T, distance.reshape(-1), through.reshape(-1)
        if view.indices is not None:
            rows = view.indices.to(color.device)
            color, distance, through = color[rows], distance[rows], through[rows]
        opacity = 1 - through
        depth = torch.where(opacity > _TRANSPARENT, distance / opacity.clamp(min=_TRANSPARENT), 0.0)
        return Rendering(color + through[:, None] * background.to(color), depth, opacity)

    def holds(self, moment: Moment) -> bool:
        """Return whether it is the same time; which camera looks does not matter."""
        return moment.time == self.moment.time


class Particles(Method):
    """N canonical Gaussians, and M nodes that carry them through time.

    A step renders a whole image, compares it, and has its gradients in one pass of ``ops.compare``; the
    optimiser passes over particles that the image does not show.

    Args:
        start: what it is built from; for the stage's numbers see ``options.Numbers``.
        width: error at which the photometric loss turns from a square to a line.
        blur: square pixels added to the variance of every splat.
        choices: see ``options.Effects``.
    """

    terms = ("photo", "rigid", "smooth")
    numbers = tuple(key for key in Numbers.__dataclass_fields__ if key != "name")
    asks = Asks(kind="pictures", straight=True)
    effects = EFFECTS
    on_cpu = "its kernels are the CPU's, and without them only small pictures are feasible"
    planning: ClassVar[ParticlesPlanning] = ParticlesPlanning()

    # Scene queries: see ``methods.method``.
    matter, bounds, trajectories = queries.matter, queries.bounds, queries.trajectories
    ellipsoids, template, movement = queries.ellipsoids, queries.template, queries.movement

    def __init__(self, start: Start, *, width: float = 0.05, blur: float = BLUR, **choices) -> None:
        super().__init__()
        self.stage = Numbers(name=start.stage, **start.numbers)
        self.canonical_time, self.width, self.blur = start.scene.canonical_time, width, blur
        self.views, times = len(start.scene.train), start.scene.times
        effects = Effects(**choices).only(self.stage.effects, len(times))
        self.ends = min(times), max(times)
        self.progress = self.decay = 0.0
        self.shown_now: list[Tensor] = []  # which particles each image of this step showed

        values = self._first_values(start)
        count = len(values["means"])
        self.means = nn.Parameter(values["means"])
        self.log_scales = nn.Parameter(values["log_scales"])
        self.turns = nn.Parameter(values["turns"])
        self.opacity = nn.Parameter(values["opacity"])  # logits
        self.color = nn.Parameter(values["color"])  # coefficient of the constant harmonic
        degree = effects.view_dependence or 0
        self.shade = _coefficients(values.get("shade"), count, degree * (degree + 2), 3)
        self.tint = _coefficients(values.get("tint"), count, effects.color_over_time or 0, 3)
        self.fade = _coefficients(values.get("fade"), count, effects.opacity_over_time or 0)

        self.nodes = self.skin = None
        if effects.motion is not None:
            node_count, knots = self.stage.motion(count, len(times))
            curve = Curve(
                effects.motion, knots, len(times), self.canonical_time, straight=self.stage.straight
            )
            self.nodes = Nodes(
                None if start.blank else self.means.data,
                node_count,
                curve,
                TimeOffsets.of(effects.motion, times, self.stage.time_offsets),
                turns=effects.rotation is not None,
                rests=effects.background is not None,
                edges=self.stage.edges,
            )
            self.skin = Skin(self.nodes, self.means.data)
        self.least_motion = effects.background
        resting = None if effects.background is None else torch.zeros(count, dtype=torch.bool)
        self.register_buffer("resting", resting)
        # Since the last round of density control: sums of gradients, images that showed a particle; and for
        # how many rounds none did.
        self.register_buffer("pulled", torch.zeros(count))
        self.register_buffer("shown", torch.zeros(count))
        self.register_buffer("idle", torch.zeros(count))
        self.register_buffer("round", torch.zeros((), dtype=torch.int64))
        rows = ["means", "log_scales", "turns", "opacity", "color", "shade", "tint", "fade"]
        rows += ["pulled", "shown", "idle", "resting"]
        self.grows = tuple(name for name in rows if getattr(self, name) is not None)
        if self.skin is not None:
            self.grows += Skin.ROWS

    def _first_values(self, start: Start) -> dict[str, Tensor]:
        """Return the first value of every parameter: fresh, or of the stage before.

        Also register ``covered``: mean number of pixels of an image that show anything; ``extent``: median
        distance of points from the middle; and ``most``: how many particles there will be.
        """
        if isinstance(start.before, Particles):
            before = start.before
            covered, extent = float(before.covered), float(before.extent)
            values = {n: p.data.to("cpu", copy=True) for n, p in before.named_parameters(recurse=False)}
        elif start.blank:
            covered = extent = 1.0
            values = first_values(Cloud(torch.zeros(1, 3), torch.zeros(1, 3), torch.zeros(1), 1.0))
        else:
            covered = covered_pixels(start.scene, list(start.frames))
            cloud = first_points(start, round(self.stage.first * self.stage.most(covered, self.views)))
            distances = (cloud.points - cloud.points.median(0).values).norm(dim=-1)
            extent = float(distances.median()) or start.scene.box.diagonal
            # Points of a hull lie on its surface, and are as far apart as particles should be large.
            widest = None if start.scene.has_alpha else widths(start.scene, cloud.points, covered)
            values = first_values(cloud, widest)
        self.register_buffer("covered", torch.tensor(covered))
        self.register_buffer("extent", torch.tensor(extent))
        self.register_buffer("most", torch.tensor(float(self.stage.most(covered, self.views))))
        return values

    @classmethod
    def check_feasible(
        cls, scene: Scene, stage: str, numbers: Mapping[str, Any], device: torch.device
    ) -> None:
        """See ``Method``: without kernels, refuse images too large for the particles that they call for.

        The number of particles grows as the root of the covered pixels, so that splats times pixels grow as
        the third power of an image's side.

        Raises:
            ValueError: naming a size that is feasible.

        Cost: with kernels nothing, else a look at twelve images.
        """
        if has_kernels(device):
            return
        cameras = [frame.camera for frame in (*scene.train, *scene.held, *scene.val, *scene.test)]
        width, height = max(((c.width, c.height) for c in cameras), key=lambda size: size[0] * size[1])
        settings, views = Numbers(name=stage, **numbers), len(scene.train)
        covered = covered_pixels(scene, spread(views, _COUNTED_IMAGES))
        count = settings.most(covered, views) * max(settings.first, settings.full)
        scale = (FEASIBLE / (count * width * height)) ** (1 / 3)
        if scale >= 1:
            return
        smaller_width, smaller_height = smaller(width, height, _SLACK * scale)
        if device.type == "cpu":
            key, why = "model", "have no kernels without Numba"
            instead = "install forewarp[cpu] and leave FOREWARP_NUMBA unset"
        else:
            key, why, instead = "trainer", "have no kernels on a GPU", "use trainer=cpu"
        raise ValueError(
            f"{key}: expected pictures of at most {smaller_width} x {smaller_height} pixels, as particles "
            f"{why}, but got {width} x {height} and {count:,.0f} particles; {instead}, "
            "or use smaller pictures"
        )

    @property
    def moves(self) -> bool:
        """Whether there is any motion."""
        return self.nodes is not None

    @property
    def size(self) -> tuple[str, int]:
        """See ``Method``."""
        return "particles", len(self.means)

    def at_rest(self) -> float:
        """See ``HasRest``."""
        return 0.0 if self.resting is None else float(self.resting.float().mean())

    def adopted(self) -> set[str]:
        """See ``Method``: nodes too are as many as a checkpoint says."""
        nodes = () if self.nodes is None else self.nodes.rows()
        return {*self.grows, *(f"nodes.{name}" for name in nodes)}

    def misfit(self, state: Mapping[str, Tensor]) -> str | None:
        """See ``Method``; what is stored of nodes must go together, too."""
        if self.nodes is None:
            return super().misfit(state)
        followed = self.skin.links.shape[1]  # a particle follows fewer nodes where there are few
        links = {n: state[n][:, :1].expand(-1, followed) for n in Skin.ROWS if state[n].dim() == 2}
        if len({state[name].shape for name in Skin.ROWS}) > 1:
            return Skin.ROWS[0]
        inconsistent = self.nodes.misfit(state, "nodes.", state["skin.links"])
        return inconsistent or super().misfit({**state, **links})

    def at(self, moment: Moment) -> Snapshot:
        """Move every particle; nothing is rendered yet."""
        bases = self.over_time(moment.time)
        return ParticlesSnapshot(moment, self.gaussians(), self.warp(moment.time), *bases, self.blur)

    def gaussians(self) -> Gaussians:
        """Return the particles as the operators read them: coefficients of one kind in one tensor."""
        opacity = self.opacity if self.fade is None else torch.cat([self.opacity, self.fade], -1)
        colors = [getattr(self, name) for name in self._color_parameters()]
        colors = colors[0] if len(colors) == 1 else torch.cat(colors, 1)
        return Gaussians(self.means, self.log_scales, self.turns, opacity, colors)

    def _color_parameters(self) -> list[str]:
        """Return the parameters of colour that there are, in the operators' order."""
        return [name for name in ("color", "shade", "tint") if getattr(self, name) is not None]

    def warp(self, time: float) -> Warp:
        """Return how all particles move from the canonical state to a time."""
        if self.nodes is not None:
            return Warp(self.nodes.maps(time), self.skin.links, self.skin.weights())
        zero = self.means.new_zeros(len(self.means), 1)
        return Warp(self.means.new_zeros(1, 12), zero.int(), zero)

    def over_time(self, time: float) -> tuple[Tensor, Tensor]:
        """Return what a time makes of the coefficients of colour (T,) and of opacity (1 + F,)."""
        color = [] if self.tint is None else self.color_basis(time)
        opacity = [] if self.fade is None else self.opacity_basis(time)
        return self.means.new_tensor(color), self.means.new_tensor([1.0, *opacity])

    def color_basis(self, time: float) -> list[float]:
        """Return the cosines of colour over time."""
        return self._cosines(self.tint.shape[1], time)

    def opacity_basis(self, time: float) -> list[float]:
        """Return the cosines of opacity over time."""
        return self._cosines(self.fade.shape[1], time)

    def _cosines(self, count: int, time: float) -> list[float]:
        """Return ``cos(pi k t) - cos(pi k t_c)`` for k = 1 .. count: 0 at the canonical time."""
        return [
            math.cos(math.pi * k * time) - math.cos(math.pi * k * self.canonical_time)
            for k in range(1, count + 1)
        ]

    @torch.no_grad()
    def look(self, batch: Batch, factors: Mapping[str, float], generator: torch.Generator) -> Step:
        """See ``Method``. Images are rendered one after the other, each as a whole."""
        gradients: dict[str, Tensor] = {}
        terms = dict.fromkeys(self.terms, 0.0)
        squared, numbers, views = 0.0, 0, len(batch.observations)
        unit = float(self.covered) * views  # the loss is a mean over pixels that show anything
        for seen in batch.observations:
            compared, of_nodes = self._compare(seen, factors, unit, generator, gradients)
            squared, numbers = squared + compared.squared, numbers + 3 * len(seen.view)
            terms["photo"] += compared.loss / unit
            for name, value in of_nodes.items():
                terms[name] += value / views
        values = {name: (lambda v=v: self.means.new_tensor(v)) for name, v in terms.items()}
        if self.nodes is None:
            values["rigid"] = values["smooth"] = lambda: None
        error = torch.tensor(squared / numbers, dtype=torch.float64)
        return Step(values, error, {"particles": len(self.means)}, gradients)

    def _compare(
        self,
        seen: Observation,
        factors: Mapping[str, float],
        unit: float,
        generator: torch.Generator,
        gradients: dict[str, Tensor],
    ) -> tuple[Compared, dict[str, float]]:
        """Compare with one image, add to ``gradients``, and return the terms of the nodes, too."""
        time = self._jittered(seen.moment.time, generator)
        tints, fades = self.over_time(time)
        if self.nodes is None:
            warp = self.warp(time)
        else:
            motion_time = self.nodes.taken(time)
            self.nodes.look_ahead(motion_time)
            basis = self.nodes.basis_of_motion((motion_time, 1.0))
            motion, maps = self.nodes.carried(basis)
            warp = Warp(maps, self.skin.links, self.skin.weights())
        colors = self._color_parameters()
        compared = compare(
            self.gaussians(), warp, pinhole_of(seen.view.camera, self.blur), tints, fades, seen.rgb,
            seen.background, width=self.width, factor=factors.get("photo", 0.0) / unit,
            by_skin=self.moves, kinds=[getattr(self, name).shape[1] for name in colors],
        )  # fmt: skip
        shown = compared.pull > 0
        self.pulled.add_(compared.pull)
        self.shown.add_(shown)
        self.shown_now.append(shown)
        if self.progress < self.stage.settled:
            self.idle[density.too_near(compared.order, compared.distances)] = math.inf
        found = compared.particles
        new = {"means": found.means, "log_scales": found.log_scales, "turns": found.quaternions}
        new |= {"opacity": found.opacity[:, :1], **dict(zip(colors, found.colors, strict=True))}
        if self.fade is not None:
            new["fade"] = found.opacity[:, 1:]
        terms = {}
        if self.nodes is not None:
            nodes, rigid = self.nodes, factors.get("rigid", 0.0) * self.stage.loose**self.progress
            by_motion, terms["rigid"] = pull_nodes(
                motion, nodes.places, compared.maps, nodes.edges, nodes.edge_weights, rigid
            )
            smooth, extent = factors.get("smooth", 0.0), float(self.extent)
            terms["smooth"], of_nodes = nodes.spread_over_time(
                time, motion_time, basis, by_motion, smooth, extent
            )
            new |= {"skin.learned": compared.skin, **of_nodes}
        for name, value in new.items():
            gradients[name] = value if name not in gradients else gradients[name] + value
        return compared, terms

    def _jittered(self, time: float, generator: torch.Generator) -> float:
        """Shift an image's time at random, less and less, so that curves do not follow single images."""
        deviation = self.stage.jitter * max(0.0, 1 - self.progress / self.stage.calm)
        if self.nodes is None or deviation == 0:
            return time
        return min(1.0, max(0.0, time + deviation * float(torch.randn((), generator=generator))))

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """See ``Method``: scale learning rates by the scene, and renew particles where it is time.

        Rates of lengths are of the scene's extent; that of the skin follows the number of images, and the
        decay of opacity the rate of opacity.
        """
        self.progress, stage = progress, self.stage
        density.bound_opacity(self)
        for group in optimizer.param_groups:
            if group["name"] in ("means", "shifts"):
                group["lr"] *= float(self.extent)
            elif group["name"] == "time_offsets":
                self.nodes.offsets.learns = progress >= stage.calm
                if self.nodes.offsets.learns:
                    self.nodes.offsets.settle(group["lr"])
            elif group["name"] == "opacity":
                decay = stage.decay(float(self.most), float(self.covered))
                self.decay = min(0.99, decay * group["lr"] / (group["base_lr"] or 1.0))  # rates may rise
            elif group["name"] == "skin":
                group["lr"] *= view_share(self.views)
        number = int(progress / stage.every)
        if number > int(self.round) and progress < stage.settled:
            self.round.fill_(number)
            self._renew(progress, optimizer)
        return {}

    def _renew(self, progress: float, optimizer: torch.optim.Optimizer) -> None:
        """Run a round of density control; every few rounds, link particles to nodes anew, and let rest."""
        target = round(float(self.most) * self.stage.share_at(progress))
        low, high = self.ends if self.nodes is None else self.nodes.seen.tolist()
        all_seen = self.moves and low <= self.ends[0] + 0.02 and high >= self.ends[1] - 0.02
        density.renew(self, optimizer, target, unseen=all_seen, extent=float(self.extent))
        if self.moves and int(self.round) % self.stage.relink == 0:
            self.skin.relink(self.nodes, self.means.data, optimizer)
            if self.resting is not None:
                self.skin.let_go(self.resting)
                if progress >= self.stage.rest:
                    least = max(self.least_motion, density.pixel_width(float(self.covered)))
                    density.come_to_rest(self, least * float(self.extent))

    def warm_up(self) -> None:
        """Compile the operators' kernels."""
        compile_kernels(self)

    def param_groups(self) -> dict[str, list[nn.Parameter]]:
        """See ``Method``."""
        groups = {name: [p] for name, p in self.named_parameters(recurse=False)}
        if self.nodes is not None:
            groups |= {"skin": [self.skin.learned]} | self.nodes.param_groups()
        return groups

    def optimizer(self, groups: list[dict]) -> torch.optim.Optimizer:
        """Make an Adam that passes over unseen rows; after a step, let the opacity of what was seen decay."""
        optimizer = RowsAdam(groups)
        optimizer.register_step_post_hook(lambda *_: density.decay_opacity(self))
        return optimizer

    def departures(self) -> list[str]:
        """See ``Method``."""
        return [
            "from the forward-flow paper: particles that are rasterised, not voxels that rays march through"
        ]


def _coefficients(before: Tensor | None, *shape: int) -> nn.Parameter | None:
    """Make an effect's coefficients (N, K, ...): those of the stage before, if it has as many, else 0.

    None where the effect is off (K = 0).
    """
    if shape[1] == 0:
        return None
    return nn.Parameter(before if before is not None and before.shape == shape else torch.zeros(shape))
