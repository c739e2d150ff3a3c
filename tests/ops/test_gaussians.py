import math

import numpy as np
import pytest
import torch

from forewarp.ops import gaussians
from forewarp.ops.gaussians import (
    CHUNK,
    Gaussians,
    Splats,
    Warp,
    compare,
    harmonics,
    project,
    rasterize,
    rasterize_reference,
)
from forewarp.ops.layout import COLUMN, LOG_MIN_ALPHA
from forewarp.ops.lens import distort
from tests.support.gaussians import NO_FADES, NO_TINTS, SIZE, crowd, one, pinhole, still, straight

F32, F64 = torch.float32, torch.float64
LENS = {"radial": (0.1, -0.05, 0.01), "tangential": (0.01, -0.02), "reach": 4.0}


def leaves_of(particles, kind=None):
    return Gaussians(*(t.detach().clone().to(kind or t.dtype).requires_grad_() for t in particles))


def close_in_norm(exact, fast, share):
    for first, second in zip(exact, fast, strict=True):
        assert float((first - second).norm() / first.norm()) < share


def seen(particles, camera=None, warp=None):
    return project(particles, warp or still(particles), camera or straight(), NO_TINTS, NO_FADES)


def seen_crowd(kind, count=60, lens=None, **changes):
    """Splats of a crowd, and the leaves: Gaussians, maps, weights."""
    particles, warp, *bases = crowd(count, **changes)
    particles = particles._replace(means=particles.means.T.contiguous().T)  # columns side by side
    particles = leaves_of(particles, kind)
    maps, weights = (t.to(kind).clone().requires_grad_() for t in (warp.maps, warp.weights))
    warp = Warp(maps, warp.links, weights)
    splats = project(particles, warp, pinhole(**lens or {}), *(basis.to(kind) for basis in bases))
    return splats, (*particles, maps, weights)


def test_project_hand_worked(backend):
    # 4 units away a unit is 10 pixels, a deviation of 0.2 two pixels, its variance 4 + 0.1.
    splats = seen(one((0.1, -0.2, 0.0), scale=0.2, opacity=math.log(3), color=(0.1, 0.2, -0.6)))
    x, y, a, b, c, *rest = splats.values[0].tolist()
    # Beside the axis the Jacobian's column of depth adds a little to the variance.
    wide, high = 4.1 + (2 * 0.1 / 4) ** 2, 4.1 + (2 * 0.2 / 4) ** 2
    beside = -(2 * 0.1 / 4) * (2 * 0.2 / 4)
    determinant = wide * high - beside**2
    assert (x, y) == pytest.approx((9.0, 6.0))
    assert (a, b, c) == pytest.approx((high / determinant, -beside / determinant, wide / determinant))
    assert rest == pytest.approx([0.75, 0.6, 0.7, 0.0, math.sqrt(16.05)], abs=1e-6)  # no colour is below 0
    assert splats.reach[0, 0].item() == pytest.approx(math.sqrt(2 * math.log(255 * 0.75) * wide), rel=1e-5)


def test_a_node_carries_and_rotates_what_follows_it(backend):
    particle = one((0.1, 0.0, 0.0), scale=(0.3, 0.01, 0.01))
    quarter = torch.tensor([[-1.0, -1, 0, 1, -1, 0, 0, 0, 0, 0, 0.2, 0]])  # about z, then along y
    warp = Warp(quarter, torch.zeros(1, 1, dtype=torch.int32), torch.ones(1, 1))
    x, y, a, _, c, *_ = seen(particle, warp=warp).values[0].tolist()
    assert (x, y) == pytest.approx((8.0, 11.0), abs=1e-5)
    assert a > 10 * c  # a needle that now stands upright
    flat = seen(one(scale=(0.3, 0.1, 0.2), quaternion=(0.0, 0.0, 0.0, 0.0))).values  # rotates nothing
    torch.testing.assert_close(flat, seen(one(scale=(0.3, 0.1, 0.2))).values)


