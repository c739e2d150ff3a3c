"""The command that writes docs/stability.md: its tables, its resumable file, its marks."""

import json

import pytest
import torch

from forewarp.ops.backend import numba_installed
from tests.stability import endurance, twin
from tests.stability import report as stability


def test_a_section_is_replaced_and_the_rest_stays(tmp_path):
    path = tmp_path / "a.md"
    path.write_text("before\n<!-- operators -->\nold\n<!-- end of operators -->\nafter\n")
    for text in ("new \\1", "newer"):
        stability.replace_section(path, "operators", text)
    expected = "before\n<!-- operators -->\n\nnewer\n\n<!-- end of operators -->\nafter\n"
    assert path.read_text() == expected
    with pytest.raises(ValueError, match="expected the marks of 'long runs', but got none"):
        stability.replace_section(path, "long runs", "x")


def test_relative_error_hand_worked():
    exact = [torch.tensor([2.0, -4.0]), torch.tensor([1.0])]
    assert twin.relative_error([torch.tensor([2.0, -3.0]), torch.tensor([1.1])], exact) == 0.25
    assert twin.relative_error([], []) is None
    assert twin.relative_error([torch.zeros(2)], [torch.zeros(2)]) == 0
    for broken in (torch.tensor([float("nan"), 1.0]), torch.zeros(3)):
        assert stability.error_text(twin.relative_error([broken], exact[:1])) == "not finite"


def test_float64_differs_from_itself_by_nothing_and_the_switch_is_put_back():
    before = numba_installed()
    for _, _, function, inputs in twin.encoding_cases():
        first, second = (twin.answers(function, inputs, torch.float64) for _ in range(2))
        assert twin.relative_error(first[0], second[0]) == 0
    with twin.implementation("reference"):
        assert not numba_installed()
    assert numba_installed() == before


def test_trials_go_on_where_they_stopped(tmp_path, monkeypatch, capsys):
    made = []

    def trial(seed, rate, steps, data):
        made.append((seed, rate))
        return {
            "seed": seed,
            "rate": rate,
            "steps": steps,
            "psnr": 20.0 + seed,
            "wrong": None,
            "seconds": 1.0,
        }

    monkeypatch.setattr(endurance, "trial", trial)
    path = tmp_path / "runs" / "trials.jsonl"
    assert endurance.endure(path, seconds=-1.0, seeds=2, steps=5) == []
    done = endurance.endure(path, seconds=60, seeds=1, steps=5)
    with path.open("a") as file:
        file.write('{"seed": 1, "ra')  # killed while writing
        file.write("\n" + json.dumps(done[0] | {"steps": 9}) + "\n")
    everything = endurance.endure(path, seconds=60, seeds=2, steps=5)
    assert made == [(0, 1.0), (0, 3.0), (0, 10.0), (1, 1.0), (1, 3.0), (1, 10.0)]
    assert len(everything) == 6
    assert "6/6 seed 1, rates x10: 21.00 dB | 0:00 left" in capsys.readouterr().out
    lines = stability.endurance_table([*everything, done[0] | {"wrong": "nan", "psnr": None}]).splitlines()
    assert lines[2] == "| x1 | 3 | 1 | 20.00 | 20.50 | 21.00 | 0.50 |"


def test_the_small_demo_composes(tmp_path):
    from tests.support.configs import composed

    config = composed(*endurance.overrides(3, 10.0, 40, tmp_path, tmp_path / "run"))
    assert config.stage.coarse.lr.density == pytest.approx(
        10 * composed("experiment=demo").stage.coarse.lr.density
    )
    assert config.stage.fine.lr.flow == pytest.approx(10 * composed("experiment=demo").stage.fine.lr.flow)
    assert config.budget.iterations == 40
    assert config.budget.minutes is None
