"""What doctests may use: ``fitted_run``, the folder of a small finished run, made where it is asked for."""

import subprocess
import sys

import pytest


@pytest.fixture(scope="session")
def fitted_run(tmp_path_factory):
    """The demo's vehicle in 32 pixels, 60 steps. Cost: about ten seconds."""
    from tests.stability.endurance import SMALL

    folder = tmp_path_factory.mktemp("fitted")
    own = [
        "data.scene=vehicle32",
        "budget.iterations=60",
        "sheets=0",
        f"data.root={folder}",
        f"run={folder}/run",
    ]
    words = [*(word for word in SMALL if word != "evaluate=false"), *own]
    # A process of its own: nothing that it sets remains.
    subprocess.run([sys.executable, "-m", "forewarp.cli.train", *words], check=True, capture_output=True)
    return str(folder / "run")


@pytest.fixture(autouse=True)
def _names_of_doctests(request, doctest_namespace):
    test = getattr(request.node, "dtest", None)
    if test is not None and "fitted_run" in test.docstring:
        doctest_namespace["fitted_run"] = request.getfixturevalue("fitted_run")
