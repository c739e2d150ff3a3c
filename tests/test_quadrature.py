import math

import pytest
import torch

from forewarp.renderer import Quadrature
from forewarp.scene.box import Box
from forewarp.scene.camera import Rays

RED, WHITE = torch.tensor([1.0, 0.0, 0.0]), torch.ones(3)


def rays(count=4, near=1.0, far=5.0, seed=0):
    """Rays from about (-3, 0, 0) that look along x."""
    g = torch.Generator().manual_seed(seed)
    origins = torch.tensor([-3.0, 0, 0]) + 0.2 * torch.randn(count, 3, generator=g)
    directions = torch.tensor([1.0, 0, 0]) + 0.05 * torch.randn(count, 3, generator=g)
    return Rays(origins, torch.nn.functional.normalize(directions, dim=1), near, far)


def slab(strength, low=-0.5, high=0.5):
    """Red matter between two planes across x."""

    def density(points):
        return strength * ((points[..., 0] > low) & (points[..., 0] < high)).to(points)

    def radiance(points, directions):
        assert directions.shape == (len(points), 1, 3)
        return density(points), RED.expand(*points.shape[:2], 3)

    return density, radiance


def along_x(count=3):
    return Rays(
        torch.tensor([[-3.0, 0, 0]]).repeat(count, 1), torch.tensor([[1.0, 0, 0]]).repeat(count, 1), 1, 5
    )


@pytest.mark.parametrize("open_end", [True, False])
def test_a_slab_hand_worked(open_end):
    seen = Quadrature(400, 400, open_end)(*slab(2.0), along_x(), WHITE)
    through = math.exp(-2)
    torch.testing.assert_close(seen.opacity, torch.full((3,), 1 - through), atol=5e-3, rtol=0)
    torch.testing.assert_close(
        seen.rgb, torch.tensor([[1, through, through]]).repeat(3, 1), atol=5e-3, rtol=0
    )
    # The mean of an exponential that is cut off after 1, from the slab's face at 2.5.
    mean = 2.5 + 0.5 - through / (1 - through)
    torch.testing.assert_close(seen.depth, torch.full((3,), mean), atol=0.01, rtol=0)
    assert seen.depths.shape == seen.weights.shape == seen.density.shape == (3, 800)


def test_more_samples_lie_where_matter_is():
    seen = Quadrature(32, 64)(*slab(20.0, -0.1, 0.1), along_x(1), WHITE)
    inside = (seen.depths > 2.8) & (seen.depths < 3.3)
    assert int(inside.sum()) > 60


def test_one_pass_alone_asks_for_density_nowhere():
    def never(points):
        raise AssertionError

    assert Quadrature(8, 0)(never, slab(1.0)[1], along_x(), WHITE).depths.shape == (3, 8)


def test_an_open_end_hides_the_background_of_a_density_that_is_never_0():
    def fog(points, directions=None):
        thin = torch.full(points.shape[:2], 1e-6)
        return thin if directions is None else (thin, RED.expand(*points.shape[:2], 3))

    torch.testing.assert_close(Quadrature(8, 8)(fog, fog, along_x(1), WHITE).rgb[0], RED)
    torch.testing.assert_close(
        Quadrature(8, 8, open_end=False)(fog, fog, along_x(1), WHITE).rgb[0], WHITE, atol=1e-4, rtol=0
    )


def test_opacity_and_depth_leave_out_a_sample_without_end():
    def fog(points, directions):
        return torch.full(points.shape[:2], 0.1), RED.expand(*points.shape[:2], 3)

    seen, closed = (Quadrature(200, 0, open_end)(None, fog, along_x(1), WHITE) for open_end in (True, False))
    assert float(seen.weights.sum()) == pytest.approx(1)
    assert float(seen.opacity) == pytest.approx(1 - math.exp(-0.4), abs=2e-3)
    torch.testing.assert_close(seen.depth, closed.depth, atol=0.02, rtol=0)


