import math

import pytest
import torch

from forewarp.ops.encode import positional_encoding, spherical_harmonics_1


def test_hand_worked():
    encoded = positional_encoding(torch.tensor([[0.5, 1.0]]), 2)[0]
    s, c = math.sin, math.cos
    expected = [0.5, 1.0, s(0.5), s(1), s(1), s(2), c(0.5), c(1), c(1), c(2)]
    torch.testing.assert_close(encoded, torch.tensor(expected))


def test_without_frequencies_it_is_the_identity():
    x = torch.randn(4, 3)
    assert positional_encoding(x, 0) is x


def test_harmonics_are_the_direction_in_another_order():
    direction = torch.tensor([[0.1, 0.2, 0.3]], requires_grad=True)
    harmonics = spherical_harmonics_1(direction)
    assert harmonics.tolist() == [pytest.approx([0.2, 0.3, 0.1])]
    harmonics[:, 0].sum().backward()
    assert direction.grad.tolist() == [[0, 1, 0]]
