"""The GPU benchmark, in tiny sizes on the CPU."""

import pytest

from tests.bench.device import StepTimes, main, papers


@pytest.mark.slow
def test_it_runs_to_its_end_without_a_gpu(tmp_path, capsys):
    main(["--device", "cpu", "--small", "--folder", str(tmp_path)])
    out = capsys.readouterr().out
    for budget in ("fast", "faithful"):
        block = out.split(f"vehicle, {budget}")[1]
        assert "steps: coarse" in block
        assert "fine" in block
        assert "of a kept grid" in block
    assert "dB of views set aside" in out
    assert "test views" in out


def test_without_a_step_there_are_no_times():
    times = StepTimes()
    assert not times
    times.seconds["fine"] = [3.0, 0.5, 0.5]
    assert f"{times or 'fitted before'}" == "fine 500.0 ms"


def test_a_missing_gpu_is_said_in_one_line(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ValueError, match="expected a GPU, but found none"):
        main(["--device", "gpu"])


def test_the_papers_number_stands_beside_its_scene():
    assert papers("hook") == ", the paper 32.29"
    assert papers("vehicle") == ""
