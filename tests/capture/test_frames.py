"""The images of a capture: from a video, from a folder, and their masks."""

import shutil
import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

pytest.importorskip("pycolmap", reason="no pycolmap; make install adds it")

from forewarp.capture.frames import (
    Source,
    bars_of,
    edge_width,
    extracted,
    measure,
    sharpest,
    sharpness,
    take,
    write_smaller,
)
from forewarp.capture.poses import BLURRED
from tests.support.captures import quiet, step
from tests.support.films import numbered, write_film, write_planes
from tests.support.written_scenes import refused, say_linear


def stamps_of(film):
    return measure(film, quiet)[0]


def number_of(image):
    """The number of a frame of ``numbered``: its darkest quarter tells."""
    return round(float(np.median(image[image < 200])) / 8)


@pytest.mark.slow
@pytest.mark.parametrize("stamps", ["N*40", "N*(N+1)*10", "500+N*100"], ids=["even", "uneven", "late"])
def test_stamps_are_the_videos_own_and_the_frames_asked_for_come(tmp_path, stamps):
    film = write_film(tmp_path / "a.mp4", numbered(24), stamps=stamps)
    expected = np.array([eval(stamps, {"N": n}) for n in range(24)]) / 1000
    np.testing.assert_allclose(stamps_of(film), expected - expected[0], atol=1e-6)
    chosen = [0, 3, 4, 11, 23]
    assert [number_of(image) for image in extracted(film, chosen, None)] == chosen


def test_hundreds_of_frames_can_be_chosen(tmp_path):
    film = write_film(tmp_path / "a.mp4", numbered(400, size=(16, 16), step=0))
    assert len(list(extracted(film, list(range(0, 400, 2)), None))) == 200


@pytest.mark.parametrize(
    ("rotation", "size", "bright"),
    [(0, (48, 64), "tl"), (90, (64, 48), "bl"), (-90, (64, 48), "tr"), (180, (48, 64), "br")],
)
def test_frames_are_turned_upright(tmp_path, rotation, size, bright):
    film = write_film(tmp_path / "a.mp4", numbered(3), rotation=rotation)
    (image,) = extracted(film, [1], None)
    assert image.shape == (*size, 3)
    rows = slice(2, 10) if bright[0] == "t" else slice(-10, -2)
    columns = slice(2, 10) if bright[1] == "l" else slice(-10, -2)
    assert image[rows, columns].min() > 230
    assert len(stamps_of(film)) == 3


def test_frames_of_an_interlaced_film_are_whole(tmp_path):
    """A bar that goes 8 pixels to the right between the two fields of a frame."""
    frames = np.zeros((8, 96, 128, 3), np.uint8)
    for n, frame in enumerate(frames):
        for field in (0, 1):
            left = 8 * (2 * n + field)
            frame[field::2, left : left + 24] = 250
    options = ["-flags", "+ilme+ildct", "-x264-params", "tff=1", "-field_order", "tt"]
    film = write_film(tmp_path / "a.mp4", frames, options=options)
    assert len(stamps_of(film)) == 8
    (image,) = extracted(film, [3], None)
    rows = image[..., 0].astype(int)
    assert np.abs(np.diff(rows[8:-8], axis=0)).max() < 60
    assert rows[40, 58:70].min() > 200


def test_frames_are_made_smaller_never_larger_by_as_many_threads_as_given(tmp_path, monkeypatch):
    film = write_film(tmp_path / "a.mp4", numbered(3))
    calls, popen = [], subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda call, **rest: calls.append(call) or popen(call, **rest))
    for size, shape in ((None, (48, 64, 3)), (32, (24, 32, 3)), (500, (48, 64, 3))):
        assert [image.shape for image in extracted(film, [0, 1], size, threads=1)] == [shape] * 2
    measure(film, quiet, threads=1)
    words = [" ".join(call) for call in calls if "-vf" in call]  # others only read the header
    assert len(words) == 4
    assert all("-threads 1 " in line and "-filter_threads 1 " in line for line in words)


