import math

import pytest
import torch
from torch.autograd import gradcheck

from forewarp.ops.composite import accumulate, dense_weights, render_weights
from tests.support.reference import composite

IDS = torch.tensor([0, 0, 0, 2, 2, 4])  # rays 1, 3 and 5 have no sample


def random_optical(seed=0):
    return 3 * torch.rand(6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_hand_worked():
    weights, transmittance = render_weights(torch.tensor([math.log(2), math.log(4)]), torch.tensor([0, 0]), 1)
    torch.testing.assert_close(weights, torch.tensor([0.5, 0.375]))
    assert transmittance.item() == pytest.approx(0.125)


def test_equals_the_slow_twin():
    optical = random_optical()
    weights, transmittance = render_weights(optical, IDS, 6)
    expected, through = composite(optical, IDS, 6)
    torch.testing.assert_close(weights, torch.tensor(expected, dtype=torch.float64))
    torch.testing.assert_close(transmittance, torch.tensor(through, dtype=torch.float64))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weights_and_what_passes_sum_to_one(dtype):
    optical = random_optical(1).to(dtype)
    weights, transmittance = render_weights(optical, IDS, 6)
    total = accumulate(weights, torch.ones(6, 1, dtype=dtype), IDS, 6)[:, 0] + transmittance
    assert weights.dtype == dtype
    torch.testing.assert_close(total, torch.ones(6, dtype=dtype))
    assert transmittance[[1, 3, 5]].tolist() == [1, 1, 1]


def test_a_ray_does_not_depend_on_its_neighbours():
    optical = random_optical()
    alone, _ = render_weights(optical[3:5], torch.zeros(2, dtype=torch.int64), 1)
    crowd = torch.cat([torch.full((200_000,), 79.0), optical[3:5].float()])
    ids = torch.cat([torch.arange(200_000), torch.tensor([200_000, 200_000])])
    torch.testing.assert_close(render_weights(crowd, ids, 200_001)[0][-2:], alone.float())


def test_gradcheck():
    optical = random_optical().requires_grad_()
    assert gradcheck(lambda x: render_weights(x, IDS, 6), optical)
    weights, values = random_optical().requires_grad_(), torch.randn(6, 2).double().requires_grad_()
    assert gradcheck(lambda w, v: accumulate(w, v, IDS, 6), (weights, values))


@pytest.mark.parametrize("huge", [80.0, 1e4, 1e30, float("inf")])
def test_opaque_matter_hides_what_follows_with_finite_gradients(huge):
    optical = torch.tensor([0.0, huge, huge, 1.0, 1.0], requires_grad=True)
    weights, transmittance = render_weights(optical, torch.tensor([0, 0, 0, 1, 1]), 2)
    e = math.exp(-1)
    torch.testing.assert_close(weights, torch.tensor([0, 1, 0, 1 - e, e * (1 - e)]))
    assert transmittance[0].item() == pytest.approx(0, abs=1e-30)
    (weights.sum() + transmittance.sum()).backward()
    assert optical.grad.isfinite().all()


def test_thin_matter_is_not_lost_to_rounding():
    weights, _ = render_weights(torch.tensor([5e-7]), torch.tensor([0]), 1)
    assert weights.item() == pytest.approx(5e-7, rel=1e-6)


def test_no_samples():
    optical = torch.zeros(0, requires_grad=True)
    weights, transmittance = render_weights(optical, torch.zeros(0, dtype=torch.int64), 3)
    assert transmittance.tolist() == [1, 1, 1]
    assert (
        accumulate(weights, torch.zeros(0, 2), torch.zeros(0, dtype=torch.int64), 3).tolist() == [[0, 0]] * 3
    )
    transmittance.sum().backward()
    assert optical.grad.shape == (0,)


def test_refuses_other_shapes():
    with pytest.raises(ValueError, match=r"optical: expected shape \(P\)"):
        render_weights(torch.zeros(2, 1), torch.zeros(2, dtype=torch.int64), 1)
    with pytest.raises(ValueError, match=r"values: expected shape \(2, C\), but got \(3, 1\)"):
        accumulate(torch.zeros(2), torch.zeros(3, 1), torch.zeros(2, dtype=torch.int64), 1)


def test_dense_equals_packed():
    optical = 3 * torch.rand(5, 4, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    weights, transmittance = dense_weights(optical)
    packed, through = render_weights(optical.flatten(), torch.arange(5).repeat_interleave(4), 5)
    torch.testing.assert_close(weights.flatten(), packed)
    torch.testing.assert_close(transmittance, through)
    torch.testing.assert_close(weights.sum(1) + transmittance, torch.ones(5, dtype=torch.float64))


def test_dense_gradcheck():
    optical = (3 * torch.rand(3, 4, dtype=torch.float64)).requires_grad_()
    assert gradcheck(dense_weights, optical)


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
