import torch

from forewarp.methods.voxel.effects.inpaint import ConvBlock, UNet3d


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
