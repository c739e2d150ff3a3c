"""``trace`` against the three operators that it joins, in plain PyTorch."""

import importlib.util

import pytest
import torch

from forewarp.ops.grid import index_of, occupied_cells, trilinear_reference
from forewarp.ops.march import accumulate, march_reference, render_weights, trace

pytestmark = pytest.mark.skipif(importlib.util.find_spec("numba") is None, reason="Numba is not installed")
SHAPE, STEP, SHIFT, SCALE, FILL = (12, 15, 9), 0.31, -0.7, 0.6, -10.0


def matter(strength, seed=0, share=0.3):
    """A sparse lattice: index and raw density."""
    generator = torch.Generator().manual_seed(seed)
    voxels = (torch.rand(SHAPE, generator=generator) < share).nonzero()
    raw = strength * torch.randn(len(voxels), generator=generator, dtype=torch.float64)
    return index_of(voxels, SHAPE), raw


def beams(count=60, seed=1):
    """Rays from outside and inside; some along an axis, along a face, or past the box."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor(SHAPE, dtype=torch.float64) - 1
    origins = size * (3 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1)
    directions = size * torch.rand(count, 3, generator=generator, dtype=torch.float64) - origins
    grazing = torch.tensor([[-2, 0, 4], [-2, 14, 8], [-2, 7, 4], [-2, -1e-9, 4], [5, 5, -3], [50, 50, 50]])
    along = torch.tensor([[1, 0, 0], [1, 0, 0], [1, 1e-9, 0], [1, 0, 0], [0, 0, 1], [1, 1, 1]])
    origins = torch.cat([origins, grazing.double()])
    jitter = torch.rand(len(origins), generator=generator, dtype=torch.float64)
    return origins, torch.cat([torch.nn.functional.normalize(directions, dim=-1), along.double()]), jitter


def plainly(origins, directions, jitter, cells, index, raw):
    """All samples: rays, distances, weights; then what remains of each ray."""
    rays, distances = march_reference(origins, directions, 0.2, 40.0, STEP, cells, jitter)
    points = origins[rays] + distances[:, None] * directions[rays]
    read = trilinear_reference(raw[:, None], index, points, raw.new_full((1,), FILL))[:, 0]
    weights, through = render_weights(torch.nn.functional.softplus(read + SHIFT) * SCALE, rays, len(origins))
    return rays, distances, weights, through


def traced(origins, directions, jitter, cells, index, raw, **changes):
    numbers = {"raw": raw, "index": index, "fill": FILL, "shift": SHIFT, "scale": SCALE} | changes
    return trace(origins, directions, 0.2, 40.0, STEP, cells, jitter, **numbers)


@pytest.mark.parametrize("strength", [0.0, 1.0, 6.0, 60.0, 1e6])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equals_the_operators_one_by_one(strength, dtype):
    index, raw = matter(strength)
    scene = (*(v.to(dtype) for v in beams()), occupied_cells(index), index, raw.to(dtype))
    found, (rays, distances, weights, through) = traced(*scene, threshold=-1.0), plainly(*scene)
    exact = {"atol": 1e-4 if dtype == torch.float32 else 1e-9, "rtol": 1e-5}
    if dtype == torch.float64:  # in float32 a sample on a cell's face may fall on either side
        assert torch.equal(found.ray_ids, rays)
        torch.testing.assert_close(found.distances, distances)
        torch.testing.assert_close(found.weights, weights, **exact)
        assert found.samples == len(rays) > 100
    moments = accumulate(
        weights, torch.stack([torch.ones_like(distances), distances], -1), rays, len(scene[0])
    )
    torch.testing.assert_close(found.opacity, moments[:, 0], **exact)
    torch.testing.assert_close(found.distance, moments[:, 1], **(exact | {"atol": 40 * exact["atol"]}))
    torch.testing.assert_close(found.transmittance, through, **exact)
    assert found.weights.dtype == found.opacity.dtype == dtype


def test_ends_where_a_ray_ends():
    index, raw = matter(60.0)
    scene = (*beams(), occupied_cells(index), index, raw)
    whole, ended = (traced(*scene, threshold=-1.0, early_stop_eps=v) for v in (0.0, 1e-3))
    assert ended.samples == len(ended.weights) < 0.8 * whole.samples
    for name in ("opacity", "transmittance"):
        torch.testing.assert_close(getattr(ended, name), getattr(whole, name), atol=1e-3, rtol=0)
    # Each ray keeps its first samples, to the one that ends it and no further.
    _, _, weights, _ = plainly(*scene)
    left = 0
    for ray in range(len(scene[0])):
        own = weights[whole.ray_ids == ray]
        before = 1 - torch.cat([own.new_zeros(1), own.cumsum(0)[:-1]]) if len(own) else own
        torch.testing.assert_close(ended.weights[ended.ray_ids == ray], own[before >= 1e-3])
        left += int((before < 1e-3).sum())
    assert left == whole.samples - ended.samples > 0


def test_the_same_on_two_threads(two_threads):
    index, raw = matter(6.0)
    scene = (*beams(), occupied_cells(index), index, raw)
    many = traced(*scene)
    torch.set_num_threads(1)
    one = traced(*scene)
    assert all(torch.equal(a, b) for a, b in zip(many[:-1], one[:-1]))


def test_nothing_to_see():
    index, raw = matter(6.0)
    origins, directions, jitter = beams()
    cells = occupied_cells(index)
    for rays, matters in ((slice(0, 0), cells), (slice(None), torch.zeros_like(cells))):
        found = traced(
            origins[rays], directions[rays], jitter[rays], matters, index, raw, early_stop_eps=1e-4
        )
        assert found.samples == len(found.weights) == 0
        assert (found.transmittance == 1).all()
        assert (found.opacity == 0).all()
