"""The page that the contract suite wrote last."""

from tests.contract.table import METHODS
from tests.support.configs import ROOT


def test_the_page_has_every_method_and_no_failure():
    page = (ROOT / "docs" / "conformance.md").read_text()
    (head,) = (line for line in page.splitlines() if line.startswith("| case |"))
    assert [cell.strip() for cell in head.strip("|").split("|")] == ["case", *METHODS]
    assert "**failed**" not in page
