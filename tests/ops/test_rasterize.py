import math

import pytest
import torch
from torch.autograd import gradcheck

from forewarp.ops.gaussians import Splats, project, rasterize
from tests.support.gaussians import NO_FADES, NO_TINTS, SIZE, crowd, one, pinhole, still, straight, together


def splat(u=8.5, v=8.5, opacity=0.5, color=(1.0, 0.0, 0.5), distance=3.0, conic=(1.0, 0.0, 1.0), reach=6.0):
    numbers = torch.tensor([[u, v, *conic, opacity, *color, distance]])
    return Splats(numbers, torch.full((1, 2), reach))


def joined(*parts):
    return Splats(*(torch.cat(columns) for columns in zip(*parts)))


def crowd_of(count=60, dtype=torch.float64, **changes):
    particles, warp, tints, fades = crowd(count, dtype=dtype, **changes)
    return project(particles, warp, pinhole(), tints, fades)


def test_hand_worked(backend):
    near = splat(color=(1.0, 0.0, 0.0), opacity=0.5, distance=2.0)
    far = splat(color=(0.0, 1.0, 0.0), opacity=0.25, distance=4.0)
    picture = rasterize(joined(far, near), 16, 16)  # the nearer one is drawn first, whatever its row
    assert picture.color[:, 8, 8].tolist() == pytest.approx([0.5, 0.125, 0.0], abs=1e-6)
    assert picture.transmittance[8, 8].item() == pytest.approx(0.375, abs=1e-6)
    assert picture.depth[8, 8].item() == pytest.approx(0.5 * 2 + 0.125 * 4, abs=1e-5)
    beside = 0.5 * math.exp(-0.5 * 4)  # two pixels away
    assert picture.color[0, 8, 10].item() == pytest.approx(beside, rel=1e-5)


def test_nothing_below_a_255th(backend):
    picture = rasterize(splat(opacity=0.5, reach=16.0), 16, 16)
    beyond = math.sqrt(2 * math.log(255 * 0.5))
    x = torch.arange(16) + 0.5 - 8.5
    away = (x.square() + x[:, None].square()).sqrt()
    assert bool((picture.transmittance[away > beyond + 1e-4] == 1).all())
    assert bool((picture.transmittance[away < beyond - 1e-4] < 1).all())


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (7, 9), (29, 21), (64, 3)])
def test_kernel_equals_reference(size):
    exact, fast = (
        rasterize(Splats(*(t.to(kind) for t in crowd_of())), *size) for kind in (torch.float64, torch.float32)
    )
    for one_plane, other in zip(exact, fast):
        assert one_plane.shape[-2:] == (size[1], size[0])
        torch.testing.assert_close(other.double(), one_plane, rtol=2e-5, atol=2e-5)


