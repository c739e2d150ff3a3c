"""JPEG headers: the size without decoding, and one line for what is no good."""

import imageio.v3 as iio
import numpy as np
import pytest

from forewarp.data.images import read_image
from forewarp.data.jpeg import inspect_jpeg, write_jpeg
from forewarp.scene.errors import SceneError

NOISE = np.random.default_rng(0).integers(0, 256, (37, 53, 3), dtype=np.uint8)


@pytest.fixture
def path(tmp_path):
    """A written image of 53 x 37 pixels."""
    write_jpeg(tmp_path / "a.jpg", NOISE)
    return tmp_path / "a.jpg"


@pytest.mark.parametrize(
    "options", [{}, {"progressive": True}, {"optimize": True}, {"comment": b"c" * 60000}]
)
def test_the_size_of_every_kind(tmp_path, options):
    iio.imwrite(tmp_path / "a.jpg", NOISE, plugin="pillow", **options)
    assert inspect_jpeg(tmp_path / "a.jpg") == (53, 37)
    iio.imwrite(tmp_path / "a.jpg", NOISE[..., 0], plugin="pillow", **options)
    assert inspect_jpeg(tmp_path / "a.jpg") == (53, 37)


def test_written_pixels_come_back_nearly(path):
    rgba = read_image(path).numpy()
    assert (rgba[..., 3] == 255).all()
    assert np.abs(rgba[..., :3].astype(int) - NOISE).mean() < 4


def test_what_stands_behind_the_end_does_no_harm(path):
    path.write_bytes(path.read_bytes() + b"\0" * 9000)
    assert inspect_jpeg(path) == (53, 37)
    assert read_image(path).shape == (37, 53, 4)


def with_byte(at, value):
    return lambda content: content[:at] + bytes([value]) + content[at + 1 :]


def frame_at(content):
    return content.index(b"\xff\xc0")


def frame_of(content):
    return content[frame_at(content) : frame_at(content) + 19]


def widened(content):
    at = frame_at(content)
    return content[: at + 5] + b"\xff\xff\xff\xff" + content[at + 9 :]


BAD = {
    "empty": (lambda c: b"", "expected an image, but got an empty file"),
    "png": (lambda c: b"\x89PNG\r\n\x1a\n", "expected a JPEG image, but got a file of another kind"),
    "head only": (lambda c: c[:2], "expected a whole JPEG image, but got a truncated one"),
    "in the header": (lambda c: c[:100], "expected a whole JPEG image, but got a truncated one"),
    "in the pixels": (lambda c: c[: len(c) // 2], "expected a whole JPEG image, but got a truncated one"),
    "no end": (lambda c: c[:-2], "expected a whole JPEG image, but got a truncated one"),
    "harmed": (with_byte(2, 0), "expected an unharmed JPEG image, but got a broken header"),
    "12 bits": (lambda c: with_byte(frame_at(c) + 4, 12)(c), "channels of 8 bits, but got 3 of 12"),
    "lossless": (lambda c: with_byte(frame_at(c) + 1, 0xC3)(c), "expected a baseline or progressive JPEG"),
    "two frames": (lambda c: c.replace(frame_of(c), 2 * frame_of(c)), "with one header, but got two"),
    "no frame": (lambda c: c[:2] + c[c.index(b"\xff\xda") :], "but got one without a header"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_images_are_one_line(path, case):
    change, match = BAD[case]
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(SceneError, match=rf"a.jpg: .*{match}") as caught:
        inspect_jpeg(path)
    assert "\n" not in str(caught.value)


def test_an_absurd_size_is_refused_before_it_is_decoded(path):
    path.write_bytes(widened(path.read_bytes()))
    assert inspect_jpeg(path) == (65535, 65535)
    with pytest.raises(SceneError, match=r"expected an image of 1 to 80000000 pixels, but got 65535 x 65535"):
        read_image(path)


def test_a_missing_file(tmp_path):
    with pytest.raises(SceneError, match=r"b.jpg: expected an image, but got No such file"):
        inspect_jpeg(tmp_path / "b.jpg")
