"""Pixels: composition, halving, decoding once."""

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from forewarp.data.images import (
    CachedImage,
    composited,
    halved,
    halved_depth,
    inspect_png,
    read_image,
    write_png,
)
from forewarp.scene.errors import SceneError


def test_composition_by_hand():
    rgba = torch.tensor([[[255, 0, 51, 255], [255, 0, 51, 0], [255, 0, 51, 51]]], dtype=torch.uint8)
    expected = torch.tensor([[[1, 0, 0.2], [0.5, 0.5, 1], [0.6, 0.4, 0.84]]])
    torch.testing.assert_close(composited(rgba, torch.tensor([0.5, 0.5, 1])), expected)


def test_composition_over_a_colour_per_ray():
    rgba = torch.zeros(3, 4, dtype=torch.uint8)
    behind = torch.rand(3, 3)
    assert torch.equal(composited(rgba, behind), behind)


def test_halving_is_the_rounded_mean_of_straight_values():
    rgba = torch.randint(0, 256, (6, 10, 4), dtype=torch.uint8)
    mean = rgba.double().reshape(3, 2, 5, 2, 4).mean((1, 3))
    assert torch.equal(halved(rgba), mean.round().to(torch.uint8))  # half to even, as torch rounds
    white = torch.full((2, 2, 4), 255, dtype=torch.uint8)
    assert torch.equal(halved(white), white[:1, :1])


def test_halved_depth_averages_the_foreground():
    depth = torch.tensor([[2.0, 0.0, 0.0, 0.0], [4.0, 0.0, 0.0, 0.0]])
    assert torch.equal(halved_depth(depth), torch.tensor([[3.0, 0.0]]))


@pytest.mark.parametrize(("channels", "alpha"), [(3, False), (4, True)])
def test_header_and_pixels_of_either_kind(tmp_path, channels, alpha):
    pixels = np.random.default_rng(0).integers(0, 256, (4, 6, channels), dtype=np.uint8)
    iio.imwrite(tmp_path / "a.png", pixels)
    header = inspect_png(tmp_path / "a.png")
    assert (header.size, header.has_alpha) == ((6, 4), alpha)
    image = read_image(tmp_path / "a.png")
    assert np.array_equal(image[..., :channels], pixels)
    assert alpha or (image[..., 3] == 255).all()


def test_an_image_is_decoded_once(tmp_path):
    pixels = torch.randint(0, 256, (4, 6, 4), dtype=torch.uint8)
    write_png(tmp_path / "a.png", pixels)
    load = CachedImage(tmp_path / "a.png", (6, 4))
    assert torch.equal(load(), pixels)
    (tmp_path / "a.png").unlink()
    assert load() is load()


def test_what_is_no_image_is_named(tmp_path):
    (tmp_path / "a.jpg").write_text("no image")
    with pytest.raises(
        SceneError, match=r"a.jpg: expected a PNG or JPEG image, but got a file of another kind"
    ):
        read_image(tmp_path / "a.jpg")
    with pytest.raises(SceneError, match=r"b.png: expected an image, but got No such file"):
        read_image(tmp_path / "b.png")
