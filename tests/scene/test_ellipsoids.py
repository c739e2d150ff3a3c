import pytest
import torch
from scipy.spatial.transform import Rotation

from forewarp.ops.gaussians import FLAT, rotations
from forewarp.scene.cloud import Ellipsoids, axes_of


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def covariances(scales, quaternions):
    root = rotations(quaternions) * scales[:, None]
    return root @ root.mT


def test_axes_give_the_covariances_again_with_proper_rotations():
    roots = random(500, 3, 3)
    scales, quaternions = axes_of(roots)
    torch.testing.assert_close(covariances(scales, quaternions), roots @ roots.mT)
    torch.testing.assert_close(quaternions.norm(dim=-1), torch.ones(500).double())
    assert float(scales.min()) > 0
    found = Rotation.from_quat(quaternions.numpy(), scalar_first=True).as_matrix()
    assert abs(torch.linalg.det(torch.from_numpy(found)) - 1).max() < 1e-9
    torch.testing.assert_close(torch.from_numpy(found), rotations(quaternions))


def test_a_turned_diagonal_keeps_its_axes():
    given, turns = random(200, 3).exp(), random(200, 4, seed=1)
    turns /= turns.norm(dim=-1, keepdim=True)
    scales, quaternions = axes_of(rotations(turns) * given[:, None])
    torch.testing.assert_close(scales, given)
    torch.testing.assert_close(rotations(quaternions), rotations(turns))
    bent = torch.eye(3).double() + 0.01 * random(200, 3, 3, seed=2)
    apart = (given.sort().values[:, 1:] / given.sort().values[:, :-1]).amin(-1) > 1.2
    again, turned = axes_of(bent @ (rotations(turns) * given[:, None]))
    torch.testing.assert_close(again[apart], given[apart], rtol=0.05, atol=0)
    assert float((rotations(turned) - rotations(turns))[apart].abs().max()) < 0.2


@pytest.mark.parametrize(
    "diagonal", [(0.0, 0.0, 0.0), (1.0, 0.0, 2.0), (1.0, -1.0, 1.0), (1e-20, 1.0, 1.0), (1e-30, 1e-30, 1e-30)]
)
def test_what_is_flat_or_mirrored_has_finite_logarithms(diagonal):
    roots = torch.diag(torch.tensor(diagonal))[None]
    scales, quaternions = axes_of(roots)
    assert bool(scales.log().isfinite().all())
    assert bool(quaternions.isfinite().all())
    largest = max(map(abs, diagonal))
    torch.testing.assert_close(
        covariances(scales, quaternions), roots @ roots.mT, atol=largest**2 * 1e-6, rtol=0
    )


def test_colours_are_the_mean_and_stay_in_range():
    harmonics = torch.tensor([[[0.0, 0.25, 9.0]], [[-9.0, -0.5, 0.5]]]) / FLAT
    cloud = Ellipsoids(torch.zeros(2, 3), torch.eye(3).expand(2, 3, 3), torch.ones(2), harmonics)
    torch.testing.assert_close(cloud.colors, torch.tensor([[0.5, 0.75, 1.0], [0.0, 0.0, 1.0]]))
    assert len(cloud[[1]]) == 1
    assert torch.equal(cloud[[1]].colors, cloud.colors[1:])
