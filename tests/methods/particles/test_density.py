import math

import torch
from torch import nn

from forewarp.methods.particles.density import renew, too_near
from forewarp.methods.rows import RowsAdam


class Few(nn.Module):
    """Particles with what density control reads."""

    grows = ("means", "log_scales", "turns", "opacity", "pulled", "shown", "idle")

    def __init__(self, count=10):
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.means = nn.Parameter(torch.randn(count, 3, generator=generator))
        self.log_scales = nn.Parameter(torch.full((count, 3), -3.0))
        self.turns = nn.Parameter(torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1))
        self.opacity = nn.Parameter(torch.zeros(count, 1))
        for name in ("pulled", "idle"):
            self.register_buffer(name, torch.zeros(count))
        self.register_buffer("shown", torch.ones(count))

    fade = None


def optimizer_of(method):
    groups = [{"params": [p], "lr": 1e-3, "name": n} for n, p in method.named_parameters()]
    optimizer = RowsAdam(groups)
    for p in method.parameters():
        p.grad = torch.ones_like(p)
    optimizer.step()
    return optimizer


def test_what_is_pulled_most_is_split_along_its_longest_axis():
    few = Few()
    optimizer = optimizer_of(few)
    few.log_scales.data[3, 1] = -1.0
    few.pulled[3], few.pulled[5] = 7.0, 3.0
    before, place = few.log_scales[3].clone(), few.means[3].clone()
    renew(few, optimizer, 11, unseen=False, extent=1.0)
    assert len(few.means) == 11
    length = before[1].exp()
    apart = torch.tensor([0.0, 0.6, 0.0]) * length
    torch.testing.assert_close(few.means[3], place - apart, atol=1e-3, rtol=0)
    torch.testing.assert_close(few.means[10], place + apart, atol=1e-3, rtol=0)
    shorter = before + torch.tensor([0.0, 1.0, 0.0]) * torch.tensor(0.6).log()
    for row in (3, 10):
        torch.testing.assert_close(few.log_scales[row], shorter)
    steps = optimizer.state[few.means]["steps"]
    assert steps.tolist() == [1.0] * 10 + [0.0]  # the new half begins afresh
    assert not bool(few.pulled.any())
    assert len(few.idle) == 11


def test_what_has_faded_or_is_too_large_goes():
    few = Few()
    optimizer = optimizer_of(few)
    few.opacity.data[2], few.log_scales.data[4, 0] = -5.0, 2.0
    kept = few.means[[0, 1, 3, 5, 6, 7, 8, 9]].clone()
    renew(few, optimizer, 8, unseen=False, extent=1.0)
    torch.testing.assert_close(few.means.data, kept)


def test_what_stood_too_near_to_a_camera_goes_though_it_was_seen():
    few = Few()
    optimizer = optimizer_of(few)
    few.idle[7] = math.inf
    few.pulled[7], few.pulled[2] = 9.0, 1.0  # it is not split, though it is pulled most
    kept = few.means[[0, 1, 3, 4, 5, 6, 8, 9]].clone()
    renew(few, optimizer, 10, unseen=False, extent=1.0)
    torch.testing.assert_close(few.means.data[[0, 1, 3, 4, 5, 6, 7, 8]], kept)
    assert len(few.means) == 10
    assert not bool(few.idle.any())


def test_few_that_stand_before_all_others_are_too_near_and_many_are_not():
    order, far = torch.arange(200).flip(0), torch.linspace(2.0, 3.0, 200)
    assert not len(too_near(order, far))
    for few, gone in ((1, 1), (4, 4), (6, 0)):
        distances = torch.cat([torch.full((few,), 0.5), far[few:]]).flip(0)  # of each row, not in that order
        assert too_near(order, distances).tolist() == order[:gone].tolist()
    assert not len(too_near(order[:0], far[:0]))
    lone = torch.tensor([0.1, 2.0, 2.5])
    assert not len(too_near(torch.arange(3), lone))  # of so few it may be the scene itself


def test_what_is_never_seen_goes_after_some_rounds_and_only_where_all_is_in_play():
    for unseen, left in ((True, 9), (False, 10)):
        few = Few()
        optimizer = optimizer_of(few)
        for _ in range(5):
            few.shown.fill_(1)
            few.shown[6] = 0
            renew(few, optimizer, 10, unseen=unseen, extent=1.0)
        assert len(few.means) == left


def test_all_that_there_is_does_not_vanish():
    few = Few()
    optimizer = optimizer_of(few)
    few.opacity.data.fill_(-9.0)
    renew(few, optimizer, 10, unseen=False, extent=1.0)
    assert len(few.means) == 10


def test_at_most_a_tenth_is_split_at_once():
    few = Few(100)
    optimizer = optimizer_of(few)
    few.pulled.copy_(torch.arange(100.0))
    renew(few, optimizer, 1000, unseen=False, extent=1.0)
    assert len(few.means) == 111
