"""Write small scenes once, fit every method to each, and write docs/results/conformance.md from the results.

Tests share these files and fitted methods and must not change them.
"""

from collections import defaultdict
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.contract.scenes import DATASETS, data_of
from tests.contract.table import METHODS

TITLES = {"dnerf": "D-NeRF", "hypernerf": "HyperNeRF", "nhr": "NHR", "lego_complete": "Lego Complete"}
TITLES |= {"multicam": "DyNeRF"}
WORST = ("failed", "skipped", "not run", "passed")
HEAD = """# Conformance

What each method was seen to do by the contract suite (`tests/contract`), on one scene of 20 pixels and 6
times in the format of each dataset: D-NeRF, HyperNeRF, NHR, Lego Complete, DyNeRF; what does not depend on
the format (equal, stopped and killed runs, a voxel stage beside) in D-NeRF's alone. Written by `make
conformance`; do not edit. How a method joins: [extending](../extending.md).
"""


def pytest_addoption(parser):
    parser.addoption("--conformance", metavar="FILE", help="write the table of what the contract suite found")


def pytest_collection_modifyitems(config, items):
    """Leave fits of the other methods to the other datasets to ``make conformance``."""
    if not config.getoption("--conformance", None):
        left = [item for item in items if item.path.parent == Path(__file__).parent and _is_left(item)]
        config.hook.pytest_deselected(items=left)
        items[:] = [item for item in items if item not in left]


def _is_left(item):
    params = item.callspec.params if hasattr(item, "callspec") else {}
    is_other = params.get("dataset", "dnerf") != "dnerf" and params.get("name") not in (
        "particles",
        "forward",
    )
    return is_other and "fitted" in item.fixturenames


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
def fitted(scenes, tmp_path_factory, request):
    """``fitted(name, dataset)`` returns the run, its fitted module, and the loss of every step.

    Where no slow test is run, which alone look at how well a method learns, it is fitted for some steps only.
    """
    from tests.contract.fitting import Losses, run_of, stage_of

    whole = any(item.get_closest_marker("slow") for item in request.session.items)

    @cache
    def fit(name, dataset):
        losses, folder = Losses(), tmp_path_factory.mktemp(f"{name}_{dataset}")
        stage = stage_of(METHODS[name], **({} if whole else {"steps": 20}))
        run = run_of([stage], data_of(dataset, scenes), folder, losses)
        return SimpleNamespace(run=run, module=run.fit(), losses=losses.values)

    return fit


class Conformance:
    """A pytest plugin that records the outcome of every test of a method, failures included."""

    def __init__(self, path):
        self.path, self.outcomes, self.said = Path(path), defaultdict(dict), defaultdict(dict)

    def _note(self, item, outcome):
        params = item.callspec.params if hasattr(item, "callspec") else {}
        if "name" in params:
            outcomes = self.outcomes[item.originalname, params["name"]]
            key = params.get("dataset"), item.nodeid
            outcomes[key] = min(outcomes.get(key, "passed"), outcome, key=WORST.index)

    def pytest_deselected(self, items):
        for item in items:
            self._note(item, "not run")

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item, call):
        report = yield
        self._note(item, report.outcome)
        for key, value in report.user_properties:
            self.said[item.callspec.params["name"]][key] = value
        return report

    def pytest_sessionfinish(self, session, exitstatus):
        if exitstatus in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            kinds = list(dict.fromkeys(kind for said in self.said.values() for kind in said))
            methods = [[m, *(self.said[m].get(kind, "**not run**") for kind in kinds)] for m in METHODS]
            cases = list(dict.fromkeys(case for case, _ in self.outcomes))
            promises = [[c[5:].replace("_", " "), *(self._promise(c, m) for m in METHODS)] for c in cases]
            lines = [HEAD, "## Methods\n", *table(["method", *kinds], methods)]
            lines += ["\n## Promises\n", *table(["case", *METHODS], promises), ""]
            self.path.write_text("\n".join(lines))

    def _promise(self, case, method):
        outcomes = self.outcomes.get((case, method))
        if not outcomes:
            return "nothing to test"
        worst = min(outcomes.values(), key=WORST.index)
        if worst == "passed":
            return "yes"
        where = sorted({TITLES[d] for (d, _), outcome in outcomes.items() if outcome == worst and d})
        return f"**{worst}**" + (f" ({', '.join(where)})" if where else "")


def table(head, rows):
    """Return the lines of a Markdown table."""
    return ["| " + " | ".join(map(str, row)) + " |" for row in (head, ["---"] * len(head), *rows)]
