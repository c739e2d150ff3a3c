import pytest
import torch

from forewarp.drawing.images import draw_discs, hidden, sample_lines

RED = torch.tensor([[1.0, 0.0, 0.0]])


def test_a_disc_covers_its_area_wherever_it_lies():
    for at in ([10.0, 8.0], [10.5, 8.5], [10.3, 7.9]):
        drawn = draw_discs(torch.zeros(16, 20, 3), torch.tensor([at]), RED, torch.ones(1), 3.0)
        assert float(drawn[..., 0].sum()) == pytest.approx(torch.pi * 9, rel=0.05)
        assert float(drawn[..., 1:].max()) == 0
        for axis, middle in ((0, at[0]), (1, at[1])):
            share = drawn[..., 0].sum(dim=axis)
            place = torch.arange(len(share)) + 0.5
            assert float((share * place).sum() / share.sum()) == pytest.approx(middle, abs=0.05)


def test_overlap_does_not_darken_and_mixes_colours():
    at = torch.tensor([[5.0, 5.0], [5.0, 5.0]])
    colors = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    drawn = draw_discs(torch.ones(10, 10, 3), at, colors, torch.tensor([0.5, 0.5]), 2.0)
    torch.testing.assert_close(drawn[5, 5], torch.tensor([0.75, 0.5, 0.75]))


def test_discs_outside_leave_the_picture_alone():
    picture = torch.rand(6, 7, 3, generator=torch.Generator().manual_seed(0))
    at = torch.tensor([[-50.0, 3.0], [3.0, 900.0]])
    drawn = draw_discs(picture, at, RED.expand(2, 3), torch.ones(2), 2.0)
    torch.testing.assert_close(drawn, picture)


def test_lines_are_sampled_densely_with_all_they_carry():
    lines = torch.tensor([[[0.0, 0.0, 1.0], [4.0, 0.0, 0.0], [4.0, 3.0, 2.0]], [[9.0, 9.0, 5.0]] * 3])
    samples, line = sample_lines(lines)
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
    assert hidden(at, distance, depth, 0.1).tolist() == [False, False, True, False]
