import math

import pytest
import torch

from forewarp.ops import march
from forewarp.ops.grid import index_of, occupied_cells, trilinear_reference
from tests.support.reference import composite, march_samples

F64 = torch.float64


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def test_with_jitter_each_lies_in_its_bin_and_the_outer_bins_are_half_as_wide():
    depths = march.stratified(torch.full((4000,), 2.0), torch.full((4000,), 6.0), 5, seeded())
    edges = torch.tensor([2.0, 2.5, 3.5, 4.5, 5.5, 6.0])
    assert (depths >= edges[:-1]).all()
    assert (depths <= edges[1:]).all()
    torch.testing.assert_close(depths.mean(0), (edges[1:] + edges[:-1]) / 2, atol=0.02, rtol=0)
    assert (depths.amax(0) - depths.amin(0) > 0.98 * (edges[1:] - edges[:-1])).all()
    assert march.stratified(torch.ones(0), torch.ones(0), 4, seeded()).shape == (0, 4)
    assert (march.stratified(torch.ones(2), torch.ones(2), 3, seeded()) == 1).all()


def test_midpoints_and_union():
    assert march.midpoints(torch.tensor([[0.0, 1, 3]])).tolist() == [[0.5, 2]]
    assert march.union(torch.tensor([[1.0, 4]]), torch.tensor([[3.0, 0, 5]])).tolist() == [[0, 1, 3, 4, 5]]


@pytest.mark.parametrize(
    ("edges", "weights", "expected"),
    [
        # The distribution function is 0, 1/4, 1/4, 1 at the edges; a plateau is left at its end.
        ([0.0, 1, 2, 4], [1.0, 0, 3], [0.0, 2, 2 + 2 / 3, 2 + 4 / 3, 4]),
        ([0.0, 1, 2, 3], [0.0, 0, 0], [0.0, 0.75, 1.5, 2.25, 3]),  # spread over all
    ],
)
def test_importance_hand_worked(edges, weights, expected):
    depths = march.by_importance(torch.tensor([edges]), 1e6 * torch.tensor([weights]), 5)
    torch.testing.assert_close(depths, torch.tensor([expected]), atol=1e-4, rtol=0)


@pytest.mark.parametrize("weight", [0.0, 1.0, 1e30])
def test_drawn_distances_stay_inside_and_finite(weight):
    edges = torch.tensor([[1.0, 1, 2, 5]]).repeat(64, 1)  # an empty bin too
    depths = march.by_importance(edges, torch.tensor([0.0, weight, 0.0]).repeat(64, 1), 33, seeded())
    assert ((depths >= 1) & (depths <= 5)).all()  # False for NaN


LOW, HIGH = torch.tensor([-1.0, -2, -3]), torch.tensor([1.0, 2, 3])


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ((-4.0, 0.0, 0.0), (1.0, 0.0, 0.0), (3.0, 5.0)),
        ((0.0, 0.0, 5.0), (0.0, 0.0, -1.0), (2.0, 8.0)),
        ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 2.0)),  # from inside
        ((-4.0, 2.0, 0.0), (1.0, 0.0, 0.0), (3.0, 5.0)),  # along a face
        ((-4.0, 0.0, 0.0), (0.6, 0.8, 0.0), None),
        ((-4.0, 2.1, 0.0), (1.0, 0.0, 0.0), None),
        ((4.0, 0.0, 0.0), (1.0, 0.0, 0.0), None),  # behind
    ],
)
def test_clipping_hand_worked(origin, direction, expected):
    begin, end = march.clip_to_box(torch.tensor([origin]), torch.tensor([direction]), 0.0, 10.0, LOW, HIGH)
    if expected is None:
        assert end <= begin
    else:
        assert (begin.item(), end.item()) == pytest.approx(expected)


def run(origins, directions, cells):
    origins, directions = (torch.tensor(rays, dtype=F64).reshape(-1, 3) for rays in (origins, directions))
    jitter = torch.zeros(len(origins), dtype=F64)
    return [found.tolist() for found in march.march(origins, directions, 0.0, 20.0, 1.0, cells, jitter)]


def full(*shape):
    return torch.ones(shape, dtype=torch.bool)


@pytest.mark.parametrize(("shape", "density"), [((2, 3, 4), 0.3), ((9, 14, 6), 0.1), ((9, 14, 6), 1.0)])
def test_equals_the_slow_twin(backend, shape, density):
    generator, size = seeded(5), torch.tensor(shape, dtype=F64)
    cells = torch.rand(shape, generator=generator) < density
    origins = size * (3 * torch.rand(40, 3, generator=generator, dtype=F64) - 1)  # some start inside
    targets = size * torch.rand(40, 3, generator=generator, dtype=F64)
    directions = (targets - origins) * torch.tensor([0.2, 0.1, 0.3])
    jitter = torch.rand(40, generator=generator, dtype=F64)
    arguments = (origins, directions, 0.3, 11.0, 0.37, cells, jitter)
    ids, distances = march.march(*arguments)
    expected_ids, expected = march_samples(*arguments)
    assert ids.tolist() == expected_ids != []
    torch.testing.assert_close(distances, torch.tensor(expected, dtype=F64))


