"""Decoded frames of films on disk, where memory does not hold them all."""

import os
import shutil
import threading
import time

import pytest
import torch

from forewarp import files
from forewarp.data import films
from forewarp.data.films import STORE, Film, FilmStore, films_of
from forewarp.data.images import CACHE
from forewarp.data.module import MulticamDataModule
from tests.support.films import numbered, write_film
from tests.support.written_scenes import fixed_cameras, refused, write_multicam

COUNT, SIZE = 4, (24, 16)
BYTES = 3 * 24 * 16 * COUNT  # of a film


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """The root of a rig of two videos, which no test changes."""
    root = tmp_path_factory.mktemp("films")
    write_multicam(root / "toy", fixed_cameras(2), count=COUNT)
    return root


@pytest.fixture
def small(monkeypatch):
    """Memory that holds no frame, and a store that is set back."""
    monkeypatch.setattr(CACHE, "limit", 0)
    monkeypatch.setattr(STORE, "limit", STORE.limit)
    monkeypatch.setattr(STORE, "folder", None)


@pytest.fixture
def film(root, small):
    """A film by the first camera."""
    return film_at(root / "toy" / "cam00.mp4")


def film_at(path, count=COUNT):
    return Film(path, torch.arange(count).numpy() / 30, SIZE, 10**9)


def data_of(root, place, **options):
    """A data module whose frames do not fit into memory, and lie in ``place``."""
    data = MulticamDataModule(root, "toy", rays=8, cache_bytes=0, **options)
    data.frames_folder = place
    return data


def decoded_again(*_):
    raise AssertionError("a film was decoded again")


@pytest.mark.slow
def test_frames_are_the_same_as_from_memory_and_what_they_take_is_told_before(
    root, small, tmp_path, capsys, monkeypatch
):
    data = data_of(root, tmp_path / ".frames")
    data.setup("fit")
    told = capsys.readouterr().err
    assert told.startswith("frames  9.22e-06 GB for the decoded frames of 2 films, in ")
    assert f"frames 100% | {2 * COUNT}/{2 * COUNT} in 0:0" in told.splitlines()[-1]
    assert "assumed" not in data.scene.protocol
    frames = [*data.scene.train, *data.scene.test]
    monkeypatch.setattr(Film, "decoded", decoded_again)
    stored = [frame.load() for frame in frames]
    data_of(root, tmp_path / ".frames").setup()
    assert capsys.readouterr().err == ""  # another run shares them
    monkeypatch.undo()
    monkeypatch.setattr(CACHE, "limit", 10**9)
    for frame, image in zip(frames, stored):
        torch.testing.assert_close(frame.load(), image, rtol=0, atol=0)
    assert {path.suffix for path in (tmp_path / ".frames").iterdir()} == {".rgb", ".lock"}


def test_only_the_films_of_a_part_are_decoded_and_a_frame_decodes_its_own(root, small, tmp_path):
    data = data_of(root, tmp_path)
    data.setup("test")
    assert len([*tmp_path.glob("*.rgb")]) == 1
    data.scene.train[0].load()
    assert len([*tmp_path.glob("*.rgb")]) == 2


def test_where_all_frames_fit_into_memory_there_are_no_files(root, small, tmp_path):
    data = MulticamDataModule(root, "toy", rays=8)
    data.frames_folder = tmp_path / ".frames"
    data.setup("fit")
    data.scene.train[0].load()
    assert not (tmp_path / ".frames").exists()


def test_a_killed_process_leaves_finished_films_and_no_part_of_another(root, small, tmp_path, monkeypatch):
    store = FilmStore(tmp_path)
    both = [film_at(root / "toy" / f"cam0{k}.mp4") for k in range(2)]
    left = tmp_path / f".{both[1].key}.rgb.0123.part.rgb"
    left.write_bytes(b"half a frame")
    decoded, killed = Film.decoded, both[1]

    def killed_in_the_second(film, start, count):
        yield from decoded(film, start, 2 if film is killed else count)
        if film is killed:
            raise KeyboardInterrupt

    monkeypatch.setattr(Film, "decoded", killed_in_the_second)
    with pytest.raises(KeyboardInterrupt):
        store.fill(both)
    assert [path.stem for path in tmp_path.glob("*.rgb")] == [both[0].key]
    assert not left.exists()
    again = []
    monkeypatch.setattr(Film, "decoded", lambda film, *span: again.append(film) or decoded(film, *span))
    store.fill(both)
    assert again == [both[1]]
    assert [store.frame(film, 3).shape for film in both] == [(16, 24, 3)] * 2


def test_a_changed_video_and_another_size_have_frames_of_their_own(tmp_path, small):
    path, store = tmp_path / "cam00.mp4", FilmStore()
    write_film(path, numbered(COUNT, SIZE[::-1]))
    before = store.frame(first := film_at(path), 1).copy()
    os.utime(path, (1, 1))
    write_film(path, numbered(COUNT, SIZE[::-1], step=20))
    after = store.frame(film_at(path), 1)
    assert after[-1, -1, 0] > before[-1, -1, 0]
    assert Film(path, first.stamps, (12, 8), 0).key not in (first.key, film_at(path).key)


