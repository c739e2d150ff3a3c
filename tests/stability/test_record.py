"""Every test that docs/stability.md names exists."""

import ast
import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.stability

ROOT = Path(__file__).parents[2]
DOCUMENT = (ROOT / "docs" / "stability.md").read_text()


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
