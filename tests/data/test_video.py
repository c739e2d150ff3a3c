"""Videos: the times of their frames, and frames from the middle."""

import subprocess
from types import SimpleNamespace

import imageio_ffmpeg
import numpy as np
import pytest

from forewarp.capture.frames import measure
from forewarp.data import video
from forewarp.data.files import SceneError
from forewarp.data.video import converted, doubts_of, extracted, header_of, stamps_of
from tests.support.films import numbered, write_film, write_planes


@pytest.mark.slow
@pytest.mark.parametrize("late", [0, 500])
def test_frames_from_any_time_on_are_those_of_the_whole_video(tmp_path, late):
    film = write_film(tmp_path / "a.mp4", numbered(12), stamps=f"{late}+N*40+mod(N\\,2)*10")
    stamps = stamps_of(film)
    np.testing.assert_allclose(np.diff(stamps), [0.05, 0.03] * 5 + [0.05], atol=1e-6)
    images = list(extracted(film, None, None))
    assert len(images) == 12
    for n in (0, 5, 11):
        np.testing.assert_array_equal(next(extracted(film, None, None, start=stamps[n] - 0.01)), images[n])


@pytest.mark.parametrize("chosen", [[0], [7], [0, 1, 2, 5, 11], [3, 4, 9]])
@pytest.mark.parametrize("most_told", [100, 0])
def test_the_frames_that_are_chosen_are_given(tmp_path, monkeypatch, chosen, most_told):
    """Many are chosen here, as a command has no room for their numbers."""
    monkeypatch.setattr(video, "_MOST_TOLD", most_told)
    write_film(tmp_path / "a.mp4", numbered(12, step=20))
    greys = [int(frame[-1, -1, 0]) for frame in extracted(tmp_path / "a.mp4", chosen, None)]
    assert greys == pytest.approx([20 * n for n in chosen], abs=4)


def test_a_video_that_does_not_store_the_time_of_each_frame_is_refused(tmp_path):
    coded = ["-c:v", "mpeg4", "-bf", "2", "-vtag", "XVID"]
    film = write_film(tmp_path / "a.avi", numbered(12), options=coded)
    with pytest.raises(SceneError, match="avi: expected a time stamp of each frame, but got .* without"):
        stamps_of(film)


def test_what_is_no_video_has_no_frames(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"text")
    assert stamps_of(tmp_path / "a.mp4").shape == (0,)
    assert list(extracted(tmp_path / "a.mp4", None, None)) == []


@pytest.mark.slow
def test_frames_that_were_cut_off_without_coding_anew_have_no_time(tmp_path):
    """They lie before the first frame that is shown, on which it depends."""
    film, cut = write_film(tmp_path / "a.mp4", numbered(12)), tmp_path / "cut.mp4"
    options = ["-v", "error", "-ss", "0.2", "-i", str(film), "-c", "copy", str(cut)]
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), *options], check=True)
    np.testing.assert_allclose(stamps_of(cut), 0.04 * np.arange(7), atol=1e-6)
    shown = list(extracted(cut, None, None))
    assert len(shown) == 7
    np.testing.assert_array_equal(shown[0], list(extracted(film, [5], None))[0])


@pytest.mark.slow
def test_of_several_streams_the_film_is_taken_not_a_cover_or_a_preview(tmp_path):
    film = write_film(tmp_path / "film.mp4", numbered(12))
    small = write_film(tmp_path / "small.mp4", numbered(3, size=(24, 32)))
    cover = write_film(tmp_path / "cover.mp4", numbered(1, size=(96, 128)))
    for first in (small, cover):
        both = tmp_path / f"with_{first.name}"
        call = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", "-i", str(first), "-i", str(film)]
        subprocess.run([*call, "-map", "0:v", "-map", "1:v", "-c", "copy", str(both)], check=True)
        assert len(stamps_of(both)) == 12
        frames = [*extracted(both, [0, 11], None)]
        assert [frame.shape for frame in frames] == [(48, 64, 3)] * 2
        assert header_of(both).count("Video:") == 1


