"""Kernels are kept where a folder can be written by this user alone."""

import tempfile

import pytest

numba = pytest.importorskip("numba")

from forewarp.ops.kernels import keeping  # noqa: E402


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """No folder of Numba's own can be written; the temporary one can."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(keeping, "can_keep", lambda: numba.config.CACHE_DIR != "")
    return tmp_path


def test_without_a_folder_of_its_own_they_lie_in_the_users_below_the_temporary_one(temporary, capsys):
    assert keeping.keep()
    (folder,) = temporary.iterdir()
    assert (numba.config.CACHE_DIR, folder.stat().st_mode & 0o777) == (str(folder), 0o700)
    assert capsys.readouterr().err == f"kernels: kept in {folder}, as no other folder can be written\n"


@pytest.mark.parametrize("kind", ["open to all", "a link", "a file"])
def test_a_folder_that_others_may_have_filled_is_left_alone(temporary, capsys, kind):
    folder = keeping.private_folder()
    if kind == "open to all":
        folder.chmod(0o777)
    else:
        folder.rmdir()
        folder.symlink_to(temporary) if kind == "a link" else folder.touch()
    assert not keeping.keep()
    assert "compiled anew by each process" in capsys.readouterr().err


def test_numba_is_asked_for_its_own_folders(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    assert keeping.can_keep()
    assert [*tmp_path.iterdir()] != []
