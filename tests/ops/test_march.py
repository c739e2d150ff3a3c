import pytest
import torch

from forewarp.ops.march import march
from tests.support.reference import march_samples


def rays(origins, directions):
    return torch.tensor(origins, dtype=torch.float64), torch.tensor(directions, dtype=torch.float64)


def run(origins, directions, cells, near=0.0, far=20.0, step=0.5, jitter=0.0):
    jitter = torch.full((len(origins),), jitter, dtype=origins.dtype)
    ids, distances = march(origins, directions, near, far, step, cells, jitter)
    return ids.tolist(), distances.tolist()


def full(*shape):
    return torch.ones(shape, dtype=torch.bool)


def test_hand_worked(backend):
    cells = full(2, 3, 4)
    cells[0] = False
    # Along x from -1: the box is x in [0, 2], its occupied half [1, 2] at t in [2, 3].
    origins, directions = rays([[-1, 1.5, 1.5]], [[1, 0, 0]])
    assert run(origins, directions, cells) == ([0, 0, 0], [2.0, 2.5, 3.0])
    assert run(origins, directions, cells, jitter=0.5) == ([0, 0], [2.25, 2.75])


@pytest.mark.parametrize("density", [0.1, 0.3, 1.0])
@pytest.mark.parametrize("shape", [(2, 3, 4), (9, 14, 6)])
def test_equals_the_slow_twin(backend, shape, density):
    generator = torch.Generator().manual_seed(5)
    cells = torch.rand(shape, generator=generator) < density
    size = torch.tensor(shape, dtype=torch.float64)
    origins = size * (
        3 * torch.rand(40, 3, generator=generator, dtype=torch.float64) - 1
    )  # some start inside
    targets = size * torch.rand(40, 3, generator=generator, dtype=torch.float64)
    directions = (targets - origins) * torch.tensor([0.2, 0.1, 0.3])
    jitter = torch.rand(40, generator=generator, dtype=torch.float64)
    arguments = (origins, directions, 0.3, 11.0, 0.37, cells, jitter)
    ids, distances = march(*arguments)
    expected_ids, expected = march_samples(*arguments)
    assert ids.tolist() == expected_ids
    torch.testing.assert_close(distances, torch.tensor(expected, dtype=torch.float64))
    assert len(ids) > 0


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rays_along_an_axis(backend, axis, sign):
    cells = full(2, 3, 4)
    origin = torch.tensor([[0.5, 0.5, 0.5]], dtype=torch.float64)
    origin[0, axis] = -1.0 if sign > 0 else cells.shape[axis] + 1.0
    direction = torch.zeros(1, 3, dtype=torch.float64)
    direction[0, axis] = sign
    _, distances = run(origin, direction, cells)
    assert distances == [1 + 0.5 * k for k in range(2 * cells.shape[axis] + 1)]


def test_misses_grazes_and_starts_inside(backend):
    origins, directions = rays(
        [[-1, 5, 1], [5, 1, 1], [-1, 0, 0], [-1, 3, 4], [1, 1, 1], [-1, -1e-9, 1]],
        [[1, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0]],
    )
    ids, distances = run(origins, directions, full(2, 3, 4), step=1.0)
    assert ids == [2, 2, 2, 3, 3, 3, 4, 4]  # 0, 1 and 5 miss; 2 and 3 slide along an edge; 4 starts inside
    assert distances == [1, 2, 3, 1, 2, 3, 0, 1]


def test_near_and_far_bound_the_samples(backend):
    origins, directions = rays([[-1, 1, 1]], [[1, 0, 0]])
    assert run(origins, directions, full(2, 3, 4), near=1.5, far=2.2)[1] == [1.5, 2.0]
    assert run(origins, directions, full(2, 3, 4), near=4.0, far=9.0)[1] == []


def test_nothing_to_march(backend):
    origins, directions = rays([[-1, 1, 1]], [[1, 0, 0]])
    assert run(origins, directions, ~full(2, 3, 4)) == ([], [])
    assert run(origins[:0], directions[:0], full(2, 3, 4)) == ([], [])


@pytest.mark.parametrize("bad", [0.0, float("nan"), float("inf"), 1e-30])
def test_a_broken_direction_ends(backend, bad):
    origins, directions = rays([[1, 1, 1], [-1, 1, 1]], [[bad, bad, bad], [1, 0, 0]])
    cells = full(9, 3, 4)
    cells[:4] = False
    ids, distances = run(origins, directions, cells, step=1.0)
    assert [t for i, t in zip(ids, distances) if i == 1] == [5, 6, 7, 8, 9, 10]
    assert torch.tensor(distances).isfinite().all()


def test_float32_in_float32_out(backend):
    origins, directions = (v.float() for v in rays([[-1, 1, 1]], [[1, 0, 0]]))
    ids, distances = march(origins, directions, 0.0, 9.0, 0.5, full(2, 3, 4), torch.zeros(1))
    assert ids.dtype == torch.int64
    assert distances.dtype == torch.float32
    assert not distances.requires_grad


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"step": 0.0}, "expected step > 0"),
        ({"step": float("inf")}, "expected step > 0"),
        ({"near": 3.0, "far": 2.0}, "0 <= near < far, but got"),
        ({"near": -1.0}, "0 <= near < far, but got"),
        ({"jitter": torch.zeros(3)}, r"jitter: expected shape \(2\)"),
        ({"directions": torch.zeros(1, 3)}, r"directions: expected shape \(2, 3\)"),
        ({"origins": torch.zeros(2, 2)}, r"origins: expected shape \(R, 3\)"),
    ],
)
def test_refuses(change, text):
    fine = {
        "origins": torch.zeros(2, 3),
        "directions": torch.ones(2, 3),
        "near": 0.0,
        "far": 1.0,
        "step": 0.1,
    }
    fine |= {"cells": full(2, 3, 4), "jitter": torch.zeros(2)}
    with pytest.raises(ValueError, match=text):
        march(**(fine | change))
