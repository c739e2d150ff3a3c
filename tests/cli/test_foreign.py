"""The package of docs/extending.md, found by its entry point: a method, an effect, data, and what watches."""

import importlib
import json
import os
import re
import shlex
import shutil
import signal
import sys
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
import yaml

from forewarp import load
from forewarp.provenance import source_of
from forewarp.scene.camera import look_at
from tests.support.commands import call

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
SMALL = [
    *("experiment=mine", "data.scene=toy", "data.rays=32", "trainer=cpu", "threads=1", "sheets=0"),
    *("budget.minutes=null", "budget.iterations=6", "checkpoint_seconds=0", "callbacks.pictures=null"),
]
BALLS = [*SMALL, "model=balls"]
SHEEN = [*SMALL, "model=forward", "model/view_dependence=sheen", "~stage.fine"]
TRUST = "trust=[mine]"
ADVICE = "; if you trust the package mine, add trust=[mine] (or set FOREWARP_TRUST=mine)"
# A callback that interrupts a run as Ctrl-C does, and lattices for 16 pixels of a method of ours.
MORE = {
    "mine/stop.py": """
import signal

import lightning


class Stop(lightning.Callback):
    def on_train_batch_end(self, trainer, module, *_):
        if module.global_step == 3:
            signal.raise_signal(signal.SIGINT)
""",
    "mine/conf/numbers/forward.yaml": """
exceptions:
  mine:
    stage: {coarse: {num_voxels: [[0, 800]]}, fine: {num_voxels: [[0, 1000]]}}
""",
}


def files_of(page):
    """Return the files that the page gives whole: name -> text."""
    named = re.findall(r"^`(mine/\S+|pyproject.toml)`\n\n```\w+\n(.*?)```", page, re.M | re.S)
    return {name: text for name, text in named}


