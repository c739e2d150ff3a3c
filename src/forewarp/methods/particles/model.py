"""The method: canonical particles, moved forward by nodes and rasterised."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from forewarp.fields.curves import Curve
from forewarp.methods.method import Method, Snapshot, Start, Step
from forewarp.methods.particles import matter, opacity
from forewarp.methods.particles.camera import Pinholes
from forewarp.methods.particles.density import renew, too_near
from forewarp.methods.particles.effects import Effects, cosines
from forewarp.methods.particles.feasible import check_feasible
from forewarp.methods.particles.nodes import Nodes
from forewarp.methods.particles.packed import add, by_name, kinds_of, packed
from forewarp.methods.particles.planning import EFFECTS, ParticlesPlanning
from forewarp.methods.particles.rest import come_to_rest, pixel_width
from forewarp.methods.particles.settings import Numbers, told_by
from forewarp.methods.particles.skin import Skin
from forewarp.methods.particles.snapshot import ParticlesSnapshot
from forewarp.methods.particles.start import covered_pixels, first_points, first_values, widths
from forewarp.methods.particles.time_offsets import TimeOffsets
from forewarp.methods.rows_adam import RowsAdam
from forewarp.ops.gaussians import BLUR, Gaussians, Warp, compare
from forewarp.ops.nodes import pull_nodes
from forewarp.scene.box import Box
from forewarp.scene.cloud import Cloud, Ellipsoids
from forewarp.scene.view import Asks, Batch, Moment


class Particles(Method):
    """N Gaussians of a template near the canonical state, and M nodes that carry them through time.

    A step draws one whole picture, compares it, and has its gradients in one pass of ``ops.compare``; the
    optimiser passes over what the picture did not show. Stage numbers: see ``settings.Numbers``.

    Args:
        start: what it is built from.
        width: of the loss, where it turns from a square to a line.
        blur: square pixels that every particle is blurred by.
        choices: see ``effects.Effects``.
    """

    terms = ("photo", "rigid", "smooth")
    numbers = tuple(key for key in Numbers.__dataclass_fields__ if key != "name")
    asks = Asks(kind="pictures", straight=True)
    effects = EFFECTS
    on_cpu = "its kernels are the CPU's, and without them only small pictures are feasible"
    planning: ClassVar[ParticlesPlanning] = ParticlesPlanning()
    check_feasible = classmethod(check_feasible)

    def __init__(self, start: Start, *, width: float = 0.05, blur: float = BLUR, **choices) -> None:
        super().__init__()
        self.numbers_of = Numbers(name=start.stage, **start.numbers)
        self.canonical_time, self.width = start.scene.canonical_time, width
        self.pinholes = Pinholes(blur)
        self.views, times = len(start.scene.train), start.scene.times
        on = Effects(**choices).only(self.numbers_of.effects, len(times))
        self.ends = min(times), max(times)
        self.progress = self.decay = 0.0
        self.fading: list[Tensor] = []  # what each picture of this step showed
        before = start.before if isinstance(start.before, Particles) else None
        fresh = None if start.blank or before is not None else self._measured(start)
        self._make(before, fresh, on)
        self.nodes = self.skin = None
        if on.motion is not None:
            count, knots = self.numbers_of.motion(len(self.means), len(times))
            straight = self.numbers_of.straight
            curve = Curve(on.motion, knots, len(times), self.canonical_time, straight=straight)
            points, edges = None if start.blank else self.means.data, self.numbers_of.edges
            turns, rests = on.rotation is not None, on.background is not None
            offsets = TimeOffsets.of(on.motion, times, self.numbers_of.time_offsets)
            self.nodes = Nodes(points, count, curve, offsets, turns=turns, rests=rests, edges=edges)
            self.skin = Skin(self.nodes, self.means.data)
        resting = None if on.background is None else torch.zeros(len(self.means), dtype=torch.bool)
        self.register_buffer("resting", resting)
        self.least_motion = on.background
        for name in ("pulled", "shown", "idle"):
            self.register_buffer(name, torch.zeros(len(self.means)))
        self.register_buffer("round", torch.zeros((), dtype=torch.int64))
        self.grows = self._grows()

    def _measured(self, start: Start) -> dict[str, Tensor]:
        """The first values of every parameter; notes what follows from the pictures, too."""
        covered = covered_pixels(start.scene, list(start.frames))
        most = self.numbers_of.most(covered, self.views)
        cloud = first_points(start, round(self.numbers_of.first * most))
        away = (cloud.points - cloud.points.median(0).values).norm(dim=-1).median()
        extent = float(away) or start.scene.box.diagonal
        self._scalars(covered, extent, most)
        opaque = not start.scene.has_alpha  # else points lie on a surface, and are apart as they should be
        return first_values(cloud, widths(start.scene, cloud.points, covered) if opaque else None)

    def _scalars(self, covered: float, extent: float, most: int) -> None:
        """Pixels that show anything; median distance from the middle; most particles."""
        self.register_buffer("covered", torch.tensor(float(covered)))
        self.register_buffer("extent", torch.tensor(float(extent)))
        self.register_buffer("most", torch.tensor(float(most)))

    def _make(self, before: Particles | None, fresh: dict[str, Tensor] | None, on: Effects) -> None:
        """Give every parameter its first value: of the stage before, fresh ones, or none at all."""
        if before is not None:
            covered = float(before.covered)
            most = self.numbers_of.most(covered, self.views)  # by this stage's own density
            self._scalars(covered, float(before.extent), most)
            first = {n: p.data.to("cpu", copy=True) for n, p in before.named_parameters(recurse=False)}
        elif fresh is not None:
            first = fresh
        else:
            self._scalars(1.0, 1.0, 1)
            first = first_values(Cloud(torch.zeros(1, 3), torch.zeros(1, 3), torch.zeros(1), 1.0))
        count = len(first["means"])
        for name in ("means", "log_scales", "turns", "opacity", "color"):
            setattr(self, name, nn.Parameter(first[name]))
        degree, tints, fades = on.view_dependence or 0, on.color_over_time or 0, on.opacity_over_time or 0
        for name, shape in (("shade", (degree * (degree + 2), 3)), ("tint", (tints, 3)), ("fade", (fades,))):
            value = first.get(name)
            if value is None or value.shape[1:] != shape:
                value = torch.zeros(count, *shape)
            setattr(self, name, nn.Parameter(value) if shape[0] else None)

    def _grows(self) -> tuple[str, ...]:
        names = ["means", "log_scales", "turns", "opacity", "color", "shade", "tint", "fade"]
        names += ["pulled", "shown", "idle", "resting"]
        rows = [] if self.skin is None else [f"skin.{name}" for name in Skin.ROWS]
        return (*(name for name in names if getattr(self, name) is not None), *rows)

    @property
    def moves(self) -> bool:
        """Whether there is any motion."""
        return self.nodes is not None

    @property
    def size(self) -> tuple[str, int]:
        """See ``Method``."""
        return "particles", len(self.means)

    def adopted(self) -> set[str]:
        """See ``Method``: nodes too are as many as a checkpoint says."""
        nodes = () if self.nodes is None else self.nodes.rows()
        return {*self.grows, *(f"nodes.{name}" for name in nodes)}

    def misfit(self, state: Mapping[str, Tensor]) -> str | None:
        """See ``Method``; what is stored of nodes must go together, too."""
        if self.nodes is None:
            return super().misfit(state)
        own, wide = self.nodes, self.skin.links.shape[1]  # few nodes are fewer to follow
        rows = [f"skin.{name}" for name in Skin.ROWS]
        links = {n: state[n][:, :1].expand(-1, wide) for n in rows if state[n].dim() == 2}
        if len({state[n].shape for n in rows}) > 1:
            return rows[0]
        return own.misfit(state, "nodes.", state["skin.links"]) or super().misfit({**state, **links})

    def at(self, moment: Moment) -> Snapshot:
        """Move every particle; nothing is drawn yet."""
        particles, warp = self.gaussians(), self.warp(moment.time)
        return ParticlesSnapshot(moment, particles, warp, *self.over_time(moment.time), self.pinholes)

    def gaussians(self) -> Gaussians:
        """The particles as the operators read them."""
        return packed(self)

    def warp(self, time: float) -> Warp:
        """How everything moves until a time."""
        if self.nodes is not None:
            return Warp(self.nodes.maps(time), self.skin.links, self.skin.weights())
        none = self.means.new_zeros(len(self.means), 1)
        return Warp(self.means.new_zeros(1, 12), none.int(), none)

    def over_time(self, time: float) -> tuple[Tensor, Tensor]:
        """What a time makes of colours (T,) and of opacity (1 + F,)."""
        tints = [] if self.tint is None else self.tints(time)
        fades = [] if self.fade is None else self.fades(time)
        return self.means.new_tensor(tints), self.means.new_tensor([1.0, *fades])

    def tints(self, time: float) -> list[float]:
        """See ``over_time``."""
        return cosines(self.tint.shape[1], time, self.canonical_time)

    def fades(self, time: float) -> list[float]:
        """See ``over_time``."""
        return cosines(self.fade.shape[1], time, self.canonical_time)

    def most_opaque(self) -> Tensor:
        """The logit of each particle's opacity (N,) when it is largest."""
        return opacity.most_opaque(self)

    @torch.no_grad()
    def look(self, batch: Batch, factors: Mapping[str, float], generator: torch.Generator) -> Step:
        """See ``Method``. Pictures are drawn one after the other; each is whole."""
        total, squared, pixels = {}, 0.0, 0
        terms = dict.fromkeys(self.terms, 0.0)
        weight = factors.get("photo", 0.0) / (float(self.covered) * len(batch.observations))
        for seen in batch.observations:
            time = self._jittered(seen.moment.time, generator)
            found, own = self._compared(seen, time, weight, factors, total)
            squared, pixels = squared + found.squared, pixels + 3 * len(seen.view)
            terms["photo"] += found.loss / (float(self.covered) * len(batch.observations))
            for name, value in own.items():
                terms[name] += value / len(batch.observations)
        values = {name: (lambda v=v: self.means.new_tensor(v)) for name, v in terms.items()}
        if self.nodes is None:
            values["rigid"] = values["smooth"] = lambda: None
        error = torch.tensor(squared / pixels, dtype=torch.float64)
        return Step(values, error, {"particles": len(self.means)}, total)

    def _jittered(self, time: float, generator: torch.Generator) -> float:
        spread = self.numbers_of.jitter * max(0.0, 1 - self.progress / self.numbers_of.calm)
        if self.nodes is None or spread == 0:
            return time
        return min(1.0, max(0.0, time + spread * float(torch.randn((), generator=generator))))

    def _compared(self, seen, time: float, weight: float, factors, total: dict) -> tuple:
        """Compare one picture; adds gradients to ``total``, and gives what the nodes' terms are."""
        tints, fades = self.over_time(time)
        own, warp = {}, None
        if self.nodes is not None:
            taken = self.nodes.taken(time)
            self.nodes.look_ahead(taken)
            basis = self.nodes.basis_of_motion((taken, 1.0))
            motion, maps = self.nodes.carried(basis)
            warp = Warp(maps, self.skin.links, self.skin.weights())
        found = compare(
            self.gaussians(), warp or self.warp(time), self.pinholes(seen.view.camera), tints, fades,
            seen.rgb, seen.background, width=self.width, factor=weight, by_skin=warp is not None,
            kinds=kinds_of(self),
        )  # fmt: skip
        self.pulled.add_(found.pull)
        shown = found.pull > 0
        self.shown.add_(shown)
        self.fading.append(shown)
        if self.progress < self.numbers_of.settled:
            self.idle[too_near(found.order, found.distances)] = math.inf
        add(total, by_name(self, found.particles))
        if self.nodes is not None:
            add(total, {"skin.learned": found.skin})
            nodes, rigid = self.nodes, factors.get("rigid", 0.0) * self._loose()
            slope, strain = pull_nodes(
                motion, nodes.places, found.maps, nodes.edges, nodes.edge_weights, rigid
            )
            own["rigid"] = strain
            smooth = factors.get("smooth", 0.0)
            own["smooth"], over_time = nodes.spread_over_time(
                time, taken, basis, slope, smooth, float(self.extent)
            )
            add(total, over_time)
        return found, own

    def _loose(self) -> float:
        """What is left of the rigidity, by how much of the stage is done."""
        return self.numbers_of.loose**self.progress

    def advance(self, progress: float, step: int, optimizer: torch.optim.Optimizer) -> dict[str, float]:
        """Rates of lengths are of the scene's extent, that of weights follows what the pictures tell, and the
        decay of opacity its rate; renew particles where it is time.
        """
        self.progress, numbers = progress, self.numbers_of
        opacity.bound(self)
        for group in optimizer.param_groups:
            if group["name"] in ("means", "shifts"):
                group["lr"] *= float(self.extent)
            elif group["name"] == "time_offsets":
                self.nodes.offsets.learns = progress >= numbers.calm
                if self.nodes.offsets.learns:
                    self.nodes.offsets.settle(group["lr"])
            elif group["name"] == "opacity":
                share = numbers.decay(float(self.most), float(self.covered))
                self.decay = min(0.99, share * group["lr"] / (group["base_lr"] or 1.0))  # rates may rise
            elif group["name"] == "skin":
                group["lr"] *= told_by(self.views)
        number = int(progress / numbers.every)
        if number > int(self.round) and progress < numbers.settled:
            self.round.fill_(number)
            self._renew(progress, optimizer)
        return {}

    def _renew(self, progress: float, optimizer: torch.optim.Optimizer) -> None:
        target = round(float(self.most) * self.numbers_of.share_at(progress))
        low, high = self.ends if self.nodes is None else self.nodes.seen.tolist()
        whole = low <= self.ends[0] + 0.02 and high >= self.ends[1] - 0.02
        renew(self, optimizer, target, unseen=whole and self.nodes is not None, extent=float(self.extent))
        if self.nodes is not None and int(self.round) % self.numbers_of.relink == 0:
            self.skin.relink(self.nodes, self.means.data, optimizer)
            if self.resting is not None:
                self.skin.let_go(self.resting)
                if progress >= self.numbers_of.rest:
                    least = max(self.least_motion, pixel_width(float(self.covered)))
                    come_to_rest(self, least * float(self.extent))

    def warm_up(self) -> None:
        """Compile the operators' kernels."""
        from forewarp.methods.particles.warmup import compile_kernels

        compile_kernels(self)

    def param_groups(self) -> dict[str, list[nn.Parameter]]:
        """See ``Method``."""
        groups = {name: [p] for name, p in self.named_parameters(recurse=False)}
        if self.nodes is not None:
            groups |= {"skin": [self.skin.learned]} | self.nodes.param_groups()
        return groups

    def optimizer(self, groups: list[dict]) -> torch.optim.Optimizer:
        """Adam by rows, whose steps take of opacity what pictures take."""
        made = RowsAdam(groups)
        made.register_step_post_hook(lambda *_: opacity.fade(self))
        return made

    def trajectories(self, points: Tensor, times: Tensor) -> Tensor:
        """See ``HasTrajectories``: points go with the particles beside them."""
        return matter.paths_of(self, points, times)

    def bounds(self, times: list[float]) -> Box | None:
        """See ``HasBounds``."""
        return matter.bounds_of(self, times)

    def at_rest(self) -> float:
        """See ``HasRest``."""
        return 0.0 if self.resting is None else float(self.resting.float().mean())

    def matter(self) -> Cloud:
        """See ``HasMatter``."""
        return matter.matter_of(self)

    def ellipsoids(self, time: float) -> Ellipsoids:
        """See ``HasEllipsoids``."""
        return matter.ellipsoids_of(self, time)

    def template(self) -> Ellipsoids:
        """See ``HasEllipsoids``."""
        return matter.template_of(self)

    def movement(self, times: Sequence[float]) -> dict[str, Tensor]:
        """See ``HasEllipsoids``."""
        return matter.movement_of(self, times)

    def departures(self) -> list[str]:
        """See ``Method``."""
        return [
            "from the forward-flow paper: particles that are rasterised, not voxels that rays march through"
        ]
