"""Videos: the times of their frames, and frames from the middle."""

import numpy as np
import pytest

from forewarp.data.video import extracted, stamps_of
from tests.support.films import numbered, write_film


@pytest.mark.parametrize("late", [0, 500])
def test_frames_from_any_time_on_are_those_of_the_whole_video(tmp_path, late):
    film = write_film(tmp_path / "a.mp4", numbered(12), stamps=f"{late}+N*40+mod(N\\,2)*10")
    stamps = stamps_of(film)
    np.testing.assert_allclose(np.diff(stamps), [0.05, 0.03] * 5 + [0.05], atol=1e-6)
    images = list(extracted(film, None, None))
    assert len(images) == 12
    for n in (0, 5, 11):
        np.testing.assert_array_equal(next(extracted(film, None, None, start=stamps[n] - 0.01)), images[n])


def test_what_is_no_video_has_no_frames(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"text")
    assert stamps_of(tmp_path / "a.mp4").shape == (0,)
    assert list(extracted(tmp_path / "a.mp4", None, None)) == []
