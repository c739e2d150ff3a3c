"""Files of tensors that anyone may have made: followed before they are unpacked."""

import pickle
import struct
import time
import zipfile
from collections import OrderedDict

import pytest
import torch

from forewarp.archives import read_archive, write_archive
from forewarp.files import memory_within

STORAGE = b"X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpu"
OURS = {"a": torch.arange(6.0).reshape(2, 3), "b": {"c": [1, (2, 0.5)], "d": None}, 3: True}


def archive(path, structure, numbers=bytes(4)):
    """Write an archive with this pickle."""
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("archive/data.pkl", b"\x80\x02" + structure + b".")
        file.writestr("archive/byteorder", "little")
        file.writestr("archive/data/0", numbers)
        file.writestr("archive/version", "3\n")
    return path


def doubled(levels, begin, pair):
    """Hold twice what held twice what .. so that it has 2**levels parts."""
    return begin + b"".join(b"q%c" % n + b"h%ch%c" % (n, n) + pair for n in range(levels))


def tensor(count):
    """A tensor of so many numbers."""
    return (
        *(b"ctorch._utils\n_rebuild_tensor_v2\n((", STORAGE, b"J", struct.pack("<i", count), b"tQK\x00"),
        *(b"J", struct.pack("<i", count), b"\x85K\x01\x85\x89ccollections\nOrderedDict\n)RtR"),
    )


HOSTILE = {
    "a name of names of names": b"}" + doubled(60, b")", b"\x86") + b"K\x01s",
    "a list of lists of lists": b"}X\x01\x00\x00\x00a" + doubled(60, b")", b"\x86") + b"s",
    "a list in itself": b"}X\x01\x00\x00\x00a]q\x00h\x00as",
    "a dict in itself": b"}q\x00X\x01\x00\x00\x00ah\x00s",
    "too deep": b"}X\x01\x00\x00\x00a" + b"]" * 500 + b"a" * 499 + b"s",
    "bytes that are made": b"}X\x01\x00\x00\x00acbuiltins\nbytearray\nJ\x00\x00\x00\x7f\x85Rs",
    "a call": b"}X\x01\x00\x00\x00acos\nsystem\nX\x05\x00\x00\x00false\x85Rs",
    "numbers that are not there": b"}X\x01\x00\x00\x00a" + b"".join(tensor(2**30)) + b"s",
}


def test_what_we_write_is_read(tmp_path):
    write_archive(tmp_path / "a.pt", OURS)
    read = read_archive(tmp_path / "a.pt")
    assert torch.equal(read.pop("a"), OURS["a"])
    assert read == {key: value for key, value in OURS.items() if key != "a"}
    archive(tmp_path / "b.pt", b"}X\x01\x00\x00\x00a" + b"".join(tensor(1)) + b"s")
    assert read_archive(tmp_path / "b.pt")["a"].tolist() == [0.0]


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_kilobyte_asks_for_no_more_than_it_holds(tmp_path, kind):
    path, began = archive(tmp_path / "a.pt", HOSTILE[kind]), time.perf_counter()
    with memory_within(1 << 28), pytest.raises(ValueError, match="RefusedArchive"):
        read_archive(path)
    assert time.perf_counter() - began < 2


def test_what_torch_wrote_before_is_read_and_asks_for_no_more_either(tmp_path):
    torch.save(OrderedDict(a=OURS["a"]), tmp_path / "a.pt", _use_new_zipfile_serialization=False)
    with pytest.raises(ValueError, match="BadZipFile"):
        read_archive(tmp_path / "a.pt")
    content = (tmp_path / "a.pt").read_bytes()
    assert torch.equal(read_archive(tmp_path / "a.pt", legacy=True)["a"], OURS["a"])
    claimed = content.replace(b"K\x06N", b"J" + struct.pack("<i", 2**30) + b"N")
    assert claimed != content
    (tmp_path / "a.pt").write_bytes(claimed)
    with pytest.raises(ValueError, match="RefusedArchive"):
        read_archive(tmp_path / "a.pt", legacy=True)
    (tmp_path / "a.pt").write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(ValueError, match="ValueError"):
        read_archive(tmp_path / "a.pt", legacy=True)


def test_a_packed_archive_is_refused(tmp_path):
    """Zeros of a tensor take a thousandth of it on disk, and all of it once read."""
    numbers = bytes(4 << 20)
    archive(tmp_path / "a.pt", b"}X\x01\x00\x00\x00a" + b"".join(tensor(1 << 20)) + b"s", numbers)
    assert read_archive(tmp_path / "a.pt")["a"].shape == (1 << 20,)
    with zipfile.ZipFile(tmp_path / "a.pt") as plain, zipfile.ZipFile(tmp_path / "b.pt", "w") as packed:
        for name in plain.namelist():
            packed.writestr(name, plain.read(name), zipfile.ZIP_DEFLATED)
    with pytest.raises(ValueError, match="BadZipFile"):
        read_archive(tmp_path / "b.pt")


def test_two_files_of_one_name_are_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.pt", "w") as file:
        file.writestr("archive/data.pkl", b"\x80\x02}.")
        with pytest.warns(UserWarning, match="Duplicate"):
            file.writestr("archive/data.pkl", b"\x80\x02].")
    with pytest.raises(ValueError, match="RefusedArchive"):
        read_archive(tmp_path / "a.pt")
