import math

import pytest
import torch
from torch.autograd import gradcheck

from forewarp.ops.gaussians import Gaussians, Warp, harmonics, moved, project, rotations
from forewarp.ops.lens import distort
from tests.support.gaussians import NO_FADES, NO_TINTS, SIZE, crowd, one, pinhole, still, straight, together

LENS = {"radial": (0.1, -0.05, 0.01), "tangential": (0.01, -0.02), "reach": 4.0}


def seen(particles, camera=None, warp=None):
    warp = still(particles) if warp is None else warp
    return project(particles, warp, camera or straight(), NO_TINTS, NO_FADES)


def float32(values):
    return type(values)(*(v.float() if v.is_floating_point() else v for v in values))


def test_hand_worked(backend):
    # 4 units away a unit is 10 pixels, a deviation of 0.2 two pixels, its variance 4 + 0.1.
    splats = seen(one((0.1, -0.2, 0.0), scale=0.2, opacity=math.log(3), color=(0.1, 0.2, -0.6)))
    u, v, a, b, c, solid, *color, distance = splats.values[0].tolist()
    # Beside the axis the slopes of depth add a little to the variance.
    wide, high = 4.1 + (2 * 0.1 / 4) ** 2, 4.1 + (2 * 0.2 / 4) ** 2
    beside = -(2 * 0.1 / 4) * (2 * 0.2 / 4)
    determinant = wide * high - beside**2
    assert (u, v) == pytest.approx((9.0, 6.0))
    assert (a, b, c) == pytest.approx((high / determinant, -beside / determinant, wide / determinant))
    assert solid == pytest.approx(0.75)
    assert color == pytest.approx([0.6, 0.7, 0.0], abs=1e-6)  # never below 0
    assert distance == pytest.approx(math.sqrt(16.05))
    reach = math.sqrt(2 * math.log(255 * 0.75) * wide)
    assert splats.reach[0, 0].item() == pytest.approx(reach, rel=1e-5)


def test_a_node_carries_and_turns_what_follows_it(backend):
    particle = one((0.1, 0.0, 0.0), scale=(0.3, 0.01, 0.01))
    quarter = torch.tensor([[-1.0, -1, 0, 1, -1, 0, 0, 0, 0, 0, 0.2, 0]])  # about z, then along y
    warp = Warp(quarter, torch.zeros(1, 1, dtype=torch.int32), torch.ones(1, 1))
    splats = seen(particle, warp=warp)
    assert splats.values[0, :2].tolist() == pytest.approx([8.0, 11.0], abs=1e-5)
    assert splats.values[0, 2] > 10 * splats.values[0, 4]  # a needle that now stands upright


@pytest.mark.parametrize("lens", [{}, LENS])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_kernel_equals_reference(degree, lens):
    particles, warp, tints, fades = crowd(degree=degree)
    camera = pinhole(**lens)
    exact = project(particles, warp, camera, tints, fades)
    fast = project(float32(particles), float32(warp), camera, tints.float(), fades.float())
    assert int((exact.reach[:, 0] > 0).sum()) > 40
    torch.testing.assert_close(fast.values.double(), exact.values, rtol=2e-5, atol=2e-5)
    torch.testing.assert_close(fast.reach.double(), exact.reach, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("lens", [{}, LENS])
def test_gradients_of_kernel_equal_those_of_the_reference(lens):
    particles, warp, tints, fades = crowd(degree=3)
    found = []
    for kind in (torch.float64, torch.float32):
        leaves = [t.to(kind).clone().detach().requires_grad_() for t in (*particles, warp.maps, warp.weights)]
        splats = project(
            Gaussians(*leaves[:5]),
            Warp(leaves[5], warp.links, leaves[6]),
            pinhole(**lens),
            tints.to(kind),
            fades.to(kind),
        )
        slopes = torch.randn(
            splats.values.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64
        )
        (splats.values * slopes.to(kind)).sum().backward()
        found.append([leaf.grad.double() for leaf in leaves])
    for exact, fast in zip(*found):
        assert float((exact - fast).norm() / exact.norm()) < 1e-5


def test_gradients_do_not_depend_on_how_particles_lie_in_memory():
    particles, warp, tints, fades = crowd(dtype=torch.float32)
    found = []
    for means in (particles.means, particles.means.T.contiguous().T):
        leaf = means.detach().requires_grad_()
        splats = project(particles._replace(means=leaf), warp, pinhole(), tints.float(), fades.float())
        splats.values.sum().backward()
        found.append(leaf.grad)
    assert float(found[0].norm()) > 0
    torch.testing.assert_close(found[0], found[1])


def test_gradcheck():
    particles, warp, tints, fades = crowd(count=4, degree=0)

    def numbers(*leaves):
        own = Warp(leaves[5], warp.links, leaves[6])
        return project(Gaussians(*leaves[:5]), own, pinhole(), tints, fades).values

    leaves = [t.clone().requires_grad_() for t in (*particles, warp.maps, warp.weights)]
    assert gradcheck(numbers, leaves, atol=1e-6)


def test_a_lens_bends_as_it_does_elsewhere(backend):
    particle = one((0.3, -0.2, 0.5))
    splats = seen(particle, straight(**LENS))
    plane = torch.tensor([0.3 / 4.5, -0.2 / 4.5])
    expected = 40 * distort(plane, LENS["radial"], LENS["tangential"]) + 8
    torch.testing.assert_close(splats.values[0, :2], expected)


@pytest.mark.parametrize(
    "particle",
    [
        one((0.0, 0.0, -5.0)),  # behind the camera
        one((0.0, 0.0, -4.0)),  # at it
        one((0.0, 0.0, -3.9)),  # nearer than near
        one((3.0, 0.0, -4.0)),  # beside it
        one((30.0, 0.0, 0.0)),  # far outside the picture
        one(opacity=-6.0),  # hardly there
        one(opacity=float("nan")),
        one((float("nan"), 0.0, 0.0)),
        one(scale=float("inf")),
        one(scale=1e30),
    ],
)
def test_what_is_not_seen_has_no_reach_and_no_gradient(backend, particle):
    leaves = Gaussians(*(t.clone().requires_grad_() for t in particle))
    splats = seen(leaves)
    assert splats.reach.tolist() == [[0.0, 0.0]]
    assert splats.values.tolist() == [[0.0] * 10]
    if all(bool(t.isfinite().all()) for t in particle):
        splats.values.sum().backward()
        assert not any(bool(leaf.grad.any()) for leaf in leaves if leaf.grad is not None)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-5, 5.0, (1.0, 1e-6, 1e-6), (1.0, 1.0, 0.0)])