@pytest.mark.slow
@pytest.mark.parametrize(("blur", "seen"), [(0, False), (1, False), (4, True), (8, True)])
def test_a_films_blur_is_seen_whatever_the_codec_adds(tmp_path, blur, seen):
    """Coded as strongly as phones and web sites do."""
    rng = np.random.default_rng(0)
    sharp = rng.integers(0, 256, (24, 32, 3)).repeat(20, 0).repeat(20, 1).astype(float)
    film = np.stack([gaussian_filter(np.roll(sharp, 3 * i, 1), (blur, blur, 0)) for i in range(3)])
    path = write_film(tmp_path / "a.mp4", film.astype(np.uint8), options=("-qp", "28"))
    assert (np.median(measure(path, quiet)[2]) > BLURRED) == seen


def cut(path, share):
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    return path


def noise(path, count=50, **options):
    frames = np.random.default_rng(0).integers(0, 256, (count, 48, 64, 3), np.uint8)
    return write_film(path, frames, **options)


FAST = ("-movflags", "faststart")


def tone(path, seconds, *options):
    """A sound, with ``options`` a film's."""
    made = path.with_name(f"with_sound_{path.name}")
    sound = ["-f", "lavfi", "-i", f"sine=duration={seconds}", "-c:a", "aac"]
    call = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *options[:2], *sound, *options[2:], str(made)]
    subprocess.run(call, check=True)
    return made


def with_sound(path, seconds):
    shape = ["-map", "0:v", "-map", "1:a", "-c:v", "copy", *FAST]
    return tone(path, seconds, "-i", str(path), *shape)


def npz_beside(path):
    archive = path.with_name("hand_droid.npz")
    archive.touch()
    return archive


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda p: p.write_text("no video") and p, "a video, but got another file"),
        (lambda p: p.touch() or p, "a video, but got another file"),
        (npz_beside, "a video, but got another file; it is of MegaSaM: write its cameras and images as"),
        (lambda p: tone(p, 1), "a video, but got sound alone"),
        (lambda p: write_film(p, numbered(2)), "a video of many frames, but got 2 frames; film longer"),
        (lambda p: write_film(p, numbered(1)), "a video of many frames, but got one frame"),
        (lambda p: cut(noise(p, 9), 0.5), "a video, but got one that was cut off"),
        (lambda p: cut(noise(p, options=FAST), 0.5), "2.0 seconds, as its header says, but"),
        # Two frames are left.
        (lambda p: cut(noise(p, options=FAST), 0.055), "2.0 seconds, as .* but got 0.1; copy it again"),
        (lambda p: cut(with_sound(noise(p), 3), 0.5), "3.0 seconds, as its header"),
    ],
)
def test_what_is_no_whole_video_is_refused(tmp_path, make, says):
    with pytest.raises(ValueError, match=f"expected {says}"):
        measure(make(tmp_path / "a.mp4"), quiet)


@pytest.mark.slow
def test_sound_may_go_on_after_the_last_frame(tmp_path):
    assert len(stamps_of(with_sound(noise(tmp_path / "a.mp4"), 3))) == 50


def test_the_sharpest_of_each_window_in_time_is_chosen():
    rng = np.random.default_rng(1)
    stamps, sharp = np.cumsum(rng.uniform(0.01, 0.2, 100)), rng.uniform(0, 1, 100)
    edges = np.linspace(stamps[0], stamps[-1], 8)
    for index, low, high in zip(sharpest(stamps, sharp, 7), edges[:-1], edges[1:], strict=True):
        assert sharp[index] == sharp[(stamps >= low) & (stamps <= high)].max()
    stamps = np.concatenate([np.linspace(0, 1, 50), [6.0, 10.0]])
    assert sharpest(stamps, np.arange(52.0), 3) == [49, 50, 51]
    assert sharpest(stamps, -np.arange(52.0), 2) == [0, 50]


@pytest.mark.parametrize("count", [1, 7, 40, 59, 60, 99])
def test_gaps_cost_no_frames(count):
    stamps = np.concatenate([np.linspace(0, 1, 30), np.linspace(50, 51, 30)])
    chosen = sharpest(stamps, np.arange(60.0), count)
    assert chosen == sorted(set(chosen))
    assert min(count, 60) - 1 <= len(chosen) <= count


def test_blur_lowers_sharpness_and_widens_edges():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (10, 16)).repeat(40, 0).repeat(40, 1).astype(np.uint8)
    series = [image, *(gaussian_filter(image.astype(float), s) for s in (1, 3, 6, 12))]
    values, widths = [sharpness(blurred) for blurred in series], [edge_width(blurred) for blurred in series]
    assert values == sorted(values, reverse=True)
    assert widths == sorted(widths)
    assert edge_width(0.1 * image) == pytest.approx(widths[0], rel=1e-4)  # whatever the contrast
    assert edge_width(image.repeat(2, 0).repeat(2, 1)) == pytest.approx(widths[0], rel=1e-4)  # or size
    assert edge_width(np.full((9, 9), 7)) == float("inf")


