import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from forewarp.ops import gaussians
from forewarp.ops.backend import numba_installed
from forewarp.ops.gaussians import Gaussians, compare, project, rasterize
from tests.support.gaussians import NO_FADES, NO_TINTS, SIZE, crowd, one, pinhole, still, straight


def pixels(size=SIZE, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (size[0] * size[1], 4), generator=generator).to(torch.uint8)


BEHIND = torch.tensor([0.2, 0.5, 0.9])


def run(kind, truth=None, **options):
    particles, warp, tints, fades = crowd(dtype=kind)
    truth = pixels() if truth is None else truth
    return compare(particles, warp, pinhole(), tints, fades, truth, BEHIND.to(kind), by_skin=True, **options)


NAMES = (*Gaussians._fields, "maps", "skin", "pull")


def gradients_of(found):
    return (*found.particles, found.maps, found.skin, found.pull)


@pytest.mark.parametrize("options", [{}, {"width": 0.5, "factor": 0.01}])
def test_kernel_equals_reference(options):
    exact, fast = run(torch.float64, **options), run(torch.float32, **options)
    assert fast.loss == pytest.approx(exact.loss, rel=1e-5)
    assert fast.squared == pytest.approx(exact.squared, rel=1e-5)
    for one_part, other in zip(gradients_of(exact), gradients_of(fast), strict=True):
        assert float((one_part - other).norm() / one_part.norm()) < 2e-5
    assert fast.order.tolist() == exact.order.tolist()
    assert fast.distances.shape == exact.distances.shape == fast.pull.shape
    near, away = (found.distances[found.order] for found in (fast, exact))
    torch.testing.assert_close(near.double(), away, atol=1e-5, rtol=1e-5)
    assert bool((away.diff() >= 0).all())


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])  # by the kernels, by the reference
def test_the_fused_loss_is_that_of_a_callable(kind):
    def robust(image, truth):
        assert image.shape == truth.shape == (SIZE[1], SIZE[0], 3)
        return ((image - truth).square() + 0.5**2).sqrt().sub(0.5).sum()

    fused, called = (run(kind, width=0.5, factor=0.01, loss=loss) for loss in (None, robust))
    assert called.loss == pytest.approx(fused.loss, rel=1e-5)
    assert called.squared == pytest.approx(fused.squared, rel=1e-5)
    for one_part, other in zip(gradients_of(fused), gradients_of(called), strict=True):
        assert float((one_part - other).norm() / one_part.norm()) < 2e-5
    assert called.order.tolist() == fused.order.tolist()
    assert torch.equal(called.distances[called.order], fused.distances[fused.order])


def test_gradients_of_a_loss_of_neighbouring_pixels():
    """By the kernels, against the reference in float64."""

    def edges(image, truth):
        return (image.diff(dim=1) - truth.diff(dim=1)).square().sum()

    exact, fast = (run(kind, loss=edges) for kind in (torch.float64, torch.float32))
    assert fast.loss == pytest.approx(exact.loss, rel=1e-5)
    for one_part, other in zip(gradients_of(exact), gradients_of(fast), strict=True):
        assert float((one_part - other).norm() / one_part.norm()) < 2e-5


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])  # by the kernel, by the reference
def test_gradients_of_colours_come_apart(kind):
    whole, count = run(kind).particles.colors, crowd(dtype=kind)[0].colors.shape[1]
    parts = run(kind, kinds=(1, count - 3, 2)).particles.colors
    assert [part.shape[1] for part in parts] == [1, count - 3, 2]
    assert all(part.is_contiguous() for part in parts) or kind == torch.float64
    assert torch.equal(torch.cat(parts, 1), whole)
    with pytest.raises(ValueError, match=f"kinds: expected {count} coefficients in all, but got"):
        run(kind, kinds=(1, count))


def test_the_loss_of_nothing(backend):
    nothing = Gaussians(*(t[:0] for t in one()))
    truth = torch.tensor([[255, 0, 0, 255], [0, 0, 0, 0]], dtype=torch.uint8)
    camera = straight((2, 1))
    found = compare(nothing, still(nothing), camera, NO_TINTS, NO_FADES, truth, torch.zeros(3), width=0.1)
    # Red before black; what is transparent shows what is behind it.
    assert found.squared == pytest.approx(1.0)
    assert found.loss == pytest.approx(math.sqrt(1.01) - 0.1, rel=1e-5)


def test_finite_differences():
    """In float64, of every parameter: the reference, to which kernels are held."""
    particles, warp, tints, fades = crowd(count=6, degree=0, tints=1)
    rest = (pinhole(), tints, fades, pixels(), BEHIND.double())
    found = compare(particles, warp, *rest, by_skin=True)
    numbers, step = {**particles._asdict(), "maps": warp.maps, "skin": warp.weights.log()}, 1e-6
    for name, value in numbers.items():
        slope = torch.randn(value.shape, dtype=torch.float64)
        sides = []
        for sign in (1, -1):
            near = numbers | {name: value + sign * step * slope}
            both = (
                Gaussians(*(near[of] for of in Gaussians._fields)),
                warp._replace(maps=near["maps"], weights=near["skin"].softmax(-1)),
            )
            sides.append(compare(*both, *rest).loss)
        gradient = getattr(found if name in ("maps", "skin") else found.particles, name)
        along = float((gradient * slope).sum())
        assert (sides[0] - sides[1]) / (2 * step) == pytest.approx(along, rel=1e-4, abs=1e-4), name