def test_gradients_of_kernel_equal_those_of_the_reference():
    found = []
    for kind in (torch.float64, torch.float32):
        splats = crowd_of()
        numbers = splats.values.to(kind).requires_grad_()
        picture = rasterize(Splats(numbers, splats.reach.to(kind)), *SIZE)
        planes = torch.cat([picture.color, picture.depth[None], picture.transmittance[None]])
        slopes = torch.randn(planes.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        (planes * slopes.to(kind)).sum().backward()
        found.append(numbers.grad.double())
    for column in range(10):
        exact, fast = (grad[:, column] for grad in found)
        assert float((exact - fast).norm() / exact.norm()) < 2e-5, column


def test_gradcheck():
    splats = crowd_of(5, scale=-1.0)
    inside = lambda numbers: rasterize(Splats(numbers, splats.reach), 3, 4)  # noqa: E731
    assert gradcheck(inside, splats.values.clone().requires_grad_(), atol=1e-6)


def test_equal_depths_keep_their_order(backend):
    first, second = splat(color=(1.0, 0.0, 0.0), opacity=0.9), splat(color=(0.0, 1.0, 0.0), opacity=0.9)
    picture = rasterize(joined(first, second), 16, 16)
    assert picture.color[:, 8, 8].tolist() == pytest.approx([0.9, 0.09, 0.0], abs=1e-6)


@pytest.mark.parametrize("opacity", [0.001, 0.5, 1.0])
def test_thousands_on_one_pixel(backend, opacity):
    many = 3000
    numbers = splat(opacity=opacity, conic=(40.0, 0.0, 40.0), reach=1.0).values.repeat(many, 1)
    numbers[:, 9] = torch.linspace(1, 2, many)
    numbers.requires_grad_()
    picture = rasterize(Splats(numbers, torch.ones(many, 2)), 16, 16)
    seen = opacity * 255 > 1
    assert picture.transmittance[8, 8].item() == pytest.approx(0.0 if seen else 1.0, abs=2e-3)
    (picture.color.sum() + picture.depth.sum()).backward()
    assert bool(numbers.grad.isfinite().all())


@pytest.mark.parametrize("splats", [Splats(torch.zeros(0, 10), torch.zeros(0, 2)), splat(u=-50.0)])
def test_where_nothing_is_all_is_let_through(backend, splats):
    numbers = splats.values.clone().requires_grad_()
    picture = rasterize(Splats(numbers, splats.reach), 11, 5)
    assert bool((picture.transmittance == 1).all())
    assert not bool(picture.color.any())
    (picture.color.sum() + picture.transmittance.sum()).backward()
    assert not bool(numbers.grad.any())


def test_weights_and_what_is_let_through_are_one(backend):
    splats = crowd_of(dtype=torch.float32)
    white = splats.values.clone()
    white[:, 6:9] = 1
    picture = rasterize(Splats(white, splats.reach), *SIZE)
    assert torch.allclose(picture.color[0] + picture.transmittance, torch.ones(()))


def test_an_ellipse_between_tiles_is_cut_nowhere(backend):
    # A needle across many tiles: those that its box touches and the ellipse does not are left out.
    particle = one((0.0, 0.0, 0.0), scale=(0.8, 0.02, 0.02), opacity=4.0, quaternion=(0.92, 0.0, 0.0, 0.38))
    splats = project(particle, still(particle), straight((40, 40)), NO_TINTS, NO_FADES)
    picture = rasterize(splats, 40, 40)
    exact = rasterize(Splats(*(t.double() for t in splats)), 40, 40)
    torch.testing.assert_close(picture.transmittance.double(), exact.transmittance, atol=1e-5, rtol=1e-5)
    assert int((picture.transmittance < 1).sum()) > 60


def test_two_threads_give_the_same(two_threads):
    splats = crowd_of(dtype=torch.float32)

    def both():
        numbers = splats.values.clone().requires_grad_()
        picture = rasterize(Splats(numbers, splats.reach), *SIZE)
        (picture.color.square().sum() + picture.depth.sum()).backward()
        return picture.color.detach(), numbers.grad

    first, again = both(), both()
    assert all(torch.equal(a, b) for a, b in zip(first, again))
    torch.set_num_threads(1)
    for a, b in zip(first, both()):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("size", "text"), [((0, 4), "expected at least 1 x 1 pixels"), ((3, -1), "3 x -1")])
def test_pictures_without_pixels_are_refused(size, text):
    with pytest.raises(ValueError, match=text):
        rasterize(splat(), *size)


def test_without_kernels_what_is_not_feasible_is_refused():
    many = Splats(splat().values.double().repeat(2000, 1), torch.ones(2000, 2, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"2,000 x 400 x 400; install forewarp\[cpu\]"):
        rasterize(many, 400, 400)


def test_splats_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r"splats.values: expected shape \(N, 10\)"):
        rasterize(Splats(torch.zeros(2, 9), torch.zeros(2, 2)), 4, 4)


def test_many_groups_in_one_picture(backend):
    particles = together(*(one((x, 0.0, 0.0), color=(x, 0.0, 0.0), opacity=6.0) for x in (-0.5, 0.0, 0.5)))
    splats = project(particles, still(particles), straight(), NO_TINTS, NO_FADES)
    picture = rasterize(splats, 16, 16)
    shown = [picture.color[0, 8, x].item() for x in (3, 8, 13)]
    assert shown == sorted(shown)
