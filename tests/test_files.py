"""Files appear whole or not at all, and are read only up to a size."""

import errno
import os

import pytest
from omegaconf import OmegaConf

from forewarp.files import (
    check_replaceable,
    folder_written_whole,
    load_json,
    load_yaml,
    read_json,
    read_text,
    replace_file,
    write_json,
    written_whole,
)


def test_a_file_appears_whole_with_its_folder(tmp_path):
    path = tmp_path / "new" / "a.json"
    write_json(path, {"a": 1})
    assert read_json(path) == {"a": 1}
    replace_file(path, "{}")
    assert read_json(path) == {}
    assert [p.name for p in path.parent.iterdir()] == ["a.json"]


def test_what_fails_leaves_the_old_file_and_nothing_beside(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), written_whole(path) as beside:
        beside.write_text("half") // 0
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_an_error_names_the_file_that_it_is_of(tmp_path):
    def full(*name):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), *name)

    path = tmp_path / "a.txt"
    for name in ((), ("/tmp/of-a-library",)):
        with pytest.raises(OSError, match="No space left") as caught, written_whole(path):
            full(*name)
        assert caught.value.filename == str(path)
    with pytest.raises(FileNotFoundError) as caught, written_whole(path):
        (tmp_path / "other").read_text()
    assert caught.value.filename == str(tmp_path / "other")


def test_a_folder_that_does_not_fit_names_the_file_that_would_have_been(tmp_path):
    with (
        pytest.raises(OSError, match="No space left") as caught,
        folder_written_whole(tmp_path / "out", "m") as part,
    ):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(part / "a" / "b"))
    assert caught.value.filename == str(tmp_path / "out" / "a" / "b")
    with pytest.raises(FileNotFoundError) as caught, folder_written_whole(tmp_path / "out", "m"):
        (tmp_path / "other").read_text()
    assert caught.value.filename == str(tmp_path / "other")
    assert list(tmp_path.iterdir()) == []


def test_numbers_that_json_has_not_are_refused(tmp_path):
    with pytest.raises(ValueError, match="nan"):
        write_json(tmp_path / "a.json", {"a": float("nan")})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["{", "[1]", "\ufffe", "[" * 100_000])
def test_what_is_no_object_is_none(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_text(text)
    assert read_json(path) is None
    with pytest.raises(ValueError, match=f"{path}: .*expected"):
        load_json(path)


@pytest.mark.parametrize("name", ["a.json", "a.yaml"])
def test_a_number_that_fits_no_float_is_refused(tmp_path, name):
    path, load = tmp_path / name, load_json if name == "a.json" else load_yaml
    path.write_text('{"a": 1%s, "b": [-2]}' % ("0" * 307))
    assert load(path) == {"a": 10**307, "b": [-2]}
    path.write_text('{"a": -1%s}' % ("0" * 400))
    with pytest.raises(
        ValueError, match=r"expected .*(at most 308.*402: -10000|402 digits, -10000.*at most 308)"
    ):
        load(path)


def test_yaml_is_read_as_omegaconf_reads_it(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(f"a: 1e-3\nb: 2020-01-01\nc: {'../x' * 99}\nd: 1_0e5\ne: 1e\n'1': x\n")
    assert load_yaml(path) == OmegaConf.to_container(OmegaConf.load(path))
    path.write_text("a: 1\nb:\n  c: 1\n  c: 2\n")
    with pytest.raises(ValueError, match="a.yaml: expected YAML, but got the key 'c' twice in line 4"):
        load_yaml(path)


def test_nothing_is_read_of_a_file_that_is_too_large_or_no_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("12345")
    assert read_text(path, 5) == "12345"
    with pytest.raises(ValueError, match="expected at most 4 bytes, but got 5"):
        read_text(path, 4)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="a device or a pipe"):
        read_text(tmp_path / "pipe")
    with pytest.raises(IsADirectoryError):
        read_text(tmp_path)


def fill(part, content):
    (part / "in").mkdir()
    (part / "in" / content).touch()
    write_json(part / "mark", {"bytes": {f"in/{content}": 0}})


def files_in(path):
    return sorted(file.relative_to(path).as_posix() for file in path.rglob("*") if file.is_file())


def test_a_folder_appears_whole_and_nothing_stays_beside(tmp_path):
    path = tmp_path / "made" / "here"
    with pytest.raises(ZeroDivisionError), folder_written_whole(path, "mark") as part:
        (part / "half").write_text("half") // 0
    assert list(tmp_path.iterdir()) == []
    for content in ("one", "two"):
        with folder_written_whole(path, "mark") as part:
            fill(part, content)
            assert not (path / "in" / content).exists()
        assert files_in(path.parent) == [f"here/in/{content}", "here/mark"]
    with pytest.raises(ZeroDivisionError), folder_written_whole(path, "mark") as part:
        (part / "half").write_text("half") // 0
    assert files_in(path.parent) == ["here/in/two", "here/mark"]
    assert path.stat().st_mode == path.parent.stat().st_mode


def test_two_calls_for_one_folder_do_not_disturb_each_other(tmp_path):
    path = tmp_path / "here"
    with folder_written_whole(path, "mark") as part:
        with folder_written_whole(path, "mark") as other:
            fill(other, "other")
        fill(part, "this")
    assert files_in(tmp_path) == ["here/in/this", "here/mark"]  # the last to end


def test_the_old_folder_stays_if_the_new_one_cannot_take_its_place(tmp_path, monkeypatch):
    path, replace = tmp_path / "here", os.replace
    with folder_written_whole(path, "mark") as part:
        fill(part, "old")

    def fails(source, target):
        if source.is_dir() and target == path and source.suffix == ".part":
            raise OSError(errno.EIO, "Input/output error")
        replace(source, target)

    monkeypatch.setattr(os, "replace", fails)
    with pytest.raises(OSError, match="Input/output"), folder_written_whole(path, "mark") as part:
        fill(part, "new")
    assert files_in(tmp_path) == ["here/in/old", "here/mark"]


def test_what_a_killed_call_left_is_put_back_or_cleared(tmp_path):
    path, left = tmp_path / "here", tmp_path / ".here.0.part"
    with folder_written_whole(tmp_path / ".here.before", "mark") as part:
        fill(part, "old")
    left.mkdir()
    os.utime(left, (0, 0))
    with pytest.raises(ZeroDivisionError), folder_written_whole(path, "mark") as part:
        part.write_text("half") if left.exists() else 1 // 0
    assert files_in(tmp_path) == ["here/in/old", "here/mark"]


def test_only_a_folder_of_ours_is_replaced(tmp_path):
    path = tmp_path / "here"
    with folder_written_whole(path, "mark") as part:
        fill(part, "one")
    check_replaceable(path, "mark")
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "a").touch()
    (tmp_path / "link").symlink_to(path)
    (path / "in" / "notes").touch()
    refused = {"theirs": "a in it", "link": "a file or", "theirs/a": "a file or", "here": "in/notes"}
    for other, got in refused.items():
        with pytest.raises(ValueError, match=f"expected no folder, an empty one, or .* before.*{got}"):
            check_replaceable(tmp_path / other, "mark")
