"""What all readers share: numbers, poses, boxes; what is too large or leads out; fingerprints of files."""

import gc
import io
import os
import struct
import tracemalloc
import warnings
import zipfile
import zlib
from contextlib import contextmanager

import numpy as np
import pytest

from forewarp.data import files, hypernerf
from forewarp.data.arrays import load_numpy, read_cloud
from forewarp.data.cameras import box_of, pose_of
from forewarp.data.files import (
    MOST_BYTES,
    MOST_FRAMES,
    difference,
    fingerprint,
    frames_of,
    inside,
    number,
    numbers_of,
    read_bytes,
    read_json,
    whole,
)
from forewarp.data.images import inspect_image, read_gray16, read_image
from forewarp.data.video import stamps_of
from tests.support.written_scenes import refused, write_dnerf, write_rig

BIG, EYE, NAN = 60_000, np.eye(4), float("nan")
BAD_POSES = {
    "none": (None, "expected 4 x 4 or 3 x 4 finite numbers, but got None; check the export"),
    "3 x 3": (EYE[:3, :3], "expected 4 x 4 or 3 x 4 finite"),
    "ragged": ([[1], [1, 2]], "expected 4 x 4 or 3 x 4"),
    "words": ([["a"] * 4] * 4, "expected 4 x 4 or 3 x 4"),
    "nan": (EYE * NAN, "expected 4 x 4 or 3 x 4"),
    "scale": (np.diag([2.0, 2, 2, 1]), "expected a rotation, but got determinant 8"),
    "mirror": (np.diag([1.0, 1, -1, 1]), "expected a rotation, but got determinant -1"),
    "last row": ([*EYE[:3], [0, 0, 1, 1]], "expected the last row 0 0 0 1"),
    "far off": (EYE + 1e12 * np.eye(4, k=3), r"expected a place within 1e\+09 units, but got 1e\+12"),
}


@pytest.mark.parametrize("case", BAD_POSES)
def test_bad_poses(case):
    value, match = BAD_POSES[case]
    with refused(f"^a.json: pose: {match}") as caught:
        pose_of(value, "a.json: pose")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [1.5, -1, NAN, float("inf"), "0.5", True, None, 10**400, [1]])
def test_bad_numbers(value):
    with refused(r"^a.json: time: expected a number in \[0, 1\], but got "):
        number(value, "a.json: time", 0, 1)


@pytest.mark.parametrize("words", [["1"], ["1", "2", "3"], ["1", "x"], ["1", "nan"], ["inf", "1"]])
def test_bad_numbers_in_text(words):
    with refused(r"^a.txt: line 3: expected 2 finite numbers, but got "):
        numbers_of(words, 2, "a.txt: line 3")


@pytest.mark.parametrize("value", [1, -2, 2.0, "2", True, None, [2], np.float32(2)])
def test_whole_numbers(value):
    assert (whole(np.int64(2), "frames", 2), whole(16, "size", 8, 8)) == (2, 16)
    with refused("^frames: expected a whole number of at least 2, but got .*; set"):
        whole(value, "frames", 2)
    with refused("size: expected a multiple of 8 of at least 8, but got 20; set"):
        whole(20, "size", 8, 8)


@pytest.mark.parametrize("values", [[1, 2], [1, 1, 1, 0, 2, 2], [0] * 6, "box", [*"abcdef"]])
def test_bad_boxes(values):
    with refused("^data.box: expected six numbers x0 y0 z0 x1 y1 z1, each low"):
        box_of(values)


OUTSIDE = ["../x", "/etc/passwd", "a/../../x", "./train/../../x", "..", ".", "", "a\n", "a\x00b"]
OUTSIDE += ["\ud800.png", "./../x", "..\\x", "C:\\x", 7, None, ["a"]]


@pytest.mark.parametrize("name", OUTSIDE)
def test_no_name_leaves_its_scene(tmp_path, name):
    with refused("key: expected a path inside the scene folder, but got"):
        inside(tmp_path, name, "key")


@contextmanager
def at_most(megabytes):
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < megabytes * 2**20
    finally:
        tracemalloc.stop()


def refused_cheaply(read, path, match):
    """Reading ends in a SceneError of one line, and within 32 MB."""
    with at_most(32), refused(f"{path.name}: {match}") as refusal:
        read(path)
    assert len(str(refusal.value).splitlines()) == 1


def png_with(*chunks):
    """The chunks and an end, each with its length and checksum."""
    png = b"\x89PNG\r\n\x1a\n"
    for kind, body in (*chunks, (b"IEND", b"")):
        png += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return png


