"""The particles that are timed, a figure like D-NeRF's hook, and the tables of their steps.

After 2,500 steps hook had 12,616 particles and 200 nodes of 22 coefficients; its images of 400 x 400 showed
something at 19,650 pixels, and tiles had 60,000 particles to look at. The figure: 12,000, 200 of 22, 17,000
and 56,000.
"""

from __future__ import annotations

import math
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from unittest.mock import patch

import lightning
import torch
from torch import Tensor

from forewarp.data.module import SceneDataModule
from forewarp.methods.method import Start
from forewarp.methods.particles.model import Particles, pinhole_of
from forewarp.ops.gaussians import Gaussians, Splats, Warp, compare, project, rasterize
from forewarp.ops.nodes import pull_nodes, skin_weights
from forewarp.runs.build import build_run
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.cloud import Cloud, Handover
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Moment, View
from forewarp.training.stages import Run
from tests.bench.workloads import VERDICTS, milliseconds, slope, timed
from tests.stability.report import implementation, table
from tests.support.configs import composed
from tests.support.kernels import kernels_of

COUNT, SIDE, NODES = 12_000, 400, 200
LEARNED = 2_000  # steps that most particles had learned from by then
TIMES, VIEWS = 100, 8  # training times; different pictures of them
WHITE, MIDDLE = torch.ones(3), 0.5
# From, to and radius of the capsules that the figure consists of: body, head, arms, legs.
LIMBS = (
    ((0.0, 0.0, -0.1), (0.0, 0.0, 0.35), 0.22),
    ((0.0, 0.0, 0.7), (0.0, 0.0, 0.75), 0.14),
    *(((0.22 * s, 0.0, 0.4), (0.75 * s, 0.1, 0.15), 0.07) for s in (-1, 1)),
    *(((0.12 * s, 0.0, -0.25), (0.22 * s, 0.0, -0.95), 0.1) for s in (-1, 1)),
)
BOX = Box((-1.0, -0.5, -1.2), (1.0, 0.5, 1.1))


@dataclass(frozen=True)
class Size:
    """What is timed: so many ``particles`` and ``nodes``, pictures of ``side`` squared pixels; ``zoom`` makes
    the figure larger in them, at 1 it is as large as hook.
    """

    particles: int = COUNT
    side: int = SIDE
    nodes: int = NODES
    zoom: float = 1.0


def figure(count: int) -> tuple[Gaussians, float]:
    """Particles on the figure's surface, and how far they are apart; sizes and opacities as hook's."""
    draw = torch.Generator().manual_seed(0)
    areas = torch.tensor([2 * math.pi * r * (math.dist(a, b) + 2 * r) for a, b, r in LIMBS])
    limb = torch.multinomial(areas, count, replacement=True, generator=draw)
    first, last, radius = (torch.tensor(part)[limb] for part in zip(*LIMBS))
    outward = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw), dim=-1)
    along = torch.rand(count, 1, generator=draw)
    means = torch.lerp(first, last, along) + radius[:, None] * outward
    apart = math.sqrt(float(areas.sum()) / count)
    scales = math.log(apart) + torch.tensor([-0.1, -0.8, -1.7]) + 0.7 * torch.randn(count, 3, generator=draw)
    quaternions = torch.randn(count, 4, generator=draw)
    opacity = 1.5 + 2.4 * torch.randn(count, 1, generator=draw)
    colors = torch.cat([torch.randn(count, 1, 3, generator=draw), torch.zeros(count, 3, 3)], 1)
    return Gaussians(means, scales, quaternions, opacity, colors), apart