def install(project, site, name="mine"):
    """Write into ``site`` what pip would of a ``pyproject.toml``: a name and entry points."""
    (section,) = re.findall(r'^\[project.entry-points."(.*)"\]\n(\w+) = "(.*?)"', project, re.M)
    written = site / f"{name}-0.1.dist-info"
    written.mkdir(parents=True)
    (written / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
    (written / "entry_points.txt").write_text("[{}]\n{} = {}\n".format(*section))


def write_toy(folder):
    """Write sixteen images of a rising disc in the format of the page's reader."""
    folder.mkdir(parents=True)
    frames, rows = [], np.mgrid[:16, :16]
    for i in range(16):
        disc = np.hypot(rows[0] - 10 + i / 4, rows[1] - 8) < 3
        imageio.imwrite(folder / f"{i}.png", disc[..., None] * np.array([128, 64, 128, 255], np.uint8))
        angle = torch.tensor(0.4 * i)
        center = torch.stack([3 * angle.cos(), 3 * angle.sin(), torch.tensor(1.0)])
        pose = look_at(center, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
        frames.append({"image": f"{i}.png", "time": i / 15, "focal": 19.0, "pose": pose.tolist()})
    content = {"size": [16, 16], "range": [1.0, 5.5], "box": [[-1] * 3, [1] * 3], "frames": frames}
    (folder / "cameras.json").write_text(json.dumps(content))


def forget_mine():
    for name in [name for name in sys.modules if name.split(".")[0] == "mine"]:
        del sys.modules[name]


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """A folder with the page's package and a scene."""
    root = tmp_path_factory.mktemp("work")
    for name, text in (files_of(PAGE.read_text()) | MORE).items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    (root / "mine" / "__init__.py").touch()
    install((root / "pyproject.toml").read_text(), root / "site")
    write_toy(root / "scenes" / "toy")
    return root


@pytest.fixture(autouse=True)
def mine(work, monkeypatch):
    """The package is installed, and nothing of it remains."""
    for folder in (work, work / "site"):
        monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delenv("FOREWARP_TRUST", raising=False)
    importlib.invalidate_caches()
    yield
    forget_mine()


@pytest.fixture(scope="module")
def found(work):
    """Words that find the scene."""
    return [f"data.root={work / 'scenes'}"]


@pytest.fixture(scope="module")
def originals(work, found):
    """A finished run of the effect, and one of the method, which is not installed and named as a folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(work))
        folder = ["--config-dir", str(work / "mine" / "conf"), *found]
        for name, words in (("balls", [*folder, *BALLS]), ("sheen", [*found, *SHEEN])):
            done = call("train", *words, f"run={work / name}")
            assert done.status == 0, done.err
            patch.syspath_prepend(str(work / "site"))
            source_of.cache_clear()  # from now on it is installed
    forget_mine()
    return work


@pytest.fixture
def sheen(originals, in_tmp):
    """``run`` in the current folder: a finished run, in a process that has not seen the package."""
    return shutil.copytree(originals / "sheen", in_tmp / "run")


@pytest.fixture
def balls(originals, in_tmp):
    """As ``sheen``, of the method."""
    return shutil.copytree(originals / "balls", in_tmp / "run")


@pytest.mark.slow
def test_what_is_typed_trains_and_trains_again_without_trust(ok, found, sheen):
    config = yaml.safe_load((sheen / "config.yaml").read_text())
    assert config["data"]["_target_"] == "mine.data.MineDataModule"
    assert config["model"]["view_dependence"]["_target_"] == "mine.effects.Sheen"
    assert config["trust"] is None
    code = json.loads((sheen / "metrics.json").read_text())["protocol"]["code"]
    assert (code["mine"], set(code)) == ({"version": "0.1"}, {"forewarp", "mine"})
    assert "mine/psnr" in (sheen / "plain" / "metrics.csv").read_text()
    words = ["train", *found, *SHEEN, "run=run"]
    assert ok(*words).out.startswith("measured before")
    (sheen / "metrics.json").unlink()
    assert "coarse: finished before" in ok(*words).out
    assert type(load("run", trust=["mine"]).method.view_dependence).__name__ == "Sheen"


@pytest.mark.slow
def test_an_interrupted_run_goes_on(forewarp, ok, refused, found, in_tmp):
    # Ctrl-C works, also where whoever started the tests in the background has it ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    stop = "+callbacks.stop={_target_: mine.stop.Stop, _partial_: true}"
    stopped = forewarp("train", *found, *SHEEN, "run=run", stop, "evaluate=false", TRUST)
    signal.signal(signal.SIGINT, before)
    assert stopped.status == 130, stopped
    config = in_tmp / "run" / "config.yaml"
    saved = yaml.safe_load(config.read_text())
    assert saved["trust"] is None  # a folder has no say in it
    saved |= {"trust": ["mine"], "callbacks": saved["callbacks"] | {"stop": None}}
    config.write_text(yaml.safe_dump(saved))
    forget_mine()
    assert refused("train", "resume=run").endswith(ADVICE)
    assert "mine" not in sys.modules
    assert "coarse: resuming at 50%, step 3" in ok("train", "resume=run", TRUST).out
    assert json.loads((in_tmp / "run" / "coarse" / "done.json").read_text())["steps"] == 6


@pytest.mark.slow
def test_a_stored_run_is_measured_by_who_trusts_it(ok, refused, sheen, monkeypatch):
    line = refused("evaluate", "run=run")
    assert line.startswith("run/config.yaml: data._target_: expected a class of forewarp, but got 'mine.")
    assert line.endswith(ADVICE)
    assert "mine" not in sys.modules
    for override in ("trust=mine", "trust=[other,mine]"):
        ok("evaluate", "run=run", override)
    monkeypatch.setenv("FOREWARP_TRUST", "other, mine")
    ok("evaluate", "run=run")


@pytest.mark.slow
def test_the_page_of_a_run_takes_trust(ok, sheen, monkeypatch):
    monkeypatch.setattr("forewarp.cli.report.write_film", lambda *_: None)
    page = ["report", "kind=run", "run=run"]
    assert ADVICE in ok(*page).out
    assert "Rendering" not in ok(*page, TRUST).out


@pytest.mark.slow
def test_the_environment_goes_along_whatever_a_launcher_hands_on(ok, sheen, monkeypatch):
    """A job of another process or machine: its environment is its own."""
    import hydra

    monkeypatch.setenv("FOREWARP_TRUST", "mine")
    begun = hydra.main

    def elsewhere(**options):
        def wrapped(job):
            def launched(config):
                os.environ.pop("FOREWARP_TRUST")
                return job(config)

            launched.__module__ = "__main__"
            return begun(**options)(launched)

        return wrapped

    monkeypatch.setattr(hydra, "main", elsewhere)
    ok("evaluate", "run=run")


@pytest.mark.slow
def test_a_method_is_measured_rendered_and_opened_with_trust(ok, refused, balls):
    still = ["format=png", "frames=2", "size=16", "threads=1"]
    for words in (["evaluate", "run=run"], ["render", "run=run", *still]):
        forget_mine()
        assert refused(*words).endswith(ADVICE)
        ok(*words, TRUST)
    assert len(list((balls / "videos").rglob("*.png"))) == 2
    forget_mine()
    with pytest.raises(ValueError, match="expected a class of forewarp, but got 'mine"):
        load(balls)
    assert "mine" not in sys.modules
    scene = load(balls, trust=["mine"])
    assert scene.render(scene.frames("test")[0]).rgb.shape == (16, 16, 3)
    assert scene.trajectories(scene.matter().points, [0.0, 1.0]).shape == (64, 2, 3)


@pytest.mark.slow
def test_a_method_is_swept_beside_ours_and_reported(ok, found, in_tmp):
    run = "run=runs/toy/${model.name}-seed${seed}"
    done = ok("train", "--multirun", *found, *SMALL, "data.held_out=2", "model=forward,balls", run)
    assert done.out.count("of 2 held out views") == 2  # and scored
    assert {path.name for path in in_tmp.glob("runs/toy/*-seed*")} == {"forward-seed0", "balls-seed0"}
    ok("report", "kind=accuracy_time", "runs=runs", "out=page")
    assert "balls-fast" in (in_tmp / "page" / "accuracy-time.md").read_text()


@pytest.mark.slow
def test_an_installed_package_is_listed_and_its_options_compose(ok, work):
    """No code of it runs."""
    listed = ok("train", "--help").out
    chosen = {"model": "balls", "experiment": "mine", "data": "mine", "callbacks": "speed"}
    for group, option in chosen.items():
        assert re.search(rf"^  {group} .*\b{option}\b", listed, re.M), group
    words = ["experiment=mine", "model=balls", "data.scene=x", "data.root=y", "--cfg", "job"]
    config = yaml.safe_load(call("train", *words).out)
    assert config["callbacks"]["speed"]["_target_"] == "mine.watch.Speed"
    assert (config["model"]["count"], "accuracy" in config["callbacks"]) == ("${preset.count}", True)
    assert "mine" not in sys.modules


@pytest.mark.slow
def test_options_of_ours_win_over_those_of_an_installed_package(work, tmp_path, monkeypatch):
    (tmp_path / "other" / "conf" / "model").mkdir(parents=True)
    (tmp_path / "other" / "conf" / "model" / "nerf.yaml").write_text("name: stolen\n")
    install('[project.entry-points."forewarp.methods"]\nx = "other"', tmp_path, "other")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert yaml.safe_load(call("train", "model=nerf", "--cfg", "job").out)["model"]["name"] == "nerf"


@pytest.mark.slow
def test_an_entry_point_without_options_is_told_and_stops_nothing(work, tmp_path, monkeypatch):
    install('[project.entry-points."forewarp.methods"]\nx = "nowhere.at.all"', tmp_path, "other")
    monkeypatch.syspath_prepend(str(tmp_path))
    done = call("train", "model=balls", "data.scene=x", "--cfg", "job")
    assert done.status in (None, 0)
    line = "warning: entry point x of forewarp.methods: expected a package that has conf/, but got 'nowhere."
    assert done.err.startswith(line)
    assert done.err.count("\n") == 1


@pytest.mark.slow
def test_the_recorded_command_of_a_run_runs_again(ok, found, in_tmp, originals):
    words = [*BALLS, *found, "data.held_out=2", "callbacks=speed", "run=runs/toy/balls"]
    for folder, typed in ((in_tmp, words), (originals, None)):
        if typed is None:  # a run whose options were found by --config-dir
            shutil.copytree(folder / "balls", in_tmp / "run")
        else:
            ok("train", *typed)
        run = in_tmp / ("run" if typed is None else "runs/toy/balls")
        config = yaml.safe_load((run / "config.yaml").read_text())
        name, *recorded = shlex.split(config["command"])
        assert name == "forewarp-train"
        recorded = [f"run={run}" if word.startswith("run=") else word for word in recorded]
        scores = json.loads((run / "metrics.json").read_text())["test"]
        shutil.rmtree(run)
        ok("train", *recorded)
        assert json.loads((run / "metrics.json").read_text())["test"] == scores
    ok("report", "kind=accuracy_time", "runs=runs", "out=page")
    assert "balls-fast" in (in_tmp / "page" / "accuracy-time.md").read_text()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Optuna raises deprecation warnings of its own
def test_a_method_is_searched_and_its_trials_are_reported(ok, found, in_tmp):
    reason = "needs hydra-optuna-sweeper: install forewarp[sweeps]"
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason=reason)
    ranges = ["stage.fine.lr.place=tag(log,interval(1e-3,1e-1))", "model.count=range(8,200)"]
    words = [*BALLS, *found, "data.held_out=2", *ranges, "hydra.sweeper.n_trials=3"]
    ok("train", "--multirun", "sweeps=search_keys", *words)
    assert "search-toy.csv" in ok("report", "kind=search").out
    page = (in_tmp / "runs" / "search" / "results" / "search.md").read_text()
    header, _, *rows = [line.split("|")[1:-1] for line in page.splitlines() if line.startswith("|")]
    assert {"stage.fine.lr.place", "model.count"} <= {cell.strip() for cell in header}
    scores = [float(row[-3]) for row in rows]
    assert (len(scores), scores) == (3, sorted(scores, reverse=True))
