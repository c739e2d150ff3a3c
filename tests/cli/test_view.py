import json
import shutil
import socket
import sys
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import pytest
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import OmegaConf

pytest.importorskip("viser", reason="no viser: pip install forewarp[viewer]")

from forewarp.cli.prepare import viewer_of
from forewarp.cli.view import refuse_other_scene, view, warn_of_other_files
from forewarp.viewer.queue import RenderQueue
from tests.support.configs import composed
from tests.support.tiny_scene import ball_scene


@pytest.fixture
def _ctrl_c(monkeypatch):
    """Press Ctrl-C as soon as the page is served."""

    def pressed(queue):
        raise KeyboardInterrupt

    monkeypatch.setattr(RenderQueue, "run_forever", pressed)


@pytest.fixture
def taken():
    """A port that is in use."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


@pytest.mark.slow
@pytest.mark.usefixtures("_ctrl_c")
def test_it_says_where_the_page_is_and_ends_with_ctrl_c(ok, fitted):
    done = ok("view", str(fitted), f"run2={fitted}", "port=0")
    assert done.out.startswith("see it: http://127.0.0.1:")
    assert done.out.strip().endswith("(Ctrl-C ends)")
    assert done.err == ""


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["run=nowhere"], "expected the configuration of a run, but got none; set run=<a run's folder>"),
        ([], "run: expected the folder of a run, but got nothing; set run=runs/..."),
        (["run2=nowhere", "run={run}"], "expected the configuration of a run, but got none; set run2="),
        (["size=3", "run={run}"], "size: expected a whole number of at least 16, but got 3"),
    ],
)
def test_mistakes_end_before_anything_is_loaded(fitted, words, says):
    changes = OmegaConf.from_dotlist([word.format(run=fitted) for word in words])
    with pytest.raises(ValueError, match=says):
        view(OmegaConf.merge(composed(name="view"), changes))


@pytest.mark.slow
def test_a_taken_port_and_a_run_that_is_not_finished_end_in_one_line(refused, fitted, tmp_path, taken):
    said = refused("view", f"run={fitted}", f"port={taken}")
    assert said.startswith(f"port: expected a free port, but got {taken}, which is in use")
    half = shutil.copytree(fitted, tmp_path / "half")
    (half / "fine" / "done.json").unlink()
    assert "half/fine: expected a finished stage, but got none" in refused("view", f"run={half}")


def test_two_runs_of_different_scenes_are_refused():
    scene, views = ball_scene(frames=6), "got one with other test views"
    refuse_other_scene(scene, replace(scene, train=scene.train[:5]))
    *first, last = scene.test  # the last is at time 1
    close, later = ((*first, replace(last, time=last.time - change)) for change in (0.0005, 0.0015))
    refuse_other_scene(scene, replace(scene, test=close))
    for changes, says in (
        ({"name": "cube"}, "expected a run of ball, as run= is, but got one of cube"),
        ({"test": scene.test[:2]}, views),
        ({"test": scene.test[::-1]}, views),
        ({"test": later}, views),
    ):
        with pytest.raises(ValueError, match=says):
            refuse_other_scene(scene, replace(scene, **changes))


def test_two_runs_on_other_files_are_told(tmp_path, capsys):
    for name, content in {
        "a": {"texts": {"t.json": "0"}},
        "b": {"texts": {"t.json": "1"}},
        "old": None,
    }.items():
        (tmp_path / name).mkdir()
        if content:
            (tmp_path / name / "data.json").write_text(json.dumps(content))
    said = [
        warn_of_other_files(tmp_path / "a", tmp_path / other, "hand") or capsys.readouterr().err
        for other in ("a", "old", "b")
    ]
    assert said[:2] == ["", ""]
    assert said[2].startswith(
        "warning: run2: expected a run on the files of hand that run= was trained on, but"
    )


@pytest.mark.slow
@pytest.mark.parametrize("words", [["view", "run={run}"], ["train", "resume={run}", "viewer=true"]])
def test_without_the_extra_it_says_what_to_install(refused, fitted, monkeypatch, words):
    monkeypatch.setitem(sys.modules, "viser", None)
    said = refused(*(word.format(run=fitted) for word in words))
    assert said == "viewer: expected viser, but got none; install forewarp[viewer]"


@pytest.mark.slow
def test_training_with_a_page_asks_for_its_port_before_anything_else(refused, in_tmp, taken):
    says = refused("train", "viewer=true", f"port={taken}", "effects=auto")
    assert says.startswith(f"port: expected a free port, but got {taken}")


@pytest.mark.parametrize(("launcher", "port"), [("Joblib", 8080), ("Joblib", 0), ("Basic", 8080)])
def test_jobs_that_run_at_once_take_ports_of_their_own(monkeypatch, launcher, port):
    fails = launcher == "Joblib" and port != 0
    seen = OmegaConf.create({"launcher": {"_target_": f"hydra.{launcher}Launcher"}})
    monkeypatch.setattr(HydraConfig, "initialized", lambda: True)
    monkeypatch.setattr(HydraConfig, "get", lambda: SimpleNamespace(mode=RunMode.MULTIRUN, **seen))
    config = OmegaConf.create({"viewer": True, "host": "127.0.0.1", "port": port})
    with pytest.raises(ValueError, match="port: expected 0 where") if fails else nullcontext():
        assert viewer_of(config) == {"host": "127.0.0.1", "port": port}


def test_training_with_a_page_of_no_meaning_is_refused():
    with pytest.raises(ValueError, match="viewer: expected true or false, but got 8080"):
        viewer_of(OmegaConf.create({"viewer": 8080}))