@pytest.mark.parametrize("opacity", [-5.0, 0.0, 40.0])
@pytest.mark.parametrize("quaternion", [(1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), (1e-9, 3e8, -2e8, 1e8)])
def test_extreme_particles_are_finite(backend, scale, opacity, quaternion):
    particle = one((0.1, 0.1, 0.0), scale=scale, opacity=opacity, quaternion=quaternion)
    leaves = Gaussians(*(t.clone().requires_grad_() for t in particle))
    splats = seen(leaves)
    assert bool(splats.values.isfinite().all())
    assert splats.reach[0, 0] > 0
    splats.values.sum().backward()
    assert all(bool(leaf.grad.isfinite().all()) for leaf in leaves)


def test_a_quaternion_of_length_0_turns_nothing(backend):
    flat = seen(one(scale=(0.3, 0.1, 0.2), quaternion=(0.0, 0.0, 0.0, 0.0))).values
    torch.testing.assert_close(flat, seen(one(scale=(0.3, 0.1, 0.2))).values)


def test_no_particles_at_all(backend):
    particles, warp, tints, fades = crowd(count=0, dtype=torch.float32)
    splats = project(particles, warp, pinhole(), tints, fades)
    assert splats.values.shape == (0, 10)


def test_time_changes_colour_and_opacity(backend):
    particles = one()._replace(opacity=torch.tensor([[0.5, 2.0]]), colors=torch.ones(1, 2, 3))
    splats = project(particles, still(particles), straight(), torch.tensor([0.1]), torch.tensor([1.0, -0.5]))
    assert splats.values[0, 5].item() == pytest.approx(1 / (1 + math.exp(0.5)))
    assert splats.values[0, 6].item() == pytest.approx(0.5 + 0.28209479 + 0.1)


def test_harmonics_are_orthonormal():
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(200_000, 3, generator=generator, dtype=torch.float64)
    basis = harmonics(torch.nn.functional.normalize(directions, dim=-1), 16)
    product = 4 * math.pi * basis.T @ basis / len(basis)
    torch.testing.assert_close(product, torch.eye(16, dtype=torch.float64), atol=0.03, rtol=0)


def test_rotations_are_rotations():
    turned = rotations(torch.randn(20, 4, dtype=torch.float64))
    torch.testing.assert_close(turned @ turned.mT, torch.eye(3, dtype=torch.float64).expand(20, 3, 3))
    torch.testing.assert_close(torch.linalg.det(turned), torch.ones(20, dtype=torch.float64))


def test_moved_by_nothing_is_the_identity():
    particles = together(one((1.0, 2.0, 3.0)), one((0.0, -1.0, 0.5)))
    points, linear = moved(particles.means, still(particles))
    assert torch.equal(points, particles.means)
    assert torch.equal(linear, torch.eye(3).expand(2, 3, 3))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"means": torch.zeros(2, 3)},
            r"means: expected shape \(60, 3\)|log_scales: expected shape \(2, 3\)",
        ),
        ({"colors": torch.zeros(60, 7, 3)}, "colors: expected 1, 4, 9 or 16 coefficients of direction"),
        ({"opacity": torch.zeros(60, 3)}, r"opacity: expected shape \(60, 2\)"),
        ({"quaternions": torch.zeros(60, 3)}, r"quaternions: expected shape \(60, 4\)"),
    ],
)
def test_shapes_that_do_not_go_together_are_refused(changes, text):
    particles, warp, tints, fades = crowd()
    with pytest.raises(ValueError, match=text):
        project(particles._replace(**changes), warp, pinhole(), tints, fades)


def test_maps_of_another_shape_are_refused():
    particles, warp, tints, fades = crowd()
    with pytest.raises(ValueError, match=r"maps: expected shape \(M, 12\)"):
        project(particles, warp._replace(maps=torch.zeros(5, 9)), pinhole(SIZE), tints, fades)