@pytest.mark.parametrize("lens", [{}, LENS])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_project_by_the_kernel_equals_the_reference(degree, lens):
    (exact, slow), (fast, leaves) = (seen_crowd(kind, lens=lens, degree=degree) for kind in (F64, F32))
    assert int((exact.reach[:, 0] > 0).sum()) > 40
    torch.testing.assert_close(fast.values.double(), exact.values, rtol=2e-5, atol=2e-5)
    torch.testing.assert_close(fast.reach.double(), exact.reach, rtol=2e-5, atol=2e-5)
    factors = torch.randn(exact.values.shape, generator=torch.Generator().manual_seed(1), dtype=F64)
    for splats in (exact, fast):
        (splats.values * factors.to(splats.values)).sum().backward()
    close_in_norm([leaf.grad for leaf in slow], [leaf.grad for leaf in leaves], 1e-5)


def test_a_lens_distorts_as_it_does_elsewhere(backend):
    splats = seen(one((0.3, -0.2, 0.5)), straight(**LENS))
    plane = torch.tensor([0.3 / 4.5, -0.2 / 4.5])
    expected = 40 * distort(plane, LENS["radial"], LENS["tangential"]) + 8
    torch.testing.assert_close(splats.values[0, :2], expected)


@pytest.mark.parametrize(
    "particle",
    [
        # behind the camera, at it, nearer than near, beside it, far outside the image
        *map(one, ((0.0, 0, -5), (0.0, 0, -4), (0.0, 0, -3.9), (3.0, 0, -4), (30.0, 0, 0))),
        one(opacity=-6.0),  # hardly there
        one(opacity=float("nan")),
        one((float("nan"), 0.0, 0.0)),
        one(scale=float("inf")),
        one(scale=1e30),
    ],
)
def test_what_is_not_seen_has_no_reach_and_no_gradient(backend, particle):
    leaves = leaves_of(particle)
    splats = seen(leaves)
    assert splats.reach.tolist() == [[0.0, 0.0]]
    assert splats.values.tolist() == [[0.0] * 10]
    if all(bool(t.isfinite().all()) for t in particle):
        splats.values.sum().backward()
        assert not any(bool(leaf.grad.any()) for leaf in leaves if leaf.grad is not None)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-5, 5.0, (1.0, 1e-6, 1e-6), (1.0, 1.0, 0.0)])
@pytest.mark.parametrize(
    ("opacity", "quaternion"),
    [(-5.0, (0.0, 0, 0, 0)), (0.0, (1.0, 0, 0, 0)), (40.0, (1e-9, 3e8, -2e8, 1e8))],
)
def test_extreme_particles_are_finite(backend, scale, opacity, quaternion):
    leaves = leaves_of(one((0.1, 0.1, 0.0), scale=scale, opacity=opacity, quaternion=quaternion))
    splats = seen(leaves)
    assert bool(splats.values.isfinite().all())
    assert splats.reach[0, 0] > 0
    splats.values.sum().backward()
    assert all(bool(leaf.grad.isfinite().all()) for leaf in leaves)


def test_time_changes_colour_and_opacity(backend):
    particles = one()._replace(opacity=torch.tensor([[0.5, 2.0]]), colors=torch.ones(1, 2, 3))
    splats = project(particles, still(particles), straight(), torch.tensor([0.1]), torch.tensor([1.0, -0.5]))
    assert splats.values[0, COLUMN.opacity].item() == pytest.approx(1 / (1 + math.exp(0.5)))
    assert splats.values[0, COLUMN.red].item() == pytest.approx(0.5 + 0.28209479 + 0.1)


def test_harmonics_are_orthonormal():
    directions = torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    basis = harmonics(torch.nn.functional.normalize(directions, dim=-1), 16)
    product = 4 * math.pi * basis.T @ basis / len(basis)
    torch.testing.assert_close(product, torch.eye(16, dtype=F64), atol=0.07, rtol=0)


def test_rotations_are_rotations():
    matrices = gaussians.rotations(torch.randn(20, 4, dtype=F64))
    torch.testing.assert_close(matrices @ matrices.mT, torch.eye(3, dtype=F64).expand(20, 3, 3))
    torch.testing.assert_close(torch.linalg.det(matrices), torch.ones(20, dtype=F64))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"means": torch.zeros(2, 3)}, r"log_scales: expected shape \(2, 3\)"),
        ({"colors": torch.zeros(60, 7, 3)}, "colors: expected 1, 4, 9 or 16 coefficients of direction"),
        ({"opacity": torch.zeros(60, 3)}, r"opacity: expected shape \(60, 2\)"),
        ({"quaternions": torch.zeros(60, 3)}, r"quaternions: expected shape \(60, 4\)"),
        ({"maps": torch.zeros(5, 9)}, r"maps: expected shape \(M, 12\)"),
    ],
)
def test_shapes_that_do_not_go_together_are_refused(changes, text):
    particles, warp, *rest = crowd()
    maps = changes.pop("maps", warp.maps)
    with pytest.raises(ValueError, match=text):
        project(particles._replace(**changes), warp._replace(maps=maps), pinhole(), *rest)


