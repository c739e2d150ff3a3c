"""Particles: canonical Gaussians, moved forward by nodes and rasterised."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor, nn

from forewarp.fields.curves import Curve
from forewarp.fields.moving import GaussiansSnapshot, MovingGaussians, NodeMotion, cosines, pinhole_of
from forewarp.losses import IMAGE_LOSSES, robust
from forewarp.methods.method import Method, Snapshot, Start, Step, value_at
from forewarp.methods.particles import density, exposure
from forewarp.methods.particles.contact import known_depth, set_down
from forewarp.methods.particles.follow import follow, put_on_ground
from forewarp.methods.particles.nodes import Nodes, Skinning, TimeOffsets, are_rows
from forewarp.methods.particles.options import EFFECTS, SMALLEST, Effects, Numbers, view_share
from forewarp.methods.particles.shared import begin_window, check_still, left_alone
from forewarp.methods.particles.start import at_rest, compile_kernels, first_values, fresh_values
from forewarp.methods.rows import RowsAdam, keep_rows
from forewarp.ops.gaussians import BLUR, CHUNK, DEEP, Gaussians, ImageLoss, Warp, compare, moved
from forewarp.ops.nodes import pull_nodes
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.cloud import Cloud, Ellipsoids, nearest
from forewarp.scene.frame import Frame, spread
from forewarp.scene.view import Asks, Batch, Moment, Observation, View

_FEWEST_TIMES = 8  # of training, for learned corrections of them
_KEPT = 2**28  # bytes of colours of smaller images that are kept
_SOLID = 0.1  # opacity from which matter bounds the scene
_FRAMES, _CAMERAS = 32, 8  # at whose times, and from which of them, motion is looked at
MOVES = 1.5  # pixels from the mean place, from which on it is seen that a particle moves
_ALIKE = 9  # particles beside each other, whose median counts
# Parameters and buffers with a row for each particle; those of effects that are off are None.
_ROWS = ("means", "scales", "quaternions", "opacity", "colors", "sh", "color_over_time", "opacity_over_time")
_ROWS += ("gradient_sum", "image_count", "unseen_rounds", "resting", "shared")


@dataclass(eq=False, repr=False)
class ParticlesSnapshot(GaussiansSnapshot, Snapshot):
    """Particles at a moment. Images that the ``lit_cameras`` took have an exposure of their own."""

    lit_cameras: frozenset[int | None] = frozenset()

    def holds(self, moment: Moment) -> bool:
        """Return whether it is the same time, in the same light."""
        lit = [seen.filmed and seen.camera in self.lit_cameras for seen in (moment, self.moment)]
        return (moment.time, moment.lit) == (self.moment.time, self.moment.lit) and lit[0] == lit[1]


class Particles(Method):
    """N canonical Gaussians, and M nodes that carry them through time.

    A step renders a whole image, compares it, and has its gradients in one pass of ``ops.compare``; the
    optimiser passes over particles that the image does not show.

    Args:
        start: what it is built from; for the stage's numbers see ``options.Numbers``.
        width: error at which the photometric loss turns from a square to a line.
        deep: relative error at which the loss of depth does.
        blur: square pixels added to the variance of every splat.
        chunk: pairs of a splat and a pixel in memory at once, where there are no kernels.
        choices: see ``options.Effects``.
    """

    terms = ("photo", *IMAGE_LOSSES, "depth", "rigid", "smooth", "static")
    numbers = tuple(key for key in Numbers.__dataclass_fields__ if key != "name")
    asks = Asks(kind="pictures", straight=True)
    loose = Skinning.ROWS  # a particle follows fewer nodes where there are few
    effects, still_steps = EFFECTS, 700  # a step is of one image
    on_cpu = "it has no GPU kernels"

    def __init__(
        self,
        start: Start,
        *,
        width: float = 0.05,
        deep: float = DEEP,
        blur: float = BLUR,
        chunk: int = CHUNK,
        **choices,
    ) -> None:
        super().__init__()
        self.stage = Numbers(name=start.stage, **start.numbers)
        self.canonical_time, self.width, self.blur = start.scene.canonical_time, width, blur
        self.deep, self.chunk = deep, chunk
        if start.weights.get("depth"):
            self.asks = replace(self.asks, sensed=True)
        train, times = start.scene.train, start.scene.instants
        # Whether a step's images come with planes beside their colours, which the kernels are compiled for.
        self.has_planes = any(f.load_valid or (self.asks.sensed and f.load_sensed) for f in train)
        self.views = len(train)
        self.frames = {frame.time: frame for frame in train}
        effects = Effects(**choices).only(self.stage.effects, len(times))
        self.ends = min(times), max(times)
        self.progress = self.decay = self.hidden_decay = 0.0
        self.shown_now: list[Tensor] = []  # which particles each image of this step showed
        self.small_by, self.small = 1.0, {}  # images made so many times smaller, by frame

        self.box = start.scene.box if self.stage.shell and not start.scene.has_alpha else None
        values = self._first_values(start, effects.motion is not None and self.stage.rest_by_masks)
        new, body_of = values.pop("set_down", None), values.pop("body_of", None)
        count = len(values["means"])
        self.means = nn.Parameter(values["means"])
        self.scales = nn.Parameter(values["scales"])  # logarithms
        self.quaternions = nn.Parameter(values["quaternions"])  # w, x, y, z of any length
        self.opacity = nn.Parameter(values["opacity"])  # logits
        self.colors = nn.Parameter(values["colors"])  # of the constant harmonic
        degree = effects.view_dependence or 0
        self.sh = _coefficients(values.get("sh"), count, degree * (degree + 2), 3)  # of the other harmonics
        colors, opacities = effects.color_over_time or 0, effects.opacity_over_time or 0
        self.color_over_time = _coefficients(values.get("color_over_time"), count, colors, 3)
        self.opacity_over_time = _coefficients(values.get("opacity_over_time"), count, opacities)
        lights = exposure.count_of(effects.exposure or 0, start.scene)
        self.exposure = _coefficients(values.get("exposure"), lights, 2, 3) if lights else None
        self.lit_cameras = frozenset(frame.camera_id for frame in train if lights)
        # Of the rounds of density control; the first two are sums since the last round.
        self.register_buffer("gradient_sum", torch.zeros(count))
        self.register_buffer("image_count", torch.zeros(count))  # that showed a particle
        self.register_buffer("unseen_rounds", torch.zeros(count))  # infinite: to be removed
        self.register_buffer("round", torch.zeros((), dtype=torch.int64))
        self.least_motion = effects.background
        rests_at_once = self.box is not None or self.stage.rest_by_masks
        may_rest = effects.background is not None or (rests_at_once and effects.motion is not None)
        resting = self.beyond(self.means.data) if may_rest else None
        if may_rest and self.stage.rest_by_masks and not start.blank:
            resting |= at_rest(start.scene, self.means.data, surface_of(start.before))
            if new is not None:
                resting &= ~new
        self.register_buffer("resting", resting)
        # Rows of the run that windows of a film begin from: particles that stay as they are; -1: of its own.
        self.register_buffer("shared", values.get("shared"))

        self.nodes = self.skinning = None
        if effects.motion is not None:
            still = left_alone(self.shared, self.resting)
            own = self.means.data if still is None or bool(still.all()) else self.means.data[~still]
            nodes, knots = self.stage.motion(len(own), len(times))
            natural = self.stage.natural_splines
            curve = Curve(effects.motion, knots, len(times), self.canonical_time, straight=natural)
            offsets = None  # cosines are exactly 0 at the canonical time, and few times do not tell
            if self.stage.time_offsets and effects.motion == "spline" and len(times) >= _FEWEST_TIMES:
                offsets = TimeOffsets(times, self.stage.time_offsets)
            points, edges = None if start.blank else own, self.stage.edges
            rotates, rests = effects.rotation is not None, effects.background is not None
            if self.stage.bodies == 0 or not rotates:
                body_of = None
            else:
                body_of = torch.full((len(self.means),), -1) if body_of is None else body_of
                body_of = body_of if len(own) == len(body_of) else body_of[~still]
            more = {"rotates": rotates, "rests": rests, "edges": edges, "body_of": body_of, "times": times}
            self.nodes = Nodes(points, nodes, curve, offsets, **more)
            self.skinning = Skinning(self.nodes, self.means.data)
            if still is not None:
                self.skinning.release(still)
        self.grows = tuple(name for name in _ROWS if getattr(self, name) is not None)
        self.grows += () if self.skinning is None else Skinning.ROWS

    def _first_values(self, start: Start, sets_down: bool) -> dict[str, Tensor]:
        """Return the first value of every parameter: fresh, or of the stage before.

        Also register ``covered_pixels``: mean number of pixels of an image that show anything; ``extent``:
        median distance of points from the middle; and ``final_count``: how many particles there will be,
        beside those that are ``shared``, then of the ``moving_pixels``.

        Args:
            start: what it is built from.
            sets_down: what moves in a film; see ``contact.set_down``.

        Raises:
            ValueError: if the run that a window begins from is not one of particles that stand still.
        """
        moving = 1.0
        if start.shares and not start.blank:
            check_still(start.before)
        if isinstance(start.before, Particles):
            before = start.before
            covered, extent = float(before.covered_pixels), float(before.extent)
            if start.shares and before.shared is None:
                values, moving = begin_window(before, start, self.stage.initial_share)
            else:
                values = {n: p.data.to("cpu", copy=True) for n, p in before.named_parameters(recurse=False)}
                if before.shared is not None:
                    values["shared"], moving = before.shared.to("cpu", copy=True), float(before.moving_pixels)
                if sets_down and not start.blank:
                    values = set_down(values, before, start.scene)
        elif start.blank:
            covered = extent = 1.0
            values = first_values(Cloud(torch.zeros(1, 3), torch.zeros(1, 3), torch.zeros(1), 1.0))
            values |= {"shared": torch.tensor([-1])} if start.shares else {}
        else:
            shell = 0.0 if self.box is None else self.stage.shell
            values, covered, extent = fresh_values(start, self.stage, shell, self.beyond)
        self.register_buffer("covered_pixels", torch.tensor(covered))
        self.register_buffer("extent", torch.tensor(extent))
        self.register_buffer("moving_pixels", torch.tensor(moving) if start.shares else None)
        final_count = float(self.stage.final_count(moving if start.shares else covered, self.views))
        self.register_buffer("final_count", torch.tensor(final_count))
        return values

    def beyond(self, points: Tensor) -> Tensor:
        """Return which points (N, 3) lie outside the box in which motion is looked for: bool (N,)."""
        if self.box is None:
            return torch.zeros(len(points), dtype=torch.bool, device=points.device)
        low, high = points.new_tensor(self.box.low), points.new_tensor(self.box.high)
        return ((points < low) | (points > high)).any(-1)

    @property
    def moves(self) -> bool:
        """Whether there is any motion."""
        return self.nodes is not None

    @property
    def size(self) -> tuple[str, int]:
        """See ``Method``."""
        return "particles", len(self.means)

    def misfit(self, state: Mapping[str, Tensor]) -> str | None:
        """See ``Method``; what is stored of the skinning must go together with all nodes, too."""
        misfit = super().misfit(state)
        if misfit or self.nodes is None:
            return misfit
        links, *others = (state[name] for name in self.loose)
        fits = len(links) == len(state["means"]) and all(links.shape == other.shape for other in others)
        return None if fits and are_rows(links, len(state["nodes.positions"])) else self.loose[0]

    def at(self, moment: Moment) -> Snapshot:
        """Move every particle; nothing is rendered yet."""
        warp, bases = self.warp(moment.time), self.time_bases(moment.time)
        gaussians = self.gaussians(self.light(moment))
        return ParticlesSnapshot(moment, gaussians, warp, *bases, self.blur, self.chunk, self.lit_cameras)

    def gaussians(self, light: Tensor | None = None) -> Gaussians:
        """Return the particles, in a ``light`` or their own, as the operators read them: coefficients of one
        kind in one tensor.
        """
        opacities = [part for part in (self.opacity, self.opacity_over_time) if part is not None]
        colors = self._joined([getattr(self, name) for name in self._color_parameters()])
        colors = colors if light is None else exposure.lit(colors, light)
        return Gaussians(self.means, self.scales, self.quaternions, self._joined(opacities), colors)

    def light(self, moment: Moment) -> Tensor | None:
        """Return the gain and the bias (2, 3) of the colours of an image that a camera of the training images
        took; None for any other: gain 1, bias 0.
        """
        if not (moment.filmed and moment.camera in self.lit_cameras):
            return None
        return exposure.gain_and_bias(
            self.exposure, self._drift(moment.time if moment.lit is None else moment.lit)
        )

    def _drift(self, time: float) -> list[float]:
        return exposure.basis_at(len(self.exposure), time, self.shared is not None)

    @staticmethod
    def _joined(kinds: list[Tensor]) -> Tensor:
        return kinds[0] if len(kinds) == 1 else torch.cat(kinds, 1)

    def _color_parameters(self) -> list[str]:
        """Return the parameters of colour that there are, in the operators' order."""
        return [name for name in ("colors", "sh", "color_over_time") if getattr(self, name) is not None]

    def warp(self, time: float) -> Warp:
        """Return how all particles move from the canonical state to a time."""
        if self.nodes is not None:
            return Warp(self.nodes.maps(time), self.skinning.links, self.skinning.weights())
        zero = self.means.new_zeros(len(self.means), 1)
        return Warp(self.means.new_zeros(1, 12), zero.int(), zero)

    def time_bases(self, time: float) -> tuple[Tensor, Tensor]:
        """Return what a time makes of the coefficients of colour (T,) and of opacity (1 + F,)."""
        counts = (0 if p is None else p.shape[1] for p in (self.color_over_time, self.opacity_over_time))
        color, opacity = (cosines(count, time, self.canonical_time) for count in counts)
        return self.means.new_tensor(color), self.means.new_tensor([1.0, *opacity])

    @torch.no_grad()
    def look(self, batch: Batch, factors: Mapping[str, float], generator: torch.Generator) -> Step:
        """See ``Method``. Images are rendered one after the other, each as a whole."""
        terms, gradients = dict.fromkeys(self.terms, 0.0), {}
        squared, numbers, views, has_depth = 0.0, 0, len(batch.observations), False
        for whole in batch.observations:
            if self.nodes is not None and self.nodes.led:
                follow(self, whole, self.frames)
            seen = self._smaller(whole)
            covered = float(self.covered_pixels) * len(seen.view) / len(whole.view)
            squared_error, of_image, found = self._compare(seen, factors, generator, views, covered)
            count = len(seen.view) if seen.valid is None else int(seen.valid.sum())
            squared, numbers = squared + squared_error, numbers + 3 * count
            for name, value in of_image.items():
                terms[name] += value / views
            has_depth |= seen.sensed is not None
            for name, value in found.items():
                gradients[name] = gradients[name] + value if name in gradients else value
        values = {name: (lambda v=v: self.means.new_tensor(v)) for name, v in terms.items()}
        if not has_depth:
            values["depth"] = lambda: None
        if self.nodes is None:
            values |= dict.fromkeys(("rigid", "smooth", "static"), lambda: None)
        error = torch.tensor(squared / numbers, dtype=torch.float64)
        return Step(values, error, {"particles": len(self.means)}, gradients)

    def _smaller(self, seen: Observation) -> Observation:
        """Return an image as small as ``image_scale`` has it now; the first ones are kept, as many as fit."""
        asked, camera = value_at(self.stage.image_scale, self.progress), seen.view.camera
        times = min(asked, max(camera.width, camera.height) / SMALLEST)
        if asked != self.small_by:
            self.small_by, self.small = asked, {}
        if times <= 1:
            return seen
        frame = seen.moment.frame
        small = self.small.get(frame) or seen.smaller(times)
        if frame is not None and (len(self.small) + 1) * small.rgb.numel() <= _KEPT:
            self.small[frame] = small
        return replace(small, background=seen.background)

    def _compare(
        self,
        seen: Observation,
        factors: Mapping[str, float],
        generator: torch.Generator,
        views: int,
        covered: float,
    ) -> tuple[float, dict[str, float], dict[str, Tensor]]:
        """Compare with one of a step's images, of which ``covered`` pixels show anything.

        Returns:
            the sum of squared errors; the terms; and the step's gradients, by parameter.
        """
        time, nodes = self._jittered(seen.moment.time, generator), self.nodes
        if nodes is None:
            warp = self.warp(time)
        else:
            motion_time = nodes.motion_time(time)
            nodes.extend(motion_time)
            basis = nodes.summed_basis((motion_time, 1.0))
            motion, maps = nodes.carried(time, basis)
            warp = Warp(maps, self.skinning.links, self.skinning.weights())
        colors, light, terms = self._color_parameters(), self.light(seen.moment), {}
        loss = self._image_loss(factors, terms)
        of_colors = factors.get("photo", 0.0) if loss is None else 1.0
        sensed = seen.sensed if "depth" in factors else None
        by_depth = factors.get("depth", 0.0) / of_colors
        more = {"loss": loss, "sensed": sensed, "by_depth": by_depth}
        compared = self.compared(
            seen, self.gaussians(light), warp, time, of_colors / (covered * views), **more
        )
        terms = {"depth": compared.depth} | (terms or {"photo": compared.loss})
        terms = {name: value / covered for name, value in terms.items()}
        by_place = compared.pixel_gradient
        if self.shared is not None:
            by_place = by_place.masked_fill(self.shared >= 0, 0.0)
        shown = by_place > 0
        self.gradient_sum.add_(by_place)
        self.image_count.add_(shown)
        self.shown_now.append(shown)
        if self.progress < self.stage.density_until:
            self.unseen_rounds[density.too_near(compared.order, compared.distances)] = math.inf
        means, scales, quaternions, opacity, by_kind = compared.particles
        gradients = {"means": means, "scales": scales, "quaternions": quaternions, "opacity": opacity[:, :1]}
        if light is not None:
            unlit, drift = [getattr(self, name) for name in colors], self._drift(seen.moment.time)
            by_kind, gradients["exposure"] = exposure.to_unlit(unlit, by_kind, light, drift)
        gradients |= dict(zip(colors, by_kind, strict=True))
        if self.opacity_over_time is not None:
            gradients["opacity_over_time"] = opacity[:, 1:]
        if nodes is not None:
            rigid = factors.get("rigid", 0.0) * self.stage.rigid_final_factor**self.progress
            edges = nodes.edges, nodes.edge_weights
            by_motion, terms["rigid"] = pull_nodes(motion, nodes.positions, compared.maps, *edges, rigid)
            smooth, extent = factors.get("smooth", 0.0), float(self.extent)
            if "static" in factors:
                to_rest, terms["static"] = nodes.pull_to_rest(motion, factors["static"], extent)
                by_motion = by_motion + to_rest
            if nodes.led:
                gradients["nodes.bodies.twists"] = nodes.bodies.gradients(time, compared.maps)
            terms["smooth"], of_nodes = nodes.backward(time, motion_time, basis, by_motion, smooth, extent)
            gradients |= {"skinning.logits": compared.skin, **of_nodes}
        if self.shared is not None:
            for name in gradients.keys() & {*self.grows}:
                gradients[name][self.shared >= 0] = 0.0  # the optimiser passes over them
        return compared.squared, terms, gradients

    def compared(
        self, seen: Observation, particles: Gaussians, warp: Warp, time: float, factor: float, *,
        loss: Callable | None = None, sensed: Tensor | None = None, by_depth: float = 0.0,
    ) -> ImageLoss:  # fmt: skip
        """Compare particles, moved by a warp, with an image; see ``ops.gaussians.compare``."""
        return compare(
            particles, warp, pinhole_of(seen.view.camera, self.blur), *self.time_bases(time),
            seen.rgb, seen.background, width=self.width, factor=factor, by_skin=self.moves,
            kinds=[getattr(self, name).shape[1] for name in self._color_parameters()], loss=loss,
            valid=seen.valid, sensed=sensed, by_depth=by_depth, deep=self.deep, chunk=self.chunk,
        )  # fmt: skip

    def _image_loss(self, factors: Mapping[str, float], terms: dict[str, float]) -> Callable | None:
        """Return the weighted sum of all losses of an image, which notes each in ``terms``; None if ``photo``
        is the only one: a kernel computes it together with its gradients.
        """
        losses = {"photo": partial(robust, width=self.width)} | IMAGE_LOSSES
        losses = {name: loss for name, loss in losses.items() if name in factors}
        if losses.keys() == {"photo"}:
            return None

        def weighted(image: Tensor, truth: Tensor) -> Tensor:
            values = {name: loss(image, truth) for name, loss in losses.items()}
            terms.update({name: float(value.detach()) for name, value in values.items()})
            return sum((factors[name] * value for name, value in values.items()), 0.0 * image.sum())

        return weighted

    def _jittered(self, time: float, generator: torch.Generator) -> float:
        """Shift an image's time at random, less and less, so that curves do not follow single images."""
        deviation = self.stage.jitter * max(0.0, 1 - self.progress / self.stage.jitter_until)
        if self.nodes is None or self.nodes.led or deviation == 0:
            return time
        return min(1.0, max(0.0, time + deviation * float(torch.randn((), generator=generator))))

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """See ``Method``: scale learning rates by the scene, and control density where it is time.

        Rates of lengths are of the scene's extent; that of the skinning follows the number of images, and the
        decays of opacity the rate of opacity.
        """
        self.progress, stage = progress, self.stage
        if self.nodes is not None and self.nodes.led and progress >= stage.bodies:
            put_on_ground(self)
            self.nodes.take_over()
        density.bound_opacity(self)
        for group in optimizer.param_groups:
            if group["name"] in ("means", "node_translations", "node_bodies"):
                group["lr"] *= float(self.extent)
            elif group["name"] == "time_offsets":
                self.nodes.time_offsets.learns = progress >= stage.jitter_until
                if self.nodes.time_offsets.learns:
                    self.nodes.time_offsets.settle(group["lr"])
            elif group["name"] == "opacity":
                learns = group["lr"] / (group["base_lr"] or 1.0)
                decay = stage.decay(float(self.final_count), float(self.covered_pixels))
                self.decay = min(0.99, decay * learns)  # rates may rise
                self.hidden_decay = min(0.99, stage.hidden_decay * learns)
            elif group["name"] == "skinning":
                group["lr"] *= view_share(self.views)
        number = int(progress / stage.density_interval)
        if number > int(self.round) and progress < stage.density_until:
            self.round.fill_(number)
            density.control(self, progress, optimizer)
        return {}

    def warm_up(self) -> None:
        """Compile the operators' kernels."""
        compile_kernels(self)

    def param_groups(self) -> dict[str, list[nn.Parameter]]:
        """See ``Method``."""
        groups = {name: [p] for name, p in self.named_parameters(recurse=False)}
        if self.nodes is not None:
            groups |= {"skinning": [self.skinning.logits]} | self.nodes.param_groups()
        return groups

    def optimizer(self, groups: list[dict]) -> torch.optim.Optimizer:
        """Make an Adam that passes over unseen rows; after a step, let the opacity of what was seen decay."""
        optimizer = RowsAdam(groups)
        optimizer.register_step_post_hook(lambda *_: density.decay_opacity(self))
        if self.nodes is not None and self.nodes.bodies is not None:
            optimizer.register_step_post_hook(lambda *_: self.nodes.bodies.settle())
        return optimizer

    def protocol(self) -> dict[str, str]:
        """See ``Method``."""
        lit = "gain and bias of test images of the film: of smooth curves over time, learned in training"
        return super().protocol() | ({} if self.exposure is None else {"exposure": lit})

    def departures(self) -> list[str]:
        """See ``Method``."""
        note = "particles that are rasterised, not voxels that rays march through"
        return [f"from the forward-flow paper: {note}"]

    @torch.no_grad()
    def moving(self) -> MovingGaussians:
        """See ``HasMovingGaussians``: all particles, in their order."""
        motion, nodes = None, self.nodes
        if nodes is not None:
            if nodes.led:
                nodes = copy.deepcopy(nodes)
                nodes.take_over()
            offsets = nodes.time_offsets
            times = [] if offsets is None else offsets.times
            curves = nodes.translations.data, _data(nodes.rotations), nodes.curve
            skinning = self.skinning.links, self.skinning.weights()
            corrections = [offsets(time) - time for time in times]
            motion = NodeMotion(nodes.positions, *curves, *skinning, times, corrections)
        harmonics = self.colors if self.sh is None else torch.cat([self.colors, self.sh], 1)
        canonical = self.means.data, self.scales.data, self.quaternions.data, self.opacity.data[:, 0]
        over_time = _data(self.color_over_time), _data(self.opacity_over_time), self.canonical_time
        return MovingGaussians(*canonical, harmonics.data, *over_time, self.blur, motion)

    @torch.no_grad()
    def in_motion(self, frames: Sequence[Frame]) -> Tensor:
        """See ``HasLayers``. A particle moves that goes more than ``MOVES`` pixels from its mean place, in
        half of some cameras' images. Motion along their rays, of which images say little, is none; neither is
        that at times of which no image shows the place. Single particles stray: the median with the nearest
        others counts. What rests, or follows only nodes that have stopped, does not move.

        Cost: 256 places in an image for each particle.
        """
        if self.nodes is None:
            return torch.zeros(len(self.means), dtype=torch.bool, device=self.means.device)
        frames = [frames[number] for number in spread(len(frames), _FRAMES)]
        places = torch.stack([moved(self.means.data, self.warp(frame.time))[0] for frame in frames])
        shown = torch.stack([_in_image(frame.camera, now) for frame, now in zip(frames, places)])  # (F, N)
        ranges = []
        for number in spread(len(frames), _CAMERAS):
            pixels, depth = replace(frames[number].camera, lens=None).project(places)
            mean = (pixels * shown[..., None]).sum(0) / shown.sum(0).clamp(min=1)[:, None]
            away = ((pixels - mean).norm(dim=-1) * shown).amax(0)
            ranges.append(torch.where(((depth > 0) | ~shown).all(0), away, torch.nan))
        ranges = torch.stack(ranges).nanmedian(0).values.nan_to_num()
        beside = nearest(self.means.data, self.means.data, _ALIKE)[1]
        return (ranges[beside].median(-1).values > MOVES) & (self.skinning.shares.sum(-1) > 0)

    def common(self) -> Tensor | None:
        """See ``HasCommon``."""
        return None if self.shared is None else self.shared.cpu()

    @torch.no_grad()
    def only(self, rows: Tensor) -> Particles:
        """See ``HasLayers``."""
        part = copy.deepcopy(self, {id(self.frames): self.frames})
        keep_rows(part, rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows)
        return part

    @torch.no_grad()
    def bounds(self, times: list[float]) -> Box | None:
        """See ``HasBounds``."""
        solid = torch.sigmoid(density.most_opaque(self)) > _SOLID
        if not bool(solid.any()):
            return None
        low, high = self.means.new_full((3,), torch.inf), self.means.new_full((3,), -torch.inf)
        for time in times:  # one at a time, as all places of all particles may take gigabytes
            points = moved(self.means.data, self.warp(time))[0][solid]
            low, high = torch.minimum(low, points.amin(0)), torch.maximum(high, points.amax(0))
        pad = 2 * float(self.scales[solid].exp().median()) + 1e-3 * float(self.extent)
        return Box(low - pad, high + pad)

    def matter(self) -> Cloud:
        """See ``HasMatter``."""
        return self.moving().matter()

    def trajectories(self, points: Tensor, times: Tensor) -> Tensor:
        """See ``HasTrajectories``."""
        return self.moving().trajectories(points, times)

    @torch.no_grad()
    def carried(self, view: View, moment: Moment, to: Moment) -> Tensor:
        """See ``CarriesPixels``."""
        return self.at(moment).carried(view, moved(self.means.data, self.warp(to.time))[0])

    def ellipsoids(self, time: float) -> Ellipsoids:
        """See ``HasEllipsoids``."""
        return self.moving().ellipsoids(time)

    def template(self) -> Ellipsoids:
        """See ``HasEllipsoids``."""
        return self.moving().template()

    def movement(self, times: Sequence[float]) -> dict[str, Tensor]:
        """See ``HasEllipsoids``."""
        return self.moving().movement(times)


