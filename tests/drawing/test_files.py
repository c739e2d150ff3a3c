import imageio.v3 as iio
import pytest
import torch

from forewarp.drawing.images import write_png, write_video
from tests.support.films import read_film


def images(count, height=18, width=22):
    """Grey to white, so that no two are alike."""
    return [torch.full((height, width, 3), 0.2 + 0.8 * i / count) for i in range(count)]


def test_a_png_is_rounded_and_clamped(tmp_path):
    path = write_png(tmp_path / "new" / "a.png", torch.tensor([[[-1.0, 0.5, 2.0]]]))
    assert iio.imread(path).tolist() == [[[0, 128, 255]]]


def test_gifs_folders_and_mp4_of_odd_sizes_hold_every_frame(tmp_path):
    assert iio.imread(write_video(tmp_path / "a.gif", iter(images(4)), fps=10)).shape[:3] == (4, 18, 22)
    folder = write_video(tmp_path / "a.png", iter(images(3)), fps=1)
    assert [p.name for p in sorted(folder.iterdir())] == ["0000.png", "0001.png", "0002.png"]
    frames = read_film(write_video(tmp_path / "videos" / "a.mp4", iter(images(7, 17, 21)), fps=5), 18, 22)
    assert frames.shape == (7, 18, 22, 3)
    assert abs(float(frames[6].mean()) - 255 * (0.2 + 0.8 * 6 / 7)) < 4


@pytest.mark.parametrize("suffix", ["mp4", "gif"])
def test_nothing_half_written_stays(tmp_path, suffix):
    def broken():
        yield from images(2)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / f"a.{suffix}", broken(), fps=5)
    with pytest.raises(ValueError, match=r"expected images of \(20, 30, 3\), .* but got \(20, 32, 3\)"):
        write_video(tmp_path / "a.mp4", [torch.zeros(20, width, 3) for width in (30, 32)], fps=10)
    assert list(tmp_path.iterdir()) == []
