"""The benchmark of particles: its figure, its tables in a tiny size, and the seconds of a start."""

from types import SimpleNamespace

import pytest

from forewarp.ops.kernels import project, rasterize
from forewarp.training.callbacks import StageProgress
from forewarp.training.module import DynamicSceneModule
from tests.bench import particle_tables, start_up
from tests.bench.particles import Loop, Size, figure

TINY = Size(particles=300, side=32, nodes=9)


@pytest.fixture(scope="module")
def loop():
    return Loop(TINY)


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(particle_tables, "STEPS", 2)
    monkeypatch.setattr(particle_tables, "FEW", 1)


def test_the_figure_is_as_large_as_asked_and_stays_so(loop):
    assert (len(loop.method.means), len(loop.method.nodes.positions)) == (300, 9)
    before = loop.method.means.detach().clone()
    for _ in range(3):
        loop.step()
    assert len(loop.method.means) == 300
    assert float((loop.method.means.detach() - before).abs().max()) > 0
    assert loop.picture().shape == (32 * 32, 3)
    assert figure(100)[1] == pytest.approx(
        2 * figure(400)[1]
    )  # half as far apart where there are four times as many


def test_every_kernel_of_a_step_belongs_to_a_part(loop):
    with particle_tables.kernels_timed() as spent:
        loop.step()
        loop.picture()
    assert len(spent) > 10
    counted = {
        key
        for kernels in particle_tables.PARTS.values()
        for part, names in kernels
        for key in spent
        if key[0] == part and (not names or key[1] in names)
    }
    assert counted == spent.keys()
    assert hasattr(project.project, "py_func")  # put back
    assert hasattr(rasterize.draw, "py_func")


@pytest.mark.slow
def test_tables_are_made(few):
    text = particle_tables.parts_table(TINY)
    for name in (*particle_tables.PARTS, "**a whole step**", "**a picture**"):
        (line,) = (line for line in text.splitlines() if line.startswith(f"| {name} |"))
        cells = [cell.strip() for cell in line.split("|")[2:-1]]
        assert all(float(cell) > 0 for cell in cells if cell)
        compared = (
            name in particle_tables.PARTS and name != "sorting into tiles"
        )  # plain PyTorch has no tiles
        assert bool(cells[2]) == compared
    grown = particle_tables.growth_table(TINY, {"particles": (100, 200), "zoom": (0.5, 1.0), "nodes": (4, 9)})
    assert grown.count("to the power") == 3
    grown, _, threads = grown.partition("**threads**")
    assert "| 1 |" in threads
    assert grown.count("\n| ") == 3 * 4
    small, large = (int(line.split("|")[1]) for line in grown.split("\n\n")[3].splitlines()[2:])
    assert 3 * small < large < 5 * small  # covered pixels: half as large, a quarter


@pytest.mark.slow
def test_each_effect_is_timed_alone_and_what_is_off_is_absent(few):
    text = particle_tables.effects_table(TINY)
    lines = text.splitlines()[2:]
    assert [line.split("|")[1].strip() for line in lines] == list(particle_tables.ALONE)
    assert all(float(cell) > 0 for line in lines for cell in line.split("|")[2:-1])
    bare, shaded, moving, usual = (
        Loop(TINY, list(particle_tables.ALONE.values())[k]).method for k in (0, 2, 5, 8)
    )
    assert (bare.nodes, bare.sh, bare.color_over_time, bare.opacity_over_time, bare.resting) == (None,) * 5
    assert shaded.sh.shape == (300, 15, 3)
    assert moving.nodes.rotations is None
    assert None not in (usual.nodes.rotations, usual.sh, usual.color_over_time, usual.resting)


def test_steps_grow_with_threads_as_far_as_there_are_cores(few, monkeypatch):
    monkeypatch.setattr(particle_tables, "_most_threads", lambda: 3)
    monkeypatch.setattr(particle_tables, "steps_a_second", lambda loop, threads: 100.0 * threads**0.7)
    text = particle_tables.threads_table(TINY)
    assert "| 1 | 100 | 1.00 |" in text
    assert text.endswith("| 2 | 162 | 1.62 |")


