import resource
import zipfile

import pytest
import torch

from forewarp.training.checkpoints import read_archive, write_archive

CONTENT = {"a": torch.arange(1000.0), "b": {"c": [1, "x", None]}}


def test_what_is_written_is_read(tmp_path):
    write_archive(tmp_path / "deep" / "a.pt", CONTENT)
    found = read_archive(tmp_path / "deep" / "a.pt")
    assert torch.equal(found["a"], CONTENT["a"])
    assert found["b"] == CONTENT["b"]
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a.pt"]


def test_a_full_disk_is_told_and_leaves_what_was_there(tmp_path):
    path = tmp_path / "a.pt"
    write_archive(path, {"a": 1})
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, before[1]))
    try:
        with pytest.raises(OSError, match="File too large") as refusal:
            write_archive(path, CONTENT)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert refusal.value.filename == str(path)
    assert read_archive(path) == {"a": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["a.pt"]


def test_a_packed_archive_is_not_unpacked(tmp_path):
    """Zeros of 64 MB in a file of 64 KB."""
    torch.save({"a": torch.zeros(1 << 24)}, tmp_path / "plain.pt")
    with (
        zipfile.ZipFile(tmp_path / "plain.pt") as plain,
        zipfile.ZipFile(tmp_path / "a.pt", "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for name in plain.namelist():
            packed.writestr(name, plain.read(name))
    assert torch.load(tmp_path / "a.pt", weights_only=True)["a"].shape == (1 << 24,)  # torch would
    with pytest.raises(ValueError, match="BadZipFile"):
        read_archive(tmp_path / "a.pt")


def test_no_tensor_is_larger_than_the_file(tmp_path):
    torch.save({"a": [{"b": torch.zeros(1).expand(400, 1000, 1000)}]}, tmp_path / "a.pt")
    with pytest.raises(ValueError, match="TypeError"):
        read_archive(tmp_path / "a.pt")
    torch.save({"a": torch.zeros(6, 5).T, "b": torch.zeros(0, 3)}, tmp_path / "a.pt")
    assert read_archive(tmp_path / "a.pt")["a"].shape == (5, 6)


@pytest.mark.parametrize("content", [b"", b"nonsense", [1], torch.zeros(3), {"a": torch.eye(3).to_sparse()}])
def test_what_is_no_such_file_is_refused(tmp_path, content):
    if isinstance(content, bytes):
        (tmp_path / "a.pt").write_bytes(content)
    else:
        torch.save(content, tmp_path / "a.pt")
    with pytest.raises(ValueError, match="^[A-Z]\\w+$"):
        read_archive(tmp_path / "a.pt")
    with pytest.raises(FileNotFoundError):
        read_archive(tmp_path / "b.pt")