def test_the_first_pass_has_no_gradient_and_the_second_has():
    strength = torch.tensor(2.0, requires_grad=True)
    density, radiance = slab(strength)
    asked = []

    def noted(points):
        asked.append(torch.is_grad_enabled())
        return density(points)

    seen = Quadrature(8, 8)(noted, radiance, along_x(), WHITE)
    assert asked == [False]
    assert not seen.depths.requires_grad
    seen.opacity.sum().backward()
    assert strength.grad > 0


def test_outside_the_box_nothing_is_asked():
    box = Box((-1, -1, -1), (1, 1, 1))

    def everywhere(points, directions=None):
        assert (points.abs() <= 1 + 1e-5).all()
        dense = torch.full(points.shape[:2], 9.0)
        return dense if directions is None else (dense, RED.expand(*points.shape[:2], 3))

    some = along_x(3)
    some.directions[1] = torch.tensor([0.0, 0, 1])  # misses
    behind = torch.rand(3, 3)
    seen = Quadrature(16, 16, box=box)(everywhere, everywhere, some, behind)
    torch.testing.assert_close(seen.rgb[1], behind[1])
    assert seen.opacity[1] == seen.depth[1] == 0
    torch.testing.assert_close(seen.rgb[[0, 2]], RED.expand(2, 3), atol=1e-4, rtol=0)
    assert len(seen.depths) == 2


def test_samples_lie_between_the_first_and_the_last_kept_point():
    box, asked = Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), []

    def kept(points):
        return (points[..., 0] > -0.3) & (points[..., 0] < 0.2) & (points[..., 1] > -0.5)

    def radiance(points, directions):
        asked.append(points)
        return 2.0 * torch.ones(len(points)), RED.expand(len(points), 3)

    three = along_x()
    three.origins[1:, 1] = torch.tensor([-0.6, 1.5])  # past all that is kept, and past the box
    seen = Quadrature(50, 0, False, box, kept)(None, radiance, three, WHITE)
    step = 2 / 63  # the probes begin at the box's face
    assert seen.depths.shape == (1, 50)
    assert 2.7 - step <= float(seen.depths.min()) < float(seen.depths.max()) <= 3.2 + step
    assert len(asked[0]) > 44
    assert kept(asked[0]).all()
    expected = torch.tensor([1 - math.exp(-2 * 0.5), 0.0, 0.0])
    torch.testing.assert_close(seen.opacity, expected, atol=0.02, rtol=0)


def test_all_rays_may_miss():
    weight = torch.ones((), requires_grad=True)
    box = Box((-1, 7, -1), (1, 8, 1))
    seen = Quadrature(4, 4, box=box)(*slab(weight), along_x(), WHITE, torch.Generator())
    assert (seen.rgb == 1).all()
    seen.rgb.sum().backward()
    assert weight.grad == 0


def test_pictures_in_pieces_and_permuted(monkeypatch):
    quadrature, some = Quadrature(12, 12), rays(9)
    behind = torch.rand(9, 3)
    whole = quadrature(*slab(2.0), some, behind)
    monkeypatch.setattr("forewarp.renderer._POINTS", 48)
    pieces = quadrature.image(*slab(2.0), some, behind)
    order = torch.randperm(9)
    turned = quadrature(*slab(2.0), some[order], behind[order])
    for name in ("rgb", "depth", "opacity"):
        torch.testing.assert_close(getattr(pieces, name), getattr(whole, name))
        torch.testing.assert_close(getattr(turned, name), getattr(whole, name)[order])


def test_a_generator_jitters_and_nothing_else_does():
    quadrature, some = Quadrature(12, 12), rays()
    still = [quadrature(*slab(2.0), some, WHITE).depths for _ in range(2)]
    drawn = [quadrature(*slab(2.0), some, WHITE, torch.Generator().manual_seed(s)).depths for s in (0, 0, 1)]
    assert torch.equal(*still)
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[1], drawn[2])
    assert (drawn[0].diff(dim=1) >= 0).all()


@pytest.mark.parametrize("wrong", [(2, 8), (8, -1)])
def test_refuses(wrong):
    with pytest.raises(ValueError, match="model.sampling: expected samples >= 3 and fine_samples >= 0"):
        Quadrature(*wrong)