@pytest.mark.parametrize(
    ("options", "suffix", "said"),
    [
        (("-c:v", "prores_ks", "-pix_fmt", "yuva444p10le"), "mov", "its alpha is not read"),
        (("-c:v", "png", "-pix_fmt", "rgba"), "mkv", "its alpha is not read"),
        (("-c:v", "gif", "-pix_fmt", "rgb8"), "gif", ""),
        ((), "mp4", ""),
    ],
)
def test_alpha_that_is_not_read_is_said(tmp_path, options, suffix, said):
    film = write_film(tmp_path / f"a.{suffix}", numbered(3), options=options)
    assert said in "".join(doubts_of(film))
    assert bool(said) == bool(doubts_of(film))


TO_709 = {  # columns: the light of red, green and blue, of wider primaries
    "bt2020": [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]],
    "smpte432": [[1.2249, -0.2247, 0], [-0.0420, 1.0419, 0], [-0.0197, -0.0786, 1.0979]],
}


@pytest.mark.parametrize(("primaries", "name"), [("bt2020", "BT.2020"), ("smpte432", "Display P3")])
def test_wide_colors_of_sdr_become_those_of_bt709(tmp_path, primaries, name):
    shown = np.kron(np.random.default_rng(0).integers(40, 210, (6, 8, 3)), np.ones((8, 8, 1)))
    stored = 255 * ((shown / 255) ** 2.4 @ np.linalg.inv(TO_709[primaries]).T) ** (1 / 2.4)
    planes = stored.round().astype(np.uint8).transpose(2, 0, 1)[[1, 2, 0]]
    tags = [
        "-color_primaries",
        primaries,
        "-color_trc",
        "bt709",
        "-colorspace",
        "bt709",
        "-color_range",
        "tv",
    ]
    told = f"scale=out_color_matrix=bt709:out_range=tv,format=yuv444p,setparams=color_primaries={primaries}"
    told += ":color_trc=bt709:colorspace=bt709:range=tv"
    film = write_planes(tmp_path / "a.mkv", planes, "gbrp", "-vf", told, *tags, "-c:v", "ffv1")
    (image,) = extracted(film, [1], None)
    assert np.abs(image - shown).mean() < 1.5
    assert converted(film) == [f"{name}, converted to BT.709"]


def test_two_pictures_in_a_frame_are_refused_and_one_is_cut_out(tmp_path):
    film = write_film(tmp_path / "a.mkv", numbered(3), options=("-metadata:s:v", "stereo_mode=left_right"))
    with pytest.raises(
        SceneError, match="one lens, but got two pictures .* side by side; type ffmpeg"
    ) as told:
        stamps_of(film)
    words = str(told.value).split("type ffmpeg ")[1].split()
    ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *words]
    subprocess.run(ffmpeg, cwd=tmp_path, check=True)
    assert next(extracted(tmp_path / "one.mp4", None, None)).shape == (48, 32, 3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["equirectangular", "half equirectangular", "cubemap", "fisheye"])
def test_films_of_no_perspective_are_refused_and_turned_to_one(tmp_path, kind, monkeypatch):
    film = write_film(tmp_path / f"{kind[:4]}.mp4", numbered(1))
    text = f"      spherical: {kind} (0.000000/0.000000/0.000000)\n".encode()
    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "run", lambda *_, **__: SimpleNamespace(stderr=text))
        with pytest.raises(SceneError, match=f"one that is {kind}; type ffmpeg") as caught:
            stamps_of(film)
    words = str(caught.value).split("type ffmpeg ")[1].split(",")[0].split()
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *words], cwd=tmp_path, check=True)
    assert next(extracted(tmp_path / "front.mp4", None, None)).ndim == 3


@pytest.mark.parametrize("size", [(64, 48), (96, 128)])
def test_frames_that_change_their_size_are_refused(tmp_path, size):
    for name, shape in (("1.mkv", (48, 64)), ("2.mkv", size)):
        write_film(tmp_path / name, numbered(4, shape))
    (tmp_path / "list").write_text("file '1.mkv'\nfile '2.mkv'\n")
    joined = ["-f", "concat", "-i", "list", "-c", "copy", "a.mkv"]
    subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *joined], cwd=tmp_path, check=True)
    got = f"others of {size[1]} x {size[0]}, .* after 0.12 s; cut it there"
    with pytest.raises(SceneError, match=f"expected frames of one size and kind, but got {got}"):
        measure(tmp_path / "a.mkv", lambda *_: None)
