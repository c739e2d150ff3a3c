"""The tables of particles: what a step consists of, how it grows, and what Lightning adds."""

from __future__ import annotations

import importlib
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import lightning
import torch

from forewarp.methods.particles.model import pinhole_of
from forewarp.ops.gaussians import Gaussians, Splats, compare, project, rasterize
from forewarp.ops.nodes import pull_nodes, skin_weights
from tests.bench.particles import MIDDLE, WHITE, Loop, Size, camera, run_of
from tests.bench.timed_cases import milliseconds, timed
from tests.stability.report import table
from tests.stability.twin import implementation

STEPS, FEW = 40, 5  # repetitions: of what takes milliseconds, of what takes long
# Of which kernels a part consists: the module's name in ``ops.kernels``, and its functions; none named: all.
PARTS = {
    "projection": (("project", ()),),
    "sorting into tiles": (("rasterize", ("sort_into_tiles",)),),
    "forward: a picture's": (("rasterize", ("draw",)),),
    "forward, loss and backward": (("rasterize", ("compare",)),),
    "chain, back to particles and nodes": (("backward", ()),),
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
    before = []

    def clocked(key: tuple[str, str], kernel: Callable) -> Callable:
        def call(*arguments):
            begin = time.process_time()
            try:
                return kernel(*arguments)
            finally:
                spent[key] = spent.get(key, 0.0) + time.process_time() - begin

        return call

    for part in {part for kernels in PARTS.values() for part, _ in kernels}:
        home = importlib.import_module(f"forewarp.ops.kernels.{part}")
        for name, kernel in list(vars(home).items()):
            own = hasattr(kernel, "py_func") and kernel.py_func.__module__ == home.__name__
            if own and not name.startswith("_"):
                before.append((home, name, kernel))
                setattr(home, name, clocked((part, name), kernel))
    try:
        yield spent
    finally:
        for home, name, kernel in before:
            setattr(home, name, kernel)


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
    tints, fades = method.time_bases(MIDDLE)
    particles, warp = (type(p)(*(t.detach() for t in p)) for p in (method.gaussians(), method.warp(MIDDLE)))
    seen = (particles, warp, pinhole_of(view, method.blur), tints, fades)
    little = (*seen[:2], pinhole_of(camera(smaller, 0.3), method.blur), *seen[3:])
    truth = torch.zeros(smaller**2, 4, dtype=torch.uint8)
    nodes, found = method.nodes, {}
    with implementation("reference"):
        found["projection"] = timed(lambda: project(*seen), FEW)
        splats = Splats(*(t.detach() for t in project(*little)))
        found["forward: a picture's"] = times * timed(lambda: rasterize(splats, smaller, smaller), FEW)
        found["forward, loss and backward"] = times * timed(lambda: compare(*little, truth, WHITE), FEW)
        leaves = Gaussians(*(part.clone().requires_grad_() for part in particles))
        numbers = project(leaves, *seen[1:]).values.sum()
        found["chain, back to particles and nodes"] = timed(lambda: numbers.backward(retain_graph=True), FEW)
        skin = method.skinning
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
    from tests.bench.performance import slope

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
    from tests.bench.performance import VERDICTS

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
