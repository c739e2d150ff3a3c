"""Cut-outs: what the mask says and nothing of what lies behind, whole or halved."""

import numpy as np
import pytest
import torch

from forewarp.data.cache import CACHE
from forewarp.data.jpeg import write_jpeg
from forewarp.data.masked import MaskedImage, halved_cutout

STUDIO, SKIN = (20, 160, 40), (200, 120, 100)


@pytest.fixture
def files(tmp_path):
    """A rectangle of rows 8 to 20 and columns 5 to 30 in front of a studio, 40 x 31."""
    image = np.broadcast_to(np.array(STUDIO, np.uint8), (31, 40, 3)).copy()
    mask = np.zeros((31, 40), np.uint8)
    image[8:21, 5:31], mask[8:21, 5:31] = SKIN, 255
    write_jpeg(tmp_path / "image.jpg", image, quality=100)
    write_jpeg(tmp_path / "mask.jpg", mask)
    return tmp_path / "image.jpg", tmp_path / "mask.jpg"


def test_the_foreground_is_cut_out(files):
    rgba = MaskedImage(*files, (40, 31))()
    expected = torch.zeros(31, 40, dtype=torch.uint8)
    expected[8:21, 5:31] = 255
    assert torch.equal(rgba[..., 3], expected)
    assert (rgba[expected == 0] == 0).all()
    inner = rgba[10:19, 7:29, :3].int() - torch.tensor(SKIN)
    assert inner.abs().max() <= 4


def test_only_the_foreground_is_kept(files):
    load, before = MaskedImage(*files, (40, 31)), CACHE.bytes
    first = load()
    assert CACHE.bytes - before == 13 * 26 * 4
    files[0].unlink()
    assert torch.equal(load(), first)


def test_halves_cut_off_an_odd_row_and_mix_in_no_studio(files):
    rgba = MaskedImage(*files, (40, 31), halve=True)()
    assert rgba.shape == (15, 20, 4)
    assert rgba[4:10, 3:15, 3].eq(255).all()
    assert rgba[4:10, 2, 3].eq(128).all()  # columns 4 and 5, of which one is foreground
    edge = rgba[5:9, 2, :3].int() - torch.tensor(SKIN)
    assert edge.abs().max() <= 12


def test_halving_by_hand():
    block = torch.tensor([[[10, 20, 30, 255], [0] * 4], [[20, 40, 61, 255], [0] * 4]], dtype=torch.uint8)
    assert halved_cutout(block).tolist() == [[[15, 30, 46, 128]]]
    assert halved_cutout(torch.zeros(3, 5, 4, dtype=torch.uint8)).tolist() == [[[0] * 4] * 2]


def test_an_empty_mask_is_an_empty_image(files):
    write_jpeg(files[1], np.full((31, 40), 100, np.uint8))
    assert torch.equal(MaskedImage(*files, (40, 31))(), torch.zeros(31, 40, 4, dtype=torch.uint8))
