import errno
from pathlib import Path

import imageio.v3 as iio
import pytest
import torch

from forewarp.drawing import images
from forewarp.drawing.images import write_png, write_video
from forewarp.files import disk_error
from tests.support.films import read_film
from tests.support.full_disk import file_size_limit

RED = torch.tensor([[1.0, 0.0, 0.0]])


def test_depth_is_bright_near_and_white_where_nothing_is():
    depth = torch.tensor([[2.0, 3.0, 4.0, 0.0]])
    colors = images.depth_colors(depth, torch.tensor([[1.0, 1.0, 1.0, 0.0]]))
    lightness = colors[0].mean(-1)
    assert lightness[0] > lightness[1] > lightness[2]
    assert colors[0, 3].tolist() == [1, 1, 1]
    assert bool((images.depth_colors(torch.zeros(2, 3), torch.zeros(2, 3)) == 1).all())


def test_the_scale_of_depth_tells_its_ends_in_the_corner():
    depth = torch.linspace(2.0, 4.0, 50 * 60).reshape(50, 60)
    colors = images.depth_colors(depth, torch.ones_like(depth))
    assert torch.equal(colors[-14:, -48:], images.depth_scale(2.02, 3.98))
    assert torch.equal(colors[:-14], images.depth_colors(depth, torch.ones_like(depth))[:-14])
    scale = images.depth_scale(1.7, -4e-9)
    texts = ["".join("#" if dark else "." for dark in line) for line in (scale[1:6, 1:12] == 0).all(-1)]
    assert texts == [".#......###", "##........#", ".#.......#.", ".#.......#.", "###..#...#."]
    assert (scale[9, 1] - scale[9, -2]).sum() > 0.5  # near is bright
    assert images.depth_colors(depth[:9], torch.ones(9, 60)).min() > 0.1  # too small for one


def test_error_is_black_where_images_agree_and_white_at_full():
    a = torch.rand(2, 3, 3, generator=torch.Generator().manual_seed(0)) * 0.5
    assert float(images.error_colors(a, a).max()) == 0
    assert float(images.error_colors(a, a + 0.3, full=0.25).min()) > 0.85


def test_flow_hue_is_direction_and_saturation_is_length():
    flow = torch.tensor([[[2.0, 0.0], [-2.0, 0.0], [1.0, 0.0], [0.0, 0.0]]])
    right, left, slow, still = images.flow_colors(flow, torch.ones(1, 4), full=2.0)[0]
    torch.testing.assert_close(torch.stack([right, left]), images.hues(torch.tensor([0.0, 0.5])))
    torch.testing.assert_close(slow, 0.5 * (right + still))
    assert still[0] == still[1] == still[2] < 1  # grey, to be told from the white of nothing
    assert bool((images.flow_colors(flow, torch.zeros(1, 4)) == 1).all())


def test_the_wheel_stands_in_the_corner_only():
    drawn = images.with_wheel(torch.zeros(60, 80, 3))
    assert float(drawn[-20:, -20:].max()) > 0.5
    assert float(drawn[:40].max()) == float(drawn[:, :60].max()) == 0


def test_a_row_keeps_the_images_and_parts_them():
    a, b = torch.zeros(2, 3, 3), torch.full((2, 5, 3), 0.5)
    assert torch.equal(images.in_a_row([a, b], gap=4), torch.cat([a, torch.ones(2, 4, 3), b], 1))


def test_a_disc_covers_its_area_wherever_it_lies_and_nothing_from_outside():
    for x, y in ([10.0, 8.0], [10.5, 8.5], [10.3, 7.9]):
        at = torch.tensor([[x, y], [-50.0, 3.0], [3.0, 900.0]])
        drawn = images.draw_discs(torch.zeros(16, 20, 3), at, RED.expand(3, 3), torch.ones(3), 3.0)
        assert float(drawn[..., 0].sum()) == pytest.approx(torch.pi * 9, rel=0.05)
        assert float(drawn[..., 1:].max()) == 0
        for axis, middle in ((0, x), (1, y)):
            share = drawn[..., 0].sum(dim=axis)
            place = torch.arange(len(share)) + 0.5
            assert float((share * place).sum() / share.sum()) == pytest.approx(middle, abs=0.05)


