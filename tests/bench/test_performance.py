"""The tables of the benchmark."""

import pytest

from tests.bench import performance
from tests.bench.performance import WORDS, box_table, growth_tables, splat_error
from tests.bench.timed_cases import CASES
from tests.bench.workloads import make_module


def entry(name, size, dense, seconds):
    return {
        "extra_info": {"name": name, "size": size, "dense": dense, "peak": 3 * 2**20},
        "stats": {"median": seconds},
    }


def test_a_slope_is_of_the_work_and_a_ratio_of_the_same_size():
    own = [entry("splat", side, False, 1e-8 * side**3) for side in CASES["splat"].sizes]
    rays = [entry("render by rays", n, False, 1e-5 * n**0.5) for n in CASES["render by rays"].sizes]
    text = growth_tables([*own, *rays, entry("splat", 32, True, 32**3 * 5e-8)])
    assert "**splat**: seconds grow as its cube to the power 1.00" in text
    assert "**render by rays**: seconds grow as it to the power 0.50" in text
    assert "| 32 | 0.328 | 3 | 1.64 | 3 | 5.0 |" in text
    assert "| 80 | 5.12 | 3 |  |  |  |" in text
    assert "fields" not in text


def test_the_work_of_a_step_does_not_ask_how_large_the_box_is():
    small, large = (make_module(16, False, rays=200, box=box) for box in (1.0, 2.0))
    counts = [
        (len(module.method.radiance.voxels), module.look(batch, {}).noted["samples"])
        for module, batch in (small, large)
    ]
    assert large[0].method.radiance.lattice.count == 8 * small[0].method.radiance.lattice.count
    for before, after in zip(*counts):
        assert 0.7 * before < after < 1.3 * before


def test_the_box_has_a_line_each():
    assert box_table(side=8, rays=16).count("| x") == 4


def test_the_splat_of_a_tenth_of_80_cubed_is_exact():
    assert splat_error(80) <= 1e-5


def test_what_a_profiler_says_has_words():
    keys = ("aten::convolution_backward", "aten::mkldnn_convolution", "aten::mm", "_NumbaTrilinear")
    words = [next(word for part, word in WORDS if part in key) for key in keys]
    assert words[:2] == ["convolutions, backwards", "convolutions"]
    assert words[2] == "F1, F2, F4 and layers of one voxel"
    assert words[3] == "reads and scatters (Numba)"


def test_the_goals_hold_against_the_dense_step_as_it_runs_by_itself(monkeypatch):
    monkeypatch.setattr(performance, "by_itself", lambda side, rays: 1e6)
    lines = performance.goals_table(side=8, rays=16, picture=12, frame_side=8).splitlines()
    assert "1000000.0 s" in lines[3]
    assert lines[3].endswith("| reached |")
    assert lines[4].startswith("| densely with our large pages |  |")
    assert lines[4].endswith("times |  |")


@pytest.mark.slow
def test_a_process_of_its_own_times_the_dense_step():
    assert 0 < performance.by_itself(8, 16) < 60
