"""Splats sorted into tiles: which tiles look at which splats, for any number of them and of threads."""

import numpy as np
import pytest

pytest.importorskip("numba", reason="no numba: pip install forewarp[cpu]")

from forewarp.ops.kernels import rasterize as kernels

ACROSS, DOWN, SIDE = 5, 4, 8


def splats_of(count, *, widest=9.0, seed=0):
    """Random splats (N, 16), some of them beside the picture."""
    draw = np.random.default_rng(seed)
    found = np.zeros((count, 16), np.float32)
    found[:, :2] = draw.uniform((-9, -9), (SIDE * ACROSS + 9, SIDE * DOWN + 9), (count, 2))
    root = draw.normal(size=(count, 2, 2)) * draw.uniform(0.1, widest, (count, 1, 1)) * 0.5
    covariance = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(2)
    inverse = np.linalg.inv(covariance)
    found[:, 2], found[:, 3], found[:, 4] = inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]
    found[:, 5], found[:, 9] = draw.uniform(0.01, 1.0, count), draw.uniform(1.0, 5.0, count)
    reach = 2 * np.log(255 * found[:, 5])
    found[:, 10], found[:, 11] = (np.sqrt(reach * covariance[:, k, k]) for k in (0, 1))
    found[:, 12] = np.log(found[:, 5])
    return found


def touched(splat):
    """The tiles (down, across) that have a pixel where a splat covers a 255th or more."""
    x, y = np.arange(SIDE * ACROSS) + 0.5 - splat[0], (np.arange(SIDE * DOWN) + 0.5 - splat[1])[:, None]
    power = -0.5 * (splat[2] * x * x + splat[4] * y * y) - splat[3] * x * y + splat[12]
    return (power > -np.log(255)).reshape(DOWN, SIDE, ACROSS, SIDE).any((1, 3))


def sorted_by(splats, shares):
    """The splats that each tile looks at, in its order, and the records."""
    order = kernels.by_depth(splats)
    records, entries, ends = kernels.sort_into_tiles(splats, order, ACROSS, DOWN, shares)
    assert len(ends) == ACROSS * DOWN + 1
    assert ends[-1] == len(entries)
    return [order[entries[a:b]].tolist() for a, b in zip(ends, ends[1:])], records, order


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 100])
@pytest.mark.parametrize("widest", [0.5, 9.0, 200.0])
def test_each_tile_looks_at_what_touches_it(count, widest):
    splats = splats_of(count, widest=widest)
    tiles, records, order = sorted_by(splats, 1)
    needed = [touched(splat) for splat in splats]
    for tile, found in enumerate(tiles):
        row, column = divmod(tile, ACROSS)
        assert {k for k in range(count) if needed[k][row, column]} <= set(found)
        assert len(found) == len(set(found))
        assert found == sorted(found, key=lambda k: splats[k, 9])
    looked, least = sum(map(len, tiles)), sum(int(n.sum()) for n in needed)
    assert looked <= 1.35 * least + 10  # little is looked at in vain
    np.testing.assert_array_equal(records[:, :2], splats[order, :2])
    np.testing.assert_allclose(records[:, 2:5], splats[order, 2:5] * [-0.5, -1.0, -0.5], rtol=1e-6)
    np.testing.assert_array_equal(records[:, 5], splats[order, 12])
    np.testing.assert_array_equal(records[:, 6:], splats[order, 6:10])


@pytest.mark.parametrize("count", [1, 17, 100])
@pytest.mark.parametrize("shares", [2, 3, 40])
def test_threads_do_not_change_it(count, shares):
    splats = splats_of(count)
    alone, together = sorted_by(splats, 1), sorted_by(splats, shares)
    assert together[0] == alone[0]
    np.testing.assert_array_equal(together[1], alone[1])


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e30])
@pytest.mark.parametrize("column", [0, 1, 2, 3, 4, 10, 11])
def test_numbers_that_mean_nothing_spoil_no_other_splat(bad, column):
    splats = splats_of(40)
    wanted, _, _ = sorted_by(np.delete(splats, 20, 0), 1)
    splats[20, column] = bad
    found, _, _ = sorted_by(splats, 2)
    assert [[k - (k > 20) for k in tile if k != 20] for tile in found] == wanted
