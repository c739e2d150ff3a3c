"""What every test may ask for: the commands in this process, an empty folder."""

import importlib
import logging
from types import SimpleNamespace

import pytest
import torch
from hydra.core.global_hydra import GlobalHydra

collect_ignore = ["foreign"]  # the package that tests/cli/test_foreign.py imports as somebody else's
ENVIRONMENT = (
    "FOREWARP_ROOT",
    "FOREWARP_TRACEBACK",
    "HYDRA_FULL_ERROR",
    "OMP_WAIT_POLICY",
    "RAY_USAGE_STATS_ENABLED",
    "TF_CPP_MIN_LOG_LEVEL",
    "THP_MEM_ALLOC_ENABLE",
)


@pytest.fixture
def forewarp(monkeypatch, capsys):
    """``forewarp("train", "data.scene=x")`` gives ``status``, ``out`` and ``err``; nothing global remains."""
    for name in ENVIRONMENT:
        monkeypatch.setenv(name, "")  # so that it is put back afterwards
        monkeypatch.delenv(name)
    quiet, threads = logging.getLogger("forewarp.metrics"), torch.get_num_threads()
    level, disabled = quiet.level, logging.root.manager.disable

    def call(name, *arguments):
        monkeypatch.setattr("sys.argv", [f"forewarp-{name}", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as leaving:
            importlib.import_module(f"forewarp.cli.{name}").main()
        GlobalHydra.instance().clear()
        return SimpleNamespace(status=leaving.value.code, **capsys.readouterr()._asdict())

    yield call
    quiet.setLevel(level)
    logging.disable(disabled)
    torch.set_num_threads(threads)


@pytest.fixture
def refused(forewarp):
    """Call a command that must end in one line and status 2; returns that line."""

    def call(name, *arguments):
        done = forewarp(name, *arguments)
        lines = done.err.strip().splitlines()
        assert done.status == 2, done
        assert "Traceback" not in done.err
        assert lines[-1].startswith(f"forewarp-{name}: error: "), done.err
        assert [line for line in lines[:-1] if "%" not in line] == []  # nothing but a progress line before it
        return lines[-1].removeprefix(f"forewarp-{name}: error: ")

    return call


@pytest.fixture
def in_tmp(tmp_path, monkeypatch):
    """The current directory, empty."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module", autouse=True)
def _imports_are_no_garbage():
    """Exempt imported modules from garbage collection, which every stage of a run does before it starts."""
    import gc

    gc.collect()
    gc.freeze()
