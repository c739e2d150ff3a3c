"""Images: headers, decoding, what is refused, composition, halving, cut-outs, what is kept in memory."""

import gc
import mmap
import struct

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image
from PIL.ImageCms import ImageCmsProfile, createProfile

from forewarp.data.files import SceneError
from forewarp.data.images import (
    _OWN_PAGES,
    CACHE,
    ImageCache,
    StoredImage,
    StoredMask,
    bright,
    composited,
    halved_cutout,
    inspect_image,
    read_gray16,
    read_image,
    reduced,
    refuse_other_sizes,
    write_image,
)
from tests.support.written_scenes import refused

NOISE = np.random.default_rng(0).integers(0, 256, (37, 53, 3), dtype=np.uint8)
STUDIO, SKIN = (20, 160, 40), (200, 120, 100)


def test_composition_by_hand():
    rgba = torch.tensor([[[255, 0, 51, 255], [255, 0, 51, 0], [255, 0, 51, 51]]], dtype=torch.uint8)
    expected = torch.tensor([[[1, 0, 0.2], [0.5, 0.5, 1], [0.6, 0.4, 0.84]]])
    torch.testing.assert_close(composited(rgba, torch.tensor([0.5, 0.5, 1])), expected)
    colors = torch.rand(3, 3)  # a colour per ray
    assert torch.equal(composited(torch.zeros(3, 4, dtype=torch.uint8), colors), colors)


def test_halving_is_the_rounded_mean_of_straight_values():
    rgba = torch.randint(0, 256, (6, 9, 4), dtype=torch.uint8)
    mean = rgba.double().reshape(2, 3, 3, 3, 4).mean((1, 3))
    assert torch.equal(reduced(rgba, 3), mean.round().to(torch.uint8))  # half to even, as torch rounds
    block = torch.tensor([[[10, 20, 30, 255], [0] * 4], [[20, 40, 61, 255], [0] * 4]], dtype=torch.uint8)
    assert halved_cutout(block).tolist() == [[[15, 30, 46, 128]]]
    assert halved_cutout(torch.zeros(3, 5, 4, dtype=torch.uint8)).tolist() == [[[0] * 4] * 2]


RGBA, GREY = np.dstack([NOISE, NOISE[..., 0]]), NOISE[..., 0].clip(1)
KINDS = [  # what is written, how, and the pixels read
    (NOISE, {}, np.insert(NOISE, 3, 255, -1)),
    (RGBA, {}, RGBA),
    (GREY, {}, np.dstack([GREY, GREY, GREY, np.full_like(GREY, 255)])),
    (GREY, {"transparency": 1}, np.dstack([GREY, GREY, GREY, 255 * (GREY > 1).astype(np.uint8)])),
]


@pytest.mark.parametrize(("pixels", "options", "expected"), KINDS)
def test_header_and_pixels_of_a_png(tmp_path, pixels, options, expected):
    iio.imwrite(tmp_path / "a.png", pixels, **options)
    header = inspect_image(tmp_path / "a.png")
    assert (header.size, header.has_alpha) == ((53, 37), bool((expected[..., 3] < 255).any()))
    assert np.array_equal(read_image(tmp_path / "a.png"), expected)
    steps = np.arange(48, dtype=np.uint16).reshape(6, 8) * 1000
    iio.imwrite(tmp_path / "d.png", steps)
    assert np.array_equal(read_gray16(tmp_path / "d.png"), steps)


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"comment": b"c" * 60000}])
def test_header_and_pixels_of_a_jpeg(tmp_path, options):
    for pixels in (NOISE, NOISE[..., 0]):
        iio.imwrite(tmp_path / "a.jpg", pixels, plugin="pillow", quality=97, subsampling=0, **options)
        with (tmp_path / "a.jpg").open("ab") as file:
            file.write(bytes(9000))  # what follows the end does no harm
        header, rgba = inspect_image(tmp_path / "a.jpg"), read_image(tmp_path / "a.jpg").numpy()
        assert (header.size, header.has_alpha) == ((53, 37), False)
        assert (rgba[..., 3] == 255).all()
        assert np.abs(rgba[..., 0].astype(int) - NOISE[..., 0]).mean() < 4


