from contextlib import contextmanager

import numpy as np
import pytest
from PIL import Image

from forewarp.capture.pictures import take
from tests.support.films import numbered, write_film


@contextmanager
def told(title):
    yield lambda done, total: None


def taken(place, source, masks=None, count=4, size=None, **options):
    place.mkdir(exist_ok=True)
    video = source.suffix == ".mp4"
    return take(place, source, video=video, masks=masks, count=count, size=size, told=told, **options)


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


def test_by_default_at_most_every_second_frame_is_taken(tmp_path):
    film = write_film(tmp_path / "a.mp4", numbered(12))
    found = taken(tmp_path / "work", film, count=None)
    assert len(found.times) == 6
    assert all((int(name[6:12]) - 1) // 2 == window for window, name in enumerate(sorted(found.times)))


def test_pictures_of_a_folder_come_in_the_order_of_their_names(tmp_path):
    (tmp_path / "p").mkdir()
    for name in ("img 10.png", "img 2.png", "img 1.png", "img 2.jpg"):
        Image.new("RGB", (64, 48), (int(name[4:-4]),) * 3).save(tmp_path / "p" / name)
    (tmp_path / "p" / "notes.txt").touch()
    (tmp_path / "p" / "._img 1.png").touch()  # as macOS leaves them
    found = taken(tmp_path / "work", tmp_path / "p", size=32)
    ours = ["picture_000001.png", "picture_000002.jpg", "picture_000003.png", "picture_000004.png"]
    assert found.times == {name: number for number, name in enumerate(ours)}
    assert found.originals == dict(zip(ours, ["img 1.png", "img 2.jpg", "img 2.png", "img 10.png"]))
    assert found.size == (32, 24)
    with Image.open(found.folder / ours[3]) as picture:
        assert picture.size == (32, 24)
        assert picture.getpixel((0, 0)) == (10, 10, 10)


def folder_of(folder, count=3, mode="RGB", size=(64, 48), **options):
    """Pictures that are bright in the upper left quarter; of RGBA all else is transparent."""
    folder.mkdir()
    for n in range(count):
        picture = Image.new(mode, size)
        picture.paste((250,) * len(mode), (0, 0, size[0] // 2, size[1] // 2))
        picture.save(folder / f"{n}.{'png' if mode == 'RGBA' else 'jpg'}", **options)
    return folder


@pytest.mark.parametrize("upright", [True, False])
def test_pictures_are_turned_as_their_exif_says_but_for_known_poses(tmp_path, upright):
    exif = Image.Exif()
    exif[0x0112] = 6  # stored a quarter turn to the left
    found = taken(tmp_path / "work", folder_of(tmp_path / "p", exif=exif), upright=upright)
    assert found.size == ((48, 64) if upright else (64, 48))
    with Image.open(found.folder / "picture_000001.jpg") as picture:
        width, height = picture.size
        at = (width - 5, 5) if upright else (5, 5)
        assert [picture.getpixel(p)[0] > 200 for p in ((5, 5), (width - 5, 5))] == [
            at == (5, 5),
            at != (5, 5),
        ]


def test_cut_outs_stay_cut_out(tmp_path):
    found = taken(tmp_path / "work", folder_of(tmp_path / "p", mode="RGBA"), size=32)
    with Image.open(found.folder / "picture_000001.png") as picture:
        assert picture.getpixel((5, 5)) == (250,) * 4
        assert picture.getpixel((25, 20))[3] == 0


@pytest.mark.parametrize(
    ("count", "odd", "says"),
    [
        (2, None, "p: expected a folder of many pictures, PNG or JPEG, but got 2 PNG or JPEG files"),
        (3, Image.new("RGBA", (64, 48)), "odd.png: expected alpha in all pictures or in none"),
        (3, "turned", "odd.png: expected 64 x 48 pixels as the first, but got 48 x 64, as its EXIF"),
    ],
)
def test_folders_that_are_no_capture_are_refused(tmp_path, count, odd, says):
    folder_of(tmp_path / "p", count)
    if odd == "turned":
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.new("RGB", (64, 48)).save(tmp_path / "p" / "odd.png", exif=exif)
    elif odd:
        odd.save(tmp_path / "p" / "odd.png")
    with pytest.raises(ValueError, match=says):
        taken(tmp_path / "work", tmp_path / "p")


def test_what_was_taken_is_not_taken_again(tmp_path):
    film = write_film(tmp_path / "a.mp4", numbered(12))
    first = taken(tmp_path / "work", film)
    film.unlink()
    assert taken(tmp_path / "work", film) == first


@pytest.mark.parametrize("by_name", [True, False])
def test_what_moves_is_black_for_the_matcher(tmp_path, by_name):
    film = write_film(tmp_path / "a.mp4", numbered(12))
    # More masks than frames can only be meant by name.
    names = [f"frame_{n:06d}.png" for n in range(1, 14)] if by_name else [f"{n}.png" for n in range(12)]
    masks = write_masks(tmp_path / "masks", names, size=(128, 96), box=(0, 0, 16, 16))
    found = taken(tmp_path / "work", film, masks)
    for name in found.times:
        mask = np.asarray(Image.open(found.masks / f"{name}.png"))
        assert mask.shape == (48, 64)
        assert (mask[:8, :8] == 0).all()
        assert (mask == 255).sum() == 48 * 64 - 64


def test_masks_of_all_frames_count_in_order_also_when_numbered_from_0(tmp_path):
    film = write_film(tmp_path / "a.mp4", numbered(12))
    masks = tmp_path / "masks"
    masks.mkdir()
    for n in range(12):  # of frame n the columns up to 5 n are still
        Image.fromarray(np.uint8(255 * (np.arange(64) >= 5 * n))[None].repeat(48, 0)).save(
            masks / f"frame_{n:06d}.png"
        )
    found = taken(tmp_path / "work", film, masks)
    for name in found.times:
        still = np.asarray(Image.open(found.masks / f"{name}.png"))[0] > 0
        assert still.sum() == 5 * (int(name[6:12]) - 1)


def test_masks_of_a_folder_go_by_the_users_names(tmp_path):
    source = folder_of(tmp_path / "p", 3)
    masks = write_masks(tmp_path / "masks", ["0.png", "1.png", "2.png", "other.png"])
    found = taken(tmp_path / "work", source, masks)
    assert {path.name for path in found.masks.iterdir()} == {f"{name}.png" for name in found.times}


def test_masks_of_zeros_and_ones_are_refused(tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    for n in range(3):
        Image.new("L", (64, 48), 1).save(masks / f"{n}.png")
    with pytest.raises(ValueError, match="brighter than 127 of 255, but got at most 1; write it as 255"):
        taken(tmp_path / "work", folder_of(tmp_path / "p"), masks)


def test_masks_that_fit_no_picture_are_refused(tmp_path):
    film = write_film(tmp_path / "a.mp4", numbered(12))
    masks = write_masks(tmp_path / "masks", ["1.png", "2.png"])
    with pytest.raises(ValueError, match=r"expected 12 masks, .* \(frame_0.*\), but got 2"):
        taken(tmp_path / "work", film, masks)
