"""Threads and arguments: what an operator cannot take is refused in one line that says what was expected."""

import math
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest
import torch
from torch import zeros

from forewarp.ops.backend import check_shapes, cores, match_threads, numba_installed
from forewarp.ops.curves import dct_basis
from forewarp.ops.encode import positional_encoding
from forewarp.ops.grid import block_sums, index_of, second_variation, trilinear
from forewarp.ops.march import by_importance, dense_weights, march, stratified, trace
from forewarp.ops.splat import average_splat, with_copies

SHAPE = (3, 4, 5)
INDEX = zeros(SHAPE, dtype=torch.int32)
CELLS = torch.ones(2, 3, 4, dtype=torch.bool)
AVERAGE = average_splat(zeros(0, 2), zeros(0, 3), SHAPE)


def read(values=zeros(60, 2), index=INDEX, points=zeros(5, 3), fill=zeros(2)):  # noqa: B008
    trilinear(values, index, points, fill)


def go(origins=zeros(2, 3), directions=zeros(2, 3), near=0.0, far=1.0, step=0.1, jitter=zeros(2)):  # noqa: B008
    march(origins, directions, near, far, step, CELLS, jitter)


def see(raw=zeros(60), index=INDEX, jitter=zeros(2)):  # noqa: B008
    numbers = {"raw": raw, "index": index, "fill": 0.0, "shift": 0.0, "scale": 1.0}
    trace(zeros(2, 3), torch.ones(2, 3), 0.0, 1.0, 0.1, CELLS, jitter, **numbers)


COSINES, TIMES = "expected 1 <= bases <= frames - 1, but got bases=", r"expected times in \[0, 1\]"
REFUSED = {
    "curves": [
        *((partial(dct_basis, 0.0, *sizes, 0.0), COSINES) for sizes in ((0, 5), (5, 5), (1, 1))),
        *((partial(dct_basis, t, 2, 5, 0.0), TIMES) for t in (-1e-3, 1.001, math.nan, math.inf)),
        (partial(dct_basis, 0.0, 2, 5, 1.5), TIMES),
    ],
    "encode": [
        (partial(positional_encoding, zeros(1, 3), -1), "expected frequencies >= 0, but got -1"),
        (
            partial(positional_encoding, zeros(1, 2), 0, identity=False),
            ">= 1 without the identity, but got 0",
        ),
    ],
    "grid": [
        (partial(read, values=zeros(4)), r"values: expected shape \(M, C\)"),
        (partial(read, index=INDEX[0]), r"index: expected shape \(X, Y, Z\)"),
        (partial(read, points=zeros(5, 2)), r"points: expected shape \(P, 3\), but got \(5, 2\)"),
        (partial(read, fill=zeros(3)), r"fill: expected shape \(2\)"),
        (partial(read, index=INDEX[:1]), "expected at least 2 voxels an axis"),
        (partial(index_of, zeros(3), SHAPE), r"voxels: expected shape \(N, 3\)"),
        (partial(second_variation, zeros(3, 2, 3, 1)), "expected 3 points an axis or more, but got"),
        (partial(block_sums, zeros(4, 3)), "image: expected sides that 2 divides, but got 3 x 4 pixels"),
    ],
    "march": [
        *((partial(go, step=step), "expected step > 0") for step in (0.0, math.inf)),
        *((partial(go, far=far), "0 <= near < far, but got") for far in (-1.0, 0.0, math.inf, math.nan)),
        (partial(go, near=-1.0), "0 <= near < far, but got"),
        (partial(go, jitter=zeros(3)), r"jitter: expected shape \(2\)"),
        (partial(go, directions=zeros(1, 3)), r"directions: expected shape \(2, 3\)"),
        (partial(go, origins=zeros(2, 2)), r"origins: expected shape \(R, 3\)"),
        (partial(see, raw=zeros(60, 1)), r"raw: expected shape \(M\)"),
        (partial(see, index=INDEX[:2]), r"index: expected shape \(3, 4, 5\)"),
        (partial(see, jitter=zeros(3)), "jitter: expected shape"),
        (partial(stratified, zeros(1), zeros(1), 1), "expected count >= 2, but got 1"),
        (partial(by_importance, zeros(1, 1), zeros(1, 0), 4), "expected a bin"),
        (partial(by_importance, zeros(1, 3), zeros(1, 2), 0), "but got 2 and count=0"),
        (partial(dense_weights, zeros(3)), r"optical: expected shape \(R, S\), but got \(3,\)"),
    ],
    "splat": [
        (partial(average_splat, zeros(4), zeros(4, 3), SHAPE), r"source: expected shape \(N, C\)"),
        (partial(average_splat, zeros(4, 2), zeros(5, 3), SHAPE), r"positions: expected shape \(4, 3\), but"),
        (partial(with_copies, AVERAGE, zeros(4, 2), zeros(4).long()), "cells"),
    ],
    "check_shapes": [
        (
            partial(check_shapes, f"points ({s})", zeros(4, 3)),
            r"points: expected shape \(.*\), but got \(4, 3\)",
        )
        for s in ("P, 2", "5, 3", "P", "A, B, C", "..., 4")
    ],
}


@pytest.mark.parametrize("room", REFUSED)
def test_refuses(room):
    for call, text in REFUSED[room]:
        with pytest.raises(ValueError, match=text):
            call()


@pytest.mark.skipif(not numba_installed() or cores() < 2, reason="needs Numba and two cores")
def test_numba_follows_the_threads_of_pytorch_in_each_thread(two_threads):
    import numba

    for wanted in (2, 2, 1, 2):
        torch.set_num_threads(wanted)
        assert match_threads() == wanted == numba.get_num_threads()

    def seen():
        torch.set_num_threads(1)
        return match_threads(), numba.get_num_threads()

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(seen).result() == (1, 1)
    torch.set_num_threads(2)
    assert match_threads() == 2 == numba.get_num_threads()