def test_overlap_does_not_darken_and_mixes_colours():
    at, colors = torch.tensor([[5.0, 5.0], [5.0, 5.0]]), torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    drawn = images.draw_discs(torch.ones(10, 10, 3), at, colors, torch.tensor([0.5, 0.5]), 2.0)
    torch.testing.assert_close(drawn[5, 5], torch.tensor([0.75, 0.5, 0.75]))


def test_lines_are_sampled_densely_with_all_they_carry():
    lines = torch.tensor([[[0.0, 0.0, 1.0], [4.0, 0.0, 0.0], [4.0, 3.0, 2.0]], [[9.0, 9.0, 5.0]] * 3])
    samples, line = images.sample_lines(lines)
    first = samples[line == 0]
    assert float((first[1:, :2] - first[:-1, :2]).norm(dim=-1).max()) <= 0.5 + 1e-6
    flat = first[first[:, 1] == 0]
    torch.testing.assert_close(flat[:, 2], 1 - flat[:, 0] / 4)
    assert samples[line == 1].tolist() == [[9.0, 9.0, 5.0]] * 2


def test_hidden_behind_the_surface_by_more_than_the_slack():
    depth = torch.full((3, 4), float("inf"))
    depth[1, 2] = 2.0
    at = torch.tensor([[2.5, 1.5], [2.5, 1.5], [2.5, 1.5], [0.5, 0.5]])
    distance = torch.tensor([1.9, 2.05, 2.2, 99.0])
    assert images.hidden(at, distance, depth, 0.1).tolist() == [False, False, True, False]


def drawn(count, height=18, width=22):
    """Grey to white, so that no two are alike."""
    return [torch.full((height, width, 3), 0.2 + 0.8 * i / count) for i in range(count)]


def test_a_png_is_rounded_and_clamped(tmp_path):
    path = write_png(tmp_path / "new" / "a.png", torch.tensor([[[-1.0, 0.5, 2.0]]]))
    assert iio.imread(path).tolist() == [[[0, 128, 255]]]


def test_gifs_folders_and_mp4_of_odd_sizes_hold_every_frame(tmp_path):
    assert iio.imread(write_video(tmp_path / "a.gif", iter(drawn(4)), fps=10)).shape[:3] == (4, 18, 22)
    folder = write_video(tmp_path / "a.png", iter(drawn(3)), fps=1)
    assert [p.name for p in sorted(folder.iterdir())] == ["0000.png", "0001.png", "0002.png"]
    frames = read_film(write_video(tmp_path / "videos" / "a.mp4", iter(drawn(7, 17, 21)), fps=5), 18, 22)
    assert frames.shape == (7, 18, 22, 3)
    assert abs(float(frames[6].mean()) - 255 * (0.2 + 0.8 * 6 / 7)) < 4


def test_a_folder_may_be_called_like_an_address_or_a_pattern(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("http:a [1]/%d.mp4", "-b?.mp4"):
        assert len(read_film(write_video(Path(name), drawn(3, 16, 20), fps=5).resolve(), 16, 20)) == 3


@pytest.mark.parametrize("suffix", ["mp4", "gif"])
def test_nothing_half_written_stays(tmp_path, suffix):
    def broken():
        yield from drawn(2)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / f"a.{suffix}", broken(), fps=5)
    with pytest.raises(ValueError, match=r"expected images of \(20, 30, 3\), .* but got \(20, 32, 3\)"):
        write_video(tmp_path / "a.mp4", [torch.zeros(20, width, 3) for width in (30, 32)], fps=10)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a.mp4", "a.gif", "a.png"])
def test_a_full_disk_is_an_error_and_keeps_the_film_that_was_there(tmp_path, name):
    noise = [torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0)) for _ in range(4)]
    (tmp_path / name).write_text("good")
    write = write_png if name == "a.png" else write_video
    with file_size_limit(4096), pytest.raises(OSError, match="ended early|too large") as refused:
        write(tmp_path / name, noise[0]) if name == "a.png" else write(tmp_path / name, noise, fps=5)
    assert refused.value.filename == str(tmp_path / name)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["good"]


def test_what_another_program_says_of_a_full_disk_is_understood(tmp_path):
    error = disk_error("av_interleaved_write_frame(): No space left on device\n", tmp_path / "a.mp4")
    assert (error.errno, error.filename) == (errno.ENOSPC, str(tmp_path / "a.mp4"))
    assert "Unknown encoder" in disk_error("Unknown encoder", tmp_path).strerror