ACROSS, DOWN, TILE = 5, 4, 8


def splats_of(count, *, widest=9.0, seed=0):
    """Random splats (N, 16), some of them beside the image."""
    draw, splats = np.random.default_rng(seed), np.zeros((count, 16), np.float32)
    splats[:, :2] = draw.uniform((-9, -9), (TILE * ACROSS + 9, TILE * DOWN + 9), (count, 2))
    root = draw.normal(size=(count, 2, 2)) * draw.uniform(0.1, widest, (count, 1, 1)) * 0.5
    covariance = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(2)
    splats[:, COLUMN.conic_a : COLUMN.opacity] = np.linalg.inv(covariance).reshape(-1, 4)[:, [0, 1, 3]]
    splats[:, COLUMN.opacity], splats[:, COLUMN.depth] = draw.uniform((0.01, 1), (1, 5), (count, 2)).T
    splats[:, COLUMN.log_opacity] = np.log(splats[:, COLUMN.opacity])
    level = 2 * np.log(255 * splats[:, COLUMN.opacity, None])
    splats[:, COLUMN.reach_x : COLUMN.log_opacity] = np.sqrt(level * covariance[:, (0, 1), (0, 1)])
    return splats


def touched(splat):
    """The tiles (down, across) that have a pixel where a splat covers a 255th or more."""
    x, y = np.arange(TILE * ACROSS) + 0.5 - splat[0], (np.arange(TILE * DOWN) + 0.5 - splat[1])[:, None]
    power = -0.5 * (splat[2] * x * x + splat[4] * y * y) - splat[3] * x * y + splat[COLUMN.log_opacity]
    return (power > -np.log(255)).reshape(DOWN, TILE, ACROSS, TILE).any((1, 3))


def sorted_by(splats, threads):
    """The splats that each tile looks at, in its order, the records, and the rows in order of depth."""
    pytest.importorskip("numba", reason="no numba: pip install forewarp[cpu]")
    tiles = gaussians._sorted_tiles(splats, TILE * ACROSS - 3, TILE * DOWN, threads)
    records, entries, ends, shares = tiles.lists
    assert (len(ends), ends[-1]) == (ACROSS * DOWN + 1, len(entries))
    assert (shares[0], shares[-1], len(shares)) == (0, ACROSS * DOWN, threads + 1)
    assert (np.diff(shares) >= 0).all()
    assert tiles.longest == np.diff(ends).max()
    return [tiles.order[entries[a:b]].tolist() for a, b in zip(ends, ends[1:])], records, tiles.order


@pytest.mark.parametrize(
    ("count", "widest"), [(0, 9.0), (1, 9.0), (15, 0.5), (16, 200.0), (17, 9.0), (100, 0.5), (100, 200.0)]
)
def test_each_tile_looks_at_what_touches_it(count, widest):
    splats = splats_of(count, widest=widest)
    tiles, records, order = sorted_by(splats, 1)
    needed = [touched(splat) for splat in splats]
    for tile, found in enumerate(tiles):
        row, column = divmod(tile, ACROSS)
        assert {k for k in range(count) if needed[k][row, column]} <= set(found)
        assert len(found) == len(set(found))
        assert found == sorted(found, key=lambda k: splats[k, COLUMN.depth])
    looked, least = sum(map(len, tiles)), sum(int(n.sum()) for n in needed)
    assert looked <= 1.35 * least + 10  # little is looked at in vain
    expected = splats[order, :10] * [1, 1, -0.5, -1.0, -0.5, 1, 1, 1, 1, 1]
    expected[:, COLUMN.opacity] = splats[order, COLUMN.log_opacity]
    np.testing.assert_allclose(records, expected, rtol=1e-6)