def camera(side: int, turn: float, zoom: float = 1.0) -> Camera:
    """A camera about the figure, as D-NeRF's are."""
    at = torch.tensor([3.8 * math.cos(6.283 * turn), 3.8 * math.sin(6.283 * turn), 1.4])
    pose = look_at(at, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    focal = 1.39 * side * zoom
    return Camera(side, side, focal, focal, side / 2, side / 2, pose, 2.0, 6.0)


@torch.no_grad()
def photograph(particles: Gaussians, view: Camera) -> Tensor:
    """A picture (H, W, 4) uint8 of particles that nothing moves, in other colours than they have."""
    count = len(particles.means)
    none = torch.zeros(count, 1)
    changed = particles._replace(colors=particles.colors + 0.2)
    still = Warp(torch.zeros(1, 12), none.int(), none)
    splats = project(changed, still, pinhole_of(view, 0.3), torch.zeros(0), torch.ones(1))
    drawn = rasterize(splats, view.width, view.height)
    solid = 1 - drawn.transmittance
    straight = (drawn.color / solid.clamp(min=1e-6)).clamp(0, 1)
    return (255 * torch.cat([straight, solid[None]])).round().to(torch.uint8).permute(1, 2, 0).contiguous()


@cache
def scene_of(count: int, side: int, zoom: float = 1.0) -> Scene:
    """The figure at many times; pictures repeat."""
    particles, _ = figure(count)
    cameras = [camera(side, i / VIEWS, zoom) for i in range(VIEWS)]
    pictures = [photograph(particles, view) for view in cameras]
    frames = tuple(
        Frame(f"r_{i}", i / (TIMES - 1), cameras[i % VIEWS], lambda i=i: pictures[i % VIEWS])
        for i in range(TIMES)
    )
    return Scene("figure", frames, (), (), BOX, 0.0, has_alpha=True)


def run_of(size: Size, steps: int, folder: Path, effects: Sequence[str] = ()) -> Run:
    """A run of the figure by the project's own numbers, but particles stay as many and nothing is drawn.

    ``effects``: overrides that choose other effects than cut-out pictures have by default.
    """
    nodes = size.nodes / math.sqrt(size.particles)
    config = composed(
        "model=particles", "trainer=cpu", "~stage.coarse", "callbacks.pictures=null", f"run={folder}",
        "budget.minutes=null", f"budget.iterations={steps}", f"stage.fine.nodes={nodes}",
        "stage.fine.initial_share=1.0", "stage.fine.density_interval=1.0", "stage.fine.density=1000",
        "stage.fine.crowd_decay=0.0", *effects,  # as hook, which has fewer particles than pixels
    )  # fmt: skip
    run = build_run(config)
    data = SceneDataModule(lambda: scene_of(size.particles, size.side, size.zoom), background="random")
    make = run.model
    return replace(run, datamodule=data, model=lambda start: _made(make, start, size), tell=lambda _: None)


@torch.no_grad()
def _made(make: Callable[[Start], Particles], start: Start, size: Size) -> Particles:
    """The method as it is after some training: particles as the figure has them, nodes that have moved."""
    particles, apart = figure(size.particles)
    cloud = Cloud(particles.means, torch.full_like(particles.means, 0.5), torch.ones(size.particles), apart)
    method = make(replace(start, handover=Handover(BOX, True, TIMES, cloud)))
    if not start.blank:
        method.gaussians.scales.copy_(particles.log_scales)
        method.gaussians.quaternions.copy_(particles.quaternions)
        method.gaussians.opacity.copy_(particles.opacity)
        method.gaussians.colors.copy_(particles.colors[:, :1])
        if method.deformation is not None:
            draw = torch.Generator().manual_seed(1)
            for curves in (method.deformation.nodes.translations, method.deformation.nodes.rotations):
                if curves is not None:
                    curves.copy_(0.02 * torch.randn(curves.shape, generator=draw))
            method.deformation.nodes.seen_times.copy_(torch.tensor([0.0, 1.0]))
    return method


class Loop:
    """A step of the figure without Lightning: draw, look, optimise.

    Args:
        size: of the figure.
        effects: overrides that choose other effects than cut-out pictures have by default.
        fraction: of the stage that is taken to be done.
        learned: steps that all parameters are taken to have learned from, which the optimiser counts.
    """

    def __init__(
        self, size: Size, effects: Sequence[str] = (), *, fraction: float = 0.7, learned: int = LEARNED
    ) -> None:
        with tempfile.TemporaryDirectory() as folder:
            run = run_of(size, 1000, Path(folder) / "run", effects)
        run.datamodule.setup("fit")
        torch.manual_seed(0)
        self.module = run._module(run.stages[0])
        self.method, self.fraction = self.module.method, fraction
        self.method.warm_up()
        run.datamodule.picker, run.datamodule.asks = self.module.curriculum, self.method.asks
        self.module.curriculum.fraction = fraction
        self.optimizer = self.module.configure_optimizers()
        self.batches = iter(run.datamodule.train_dataloader())
        self.parameters = dict(self.method.named_parameters())
        self.factors = self.module.objective.factors(0)
        self.view = View(camera(size.side, 0.3, size.zoom))
        self.step()
        for state in self.optimizer.state.values():
            state["steps"].fill_(learned)

    def step(self) -> None:
        """Take a whole step."""
        for group in self.optimizer.param_groups:
            group["lr"] = group["base_lr"]
        self.method.advance(self.fraction, 0, self.optimizer)
        gradients = self.module.look(next(self.batches), self.factors).gradients
        for name, p in self.parameters.items():
            p.grad = gradients[name]
        self.optimizer.step()

    def covered(self) -> float:
        """Pixels that show something, on average over the pictures."""
        return float(self.method.covered_pixels)

    @torch.no_grad()
    def picture(self) -> Tensor:
        """Draw a picture of another time."""
        return self.method.at(Moment(MIDDLE)).render(self.view, WHITE).rgb


STEPS, FEW = 40, 5  # repetitions: of what takes milliseconds, of what takes long
# Of which kernels a part consists: the module's name in ``ops.kernels``, and its functions; none named: all.
PARTS = {
    "projection": (("project", ("project",)),),
    "sorting into tiles": (("rasterize", ("sort_into_tiles",)),),
    "forward: a picture's": (("rasterize", ("draw",)),),
    "forward, loss and backward": (("rasterize", ("compare",)),),
    "chain, back to particles and nodes": (("project", ("splat_gradients", "chain")),),
    "nodes": (("nodes", ("carry", "pull", "spread")),),
    "weights of nodes": (("nodes", ("weigh",)),),
    "optimiser": (("adam", ()),),
}
SMALLER = 16  # times as small along a side as the picture that plain PyTorch draws
SIZES = {
    "particles": (3_000, 6_000, 12_000, 24_000),
    "side": (100, 200, 400, 800),
    "zoom": (0.25, 0.5, 1.0, 2.0),
    "nodes": (100, 200, 400, 800),
}
AXES = {
    "particles": "particles",
    "side": "side of the picture",
    "zoom": "covered pixels of as many",
    "nodes": "nodes",
}
MOVES = (
    *("model/rotation=none", "model/view_dependence=none", "model/color_over_time=none"),
    *("model/opacity_over_time=none", "model/background=none"),
)  # along splines, which are the default
NONE = ("model/motion=none", *MOVES)
# Each effect alone, on what it needs: what is typed.
ALONE = {
    "nothing: particles at rest, of one colour each": NONE,
    "view dependence, degree 1": (*NONE, "model/view_dependence=harmonics"),
    "view dependence, degree 3": (*NONE, "model/view_dependence=harmonics", "model.view_dependence=3"),
    "colour over time": (*NONE, "model/color_over_time=cosines"),
    "opacity over time": (*NONE, "model/opacity_over_time=cosines"),
    "motion, without rotation": MOVES,
    "motion": (*MOVES, "model/rotation=nodes"),
    "motion and a background that rests": (*MOVES, "model/rotation=nodes", "model/background=still"),
    "all that cut-out pictures have by default": (),
}
THREADS = (1, 2, 4, 8, 16)
LEAST_SHARE, LEAST_GAIN, STEP_MS, PICTURE_MS = 0.8, 1.6, 7.0, 5.0  # the goals


@contextmanager
def kernels_timed() -> Iterator[dict[tuple[str, str], float]]:
    """Add up the seconds of processor time in each kernel by module and name; all must be compiled before."""
    spent: dict[tuple[str, str], float] = {}

    def clocked(key: tuple[str, str], kernel: Callable) -> Callable:
        def call(*arguments):
            begin = time.process_time()
            try:
                return kernel(*arguments)
            finally:
                spent[key] = spent.get(key, 0.0) + time.process_time() - begin

        return call

    with ExitStack() as stack:
        for part in {part for kernels in PARTS.values() for part, _ in kernels}:
            home, kernels = kernels_of(part)
            for name, kernel in kernels.items():
                stack.enter_context(patch.object(home, name, clocked((part, name), kernel)))
        yield spent


def parts_of(work: Callable[[], object], repeats: int = STEPS) -> dict[str, float]:
    """Median seconds of each of ``PARTS`` in a piece of work, of those that it has."""
    work()
    rounds = []
    for _ in range(repeats):
        with kernels_timed() as spent:
            work()
        rounds.append(spent)
    found = {}
    for name, kernels in PARTS.items():
        keys = [
            k for k in rounds[0] for part, names in kernels if k[0] == part and (not names or k[1] in names)
        ]
        if keys:
            found[name] = statistics.median(sum(spent[key] for key in keys) for spent in rounds)
    return found


def yardstick() -> float:
    """Seconds that PyTorch takes for a million exponentials: how fast the processor is at the moment."""
    numbers = torch.linspace(-5, 0, 1 << 20)
    return timed(numbers.exp, STEPS)


def plain_times(loop: Loop, size: Size) -> dict[str, float]:
    """Seconds of the same parts in plain PyTorch; pictures are drawn smaller, and their seconds multiplied.

    Plain PyTorch looks at every particle at every pixel, so that its seconds follow the pixels exactly.
    """
    method, smaller = loop.method, max(1, size.side // SMALLER)
    view, times = camera(size.side, 0.3), (size.side / smaller) ** 2
    color_basis, opacity_basis = method.gaussians.time_bases(MIDDLE)
    particles, warp = (
        type(p)(*(t.detach() for t in p)) for p in (method.gaussians.joined(), method.warp(MIDDLE))
    )
    seen = (particles, warp, pinhole_of(view, method.blur), color_basis, opacity_basis)
    little = (*seen[:2], pinhole_of(camera(smaller, 0.3), method.blur), *seen[3:])
    truth = torch.zeros(smaller**2, 4, dtype=torch.uint8)
    nodes, found = method.deformation.nodes, {}
    with implementation("reference"):
        found["projection"] = timed(lambda: project(*seen), FEW)
        splats = Splats(*(t.detach() for t in project(*little)))
        found["forward: a picture's"] = times * timed(lambda: rasterize(splats, smaller, smaller), FEW)
        found["forward, loss and backward"] = times * timed(lambda: compare(*little, truth, WHITE), FEW)
        leaves = Gaussians(*(part.clone().requires_grad_() for part in particles))
        numbers = project(leaves, *seen[1:]).values.sum()
        found["chain, back to particles and nodes"] = timed(lambda: numbers.backward(retain_graph=True), FEW)
        skin = method.deformation.skinning
        found["weights of nodes"] = timed(lambda: skin_weights(skin.shares, skin.logits.detach()), FEW)
        motion, maps = nodes.motion_and_maps(nodes.curve(MIDDLE))
        pulled = (motion.detach(), nodes.positions, maps.detach(), nodes.edges, nodes.edge_weights, 1.0)
        found["nodes"] = timed(lambda: pull_nodes(*pulled), FEW)
    copies = [torch.nn.Parameter(p.detach().clone()) for p in method.parameters()]
    for copy in copies:
        copy.grad = torch.ones_like(copy)
    found["optimiser"] = timed(torch.optim.Adam(copies).step, FEW)
    return found


def parts_table(size: Size = Size()) -> str:  # noqa: B008
    """Time the parts of a step and of a picture, each against the yardstick and plain PyTorch."""
    loop = Loop(size)
    unit, plain = yardstick(), plain_times(loop, size)
    own = parts_of(loop.picture) | parts_of(loop.step)
    step, picture = timed(loop.step, STEPS), timed(loop.picture, STEPS)
    lines = []
    for name, seconds in own.items():
        slow = plain.get(name)
        beside = ["", ""] if slow is None else [milliseconds(slow), f"{slow / seconds:.0f}"]
        lines.append([name, milliseconds(seconds), f"{seconds / unit:.3g}", *beside])
    inside = sum(s for name, s in own.items() if name != "forward: a picture's")
    rest = ["all else of a step: drawing the batch, PyTorch, Python", step - inside]
    for name, seconds in (rest, ["**a whole step**", step], ["**a picture**", picture]):
        lines.append([name, milliseconds(seconds), f"{seconds / unit:.3g}", "", ""])
    lines.append(["a million exponentials by PyTorch", milliseconds(unit), "1.00", "", ""])
    return table(["part", "ms", "against exponentials", "plain PyTorch, ms", "times faster"], lines)


def growth_table(size: Size = Size(), sizes: dict[str, Sequence[int]] | None = None) -> str:  # noqa: B008
    """Time a step and a picture while particles, pixels or nodes grow, and steps while threads do."""
    parts = []
    for name, values in (SIZES if sizes is None else sizes).items():
        steps, pictures, shown = [], [], []
        for value in values:
            loop = Loop(replace(size, **{name: value}))
            steps.append(timed(loop.step, STEPS))
            pictures.append(timed(loop.picture, STEPS))
            shown.append(round(loop.covered()) if name == "zoom" else value)
        grown = [value**2 for value in values] if name == "side" else shown
        fitted = [slope(grown, seconds) for seconds in (steps, pictures)]
        against = {"side": "pixels", "zoom": "covered pixels"}.get(name, name)
        lines = [[f"{v}", milliseconds(a), milliseconds(b)] for v, a, b in zip(shown, steps, pictures)]
        said = f"a step grows as {against} to the power {fitted[0]:.2f}, a picture to {fitted[1]:.2f}"
        head = [AXES[name], "a step, ms", "a picture, ms"]
        parts.append(f"**{AXES[name]}**: {said}\n\n{table(head, lines)}")
    return "\n\n".join([*parts, threads_table(size)])


def effects_table(size: Size = Size()) -> str:  # noqa: B008
    """Time a step and a picture with each effect alone, relative to none."""
    lines, first = [], None
    for name, typed in ALONE.items():
        loop = Loop(size, typed)
        step, picture = timed(loop.step, STEPS), timed(loop.picture, STEPS)
        first = first or step
        lines.append([name, milliseconds(step), f"{step / first:.2f}", milliseconds(picture)])
    return table(["effect", "a step, ms", "times", "a picture, ms"], lines)


def threads_table(size: Size) -> str:
    """Time steps by the clock on one thread and on more, as far as there are cores."""
    loop = Loop(size)
    known = [count for count in THREADS if count <= _most_threads()]
    found = {count: steps_a_second(loop, count) for count in known}
    lines = [[f"{n}", f"{rate:.0f}", f"{rate / found[1]:.2f}"] for n, rate in found.items()]
    said = "by the clock, so that other work on the machine counts"
    return f"**threads**: {said}\n\n{table(['threads', 'steps a second', 'times those of one'], lines)}"


def steps_a_second(loop: Loop, threads: int, steps: int = STEPS) -> float:
    """Count steps a second of the clock, by so many threads; the median of five rounds."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        loop.step()
        rounds = []
        for _ in range(FEW):
            begin = time.perf_counter()
            for _ in range(steps):
                loop.step()
            rounds.append(steps / (time.perf_counter() - begin))
        return statistics.median(rounds)
    finally:
        torch.set_num_threads(before)


class _Marks(lightning.Callback):
    """Note the processor time after every step."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    def on_train_batch_end(self, *_) -> None:
        self.seconds.append(time.process_time())


def lightning_shares(size: Size, steps: int) -> tuple[float, float]:
    """Seconds of a step in a run as users start it, with all its callbacks, and in a bare loop.

    Both are means over the same number of steps of processor time, as checkpoints and logs come seldom.
    """
    marks, warm = _Marks(), max(1, steps // 10)
    with tempfile.TemporaryDirectory() as folder:
        run = run_of(size, steps + warm, Path(folder) / "run")
        own = run.callbacks
        replace(run, callbacks=lambda *given: [*own(*given), marks]).fit()
    within = (marks.seconds[-1] - marks.seconds[warm - 1]) / (len(marks.seconds) - warm)
    loop = Loop(size, learned=0)  # as the run
    for _ in range(warm):
        loop.step()
    begin = time.process_time()
    for _ in range(steps):
        loop.step()
    return within, (time.process_time() - begin) / steps


def goals_table(size: Size = Size(), steps: int = 400) -> str:  # noqa: B008
    """Measure the goals of particles."""
    loop = Loop(size)
    step, picture = timed(loop.step, STEPS), timed(loop.picture, STEPS)
    unit = yardstick()
    gain = steps_a_second(loop, 2) / steps_a_second(loop, 1) if _most_threads() >= 2 else None
    within, bare = lightning_shares(size, steps)
    share = bare / within
    rows = [
        ["a step", f"<= {STEP_MS:g} ms", _with_ratio(step, unit), 1e3 * step <= STEP_MS],
        ["a picture", f"<= {PICTURE_MS:g} ms", _with_ratio(picture, unit), 1e3 * picture <= PICTURE_MS],
        ["steps with two threads, by the clock", f">= {LEAST_GAIN} times"]
        + (["one core only", None] if gain is None else [f"{gain:.2f} times", gain >= LEAST_GAIN]),
        ["steps within Lightning, against a bare loop", f">= {LEAST_SHARE:.0%}"]
        + [f"{share:.0%}: {milliseconds(within)} and {milliseconds(bare)} ms", share >= LEAST_SHARE],
    ]
    what = f"{size.particles:,} particles, {size.side}^2 pixels: "
    return table(["what", "wanted", "measured", ""], [[what + r[0], *r[1:3], VERDICTS[r[3]]] for r in rows])


def _with_ratio(seconds: float, unit: float) -> str:
    return f"{milliseconds(seconds)} ms, {seconds / unit:.1f} times a million exponentials"


def _most_threads() -> int:
    from numba import config

    return config.NUMBA_NUM_THREADS
