"""Fit the example method of docs/extending.md and test it against a part of the contract."""

import importlib.util
import re
import sys
from pathlib import Path

import pytest
import torch

from forewarp.methods.abilities import HasMatter, HasTrajectories
from forewarp.scene.view import Moment
from forewarp.training.handover import load_handover
from tests.contract.fitting import Losses, run_of, stage_of
from tests.contract.scenes import data_of
from tests.contract.table import Entry

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"


def block_of(title, language="python"):
    """Return the first code block under a heading."""
    section = re.split(r"^## ", PAGE.read_text(), flags=re.MULTILINE)
    text = next(part for part in section if part.startswith(title + "\n"))
    return re.search(rf"```{language}\n(.*?)```", text, re.DOTALL)[1]


@pytest.fixture
def page(tmp_path, monkeypatch):
    """Import the method's code block as a module."""
    path = tmp_path / "page_of_extending.py"
    path.write_text(block_of("A method"))
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, path.stem, module)
    spec.loader.exec_module(module)
    return module


def test_the_method_is_short_and_its_lines_fit():
    lines = [line for line in block_of("A method").splitlines() if line.strip()]
    assert len(lines) <= 65
    assert max(map(len, lines)) <= 110


@pytest.mark.parametrize("dataset", ["dnerf", "hypernerf"])
def test_the_method_of_the_page_learns(page, dataset, scenes, tmp_path):
    line = block_of("How to test it", "text").strip().removesuffix(",")
    entry = eval("{" + line + "}", {"Entry": Entry, "Balls": page.Balls})["balls"]
    losses = Losses()
    run = run_of([stage_of(entry)], data_of(dataset, scenes), tmp_path, losses)
    module = run.fit()
    assert sum(losses.values[-10:]) / 10 < entry.falls * sum(losses.values[:5]) / 5
    again, camera = run.load(), run.datamodule.scene.train[0].camera
    drawn = [m.render(camera, Moment(0.3), torch.ones(3)) for m in (module, again)]
    assert torch.equal(drawn[0].rgb, drawn[1].rgb)
    assert isinstance(module.method, HasTrajectories)
    assert isinstance(module.method, HasMatter)
    assert load_handover(tmp_path / "fine").paths.shape == (64, 6, 3)
