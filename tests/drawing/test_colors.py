import torch

from forewarp.drawing import images as draw


def test_depth_is_bright_near_and_white_where_nothing_is():
    depth = torch.tensor([[2.0, 3.0, 4.0, 0.0]])
    colors = draw.depth_colors(depth, torch.tensor([[1.0, 1.0, 1.0, 0.0]]))
    lightness = colors[0].mean(-1)
    assert lightness[0] > lightness[1] > lightness[2]
    assert colors[0, 3].tolist() == [1, 1, 1]
    assert bool((draw.depth_colors(torch.zeros(2, 3), torch.zeros(2, 3)) == 1).all())


def test_error_is_black_where_pictures_agree_and_white_at_full():
    a = torch.rand(2, 3, 3, generator=torch.Generator().manual_seed(0)) * 0.5
    assert float(draw.error_colors(a, a).max()) == 0
    assert float(draw.error_colors(a, a + 0.3, full=0.25).min()) > 0.85


def test_flow_hue_is_direction_and_saturation_is_length():
    flow = torch.tensor([[[2.0, 0.0], [-2.0, 0.0], [1.0, 0.0], [0.0, 0.0]]])
    right, left, slow, still = draw.flow_colors(flow, torch.ones(1, 4), full=2.0)[0]
    torch.testing.assert_close(right, draw.hues(torch.tensor(0.0)))
    torch.testing.assert_close(left, draw.hues(torch.tensor(0.5)))
    torch.testing.assert_close(slow, 0.5 * (right + still))
    assert still[0] == still[1] == still[2] < 1  # grey, to be told from the white of nothing
    assert bool((draw.flow_colors(flow, torch.zeros(1, 4)) == 1).all())


def test_the_wheel_stands_in_the_corner_only():
    picture = torch.zeros(60, 80, 3)
    drawn = draw.with_wheel(picture)
    assert float(drawn[-20:, -20:].max()) > 0.5
    assert float(drawn[:40].max()) == float(drawn[:, :60].max()) == float(picture.max()) == 0


def test_a_row_keeps_the_pictures_and_parts_them():
    a, b = torch.zeros(2, 3, 3), torch.full((2, 5, 3), 0.5)
    row = draw.in_a_row([a, b], gap=4)
    assert row.shape == (2, 12, 3)
    torch.testing.assert_close(row[:, :3], a)
    torch.testing.assert_close(row[:, 3:7], torch.ones(2, 4, 3))
    torch.testing.assert_close(row[:, 7:], b)


def test_pixels_are_repeated_whole():
    picture = torch.rand(2, 3, 3)
    large = draw.at_least(picture, 5)
    assert large.shape == (6, 9, 3)
    assert bool((large[3:6, 6:9] == picture[1, 2]).all())
