"""The example method of docs/extending.md meets a part of the contract; the page of the suite is whole."""

import importlib
import re

import pytest

from forewarp.training.checkpoints import load_handover
from tests.contract.fitting import Losses, run_of, stage_of
from tests.contract.scenes import data_of
from tests.contract.table import METHODS, Entry
from tests.support.configs import ROOT


def block_of(title, language="python"):
    """Return the first code block under a heading."""
    section = re.split(r"^## ", (ROOT / "docs" / "extending.md").read_text(), flags=re.MULTILINE)
    text = next(part for part in section if part.startswith(title + "\n"))
    return re.search(rf"```{language}\n(.*?)```", text, re.DOTALL)[1]


@pytest.mark.slow
def test_the_method_of_the_page_learns(scenes, tmp_path, monkeypatch):
    path = tmp_path / "page_of_extending.py"
    path.write_text(block_of("A method"))
    monkeypatch.syspath_prepend(tmp_path)
    line = block_of("How to test it", "text").strip().removesuffix(",")
    balls = importlib.import_module(path.stem).Balls
    entry = eval("{" + line + "}", {"Entry": Entry, "Balls": balls})["balls"]
    losses = Losses()
    run_of([stage_of(entry)], data_of("hypernerf", scenes), tmp_path, losses).fit()
    assert sum(losses.values[-10:]) / 10 < entry.falls * sum(losses.values[:5]) / 5
    assert load_handover(tmp_path / "fine").paths.shape == (64, 6, 3)


def test_the_page_of_the_suite_has_every_method_and_no_failure():
    page = (ROOT / "docs" / "results" / "conformance.md").read_text()
    (head,) = (line for line in page.splitlines() if line.startswith("| case |"))
    assert [cell.strip() for cell in head.strip("|").split("|")] == ["case", *METHODS]
    assert "**failed**" not in page
