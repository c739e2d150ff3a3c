"""The tables of the benchmark."""

import pytest

from tests.bench import performance
from tests.bench.timed_cases import CASES


def test_a_slope_is_of_the_work_and_a_ratio_of_the_same_size(monkeypatch):
    def cost(case, size, dense):
        own = 1e-8 * size**3 if case.work(2) == 8 else 1e-5 * size**0.5
        return (5 * own if dense else own), 3 * 2**20

    monkeypatch.setattr(performance, "cost_of", cost)
    text = performance.growth_tables({name: CASES[name] for name in ("splat", "render by rays")})
    assert "**splat**: seconds grow as its cube to the power 1.00" in text
    assert "**render by rays**: seconds grow as it to the power 0.50" in text
    assert "| 32 | 0.328 | 3 | 1.64 | 3 | 5.0 |" in text
    assert "| 8192 | 0.905 | 3 |  |  |  |" in text


def test_a_cost_is_measured():
    seconds, peak = performance.cost_of(CASES["splat"], 8, True)
    assert seconds > 0
    assert peak >= 0


@pytest.mark.slow
def test_every_table_is_made(monkeypatch):
    monkeypatch.setattr(performance, "by_itself", lambda side, rays: 1e6)
    lines = performance.goals_table(side=8, rays=16, picture=12, frame_side=8).splitlines()
    assert lines[3].endswith("| reached |")
    assert performance.splat_error(80) <= 1e-5
