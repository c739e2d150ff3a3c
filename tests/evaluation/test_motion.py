"""What the paper's figures of motion and canonical shape are drawn from."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from forewarp.data.module import SceneDataModule
from forewarp.evaluation import motion
from forewarp.evaluation.motion import FILE, learned_flows, measure_motion, shape_error, true_flows
from forewarp.methods.voxel.backward import Deformation
from forewarp.metrics.variation import variation
from forewarp.scene.box import Lattice
from forewarp.scene.cloud import Cloud
from forewarp.scene.frame import Truth
from tests.support.tiny_scene import (
    BOX,
    RADIUS,
    TRAVEL,
    backward_model,
    ball_center,
    ball_data,
    ball_scene,
    built,
    known_ball,
)

TIMES = torch.linspace(0, 1, 11).double()


def row_of(begin, moves):
    """Points along x, 0.1 apart, that are moved by ``moves`` (T,) along y from y = ``begin``."""
    points = torch.zeros(11, len(moves), 3)
    points[..., 0] = torch.linspace(0, 1, 11)[:, None]
    points[..., 1] = begin + torch.tensor(moves)
    return points


def test_one_place_is_covered_by_three_bodies_in_turn():
    away = [[0.0] * 4 + [3.0] * 7, [0.0] * 4 + [1.0] * 3 + [3.5] * 4, [0.0] * 7 + [0.5] * 4]
    rows = [row_of(begin, moves) for begin, moves in zip((0.0, -1.0, -0.5), away)]
    flows = true_flows(Truth(torch.cat(rows), TIMES))
    # At y = 0 first that which never moved, then what came 1 from below, last what came 0.5.
    assert flows.backward[0] == pytest.approx([0.0] * 4 + [1.0] * 3 + [0.5] * 4)
    assert abs(flows.places[0, 1]) < flows.reach == pytest.approx(0.2)
    assert variation(flows.backward[0]) == pytest.approx(1.5)
    # Of the three the second goes farthest: by 1 and on to 3.5, only ever forwards.
    assert flows.points[0, 1] == -1
    assert flows.forward[0] == pytest.approx([0.0] * 4 + [1.0] * 3 + [3.5] * 4)
    assert variation(flows.forward[0]) == 1


def test_a_body_that_glides_past_has_a_smooth_backward_flow():
    """Its points differ from time to time, but all go the same way."""
    grid = torch.cartesian_prod(torch.linspace(-1, 1, 41), torch.linspace(0, 0.2, 5), torch.zeros(1))
    went = 0.5 * TIMES.float() ** 2
    points = grid[:, None] + went[:, None] * torch.tensor([1.0, 0, 0])
    flows = true_flows(Truth(points, TIMES))
    known = np.isfinite(flows.backward)
    assert (known.mean(1) >= 0.8).all()
    assert flows.backward[known] == pytest.approx(np.broadcast_to(went.numpy(), known.shape)[known], abs=1e-6)
    assert variation(flows.backward[0, known[0]]) == pytest.approx(1)


def test_the_order_of_times_does_not_matter_and_nothing_comes_of_rest():
    truth = Truth(row_of(0.0, [0.0, 0.4, 0.2]), torch.tensor([0.0, 1.0, 0.5]).double())
    assert true_flows(truth) is None  # no place is covered for long
    assert true_flows(Truth(row_of(0.0, [0.0, 0.0]), TIMES[:2])) is None


def test_the_ray_casters_flow_is_that_of_a_turning_body():
    pytest.importorskip("embreex")
    from forewarp.synth.raycast import surface_points
    from forewarp.synth.scenes import random_cameras
    from forewarp.synth.shapes import Material, Part, box
    from forewarp.synth.vehicle import rotation
    from forewarp.synth.world import Specimen, World

    times, rng = np.linspace(0, 1, 11), np.random.default_rng(0)
    table = Part("table", "table", *box((-0.5, -0.5, -0.1), (0.5, 0.5, 0.0)), Material("plain", ((1, 0, 0),)))
    world = World(Specimen(lambda time: {"table": rotation(np.pi / 2 * time, 0, 1)}, lambda: [table]))
    drawn = surface_points(world, 2000, random_cameras(8, 8, rng), rng)
    flows = true_flows(world.trajectories(*drawn, times))
    chord = 2 * np.sin(np.pi / 4 * times)  # at a distance of 1 from the axis
    known, radius = np.isfinite(flows.backward), np.linalg.norm(flows.places[:, :2], axis=1)[:, None]
    off = np.abs(flows.backward - radius * chord) - flows.reach * chord
    assert len(flows.places) > 20
    assert off[known].max() <= 1e-6
    radius = np.linalg.norm(flows.points[:, :2], axis=1)[:, None]
    assert flows.forward == pytest.approx(radius * chord, abs=1e-5)


class Carried:
    """A method that carries matter along y, and says so only through its trajectories."""

    moves = True

    def matter(self):
        points = row_of(-1.0, [0.0])[:, 0]
        return Cloud(points, torch.zeros(11, 3), torch.ones(11), 0.1)

    def trajectories(self, points, times):
        return points[:, None] + times[:, None] * torch.tensor([0.0, 2.0, 0.0])


class Named(Carried):
    """The same with a backward flow of its own."""

    def backward_flow(self, points, time):
        return torch.full_like(points, time)


class Module:
    device = torch.device("cpu")

    def __init__(self, method):
        self.method = method


def test_learned_flows_are_the_networks_or_those_of_the_matter_that_comes():
    place = np.array([[0.5, 0.0, 0.0]], np.float32)
    flows = motion.Flows(np.array([0.0, 0.5, 1.0]), place, np.zeros((1, 3)), place, np.zeros((1, 3)), 0.2)
    found = learned_flows(Module(Carried()), flows)
    assert found["forward"] == pytest.approx(np.array([[0.0, 1.0, 2.0]]))
    # At time 0.5 the matter from y = -1 is there; else none is.
    assert found["backward"] == pytest.approx(np.array([[np.nan, 1.0, np.nan]]), nan_ok=True)
    named = learned_flows(Module(Named()), flows)
    assert named["backward"] == pytest.approx(np.array([[0.0, 0.5, 1.0]]) * 3**0.5)


def test_medians_are_over_curves_that_are_known_for_long_enough():
    curves = np.array([[0.0, 2.0, 0.0, 2.0], [0.0, 1.0, 2.0, 3.0], [0.0, np.nan, np.nan, 1.0]])
    assert motion.median_variation(curves, np.ones((3, 4))) == 2  # of 3 and 1
    assert motion.median_variation(curves[2:], np.ones((1, 4))) is None


def depth_of_ball(camera):
    """The exact depth (H, W) of the ball at time 0, 0 beside it."""
    rays = camera.rays()
    offset = rays.origins - ball_center(0.0)
    along = (offset * rays.directions).sum(-1)
    inside = along**2 - (offset**2).sum(-1) + RADIUS**2
    return torch.where(inside > 0, -along - inside.clamp(min=0).sqrt(), 0.0).reshape(
        camera.height, camera.width
    )


def known_data(farther=0.0):
    """The ball's data with its true motion, and the depth of the canonical view, made ``farther``."""
    scene = ball_scene()
    canonical = scene.test[0]
    depth = depth_of_ball(canonical.camera)
    deep = replace(canonical, load_depth=lambda: torch.where(depth > 0, depth + farther, 0.0))
    grid = torch.cartesian_prod(*[torch.linspace(-RADIUS, RADIUS, 17)] * 3)
    inside = grid[grid.norm(dim=-1) < RADIUS] + ball_center(0.0)
    truth = Truth(inside[:, None] + TIMES.float()[:, None] * torch.tensor(TRAVEL), TIMES)
    known = replace(scene, test=(deep, *scene.test[1:]), truth=truth)
    return SceneDataModule(lambda: known, rays=256)


