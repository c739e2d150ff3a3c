from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.io import wavfile

pytest.importorskip("pycolmap", reason="no pycolmap; make install adds it")

from forewarp.capture import rig
from forewarp.capture.motion import Still, is_fixed
from forewarp.capture.poses import Search
from forewarp.capture.rig import Recording, Taken, choose, lost_of, offsets_of, recordings, span_of
from tests.capture.test_sync import tracks
from tests.support.captures import step
from tests.support.films import numbered, write_film


def film(name, count=30, rate=30.0, start=0.0):
    return Recording(name, None, start + np.arange(count) / rate)


FILMS = [film("a"), film("b", rate=25.0), film("c")]


@pytest.mark.parametrize(
    ("wanted", "offsets"),
    [
        ("none", [0, 0, 0]),
        (0, [0, 0, 0]),
        ([0, 0.5, 9, 1], [0, 0.5, 1]),
        ({"a": 2, "b": 1, "c": 0.5, "left_out": 7}, [2, 1, 0.5]),
    ],
)
def test_offsets_are_given_in_order_or_by_name_also_of_cameras_left_out(wanted, offsets):
    found, heard, _ = offsets_of(FILMS, wanted, ["a", "b", "left_out", "c"], step)
    assert found.tolist() == offsets
    assert heard is None


@pytest.mark.parametrize(
    ("wanted", "says"),
    [
        ([0, 1], "offsets: expected one of each of 3 cameras, but got 2"),
        ({"a": 0, "x": 1}, "offsets: expected names of a, b, c, but got x"),
        ({"a": 0, "b": 1}, "offsets: expected one of each camera, but got none of c; leave it out"),
        ([0, "x", 1], "offsets: seconds of b: expected a number, but got 'x'"),
        ("clap", "offsets: expected seconds for each camera, sound, none or null, but got 'clap'"),
    ],
)
def test_wrong_offsets_are_refused(wanted, says):
    with pytest.raises(ValueError, match=says):
        offsets_of(FILMS, wanted, ["a", "b", "c"], step)


def test_offsets_of_numbered_images_need_a_rate():
    with pytest.raises(ValueError, match="offsets: expected rate= beside them"):
        offsets_of(FILMS, [0, 1, 2], ["a", "b", "c"], step, is_timed=False)


def with_sound(path, sound):
    """A film with a track of 8000 samples a second."""
    file = path.with_suffix(".wav")
    wavfile.write(file, 8000, (32767 * np.clip(sound, -1, 1)).astype("<i2"))
    write_film(path, numbered(10), inputs=["-i", str(file), "-c:a", "aac"])


@pytest.mark.slow
def test_a_rig_of_films_is_heard_and_a_silent_one_is_named(tmp_path):
    """A film among them that heard another thing is named too; where none has sound, all begin together."""
    for name, sound in zip("abc", tracks([0.0, 0.25, 0.6], seconds=4.0)):
        with_sound(tmp_path / f"{name}.mp4", sound)
    films = recordings(tmp_path, None)
    names = [one.name for one in films]
    assert names == ["a", "b", "c"]
    found, heard, how = offsets_of(films, None, names, step)
    assert found == pytest.approx([0.0, 0.25, 0.6], abs=1e-3)
    assert heard.certainty.min() > 1.5
    assert how == "by sound"
    with_sound(tmp_path / "d.mp4", tracks([0.0], seconds=4.0, seed=5)[0])
    films = recordings(tmp_path, None)
    with pytest.raises(ValueError, match=r"a clap, but got . of 3 pairs that agree in d, .*without=\[d\]"):
        offsets_of(films, None, "abcd", step)
    write_film(tmp_path / "d.mp4", numbered(10))
    films = recordings(tmp_path, None)
    with pytest.raises(ValueError, match=r"expected sound in all videos, but got none in d; .*without=\[d\]"):
        offsets_of(films, None, "abcd", step)
    write_film(tmp_path / "e.mp4", numbered(10))
    silent = recordings(tmp_path, None, "abc")
    with pytest.raises(ValueError, match="expected sound in all videos, but got none in d and 1 more"):
        offsets_of(silent, "sound", "abcde", step)
    found, heard, how = offsets_of(silent, None, "abcde", step)
    assert found.tolist() == [0, 0]
    assert heard is None
    assert how.startswith("no camera has sound: taken to begin together")


