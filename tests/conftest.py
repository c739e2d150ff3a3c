"""What every test may ask for: the commands in this process, a fitted run, an empty folder."""

# ruff: noqa: E402 (torch is imported after it is said how its threads wait)
import gc

from forewarp.cli.entry import wait_briefly

wait_briefly()  # before torch is imported
gc.set_threshold(100_000, 20, 20)  # composing a configuration makes many objects and no garbage

import pytest
import torch
from hydra._internal import defaults_list
from hydra.core.config_store import ConfigStore

from tests.support.commands import call, fitted_run

of_interpolations = defaults_list._create_interpolation_map


def _where_there_are_any(overrides, defaults, self_added):
    """Make the map of interpolated defaults, a quarter of a composition, where there are such defaults."""
    if any(not default.is_self() and default.is_interpolation() for default in defaults):
        return of_interpolations(overrides, defaults, self_added)
    return None


defaults_list._create_interpolation_map = _where_there_are_any
ConfigStore.__deepcopy__ = lambda store, memo: store  # for each composition; what it loads is copied, too


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    """Compute alike on every machine: sums over several threads differ in their last bits."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def _times_of_tests(tmp_path_factory):
    """What jobs of tests take is kept apart from the user's, and what is noted of decoded frames."""
    own = tmp_path_factory.mktemp("own")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FOREWARP_TIMES", str(own / "times.csv"))
        patch.setattr("forewarp.files.own_folder", lambda: own)
        yield


@pytest.fixture
def two_threads():
    """Two threads, so that sums are made in more than one chunk."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def forewarp():
    """``forewarp("train", "data.scene=x")`` gives ``status``, ``out`` and ``err``; nothing global remains."""
    return call


@pytest.fixture
def ok():
    """As ``forewarp``, of a command that must end well."""

    def end_well(name, *arguments):
        done = call(name, *arguments)
        assert done.status == 0, done
        return done

    return end_well


@pytest.fixture
def refused():
    """Call a command that must end in one line and status 2; returns that line."""

    def refuse(name, *arguments):
        done = call(name, *arguments)
        lines = done.err.strip().splitlines()
        assert done.status == 2, done
        assert "Traceback" not in done.err
        assert lines[-1].startswith(f"forewarp-{name}: error: "), done.err
        assert [line for line in lines[:-1] if "%" not in line] == []  # nothing but a progress line before it
        return lines[-1].removeprefix(f"forewarp-{name}: error: ")

    return refuse


@pytest.fixture(scope="session")
def fitted(tmp_path_factory):
    """The folder of a finished run that all tests share; see ``fitted_run``."""
    return fitted_run(tmp_path_factory)


@pytest.fixture
def in_tmp(tmp_path, monkeypatch):
    """The current directory, empty."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module", autouse=True)
def _imports_are_no_garbage():
    """Exempt imported modules from garbage collection, which every stage of a run does before it starts."""
    gc.collect()
    gc.freeze()