def test_the_shape_of_a_known_ball_is_off_by_less_than_a_pixel():
    module, data = known_ball(), known_data()
    pixel = 3 / data.scene.test[0].camera.fx  # at the ball's distance
    found = shape_error(module, data.scene)
    assert 0 < found["chamfer"] < pixel
    assert found["chamfer"] == (found["accuracy"] + found["completeness"]) / 2
    # What lies 0.3 behind the ball along each ray is about as far from its front.
    assert 0.2 < shape_error(module, known_data(0.3).scene)["chamfer"] < 0.3 + pixel
    assert shape_error(module, ball_scene()) is None


@pytest.mark.slow
def test_pictures_of_a_known_motion_are_those_of_its_truth(tmp_path):
    data = known_data()
    entries = measure_motion(known_ball(), data, tmp_path, pictures=True)
    with np.load(tmp_path / FILE, allow_pickle=False) as stored:
        arrays = dict(stored)
    assert arrays["true_forward"] == pytest.approx(0.8 * arrays["times"], abs=1e-6)
    assert arrays["forward"] == pytest.approx(arrays["true_forward"], abs=1e-5)
    covered = np.isfinite(arrays["true_backward"]) & np.isfinite(arrays["backward"])
    assert covered.sum() >= 8
    assert arrays["backward"][covered] == pytest.approx(0.8 * arrays["times"][covered], abs=1e-5)
    assert entries["flow_variation"]["true_backward"] == pytest.approx(1)
    assert entries["flow_variation"]["backward"] == pytest.approx(1)
    assert arrays["paths"] == pytest.approx(arrays["true_paths"], abs=1e-3)
    camera = data.scene.test[0].camera
    assert arrays["canonical_rgb"].shape == arrays["true_rgb"].shape == (1, camera.height, camera.width, 3)
    true_depth = depth_of_ball(camera).numpy()
    both = (arrays["canonical_depth"][0] > 0) & (true_depth > 0)
    assert arrays["true_depth"][0] == pytest.approx(true_depth)
    assert both.sum() > 0.8 * (true_depth > 0).sum()
    assert np.abs(arrays["canonical_depth"][0] - true_depth)[both].mean() < 0.1
    assert arrays["shots"].shape[0] == len(arrays["shot_times"]) == len(arrays["marks"])
    # Without pictures the number stays, and no file of an earlier measurement.
    assert measure_motion(known_ball(), data, tmp_path, pictures=False).keys() == {"canonical_shape"}
    assert not (tmp_path / FILE).exists()


def test_a_real_scene_has_canonical_pictures_and_trajectories_of_its_own(tmp_path):
    assert measure_motion(known_ball(), ball_data(), tmp_path, pictures=True) == {}
    with np.load(tmp_path / FILE, allow_pickle=False) as stored:
        assert set(stored) == {"canonical_rgb", "canonical_depth", "true_rgb", "paths"}
        assert stored["paths"].shape[1:] == (41, 2)


def test_a_deformation_network_says_where_places_come_from():
    torch.manual_seed(0)
    lattice = Lattice.of_count(BOX, 500)
    method = built(backward_model(deformation=partial(Deformation, width=8, layers=2)), lattice)
    torch.nn.init.normal_(method.deformation.network[-1].weight, std=0.05)
    points = torch.rand(7, 3) - 0.5
    assert method.backward_flow(points, 0.0).abs().max() == 0
    assert torch.equal(method.backward_flow(points, 0.5), method.deformation(points, 0.5))
    # What is at the end of a path comes back from there.
    end = method.trajectories(points, torch.tensor([0.5]))[:, 0]
    assert (end + method.backward_flow(end, 0.5) - points).norm(dim=-1).max() < 1e-3