@pytest.mark.parametrize(("count", "threads"), [(1, 2), (17, 3), (100, 40)])
def test_threads_do_not_change_the_tiles(count, threads):
    alone, several = sorted_by(splats_of(count), 1), sorted_by(splats_of(count), threads)
    assert several[0] == alone[0]
    np.testing.assert_array_equal(several[1], alone[1])


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e30])
@pytest.mark.parametrize("column", ["x", "conic_a", "conic_b", "reach_y"])
def test_numbers_that_mean_nothing_spoil_no_other_splat(bad, column):
    splats = splats_of(40)
    wanted, _, _ = sorted_by(np.delete(splats, 20, 0), 1)
    splats[20, getattr(COLUMN, column)] = bad
    found, _, _ = sorted_by(splats, 2)
    assert [[k - (k > 20) for k in tile if k != 20] for tile in found] == wanted


def splat(x=8.5, y=8.5, opacity=0.5, color=(1.0, 0.0, 0.5), depth=3.0, conic=(1.0, 0.0, 1.0), reach=6.0):
    return Splats(torch.tensor([[x, y, *conic, opacity, *color, depth]]), torch.full((1, 2), reach))


def joined(*parts):
    return Splats(*(torch.cat(columns) for columns in zip(*parts)))


def crowd_of(kind=F64, **changes):
    return Splats(*(t.detach().to(kind) for t in seen_crowd(F64, **changes)[0]))


def drawn(splats, size=SIZE):
    """All planes (5, H, W), and the leaf by which they are differentiable."""
    values = splats.values.clone().requires_grad_()
    image = rasterize(Splats(values, splats.reach), *size)
    return torch.cat([image.color, image.depth[None], image.transmittance[None]]), values


def test_rasterize_hand_worked(backend):
    near = splat(color=(1.0, 0.0, 0.0), opacity=0.5, depth=2.0)
    far = splat(color=(0.0, 1.0, 0.0), opacity=0.25, depth=4.0)
    image = rasterize(joined(far, near), 16, 16)  # the nearer one is drawn first, whatever its row
    assert image.color[:, 8, 8].tolist() == pytest.approx([0.5, 0.125, 0.0], abs=1e-6)
    assert image.transmittance[8, 8].item() == pytest.approx(0.375, abs=1e-6)
    assert image.depth[8, 8].item() == pytest.approx(0.5 * 2 + 0.125 * 4, abs=1e-5)
    beside = 0.5 * math.exp(-0.5 * 4)  # two pixels away
    assert image.color[0, 8, 10].item() == pytest.approx(beside, rel=1e-5)


def test_equal_depths_keep_their_order(backend):
    first, second = splat(color=(1.0, 0.0, 0.0), opacity=0.9), splat(color=(0.0, 1.0, 0.0), opacity=0.9)
    image = rasterize(joined(first, second), 16, 16)
    assert image.color[:, 8, 8].tolist() == pytest.approx([0.9, 0.09, 0.0], abs=1e-6)


def test_nothing_below_a_255th(backend):
    image = rasterize(splat(opacity=0.5, reach=16.0), 16, 16)
    beyond = math.sqrt(2 * math.log(255 * 0.5))
    x = torch.arange(16) + 0.5 - 8.5
    away = (x.square() + x[:, None].square()).sqrt()
    assert bool((image.transmittance[away > beyond + 1e-4] == 1).all())
    assert bool((image.transmittance[away < beyond - 1e-4] < 1).all())


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (7, 9), SIZE, (64, 3)])
def test_rasterize_by_the_kernel_equals_the_reference(size):
    (exact, slow), (fast, values) = (drawn(crowd_of(kind), size) for kind in (F64, F32))
    assert exact.shape == (5, size[1], size[0])
    torch.testing.assert_close(fast.double(), exact, rtol=2e-5, atol=2e-5)
    factors = torch.randn(exact.shape, generator=torch.Generator().manual_seed(2), dtype=F64)
    for planes in (exact, fast):
        (planes * factors.to(planes)).sum().backward()
    if size == SIZE:
        close_in_norm(slow.grad.T, values.grad.T, 2e-5)  # column by column


def dense(splats, width, height):
    """The reference without tiles: a number for each splat and pixel."""
    values = splats.values[splats.values.detach()[:, COLUMN.depth].sort(stable=True).indices]
    x, y, a, b, c, solid = values[:, : COLUMN.red, None, None].unbind(1)
    dx = torch.arange(width) + 0.5 - x
    dy = (torch.arange(height) + 0.5)[:, None] - y
    power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy + solid.log()
    alpha = torch.where(power > LOG_MIN_ALPHA, power.exp(), 0.0)
    passed = torch.cumprod(torch.cat([alpha.new_ones(1, height, width), 1 - alpha]), 0)
    shown = torch.einsum("vhw,vk->khw", alpha * passed[:-1], values[:, COLUMN.red :])
    return torch.cat([shown, passed[-1:]])