def test_cameras_are_videos_else_folders_of_numbered_images(tmp_path):
    for name in ("one", "two"):
        for number in (1, 2, 4):
            (tmp_path / name / "images").mkdir(parents=True, exist_ok=True)
            Image.new("RGB", (8, 6)).save(tmp_path / name / "images" / f"{number:04d}.png")
    films = recordings(tmp_path, 10.0)
    assert [one.name for one in films] == ["one", "two"]
    assert films[0].stamps == pytest.approx([0.1, 0.2, 0.4])
    assert [image.stem for image in films[0].images] == ["0001", "0002", "0004"]
    assert [pixels.shape for pixels in films[0].pixels([0, 2], 4, None)] == [(3, 4, 3)] * 2
    for name in ("x 10.mp4", "x 2.mp4"):
        write_film(tmp_path / name, numbered(3))
    assert [one.name for one in recordings(tmp_path, None)] == ["x 2", "x 10"]


def test_frames_that_are_sought_are_those_asked_for_where_the_rate_varies(tmp_path, monkeypatch):
    """Some frames follow the one before them after a fifth of the usual time."""
    for name in "ab":
        write_film(tmp_path / f"{name}.mp4", numbered(12, step=20), stamps="N*40-32*floor(N/5)")
    film, rows = recordings(tmp_path, None)[0], [0, 5, 10]
    monkeypatch.setattr(rig, "_SEEK", 1)
    greys = [int(pixels[-1, -1, 0]) for pixels in film.pixels(rows, None, None)]
    assert greys == pytest.approx([20 * row for row in rows], abs=4)


def test_what_is_left_out_is_not_looked_at(tmp_path):
    """A file that is no video can be left out, as its refusal says; offsets still count it."""
    for name in "ac":
        write_film(tmp_path / f"{name}.mp4", numbered(3))
    (tmp_path / "b.mp4").write_bytes(b"no film")
    assert list(rig.cameras_in(tmp_path)) == ["a", "b", "c"]
    assert [one.name for one in recordings(tmp_path, None, ["b"])] == ["a", "c"]
    with pytest.raises(ValueError, match="offsets: expected one of each of 3 cameras, but got 1"):
        rig.capture_rig(tmp_path, tmp_path.parent / "out", Search(), step, without=["b"], offsets=[0])


def test_a_folder_called_as_videos_are_is_no_camera_left_out_without_a_word(tmp_path):
    for number in range(2):
        (tmp_path / f"cam{number}.mp4").touch()
    for name in ("frames", "cam1"):  # of other use, and what was made of a video
        (tmp_path / name).mkdir()
    assert list(rig.cameras_in(tmp_path)) == ["cam0", "cam1"]
    (tmp_path / "cam02").mkdir()
    with pytest.raises(
        ValueError, match="a video for each camera, as cam0, .* but got the folder cam02 beside"
    ):
        rig.cameras_in(tmp_path)


def test_masks_beside_the_films_of_a_rig_are_no_cameras(tmp_path):
    for name in ("cam0", "cam1", "cam1_mask", "cam1_flow"):
        write_film(tmp_path / f"{name}.mp4", numbered(3))
    (tmp_path / "cam0_depth").mkdir()
    assert list(rig.cameras_in(tmp_path)) == ["cam0", "cam1"]
    first, second = recordings(tmp_path, None, ["cam1_mask"])
    assert first.told == [f"{tmp_path}: cam0_depth and 2 more are left out, as what goes with cam0.mp4"]
    assert second.told == []


def test_images_of_another_size_than_a_cameras_first_are_named(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
        for number in range(3):
            Image.new("RGB", (80 + (number == 2), 64)).save(tmp_path / name / f"{number}.png")
    film = recordings(tmp_path, None)[0]
    with pytest.raises(ValueError, match=r"2.png: expected 80 x 64 pixels as 0.png, but got 81 x 64;.*\[a\]"):
        list(film.pixels([2], None, None))


@pytest.mark.parametrize(
    ("files", "without", "says"),
    [
        ([], [], "videos: expected at least two videos, or sub-folders of pictures, in .* but got none"),
        (["a.mp4"], [], "but got one, a; for one camera set video="),
        (["a.mp4", "b.mp4"], ["c"], "without: expected names of a, b, but got c"),
        (["a.mp4", "b.mp4"], ["b"], "without: expected at least two cameras left, but got 1 of 2"),
        (["a.mp4", "a.mkv"], [], "expected a video for each camera, but got a.mkv and a.mp4"),
        (["a.mp4", "b.mp4"], [], r"expected many frames, but got another file; leave it out .*\[a\]"),
    ],
)
def test_folders_that_are_no_rig_are_refused(tmp_path, files, without, says):
    for file in files:
        (tmp_path / file).write_bytes(b"no film")
    with pytest.raises(ValueError, match=says):
        recordings(tmp_path, None, without)


def test_the_span_is_where_all_film_or_else_most_do():
    long = [film(name, 300) for name in "abc"]
    assert span_of(long, np.array([0, 1, 2.0]))[:2] == pytest.approx((2.0, 299 / 30))
    *span, line = span_of([*long, film("short", 30)], np.array([0, 1, 2.0, 0.0]))
    assert span == pytest.approx([2.0, 299 / 30])
    assert line == "short film only a part of the time that the others share"
    with pytest.raises(ValueError, match=r"in time, but got a until 9.97 s and b from 20.00 s on.*\[b\]"):
        span_of(long[:2], np.array([0, 20.0]))


def test_frames_keep_their_times_and_belong_to_the_nearest_instant():
    films, offsets = [film("a", 10), film("b", 10, rate=29.0)], np.array([0.0, 0.043])
    (first, second), why = choose(films, offsets, span_of(films, offsets)[:2], None)
    assert why == "every frame of short films"
    assert first.rows == [2, 3, 4, 5, 6, 7, 8, 9]
    assert second.rows == [0, 1, 2, 3, 4, 5, 6, 7]
    assert second.times == pytest.approx(0.043 + np.arange(8) / 29)
    assert first.moments == list(range(1, 9))  # before its first frame in the span is one of the other's
    apart = (np.array(second.moments) + 1) / 30 - second.times
    assert np.abs(apart).max() <= 0.5 / 29 + 1e-9
    chosen, why = choose([film("a", 4000), film("b", 4000)], np.zeros(2), (0.0, 3999 / 30), None)
    assert [len(taken.rows) for taken in chosen] == [300, 300]
    assert why == "300 instants of up to 4000; frames= takes more"
    assert choose(films, offsets, (0.1, 0.3), 4)[0][1].moments == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="expected frames in the common time, but got none of a"):
        choose(films, offsets, (0.304, 0.306), 4)


