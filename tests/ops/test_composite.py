import math

import pytest
import torch

from forewarp.ops.march import accumulate, dense_weights, render_weights
from tests.support.reference import composite

IDS = torch.tensor([0, 0, 0, 2, 2, 4])  # rays 1, 3 and 5 have no sample


def random_optical(seed=0):
    return 3 * torch.rand(6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_equals_the_slow_twin():
    optical = random_optical()
    weights, transmittance = render_weights(optical, IDS, 6)
    expected, through = composite(optical, IDS, 6)
    torch.testing.assert_close(weights, torch.tensor(expected, dtype=torch.float64))
    torch.testing.assert_close(transmittance, torch.tensor(through, dtype=torch.float64))


def test_a_ray_does_not_depend_on_its_neighbours():
    optical = random_optical()
    alone, _ = render_weights(optical[3:5], torch.zeros(2, dtype=torch.int64), 1)
    crowd = torch.cat([torch.full((200_000,), 79.0), optical[3:5].float()])
    ids = torch.cat([torch.arange(200_000), torch.tensor([200_000, 200_000])])
    torch.testing.assert_close(render_weights(crowd, ids, 200_001)[0][-2:], alone.float())


def test_no_samples():
    optical = torch.zeros(0, requires_grad=True)
    weights, transmittance = render_weights(optical, torch.zeros(0, dtype=torch.int64), 3)
    assert transmittance.tolist() == [1, 1, 1]
    assert (
        accumulate(weights, torch.zeros(0, 2), torch.zeros(0, dtype=torch.int64), 3).tolist() == [[0, 0]] * 3
    )
    transmittance.sum().backward()
    assert optical.grad.shape == (0,)


def test_dense_equals_packed():
    optical = 3 * torch.rand(5, 4, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    weights, transmittance = dense_weights(optical)
    packed, through = render_weights(optical.flatten(), torch.arange(5).repeat_interleave(4), 5)
    torch.testing.assert_close(weights.flatten(), packed)
    torch.testing.assert_close(transmittance, through)
    torch.testing.assert_close(weights.sum(1) + transmittance, torch.ones(5, dtype=torch.float64))


def test_a_last_interval_without_end():
    optical = torch.tensor(
        [[math.log(2), 1e10], [math.log(2), 0.0], [math.inf, math.inf]], requires_grad=True
    )
    weights, transmittance = dense_weights(optical)
    torch.testing.assert_close(weights, torch.tensor([[0.5, 0.5], [0.5, 0], [1, 0]]))
    torch.testing.assert_close(transmittance, torch.tensor([0.0, 0.5, 0]), atol=1e-30, rtol=0)
    (weights[:, 0].sum() + 2 * transmittance.sum()).backward()
    assert optical.grad.isfinite().all()


def test_dense_edges():
    weights, transmittance = dense_weights(torch.zeros(2, 1))
    assert weights.tolist() == [[0], [0]]
    assert transmittance.tolist() == [1, 1]
    assert dense_weights(torch.zeros(0, 4))[0].shape == (0, 4)
    with pytest.raises(ValueError, match=r"optical: expected shape \(R, S\), but got \(3,\)"):
        dense_weights(torch.zeros(3))