def test_a_perfect_picture_has_no_loss_and_no_gradient(backend):
    nothing = one((0.0, 0.0, -9.0))
    truth = torch.zeros(64, 4, dtype=torch.uint8)
    found = compare(nothing, still(nothing), straight((8, 8)), NO_TINTS, NO_FADES, truth, torch.ones(3))
    assert (found.loss, found.squared) == (0.0, 0.0)
    assert not any(bool(gradient.any()) for gradient in found.particles)
    assert not bool(found.pull.any())


def test_opaque_pictures_pull_at_what_is_seen(backend):
    particle = one(opacity=0.0)
    truth = torch.full((256, 4), 255, dtype=torch.uint8)
    found = compare(particle, still(particle), straight(), NO_TINTS, NO_FADES, truth, torch.zeros(3))
    assert found.particles.opacity.item() < 0  # more of it would be nearer to white
    assert bool((found.particles.colors[0, 0] < 0).all())
    assert found.pull.item() < 1e-3 * abs(found.particles.opacity.item()) + 1  # it stands in the middle


def test_random_backgrounds_say_where_nothing_is(backend):
    particle = one(opacity=0.0)
    truth = torch.zeros(256, 4, dtype=torch.uint8)
    found = compare(particle, still(particle), straight(), NO_TINTS, NO_FADES, truth, torch.ones(3))
    assert found.particles.opacity.item() > 0  # less of it


def test_not_a_number_is_told(backend):
    particle = one(opacity=0.0)
    broken = particle._replace(colors=particle.colors * float("nan"))
    truth = torch.zeros(256, 4, dtype=torch.uint8)
    found = compare(broken, still(broken), straight(), NO_TINTS, NO_FADES, truth, torch.ones(3))
    assert not math.isfinite(found.loss)


@pytest.fixture
def uncleared():
    """New memory holds NaN, as what a kernel forgets to write may hold anything."""
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        assert bool(torch.empty(1).isnan())
        yield
    finally:
        torch.use_deterministic_algorithms(before)


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("seen", [slice(0, 0), slice(0, 1), slice(20, 45), slice(59, 60), slice(0, 60)])
def test_what_is_not_seen_has_a_gradient_of_zero(uncleared, two_threads, monkeypatch, threads, seen):
    monkeypatch.setattr(gaussians, "match_threads", lambda: threads)
    particles, warp, tints, fades = crowd(count=60, dtype=torch.float32)
    hidden = torch.ones(60, dtype=torch.bool)
    hidden[seen] = False
    particles.opacity[hidden] = -100 * fades.sign()
    rest = (pinhole(), tints, fades, pixels(), BEHIND)
    kinds = (1, particles.colors.shape[1] - 3, 2)
    assert compare(particles, warp, *rest).skin is None
    found = compare(particles, warp, *rest, by_skin=True, kinds=kinds)
    for part in (*found.particles[:4], *found.particles.colors, found.skin, found.pull):
        assert bool(part.isfinite().all())
        assert not bool(part[hidden].any())
    assert bool(found.maps.isfinite().all())
    assert bool(found.pull.any()) == (not bool(hidden.all()))

    leaves = [part.clone().requires_grad_() for part in (*particles, warp.weights)]
    own = warp._replace(weights=leaves[5])
    splats = project(Gaussians(*leaves[:5]), own, pinhole(), tints, fades)
    (splats.values.sum() + rasterize(splats, *SIZE).color.sum()).backward()
    for leaf in leaves:
        assert bool(leaf.grad.isfinite().all())
        assert not bool(leaf.grad[hidden].any())


@pytest.mark.skipif(not numba_installed(), reason="needs Numba")
@given(
    rows=st.integers(0, 60).flatmap(
        lambda total: st.tuples(st.just(total), st.lists(st.booleans(), min_size=total, max_size=total))
    ),
    shares=st.integers(1, 7),
)
def test_threads_clear_the_rows_that_they_write(rows, shares):
    from forewarp.ops.kernels.backward import SIDE_BY_SIDE, own_rows

    total, shown = rows[0], np.flatnonzero(rows[1]).astype(np.int32)
    blocks, end = -(-len(shown) // SIDE_BY_SIDE), 0
    for share in range(shares):
        first, after = own_rows.py_func(shown, share, shares, total)
        assert first == end <= after
        low, high = (SIDE_BY_SIDE * (blocks * k // shares) for k in (share, share + 1))
        assert all(first <= row < after for row in shown[low:high])
        end = after
    assert end == total


def test_two_threads_give_the_same(two_threads):
    first, again = run(torch.float32), run(torch.float32)
    assert (first.loss, first.squared) == (again.loss, again.squared)
    for name, a, b in zip(NAMES, gradients_of(first), gradients_of(again), strict=True):
        assert bool(a.any()), name
        assert torch.equal(a, b), name
    torch.set_num_threads(1)
    alone = run(torch.float32)
    assert first.loss == pytest.approx(alone.loss, rel=1e-5)
    for a, b in zip(gradients_of(first), gradients_of(alone), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize(
    ("truth", "options", "text"),
    [
        (pixels()[:-1], {}, r"pixels: expected shape \(609, 4\)"),
        (pixels().float(), {}, "expected uint8 pixels"),
        (pixels(), {"width": 0.0}, "width > 0"),
    ],
)
def test_what_cannot_be_compared_is_refused(truth, options, text):
    with pytest.raises(ValueError, match=text):
        run(torch.float32, truth, **options)
