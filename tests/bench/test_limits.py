"""What a lattice can show of an image."""

import torch

from forewarp.metrics.image import psnr
from tests.bench.limits import low_passed


def test_what_is_smooth_survives_and_what_is_fine_does_not():
    ramp = torch.linspace(0, 1, 48).expand(40, 48)[..., None].expand(-1, -1, 3)
    inner = (slice(4, -4), slice(4, -4))
    assert psnr(low_passed(ramp, 4)[inner], ramp[inner]) > 60
    chequered = ((torch.arange(40)[:, None] + torch.arange(48)) % 2).float()[..., None].expand(-1, -1, 3)
    assert (low_passed(chequered, 4)[inner] - 0.5).abs().max() < 0.02


def test_wider_voxels_show_less():
    image = torch.rand(40, 48, 3, generator=torch.Generator().manual_seed(0))
    found = [psnr(low_passed(image, pixels), image) for pixels in (1.5, 2, 4, 8)]
    assert found == sorted(found, reverse=True)
    assert low_passed(image, 1000).shape == image.shape
    assert low_passed(image, 1.0) is image  # voxels as fine as pixels lose nothing