def test_misses_grazes_starts_inside_and_finds_nothing(backend):
    origins = [[-1, 5, 1], [5, 1, 1], [-1, 0, 0], [-1, 3, 4], [1, 1, 1], [-1, -1e-9, 1]]
    ids, distances = run(origins, [[1, 0, 0]] * 6, full(2, 3, 4))
    assert ids == [2, 2, 2, 3, 3, 3, 4, 4]  # 0, 1 and 5 miss; 2 and 3 slide along an edge; 4 starts inside
    assert distances == [1, 2, 3, 1, 2, 3, 0, 1]
    assert run([[-1, 1, 1]], [[1, 0, 0]], ~full(2, 3, 4)) == [[], []]
    assert run([], [], full(2, 3, 4)) == [[], []]


@pytest.mark.parametrize("bad", [0.0, float("nan"), float("inf"), 1e-30])
def test_a_broken_direction_ends(backend, bad):
    cells = full(9, 3, 4)
    cells[:4] = False
    ids, distances = run([[1, 1, 1], [-1, 1, 1]], [[bad, bad, bad], [1, 0, 0]], cells)
    assert [t for i, t in zip(ids, distances) if i == 1] == [5, 6, 7, 8, 9, 10]
    assert torch.tensor(distances).isfinite().all()


SHAPE, STEP, SHIFT, SCALE, FILL = (12, 15, 9), 0.31, -0.7, 0.6, -10.0


def matter(strength, count=60):
    """Rays from outside and inside, some along an axis, along a face, or past the box; a sparse lattice."""
    generator = seeded()
    voxels = (torch.rand(SHAPE, generator=generator) < 0.3).nonzero()
    index, raw = index_of(voxels, SHAPE), strength * torch.randn(len(voxels), generator=generator, dtype=F64)
    size = torch.tensor(SHAPE, dtype=F64) - 1
    origins = size * (3 * torch.rand(count, 3, generator=generator, dtype=F64) - 1)
    directions = size * torch.rand(count, 3, generator=generator, dtype=F64) - origins
    grazing = torch.tensor([[-2, 0, 4], [-2, 14, 8], [-2, 7, 4], [-2, -1e-9, 4], [5, 5, -3], [50, 50, 50]])
    along = torch.tensor([[1, 0, 0], [1, 0, 0], [1, 1e-9, 0], [1, 0, 0], [0, 0, 1], [1, 1, 1]])
    directions = torch.cat([torch.nn.functional.normalize(directions, dim=-1), along.double()])
    origins = torch.cat([origins, grazing.double()])
    jitter = torch.rand(len(origins), generator=generator, dtype=F64)
    return origins, directions, jitter, occupied_cells(index), index, raw


def plainly(origins, directions, jitter, cells, index, raw):
    """All samples: rays, distances, weights; then what remains of each ray."""
    rays, distances = march.march_reference(origins, directions, 0.2, 40.0, STEP, cells, jitter)
    points = origins[rays] + distances[:, None] * directions[rays]
    read = trilinear_reference(raw[:, None], index, points, raw.new_full((1,), FILL))[:, 0]
    optical = torch.nn.functional.softplus(read + SHIFT) * SCALE
    weights, through = march.render_weights(optical, rays, len(origins))
    return rays, distances, weights, through


def traced(origins, directions, jitter, cells, index, raw, **changes):
    pytest.importorskip("numba")
    numbers = {"raw": raw, "index": index, "fill": FILL, "shift": SHIFT, "scale": SCALE} | changes
    return march.trace(origins, directions, 0.2, 40.0, STEP, cells, jitter, **numbers)


