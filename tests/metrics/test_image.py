import math

import numpy as np
import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from forewarp.metrics.image import PSNR_CAP, masked_ssim, ms_ssim, ms_ssim_legacy, psnr, quantise, ssim
from tests.support import reference


def noise(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_quantise_is_what_a_file_keeps():
    levels = torch.arange(256, dtype=torch.float64) / 255
    assert torch.equal(quantise(levels.float()), levels)
    assert quantise(torch.tensor([0.4 / 255, 0.6 / 255, 1.5])).mul(255).tolist() == [0, 1, 255]


def test_psnr_is_measured_on_8_bit_images():
    target = torch.full((4, 4, 3), 100 / 255)
    assert psnr(target + 0.4 / 255, target) == PSNR_CAP
    assert psnr(target + 0.6 / 255, target) == pytest.approx(20 * math.log10(255))
    white = torch.ones(4, 4, 3)
    assert psnr(white + 0.1, white) == PSNR_CAP  # a little outside is clipped, as saving does


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


@pytest.mark.slow
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


@pytest.mark.parametrize(("shape", "fits"), [((160, 200), False), ((161, 161), True)])
def test_a_window_fits_the_coarsest_scale(shape, fits):
    image = noise(*shape, 3)
    assert (ms_ssim(image, image) is not None) == fits
    assert (ms_ssim_legacy(image, image) is not None) == fits
    assert (ssim(image[150:], image[150:]) is not None) == fits


def test_opposite_patterns_are_cut_off_at_zero():
    checks = (torch.arange(176)[:, None] + torch.arange(176)) % 2
    image = checks.double()[..., None].expand(-1, -1, 3)
    assert ssim(image, 1 - image) < -0.9
    assert ms_ssim(image, 1 - image) == 0


def masked_mean(image, mask, axis):
    """A window's mean of pixels in a mask along an axis, each written out, and whether it has any."""
    image, mask = (np.moveaxis(x, axis, -1) for x in (image, mask))
    window = np.exp(-(np.arange(-5, 6) ** 2) / 4.5)
    window /= window.sum()
    means, some = np.zeros((2, *mask.shape[:-1], mask.shape[-1] - 10))
    for at in np.ndindex(means.shape):
        inside = mask[at[:-1]][at[-1] : at[-1] + 11]
        some[at] = inside.any()
        if inside.any():
            means[at] = (image[at[:-1]][at[-1] : at[-1] + 11] * inside * window).sum() * 11 / inside.sum()
    return np.moveaxis(means, -1, axis), np.moveaxis(some, -1, axis)


@pytest.mark.slow
def test_masked_ssim_is_its_twin():
    a, b, mask = noise(23, 27, 3), noise(23, 27, 3, seed=1), torch.zeros(23, 27)
    mask[3:9, 2:15] = mask[20:, 20:] = 1
    planes = [(255 * x).round().double().numpy() / 255 for x in (a, b)]
    values = []
    for channel in range(3):
        x, y = (plane[..., channel] for plane in planes)
        means = []
        for image in (x, y, x * x, y * y, x * y):
            means.append(masked_mean(*masked_mean(image, mask.numpy(), 1), 0)[0])
        m, n, xx, yy, xy = means
        xx, yy, xy = np.maximum(xx - m * m, 0), np.maximum(yy - n * n, 0), xy - m * n
        xy = np.sign(xy) * np.minimum(np.sqrt(xx * yy), np.abs(xy))
        values.append((2 * m * n + 1e-4) * (2 * xy + 9e-4) / ((m * m + n * n + 1e-4) * (xx + yy + 9e-4)))
    assert masked_ssim(a, b, mask.bool()) == pytest.approx(np.mean(values), abs=1e-10)
    assert np.abs(np.array(values) - 1).min() == 0  # windows without a pixel


def test_what_is_outside_the_mask_does_not_matter():
    image, mask = noise(23, 27, 3), torch.zeros(23, 27, dtype=torch.bool)
    mask[4:15, 5:20] = True
    changed = torch.where(mask[..., None], image, noise(23, 27, 3, seed=1))
    assert masked_ssim(changed, image, mask) == pytest.approx(1, abs=1e-12)
    assert masked_ssim(image, image, ~mask & mask) is None
    whole = masked_ssim(image, changed, mask | True)
    assert whole < 0.9
    assert masked_ssim(image[:10], image[:10], mask[:10]) is None


@pytest.mark.parametrize("metric", [psnr, ssim, ms_ssim, ms_ssim_legacy])
def test_refusals(metric):
    good = torch.full((12, 13, 3), 0.5)
    broken = good.clone()
    broken[3, 4, 1] = math.nan
    for pair, match in (
        ((broken, good), r"prediction: expected finite values, but got 1 of 468"),
        ((good, broken / 0), r"target: expected finite"),
        ((good[:0], good[:0]), r"prediction: expected pixels, but got shape \(0, 13, 3\)"),
        ((good[:, 1:], good), r"prediction: expected shape \(12, 13, 3\), but got \(12, 12, 3\)"),
        ((good.permute(2, 0, 1), good), r"prediction: expected shape \(12, 13, 3\), but got \(3, 12, 13\)"),
        ((good, good.mul(255).byte()), r"target: expected floats .* but got torch.uint8; divide by 255"),
        ((good * 255, good), r"prediction: expected values in \[0, 1\], but got \[127.5, 127.5\]"),
    ):
        with pytest.raises(ValueError, match=match):
            metric(*pair)