def test_instants_are_those_of_a_film_that_runs_all_the_while():
    """The first film ends early; another has twice the rate, but begins late."""
    films = [film("a", 20), *(film(name, 120) for name in "bcdefg"), film("h", 140, 60.0, start=1.0)]
    *others, late = choose(films, np.zeros(8), span_of(films, np.zeros(8))[:2], None)[0]
    for taken in others:
        assert taken.moments == taken.rows
    assert len(late.rows) > 120
    apart = np.array(late.moments) / 30 - late.times
    assert np.abs(apart).max() <= 0.5 / 30 + 1e-9


def textured(shift=0, seed=0):
    image = np.random.default_rng(seed).integers(0, 256, (40, 60, 3)).astype(np.uint8)
    return np.roll(image.repeat(6, 0).repeat(6, 1), shift, 1)


@pytest.mark.slow
def test_a_camera_stands_though_something_moves_and_the_light_changes():
    still, frames = textured(), []
    for n in range(9):
        frame = (0.9 * still + 3 * n).clip(0, 255).astype(np.uint8)
        frame[60:160, 30 * n : 30 * n + 60] = 255 - n
        frames.append(frame)
    assert is_fixed(frames)
    assert not is_fixed([textured(3 * n) for n in range(9)])
    moves = Still.of(frames).moves(frames[4])
    assert moves.shape == (240, 360)
    assert moves[65:155, 125:175].mean() > 0.95
    assert moves[:, 200:].mean() + moves[170:].mean() < 0.02


def test_a_camera_with_poses_of_few_frames_is_lost_and_named():
    looks = ["a/1", "a/2", "a/3"], ["b/1"], ["c/1"]
    taken = [Taken(film, [], [], [], names) for film, names in zip(FILMS, looks)]
    matches = {"a": (12, "b"), "b": (40, "c"), "c": (40, "b")}
    found = SimpleNamespace(cameras=dict.fromkeys(["a/2", "b/1", "c/1"]))
    with pytest.raises(ValueError, match=r"a: expected a camera .* 12 matches at most, with b; .*\[a\]"):
        lost_of(taken, found, matches, False)
    assert lost_of(taken, found, matches, True) == ["a"]
    found.cameras.pop("b/1")
    with pytest.raises(ValueError, match=r"with b \(and b\); leave it out \(without=\[a,b\]\)"):
        lost_of(taken, found, matches, True)  # one camera is no rig


def test_who_says_what_moves_is_told_though_one_film_has_no_flow(tmp_path, monkeypatch):
    work = SimpleNamespace(folder=tmp_path, masks=None, take=lambda *_: None)
    (tmp_path / "masks").mkdir()
    flows = iter([[np.ones((3, 4), bool)], None])
    monkeypatch.setattr(rig, "moving_masks", lambda *_: next(flows))
    films = [SimpleNamespace(name=name) for name in "ab"]
    alike = {"is_fixed": False, "rows": [0], "times": [0.0], "moments": [0]}
    taken = [SimpleNamespace(film=f, names=[f.name], looks=[f.name], **alike) for f in films]
    found = SimpleNamespace(cameras={"a": "first", "b": "second"})
    images, cameras = rig._frames_of(work, taken, found, "few", step)
    assert (images.masks, images.masks_from, cameras) == (None, "optical flow", found.cameras)
