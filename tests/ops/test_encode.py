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


def test_a_window_lets_octaves_in_one_after_the_other():
    x = torch.randn(4, 2)
    whole = positional_encoding(x, 3)
    torch.testing.assert_close(positional_encoding(x, 3, window=3.0), whole)
    none = positional_encoding(x, 3, window=0.0)
    assert none[:, :2].equal(x)
    assert not none[:, 2:].any()
    half = positional_encoding(x, 3, window=1.5)
    shares = torch.tensor([1.0, 1, 0.5, 0.5, 0, 0]).repeat(2)
    torch.testing.assert_close(half[:, 2:], shares * whole[:, 2:])


def test_without_the_identity_zero_has_cosines_of_one():
    assert positional_encoding(torch.zeros(1, 2), 1, identity=False).tolist() == [[0, 0, 1, 1]]
    with pytest.raises(ValueError, match="expected frequencies >= 1 without the identity, but got 0"):
        positional_encoding(torch.zeros(1, 2), 0, identity=False)
