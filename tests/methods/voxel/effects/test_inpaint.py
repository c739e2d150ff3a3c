import pytest
import torch

from forewarp.methods.voxel.effects import ConvBlock, UNet3d, convolve


def test_the_first_step_is_the_identity_and_it_can_learn():
    net = UNet3d(channels=4, width=16, levels=2)
    residual = net.residual(net.features(torch.randn(1, 4, 3, 4, 5)))
    assert (residual == 0).all()
    residual.sum().backward()
    assert net.head.weight.grad.abs().sum() > 0


def test_a_voxel_alone_is_not_normalised():
    block = ConvBlock(2, 3)
    alone, doubled = torch.randn(1, 2, 1, 1, 1), torch.randn(1, 2, 2, 1, 1)
    torch.testing.assert_close(block(alone), torch.relu(block.conv(alone)))
    torch.testing.assert_close(block(doubled), torch.relu(block.conv(block.norm(doubled))))


@pytest.mark.parametrize("size", [(1, 2, 3), (9, 10, 12), (42, 32, 8)])
@pytest.mark.parametrize("threads", [1, 2])
def test_a_convolution_is_the_layers_own_on_any_number_of_threads(size, threads):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        layer = torch.nn.Conv3d(16, 16, 3, padding=1)
        x = torch.randn(1, 16, *size).to(memory_format=torch.channels_last_3d).requires_grad_()
        weights = torch.randn(1, 16, *size)
        found = torch.autograd.grad((convolve(layer, x) * weights).sum(), [x, *layer.parameters()])
        exact = layer.double()
        wanted = torch.autograd.grad((exact(x.double()) * weights).sum(), [x, *exact.parameters()])
    finally:
        torch.set_num_threads(before)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other.float(), rtol=1e-3, atol=1e-3)


def test_one_thread_takes_the_fast_convolution_too(monkeypatch):
    layer, x = torch.nn.Conv3d(16, 16, 3, padding=1), torch.randn(1, 16, 8, 8, 8)
    taken = []
    monkeypatch.setattr(torch.nn.functional, "conv3d", lambda x, *_, **__: taken.append(x.is_mkldnn) or x)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    convolve(layer, x)
    assert taken == [torch.backends.mkldnn.is_available()]
