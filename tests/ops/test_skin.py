import pytest
import torch

from forewarp.ops.nodes import skin_weights


def numbers(count, width, spread=1.0):
    generator = torch.Generator().manual_seed(count)
    shares = torch.rand(count, width, generator=generator)
    shares[::7] = 0  # at rest
    return shares, spread * torch.randn(count, width, generator=generator)


@pytest.mark.parametrize("count", [0, 1, 16, 17, 33, 2000])
@pytest.mark.parametrize("width", [1, 6, 16, 17])
def test_kernel_equals_reference(backend, count, width):
    shares, learned = numbers(count, width)
    exact = skin_weights(shares.double(), learned.double())
    torch.testing.assert_close(skin_weights(shares, learned), exact.float(), atol=1e-6, rtol=1e-6)


def test_weights_sum_to_one_but_at_rest(backend):
    shares, learned = numbers(100, 6)
    sums = skin_weights(shares, learned).sum(-1)
    assert bool((sums[::7] == 0).all())
    rest = torch.arange(100) % 7 != 0
    torch.testing.assert_close(sums[rest], torch.ones(int(rest.sum())))


@pytest.mark.parametrize("added", [-1e6, -300.0, 300.0, 1e6])
def test_only_differences_count(backend, added):
    shares, learned = numbers(40, 6, spread=1e2)
    learned = learned.round()  # exact beside a million
    assert torch.equal(skin_weights(shares, learned + added), skin_weights(shares, learned))


def test_parts_of_arrays_are_read_as_they_are(backend):
    shares, learned = numbers(40, 6)
    wide = torch.stack([learned, torch.zeros_like(learned)], -1)[..., 0]
    assert torch.equal(skin_weights(shares, wide), skin_weights(shares, learned))


def test_two_threads_give_the_same(two_threads):
    shares, learned = numbers(5000, 6)
    together = skin_weights(shares, learned)
    torch.set_num_threads(1)
    assert torch.equal(skin_weights(shares, learned), together)


def test_shapes_that_do_not_go_together_are_refused():
    with pytest.raises(ValueError, match="^learned: expected"):
        skin_weights(torch.ones(3, 2), torch.ones(3, 4))
