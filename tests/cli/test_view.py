import shutil
import socket
import sys
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import OmegaConf

pytest.importorskip("viser", reason="no viser: pip install forewarp[viewer]")

from forewarp.cli.prepare import viewer_of
from forewarp.viewer.desk import Desk


@pytest.fixture
def ctrl_c(monkeypatch):
    """Press Ctrl-C as soon as the page is served."""

    def pressed(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(Desk, "serve_forever", pressed)


@pytest.mark.parametrize("arguments", [("{run}",), ("run={run}", "run2={run}")])
def test_it_says_where_the_page_is_and_ends_with_ctrl_c(ok, fitted, ctrl_c, arguments):
    done = ok("view", *(one.format(run=fitted) for one in arguments), "port=0")
    assert done.out.startswith("see it: http://127.0.0.1:")
    assert done.out.strip().endswith("(Ctrl-C ends)")
    assert done.err == ""


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("run=nowhere",), "expected the configuration of a run, but got none; set run=<a run's folder>"),
        ((), "run: expected the folder of a run, but got nothing; set run=runs/..."),
        (("run={run}", "run2=nowhere"), "expected the configuration of a run, but got none; set run2="),
        (("run={run}", "size=3"), "size: expected a whole number of at least 16, but got 3"),
        (("run={run}", "points=none"), "points: expected a whole number of at least 1, but got none"),
        (("run={run}", "tail=2"), "tail: expected a number in [0.01, 1], but got 2"),
        (("run={run}", "port=70000"), "port: expected a whole number from 0 to 65535, but got 70000"),
        (("run={run}", "host=192.0.2.1"), "host: expected an address of this machine"),
    ],
)
def test_mistakes_end_in_one_line(refused, fitted, in_tmp, words, says):
    assert says in refused("view", *(word.format(run=fitted) for word in words))


def test_a_taken_port_is_named(refused, fitted):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert refused("view", f"run={fitted}", f"port={port}").startswith(
            f"port: expected a free port, but got {port}, which is in use"
        )


def test_a_run_that_is_not_finished_is_named(refused, fitted, tmp_path):
    half = shutil.copytree(fitted, tmp_path / "half")
    (half / "fine" / "done.json").unlink()
    assert "half/fine: expected a finished stage, but got none" in refused("view", f"run={half}")
    (half / "config.yaml").write_text("half")
    assert "config.yaml" in refused("view", f"run={fitted}", f"run2={half}")


@pytest.mark.parametrize(
    ("command", "words"), [("view", ("run={run}",)), ("train", ("resume={run}", "viewer=true"))]
)
def test_without_the_extra_it_says_what_to_install(refused, fitted, monkeypatch, command, words):
    monkeypatch.setitem(sys.modules, "viser", None)
    said = refused(command, *(word.format(run=fitted) for word in words))
    assert said == "viewer: expected viser, but got none; install forewarp[viewer]"


def test_training_with_a_page_asks_for_its_port_before_anything_else(refused, in_tmp):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        says = refused("train", "viewer=true", f"port={port}", "effects=auto")
        assert says.startswith(f"port: expected a free port, but got {port}")


@pytest.mark.parametrize(
    ("launcher", "port", "fails"), [("joblib", 8080, True), ("joblib", 0, False), ("local", 8080, False)]
)
def test_jobs_that_run_at_once_take_ports_of_their_own(monkeypatch, launcher, port, fails):
    target = {"joblib": "hydra_plugins.hydra_joblib_launcher.joblib_launcher.JoblibLauncher"}.get(
        launcher, "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
    )
    seen = OmegaConf.create({"launcher": {"_target_": target}})
    monkeypatch.setattr(HydraConfig, "initialized", lambda: True)
    monkeypatch.setattr(HydraConfig, "get", lambda: SimpleNamespace(mode=RunMode.MULTIRUN, **seen))
    config = OmegaConf.create({"viewer": True, "host": "127.0.0.1", "port": port})
    with pytest.raises(ValueError, match="port: expected 0 where") if fails else nullcontext():
        assert viewer_of(config) == {"host": "127.0.0.1", "port": port}


def test_training_with_a_page_of_no_meaning_is_refused(refused, in_tmp):
    assert refused("train", "viewer=8080") == "viewer: expected true or false, but got 8080"
