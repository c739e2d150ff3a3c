import torch
from torch.autograd import gradcheck

from forewarp.fields.networks import Template, Trunk


def small(**changes):
    torch.manual_seed(0)
    return Template(5, 4, **({"width": 6, "layers": 4, "skip": 3} | changes)).double()


def test_the_skip_enters_the_layer_that_is_named():
    sizes = [layer.in_features for layer in Trunk(7, width=10, layers=8, skip=6).layers]
    assert sizes == [7, 10, 10, 10, 10, 17, 10, 10]
    assert [layer.in_features for layer in Trunk(7, width=10, layers=3, skip=None).layers] == [7, 10, 10]


def test_hand_worked():
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
    network = small()
    with torch.no_grad():
        network.bottleneck.weight.zero_()
        network.bottleneck.bias.fill_(-1)
        network.shading.weight.fill_(-1)
        network.shading.bias.zero_()
    before = []
    network.color_head.register_forward_hook(lambda module, inputs, output: before.append(inputs[0]))
    network(torch.randn(1, 5).double(), torch.zeros(1, 4).double())
    assert before[0].tolist() == [[6.0] * 3]  # what is below 0 comes through


def test_gradcheck():
    network = small()
    x, condition = torch.randn(3, 5).double().requires_grad_(), torch.randn(3, 4).double().requires_grad_()
    assert gradcheck(network, (x, condition))
