from contextlib import contextmanager

import numpy as np
import pytest
from PIL import Image

from forewarp.capture.pictures import take
from tests.support.films import numbered, write_film


@contextmanager
def told(title):
    yield lambda done, total: None


def taken(place, source, masks=None, count=4, size=None):
    place.mkdir(exist_ok=True)
    video = source.suffix == ".mp4"
    return take(place, source, video=video, masks=masks, count=count, size=size, told=told)


def write_masks(folder, names, box=(0, 0, 8, 8), size=(64, 48)):
    """Masks whose ``box`` (left, top, right, bottom) is bright."""
    folder.mkdir()
    for name in names:
        mask = Image.new("L", size)
        mask.paste(255, box)
        mask.save(folder / name)
    return folder


def test_frames_bear_their_numbers_and_stamps(tmp_path):
    film = write_film(tmp_path / "a.mp4", numbered(12), stamps="N*(N+1)*10")
    found = taken(tmp_path / "work", film)
    assert found.found == 12
    assert 3 <= len(found.times) <= 4
    for name, stamp in found.times.items():
        n = int(name[6:12]) - 1
        assert stamp == pytest.approx(n * (n + 1) / 100)
        assert np.median(np.asarray(Image.open(found.folder / name))[-10:, -10:]) == pytest.approx(
            8 * n, abs=3
        )


def test_pictures_of_a_folder_come_in_the_order_of_their_names(tmp_path):
    (tmp_path / "p").mkdir()
    for n in (10, 2, 1):
        Image.new("RGB", (64, 48), (n, n, n)).save(tmp_path / "p" / f"img{n}.png")
    (tmp_path / "p" / "notes.txt").touch()
    found = taken(tmp_path / "work", tmp_path / "p", size=32)
    assert found.times == {"img1.png": 0, "img2.png": 1, "img10.png": 2}
    with Image.open(found.folder / "img10.png") as picture:
        assert picture.size == (32, 24)


def test_what_was_taken_is_not_taken_again(tmp_path):
    film = write_film(tmp_path / "a.mp4", numbered(12))
    first = taken(tmp_path / "work", film)
    film.unlink()
    assert taken(tmp_path / "work", film) == first


@pytest.mark.parametrize("by_name", [True, False])
def test_what_moves_is_black_for_the_matcher(tmp_path, by_name):
    film = write_film(tmp_path / "a.mp4", numbered(12))
    names = [f"frame_{n:06d}.png" for n in range(1, 13)] if by_name else [f"{n}.png" for n in range(12)]
    masks = write_masks(tmp_path / "masks", names, size=(128, 96), box=(0, 0, 16, 16))
    found = taken(tmp_path / "work", film, masks)
    for name in found.times:
        mask = np.asarray(Image.open(found.masks / f"{name}.png"))
        assert mask.shape == (48, 64)
        assert (mask[:8, :8] == 0).all()
        assert (mask == 255).sum() == 48 * 64 - 64


def test_masks_that_fit_no_picture_are_refused(tmp_path):
    film = write_film(tmp_path / "a.mp4", numbered(12))
    masks = write_masks(tmp_path / "masks", ["1.png", "2.png"])
    with pytest.raises(ValueError, match=r"expected 12 masks, .* \(frame_0.*\), but got 2"):
        taken(tmp_path / "work", film, masks)