def size(width, height, bits=8, color=6):
    return b"IHDR", struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)


def png_bomb(side=BIG):
    """A few bytes that decode to 14 GB."""
    return png_with(size(side, side), (b"IDAT", zlib.compress(bytes(1000))))


JPEG_FRAME = struct.pack(">HBHHB", 17, 8, BIG, BIG, 3) + bytes(9)
ROWS = (b"IDAT", zlib.compress(bytes(17 * 4)))
BOMBS = [
    ("a.png", png_bomb()),
    ("a.png", png_bomb(10_000)),  # Pillow only warns of it
    ("a.png", png_bomb(9_000)),  # and not even that
    ("a.jpg", b"\xff\xd8\xff\xc0" + JPEG_FRAME + b"\xff\xda\x00\x02\xff\xd9"),
    ("a.jpg", png_bomb()),
    ("a.png", png_with(size(4, 4), size(BIG, BIG), ROWS)),  # the last header before the pixels counts
]


@pytest.mark.parametrize(("name", "content"), BOMBS)
def test_a_decompression_bomb_is_not_decoded(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    for read in (inspect_image, read_image):
        refused_cheaply(read, tmp_path / name, "expected an image of 1 to 80000000 pixels, but")


@pytest.mark.parametrize(
    ("chunks", "got"), [((), "another kind"), (((b"IDAT", b"none"),), "data that cannot be decoded")]
)
def test_a_png_of_right_checksums_may_hold_no_pixels(tmp_path, chunks, got):
    (tmp_path / "a.png").write_bytes(png_with(size(4, 4), *chunks))
    refused_cheaply(read_image, tmp_path / "a.png", f"expected .* image, but got {got}")


def film(count, side, bits=8, color=6):
    """An animated PNG: ``count`` squares of zeros in a few bytes each."""
    pixels = zlib.compress(bytes((side * {6: 4, 0: 1}[color] * bits // 8 + 1) * side), 9)
    chunks, number = [size(side, side, bits, color), (b"acTL", struct.pack(">II", count, 0))], 0
    for i in range(count):
        about = struct.pack(">IIIIIHHBB", number, side, side, 0, 0, 1, 10, 0, 0)
        number += 1 + (i > 0)
        body = (b"IDAT", pixels) if i == 0 else (b"fdAT", struct.pack(">I", number - 1) + pixels)
        chunks += [(b"fcTL", about), body]
    return png_with(*chunks)


def test_of_a_film_one_image_is_decoded(tmp_path):
    """All hundred would take 100 MB."""
    (tmp_path / "a.png").write_bytes(film(100, 512))
    (tmp_path / "b.png").write_bytes(film(100, 512, bits=16, color=0))
    with at_most(16):
        assert read_image(tmp_path / "a.png").shape == (512, 512, 4)
        assert read_gray16(tmp_path / "b.png").shape == (512, 512)
    (tmp_path / "a.png").write_bytes(png_with(size(4, 4), ROWS, size(BIG, BIG)))  # nothing behind the pixels
    assert read_image(tmp_path / "a.png").shape == (4, 4, 4)


def test_what_only_begins_as_an_archive_is_refused_and_closed(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK\x03\x04 and no more")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        with refused("a.npz: expected a NumPy file"):
            load_numpy(tmp_path / "a.npz")
        gc.collect()
    assert [str(warning.message) for warning in told if "a.npz" in str(warning.message)] == []


def test_files_are_bounded_by_their_size(tmp_path, monkeypatch):
    monkeypatch.setattr("forewarp.files.MOST_ARRAYS", 1 << 20)
    with zipfile.ZipFile(tmp_path / "b.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", bytes(1 << 20) + b"x")
    promise = io.BytesIO()  # a header that promises more than the file holds
    about = {"descr": "<f4", "fortran_order": False, "shape": (10**12, 3)}
    np.lib.format.write_array_header_1_0(promise, about)
    (tmp_path / "a.npy").write_bytes(promise.getvalue() + bytes(100))
    for name in ("a.json", "a.png"):
        (tmp_path / name).touch()
        os.truncate(tmp_path / name, 1 << 33)
    for read, name, match in (
        (read_json, "a.json", "expected at most 67108864 bytes, but got 8589934592"),
        (inspect_image, "a.png", "expected at most 536870912 bytes"),
        (load_numpy, "a.npy", "expected a NumPy file, but got one that cannot be read"),
        (load_numpy, "b.npz", ".*1048577 bytes unpacked"),
    ):
        refused_cheaply(read, tmp_path / name, match)


def test_a_scene_of_too_many_frames_is_refused(tmp_path, monkeypatch):
    with refused("frames: expected at most 1000000 frames, but got 1000001"):
        frames_of(tmp_path, {"frames": [0] * (MOST_FRAMES + 1)})
    monkeypatch.setattr(files, "MOST_FRAMES", 5)
    write_rig(tmp_path / "a")
    with refused("ids: expected at most 5 items"):
        hypernerf.read_scene(tmp_path, "a")


def test_what_all_frames_share_is_bounded(tmp_path):
    content = {str(key): 0 for key in range(2001)} | {"frames": [{}] * 50_000}
    with refused("transforms.json: expected at most 2000 keys beside so many frames, but got 2002 keys"):
        files.frames_of(tmp_path / "transforms.json", content)


def test_more_threads_than_a_system_begins_are_refused():
    assert files.threads_of(256) == 256
    with refused("threads: expected at most [0-9]+, but got 100000; set threads="):
        files.threads_of(100_000)


def test_pipes_and_devices_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "a.json")
    os.mkfifo(tmp_path / "a.jpg")
    (tmp_path / "b.json").symlink_to("/dev/zero")
    for read, name in ((read_bytes, "a.json"), (inspect_image, "a.jpg"), (read_json, "b.json")):
        refused_cheaply(read, tmp_path / name, "expected a file, but got a device or a pipe")


@pytest.mark.parametrize("name", ["a.json", "a.npy", "a.ply", "a.obj", "a.png", "a.mp4"])
def test_pointers_of_git_lfs_are_named(tmp_path, name):
    mark = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
    (tmp_path / name).write_text(mark)
    readers = {"json": read_json, "png": inspect_image, "mp4": stamps_of}
    read = readers.get(name[2:], lambda path: read_cloud(path, 3))
    with pytest.raises(ValueError, match=f"{name}: expected the file itself, .* Git LFS.*; .*git lfs pull"):
        read(tmp_path / name)
    assert fingerprint(tmp_path)["images"]["count"] + len(fingerprint(tmp_path)["texts"]) == 1


@pytest.fixture
def scene(tmp_path):
    return write_dnerf(tmp_path / "a")


def append(path):
    path.write_bytes(path.read_bytes() + b" ")


CHANGES = {
    "text": (lambda f: append(f / "transforms_val.json"), "transforms_val.json"),
    "gone": (lambda f: (f / "transforms_val.json").unlink(), "transforms_val.json"),
    "size": (lambda f: append(f / "train" / "r_0.png"), "images: 9 files of"),
    "fewer": (lambda f: (f / "train" / "r_0.png").unlink(), "images: 8 files of"),
    "name": (lambda f: (f / "train" / "r_0.png").rename(f / "train" / "r_9.png"), "images: 9 files of"),
    "new": (lambda f: (f / "b.json").write_text("{}"), "b.json"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_is_seen_and_named(scene, change):
    before = fingerprint(scene)
    assert difference(before, fingerprint(scene)) is None
    CHANGES[change][0](scene)
    assert difference(before, fingerprint(scene)).startswith(CHANGES[change][1])


def test_what_is_no_part_of_the_scene_does_not_count(scene):
    before, run = fingerprint(scene), scene / "runs" / "a"
    others = [scene / name for name in (".cache.json", ".hidden/a.png", "notes.md")]
    for path in (*others, *(run / name for name in (".lock", "data.json", "metrics.json", "images/0.png"))):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("{}")
    os.utime(scene / "transforms_train.json")
    assert fingerprint(scene) == before
    (scene / ".lock").write_text("")  # a scene that is locked is still one
    (scene / "new.json").write_text("{}")
    assert difference(before, fingerprint(scene)) == "new.json"


def test_a_text_too_large_to_read_counts_by_its_size(scene):
    before = fingerprint(scene)
    (scene / "images.txt").touch()
    os.truncate(scene / "images.txt", MOST_BYTES + 1)
    now = fingerprint(scene)
    assert now["texts"] == before["texts"]
    assert now["images"]["bytes"] == before["images"]["bytes"] + MOST_BYTES + 1


def test_links_count_as_what_they_lead_to_and_may_go_in_circles(scene, tmp_path):
    before = fingerprint(scene)
    (scene / "train").rename(tmp_path / "elsewhere")
    (scene / "train").symlink_to(tmp_path / "elsewhere")
    (scene / "round").symlink_to(scene)
    assert fingerprint(scene) == before