@pytest.mark.parametrize("chunk", [1, 1000, CHUNK])
def test_the_reference_by_tiles_equals_that_without(chunk):
    results = []
    for draw in (dense, lambda *given: rasterize_reference(*given, chunk)):
        splats = crowd_of(F64)
        shown = splats.reach[:, 0] > 0
        leaf = splats.values[shown].detach().clone().requires_grad_()
        planes = draw(Splats(leaf, splats.reach[shown]), 37, 21)
        factors = torch.randn(planes.shape, generator=torch.Generator().manual_seed(2), dtype=F64)
        (planes * factors).sum().backward()
        results.append((planes.detach(), leaf.grad))
    for dense_one, tiled in zip(*results):
        torch.testing.assert_close(tiled, dense_one)


@pytest.mark.parametrize("splats", [Splats(torch.zeros(0, 10), torch.zeros(0, 2)), splat(x=-50.0)])
def test_where_nothing_is_all_is_let_through(backend, splats):
    planes, leaf = drawn(splats, (11, 5))
    assert bool((planes[4] == 1).all())
    assert not bool(planes[:4].any())
    planes.sum().backward()
    assert not bool(leaf.grad.any())


def test_weights_and_what_is_let_through_are_one(backend):
    splats = crowd_of(F32)
    splats.values[:, COLUMN.red : COLUMN.depth].fill_(1)
    planes, _ = drawn(splats)
    torch.testing.assert_close(planes[0] + planes[4], torch.ones(SIZE[1], SIZE[0]))


@pytest.mark.parametrize(
    ("splats", "size", "text"),
    [
        (splat(), (0, 4), "expected at least 1 x 1 pixels"),
        (splat(), (3, -1), "3 x -1"),
        (Splats(torch.zeros(2, 9), torch.zeros(2, 2)), (4, 4), r"splats.values: expected shape \(N, 10\)"),
    ],
)
def test_what_cannot_be_drawn_is_refused(splats, size, text):
    with pytest.raises(ValueError, match=text):
        rasterize(splats, *size)


BEHIND = torch.tensor([0.2, 0.5, 0.9])


def pixels(size=SIZE, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (size[0] * size[1], 4), generator=generator).to(torch.uint8)


def run(kind, truth=None, **options):
    particles, warp, *bases = crowd(dtype=kind)
    truth = pixels() if truth is None else truth
    return compare(particles, warp, pinhole(), *bases, truth, BEHIND.to(kind), by_skin=True, **options)


def alone(particle, truth, background, size=(16, 16), **options):
    truth = torch.tensor([truth], dtype=torch.uint8).expand(size[0] * size[1], 4)
    view = still(particle), straight(size), NO_TINTS, NO_FADES
    return compare(particle, *view, truth, torch.full((3,), background), **options)


def gradients_of(compared):
    return (*compared.particles, compared.maps, compared.skin, compared.pixel_gradient)


def sensed(kind=F64, seed=3):
    """Depths about the crowd's, a third of them holes, and confidences."""
    generator = torch.Generator().manual_seed(seed)
    depth, trust, hole = torch.rand(3, SIZE[0] * SIZE[1], generator=generator, dtype=F64)
    return torch.stack([torch.where(hole < 0.3, 0.0, 3 + 2 * depth), trust]).to(kind)


def edges(image, truth):
    """A loss of neighbouring pixels."""
    return (image.diff(dim=1) - truth.diff(dim=1)).square().sum()


