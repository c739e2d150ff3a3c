"""The tables of docs/results/hard-cases.md and digits.md: marks, errors, and the tests that they name."""

import ast
import re
from pathlib import Path

import pytest
import torch

from tests.stability.report import error_text, relative_error, replace_section

pytestmark = pytest.mark.stability


def test_a_section_is_replaced_and_the_rest_stays(tmp_path):
    path = tmp_path / "a.md"
    path.write_text("before\n<!-- operators -->\nold\n<!-- end of operators -->\nafter\n")
    for text in ("new \\1", "newer"):
        replace_section(path, "operators", text)
    expected = "before\n<!-- operators -->\n\nnewer\n\n<!-- end of operators -->\nafter\n"
    assert path.read_text() == expected
    with pytest.raises(ValueError, match="expected the marks of 'lines', but got none"):
        replace_section(path, "lines", "x")


def test_relative_error_hand_worked():
    exact = [torch.tensor([2.0, -4.0]), torch.tensor([1.0])]
    assert relative_error([torch.tensor([2.0, -3.0]), torch.tensor([1.1])], exact) == 0.25
    assert relative_error([], []) is None
    assert relative_error([torch.zeros(2)], [torch.zeros(2)]) == 0
    for broken in (torch.tensor([float("nan"), 1.0]), torch.zeros(3)):
        assert error_text(relative_error([broken], exact[:1])) == "not finite"


ROOT = Path(__file__).parents[2]
DOCUMENT = (ROOT / "docs" / "results" / "hard-cases.md").read_text()


@pytest.mark.slow
def test_every_test_that_the_table_names_exists():
    named = re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", DOCUMENT)
    assert len(named) > 40
    for file, test in named:
        tree = ast.parse((ROOT / file).read_text())
        assert not test or test in {n.name for n in tree.body if isinstance(n, ast.FunctionDef)}, (file, test)


def test_all_thirty_cases_have_a_row():
    rows = [line.split("|")[1] for line in DOCUMENT.splitlines() if line.startswith("|")]
    numbers = {int(n) for row in rows for n in re.findall(r"\b\d+\b", re.split(r"[a-zA-Z]", row)[0])}
    assert set(range(1, 31)) <= numbers
