import math

import pytest
import torch

from forewarp.ops.encode import positional_encoding, spherical_harmonics_1


def test_hand_worked():
    x = torch.tensor([[0.5, 1.0]])
    assert positional_encoding(x, 0) is x
    encoded = positional_encoding(x, 2)[0]
    s, c = math.sin, math.cos
    expected = [0.5, 1.0, s(0.5), s(1), s(1), s(2), c(0.5), c(1), c(1), c(2)]
    torch.testing.assert_close(encoded, torch.tensor(expected))
    assert positional_encoding(torch.zeros(1, 2), 1, identity=False).tolist() == [[0, 0, 1, 1]]


def test_harmonics_are_the_direction_in_another_order():
    assert spherical_harmonics_1(torch.tensor([[0.1, 0.2, 0.3]])).tolist() == [pytest.approx([0.2, 0.3, 0.1])]


def test_a_window_lets_octaves_in_one_after_the_other():
    x = torch.randn(4, 2)
    whole = positional_encoding(x, 3)
    for window, shares in ((3.0, (1, 1, 1)), (1.5, (1, 0.5, 0)), (0.0, (0, 0, 0))):
        windowed = positional_encoding(x, 3, window=window)
        assert windowed[:, :2].equal(x)
        octaves = torch.tensor(shares, dtype=torch.float32).repeat_interleave(2).repeat(2)
        torch.testing.assert_close(windowed[:, 2:], octaves * whole[:, 2:])
