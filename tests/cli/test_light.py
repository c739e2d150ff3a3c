"""What needs no torch does not wait for it: help, and whatever is refused."""

import json
import subprocess
import sys

import pytest

from tests.support.configs import ROOT

HEAVY = {"torch", "lightning", "torchmetrics", "numba", "imageio", "matplotlib"}
CODE = """
import json, sys
name, *words = sys.argv[1:]
import importlib
sys.argv = [f"forewarp-{name}", *words]
try:
    importlib.import_module(f"forewarp.cli.{name}").main()
finally:
    print(json.dumps(sorted(sys.modules)))
"""
COMMANDS = ("train", "plan", "evaluate", "render", "report", "synthesize")


def run(folder, *arguments):
    """A command in a process of its own: its exit status, its last words, and the heavy modules it loaded."""
    command = [sys.executable, "-c", CODE, *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    loaded = set(json.loads(done.stdout.splitlines()[-1])) & HEAVY
    return done.returncode, (done.stderr.splitlines() or [""])[-1], loaded


def test_importing_the_package_loads_nothing():
    code = "import sys; before = set(sys.modules); import forewarp; print(*set(sys.modules) - before)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == ["forewarp"]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_light(tmp_path, name):
    assert run(tmp_path, name, "--help") == (0, "", set())


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["train", "data.scence=x"], "did you mean data.scene?"),
        (["train", "preset=quick"], "Could not find 'preset/quick'"),
        (["train", "--unknown"], "unrecognized arguments: --unknown"),
        (["train", "sweeps=nothing"], "Could not find 'sweeps/nothing'"),
        (["train", "data=dnerf"], "data.scene: expected a value, but got none"),
        (
            ["train", "data=dnerf", "data.root=nowhere", "data.scene=x"],
            "data.root: expected an existing folder",
        ),
        (["train", "data=nhr", "data.root=.", "data.scene=x"], "x: expected a scene with CamPose.inf"),
        (["train", "resume=nowhere"], "expected the configuration of a run, but got none"),
        (["train", "seeds=2"], "seeds: expected --multirun beside seeds=2"),
        (["train", "plan=nowhere.yaml"], "plan: expected a file that forewarp-plan wrote"),
        (
            ["plan", "data=dnerf", "data.root=nowhere", "data.scene=x"],
            "data.root: expected an existing folder",
        ),
        (["plan", "data.scence=x"], "did you mean data.scene?"),
        (["evaluate"], "run: expected the folder of a run, but got nothing"),
        (["evaluate", "run=."], "config.yaml: expected the configuration of a run, but got none"),
        (["render"], "run: expected the folder of a run, but got nothing"),
        (["render", "run=."], "config.yaml: expected the configuration of a run, but got none"),
        (
            ["report", "kind=limits", "runs=[a]"],
            "config.yaml: expected the configuration of a run, but got none",
        ),
        (["report"], "runs/accuracy_time: expected folders of runs, but got none"),
        (["synthesize", "folder=."], "expected a new or empty folder, but got one with files"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_is_refused_is_refused_at_once(tmp_path, words, says):
    (tmp_path / "a file").touch()
    status, line, loaded = run(tmp_path, *words)
    assert status == 2
    assert says in line
    assert loaded == set()
