import pytest
from filelock import FileLock

from forewarp.capture.workplace import workplace

ABOUT = {"video": "a.mp4", "frames": 12}


def work(out, about, error=None):
    """Enter, note what is there, leave a file, and end as asked."""
    with workplace(out, about) as place:
        there = sorted(path.name for path in place.iterdir())
        (place / "frames").touch()
        if error is not None:
            raise error
        out.mkdir(exist_ok=True)
    return there


def test_it_is_gone_at_the_end(tmp_path):
    assert work(tmp_path / "new" / "hand", ABOUT) == ["about.json"]
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["hand"]


@pytest.mark.parametrize("error", [ValueError("a: expected b, but got c"), ImportError("no")])
def test_a_refusal_leaves_nothing(tmp_path, error):
    with pytest.raises(type(error)):
        work(tmp_path / "new" / "hand", ABOUT, error)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "error",
    [KeyboardInterrupt(), OSError("full"), RuntimeError("a bug"), ValueError("shapes (2,) (3,) not aligned")],
)
def test_what_was_interrupted_goes_on(tmp_path, error):
    with pytest.raises(type(error)):
        work(tmp_path / "hand", ABOUT, error)
    assert work(tmp_path / "hand", ABOUT) == ["about.json", "frames"]


def test_other_work_begins_anew(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        work(tmp_path / "hand", ABOUT, KeyboardInterrupt())
    assert work(tmp_path / "hand", ABOUT | {"frames": 13}) == ["about.json"]


def test_two_at_once_are_refused(tmp_path):
    with workplace(tmp_path / "hand", ABOUT) as place:
        with (
            pytest.raises(ValueError, match="expected one capture at a time"),
            workplace(tmp_path / "hand", ABOUT),
        ):
            pass
        assert place.is_dir()


def test_the_next_call_keeps_what_it_begins(tmp_path, monkeypatch):
    """It may begin as soon as the lock is free; the folder of the one before is removed by then."""
    free, there = FileLock.release, []
    monkeypatch.setattr(
        FileLock, "release", lambda lock, *a, **k: (there.extend(tmp_path.iterdir()), free(lock, *a, **k))
    )
    work(tmp_path / "hand", ABOUT)
    assert there[:1] == [tmp_path / "hand"]
