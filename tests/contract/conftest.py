"""Write the small scenes once, fit every method once to each, and write the conformance table.

Tests share these files and fitted methods and must not change them.
"""

from functools import cache
from types import SimpleNamespace

import pytest

from tests.contract.conformance import Conformance
from tests.contract.scenes import DATASETS, data_of


def pytest_addoption(parser):
    parser.addoption("--conformance", metavar="FILE", help="write the table of what the contract suite found")


def pytest_configure(config):
    if path := config.getoption("--conformance", None):
        config.pluginmanager.register(Conformance(path))


@pytest.fixture(scope="session")
def scenes(tmp_path_factory):
    """Return the folder with a scene of each dataset."""
    root = tmp_path_factory.mktemp("scenes")
    for name, (write, _) in DATASETS.items():
        write(root / name)
    return root


@pytest.fixture(scope="session")
def fitted(scenes, tmp_path_factory):
    """``fitted(name, dataset)`` returns the run, its fitted module, and the loss of every step."""
    from tests.contract.fitting import Losses, run_of, stage_of
    from tests.contract.table import METHODS

    @cache
    def fit(name, dataset):
        losses, folder = Losses(), tmp_path_factory.mktemp(f"{name}_{dataset}")
        run = run_of([stage_of(METHODS[name])], data_of(dataset, scenes), folder, losses)
        return SimpleNamespace(run=run, module=run.fit(), losses=losses.values)

    return fit