def taken(tmp_path, source, masks=None, count=4, size=None, colmap=None):
    work = tmp_path / "work"
    work.mkdir(exist_ok=True)
    kind = "video" if source.suffix == ".mp4" else "images"
    return take(work, Source(**{kind: source}, masks=masks, colmap=colmap, size=size), step, count, None)


def test_frames_bear_their_numbers_and_stamps_and_are_taken_once(tmp_path):
    film = write_film(tmp_path / "a.mp4", numbered(12), stamps="N*(N+1)*10")
    frames = taken(tmp_path, film)
    assert frames.found == 12
    assert 3 <= len(frames.times) <= 4
    for name, stamp in frames.times.items():
        n = int(name[6:12]) - 1
        assert stamp == pytest.approx(n * (n + 1) / 100)
        assert number_of(np.asarray(Image.open(frames.folder / name))) == n
    film.unlink()
    assert taken(tmp_path, film) == frames


@pytest.mark.parametrize("rotation", [0, 90])
def test_black_bars_are_cut_off_and_told(tmp_path, rotation):
    """A checkerboard that shifts, with bars of 12 rows above and below."""
    row, column = np.mgrid[:72, :128] // 8
    frames = np.stack([np.where((row + column + n // 4) % 2, 220, 30) for n in range(16)])
    frames = np.repeat(frames.astype(np.uint8)[..., None], 3, -1)
    padded = np.pad(frames, ((0, 0), (12, 12), (0, 0), (0, 0)))
    images = taken(tmp_path, write_film(tmp_path / "a.mp4", padded, rotation=rotation))
    where = "at the left and right" if rotation else "above and below"
    assert images.assumed == f"black bars, 14% {where} each, are cut off"
    sizes = {tuple(sorted(size)) for size in images.sizes.values()}
    assert sizes <= {(68, 128), (70, 128)}
    pictures = tmp_path / "p"
    pictures.mkdir()
    for i in (0, 4, 8):
        Image.fromarray(np.pad(frames[i] + np.uint8(i), ((0, 0), (20, 20), (0, 0)))).save(
            pictures / f"{i}.png"
        )
    told = take(tmp_path, Source(images=pictures), step, None, None)
    bars, times = told.assumed.split("; ", 1)
    assert bars == "black bars, 12% at the left and right each, stay: crop the pictures"
    assert times.startswith(f"{pictures}: times: taken from the numbers")
    pixels = np.asarray(Image.open(images.folder / next(iter(images.times))))[..., 0]
    assert pixels.max(1).min() > 150
    assert pixels.max(0).min() > 150


def test_linear_and_equal_images_of_a_folder_are_told(tmp_path):
    pictures = tmp_path / "p"
    pictures.mkdir()
    for i, frame in enumerate(numbered(4)):
        Image.fromarray(frame).save(pictures / f"{i}.png")
    shutil.copy(pictures / "0.png", pictures / "1.png")
    say_linear(pictures / "3.png")
    told = take(tmp_path, Source(images=pictures), step, None, None).assumed
    assert "1 of 4 images say that they are linear (gAMA 1; 3.png, ..)" in told
    assert (
        f"{pictures}: 1 of 4 images are the same file as others (0.png and 1.png, ..); leave copies" in told
    )


@pytest.mark.parametrize("frame", ["dark above", "uneven", "soft"])
def test_what_is_no_pair_of_bars_stays(frame):
    brightest = np.full((96, 128), 200)
    brightest[:12] = 0
    if frame != "dark above":
        brightest[-12 if frame == "soft" else -20 :] = 0
    if frame == "soft":
        brightest = gaussian_filter(brightest.astype(float), 8)
    assert bars_of(brightest) == (0, 0)


def test_by_default_every_frame_of_a_short_film_is_taken(tmp_path):
    frames = taken(tmp_path, write_film(tmp_path / "a.mp4", numbered(12)), count=None)
    assert len(frames.times) == 12
    assert frames.why == "every frame of a short film"


def test_images_of_a_folder_come_in_the_order_of_their_names(tmp_path):
    (tmp_path / "p").mkdir()
    for name in ("img 10.png", "img 2.png", "img 1.png", "img 3.jpg"):
        Image.new("RGB", (64, 48), (int(name[4:-4]),) * 3).save(tmp_path / "p" / name)
    (tmp_path / "p" / "notes.txt").touch()
    (tmp_path / "p" / "._img 1.png").touch()  # as macOS leaves them
    frames = taken(tmp_path, tmp_path / "p", size=32)
    ours = ["picture_000001.png", "picture_000002.png", "picture_000003.jpg", "picture_000004.png"]
    assert frames.times == pytest.approx(dict(zip(ours, [0, 1 / 9, 2 / 9, 1])))
    assert frames.originals == dict(zip(ours, ["img 1.png", "img 2.png", "img 3.jpg", "img 10.png"]))
    assert set(frames.sizes.values()) == {(32, 24)}
    with Image.open(frames.folder / ours[3]) as image:
        assert image.size == (32, 24)
        assert image.getpixel((0, 0)) == (10, 10, 10)


def quarter(folder, count=3, mode="RGB", size=(64, 48), **options):
    """Images that are bright in the upper left quarter; of RGBA all else is transparent."""
    folder.mkdir()
    for n in range(count):
        image = Image.new(mode, size)
        image.paste((250,) * len(mode), (0, 0, size[0] // 2, size[1] // 2))
        image.save(folder / f"{n}.{'png' if mode == 'RGBA' else 'jpg'}", **options)
    return folder


def turned():
    """What says that an image is stored a quarter turn to the left."""
    exif = Image.Exif()
    exif[0x0112] = 6
    return exif


@pytest.mark.parametrize("known", [False, True])
def test_images_are_turned_and_made_smaller_but_for_known_poses(tmp_path, known):
    source = quarter(tmp_path / "p", exif=turned())
    frames = taken(tmp_path, source, size=32, colmap=tmp_path if known else None)
    with Image.open(frames.folder / "picture_000001.jpg") as image:
        width, height = size = frames.sizes["picture_000001.jpg"]
        assert image.size == size == ((64, 48) if known else (24, 32))
        bright = [image.getpixel(place)[0] > 200 for place in ((3, 3), (width - 3, 3))]
        assert bright == [known, not known]


@pytest.mark.parametrize("layout", ["cam0{}/{:04d}.png", "cam0{}_{:04d}.png"])
def test_with_known_poses_folders_or_names_tell_cameras_apart_and_sizes_differ(tmp_path, layout):
    for camera, size in enumerate([(64, 48), (48, 64)]):
        for number in (3, 5, 6):
            path = tmp_path / "p" / layout.format(camera, number)
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.new("RGB", size).save(path)
    masks = tmp_path / "masks"
    masks.mkdir()
    for n in range(6):  # in the order of the names: the first three are of the first camera
        Image.new("L", (64, 64), 255 * (n < 3)).save(masks / f"{n}.png")
    frames = taken(tmp_path, tmp_path / "p", masks, colmap=tmp_path)
    names = [layout.format(camera, number) for number in (3, 5, 6) for camera in (0, 1)]
    assert list(frames.originals.values()) == names
    assert frames.assumed.endswith("images' names, 3 to 6; images of one number share a time")
    moves = [Image.open(frames.masks / f"{name}.png").getpixel((0, 0)) == 0 for name in frames.times]
    assert moves == 3 * [True, False]
    assert list(frames.times.values()) == pytest.approx([0, 0, 2 / 3, 2 / 3, 1, 1])
    assert list(frames.sizes.values()) == 3 * [(64, 48), (48, 64)]


def test_cut_outs_stay_cut_out(tmp_path):
    frames = taken(tmp_path, quarter(tmp_path / "p", mode="RGBA"), size=32)
    with Image.open(frames.folder / "picture_000001.png") as image:
        assert image.getpixel((5, 5)) == (250,) * 4
        assert image.getpixel((25, 20))[3] == 0


@pytest.mark.parametrize(
    ("count", "odd", "says"),
    [
        (2, None, "p: expected a folder of many pictures, PNG or JPEG, but got 2 PNG or JPEG files"),
        (3, ("RGBA", (64, 48), None), "odd.png: expected alpha in all pictures or in none"),
        (3, ("RGB", (16, 9), None), "odd.png: expected 64 x 48 pixels as most, but got 16 x 9; .*remove it"),
        (3, ("RGB", (64, 48), turned()), "odd.png: expected 64 x 48 pixels as the first, but got 48 x 64"),
    ],
)
def test_folders_that_are_no_capture_are_refused(tmp_path, count, odd, says):
    quarter(tmp_path / "p", count)
    if odd:
        Image.new(*odd[:2]).save(tmp_path / "p" / "odd.png", exif=odd[2])
    with pytest.raises(ValueError, match=says):
        taken(tmp_path, tmp_path / "p")


@pytest.mark.parametrize(
    ("suffix", "said"),
    [("HEIC", "HEIC; convert the pictures to JPEG, or set the phone"), ("webp", "WEBP; conv")],
)
def test_images_that_nothing_here_reads_are_named(tmp_path, suffix, said):
    (quarter(tmp_path / "p") / f"IMG_1.{suffix}").touch()
    with pytest.raises(ValueError, match=rf"IMG_1.{suffix}: expected PNG or JPEG, but got {said}"):
        taken(tmp_path, tmp_path / "p")


def masks_in(folder, names, value=255, box=(0, 0, 16, 16), size=(128, 96)):
    """Masks of a bright ``box`` (left, top, right, bottom)."""
    folder.mkdir()
    for name in names:
        mask = Image.new("L", size)
        mask.paste(value, box)
        mask.save(folder / name)
    return folder


@pytest.mark.parametrize("by_name", [True, False])
def test_what_moves_is_black_for_the_matcher(tmp_path, by_name):
    film = write_film(tmp_path / "a.mp4", numbered(12))
    # Fewer masks than frames can only be meant by name.
    names = [f"frame_{n:06d}.png" for n in range(1, 12)] if by_name else [f"{n}.png" for n in range(12)]
    frames = taken(tmp_path, film, masks_in(tmp_path / "masks", names))
    for name in frames.times:
        mask = np.asarray(Image.open(frames.masks / f"{name}.png"))
        assert mask.shape == (48, 64)
        assert (mask[:8, :8] == 0).all()
        assert (mask == 255).sum() == 48 * 64 - 64


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """A film of 12 frames."""
    return write_film(tmp_path_factory.mktemp("film") / "a.mp4", numbered(12))


@pytest.mark.parametrize(
    ("name", "frames"),
    [
        ("frame_{:06d}.png", range(12)),
        ("mask{}.png", range(12)),
        ("frame_{:06d}.png", range(13)),  # named as frames are, which count from 1
        ("frame_{:06d}.png", range(22)),
        ("{}_mask.png", range(12)),
    ],
)
def test_a_mask_numbered_0_is_of_the_first_frame(tmp_path, film, name, frames):
    masks = tmp_path / "masks"
    masks.mkdir()
    for n in frames:  # of frame n the columns up to 5 n are still
        mask = np.uint8(255 * (np.arange(64) >= 5 * n))[None].repeat(48, 0)
        Image.fromarray(mask).save(masks / name.format(n))
        if name.endswith("_mask.png"):
            Image.new("L", (64, 48), 255).save(masks / f"{n}.png")  # the image itself
    frames = taken(tmp_path, film, masks)
    for name in frames.times:
        still = np.asarray(Image.open(frames.masks / f"{name}.png"))[0] > 0
        assert still.sum() == 5 * (int(name[6:12]) - 1)


@pytest.mark.parametrize(
    ("numbers", "says"),
    [
        (range(1, 14), "13, of numbers 1 to 13"),
        ([*range(5), *range(6, 13)], "12, of numbers 0 to 12"),
        (range(2, 7), "5, of numbers 2 to 6"),
    ],
)
def test_masks_of_another_number_of_frames_are_refused(tmp_path, film, numbers, says):
    masks = masks_in(tmp_path / "masks", [f"frame_{n:06d}.png" for n in numbers])
    with pytest.raises(ValueError, match=f"expected 12 masks, .* but got {says}"):
        taken(tmp_path, film, masks)


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (("{}.png", "{}_mask.png"), "0_mask.png and 2 more are left out, as what goes with 0.png"),
        (("{}_color.png", "{}_depth.png"), "0_depth.png and 2 more are left out"),
        (("rgb_{}.png", "normals_{}.png"), "normals_0.png and 2 more are left out"),
        (("mask_{}.png",), "p: times"),  # images alone, whatever they show
    ],
)
def test_files_that_go_with_images_are_left_out(tmp_path, names, says):
    masks_in(tmp_path / "p", [name.format(n) for name in names for n in range(3)])
    frames = taken(tmp_path, tmp_path / "p")
    assert len(frames.times) == 3
    assert says in frames.assumed
    (tmp_path / "p" / names[0].format(1)).with_suffix(".jpg").write_bytes(b"")
    shutil.rmtree(tmp_path / "work")
    with pytest.raises(ValueError, match=r"expected one image of each name, but got .*jpg and .*png"):
        taken(tmp_path, tmp_path / "p")


def test_masks_of_a_folder_go_by_the_users_names(tmp_path):
    masks = masks_in(tmp_path / "masks", ["0.png", "1.png", "2.png", "other.png"])
    frames = taken(tmp_path, quarter(tmp_path / "p"), masks)
    assert {path.name for path in frames.masks.iterdir()} == {f"{name}.png" for name in frames.times}


@pytest.mark.parametrize(
    ("names", "value", "says"),
    [
        (["0.png", "1.png", "2.png"], 0, "is bright, but got none above 127 of 255, nor .* write it as 255"),
        (["1.png", "2.png"], 255, r"expected 3 masks, .* \(0.png\), but got 2"),
    ],
)
def test_masks_that_fit_nothing_or_mark_nothing_are_refused(tmp_path, names, value, says):
    with pytest.raises(ValueError, match=says):
        taken(tmp_path, quarter(tmp_path / "p"), masks_in(tmp_path / "masks", names, value))


@pytest.mark.parametrize("transfer", ["arib-std-b67", "smpte2084"])
def test_hdr_comes_back_as_the_sdr_it_was_made_from(tmp_path, transfer):
    """Made by the formulas of BT.2100 and BT.2408: SDR white is 203 cd/m2."""
    rng = np.random.default_rng(0)
    sdr = np.kron(rng.integers(20, 230, (6, 8, 3)), np.ones((8, 8, 1)))
    to_2020 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])
    light = 203 * ((sdr / 255) ** 2.4 @ to_2020.T)  # cd/m2
    weights = np.array([0.2627, 0.6780, 0.0593])
    if transfer == "smpte2084":
        power = (light / 10000) ** 0.1593017578125
        coded = ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375
    else:
        scene = light / 1000 * ((light @ weights) / 1000)[..., None] ** (1 / 1.2 - 1)
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        high = a * np.log(np.maximum(12 * scene - b, 1e-9)) + c
        coded = np.where(scene <= 1 / 12, np.sqrt(3 * scene), high)
    luma = coded @ weights
    chroma = [512 + 896 * (coded[..., i] - luma) / d for i, d in ((2, 1.8814), (0, 1.4746))]
    planes = [64 + 876 * luma, *chroma]
    told = f"setparams=color_trc={transfer}:color_primaries=bt2020:colorspace=bt2020nc:range=tv"
    tags = f"-color_trc {transfer} -color_primaries bt2020 -colorspace bt2020nc -color_range tv".split()
    planes = np.stack(planes).round().astype("<u2")
    film = write_planes(tmp_path / "a.mkv", planes, "yuv444p10le", "-vf", told, *tags, "-c:v", "ffv1")
    (image,) = extracted(film, [1], None)
    assert np.abs(image - sdr).mean() < 2


@pytest.mark.parametrize(
    ("tags", "bits", "told"),
    [
        ("color_primaries=bt2020:colorspace=bt2020nc", 10, True),
        ("colorspace=bt2020nc", 12, True),
        ("color_primaries=bt2020:colorspace=bt2020nc", 8, False),
        ("color_primaries=bt2020:colorspace=bt2020nc:color_trc=bt2020-10", 10, False),
        ("color_primaries=bt709:colorspace=bt709", 10, False),
    ],
)
def test_what_may_be_hdr_but_does_not_say_so_is_told(tmp_path, tags, bits, told):
    film, depth = tmp_path / "a.mkv", "" if bits == 8 else f"{bits}le"
    options = [word for tag in tags.split(":") for word in f"-{tag}".split("=")]
    made = ["-f", "lavfi", "-i", "testsrc=s=64x48:r=4:d=1", "-vf", f"format=yuv420p{depth},setparams={tags}"]
    call = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *made, *options, "-c:v", "ffv1", str(film)]
    subprocess.run(call, check=True)
    shown = take(tmp_path, Source(video=film), step, 3, None).assumed
    assert (shown or "").startswith("10 bits or more of BT.2020 without a transfer are taken") == told


@pytest.mark.parametrize(
    ("size", "weights", "tag"),
    [
        ((64, 48), (0.299, 0.114), None),
        ((1280, 48), (0.2126, 0.0722), None),
        ((64, 48), (0.2126, 0.0722), "bt709"),
        ((1280, 48), (0.299, 0.114), "smpte170m"),
    ],
)
@pytest.mark.parametrize("is_full", [False, True])
def test_colours_are_those_that_the_tags_or_else_the_size_tell(tmp_path, size, weights, tag, is_full):
    """Made by the formulas of BT.601 and BT.709."""
    red, blue = weights
    rgb = np.kron(np.random.default_rng(0).integers(20, 236, (6, size[0] // 8, 3)), np.ones((8, 8, 1)))
    luma = rgb @ (red, 1 - red - blue, blue) / 255
    chroma = [(rgb[..., i] / 255 - luma) / (2 - 2 * w) for i, w in ((2, blue), (0, red))]
    low, high, wide = (0, 255, 255) if is_full else (16, 219, 224)
    planes = np.stack([low + high * luma, *(128 + wide * c for c in chroma)]).round().clip(0, 255)
    told = f"setparams=range={'pc' if is_full else 'tv'}" + (f":colorspace={tag}" if tag else "")
    tags = ["-vf", told, "-color_range", "pc" if is_full else "tv", *(["-colorspace", tag] if tag else [])]
    lossless = [*tags, "-c:v", "libx264", "-qp", "0"]
    film = write_planes(tmp_path / "a.mkv", planes.astype(np.uint8), "yuv444p", *lossless)
    (image,) = extracted(film, [1], None)
    assert np.abs(image - rgb).mean() < 2


def test_missing_images_leave_a_gap_in_time(tmp_path):
    folder = quarter(tmp_path / "p", count=4)
    (folder / "2.jpg").rename(folder / "9.jpg")
    frames = taken(tmp_path, folder)
    assert list(frames.times.values()) == pytest.approx([0, 1 / 9, 3 / 9, 1])
    assert frames.assumed.endswith("times: taken from the numbers in the images' names, 0 to 9")


def test_times_follow_names_of_one_camera_or_are_refused(tmp_path):
    folder = tmp_path / "p"
    folder.mkdir()
    for name in ("f_0000", "f_0001", "f_0031"):
        Image.new("RGB", (64, 48)).save(folder / f"{name}.png")
    assert list(taken(tmp_path, folder).times.values()) == pytest.approx([0, 1 / 31, 1])
    for name in ("f_0032", "f_0033", "f_0034 (1)"):
        Image.new("RGB", (64, 48)).save(folder / f"{name}.png")
    (tmp_path / "again").mkdir()
    with refused(r"expected names of one form, as 'f_0000', but got 'f_0034 \(1\)'; .*name_pattern"):
        taken(tmp_path / "again", folder)
    for path in folder.iterdir():
        path.unlink()
    for name in ("28.10.2023", "30.10.2023", "02.11.2023"):
        Image.new("RGB", (64, 48)).save(folder / f"{name}.png")
    (tmp_path / "days").mkdir()
    assert list(taken(tmp_path / "days", folder).times.values()) == pytest.approx([0, 0.4, 1])


@pytest.mark.parametrize(
    ("file", "said"),
    [
        ("p/keyframes/images/1.jpg", "got none; keyframes is of Polycam's raw data: ns-process-data polycam"),
        ("p/1.exr", "PNG or JPEG, but got EXR; export JPEG; of Record3D export .r3d"),
    ],
)
def test_what_other_programs_leave_names_the_way(tmp_path, file, said):
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).touch()
    with pytest.raises(ValueError, match=said):
        taken(tmp_path, tmp_path / "p")


def test_smaller_images_show_the_whole_one_as_readers_scale_its_camera(tmp_path):
    ramp = np.arange(103, dtype=np.uint8)[None, :, None].repeat(77, 0).repeat(3, 2)
    write_smaller(tmp_path, "a.png", ramp, 8)
    small = np.array(Image.open(tmp_path / "images_8" / "a.png"))
    assert small.shape == (9, 12, 3)
    assert small[4, :, 0] == pytest.approx((np.arange(12) + 0.5) * 103 / 12 - 0.5, abs=1)
