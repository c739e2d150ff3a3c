"""Particles: canonical Gaussians, moved forward by nodes and rasterised."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor, nn

from forewarp.fields.curves import Curve
from forewarp.fields.moving import GaussiansSnapshot, MovingGaussians, NodeMotion, pinhole_of
from forewarp.losses import IMAGE_LOSSES, robust
from forewarp.methods.method import Method, Snapshot, Start, Step, value_at
from forewarp.methods.particles import exposure
from forewarp.methods.particles.deformation import Deformation, identity_warp
from forewarp.methods.particles.density import DensityControl
from forewarp.methods.particles.films.contact import known_depth, place_on_ground
from forewarp.methods.particles.films.tracking import body_tracking
from forewarp.methods.particles.gaussians import GaussianModel, coefficients
from forewarp.methods.particles.nodes import Nodes, Skinning, TimeOffsets, are_rows
from forewarp.methods.particles.options import EFFECTS, SMALLEST, Effects, Numbers, view_share
from forewarp.methods.particles.regularizers import REGULARIZERS, Regularizer, RegularizerInput, regularize
from forewarp.methods.particles.start import at_rest, compile_kernels, first_values, fresh_values
from forewarp.methods.particles.windows import begin_window, check_still
from forewarp.methods.rows import RowsAdam, keep_rows, take_rows
from forewarp.ops.gaussians import BLUR, CHUNK, DEEP, Gaussians, ImageLoss, Warp, compare, moved
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.cloud import Cloud, Ellipsoids, nearest
from forewarp.scene.frame import Frame, spread
from forewarp.scene.view import Asks, Batch, Moment, Observation, Rendering, View

_FEWEST_TIMES = 8  # of training, for learned corrections of them
_KEPT = 2**28  # bytes of colours of smaller images that are kept
_SOLID = 0.1  # opacity from which matter bounds the scene
_FRAMES, _CAMERAS = 32, 8  # at whose times, and from which of them, motion is looked at
MOVES = 1.5  # pixels from the mean place, from which on it is seen that a particle moves
_ALIKE = 9  # particles beside each other, whose median counts


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
    optimiser passes over Gaussians that the image does not show.

    Attributes:
        gaussians: what is learned of each (``GaussianModel``).
        deformation: how they move (``Deformation``); None: they do not.
        density: when and where they are split and removed (``DensityControl``).
        hook: what moves nodes in place of their curves for a while (``TrainingHook``); None: nothing does.

    Args:
        start: what it is built from; for the stage's numbers see ``options.Numbers``.
        width: error at which the photometric loss turns from a square to a line.
        deep: relative error at which the loss of depth does.
        blur: square pixels added to the variance of every splat.
        chunk: pairs of a splat and a pixel in memory at once, where there are no kernels.
        choices: see ``options.Effects``.
    """

    regularizers: ClassVar[Mapping[str, Regularizer]] = REGULARIZERS
    terms = ("photo", *IMAGE_LOSSES, "depth", "rigid", "smooth", *REGULARIZERS)
    numbers = tuple(key for key in Numbers.__dataclass_fields__ if key != "name")
    asks = Asks(kind="pictures", straight=True)
    loose = tuple(f"deformation.skinning.{name}" for name in Skinning.ROWS)  # few nodes: fewer links
    effects, still_steps = EFFECTS, 700  # a step is of one image
    on_cpu = "it has no GPU kernels"
    earlier_names = (
        *((name, f"gaussians.{name}") for name in GaussianModel.ROWS),
        *((name, f"density.{name}") for name in (*DensityControl.ROWS, "round")),
        ("nodes.bodies.of_node", "deformation.nodes.groups"),
        ("nodes.bodies.", "hook.bodies."),
        *((name, f"deformation.{name}") for name in ("resting", "nodes.", "skinning.")),
    )

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
        self.progress = 0.0
        self.small_by, self.small = 1.0, {}  # images made so many times smaller, by frame

        self.box = start.scene.box if self.stage.shell and not start.scene.has_alpha else None
        values = self._first_values(start, effects.motion is not None and self.stage.rest_by_masks)
        is_placed, body_of = values.pop("is_placed", None), values.pop("body_of", None)
        self.gaussians = GaussianModel(
            values,
            self.canonical_time,
            degree=effects.view_dependence or 0,
            color_cosines=effects.color_over_time or 0,
            opacity_cosines=effects.opacity_over_time or 0,
        )
        lights = exposure.count_of(effects.exposure or 0, start.scene)
        self.exposure = coefficients(values.get("exposure"), lights, 2, 3) if lights else None
        self.lit_cameras = frozenset(frame.camera_id for frame in train if lights)
        # Rows of the run that windows of a film begin from: particles that stay as they are; -1: of its own.
        self.register_buffer("shared", values.get("shared"))
        self.density = DensityControl(len(self.gaussians), self.stage)
        self.least_motion, self.deformation, self.hook = effects.background, None, None
        if effects.motion is not None:
            self.deformation = self._deformation(start, effects, is_placed, body_of)
            self.hook = body_tracking(self.deformation.nodes, times, self.stage.bodies)
        self.grows = tuple(f"gaussians.{name}" for name in self.gaussians.rows)
        self.grows += tuple(f"density.{name}" for name in self.density.ROWS)
        self.grows += () if self.shared is None else ("shared",)
        if self.deformation is not None:
            self.grows += tuple(f"deformation.{name}" for name in self.deformation.rows)

    def _deformation(
        self, start: Start, effects: Effects, is_placed: Tensor | None, body_of: Tensor | None
    ) -> Deformation:
        """Make nodes on the Gaussians that may move, and let these follow them.

        Args:
            start, effects: of the method.
            is_placed, body_of: (N,) bool and int64, see ``contact.place_on_ground``; None: nothing was.
        """
        means, times, stage = self.gaussians.means.data, start.scene.instants, self.stage
        rotates, rests = effects.rotation is not None, effects.background is not None
        resting, fixed = None, self.fixed
        if rests or self.box is not None or stage.rest_by_masks:
            resting = self.beyond(means)
            if stage.rest_by_masks and not start.blank:
                resting |= at_rest(start.scene, means, surface_of(start.before))
                if is_placed is not None:
                    resting &= ~is_placed
        static = resting if fixed is None else fixed if resting is None else fixed | resting
        free = slice(None) if static is None or bool(static.all()) else ~static
        nodes, knots = stage.motion(len(means[free]), len(times))
        natural = stage.natural_splines
        curve = Curve(effects.motion, knots, len(times), self.canonical_time, straight=natural)
        offsets = None  # cosines are exactly 0 at the canonical time, and few times do not tell
        if stage.time_offsets and effects.motion == "spline" and len(times) >= _FEWEST_TIMES:
            offsets = TimeOffsets(times, stage.time_offsets)
        if stage.bodies == 0 or not rotates:
            body_of = None
        else:
            body_of = (torch.full((len(means),), -1) if body_of is None else body_of)[free]
        points, edges = None if start.blank else means[free], stage.edges
        more = {"rotates": rotates, "rests": rests, "edges": edges, "group_of": body_of}
        return Deformation(Nodes(points, nodes, curve, offsets, **more), means, resting, fixed)

    def _first_values(self, start: Start, places: bool) -> dict[str, Tensor]:
        """Return the first value of every parameter: fresh, or of the stage before.

        Also register ``covered_pixels``: mean number of pixels of an image that show anything; ``extent``:
        median distance of points from the middle; and ``final_count``: how many particles there will be,
        beside those that are ``shared``, then of the ``moving_pixels``.

        Args:
            start: what it is built from.
            places: whether what moves in a film is put on the ground; see ``contact.place_on_ground``.

        Raises:
            ValueError: if the run that a window begins from is not one of particles that stand still.
        """
        moving, before = 1.0, start.before
        if start.shares and not start.blank:
            check_still(isinstance(before, Particles) and (before.shared is not None or before.is_static))
        if isinstance(before, Particles):
            covered, extent = float(before.covered_pixels), float(before.extent)
            values = {name: value.to("cpu", copy=True) for name, value in before.values().items()}
            if start.shares and before.shared is None:
                share, count_of = self.stage.initial_share, before.stage.final_count
                values, moving = begin_window(
                    values, before.drawn, start, lambda pixels: round(share * count_of(pixels, before.views))
                )
            else:
                if before.shared is not None:
                    values["shared"], moving = before.shared.to("cpu", copy=True), float(before.moving_pixels)
                if places and not before.moves and not start.blank:
                    values = place_on_ground(values, start.scene, before.drawn, before.light_of)
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

    def values(self) -> dict[str, Tensor]:
        """Return all that is learned of Gaussians and exposure, by name."""
        named = [*self.gaussians.named_parameters(), *self.named_parameters(recurse=False)]
        return {name: parameter.data for name, parameter in named}

    @property
    def fixed(self) -> Tensor | None:
        """Which Gaussians (N,) bool stay as they are, as other windows share them; None: none."""
        return None if self.shared is None else self.shared >= 0

    @property
    def is_static(self) -> bool:
        """Whether nothing changes over time but exposure."""
        changes = self.gaussians.color_over_time, self.gaussians.opacity_over_time, self.deformation
        return all(change is None for change in changes)

    def beyond(self, points: Tensor) -> Tensor:
        """Return which points (N, 3) lie outside the box in which motion is looked for: bool (N,)."""
        if self.box is None:
            return torch.zeros(len(points), dtype=torch.bool, device=points.device)
        low, high = points.new_tensor(self.box.low), points.new_tensor(self.box.high)
        return ((points < low) | (points > high)).any(-1)

    @property
    def moves(self) -> bool:
        """Whether there is any motion."""
        return self.deformation is not None

    @property
    def size(self) -> tuple[str, int]:
        """See ``Method``."""
        return "particles", len(self.gaussians)

    def misfit(self, state: Mapping[str, Tensor]) -> str | None:
        """See ``Method``; what is stored of the skinning must go together with all nodes, too."""
        misfit = super().misfit(state)
        if misfit or self.deformation is None:
            return misfit
        links, *others = (state[name] for name in self.loose)
        fits = len(links) == len(state["gaussians.means"]) and all(links.shape == t.shape for t in others)
        fits = fits and are_rows(links, len(state["deformation.nodes.positions"]))
        return None if fits else self.loose[0]

    def at(self, moment: Moment) -> Snapshot:
        """Move every particle; nothing is rendered yet."""
        gaussians, bases = self.gaussians.joined(self.light(moment)), self.gaussians.time_bases(moment.time)
        warp = self.warp(moment.time)
        return ParticlesSnapshot(moment, gaussians, warp, *bases, self.blur, self.chunk, self.lit_cameras)

    @torch.no_grad()
    def drawn(self, frame: Frame) -> Rendering:
        """Render what a training image shows (H, W), before black."""
        camera = frame.camera
        drawn = self.at(_moment_of(frame)).render(View(camera), torch.zeros(3, device=self.device))
        return drawn.shaped(camera.height, camera.width)

    def light_of(self, frame: Frame) -> Tensor | None:
        """Return the ``light`` of a training image."""
        return self.light(_moment_of(frame))

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

    def warp(self, time: float) -> Warp:
        """Return how all Gaussians move from the canonical state to a time."""
        if self.deformation is None:
            return identity_warp(self.gaussians.means)
        nodes = self.deformation.nodes
        motion, maps = nodes.motion_and_maps(nodes.basis(time))
        if self.is_led:
            self.hook.move(time, motion, maps)
        return self.deformation.warp_by(maps)

    @property
    def is_led(self) -> bool:
        """Whether a hook moves nodes in place of their curves."""
        return self.hook is not None and self.hook.leads

    @torch.no_grad()
    def look(self, batch: Batch, factors: Mapping[str, float], generator: torch.Generator) -> Step:
        """See ``Method``. Images are rendered one after the other, each as a whole."""
        terms, gradients = dict.fromkeys(self.terms, 0.0), {}
        squared, numbers, views, has_depth = 0.0, 0, len(batch.observations), False
        for whole in batch.observations:
            if self.is_led:
                self.hook.before_image(self, whole)
            seen = self._smaller(whole)
            covered = float(self.covered_pixels) * len(seen.view) / len(whole.view)
            squared_error, of_image, found = self._compare(seen, factors, generator, views, covered)
            count = len(seen.view) if seen.valid is None else int(seen.valid.sum())
            squared, numbers = squared + squared_error, numbers + 3 * count
            for name, value in of_image.items():
                before = terms[name] or 0.0  # one image may have a term that another lacks
                terms[name] = (before or None) if value is None else before + value / views
            has_depth |= seen.sensed is not None
            for name, value in found.items():
                gradients[name] = gradients[name] + value if name in gradients else value
        terms["depth"] = terms["depth"] if has_depth else None
        like = self.gaussians.means
        values = {n: (lambda v=v: None if v is None else like.new_tensor(v)) for n, v in terms.items()}
        error = torch.tensor(squared / numbers, dtype=torch.float64)
        return Step(values, error, {"particles": len(self.gaussians)}, gradients)

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
    ) -> tuple[float, dict[str, float | None], dict[str, Tensor]]:
        """Compare with one of a step's images, of which ``covered`` pixels show anything.

        Returns:
            the sum of squared errors; the terms, None where an effect is off; and the step's gradients, by
            parameter.
        """
        time, gaussians = self._jittered(seen.moment.time, generator), self.gaussians
        deformation, now, is_led = self.deformation, None, self.is_led
        if deformation is None:
            warp = identity_warp(gaussians.means)
        else:
            now = deformation.at(time)
            if is_led:
                self.hook.move(time, now.motion, now.maps)
            warp = deformation.warp_by(now.maps)
        light, terms = self.light(seen.moment), {}
        loss = self._image_loss(factors, terms)
        of_colors = factors.get("photo", 0.0) if loss is None else 1.0
        sensed = seen.sensed if "depth" in factors else None
        by_depth = factors.get("depth", 0.0) / of_colors
        more = {"loss": loss, "sensed": sensed, "by_depth": by_depth}
        compared = self.compared(
            seen, gaussians.joined(light), warp, time, of_colors / (covered * views), **more
        )
        terms = {"depth": compared.depth} | (terms or {"photo": compared.loss})
        terms = {name: value / covered for name, value in terms.items()}
        by_place, fixed = compared.pixel_gradient, self.fixed
        self.density.count(by_place if fixed is None else by_place.masked_fill(fixed, 0.0))
        self.density.mark_too_near(self.progress, compared.order, compared.distances)
        gradients, found = {}, compared.particles
        if light is not None:
            unlit = [getattr(gaussians, name) for name in gaussians.color_names]
            drift = self._drift(seen.moment.time)
            by_kind, gradients["exposure"] = exposure.to_unlit(unlit, found.colors, light, drift)
            found = found._replace(colors=by_kind)
        gradients |= {f"gaussians.{name}": value for name, value in gaussians.split(found).items()}
        extent = float(self.extent)
        values, by_motion, by_name = regularize(
            {name: function for name, function in self.regularizers.items() if name in factors},
            factors,
            RegularizerInput(gaussians, deformation, None if now is None else now.motion, extent),
            self.named_parameters(),
        )
        terms |= values
        if now is None:
            terms |= {"rigid": None, "smooth": None}
        else:
            rigid = factors.get("rigid", 0.0) * self.stage.rigid_final_factor**self.progress
            factors = dict(factors) | {"rigid": rigid}
            of_motion, by_nodes = deformation.gradients(
                now, compared.maps, factors, extent, by_motion, learns=not is_led
            )
            terms |= of_motion
            by_nodes["skinning.logits"] = compared.skin
            gradients |= {f"deformation.{name}": value for name, value in by_nodes.items()}
        if is_led:
            by_hook = self.hook.gradients(time, compared.maps)
            gradients |= {f"hook.{name}": value for name, value in by_hook.items()}
        for name, gradient in by_name.items():
            gradients[name] = gradients[name] + gradient if name in gradients else gradient
        if fixed is not None:
            for name in gradients.keys() & {*self.grows}:
                gradients[name][fixed] = 0.0  # the optimiser passes over them
        return compared.squared, terms, gradients

    def compared(
        self, seen: Observation, particles: Gaussians, warp: Warp, time: float, factor: float, *,
        loss: Callable | None = None, sensed: Tensor | None = None, by_depth: float = 0.0,
    ) -> ImageLoss:  # fmt: skip
        """Compare particles, moved by a warp, with an image; see ``ops.gaussians.compare``."""
        return compare(
            particles, warp, pinhole_of(seen.view.camera, self.blur), *self.gaussians.time_bases(time),
            seen.rgb, seen.background, width=self.width, factor=factor, by_skin=self.moves,
            kinds=self.gaussians.color_kinds, loss=loss, valid=seen.valid, sensed=sensed,
            by_depth=by_depth, deep=self.deep, chunk=self.chunk,
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
        if self.deformation is None or self.is_led or deviation == 0:
            return time
        return min(1.0, max(0.0, time + deviation * float(torch.randn((), generator=generator))))

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """See ``Method``: scale learning rates by the scene, and control density where it is time.

        Rates of lengths are of the scene's extent; that of the skinning follows the number of images, and the
        decays of opacity the rate of opacity.
        """
        self.progress, stage, deformation = progress, self.stage, self.deformation
        if self.is_led:
            self.hook.update(self, progress)
        self.gaussians.bound_opacity()
        for group in optimizer.param_groups:
            if group["name"] in ("means", "node_translations", "node_bodies"):
                group["lr"] *= float(self.extent)
            elif group["name"] == "time_offsets":
                offsets = deformation.nodes.time_offsets
                offsets.learns = progress >= stage.jitter_until
                if offsets.learns:
                    offsets.settle(group["lr"])
            elif group["name"] == "opacity":
                learns = group["lr"] / (group["base_lr"] or 1.0)
                decay = stage.decay(float(self.final_count), float(self.covered_pixels))
                self.density.decay = min(0.99, decay * learns)  # rates may rise
                self.density.hidden_decay = min(0.99, stage.hidden_decay * learns)
            elif group["name"] == "skinning":
                group["lr"] *= view_share(self.views)
        if self.density.is_due(progress):
            self.control_density(progress, optimizer)
        return {}

    @torch.no_grad()
    def control_density(self, progress: float, optimizer: torch.optim.Optimizer) -> None:
        """Run a round of density control; every few rounds, link particles to nodes anew, and let nodes rest.

        Args:
            progress: fraction of the stage that is done.
            optimizer: whose moments follow.
        """
        stage, deformation, all_times = self.stage, self.deformation, False
        if deformation is not None:
            first, last = deformation.nodes.seen_times.tolist()
            all_times = first <= self.ends[0] + 0.02 and last >= self.ends[1] - 0.02
        self.density.densify_and_prune(
            self.gaussians,
            round(float(self.final_count) * stage.share_at(progress)),
            partial(take_rows, self, optimizer),
            extent=float(self.extent),
            far=self.beyond(self.gaussians.means.data),
            fixed=self.fixed,
            all_times=all_times,
        )
        if deformation is None or int(self.density.round) % stage.relink:
            return
        deformation.reskin(self.gaussians.means.data, optimizer, self.fixed)
        if self.least_motion is not None and progress >= stage.rest_from and not self.is_led:
            least = max(self.least_motion, pixel_width(float(self.covered_pixels))) * float(self.extent)
            deformation.freeze_static_nodes(self.gaussians, self.ends, least, self.fixed)

    def warm_up(self) -> None:
        """Compile the operators' kernels."""
        compile_kernels(self.gaussians.means, self.has_planes)

    def param_groups(self) -> dict[str, list[nn.Parameter]]:
        """See ``Method``."""
        named = [*self.gaussians.named_parameters(), *self.named_parameters(recurse=False)]
        groups = {name: [parameter] for name, parameter in named}
        if self.deformation is not None:
            groups |= {"skinning": [self.deformation.skinning.logits]} | self.deformation.nodes.param_groups()
        if self.hook is not None:
            groups |= self.hook.param_groups()
        if "time_offsets" in groups:  # last, as checkpoints number parameters
            groups["time_offsets"] = groups.pop("time_offsets")
        return groups

    def optimizer(self, groups: list[dict]) -> torch.optim.Optimizer:
        """Make an Adam that passes over unseen rows; after a step, let the opacity of what was seen decay."""
        optimizer = RowsAdam(groups)
        optimizer.register_step_post_hook(
            lambda *_: self.density.decay_opacity(self.gaussians.opacity, self.fixed)
        )
        if self.hook is not None:
            optimizer.register_step_post_hook(lambda *_: self.hook.after_step())
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
        motion, gaussians = None, self.gaussians
        if self.deformation is not None:
            nodes, skinning = self.deformation.nodes, self.deformation.skinning
            if self.is_led:
                nodes = copy.deepcopy(nodes)
                self.hook.fit_curves(nodes)
            offsets = nodes.time_offsets
            times = [] if offsets is None else offsets.times
            curves = nodes.translations.data, _data(nodes.rotations), nodes.curve
            corrections = [offsets(time) - time for time in times]
            followed = skinning.links, skinning.weights()
            motion = NodeMotion(nodes.positions, *curves, *followed, times, corrections)
        return MovingGaussians(
            gaussians.means.data,
            gaussians.scales.data,
            gaussians.quaternions.data,
            gaussians.opacity.data[:, 0],
            gaussians.harmonics(),
            _data(gaussians.color_over_time),
            _data(gaussians.opacity_over_time),
            self.canonical_time,
            self.blur,
            motion,
        )

    @torch.no_grad()
    def in_motion(self, frames: Sequence[Frame]) -> Tensor:
        """See ``HasLayers``. A particle moves that goes more than ``MOVES`` pixels from its mean place, in
        half of some cameras' images. Motion along their rays, of which images say little, is none; neither is
        that at times of which no image shows the place. Single particles stray: the median with the nearest
        others counts. What rests, or follows only nodes that have stopped, does not move.

        Cost: 256 places in an image for each particle.
        """
        means = self.gaussians.means.data
        if self.deformation is None:
            return torch.zeros(len(means), dtype=torch.bool, device=means.device)
        frames = [frames[number] for number in spread(len(frames), _FRAMES)]
        places = torch.stack([moved(means, self.warp(frame.time))[0] for frame in frames])
        shown = torch.stack([_in_image(frame.camera, now) for frame, now in zip(frames, places)])  # (F, N)
        ranges = []
        for number in spread(len(frames), _CAMERAS):
            pixels, depth = replace(frames[number].camera, lens=None).project(places)
            mean = (pixels * shown[..., None]).sum(0) / shown.sum(0).clamp(min=1)[:, None]
            away = ((pixels - mean).norm(dim=-1) * shown).amax(0)
            ranges.append(torch.where(((depth > 0) | ~shown).all(0), away, torch.nan))
        ranges = torch.stack(ranges).nanmedian(0).values.nan_to_num()
        beside = nearest(means, means, _ALIKE)[1]
        return (ranges[beside].median(-1).values > MOVES) & (self.deformation.skinning.shares.sum(-1) > 0)

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
        solid = torch.sigmoid(self.gaussians.most_opaque()) > _SOLID
        if not bool(solid.any()):
            return None
        means = self.gaussians.means.data
        low, high = means.new_full((3,), torch.inf), means.new_full((3,), -torch.inf)
        for time in times:  # one at a time, as all places of all particles may take gigabytes
            points = moved(means, self.warp(time))[0][solid]
            low, high = torch.minimum(low, points.amin(0)), torch.maximum(high, points.amax(0))
        pad = 2 * float(self.gaussians.scales[solid].exp().median()) + 1e-3 * float(self.extent)
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
        return self.at(moment).carried(view, moved(self.gaussians.means.data, self.warp(to.time))[0])

    def ellipsoids(self, time: float) -> Ellipsoids:
        """See ``HasEllipsoids``."""
        return self.moving().ellipsoids(time)

    def template(self) -> Ellipsoids:
        """See ``HasEllipsoids``."""
        return self.moving().template()

    def movement(self, times: Sequence[float]) -> dict[str, Tensor]:
        """See ``HasEllipsoids``."""
        return self.moving().movement(times)


def surface_of(method: Method | None) -> Callable[[Frame], Tensor] | None:
    """Return what renders how far away the surface is in an image, (H, W), 0 where there is none, from
    particles of the stage before; None without them.
    """
    return (lambda frame: known_depth(method.drawn(frame))) if isinstance(method, Particles) else None


def _moment_of(frame: Frame) -> Moment:
    """Return the moment of a training image, in its light."""
    return Moment(frame.time, camera=frame.camera_id, filmed=True)


def pixel_width(covered: float) -> float:
    """Return the width of a pixel as a share of the scene's extent, from the number of covered pixels.

    Roughly: as of a disc that fills the covered pixels, whose extent (the median distance from its middle) is
    its radius over the root of 2. Of images that show a part of the scene each it is too large.

    >>> round(pixel_width(20_000.0), 4)
    0.0177
    """
    return math.sqrt(2 * math.pi / max(covered, 1.0))


def _data(parameter: Tensor | None) -> Tensor | None:
    return None if parameter is None else parameter.data


def _in_image(camera: Camera, points: Tensor) -> Tensor:
    """Return which points (N, 3) lie before a camera and within its image."""
    pixels, depth = camera.project(points)
    inside = (pixels >= 0) & (pixels < pixels.new_tensor([camera.width, camera.height]))
    return inside.all(-1) & (depth > 0)
