"""Write docs/conformance.md from the results of the contract suite, failures included."""

from collections import defaultdict
from pathlib import Path

import pytest

from tests.contract.table import METHODS

TITLES = {"dnerf": "D-NeRF", "hypernerf": "HyperNeRF", "nhr": "NHR", "lego_complete": "Lego Complete"}
WORST = ("failed", "skipped", "not run", "passed")
HEAD = """# Conformance

What each method was seen to do by the contract suite (`tests/contract`), on one scene of 20 pixels and 6
times in the format of each dataset: D-NeRF, HyperNeRF, NHR, Lego Complete; what does not depend on the format
(equal, stopped and killed runs, a voxel stage beside) in D-NeRF's alone. Written by `make conformance`; do
not edit. How a method joins: [extending](extending.md).
"""


class Conformance:
    """A pytest plugin that records the outcome of every test of a method."""

    def __init__(self, path):
        self.path, self.found, self.said = Path(path), defaultdict(dict), {}

    def _note(self, item, outcome):
        params = item.callspec.params if hasattr(item, "callspec") else {}
        if "name" in params:
            known = self.found[item.originalname, params["name"]]
            key = (params.get("dataset"), item.nodeid)
            known[key] = min(known.get(key, "passed"), outcome, key=WORST.index)

    def pytest_deselected(self, items):
        for item in items:
            self._note(item, "not run")

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item, call):
        report = yield
        self._note(item, report.outcome)
        for key, value in report.user_properties:
            self.said[item.callspec.params["name"], key] = value
        return report

    def pytest_sessionfinish(self, session, exitstatus):
        if exitstatus in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            self.path.write_text(self.page())

    def page(self):
        methods = list(METHODS)
        return "\n".join(
            [
                HEAD,
                "## Methods\n",
                *table(["method", *KINDS], [self._kinds(m) for m in methods]),
                "\n## Promises\n",
                *table(["case", *methods], self._promises(methods)),
                "",
            ]
        )

    def _kinds(self, method):
        return [method, *(self.said.get((method, kind), "**not run**") for kind in KINDS)]

    def _promises(self, methods):
        cases = list(dict.fromkeys(case for case, _ in self.found))
        return [[case[5:].replace("_", " "), *(self._promise(case, m) for m in methods)] for case in cases]

    def _promise(self, case, method):
        results = self.found.get((case, method))
        if not results:
            return "nothing to test"
        worst = min(results.values(), key=WORST.index)
        if worst == "passed":
            return "yes"
        where = sorted({TITLES[d] for (d, _), outcome in results.items() if outcome == worst and d})
        return f"**{worst}**" + (f" ({', '.join(where)})" if where else "")


KINDS = ("size in", "asks for", "loss terms", "effects", "abilities", "loss falls")


def kinds_of(method, entry, losses):
    """Return what a method says of itself, as cells of the table."""
    from forewarp.methods.method import HasBounds, HasMatter, HasTrajectories

    can = {"trajectories": HasTrajectories, "bounds": HasBounds, "matter": HasMatter}
    asks = method.asks
    asked = [f"{asks.kind} of side {asks.side}" if asks.kind == "crops" else asks.kind]
    asked += [f"{asks.neighbours} neighbouring times"] * bool(asks.neighbours)
    asked += [f"up to {asks.instant} pictures of the time"] * bool(asks.instant)
    share = sum(losses[-10:]) / 10 / (sum(losses[:5]) / 5)
    cells = (
        method.size[0],
        ", ".join(asked),
        ", ".join(method.terms),
        ", ".join(entry.effects) or "none",
        ", ".join(word for word, ability in can.items() if isinstance(method, ability)) or "none",
        f"below {entry.falls:.0%} in {entry.steps} steps" if share < entry.falls else "**no**",
    )
    return dict(zip(KINDS, cells))


def table(head, rows):
    """Return the lines of a Markdown table."""
    rule = ["---"] * len(head)
    return ["| " + " | ".join(map(str, row)) + " |" for row in (head, rule, *rows)]