@pytest.mark.parametrize(
    ("strength", "dtype"), [(0.0, F64), (6.0, F64), (6.0, torch.float32), (1e6, torch.float32)]
)
def test_trace_equals_the_operators_one_by_one(strength, dtype):
    scene = [t.to(dtype) if t.is_floating_point() else t for t in matter(strength)]
    found, (rays, distances, weights, through) = traced(*scene, threshold=-1.0), plainly(*scene)
    exact = {"atol": 1e-4 if dtype == torch.float32 else 1e-9, "rtol": 1e-5}
    if dtype == F64:  # in float32 a sample on a cell's face may fall on either side
        assert torch.equal(found.ray_ids, rays)
        torch.testing.assert_close(found.distances, distances)
        torch.testing.assert_close(found.weights, weights, **exact)
        assert found.samples == len(rays) > 100
    ones = torch.stack([torch.ones_like(distances), distances], -1)
    moments = march.accumulate(weights, ones, rays, len(scene[0]))
    torch.testing.assert_close(found.opacity, moments[:, 0], **exact)
    torch.testing.assert_close(found.distance, moments[:, 1], **(exact | {"atol": 40 * exact["atol"]}))
    torch.testing.assert_close(found.transmittance, through, **exact)
    assert found.weights.dtype == found.opacity.dtype == dtype


def test_trace_ends_where_a_ray_ends():
    scene = matter(60.0)
    whole, ended = (traced(*scene, threshold=-1.0, early_stop_eps=v) for v in (0.0, 1e-3))
    assert ended.samples == len(ended.weights) < 0.8 * whole.samples
    for name in ("opacity", "transmittance"):
        torch.testing.assert_close(getattr(ended, name), getattr(whole, name), atol=1e-3, rtol=0)
    before = 1 - torch.cat([w.cumsum(0) - w for w in whole.weights.split(whole.ray_ids.bincount().tolist())])
    torch.testing.assert_close(ended.weights, whole.weights[before >= 1e-3])  # each ray's first samples


def test_trace_is_the_same_on_two_threads(two_threads):
    many = traced(*matter(6.0))
    torch.set_num_threads(1)
    assert all(torch.equal(a, b) for a, b in zip(many[:-1], traced(*matter(6.0))[:-1]))


def test_trace_of_nothing():
    *rays, cells, index, raw = matter(6.0)
    for some, matters in ((slice(0, 0), cells), (slice(None), torch.zeros_like(cells))):
        found = traced(*(part[some] for part in rays), matters, index, raw, early_stop_eps=1e-4)
        assert found.samples == len(found.weights) == 0
        assert (found.transmittance == 1).all()
        assert (found.opacity == 0).all()


def test_weights_equal_the_slow_twin():
    ids = torch.tensor([0, 0, 0, 2, 2, 4])  # rays 1, 3 and 5 have no sample
    optical = 3 * torch.rand(6, generator=seeded(), dtype=F64)
    twin = composite(optical, ids, 6)
    for found, expected in zip(march.render_weights(optical, ids, 6), twin, strict=True):
        torch.testing.assert_close(found, torch.tensor(expected, dtype=F64))


def test_a_ray_does_not_depend_on_its_neighbours():
    optical = 3 * torch.rand(2, generator=seeded())
    alone, _ = march.render_weights(optical, torch.zeros(2, dtype=torch.int64), 1)
    crowd = torch.cat([torch.full((200_000,), 79.0), optical])
    ids = torch.cat([torch.arange(200_000), torch.tensor([200_000, 200_000])])
    torch.testing.assert_close(march.render_weights(crowd, ids, 200_001)[0][-2:], alone)


def test_no_samples():
    optical, none = torch.zeros(0, requires_grad=True), torch.zeros(0, dtype=torch.int64)
    weights, transmittance = march.render_weights(optical, none, 3)
    assert transmittance.tolist() == [1, 1, 1]
    assert march.accumulate(weights, torch.zeros(0, 2), none, 3).tolist() == [[0, 0]] * 3
    transmittance.sum().backward()
    assert optical.grad.shape == (0,)


def test_dense_equals_packed():
    optical = 3 * torch.rand(5, 4, generator=seeded(3), dtype=F64)
    weights, transmittance = march.dense_weights(optical)
    packed, through = march.render_weights(optical.flatten(), torch.arange(5).repeat_interleave(4), 5)
    torch.testing.assert_close(weights.flatten(), packed)
    torch.testing.assert_close(transmittance, through)
    torch.testing.assert_close(weights.sum(1) + transmittance, torch.ones(5, dtype=F64))


def test_a_last_interval_without_end():
    half = math.log(2)
    optical = torch.tensor([[half, 1e10], [half, 0.0], [math.inf, math.inf]], requires_grad=True)
    weights, transmittance = march.dense_weights(optical)
    torch.testing.assert_close(weights, torch.tensor([[0.5, 0.5], [0.5, 0], [1, 0]]))
    torch.testing.assert_close(transmittance, torch.tensor([0.0, 0.5, 0]), atol=1e-30, rtol=0)
    (weights[:, 0].sum() + 2 * transmittance.sum()).backward()
    assert optical.grad.isfinite().all()
    assert march.dense_weights(torch.zeros(0, 4))[0].shape == (0, 4)
