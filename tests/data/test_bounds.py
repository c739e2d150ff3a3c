"""What promises more than a memory holds, or points out of the scene, is refused before anything is made."""

import io
import json
import os
import struct
import tracemalloc
import zipfile
import zlib

import numpy as np
import pytest

from forewarp.data import dnerf, hypernerf, lego_complete, posed_video
from forewarp.data import files as data_files
from forewarp.data.arrays import load_numpy
from forewarp.data.files import MOST_FRAMES, frames_of, inside, read_bytes, read_json
from forewarp.data.images import inspect_image, read_gray16, read_image
from forewarp.scene.errors import SceneError
from tests.support.dnerf_scene import ANGLE, edit, shots, truth, write_tiny
from tests.support.posed_scene import edit as edit_video
from tests.support.posed_scene import write_tiny as write_video
from tests.support.rig_scene import write_rig

BIG = 60_000


def chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_bomb(width=BIG, height=BIG):
    """A few bytes that decode to 14 GB."""
    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    rows = zlib.compress(bytes(1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def jpeg_bomb(width=BIG, height=BIG):
    frame = struct.pack(">HBHHB", 17, 8, height, width, 3) + bytes(9)
    return b"\xff\xd8\xff\xc0" + frame + b"\xff\xda\x00\x02\xff\xd9"


def cheaply(action, match):
    """The action ends in a SceneError, and within 32 MB."""
    tracemalloc.start()
    try:
        with pytest.raises(SceneError, match=match) as refusal:
            action()
        assert tracemalloc.get_traced_memory()[1] < 32 * 2**20
    finally:
        tracemalloc.stop()
    assert len(str(refusal.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.png", png_bomb()),
        ("a.png", png_bomb(10_000, 10_000)),  # Pillow only warns of it
        ("a.jpg", jpeg_bomb()),
        ("a.jpg", png_bomb()),
    ],
)
def test_a_decompression_bomb_is_not_decoded(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    for read in (inspect_image, read_image):
        cheaply(
            lambda read=read: read(tmp_path / name), f"{name}: expected an image of 1 to 80000000 pixels, but"
        )


def png_with(*chunks):
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(kind, body) for kind, body in chunks) + chunk(b"IEND", b"")


def size(width, height, bits=8, color=6):
    return b"IHDR", struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)


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
    tracemalloc.start()
    try:
        assert read_image(tmp_path / "a.png").shape == (512, 512, 4)
        assert read_gray16(tmp_path / "b.png").shape == (512, 512)
        assert tracemalloc.get_traced_memory()[1] < 16 * 2**20
    finally:
        tracemalloc.stop()


ROWS = (b"IDAT", zlib.compress(bytes(17 * 4)))


def test_a_second_header_makes_no_bomb(tmp_path):
    """The decoder takes the last header before the pixels, and so does the check."""
    (tmp_path / "a.png").write_bytes(png_with(size(4, 4), size(BIG, BIG), ROWS))
    cheaply(lambda: read_image(tmp_path / "a.png"), "expected an image of 1 to 80000000 pixels, but got")
    (tmp_path / "a.png").write_bytes(png_with(size(4, 4), ROWS, size(BIG, BIG)))
    assert read_image(tmp_path / "a.png").shape == (4, 4, 4)


def test_a_bomb_in_a_scene_is_refused_when_the_scene_is_read(tmp_path):
    write_tiny(tmp_path / "a")
    (tmp_path / "a" / "train" / "r_1.png").write_bytes(png_bomb())
    cheaply(lambda: dnerf.read_scene(tmp_path, "a"), "r_1.png: expected an image of 1 to")


def test_a_file_of_text_is_bounded_by_its_size(tmp_path):
    with (tmp_path / "a.json").open("wb") as file:
        file.truncate(1 << 33)
    cheaply(
        lambda: read_json(tmp_path / "a.json"), "a.json: expected at most 67108864 bytes, but got 8589934592"
    )
    with (tmp_path / "a.png").open("wb") as file:
        file.truncate(1 << 33)
    cheaply(lambda: inspect_image(tmp_path / "a.png"), "a.png: expected at most 536870912 bytes")


def test_a_file_with_too_many_frames_is_refused(tmp_path, monkeypatch):
    with pytest.raises(SceneError, match="frames: expected at most 1000000 frames, but got 1000001"):
        frames_of({"frames": [0] * (MOST_FRAMES + 1)}, tmp_path)
    monkeypatch.setattr(data_files, "MOST_FRAMES", 5)
    monkeypatch.setattr(hypernerf, "MOST_FRAMES", 5)
    write_tiny(tmp_path / "a")
    edit(tmp_path / "a", "train", lambda c: c.update(frames=c["frames"] * 2))
    write_video(tmp_path / "b")
    write_rig(tmp_path / "c")
    for kind, name in ((dnerf, "a"), (posed_video, "b"), (hypernerf, "c")):
        with pytest.raises(SceneError, match="expected at most 5 "):
            kind.read_scene(tmp_path, name)


def test_arrays_are_as_long_as_their_files(tmp_path, monkeypatch):
    content = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        content, {"descr": "<f4", "fortran_order": False, "shape": (10**12, 3)}
    )
    (tmp_path / "a.npy").write_bytes(content.getvalue() + bytes(100))
    cheaply(
        lambda: load_numpy(tmp_path / "a.npy"),
        "a.npy: expected a NumPy file, but got one that cannot be read",
    )
    monkeypatch.setattr("forewarp.data.arrays.MOST_ARRAYS", 1 << 20)
    with zipfile.ZipFile(tmp_path / "b.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", bytes(1 << 20) + b"x")
    cheaply(lambda: load_numpy(tmp_path / "b.npz"), "b.npz: .*1048577 bytes unpacked")


