"""Harmed files of every kind are read or refused, nothing else."""

import pytest

from tests.stability.fuzz import INPUTS, fuzz, fuzz_here
from tests.stability.report import fuzz_table

pytestmark = pytest.mark.stability


def check(outcomes, count):
    assert sum(o.inputs for o in outcomes) == count
    assert [fault for o in outcomes for fault in o.faults][:3] == []
    for outcome in outcomes:
        # Neither harmless nor hopeless.
        assert outcome.refused > 0.2 * outcome.inputs, outcome.name
        assert outcome.read > 0.001 * outcome.inputs, outcome.name


def test_some_harmed_files():
    outcomes, grown = fuzz_here(350, seed=7)
    check(outcomes, 350)
    assert "350 inputs" in fuzz_table(outcomes, grown)


@pytest.mark.slow
def test_many_harmed_files():
    outcomes, grown = fuzz(INPUTS, workers=2)
    check(outcomes, INPUTS)
    assert grown < 2**30
    print("\n" + fuzz_table(outcomes, grown))
