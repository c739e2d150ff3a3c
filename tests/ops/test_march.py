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


def test_misses_grazes_and_starts_inside(backend):
    origins, directions = rays(
        [[-1, 5, 1], [5, 1, 1], [-1, 0, 0], [-1, 3, 4], [1, 1, 1], [-1, -1e-9, 1]],
        [[1, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0]],
    )
    ids, distances = run(origins, directions, full(2, 3, 4), step=1.0)
    assert ids == [2, 2, 2, 3, 3, 3, 4, 4]  # 0, 1 and 5 miss; 2 and 3 slide along an edge; 4 starts inside
    assert distances == [1, 2, 3, 1, 2, 3, 0, 1]


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
