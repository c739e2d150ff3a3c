import pytest
import torch
from torch import nn

from forewarp.fields.mlp import mlp


def test_layers_and_widths():
    network = mlp(5, 2, width=7, layers=3)
    assert [(m.in_features, m.out_features) for m in network if isinstance(m, nn.Linear)] == [
        (5, 7),
        (7, 7),
        (7, 2),
    ]
    assert isinstance(network[-1], nn.Linear)
    assert len(mlp(5, 2, width=7, layers=1)) == 1


def test_zero_last_starts_from_zero_and_learns():
    network = mlp(5, 2, width=7, layers=3, zero_last=True)
    out = network(torch.randn(4, 5))
    assert (out == 0).all()
    out.sum().backward()
    assert network[-1].weight.grad.abs().sum() > 0


@pytest.mark.parametrize("wrong", [{"layers": 0}, {"width": 0}])
def test_refuses(wrong):
    with pytest.raises(ValueError, match="expected layers >= 1 and width >= 1, but got"):
        mlp(5, 2, **({"width": 7, "layers": 2} | wrong))
