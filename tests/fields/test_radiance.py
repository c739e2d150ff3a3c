import pytest
import torch

from forewarp.fields.grids import EMPTY, DirectRadiance, FeatureRadiance
from forewarp.scene.box import Box, Lattice

LATTICE = Lattice(Box((0, 0, 0), (2, 3, 4)), (3, 4, 5))
ALL = torch.ones(LATTICE.shape, dtype=torch.bool)
COMMON = {"alpha_init": 1e-2, "density_scale": 0.5, "alpha_threshold": 0.0}


@pytest.mark.parametrize(
    ("features", "names"), [(3, {"density", "color"}), (12, {"density", "color", "shading"})]
)
def test_direct_radiance_owns_what_it_uses(features, names):
    radiance = DirectRadiance(LATTICE, ALL, features=features, **COMMON)
    assert {n for n, _ in radiance.named_parameters()} == names
    grid = radiance()
    assert grid.values.shape == (60, 1 + features)
    assert grid.activation.alpha(grid.raw_density, 0.5)[0].item() == pytest.approx(1e-2, rel=1e-3)


def test_direct_radiance_births_have_their_opacity_over_a_voxel():
    radiance = DirectRadiance(LATTICE, ALL, features=3, **COMMON)
    raw = torch.tensor(radiance.births(5e-3)["density"])
    assert radiance.activation.alpha(raw, LATTICE.voxel_size).item() == pytest.approx(5e-3, rel=1e-3)
    assert radiance.empties() == {"density": EMPTY}


def test_feature_radiance_starts_uniform_and_learns():
    radiance = FeatureRadiance(LATTICE, ALL, features=12, grid_features=4, width=16, **COMMON)
    grid = radiance()
    assert grid.values.shape == (60, 13)
    assert (grid.values == 0).all()
    grid.values.sum().backward()
    assert radiance.network[-1].weight.grad.abs().sum() > 0
    assert radiance.births(1e-2) == radiance.empties() == {}


def test_positions_follow_the_active_voxels():
    radiance = FeatureRadiance(LATTICE, ALL, features=3, grid_features=2, width=8, **COMMON)
    torch.nn.init.normal_(radiance.network[-1].weight)
    radiance()
    for keep in ([0, 1], [0], [1], [0, 1], [1]):
        active = torch.zeros_like(ALL)
        active[keep] = True
        radiance.activate(active, {})
    radiance.features.data[:] = 0
    fresh = FeatureRadiance(LATTICE, active, features=3, grid_features=2, width=8, **COMMON)
    fresh.network = radiance.network
    fresh.features.data[:] = 0
    torch.testing.assert_close(radiance().values, fresh().values)


def test_feature_radiance_knows_where_it_is_on_any_lattice():
    """The same world point is encoded alike on a lattice of another box, so F1 carries over."""
    inner = Lattice(Box((0.5, 1, 1), (1.5, 2, 3)), (3, 4, 5))
    both = [
        FeatureRadiance(lattice, ALL, features=3, grid_features=1, width=4, box=LATTICE.box, **COMMON)
        for lattice in (LATTICE, inner)
    ]
    centre = []
    for radiance in both:
        radiance.network = torch.nn.Identity()  # its values are then the encoded positions, and the features
        centre.append(radiance.values().detach()[(radiance.voxels == torch.tensor([1, 0, 2])).all(-1)])
    assert centre[0][0, 0] == centre[1][0, 0] == 0  # the middle of the scene along x
    assert centre[0][0, 1] == -1
    assert centre[1][0, 1] == pytest.approx(-1 / 3, abs=1e-6)
