"""Perceptrons, NeRF's trunk and template, codes of instants and cameras."""

from functools import partial

import pytest
import torch
from torch.autograd import gradcheck

from forewarp.fields.networks import CameraCodes, Template, TimeCodes, Trunk, mlp


def test_zero_last_starts_from_zero_and_learns():
    network = mlp(5, 2, width=7, layers=3, zero_last=True)
    out = network(torch.randn(4, 5))
    assert (out == 0).all()
    out.sum().backward()
    assert network[-1].weight.grad.abs().sum() > 0


def small():
    torch.manual_seed(0)
    return Template(5, 4, width=6, layers=4, skip=3).double()


def test_the_skip_enters_the_layer_that_is_named():
    sizes = [layer.in_features for layer in Trunk(7, width=10, layers=8, skip=6).layers]
    assert sizes == [7, 10, 10, 10, 10, 17, 10, 10]
    assert [layer.in_features for layer in Trunk(7, width=10, layers=3, skip=None).layers] == [7, 10, 10]
    trunk = Trunk(1, width=1, layers=2, skip=2)
    with torch.no_grad():
        for layer in trunk.layers:
            layer.bias.fill_(1)
        trunk.layers[0].weight.fill_(2)
        trunk.layers[1].weight.copy_(torch.tensor([[10.0, -1.0]]))  # of the input, of the layer before
    # relu(10 x - relu(2 x + 1) + 1)
    assert trunk(torch.tensor([[3.0], [-1.0], [0.125]])).tolist() == [[24.0], [0.0], [1.0]]


def test_density_sees_no_condition_and_colour_does():
    network, x = small(), torch.randn(3, 5).double()
    near, far = (network(x, condition) for condition in torch.randn(2, 3, 4).double())
    assert torch.equal(near[0], far[0])
    assert torch.equal(near[0], network.density(x))
    assert not torch.equal(near[1], far[1])
    assert near[1].shape == (3, 3)
    assert ((near[1] > 0) & (near[1] < 1)).all()


def test_the_bottleneck_has_no_activation():
    network, before = small(), []
    with torch.no_grad():
        network.bottleneck.weight.zero_()
        network.bottleneck.bias.fill_(-1)
        network.shading.weight.fill_(-1)
        network.shading.bias.zero_()
    network.color_head.register_forward_hook(lambda module, inputs, output: before.append(inputs[0]))
    network(torch.randn(1, 5).double(), torch.zeros(1, 4).double())
    assert before[0].tolist() == [[6.0] * 3]  # what is below 0 comes through


def test_gradcheck():
    x, condition = torch.randn(3, 5).double().requires_grad_(), torch.randn(3, 4).double().requires_grad_()
    assert gradcheck(small(), (x, condition))


@pytest.mark.parametrize(
    ("time", "shares"),
    [(-1.0, (1, 0)), (0.0, (1, 0)), (0.125, (0.75, 0.25)), (0.5, (0, 1)), (1.0, (0, 1))],
)
def test_codes_between_times_are_those_beside_it_and_stay_beyond_them(time, shares):
    codes = TimeCodes((0.0, 0.5), 4)
    torch.testing.assert_close(codes(time), torch.tensor(shares, dtype=torch.float32) @ codes.table)


def test_first_values_of_codes_are_small_and_positive():
    table = TimeCodes([i / 99 for i in range(100)], 8).table.detach()
    assert 0 <= float(table.min()) < float(table.max()) < 0.05


def test_a_camera_that_is_not_known_sees_by_the_mean():
    codes = CameraCodes({55, 1, 9}, 3)  # ids are not rows
    for row, camera in enumerate((1, 9, 55)):
        assert codes(camera).equal(codes.table[row])
    for unknown in (None, 0, 2, -1):
        torch.testing.assert_close(codes(unknown), codes.table.mean(0))
    assert CameraCodes({None, 4}, 3)(None).shape == (3,)


SKIP = r"width and layers >= 1 and a skip in \[2, layers\] or"


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (partial(mlp, 5, 2, width=7, layers=0), "expected layers >= 1 and width >= 1, but"),
        *(
            (partial(Trunk, 5, **({"width": 6, "layers": 4, "skip": 3} | wrong)), SKIP)
            for wrong in ({"skip": 1}, {"skip": 5}, {"layers": 0}, {"width": 0})
        ),
        (
            partial(Template, 5, 0, width=8, layers=4, skip=3),
            "template: expected condition >= 1 and width >= 2, but got",
        ),
    ],
)
def test_refuses(call, text):
    with pytest.raises(ValueError, match=text):
        call()