def _coefficients(before: Tensor | None, *shape: int) -> nn.Parameter | None:
    """Make an effect's coefficients (N, K, ...): those of the stage before, if it has as many, else 0.

    None where the effect is off (K = 0).
    """
    if shape[1] == 0:
        return None
    return nn.Parameter(before if before is not None and before.shape == shape else torch.zeros(shape))


def surface_of(method: Method | None) -> Callable[[Frame], Tensor] | None:
    """Return what renders how far away the surface is in an image, (H, W), 0 where there is none, from
    particles of the stage before; None without them.
    """
    if not isinstance(method, Particles):
        return None

    @torch.no_grad()
    def surface(frame: Frame) -> Tensor:
        camera = frame.camera
        drawn = method.at(Moment(frame.time)).render(View(camera), torch.zeros(3, device=method.device))
        return known_depth(drawn.shaped(camera.height, camera.width))

    return surface


def _data(parameter: Tensor | None) -> Tensor | None:
    return None if parameter is None else parameter.data


def _in_image(camera: Camera, points: Tensor) -> Tensor:
    """Return which points (N, 3) lie before a camera and within its image."""
    pixels, depth = camera.project(points)
    inside = (pixels >= 0) & (pixels < pixels.new_tensor([camera.width, camera.height]))
    return inside.all(-1) & (depth > 0)