def test_goals_are_judged(few, monkeypatch):
    monkeypatch.setattr(particle_tables, "lightning_shares", lambda size, steps: (0.010, 0.007))
    monkeypatch.setattr(particle_tables, "_most_threads", lambda: 2)
    monkeypatch.setattr(particle_tables, "steps_a_second", lambda loop, threads: 100.0 * threads**0.7)
    text = particle_tables.goals_table(TINY)
    assert "| 1.62 times | reached |" in text
    assert text.count("times a million exponentials") == 2
    assert "| 70%: 10 and 7 ms | **missed** |" in text


def test_steps_within_lightning_and_without_are_timed(monkeypatch):
    clock = _clock(monkeypatch, particle_tables)
    monkeypatch.setattr(
        DynamicSceneModule, "training_step", clock.taking(3.0, DynamicSceneModule.training_step)
    )
    shown = clock.taking(0.5, StageProgress.on_train_batch_end)  # a run's callbacks count
    monkeypatch.setattr(StageProgress, "on_train_batch_end", shown)
    monkeypatch.setattr(particle_tables.Loop, "step", clock.taking(2.0, particle_tables.Loop.step))
    assert particle_tables.lightning_shares(TINY, 12) == (3.5, 2.0)


def test_a_second_counts_once(monkeypatch):
    clock = _clock(monkeypatch, start_up)
    ledger = start_up.Ledger(clock.now - 1.0)
    inner = ledger.counted("inner", clock.taking(5.0))
    ledger.counted("outer", clock.taking(2.0, inner))()
    assert ledger.spent == {"Python itself": 1.0, "inner": 5.0, "outer": 2.0}
    with pytest.raises(BaseException, match="^$"):
        ledger.counted("last", ledger.stop)()
    ended = ledger.now()
    clock.now += 1.0
    assert ledger.now() == ended


class _Clock:
    """A clock that moves only as it is told, whatever else the machine does."""

    now = 100.0

    def taking(self, seconds, work=lambda: None):
        def call(*given, **named):
            self.now += seconds
            return work(*given, **named)

        return call


def _clock(monkeypatch, module):
    clock = _Clock()
    read = lambda: clock.now  # noqa: E731
    monkeypatch.setattr(module, "time", SimpleNamespace(time=read, process_time=read))
    return clock


def test_a_start_is_judged(monkeypatch):
    warm = {"imports": 3.0, "kernels": 1.0, start_up.WHOLE: 5.0}
    cold = {"imports": 3.0, "kernels": 30.0, start_up.WHOLE: 34.0}
    monkeypatch.setattr(start_up, "started", lambda overrides, cache=None: warm if cache is None else cold)
    monkeypatch.setattr(start_up, "bare_seconds", lambda: 2.0)
    text = start_up.start_table()
    assert "| kernels | 1.0 | 30.0 |" in text
    assert "| all else | 1.0 | 1.0 |" in text
    assert "took 2.0 s: the first step is done 3.0 s later (wanted: 6 s, reached)" in text
    assert "after 34.0 s (wanted: 25 s, **missed**)" in text


@pytest.mark.slow
def test_a_real_start(tmp_path):
    spent = start_up.started([*start_up.USUAL, "data.scene=tiny", f"paths.data={tmp_path}", *SMALL])
    assert spent.keys() >= {label for *_, label in start_up.COUNTED} | {start_up.WHOLE}
    assert sum(s for name, s in spent.items() if name != start_up.WHOLE) <= spent[start_up.WHOLE] + 0.1
    with pytest.raises(ValueError, match="expected a first step, but got .*glow"):
        start_up.started([*start_up.USUAL, "model=glow"])


SMALL = ["data.synthesis.size=32", "data.synthesis.frames=8", "data.synthesis.test_views=[1,1,1]"]
