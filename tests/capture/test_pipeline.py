from unittest.mock import Mock

import pytest
from filelock import FileLock

pytest.importorskip("pycolmap", reason="no pycolmap; make install adds it")

from forewarp.capture import pipeline
from forewarp.capture.frames import Frames, Source
from forewarp.capture.pipeline import capture, keep, work_folder
from forewarp.capture.poses import Search, TooFewRegistered
from tests.support.captures import step

ABOUT = {"video": "a.mp4", "frames": 12}


def work(out, about=ABOUT, error=None):
    """Enter, note what is there, leave a file, and end as asked."""
    with work_folder(out, about) as folder:
        there = sorted(path.name for path in folder.iterdir())
        (folder / "frames").touch()
        if error is not None:
            raise error
        out.mkdir(exist_ok=True)
    return there


def test_it_is_gone_at_the_end_and_the_next_call_keeps_what_it_begins(tmp_path, monkeypatch):
    """That may begin as soon as the lock is free; the folder of the one before is removed by then."""
    free, there = FileLock.release, []

    def release(lock, *arguments, **options):
        there.extend((tmp_path / "new").iterdir())
        free(lock, *arguments, **options)

    monkeypatch.setattr(FileLock, "release", release)
    assert work(tmp_path / "new" / "hand") == ["about.json"]
    assert there[:1] == [tmp_path / "new" / "hand"]
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["hand"]


@pytest.mark.parametrize("error", [ValueError("a: expected b, but got c"), ImportError("no")])
def test_a_refusal_leaves_nothing(tmp_path, error):
    with pytest.raises(type(error)):
        work(tmp_path / "new" / "hand", error=error)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "error",
    [KeyboardInterrupt(), OSError("full"), RuntimeError("a bug"), ValueError("shapes (2,) (3,) not aligned")],
)
def test_what_was_interrupted_goes_on_but_other_work_begins_anew(tmp_path, error):
    with pytest.raises(type(error)):
        work(tmp_path / "hand", error=error)
    with pytest.raises(type(error)):
        work(tmp_path / "other", error=error)
    assert work(tmp_path / "hand") == ["about.json", "frames"]
    assert work(tmp_path / "other", ABOUT | {"frames": 13}) == ["about.json"]


def test_two_at_once_are_refused(tmp_path):
    with work_folder(tmp_path / "hand", ABOUT) as folder:
        with pytest.raises(ValueError, match="expected one capture at a time"):
            work(tmp_path / "hand")
        assert folder.is_dir()


def test_what_was_kept_stays_until_the_new_is_whole(tmp_path):
    best, full = tmp_path / "best", Mock(write=Mock(side_effect=OSError("full")))
    best.mkdir()
    (best / "images.bin").touch()  # of an older version, without a mark
    with pytest.raises(OSError, match="full"):
        keep(tmp_path, full, {"error": 1.0})
    assert [path.name for path in best.iterdir()] == ["images.bin"]
    for name in ("first.bin", "second.bin"):
        keep(tmp_path, Mock(write=lambda folder, name=name: (folder / name).touch()), {"error": 1.0})
        assert sorted(path.name for path in tmp_path.rglob("*")) == ["best", "error.json", name]


def test_a_film_whose_poses_fail_is_tried_with_more_frames(tmp_path, monkeypatch):
    (tmp_path / "a.mp4").touch()
    tried = []

    def take(work, source, step, count, threads, why="none"):
        (work / "pictures.json").touch()
        names = [f"{i:03d}" for i in range(count or 200)]
        return Frames(work, None, dict.fromkeys(names, 0.0), range(len(names)), 600, 2.0, {}, {}, why=why)

    def find_poses(work, images, *_):
        tried.append((len(images.times), images.why))
        raise TooFewRegistered(f"poses: expected most, but got few of {len(images.times)}")

    monkeypatch.setattr(pipeline, "take", take)
    monkeypatch.setattr(pipeline, "find_poses", find_poses)
    for frames, expected in ((None, [200, 400]), (50, [50])):
        tried.clear()
        with pytest.raises(ValueError, match=f"few of {expected[-1]}"):
            capture(Source(video=tmp_path / "a.mp4"), tmp_path / "out", Search(), step, frames=frames)
        assert [count for count, _ in tried] == expected
        assert [why for _, why in tried][1:] == [pipeline._AGAIN] * (len(expected) - 1)