VALID = torch.arange(SIZE[0] * SIZE[1]) % 3 > 0


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"width": 0.5, "factor": 0.01},
        {"valid": VALID},
        {"sensed": sensed(), "by_depth": 2.5, "deep": 0.2},
        {"sensed": sensed(), "valid": VALID, "factor": 0.01},
        {"loss": edges},
    ],
)
def test_compare_by_the_kernel_equals_the_reference(options):
    exact, fast = run(F64, **options), run(F32, **options)
    assert fast.loss == pytest.approx(exact.loss, rel=1e-5)
    assert fast.squared == pytest.approx(exact.squared, rel=1e-5)
    assert fast.depth == pytest.approx(exact.depth, rel=1e-5)
    assert (exact.depth > 0) == ("sensed" in options)
    close_in_norm(gradients_of(exact), gradients_of(fast), 2e-5)
    assert fast.order.tolist() == exact.order.tolist()
    assert fast.distances.shape == exact.distances.shape == fast.pixel_gradient.shape
    near, depths = (compared.distances[compared.order] for compared in (fast, exact))
    torch.testing.assert_close(near.double(), depths, atol=1e-5, rtol=1e-5)
    assert bool((depths.diff() >= 0).all())


@pytest.mark.parametrize("kind", [F32, F64])  # by the kernel, by the reference
def test_gradients_of_colours_come_apart(kind):
    whole, count = run(kind).particles.colors, crowd(dtype=kind)[0].colors.shape[1]
    parts = run(kind, kinds=(1, count - 3, 2)).particles.colors
    assert [part.shape[1] for part in parts] == [1, count - 3, 2]
    assert all(part.is_contiguous() for part in parts) or kind == F64
    assert torch.equal(torch.cat(parts, 1), whole)


def test_the_loss_of_nothing(backend):
    nothing = Gaussians(*(t[:0] for t in one()))
    compared = alone(nothing, (255, 0, 0, 255), 0.0, (2, 1), width=0.1)  # red before black
    assert compared.squared == pytest.approx(2.0)
    assert compared.loss == pytest.approx(2 * (math.sqrt(1.01) - 0.1), rel=1e-5)
    assert alone(nothing, (255, 0, 0, 0), 0.0).loss == 0  # what is transparent shows what is behind it


def test_depth_pulls_along_the_ray_and_says_nothing_of_opacity(backend):
    """A particle at distance 4, of a ray on which 4, 5 or nothing was measured; colour asks for nothing."""
    gray = {"truth": (127, 127, 127, 255), "background": 0.498, "deep": 0.01}
    known = torch.full((2, 256), 4.0)
    known[1] = 1.0
    right = alone(one(scale=0.3), **gray, sensed=known)
    wrong = alone(one(scale=0.3), **gray, sensed=known * torch.tensor([[1.25], [1.0]]))
    none = alone(one(scale=0.3), **gray, sensed=known * torch.tensor([[0.0], [1.0]]))
    doubted = alone(one(scale=0.3), **gray, sensed=known * torch.tensor([[1.25], [0.25]]))
    assert right.depth < 1e-3 * wrong.depth
    assert wrong.particles.means[0, 2].item() < -1  # farther would be better
    assert wrong.particles.opacity.item() > 0  # and less of it
    assert abs(right.particles.opacity.item()) < 1e-3 * wrong.particles.opacity.item()
    assert none.depth == 0
    assert doubted.depth == pytest.approx(wrong.depth / 4, rel=1e-5)
    pulled = wrong.particles.means[0, 2].item() / 4
    assert doubted.particles.means[0, 2].item() == pytest.approx(pulled, rel=1e-3)


def test_a_perfect_image_has_no_loss_and_no_gradient(backend):
    compared = alone(one((0.0, 0.0, -9.0)), (0, 0, 0, 0), 1.0)
    assert (compared.loss, compared.squared) == (0.0, 0.0)
    assert not any(bool(gradient.any()) for gradient in (*compared.particles, compared.pixel_gradient))


def test_images_pull_at_what_is_seen_and_backgrounds_say_where_nothing_is(backend):
    opaque, empty = alone(one(), (255, 255, 255, 255), 0.0), alone(one(), (0, 0, 0, 0), 1.0)
    assert opaque.particles.opacity.item() < 0  # more of it would be nearer to white
    assert bool((opaque.particles.colors[0, 0] < 0).all())
    most = 1e-3 * abs(opaque.particles.opacity.item()) + 1  # it stands in the middle
    assert opaque.pixel_gradient.item() < most
    assert empty.particles.opacity.item() > 0  # less of it


