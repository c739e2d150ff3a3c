import math

import pytest
import torch
from torch.autograd import gradcheck
from torch.nn import functional as F

from forewarp import losses
from forewarp.metrics.image import _similarity
from forewarp.ops.grid import neighbour_pairs

IDS = torch.tensor([0, 0, 2])


def test_photometric_hand_worked():
    rgb, truth = torch.tensor([[0.5, 0.0, 0.0], [1.0, 1.0, 1.0]]), torch.zeros(2, 3)
    assert losses.photometric(rgb, truth).item() == pytest.approx((0.25 + 3) / 6)
    assert losses.photometric(rgb, truth, literal=True).item() == pytest.approx((0.25 + 3) / 2)


def test_point_color_hand_worked():
    weights, truth = torch.tensor([0.5, 0.25, 1.0]), torch.zeros(3, 3)
    colors = torch.tensor([[1.0, 0, 0], [0, 2.0, 0], [1.0, 1.0, 0]])
    # ray 0: 0.5 * 1 + 0.25 * 4, ray 1 nothing, ray 2: 1 * 2; as printed over their 3, 1 and 2 samples.
    assert losses.point_color(weights, colors, IDS, truth).item() == pytest.approx((1.5 + 2) / 3)
    every = torch.tensor([0, 0, 0, 1, 2, 2])
    printed = losses.point_color(weights, colors, IDS, truth, all_ray_ids=every)
    assert printed.item() == pytest.approx((1.5 / 3 + 2 / 2) / 3)


def test_point_color_pulls_colours_and_not_weights():
    weights = torch.rand(3, requires_grad=True)
    colors = torch.rand(3, 3, requires_grad=True)
    losses.point_color(weights, colors, IDS, torch.zeros(3, 3)).backward()
    assert weights.grad is None
    assert colors.grad.abs().sum() > 0


def test_rays_that_are_drawn_more_often_count_less():
    truth, rgb = torch.zeros(3, 3), torch.tensor([[0.5], [1.0], [0.1]]).expand(3, 3)
    shares = torch.tensor([2.0, 0.5, 0.5])
    assert losses.photometric(rgb, truth, shares=shares).item() == pytest.approx((0.5 + 0.5 + 0.005) / 3)
    found = losses.point_color(torch.ones(3), rgb, IDS, truth, shares=shares)
    assert found.item() == pytest.approx(3 * (2 * 0.25 + 2 * 1.0 + 0.5 * 0.01) / 3)
    through = torch.full((3,), 0.5)
    assert losses.background_entropy(through, shares).item() == pytest.approx(math.log(2))


def test_entropy_hand_worked():
    assert losses.background_entropy(torch.tensor([0.5, 0.5])).item() == pytest.approx(math.log(2))
    assert losses.background_entropy(torch.tensor([0.0, 1.0])).item() == pytest.approx(0, abs=2e-5)


@pytest.mark.parametrize("entropy", [losses.background_entropy, losses.sample_entropy])
def test_entropy_has_a_finite_slope_everywhere(entropy):
    t = torch.tensor([0.0, 1e-12, 0.5, 1 - 1e-7, 1.0], requires_grad=True)
    entropy(t).backward()
    assert t.grad.isfinite().all()


def test_flow_and_inpainting_hand_worked():
    flow = torch.tensor([[1.0, -2.0, 0.0], [0.0, 0.0, 3.0]])
    assert losses.flow_l1(flow).item() == 1.0
    assert losses.inpaint_diff(-flow).item() == 1.0


def test_what_stands_still_hand_worked():
    assert losses.static_points(torch.tensor([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0]])).item() == 12.5
    assert losses.moving_opacity(torch.tensor([0.0, 1.0, 0.5])).item() == 0.5


def test_total_variation_is_that_of_the_lattice():
    pairs = neighbour_pairs(torch.arange(60, dtype=torch.int32).reshape(3, 4, 5))
    number = torch.arange(60.0)  # steps of 20, 5 and 1
    assert losses.tv_density(number, pairs).item() == 26
    assert losses.tv_flow(number[:, None].expand(-1, 3), pairs).item() == 26


def test_depth_term_of_a_ramp():
    ramp = torch.arange(4.0).expand(2, 4, 4)
    assert losses.tv_depth(ramp, torch.ones(2, 4, 4)).item() == 1
    assert losses.tv_depth(ramp, torch.full((2, 4, 4), 0.25)).item() == 0.25


def test_nothing_to_measure_is_zero_and_attached():
    for value in (
        losses.sample_entropy(torch.zeros(0, requires_grad=True)),
        losses.flow_l1(torch.zeros(0, 3, requires_grad=True)),
        losses.moving_opacity(torch.zeros(0, requires_grad=True)),
        losses.point_color(torch.zeros(0), torch.zeros(0, 3, requires_grad=True), IDS[:0], torch.zeros(2, 3)),
    ):
        assert value.item() == 0
        value.backward()


def test_losses_of_whole_images():
    image, truth = torch.rand(2, 13, 9, 3, dtype=torch.float64)
    padded = (F.pad(x.permute(2, 0, 1), (5, 5, 5, 5)) for x in (image, truth))
    torch.testing.assert_close(losses.dssim(image, truth), (1 - _similarity(*padded)[0]).sum() / 2)
    assert losses.dssim(image, image).item() == pytest.approx(0, abs=1e-9)
    assert losses.robust(torch.full((1, 1, 3), 0.75), torch.zeros(1, 1, 3), 1.0).item() == 0.75


@pytest.mark.slow
def test_gradcheck():
    def draw(*shape):
        return (0.1 + 0.8 * torch.rand(*shape, dtype=torch.float64)).requires_grad_()

    truth = torch.zeros(3, 3, dtype=torch.float64)
    pairs = neighbour_pairs(torch.arange(60, dtype=torch.int32).reshape(3, 4, 5))
    assert gradcheck(lambda c: losses.photometric(c, truth), draw(3, 3))
    assert gradcheck(lambda c: losses.point_color(torch.ones(3).double(), c, IDS, truth), draw(3, 3))
    assert gradcheck(lambda image: losses.robust(image, truth, 0.05), draw(3, 3))
    assert gradcheck(lambda image: losses.dssim(image, truth[:, None].expand(3, 2, 3)), draw(3, 2, 3))
    assert gradcheck(losses.background_entropy, draw(5))
    assert gradcheck(losses.sample_entropy, draw(5))
    assert gradcheck(losses.flow_l1, draw(5, 3))
    assert gradcheck(losses.static_points, draw(5, 3))
    assert gradcheck(losses.inpaint_diff, draw(1, 2, 3, 4, 5))
    assert gradcheck(lambda d: losses.tv_density(d, pairs), draw(60))
    assert gradcheck(lambda f: losses.tv_flow(f, pairs), draw(60, 3))
    assert gradcheck(lambda d: losses.tv_depth(d, torch.ones(2, 4, 4).double()), draw(2, 4, 4))
