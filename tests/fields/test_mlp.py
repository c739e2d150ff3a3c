import torch

from forewarp.fields.networks import mlp


def test_zero_last_starts_from_zero_and_learns():
    network = mlp(5, 2, width=7, layers=3, zero_last=True)
    out = network(torch.randn(4, 5))
    assert (out == 0).all()
    out.sum().backward()
    assert network[-1].weight.grad.abs().sum() > 0