def test_pipes_and_devices_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "a.json")
    os.mkfifo(tmp_path / "a.jpg")
    cheaply(lambda: read_bytes(tmp_path / "a.json"), "a.json: expected a file, but got a device or a pipe")
    cheaply(lambda: inspect_image(tmp_path / "a.jpg"), "a.jpg: expected a file, but got a device or a pipe")
    (tmp_path / "b.json").symlink_to("/dev/zero")
    cheaply(lambda: read_json(tmp_path / "b.json"), "b.json: expected a file, but got a device")


OUTSIDE = [
    "./train/../../x",
    "\ud800.png",
    "../x",
    "/etc/passwd",
    "a/../../x",
    "..",
    ".",
    "",
    "a\n",
    "a\x00b",
    "./../x",
    "..\\x",
    "a\\b",
]
OUTSIDE += ["./train/../../x", "\ud800.png", 7, None, ["a"]]


@pytest.mark.parametrize("name", OUTSIDE)
def test_no_name_leaves_its_scene(tmp_path, name):
    with pytest.raises(SceneError, match="key: expected a path inside the scene folder, but got"):
        inside(tmp_path, name, "key")


def read_dnerf(root, name, key):
    folder = write_tiny(root / "a")
    edit(folder, "train", lambda c: c["frames"][1].update({key: name}))
    return dnerf.read_scene(root, "a")


def read_video(root, name, key):
    folder = write_video(root / "a")
    edit_video(folder, lambda c: c["frames"][1].update({key: name}))
    return posed_video.read_scene(root, "a")


def read_rig(root, name, key):
    folder = write_rig(root / "a")
    path = folder / "dataset.json"
    content = json.loads(path.read_text())
    content["ids"][0], content["train_ids"][0] = name, name
    path.write_text(json.dumps(content))
    path = folder / "metadata.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {name: {"time_id": 0}}))
    return hypernerf.read_scene(root, "a")


def write_lego(folder):
    test = [s for k, a in enumerate(dnerf.ABILITIES) for s in shots(2, k, (6, 8), a, True, [0.0, 0.0])]
    lego_complete.write_scene(
        folder, {"train": shots(3), "test": test}, camera_angle_x=ANGLE, trajectories=truth()
    )
    return folder


def read_lego(root, name, key):
    folder = write_lego(root / "a")
    edit(folder, "test_time", lambda c: c["frames"][1].update({key: name}))
    return lego_complete.read_scene(root, "a")


@pytest.mark.parametrize(
    ("read", "key"),
    [
        (read_dnerf, "file_path"),
        (read_dnerf, "depth_file_path"),
        (read_video, "file_path"),
        (read_video, "mask_path"),
        (read_rig, "ids"),
        (read_lego, "file_path"),
        (read_lego, "depth_file_path"),
    ],
)
@pytest.mark.parametrize("name", ["../../secret", "/etc/secret"])
def test_every_reader_stays_in_its_scene(tmp_path, read, key, name):
    (tmp_path / "secret.png").write_bytes(b"x")
    with pytest.raises(SceneError, match=f"{key}.*: expected a path inside the scene folder, but got"):
        read(tmp_path, name, key)
