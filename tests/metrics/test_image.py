import math

import numpy as np
import pytest
import torch
from torch.nn import functional as F
from torchmetrics.functional.image import structural_similarity_index_measure
from torchmetrics.image import PeakSignalNoiseRatio

from forewarp.metrics.image import PSNR_CAP, ms_ssim, ms_ssim_legacy, psnr, quantise, ssim
from tests.support import reference


def noise(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def tinted(height, width):
    """Make a warm-coloured textured image with the spectrum of natural images."""
    rows, columns = torch.fft.fftfreq(height)[:, None], torch.fft.rfftfreq(width)[None]
    falling = 1 / (rows**2 + columns**2).sqrt().clamp_min(1 / height)
    gray = torch.fft.irfft2(torch.fft.rfft2(noise(height, width) - 0.5) * falling, s=(height, width))
    gray = (gray - gray.min()) / (gray.max() - gray.min())
    return gray[..., None] * torch.tensor([0.9, 0.6, 0.3])


def blurred(image, sigma=5.0):
    x = torch.arange(-15, 16, dtype=image.dtype)
    weights = torch.exp(-(x**2) / (2 * sigma**2))
    weights = (weights / weights.sum()).view(1, 1, 1, -1)
    planes = F.pad(image.permute(2, 0, 1)[:, None], (15, 15, 15, 15), mode="reflect")
    planes = F.conv2d(F.conv2d(planes, weights), weights.transpose(2, 3))
    return planes[:, 0].permute(1, 2, 0)


def test_quantise_is_what_a_file_keeps():
    levels = torch.arange(256, dtype=torch.float64) / 255
    assert torch.equal(quantise(levels.float()), levels)
    assert quantise(torch.tensor([0.4 / 255, 0.6 / 255, 1.5])).mul(255).tolist() == [0, 1, 255]


def test_psnr_by_hand():
    # One value of 12 is wrong by 51/255 = 0.2.
    target = torch.zeros(2, 2, 3)
    prediction = target.clone()
    prediction[0, 1, 2] = 0.2
    assert psnr(prediction, target) == pytest.approx(-10 * math.log10(0.04 / 12))


def test_psnr_is_measured_on_8_bit_images():
    target = torch.full((4, 4, 3), 100 / 255)
    assert psnr(target + 0.4 / 255, target) == PSNR_CAP
    assert psnr(target + 0.6 / 255, target) == pytest.approx(20 * math.log10(255))


def test_mean_of_per_image_psnr_is_not_the_pooled_one():
    target = torch.zeros(2, 4, 5, 3)
    prediction = torch.stack([torch.full((4, 5, 3), v / 255) for v in (1.0, 51.0)])
    per_image = sum(psnr(p, t) for p, t in zip(prediction, target)) / 2
    pooled = PeakSignalNoiseRatio(data_range=1.0)(prediction, target).item()
    assert per_image == pytest.approx((20 * math.log10(255) + 20 * math.log10(5)) / 2)
    assert pooled == pytest.approx(-10 * math.log10((1 / 255**2 + 0.04) / 2), abs=1e-4)
    assert per_image > pooled + 10


@pytest.mark.parametrize("value", [0.0, 128 / 255, 254 / 255, 1.0])
def test_equal_flat_images_are_perfect(value):
    flat = torch.full((161, 170, 3), value)
    assert psnr(flat, flat) == PSNR_CAP
    # torchmetrics in float32 gives 0.9985 on near-white.
    for metric in (ssim, ms_ssim, ms_ssim_legacy):
        assert metric(flat, flat) == pytest.approx(1, abs=1e-9)


def test_similarity_of_black_and_white_by_hand():
    # No variance on either side: contrast is 1 and the luminance term is c1 / (1 + c1).
    black, white = torch.zeros(12, 15, 3), torch.ones(12, 15, 3)
    assert ssim(white, black) == pytest.approx(1e-4 / (1 + 1e-4))


def test_ssim_is_torchmetrics_in_float64():
    a, b = noise(23, 31, 3), noise(23, 31, 3, seed=1)
    planes = (quantise(x).permute(2, 0, 1)[None] for x in (a, b))
    theirs = structural_similarity_index_measure(*planes, data_range=1.0).item()
    assert ssim(a, b) == pytest.approx(theirs, abs=1e-12)


@pytest.mark.parametrize("legacy", [False, True])
def test_ms_ssim_is_its_twin(legacy):
    # Gray: the right one's channels are all alike, so its twin walks through one of them.
    plane = noise(161, 163)
    other = 0.6 * plane + 0.4 * noise(161, 163, seed=1)
    a, b = (quantise(x[..., None].expand(-1, -1, 3).contiguous()) for x in (plane, other))
    planes = [x.reshape(3, 161, 163) if legacy else x.permute(2, 0, 1)[:1] for x in (a, b)]
    halve = reference.halved_with_zeros if legacy else reference.halved
    values = []
    for x, y in zip(*(p.numpy() for p in planes)):
        value = 1.0
        for scale, weight in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
            similarity, contrast = reference.similarity_means(x, y)
            value *= (similarity if scale == 4 else contrast) ** weight
            x, y = halve(x), halve(y)
        values.append(value)
    metric = ms_ssim_legacy if legacy else ms_ssim
    assert metric(a, b) == pytest.approx(np.mean(values), abs=1e-10)


def test_legacy_ms_ssim_flatters_blur():
    # The steps between a pixel's red, green and blue pose as detail along a row, and outlive any blur.
    image = tinted(200, 240)
    right, legacy = ms_ssim(blurred(image), image), ms_ssim_legacy(blurred(image), image)
    assert 0.3 < right < 0.95
    assert legacy > right + 0.02


@pytest.mark.parametrize(("shape", "fits"), [((160, 200), False), ((200, 160), False), ((161, 161), True)])
def test_ms_ssim_needs_more_than_160_pixels(shape, fits):
    image = noise(*shape, 3)
    assert (ms_ssim(image, image) is not None) == fits
    assert (ms_ssim_legacy(image, image) is not None) == fits


def test_ssim_needs_a_window():
    assert ssim(noise(10, 40, 3), noise(10, 40, 3)) is None
    assert ssim(noise(11, 40, 3), noise(11, 40, 3)) == pytest.approx(1)


def test_opposite_patterns_are_cut_off_at_zero():
    checks = (torch.arange(176)[:, None] + torch.arange(176)) % 2
    image = checks.double()[..., None].expand(-1, -1, 3)
    assert ssim(image, 1 - image) < -0.9
    assert ms_ssim(image, 1 - image) == 0


@pytest.mark.parametrize("metric", [psnr, ssim, ms_ssim, ms_ssim_legacy])
def test_refusals(metric):
    good = torch.full((12, 13, 3), 0.5)
    broken = good.clone()
    broken[3, 4, 1] = math.nan
    with pytest.raises(ValueError, match=r"prediction: expected finite values, but got 1 of 468"):
        metric(broken, good)
    with pytest.raises(ValueError, match=r"target: expected finite"):
        metric(good, broken / 0)
    with pytest.raises(ValueError, match=r"prediction: expected shape \(12, 13, 3\), but got \(12, 12, 3\)"):
        metric(good[:, 1:], good)
    with pytest.raises(ValueError, match=r"prediction: expected an image \(H, W, 3\), but got"):
        metric(good.permute(2, 0, 1), good)
    with pytest.raises(ValueError, match=r"target: expected floats .* but got torch.uint8; divide by 255"):
        metric(good, good.mul(255).byte())
    with pytest.raises(
        ValueError, match=r"prediction: expected values in \[0, 1\], but got \[127.5, 127.5\]"
    ):
        metric(good * 255, good)


def test_a_prediction_a_little_outside_is_clipped_as_saving_does():
    target = torch.ones(4, 4, 3)
    assert psnr(target + 0.1, target) == PSNR_CAP
