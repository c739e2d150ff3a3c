"""What promises more than a memory holds, or points out of the scene, is refused before anything is made."""

import io
import os
import struct
import tracemalloc
import zipfile
import zlib
from contextlib import contextmanager

import numpy as np
import pytest

from forewarp.data import hypernerf
from forewarp.data.arrays import load_numpy
from forewarp.data.files import MOST_FRAMES, SceneError, frames_of, inside, read_bytes, read_json
from forewarp.data.images import inspect_image, read_gray16, read_image
from tests.support.rig_scene import write_rig

BIG = 60_000


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
    with at_most(32), pytest.raises(SceneError, match=f"{path.name}: {match}") as refusal:
        read(path)
    assert len(str(refusal.value).splitlines()) == 1


def png_with(*chunks):
    """The chunks and an end, each with its length and checksum."""
    parts = (
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in (*chunks, (b"IEND", b""))
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def size(width, height, bits=8, color=6):
    return b"IHDR", struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)


def png_bomb(side=BIG):
    """A few bytes that decode to 14 GB."""
    return png_with(size(side, side), (b"IDAT", zlib.compress(bytes(1000))))


def jpeg_bomb():
    frame = struct.pack(">HBHHB", 17, 8, BIG, BIG, 3) + bytes(9)
    return b"\xff\xd8\xff\xc0" + frame + b"\xff\xda\x00\x02\xff\xd9"


ROWS = (b"IDAT", zlib.compress(bytes(17 * 4)))
BOMBS = [
    ("a.png", png_bomb()),
    ("a.png", png_bomb(10_000)),  # Pillow only warns of it
    ("a.jpg", jpeg_bomb()),
    ("a.jpg", png_bomb()),
    ("a.png", png_with(size(4, 4), size(BIG, BIG), ROWS)),  # the last header before the pixels counts
]


@pytest.mark.parametrize(("name", "content"), BOMBS)
def test_a_decompression_bomb_is_not_decoded(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    for read in (inspect_image, read_image):
        refused_cheaply(read, tmp_path / name, "expected an image of 1 to 80000000 pixels, but")


def film(count, side, bits=8, color=6):
    """An animated PNG: ``count`` squares of zeros in a few bytes each."""
    row = side * {6: 4, 0: 1}[color] * bits // 8 + 1
    pixels = zlib.compress(bytes(row * side), 9)
    chunks, number = [size(side, side, bits, color), (b"acTL", struct.pack(">II", count, 0))], 0
    for i in range(count):
        about = struct.pack(">IIIIIHHBB", number, side, side, 0, 0, 1, 10, 0, 0)
        number += 1 + (i > 0)
        body = (b"IDAT", pixels) if i == 0 else (b"fdAT", struct.pack(">I", number - 1) + pixels)
        chunks += [(b"fcTL", about), body]
    return png_with(*chunks)


def test_of_a_film_one_picture_is_decoded(tmp_path):
    """All hundred would take 100 MB."""
    (tmp_path / "a.png").write_bytes(film(100, 512))
    (tmp_path / "b.png").write_bytes(film(100, 512, bits=16, color=0))
    with at_most(16):
        assert read_image(tmp_path / "a.png").shape == (512, 512, 4)
        assert read_gray16(tmp_path / "b.png").shape == (512, 512)
    (tmp_path / "a.png").write_bytes(png_with(size(4, 4), ROWS, size(BIG, BIG)))  # nothing behind the pixels
    assert read_image(tmp_path / "a.png").shape == (4, 4, 4)


def array_of(shape):
    """A .npy file whose header promises more than it holds."""
    content = io.BytesIO()
    np.lib.format.write_array_header_1_0(content, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return content.getvalue() + bytes(100)


def test_files_are_bounded_by_their_size(tmp_path, monkeypatch):
    monkeypatch.setattr("forewarp.data.arrays.MOST_ARRAYS", 1 << 20)
    with zipfile.ZipFile(tmp_path / "b.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", bytes(1 << 20) + b"x")
    (tmp_path / "a.npy").write_bytes(array_of((10**12, 3)))
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
    with pytest.raises(SceneError, match="frames: expected at most 1000000 frames, but got 1000001"):
        frames_of({"frames": [0] * (MOST_FRAMES + 1)}, tmp_path)
    monkeypatch.setattr(hypernerf, "MOST_FRAMES", 5)
    write_rig(tmp_path / "a")
    with pytest.raises(SceneError, match="ids: expected at most 5 items"):
        hypernerf.read_scene(tmp_path, "a")


def test_pipes_and_devices_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "a.json")
    os.mkfifo(tmp_path / "a.jpg")
    (tmp_path / "b.json").symlink_to("/dev/zero")
    for read, name in ((read_bytes, "a.json"), (inspect_image, "a.jpg"), (read_json, "b.json")):
        refused_cheaply(read, tmp_path / name, "expected a file, but got a device or a pipe")


OUTSIDE = ["../x", "/etc/passwd", "a/../../x", "./train/../../x", "..", ".", "", "a\n", "a\x00b", "a\\b"]
OUTSIDE += ["\ud800.png", "./../x", "..\\x", 7, None, ["a"]]


@pytest.mark.parametrize("name", OUTSIDE)
def test_no_name_leaves_its_scene(tmp_path, name):
    with pytest.raises(SceneError, match="key: expected a path inside the scene folder, but got"):
        inside(tmp_path, name, "key")
