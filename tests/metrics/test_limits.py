import torch

from forewarp.metrics.image import psnr
from forewarp.metrics.limits import REGIONS, error_shares, low_passed, regions

torch.manual_seed(0)
NOISE = torch.rand(40, 48, 3)
DISC = (torch.arange(40)[:, None] - 20) ** 2 + (torch.arange(48)[None] - 20) ** 2 < 100


def test_what_is_smooth_survives_and_what_is_fine_does_not():
    ramp = torch.linspace(0, 1, 48).expand(40, 48)[..., None].expand(-1, -1, 3)
    inner = (slice(4, -4), slice(4, -4))
    assert psnr(low_passed(ramp, 4)[inner], ramp[inner]) > 60
    chequered = ((torch.arange(40)[:, None] + torch.arange(48)) % 2).float()[..., None].expand(-1, -1, 3)
    assert (low_passed(chequered, 4)[inner] - 0.5).abs().max() < 0.02


def test_wider_voxels_show_less():
    found = [psnr(low_passed(NOISE, pixels), NOISE) for pixels in (1.5, 2, 4, 8)]
    assert found == sorted(found, reverse=True)
    assert low_passed(NOISE, 1000).shape == NOISE.shape
    assert low_passed(NOISE, 1.0) is NOISE  # voxels as fine as pixels lose nothing


def test_regions_share_no_pixel_and_miss_none():
    found = regions(DISC)
    assert list(found) == list(REGIONS)
    assert (sum(mask.int() for mask in found.values()) == 1).all()
    assert found["inside"][20, 20]
    assert found["outside"][0, 0]
    assert found["outline"][20, [26, 29, 30, 33]].tolist() == [False, True, True, False]
    assert regions(torch.ones(5, 7, dtype=bool))["inside"].all()


def test_errors_are_shared_out_whole():
    image = NOISE.clone()
    image[20, 20] += 1.0
    image[0, 0] += 2.0
    found = error_shares(NOISE, image, DISC)
    shares = {name: round(float(value), 4) for name, value in found.items()}
    assert shares == {"outside": 4.0, "outline": 0.0, "inside": 1.0}
