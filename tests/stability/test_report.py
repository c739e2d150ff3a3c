"""The command that writes docs/stability.md: its table and its marks."""

import pytest
import torch

from tests.stability import report as stability
from tests.stability import twin


def test_a_section_is_replaced_and_the_rest_stays(tmp_path):
    path = tmp_path / "a.md"
    path.write_text("before\n<!-- operators -->\nold\n<!-- end of operators -->\nafter\n")
    for text in ("new \\1", "newer"):
        stability.replace_section(path, "operators", text)
    expected = "before\n<!-- operators -->\n\nnewer\n\n<!-- end of operators -->\nafter\n"
    assert path.read_text() == expected
    with pytest.raises(ValueError, match="expected the marks of 'lines', but got none"):
        stability.replace_section(path, "lines", "x")


def test_relative_error_hand_worked():
    exact = [torch.tensor([2.0, -4.0]), torch.tensor([1.0])]
    assert twin.relative_error([torch.tensor([2.0, -3.0]), torch.tensor([1.1])], exact) == 0.25
    assert twin.relative_error([], []) is None
    assert twin.relative_error([torch.zeros(2)], [torch.zeros(2)]) == 0
    for broken in (torch.tensor([float("nan"), 1.0]), torch.zeros(3)):
        assert stability.error_text(twin.relative_error([broken], exact[:1])) == "not finite"