def test_not_a_number_is_told(backend):
    broken = one()._replace(colors=torch.full((1, 1, 3), float("nan")))
    assert not math.isfinite(alone(broken, (0, 0, 0, 0), 1.0).loss)


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("shown", [slice(0, 0), slice(0, 1), slice(20, 45), slice(59, 60), slice(0, 60)])
def test_of_many_only_what_is_seen_has_gradients(two_threads, monkeypatch, threads, shown):
    # New memory holds NaN, as what a kernel forgets to write may hold anything.
    empty = torch.empty
    monkeypatch.setattr(torch, "empty", lambda *size: empty(*size).fill_(torch.nan))
    monkeypatch.setattr(gaussians, "match_threads", lambda: threads)
    particles, warp, *bases = crowd(count=60, dtype=F32)
    hidden = torch.ones(60, dtype=torch.bool)
    hidden[shown] = False
    particles.opacity[hidden] = -100 * bases[1].sign()
    rest = (pinhole(), *bases, pixels(), BEHIND)
    kinds = (1, particles.colors.shape[1] - 3, 2)
    assert compare(particles, warp, *rest).skin is None
    compared = compare(particles, warp, *rest, by_skin=True, kinds=kinds)
    for part in (*compared.particles[:4], *compared.particles.colors, compared.skin, compared.pixel_gradient):
        assert bool(part.isfinite().all())
        assert not bool(part[hidden].any())
    assert bool(compared.maps.isfinite().all())
    assert bool(compared.pixel_gradient.any()) == (not bool(hidden.all()))

    leaves, weights = leaves_of(particles), warp.weights.clone().requires_grad_()
    splats = project(leaves, warp._replace(weights=weights), pinhole(), *bases)
    (splats.values.sum() + rasterize(splats, *SIZE).color.sum()).backward()
    for leaf in (*leaves, weights):
        assert bool(leaf.grad.isfinite().all())
        assert not bool(leaf.grad[hidden].any())


def test_two_threads_give_the_same(two_threads):
    def gradients():
        compared, (planes, leaf) = run(F32), drawn(crowd_of(F32))
        planes[:4].square().sum().backward()
        return torch.tensor([compared.loss]), *gradients_of(compared), planes.detach(), leaf.grad

    first, again = gradients(), gradients()
    assert all(bool(a.any()) and torch.equal(a, b) for a, b in zip(first, again))
    torch.set_num_threads(1)
    for a, b in zip(first, gradients()):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize(
    ("truth", "options", "text"),
    [
        (pixels()[:-1], {}, r"pixels: expected shape \(609, 4\)"),
        (pixels().float(), {}, "expected uint8 pixels"),
        (pixels(), {"width": 0.0}, "width > 0"),
        (pixels(), {"sensed": sensed()[:, :-1]}, r"sensed: expected shape \(2, 609\)"),
        (pixels(), {"valid": VALID[1:]}, r"valid: expected shape \(609\)"),
        (pixels(), {"kinds": (1, 2)}, "kinds: expected 11 coefficients in all, but got"),
    ],
)
def test_what_cannot_be_compared_is_refused(truth, options, text):
    with pytest.raises(ValueError, match=text):
        run(F32, truth, **options)


@pytest.mark.parametrize("kind", [F32, F64])  # by the kernels, by the reference
def test_the_fused_loss_is_that_of_a_callable(kind):
    def robust(image, truth):
        assert image.shape == truth.shape == (SIZE[1], SIZE[0], 3)
        return ((image - truth).square() + 0.5**2).sqrt().sub(0.5).sum()

    options = {"width": 0.5, "factor": 0.01, "sensed": sensed(kind), "by_depth": 3.0, "valid": VALID}
    fused, called = (run(kind, **options, loss=loss) for loss in (None, robust))
    assert called.depth == pytest.approx(fused.depth, rel=1e-5)
    assert called.loss == pytest.approx(fused.loss, rel=1e-5)
    assert called.squared == pytest.approx(fused.squared, rel=1e-5)
    close_in_norm(gradients_of(fused), gradients_of(called), 2e-5)
    assert called.order.tolist() == fused.order.tolist()
    assert torch.equal(called.distances[called.order], fused.distances[fused.order])


def test_gradients_of_a_loss_of_neighbouring_pixels():
    """By the kernels, against the reference in float64."""

    def edges(image, truth):
        return (image.diff(dim=1) - truth.diff(dim=1)).square().sum()

    exact, fast = (run(kind, loss=edges) for kind in (F64, F32))
    assert fast.loss == pytest.approx(exact.loss, rel=1e-5)
    close_in_norm(gradients_of(exact), gradients_of(fast), 2e-5)
