"""What needs no torch does not wait for it: help, and whatever is refused."""

import json
import subprocess
import sys

import pytest

from tests.support.configs import ROOT

HEAVY = {"torch", "lightning", "torchmetrics", "numba", "imageio", "matplotlib"}
# Calls commands in one process, until one loads a heavy module.
CODE = """
import contextlib, importlib, io, json, sys
from hydra.core.global_hydra import GlobalHydra
for name, *words in json.load(sys.stdin):
    sys.argv, err, status = [f"forewarp-{name}", *words], io.StringIO(), None
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        try:
            importlib.import_module(f"forewarp.cli.{name}").main()
        except SystemExit as leaving:
            status = leaving.code
    GlobalHydra.instance().clear()
    print(json.dumps([status, err.getvalue(), sorted(sys.modules)]), flush=True)
"""
COMMANDS = (
    "train",
    "plan",
    "evaluate",
    "render",
    "view",
    "export",
    "report",
    "synthesize",
    "capture",
    "data",
)
NOWHERE = ["data=dnerf", "data.root=nowhere", "data.scene=x"]
REFUSED = [
    (["train", "data.scence=x"], "did you mean data.scene?"),
    (["train", "--unknown"], "--unknown: expected options without dashes; type unknown=VALUE"),
    (["train", "--experiment", "dnerf"], "without dashes; type experiment=dnerf"),
    (["train", "sweeps=nothing"], "Could not find 'sweeps/nothing'"),
    (["train", "trainer=mps"], "but got mps; Apple's GPUs have no float64, which cameras and the cosine"),
    (["train", "trainer=ddp"], "one process trains a run: use trainer=gpu, and --multirun launcher=joblib"),
    (["train", "trainer=tpu"], "trainer: expected auto, cpu or gpu, but got tpu; use trainer=auto"),
    (["train", "data=dnerf"], "data.scene: expected a value, but got none"),
    (["train", *NOWHERE], "data.root: expected an existing folder"),
    (["train", "data=nhr", "data.root=.", "data.scene=x"], "x: expected a scene with CamPose.inf"),
    (["train", "resume=nowhere"], "expected the configuration of a run, but got none"),
    (["train", "seeds=2"], "seeds: expected --multirun beside seeds=2"),
    (["train", "plan=nowhere.yaml"], "plan: expected a file that forewarp-plan wrote"),
    (["plan", *NOWHERE], "data.root: expected an existing folder"),
    (["evaluate"], "run: expected the folder of a run, but got nothing"),
    (["evaluate", "run=."], "config.yaml: expected the configuration of a run, but got none"),
    (["render", "run=."], "config.yaml: expected the configuration of a run, but got none"),
    (["view"], "run: expected the folder of a run, but got nothing"),
    (["view", "run=."], "config.yaml: expected the configuration of a run, but got none"),
    (["train", "viewer=8080"], "viewer: expected true or false, but got 8080"),
    (["export"], "run: expected the folder of a run, but got nothing"),
    (["export", "run=."], "config.yaml: expected the configuration of a run, but got none"),
    (["report", "kind=run", "run=a"], "config.yaml: expected the configuration of a run, but got none"),
    (["report", "kind=paper"], "expected a folder with runs, but got runs/paper, which is not there"),
    (["capture"], "expected video=FILE, videos=FOLDER or images=FOLDER, but got none"),
    (["data", "check"], "expected check SCENES, but got check"),
    (
        ["data", "check", "nowhere"],
        "nowhere: expected the folder that holds dnerf/hook and so on, but got none",
    ),
    (["synthesize", "folder=."], "expected a new or empty folder, but got one with files"),
]


def call(folder, commands):
    """Commands in one process of their own: of each its exit status, stderr, and the heavy modules loaded."""
    command, told = [sys.executable, "-c", CODE], json.dumps(commands)
    done = subprocess.run(command, cwd=folder, input=told, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found = [json.loads(line) for line in done.stdout.splitlines()]
    return [(status, err, set(modules) & HEAVY) for status, err, modules in found]


def test_importing_the_package_loads_nothing_but_the_standard_library():
    code = "import sys; before = set(sys.modules); import forewarp; print(*set(sys.modules) - before)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    loaded = {name for name in done.stdout.split() if name.split(".")[0] not in sys.stdlib_module_names}
    assert loaded == {"forewarp"}


def test_help_is_light(tmp_path):
    found = call(tmp_path, [[name, "--help"] for name in COMMANDS])
    assert found == [(0, "", set())] * len(COMMANDS)


@pytest.mark.slow
def test_what_is_refused_is_refused_at_once(tmp_path):
    (tmp_path / "a file").touch()
    found = call(tmp_path, [words for words, _ in REFUSED])
    for (words, says), (status, err, loaded) in zip(REFUSED, found):
        assert (status, loaded) == (2, set()), words
        assert says in err.splitlines()[-1], words
