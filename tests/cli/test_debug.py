"""``debug=``: short runs that look for mistakes, of every family of methods."""

import json
import re

import pytest
from lightning.pytorch.profilers import SimpleProfiler

from forewarp.cli.train import costliest, verdict
from tests.support.configs import composed, options

MODES = ("fast", "limit", "overfit", "profile")
FAMILIES = {
    "particles": ["stage.fine.density=4", "stage.coarse.density=4"],
    "forward": ["data.rays=64", "stage.fine.num_voxels=[[0,2000]]", "stage.coarse.num_voxels=[[0,1000]]"],
    "nerf": ["data.rays=64"],
}


def test_every_mode_is_an_option():
    assert tuple(options("debug")) == MODES


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("model", FAMILIES)
def test_a_mode_is_short_without_a_logger_and_in_a_folder_of_its_own(mode, model):
    config = composed(f"debug={mode}", f"model={model}", "data.scene=x", "preset=faithful")
    assert (config.debug, config.logger, config.model.name) == (mode, {}, model)
    assert config.budget.iterations <= 1000
    assert re.match(rf"runs/debug/x/{mode}-{model}-faithful-seed0-{{hash}}-\d{{4}}-\d{{6}}$", config.run)
    assert config.trainer.get("profiler") == ("simple" if mode == "profile" else None)
    assert config.evaluate == (mode in ("fast", "limit"))
    assert config.data.train_views == (3 if mode == "overfit" else 16)


@pytest.mark.slow
def test_what_is_typed_wins():
    words = ["debug=overfit", "data.train_views=5", "budget.iterations=7", "run=here", "data.scene=x"]
    config = composed(*words, "logger=csv")
    assert list(config.logger) == ["csv"]
    assert (config.data.train_views, config.budget.iterations, config.run) == (5, 7, "here")
    assert composed("data.scene=x").debug is None


def test_overfitting_is_judged_in_words():
    assert verdict(28.5, 12.6) == "overfitted: at least 21.0 dB, so the method can learn these images"
    assert verdict(20.9, 12.6).startswith("not overfitted: less than 21.0 dB; ")
    assert verdict(30.0, 26.0).startswith("not overfitted: less than 31.0 dB; ")  # a nearly plain image


def test_the_costliest_calls_are_those_of_the_table():
    profiler = SimpleProfiler()
    profiler.recorded_durations.update({f"call {i}": [float(i), 0.5] for i in range(8)})
    *lines, _ = costliest(profiler.summary())
    assert lines[0].split() == ["7.50", "s", "in", "2", "calls", "call", "7"]
    assert [line.split()[-1] for line in lines] == ["7", "6", "5", "4", "3"]
    assert costliest("of the advanced profiler: 3 function calls") == []


@pytest.mark.slow
@pytest.mark.parametrize("model", FAMILIES)
def test_every_mode_works_with_every_family(ok, in_tmp, fitted, model):
    common = ["data=dnerf", "data.scene=vehicle", f"data.root={fitted.parent / 'scenes'}", "preset=demo"]
    common += [f"model={model}", "threads=1", "trainer=cpu", *FAMILIES[model]]
    said = {}
    for mode in MODES:
        more = [] if mode == "fast" else ["budget.iterations=12"]
        said[mode] = ok("train", f"debug={mode}", *common, *more)
        assert "warning" not in said[mode].err
        (run,) = in_tmp.glob(f"runs/debug/vehicle/{mode}-{model}-*")
        stages = [json.loads(path.read_text()) for path in run.glob("*/done.json")]
        assert 1 <= sum(stage["steps"] for stage in stages) <= 13
        assert not list(run.glob("*/tensorboard"))
        is_measured = mode in ("fast", "limit")
        measured = json.loads((run / "per_image.json").read_text())["images"] if is_measured else []
        assert len(measured) == {"fast": 1, "limit": 4}.get(mode, 0)
        tables = [path.read_text() for path in run.glob("*/fit-profile.txt")]
        assert len(tables) == (len(stages) if mode == "profile" else 0)
        assert all("method.look" in table for table in tables)
    assert re.search(r"^overfit  psnr \d+\.\d\d of 3 training images after 1[23] ", said["overfit"].out, re.M)
    assert "\nnot overfitted: less than " in said["overfit"].out
    assert "method.look" in said["profile"].out
    assert re.search(r"^profile  runs/debug/vehicle/profile-.*/fine/fit-profile", said["profile"].out, re.M)


@pytest.mark.slow
def test_a_mode_begins_anew_each_time_and_in_each_job_of_a_sweep(ok, in_tmp, fitted):
    words = ["debug=fast", "data=dnerf", "data.scene=vehicle", f"data.root={fitted.parent / 'scenes'}"]
    words += ["model=nerf", "preset=demo", "threads=1", "evaluate=false", "budget.iterations=2"]
    ok("train", "--multirun", *words, "data.rays=16,32")
    assert len(list(in_tmp.glob("runs/debug/vehicle/*"))) == 2
