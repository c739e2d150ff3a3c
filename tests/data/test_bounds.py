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

from dnerf_scene import edit, write_tiny
from forewarp.data import capture, dnerf, hypernerf, nerfies_items, posed_video
from forewarp.data import files as data_files
from forewarp.data.files import MOST_FRAMES, frames_of, inside, read_bytes, read_json
from forewarp.data.images import inspect_png, read_image
from forewarp.data.truth import load_numpy
from forewarp.scene.errors import SceneError
from posed_scene import edit as edit_video
from posed_scene import write_tiny as write_video
from rig_scene import write_rig

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


@pytest.mark.parametrize(("name", "content"), [("a.png", png_bomb()), ("a.jpg", jpeg_bomb())])
def test_a_decompression_bomb_is_not_decoded(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    cheaply(
        lambda: read_image(tmp_path / name),
        f"{name}: expected an image of 1 to 80000000 pixels, but got 60000",
    )


def test_a_bomb_in_a_scene_is_refused_when_the_scene_is_read(tmp_path):
    write_tiny(tmp_path / "a")
    (tmp_path / "a" / "train" / "r_1.png").write_bytes(png_bomb())
    cheaply(lambda: dnerf.read_scene(tmp_path, "a"), "r_1.png: expected an image of 1 to")


def test_a_bomb_under_another_suffix_is_no_image(tmp_path):
    (tmp_path / "a.jpg").write_bytes(png_bomb())
    cheaply(
        lambda: read_image(tmp_path / "a.jpg"),
        "a.jpg: expected a PNG or JPEG image, but got a file of another",
    )


def test_a_file_of_text_is_bounded_by_its_size(tmp_path):
    with (tmp_path / "a.json").open("wb") as file:
        file.truncate(1 << 33)
    cheaply(
        lambda: read_json(tmp_path / "a.json"), "a.json: expected at most 67108864 bytes, but got 8589934592"
    )
    with (tmp_path / "a.png").open("wb") as file:
        file.truncate(1 << 33)
    cheaply(lambda: inspect_png(tmp_path / "a.png"), "a.png: expected at most 536870912 bytes")


def test_a_file_with_too_many_frames_is_refused(tmp_path, monkeypatch):
    with pytest.raises(SceneError, match="frames: expected at most 1000000 frames, but got 1000001"):
        frames_of({"frames": [0] * (MOST_FRAMES + 1)}, tmp_path)
    monkeypatch.setattr(data_files, "MOST_FRAMES", 5)
    monkeypatch.setattr(nerfies_items, "MOST_FRAMES", 5)
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
    monkeypatch.setattr("forewarp.data.truth._MOST_BYTES", 1 << 20)
    with zipfile.ZipFile(tmp_path / "b.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", bytes(1 << 20) + b"x")
    cheaply(lambda: load_numpy(tmp_path / "b.npz"), "b.npz: .*1048577 bytes unpacked")


def test_pipes_and_devices_are_no_files(tmp_path):
    os.mkfifo(tmp_path / "a.json")
    os.mkfifo(tmp_path / "a.jpg")
    cheaply(
        lambda: read_bytes(tmp_path / "a.json"),
        "a.json: expected a readable file, but got a device or a pipe",
    )
    cheaply(lambda: capture._header(tmp_path / "a.jpg"), "a.jpg: expected an image, but got an empty file")
    (tmp_path / "b.json").symlink_to("/dev/zero")
    cheaply(lambda: read_json(tmp_path / "b.json"), "b.json: expected a readable file, but got a device")


OUTSIDE = ["../x", "/etc/passwd", "a/../../x", "..", ".", "", "a\n", "a\x00b", "./../x", 7, None, ["a"]]


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


@pytest.mark.parametrize(
    ("read", "key"),
    [
        (read_dnerf, "file_path"),
        (read_dnerf, "depth_file_path"),
        (read_video, "file_path"),
        (read_video, "mask_path"),
        (read_rig, "ids"),
    ],
)
@pytest.mark.parametrize("name", ["../../secret", "/etc/secret"])
def test_every_reader_stays_in_its_scene(tmp_path, read, key, name):
    (tmp_path / "secret.png").write_bytes(b"x")
    with pytest.raises(SceneError, match=f"{key}.*: expected a path inside the scene folder, but got"):
        read(tmp_path, name, key)
