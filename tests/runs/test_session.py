"""A run's folder has one process at a time; who it is may be unreadable, the refusal is not."""

import os

import pytest

from forewarp.data.files import LOCK
from forewarp.runs.session import locked


@pytest.mark.parametrize("holder", [None, b"", b"\xff\xfe\x00", b"x" * 5000])
def test_the_second_is_refused_whatever_the_file_says(tmp_path, holder):
    with locked(tmp_path / "run"):
        path = tmp_path / "run" / LOCK
        assert path.read_text().startswith(f"process {os.getpid()} on ")
        path.unlink() if holder is None else path.write_bytes(holder)
        with pytest.raises(ValueError, match="nobody works on, but got one of .+; wait for it"):
            locked(tmp_path / "run").__enter__()
    with locked(tmp_path / "run"):
        pass


def test_a_folder_that_cannot_be_written_names_the_key(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="run: ") as caught, locked(tmp_path / "file" / "run"):
        pass
    assert str(caught.value.filename).startswith("run: ")
    with locked(tmp_path / "run"):
        pass
