import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from forewarp.capture.refusals import BLURRED
from forewarp.capture.video import extracted, measure
from tests.support.films import numbered, write_film


def quiet(done, total):
    assert 0 <= done <= total


def number_of(picture):
    """The number of a frame of ``numbered``: its darkest quarter tells."""
    return round(float(np.median(picture[picture < 200])) / 8)


@pytest.mark.parametrize("stamps", ["N*40", "N*(N+1)*10", "500+N*100"], ids=["even", "uneven", "late"])
def test_stamps_are_the_videos_own_from_the_first_frame(tmp_path, stamps):
    film = write_film(tmp_path / "a.mp4", numbered(9), stamps=stamps)
    expected = np.array([eval(stamps, {"N": n}) for n in range(9)]) / 1000
    np.testing.assert_allclose(measure(film, quiet).stamps, expected - expected[0], atol=1e-6)


@pytest.mark.parametrize("stamps", ["N*40", "N*(N+1)*10"], ids=["even", "uneven"])
def test_the_frames_asked_for_come(tmp_path, stamps):
    film = write_film(tmp_path / "a.mp4", numbered(24), stamps=stamps)
    chosen = [0, 3, 4, 11, 23]
    assert [number_of(picture) for picture in extracted(film, chosen, None)] == chosen


def test_hundreds_of_frames_can_be_chosen(tmp_path):
    film = write_film(tmp_path / "a.mp4", numbered(400, size=(16, 16), step=0))
    assert len(list(extracted(film, list(range(0, 400, 2)), None))) == 200


@pytest.mark.parametrize(
    ("rotation", "size", "bright"),
    [(0, (48, 64), "tl"), (90, (64, 48), "bl"), (-90, (64, 48), "tr"), (180, (48, 64), "br")],
)
def test_frames_are_turned_upright(tmp_path, rotation, size, bright):
    film = write_film(tmp_path / "a.mp4", numbered(3), rotation=rotation)
    (picture,) = extracted(film, [1], None)
    assert picture.shape == (*size, 3)
    rows = slice(2, 10) if bright[0] == "t" else slice(-10, -2)
    columns = slice(2, 10) if bright[1] == "l" else slice(-10, -2)
    assert picture[rows, columns].min() > 230
    assert len(measure(film, quiet).stamps) == 3


@pytest.mark.parametrize(("size", "shape"), [(None, (48, 64, 3)), (32, (24, 32, 3)), (500, (48, 64, 3))])
def test_frames_are_made_smaller_never_larger(tmp_path, size, shape):
    film = write_film(tmp_path / "a.mp4", numbered(2))
    assert [picture.shape for picture in extracted(film, [0, 1], size)] == [shape] * 2


def test_blurred_frames_measure_as_blurred(tmp_path):
    rng = np.random.default_rng(0)
    sharp = rng.integers(0, 256, (60, 80, 3), np.uint8).repeat(4, 0).repeat(4, 1)
    soft = np.mean([np.roll(sharp, shift, 1) for shift in range(13)], 0).astype(np.uint8)
    found = measure(write_film(tmp_path / "a.mp4", np.stack([sharp, soft, sharp])), quiet)
    assert found.sharp[1] < 0.5 * min(found.sharp[0], found.sharp[2])
    assert found.widths[1] > 1.3 * max(found.widths[0], found.widths[2])


@pytest.mark.parametrize(("blur", "seen"), [(0, False), (1, False), (4, True), (8, True)])
def test_a_films_blur_is_seen_whatever_the_codec_adds(tmp_path, blur, seen):
    """Coded as strongly as phones and web sites do."""
    rng = np.random.default_rng(0)
    sharp = rng.integers(0, 256, (24, 32, 3)).repeat(20, 0).repeat(20, 1).astype(float)
    film = np.stack([gaussian_filter(np.roll(sharp, 3 * i, 1), (blur, blur, 0)) for i in range(3)])
    path = write_film(tmp_path / "a.mp4", film.astype(np.uint8), options=("-qp", "28"))
    assert (np.median(measure(path, quiet).widths) > BLURRED) == seen


def cut(path, share):
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    return path


def noise(count):
    return np.random.default_rng(0).integers(0, 256, (count, 48, 64, 3), np.uint8)


def sound(path):
    tone = ["-f", "lavfi", "-i", "sine=duration=1", "-c:a", "aac", str(path)]
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *tone], check=True)
    return path


FAST = ("-movflags", "faststart")


def with_sound(path, seconds):
    """The film and a tone of so many seconds."""
    tone = ["-f", "lavfi", "-i", f"sine=duration={seconds}", "-map", "0:v", "-map", "1:a", "-c:v", "copy"]
    made = path.with_name(f"with_sound_{path.name}")
    call = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path), *tone, *FAST, str(made)]
    subprocess.run(call, check=True)
    return made


def test_sound_may_go_on_after_the_last_frame(tmp_path):
    film = with_sound(write_film(tmp_path / "a.mp4", noise(50)), 3)
    assert len(measure(film, quiet, threads=1).stamps) == 50


BROKEN = {
    "text": (lambda p: p.write_text("no video") and p, "expected a video, but got another file"),
    "empty": (lambda p: p.touch() or p, "expected a video, but got another file"),
    "sound": (sound, "expected a video, but got sound alone"),
    "one frame": (lambda p: write_film(p, numbered(1)), "expected a video of many frames, but got one frame"),
    "no end": (lambda p: cut(write_film(p, noise(9)), 0.5), "expected a video, but got one that was cut off"),
    "no rest": (
        lambda p: cut(write_film(p, noise(50), options=FAST), 0.5),
        "expected 2.0 seconds, as its header says, but got",
    ),
    "no rest, with sound": (
        lambda p: cut(with_sound(write_film(p, noise(50)), 3), 0.5),
        "expected 3.0 seconds, as its header says, but got",
    ),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_what_is_no_whole_video_is_refused(tmp_path, kind):
    make, says = BROKEN[kind]
    with pytest.raises(ValueError, match=says):
        measure(make(tmp_path / "a.mp4"), quiet)


def test_ffmpeg_takes_no_more_threads_than_it_is_given(tmp_path, monkeypatch):
    film = write_film(tmp_path / "a.mp4", numbered(3))
    calls, popen = [], subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda call, **rest: calls.append(call) or popen(call, **rest))
    measure(film, quiet, threads=1)
    list(extracted(film, [1], None, threads=1))
    for call in calls:
        given = {call[i + 1] for i, word in enumerate(call) if word in ("-threads", "-filter_threads")}
        assert given == {"1"}
    assert len(calls) == 2