def test_a_longer_part_of_a_film_is_decoded_anew_and_a_shorter_one_is_not(root, small, tmp_path, monkeypatch):
    path, store = root / "toy" / "cam00.mp4", FilmStore(tmp_path)
    store.fill([film_at(path, 2)])
    whole = store.frame(film_at(path), 3)
    assert [len(file.read_bytes()) for file in tmp_path.glob("*.rgb")] == [BYTES]
    monkeypatch.setattr(Film, "decoded", decoded_again)
    store.fill([film_at(path, 3)])
    assert (store.frame(film_at(path), 3) == whole).all()


def test_a_file_that_was_cut_off_or_removed_is_made_again(film, tmp_path):
    store = FilmStore(tmp_path)
    expected = store.frame(film, 2)
    (file,) = tmp_path.glob("*.rgb")
    os.truncate(file, BYTES // 2)
    assert (store.frame(film, 2) == expected).all()
    file.unlink()
    assert (store.frame(film, 2) == expected).all()


def test_frames_that_came_with_a_scene_are_not_believed(film, tmp_path):
    expected = FilmStore(tmp_path).frame(film, 2)
    (file,) = tmp_path.glob("*.rgb")
    file.write_bytes(bytes(BYTES))  # as large as its own
    assert (FilmStore(tmp_path).frame(film, 2) == expected).all()
    other = FilmStore(tmp_path / "other")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / file.name).symlink_to(file)
    assert (other.frame(film, 2) == expected).all()
    assert not (tmp_path / "other" / file.name).is_symlink()
    store = FilmStore(tmp_path)
    assert (store.frame(film, 2) == expected).all()
    file.write_bytes(bytes(BYTES))
    os.utime(file, (1, 1))
    assert (store.frame(film, 2) == expected).all()
    (note,) = (files.own_folder() / "frames").glob(f"{film.key}.json")
    note.unlink()
    assert not FilmStore(tmp_path)._has(film)


def test_too_little_room_is_refused_in_a_line_and_nothing_is_written(film, tmp_path, monkeypatch):
    store = FilmStore(tmp_path, BYTES - 1)
    match = rf"disk_cache_bytes: expected at least {BYTES} .* of 1 film.*, but got {BYTES - 1};"
    with refused(match) as caught:
        store.fill([film])
    assert "raise it, set a larger data.scale or fewer data.frames, or 0 to seek" in str(caught.value)
    usage = shutil.disk_usage(tmp_path)._replace(free=films._RESERVE + BYTES - 1)
    monkeypatch.setattr(films.shutil, "disk_usage", lambda _: usage)
    with refused(r"but got 4.61e-06 GB free; set .*, or run=<a folder on a larger"):
        FilmStore(tmp_path).fill([film])
    assert [*tmp_path.iterdir()] == []
    with refused("data.disk_cache_bytes: expected a number"):
        store.resize(None, -1)


def test_files_that_nobody_uses_make_room_the_oldest_first(root, small, tmp_path):
    store = FilmStore(tmp_path, 3 * BYTES)
    old, middle, used = (tmp_path / f"{name * 24}.rgb" for name in "abc")
    foreign = tmp_path / "mine.txt"
    for age, path in ((9000, old), (8000, middle), (60, used), (9000, foreign)):
        path.write_bytes(bytes(BYTES))
        os.utime(path, (time.time() - age,) * 2)
    store.fill([film_at(root / "toy" / "cam00.mp4")])
    assert [path.exists() for path in (old, middle, used, foreign)] == [False, True, True, True]
    os.utime(middle)
    with refused("GB of it in use"):
        store.fill([film_at(root / "toy" / "cam01.mp4")])


def test_of_two_at_once_one_decodes_and_the_other_waits(root, small, tmp_path, monkeypatch):
    decoded, calls = Film.decoded, []
    entered, waits = threading.Event(), threading.Event()
    monkeypatch.setattr(films, "_WAIT_S", 0.01)

    def slowly(film, *span):
        calls.append(film)
        entered.set()
        assert waits.wait(10)
        yield from decoded(film, *span)

    monkeypatch.setattr(Film, "decoded", slowly)
    path = root / "toy" / "cam00.mp4"
    first = threading.Thread(target=FilmStore(tmp_path).fill, args=[[film_at(path)]])
    first.start()
    assert entered.wait(10)
    second = threading.Thread(target=FilmStore(tmp_path).fill, args=[[film_at(path)]])
    second.start()
    second.join(0.1)
    assert second.is_alive()
    waits.set()
    for thread in (first, second):
        thread.join(10)
    assert len(calls) == 1
    assert FilmStore(tmp_path).frame(film_at(path), 3).shape == (16, 24, 3)


def test_images_of_no_film_are_left_out(film):
    assert films_of([film.images[1], refused, film.images[0]]) == [film]
