"""Images and films that anyone may have made: no other program, no other file, no more than is said."""

import os
import struct
import subprocess
import zlib

import numpy as np
import pytest
from PIL import Image

from forewarp.data.images import inspect_image
from forewarp.data.video import header_of, stamps_of
from forewarp.drawing.images import read_image, video_within
from forewarp.files import memory_within
from forewarp.media import image_bytes
from tests.support.films import numbered, write_film

EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n(/tmp/x) (w) file closefile\n%%EOF\n"


def png_of(width, height):
    """The header of an image of any size."""
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in ((b"IHDR", head), (b"IDAT", zlib.compress(bytes(9))), (b"IEND", b""))
    )
    return b"\x89PNG\r\n\x1a\n" + parts


@pytest.fixture
def film(tmp_path):
    write_film(tmp_path / "a.mp4", numbered(4))
    return tmp_path / "a.mp4"


@pytest.mark.parametrize("content", [EPS, b"", b"GIF89a", png_of(60000, 60000), png_of(0, 9)])
def test_what_is_no_image_reaches_no_other_program(tmp_path, monkeypatch, content):
    monkeypatch.setattr(subprocess, "Popen", None)
    (tmp_path / "a.png").write_bytes(content)
    for read in (read_image, image_bytes, inspect_image):
        with memory_within(1 << 28), pytest.raises(ValueError, match=r"a.png: expected (a PNG|an image)"):
            read(tmp_path / "a.png")


def test_pipes_are_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "a.png")
    for read in (read_image, image_bytes, inspect_image, header_of, stamps_of):
        with pytest.raises(ValueError, match="expected a file, but got a device or a pipe"):
            read(tmp_path / "a.png")


def test_a_page_takes_no_links_and_nothing_but_what_it_shows(tmp_path, film):
    (tmp_path / "secret").write_text("ftypftypftyp")
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "b.png")
    assert image_bytes(tmp_path / "b.png") == (tmp_path / "b.png").read_bytes()
    assert video_within(film, 1 << 20) == (film.read_bytes(), "")
    (tmp_path / "link.png").symlink_to("b.png")
    (tmp_path / "link.mp4").symlink_to("a.mp4")
    (tmp_path / "text.mp4").write_text("0000ftyp and more")
    for read, name in ((image_bytes, "link.png"), (image_bytes, "secret")):
        with pytest.raises(ValueError, match=f"{name}: expected"):
            read(tmp_path / name)
    for name in ("link.mp4", "text.mp4", "secret"):
        with pytest.raises(ValueError, match=f"{name}: expected a"):
            video_within(tmp_path / name, 1 << 20)


HLS = "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\na.mp4\n#EXT-X-ENDLIST\n"


@pytest.mark.parametrize("playlist", [HLS, "ffconcat version 1.0\nfile a.mp4\n"])
def test_a_playlist_opens_no_other_film(film, playlist):
    (film.parent / "list.mp4").write_text(playlist)
    assert len(stamps_of(film)) == 4
    assert len(stamps_of(film.parent / "list.mp4")) == 0


def test_frames_of_an_enormous_size_are_refused_before_they_are_decoded(tmp_path):
    film = write_film(tmp_path / "a.mkv", numbered(2, (264, 320)), options=["-c:v", "ffv1"])
    content, sides = film.read_bytes(), [b"\xb0\x82\x01\x40", b"\xba\x82\x01\x08"]
    for side in sides:  # of the container, which this codec believes
        content = content.replace(side, side[:2] + b"\xea\x60")
    film.write_bytes(content)
    said = "a.mkv: expected frames of at most 80000000 pixels, but got 60000x60000"
    with pytest.raises(ValueError, match=said):
        header_of(film)