WHOLE = "expected a whole image, but got a truncated or harmed one"
HARM = {  # of a PNG and of a JPEG
    "empty": (lambda c: b"", "but got an empty file"),
    "text": (lambda c: b"version 1", "but got another kind of file or a harmed header"),
    "signature only": (lambda c: c[:2], "but got another kind of file or a harmed header"),
    "in the header": (lambda c: c[:100], "but got"),
    "in the pixels": (lambda c: c[: len(c) // 2], WHOLE),
    "no end": (lambda c: c[:-13], WHOLE),
}
SIZE = b"\xff\xc0\x00\x11"  # begins the header of a JPEG that holds its size; its bits follow
HARM_JPEG = {
    "12 bits": (lambda c: c.replace(SIZE + b"\x08", SIZE + b"\x0c"), "a harmed header"),
    "no frame": (lambda c: c[:2] + c[c.index(b"\xff\xda") :], "a harmed header"),
}
CASES = [(n, h) for n in ("a.png", "a.jpg") for h in HARM] + [("a.jpg", h) for h in HARM_JPEG]


@pytest.mark.parametrize(("name", "harm"), CASES)
def test_bad_images_are_refused_in_one_line(tmp_path, name, harm):
    change, match = {**HARM, **HARM_JPEG}[harm]
    write_image(tmp_path / name, NOISE)
    (tmp_path / name).write_bytes(change((tmp_path / name).read_bytes()))
    for read in (inspect_image, read_image):
        with refused(rf"{name}: .*{match}") as caught:
            read(tmp_path / name)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["WebP", "TIFF", "GIF", "BMP"])
def test_images_of_other_programs_are_named(tmp_path, kind):
    Image.fromarray(NOISE).save(tmp_path / "a.png", format=kind)
    said = f"a.png: expected a PNG or JPEG image, but got {kind}; convert it to PNG or JPEG"
    with refused(said):
        inspect_image(tmp_path / "a.png")


def test_other_kinds_of_pixel_are_refused(tmp_path):
    iio.imwrite(tmp_path / "a.png", NOISE[..., 0].astype(np.uint16))
    iio.imwrite(tmp_path / "b.jpg", RGBA, plugin="pillow", mode="CMYK")
    for name, got in (("a.png", "16 bits"), ("b.jpg", "CMYK")):
        with refused(f"8 bits a channel, grey or RGB, but got {got}; convert"):
            inspect_image(tmp_path / name)


@pytest.fixture
def cut_out(tmp_path):
    """A rectangle of rows 8 to 20 and columns 5 to 30 in front of a studio, 40 x 31, and its mask."""
    image = np.broadcast_to(np.array(STUDIO, np.uint8), (31, 40, 3)).copy()
    mask = np.zeros((31, 40), np.uint8)
    image[8:21, 5:31], mask[8:21, 5:31] = SKIN, 255
    paths = tmp_path / "image.jpg", tmp_path / "mask.jpg"
    Image.fromarray(image).save(paths[0], quality=100, subsampling=0)
    write_image(paths[1], mask)
    return lambda **options: StoredImage(paths[0], (40, 31), mask=paths[1], **options)


def test_the_foreground_is_cut_out_and_only_it_is_kept(cut_out):
    load, before = cut_out(), CACHE.bytes
    rgba = load()
    assert CACHE.bytes - before == 13 * 26 * 4
    expected = torch.zeros(31, 40, dtype=torch.uint8)
    expected[8:21, 5:31] = 255
    assert torch.equal(rgba[..., 3], expected)
    assert (rgba[expected == 0] == 0).all()
    assert (rgba[10:19, 7:29, :3].int() - torch.tensor(SKIN)).abs().max() <= 4
    load.path.unlink()
    assert torch.equal(load(), rgba)


def test_halves_cut_off_an_odd_row_and_mix_in_no_studio(cut_out):
    rgba = cut_out(factor=2)()
    assert rgba.shape == (15, 20, 4)
    assert rgba[4:10, 3:15, 3].eq(255).all()
    assert rgba[4:10, 2, 3].eq(128).all()  # columns 4 and 5, of which one is foreground
    assert (rgba[5:9, 2, :3].int() - torch.tensor(SKIN)).abs().max() <= 12
    write_image(cut_out().mask, np.full((31, 40), 100, np.uint8))
    assert not cut_out()().any()


@pytest.mark.parametrize("kind", ["palette", "RGB", "numbers", "grey"])
def test_every_object_of_a_mask_is_foreground(tmp_path, kind):
    """Three objects, as DAVIS colours them, the last of 64 of 255; their numbers; or soft grey."""
    numbers = np.arange(5, dtype=np.uint8)[None].repeat(6, 0).repeat(2, 1)
    colors = np.array([[0] * 3, [128, 0, 0], [0, 128, 0], [0, 0, 128], [64, 0, 0]], np.uint8)
    mask = Image.fromarray(colors[numbers] if kind == "RGB" else numbers)
    if kind == "palette":
        mask.putpalette(colors.tobytes() + bytes(768 - 15))
    if kind == "grey":
        mask = mask.point([60, 128, 200, 255, 130] + 251 * [0])
    mask.save(tmp_path / "mask.png")
    assert StoredMask(tmp_path / "mask.png", (10, 6))().tolist() == (numbers > 0).tolist()


@pytest.mark.parametrize("levels", [(90, 200), (2, 200), (38, 75), (38, 38), (24, 11), (127, 255)])
def test_every_label_of_a_grey_mask_is_foreground(tmp_path, levels):
    pixels = np.zeros((20, 30), np.uint8)
    pixels[3:9, 4:10], pixels[11:18, 15:29] = levels
    write_image(tmp_path / "mask.png", pixels)
    assert torch.equal(bright(tmp_path / "mask.png"), torch.from_numpy(pixels > 0))


@pytest.mark.parametrize("beneath", ["image", "erased"])
def test_the_alpha_of_an_image_that_was_cut_out_is_the_mask(tmp_path, beneath):
    rgba = np.random.default_rng(0).integers(0, 256, (40, 60, 4), np.uint8)
    mask = np.zeros((40, 60), bool)
    mask[8:30, 10:40] = True
    if beneath == "image":
        for some in (mask[:0], mask[:10, :13]):  # frames of little of the subject, or none
            rgba[..., 3] = 0
            rgba[: some.shape[0], : some.shape[1], 3] = 255 * some
            write_image(tmp_path / "mask.png", rgba)
            assert int(bright(tmp_path / "mask.png").sum()) == some.sum()
    rgba[..., 3] = 255 * mask
    rgba *= np.uint8(mask[..., None] | (beneath == "image"))
    write_image(tmp_path / "mask.png", rgba)
    assert torch.equal(bright(tmp_path / "mask.png"), torch.from_numpy(mask))
    rgba[..., :3] = 255 * (rgba[..., :1] > 60)  # a mask in the colours, of other shape
    write_image(tmp_path / "mask.png", rgba)
    assert torch.equal(bright(tmp_path / "mask.png"), torch.from_numpy(rgba[..., 0] > 0))


@pytest.mark.parametrize("kind", ["half", "bilinear", "JPEG"])
def test_soft_edges_are_no_labels(tmp_path, kind):
    row, column = np.mgrid[:64, :96]
    disc = Image.fromarray(np.uint8(255 * ((row - 31) ** 2 + (column - 44) ** 2 < 600)))
    if kind != "JPEG":
        disc = disc.resize((48, 32), Image.BOX if kind == "half" else Image.BILINEAR)
    path = tmp_path / ("mask.jpg" if kind == "JPEG" else "mask.png")
    disc.save(path)
    assert torch.equal(bright(path), torch.from_numpy(np.array(Image.open(path)) > 127))


class Owner:
    """Somebody that images are made for."""


def maker(log, name, size=4):
    def make():
        log.append(name)
        return torch.full((size,), len(log), dtype=torch.uint8)

    return make


def test_the_limit_holds_and_the_longest_unused_goes_first():
    cache, log, owners = ImageCache(10), [], {name: Owner() for name in "abc"}
    for name in "abacab":
        made = cache.get(owners[name], maker(log, name))
        assert cache.get(owners[name], maker(log, name)) is made
        assert cache.bytes <= 10
    assert log == ["a", "b", "c", "b"]  # c took the place of b, which was not asked for since
    large = Owner()
    for _ in range(2):  # what is too large is made every time
        assert len(cache.get(large, maker(log, "large", 11))) == 11
    assert (log[4:], cache.bytes) == (["large", "large"], 8)
    cache.resize(5)
    assert cache.bytes == 4
    owners.clear()
    gc.collect()
    assert cache.bytes == 0  # an owner's end frees its image


def test_kept_images_have_pages_of_their_own_which_are_freed_with_them():
    cache, owners = ImageCache(4 * _OWN_PAGES), [object.__new__(StoredImage) for _ in range(8)]
    image = torch.arange(_OWN_PAGES, dtype=torch.int32).to(torch.uint8).reshape(-1, 256, 4)
    for owner in owners:
        cache.get(owner, lambda: image.clone())
    assert cache.bytes == 4 * _OWN_PAGES
    kept = cache.get(owners[-1], lambda: None)
    assert kept.data_ptr() % mmap.PAGESIZE == 0
    torch.testing.assert_close(kept, image, rtol=0, atol=0)


def test_a_jpeg_with_a_second_image_inside_is_turned_as_others(tmp_path):
    image, exif = Image.fromarray(NOISE), Image.Exif()
    exif[0x0112] = 6
    image.save(tmp_path / "a.jpg", "MPO", save_all=True, append_images=[image.resize((8, 6))], exif=exif)
    header = inspect_image(tmp_path / "a.jpg")
    assert (header.size, header.is_turned) == ((53, 37), True)
    assert read_image(tmp_path / "a.jpg", upright=True).shape == (53, 37, 4)


def p3_profile():
    """Make the ICC profile Display P3, as phones write it."""
    fixed = lambda *values: b"".join(struct.pack(">i", round(v * 65536)) for v in values)  # noqa: E731
    name = b"Display P3\0"
    red, green, blue = (0.5151, 0.2412, -0.00105), (0.29197, 0.69224, 0.04188), (0.15716, 0.06658, 0.78438)
    curve = b"para\0\0\0\0\0\3\0\0" + fixed(2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
    tags = {
        b"desc": b"desc\0\0\0\0" + struct.pack(">I", len(name)) + name + bytes(78),
        b"cprt": b"text\0\0\0\0public domain\0",
        b"wtpt": b"XYZ \0\0\0\0" + fixed(0.9642, 1, 0.8249),
        **{b"rgb"[i : i + 1] + b"XYZ": b"XYZ \0\0\0\0" + fixed(*v) for i, v in enumerate((red, green, blue))},
        **{b"rgb"[i : i + 1] + b"TRC": curve for i in range(3)},
    }
    table, body = struct.pack(">I", len(tags)), b""
    for tag, value in tags.items():
        table += tag + struct.pack(">II", 132 + 12 * len(tags) + len(body), len(value))
        body += value + bytes(-len(value) % 4)
    head = struct.pack(">III", 128 + len(table + body), 0, 0x04000000) + b"mntrRGB XYZ "
    head += struct.pack(">6H", 2022, 1, 1, 0, 0, 0) + b"acsp" + bytes(28) + fixed(0.9642, 1, 0.8249)
    return head.ljust(128, b"\0") + table + body


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_colours_of_another_profile_become_srgb(tmp_path, suffix):
    # Saturated sRGB red, a skin's colour and grey, as Display P3 has them (CSS Color 4).
    seen = np.array([[255, 0, 0], [200, 120, 100], [90, 90, 90]])
    stored = np.array([[234, 51, 35], [190, 124, 105], [90, 90, 90]], np.uint8)
    pixels = np.repeat(stored, 16, 0)[None].repeat(16, 0)
    srgb = ImageCmsProfile(createProfile("sRGB")).tobytes()
    options = {"subsampling": 0} if suffix == ".jpg" else {}
    for profile, expected in ((p3_profile(), seen), (srgb, stored), (b"x" * 200, stored)):
        Image.fromarray(pixels).save(path := tmp_path / f"a{suffix}", icc_profile=profile, **options)
        found = read_image(path)[8, 8::16]
        assert np.abs(found[:, :3].numpy().astype(int) - expected).max() <= 4
    assert found[:, 3].eq(255).all()


def films(folder, suffix, images):
    folder.mkdir()
    paths = [folder / f"{i}{suffix}" for i in range(len(images))]
    for path, pixels in zip(paths, images):
        write_image(path, pixels)
    return paths


def test_smaller_images_of_an_earlier_extraction_are_refused(tmp_path):
    random = np.random.default_rng(0)
    wide = Image.fromarray(random.integers(0, 255, (18, 30, 3), dtype=np.uint8)).resize((300, 180))
    wide = np.asarray(wide).astype(float) + random.normal(0, 12, (180, 300, 1))  # a texture below any filter
    wide = wide.clip(0, 255).astype(np.uint8)
    moments = [wide[20:116, 4 * i : 4 * i + 128] for i in range(12)]  # of a camera that turns
    full = films(tmp_path / "images", ".png", moments[:8])
    resized = lambda x, filter: np.asarray(Image.fromarray(x).resize((64, 48), filter))  # noqa: E731
    graded = lambda x: (255 * (x / 255.0) ** 0.8 * [1, 0.9, 0.95]).astype(np.uint8)  # noqa: E731
    for filter in (Image.BOX, Image.NEAREST, Image.LANCZOS, Image.BILINEAR):
        for how in (lambda x: x, graded):
            small = [how(resized(x, filter)) for x in moments]
            folder = tmp_path / f"{filter}_{how is graded}"
            refuse_other_sizes(full, films(folder, ".jpg", small[:8]))
    refuse_other_sizes(full, films(tmp_path / "strided", ".png", [x[::2, ::2] for x in moments[:8]]))
    for later, said in ((1, ", nearer to 1.png .*; make images_1 again"), (4, "")):
        small = [resized(x, Image.BOX) for x in moments[later:]]
        earlier = films(tmp_path / f"images_{later}", ".png", small)
        with pytest.raises(SceneError, match="expected images/0.png at a .*, but got another image" + said):
            refuse_other_sizes(full, earlier)
    subject = np.zeros((96, 160), np.uint8)
    subject[20:70, 10:50] = 255
    masks = films(tmp_path / "masks", ".png", [np.roll(subject, 6 * i, 1) for i in range(8)])
    small = [np.roll(subject, 6 * i, 1)[::2, ::2] for i in range(12)]
    refuse_other_sizes(masks, films(tmp_path / "strided_masks", ".png", small[:8]), are_masks=True)
    with pytest.raises(SceneError, match="expected masks/0.png at a smaller size"):
        refuse_other_sizes(masks, films(tmp_path / "masks_2", ".png", small[4:]), are_masks=True)
