import pytest
import torch

from forewarp.methods.voxel.effects.inpaint import ConvBlock, UNet3d


@pytest.mark.parametrize("size", [(1, 1, 1), (1, 2, 5), (3, 4, 5), (7, 11, 9), (17, 8, 2)])
@pytest.mark.parametrize("kind", ["random", "constant", "empty"])
def test_any_size_is_finite_with_finite_gradients(size, kind):
    net = UNet3d(channels=4, width=16, levels=3)
    torch.nn.init.normal_(net.head.weight)
    volume = {"random": torch.randn(1, 4, *size), "constant": torch.full((1, 4, *size), 2.5)}
    dense = volume.get(kind, torch.full((1, 4, *size), -10.0)).requires_grad_()
    out = net.residual(net.features(dense))
    assert out.shape == (1, 4, *size)
    assert out.isfinite().all()
    out.square().sum().backward()
    assert dense.grad.isfinite().all()
    assert all(p.grad is None or p.grad.isfinite().all() for p in net.parameters())


def test_the_first_step_is_the_identity_and_it_can_learn():
    net = UNet3d(channels=4, width=16, levels=2)
    residual = net.residual(net.features(torch.randn(1, 4, 3, 4, 5)))
    assert (residual == 0).all()
    residual.sum().backward()
    assert net.head.weight.grad.abs().sum() > 0


def test_four_levels_as_printed():
    net = UNet3d(channels=13)
    assert len(net.encode) == 4
    assert len(net.decode) == 3
    assert net.features(torch.randn(1, 13, 3, 4, 5)).shape == (1, 16, 3, 4, 5)


def test_a_voxel_alone_is_not_normalised():
    block = ConvBlock(2, 3)
    alone, doubled = torch.randn(1, 2, 1, 1, 1), torch.randn(1, 2, 2, 1, 1)
    torch.testing.assert_close(block(alone), torch.relu(block.conv(alone)))
    torch.testing.assert_close(block(doubled), torch.relu(block.conv(block.norm(doubled))))


@pytest.mark.parametrize("wrong", [{"width": 12}, {"levels": 1}])
def test_refuses(wrong):
    with pytest.raises(
        ValueError, match=r"model.inpainter: expected a width that is a multiple of 16 and levels >= 2"
    ):
        UNet3d(channels=4, **wrong)
