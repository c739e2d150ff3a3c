"""One frame, equal times, more cosines than frames, times at and beyond the ends (cases 16 and 17)."""

import pytest
import torch

from forewarp.fields.curves import TrajectoryField
from forewarp.fields.grids import VoxelGrid
from forewarp.methods.voxel.backward import Deformation
from forewarp.training.schedule import Curriculum
from tests.support.hard_cases import LATTICE, check_finite, voxels

pytestmark = pytest.mark.stability


def field(device, **changes):
    torch.manual_seed(0)
    options = {"bases": 50, "frames": 4, "canonical_time": 0.0, "nodes": 8, "width": 16, "layers": 2}
    made = TrajectoryField(LATTICE.box, **(options | changes))
    torch.nn.init.normal_(made.network[-1].weight)
    return made.to(device)


def test_more_cosines_than_frames_are_cut_to_what_is_independent(place):
    moving = field(place)
    assert moving.bases == 3
    grid = VoxelGrid(LATTICE, torch.ones(LATTICE.shape, dtype=torch.bool), {"density": 1}).to(place)
    check_finite(moving.flow(grid, 1.0), *moving.network.parameters())


@pytest.mark.parametrize("time", [0.0, 1e-12, 1e-7, 0.5, 1.0])
def test_at_and_beside_the_canonical_time(place, time):
    moving = field(place)
    points = LATTICE.to_world(voxels(device=place))
    paths = moving.trajectories(points, torch.tensor([0.0, time], device=place))
    check_finite(paths, *moving.network.parameters())
    assert torch.equal(paths[:, 0], points)
    reach = float((paths.detach()[:, 1] - points).norm(dim=-1).max())
    assert reach <= 100 * time**0.5 + 1e-6 * LATTICE.box.diagonal  # no jump at the canonical time


@pytest.mark.parametrize("times", [[0.0], [0.5, 0.5], [0.3] * 7, [0.0, 1.0]])
def test_one_frame_and_equal_times_can_be_drawn(times):
    curriculum = Curriculum(times, times[0], start=10, error_share=0.5)
    for fraction in (0.0, 0.5, 1.0):
        curriculum.fraction = fraction
        assert 1 <= curriculum.in_play <= len(times)
        assert 0 <= curriculum() < len(times)


@pytest.mark.parametrize("errors", [[0.0, 0.0], [float("inf"), 1.0], [float("nan")] * 2, [1e30, 1e-30]])
def test_errors_of_any_size_can_be_drawn_by(errors):
    curriculum = Curriculum([0.0, 1.0], 0.0, error_share=1.0, all_in=0.0)
    for frame, error in enumerate(errors):
        curriculum.report(frame, error)
    assert all(0 <= curriculum() < 2 for _ in range(20))


@pytest.mark.parametrize("time", [0.0, 1e-9, 1.0])
def test_the_deformation_beside_the_canonical_time(device, time):
    torch.manual_seed(0)
    net = Deformation(LATTICE.box, canonical_time=0.0, width=16, layers=2).to(device)
    torch.nn.init.normal_(net.network[-1].weight)
    moved = net(LATTICE.to_world(voxels(device=device)), time)
    check_finite(moved, *net.parameters())
    assert (moved == 0).all() == (time == 0)
