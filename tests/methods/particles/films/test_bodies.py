"""Bodies: poses at times, gradients by turns and shifts, curves that take over, images that show them."""

import math

import pytest
import torch

from forewarp.fields.curves import Curve
from forewarp.methods.particles.films.bodies import GROUPS, Bodies, Poses
from forewarp.methods.particles.films.tracking import (
    PyramidLevel,
    TrackingView,
    find,
    find_shift,
    fit_distances,
    near_places,
)
from forewarp.methods.particles.nodes import Nodes
from forewarp.ops.nodes import carry_nodes, node_maps
from forewarp.scene.camera import Camera

AXIS = torch.linspace(-0.3, 0.3, 4)
CUBE = torch.cartesian_prod(AXIS, AXIS, AXIS)
TIMES = [i / 20 for i in range(21)]
EYE = torch.tensor([0.0, 0.0, 10.0])
IDENTITY = torch.tensor([0.0, 0.0, 0.0, 1.0])


def rotation(*vector):
    x, y, z = vector
    return torch.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]]))


@pytest.fixture
def bodies():
    """Two cubes, two apart, and between them points of no body."""
    points = torch.cat([CUBE - torch.tensor([1.0, 0.0, 0.0]), CUBE + torch.tensor([1.0, 0.0, 0.0]), CUBE[:8]])
    body_of = torch.tensor([0] * 64 + [1] * 64 + [-1] * 8)
    return Bodies(Nodes(points, 60, Curve("spline", 9, 21, 0.5), group_of=body_of), TIMES)


def rolled(bodies, time, slow=1.0):
    """Poses of bodies that roll evenly, the first by more than half a turn in all."""
    far = slow * (time - 0.5)
    turns = torch.stack([rotation(0.0, 0.0, 7.0 * far), rotation(far, 0.0, 0.0)])
    return Poses(turns, bodies.rest + far * torch.tensor([[0.5, 1.0, 0.0], [0.0, 0.0, 2.0]]))


def seen(bodies, *times, slow=1.0):
    for time in times:
        bodies.put(time, rolled(bodies, time, slow), EYE)


@torch.no_grad()
def motion_and_maps(bodies, time):
    motion, maps = bodies.nodes.motion_and_maps(bodies.nodes.basis(time))
    if bool(bodies.lead):
        bodies.carry(bodies.at(time), bodies.nodes.positions, motion, maps)
    return motion, maps


def places(bodies, time):
    return bodies.nodes.positions + motion_and_maps(bodies, time)[0][:, :3]


def apart(bodies, poses, others):
    return bodies.apart(poses, others).abs().amax()


def shown(bodies, truth, time):
    """An image whose loss is how far nodes are from those of the truth, as a camera at ``EYE`` sees them."""
    truth_maps = node_maps_of(bodies, truth)

    def compare(maps):
        maps = maps.clone().requires_grad_()
        with torch.enable_grad():
            linear = (maps - truth_maps)[:, :9].reshape(-1, 3, 3)
            off = (linear @ bodies.nodes.positions[..., None])[..., 0] + (maps - truth_maps)[:, 9:]
            loss = off.square().sum()
            return torch.autograd.grad(loss, maps)[0], float(loss.detach())

    return TrackingView(EYE, lambda places: [PyramidLevel(compare, 200.0)] * 3, lambda row, going: going)


def node_maps_of(bodies, poses):
    maps = torch.zeros(len(bodies.nodes.positions), 12)
    bodies.carry(poses, bodies.nodes.positions, torch.zeros(len(maps), 7), maps)
    return maps


def camera_at(width, height):
    return Camera(width, height, 50.0, 50.0, width / 2, height / 2, torch.eye(4), 0.1, 10.0)


def test_nodes_links_and_edges_are_of_one_body_each(bodies):
    of_node = bodies.of_node
    assert [int((of_node == body).sum()) for body in (0, 1, -1)] == [28, 28, 4]
    ends = bodies.nodes.edges[bodies.nodes.edge_weights > 0]
    starts = torch.arange(len(of_node))[:, None].expand_as(bodies.nodes.edges)[bodies.nodes.edge_weights > 0]
    assert torch.equal(of_node[ends], of_node[starts])
    rows, shares = bodies.nodes.links(torch.tensor([[0.52, 0.0, 0.0], [-0.75, 0.0, 0.0]]))
    for row, share, body in zip(rows.long(), shares, (1, 0)):
        assert {*of_node[row[share > 0]].tolist()} == {body}
    torch.testing.assert_close(shares.sum(-1), torch.ones(2))


def test_nodes_go_with_their_bodies_and_others_rest(bodies):
    seen(bodies, 0.75)
    poses, of_node = rolled(bodies, 0.75), bodies.of_node
    now = places(bodies, 0.75)
    for body in (0, 1):
        own = bodies.nodes.positions[of_node == body] - bodies.rest[body]
        torch.testing.assert_close(
            now[of_node == body], own @ poses.turns[body].T + poses.middles[body], atol=1e-5, rtol=0.0
        )
    assert torch.equal(now[of_node < 0], bodies.nodes.positions[of_node < 0])
    motion, maps = motion_and_maps(bodies, 0.75)
    torch.testing.assert_close(node_maps(motion, bodies.nodes.positions), maps, atol=1e-5, rtol=1e-5)


def test_poses_lie_between_those_seen_and_stay_beyond_them(bodies):
    seen(bodies, 0.75)
    assert apart(bodies, bodies.at(0.6), rolled(bodies, 0.6)) < 1e-5
    for time, end in ((0.9, 0.75), (0.1, 0.5)):
        assert apart(bodies, bodies.at(time), rolled(bodies, end)) < 1e-5


def test_gradients_are_those_of_poses_that_take_a_small_twist_over(bodies):
    seen(bodies, 0.8)
    factors = torch.randn(len(bodies.nodes.positions), 12, generator=torch.Generator().manual_seed(1))
    row = bodies.row(0.8)
    found = bodies.gradients(0.8, factors)
    others = torch.arange(len(TIMES)) != row
    assert not bool(found[:, others].any())
    start, small = (bodies.turns.clone(), bodies.middles.clone()), 1e-3
    for body in range(2):
        for number in range(6):
            sides = []
            for sign in (1, -1):
                bodies.turns, bodies.middles = (value.clone() for value in start)
                bodies.twists.data[body, row, number] = sign * small
                bodies.settle()
                assert not bool(bodies.twists.any())
                sides.append(float((node_maps_of(bodies, bodies.at(0.8)).double() * factors).sum()))
            exact = (sides[0] - sides[1]) / (2 * small)
            assert float(found[body, row, number]) == pytest.approx(exact, rel=0.01, abs=0.05)


def test_bodies_stay_before_what_is_behind_them(bodies):
    poses = rolled(bodies, 0.6)
    away = (poses.middles - EYE).norm(dim=-1)
    bodies.put(0.6, poses, EYE)
    bodies.bring_before(0.6, torch.stack([0.99 * away[0], 0.5 * away[1]]))
    nearer = (bodies.at(0.6).middles - EYE).norm(dim=-1) / away
    torch.testing.assert_close(nearer, torch.tensor([0.99, 0.97]))  # the other would have jumped
    bodies.twists.data[0, bodies.row(0.6), 3:] = 0.2 * (poses.middles[0] - EYE)
    bodies.settle()
    assert float((bodies.at(0.6).middles[0] - EYE).norm() / away[0]) == pytest.approx(0.99, rel=1e-4)


@pytest.mark.parametrize("kind", ["spline", "cosines"])
def test_curves_take_over_where_bodies_are(bodies, kind):
    """Cosines are exactly 0 at the canonical time, before which the first turns by more than half a turn."""
    bodies.nodes.curve = Curve(kind, 18, 21, 0.5)
    bodies.nodes.translations.data, bodies.nodes.rotations.data = (
        torch.zeros(60, 18, 3),
        torch.zeros(60, 18, 4),
    )
    seen(bodies, *TIMES)
    times = [0.1, 0.48, 0.77]
    before = [places(bodies, time) for time in times]
    bodies.fit_curves(bodies.nodes)
    bodies.lead.fill_(False)
    for time, place in zip(times, before):
        assert (places(bodies, time) - place).norm(dim=-1).amax() < 0.02
        linear = bodies.nodes.maps(time)[:, :9].reshape(-1, 3, 3) + torch.eye(3)
        turns = rolled(bodies, time).turns[bodies.of_node]
        assert (linear - turns)[bodies.of_node >= 0].abs().amax() < 0.05


@pytest.mark.parametrize("slow", [1.0, 0.0], ids=["as before", "from rest"])
def test_bodies_are_found_in_a_new_image(bodies, slow):
    """Even turns are foreseen; from rest, turns are held back by less than what the image says of them."""
    seen(bodies, 0.5, 0.55, slow=slow)
    truth = rolled(bodies, 0.6)
    start = apart(bodies, bodies.at(0.6), truth)
    found = find(bodies, 0.6, bodies.nodes.positions, shown(bodies, truth, 0.6))
    assert apart(bodies, found, truth) < (0.05 if slow else 0.6) * start


def test_distances_are_where_images_are_alike_or_go_there(bodies):
    """At the lowest point of a parabola; if losses bend down, the way they fall; by broken ones, nowhere."""
    poses = rolled(bodies, 0.5)
    far = (poses.middles - EYE).norm(dim=-1)

    def reached(loss):
        found = fit_distances(poses, EYE, lambda now: loss((now.middles - EYE).norm(dim=-1) / far))
        assert torch.equal(found.turns, poses.turns)
        return (found.middles - EYE).norm(dim=-1) / far

    best = torch.tensor([1.03, 0.95])
    torch.testing.assert_close(reached(lambda now: float((now - best).square().sum())), best)
    torch.testing.assert_close(reached(lambda now: float(now.sum())), torch.full((2,), 0.92))
    torch.testing.assert_close(reached(lambda now: -float(now.log().sum().exp())), torch.full((2,), 1.08))
    torch.testing.assert_close(reached(lambda now: float(((now - 1) ** 4 - now / 1e9).sum())), torch.ones(2))
    torch.testing.assert_close(reached(lambda now: math.nan), torch.ones(2))


@pytest.mark.slow
def test_a_body_is_looked_for_where_it_is_seen_again(bodies):
    """Where it would go on is too far away for steps; where it is seen again counts if that is better."""
    truth = rolled(bodies, 0.5)
    truth = truth.but(1, Poses(truth.turns, truth.middles + torch.tensor([0.0, 8.0, 0.0])))
    image = shown(bodies, truth, 0.55)
    reached = find(bodies, 0.55, bodies.nodes.positions, image)
    assert (reached.middles - truth.middles)[1].norm() > 4.0
    found = find(bodies, 0.55, bodies.nodes.positions, image._replace(again=lambda row, going: truth))
    assert (found.middles - truth.middles).norm(dim=-1).amax() < 0.3
    wrong = Poses(truth.turns, truth.middles + 50.0)
    found = find(bodies, 0.55, bodies.nodes.positions, image._replace(again=lambda row, going: wrong))
    torch.testing.assert_close(found.middles, reached.middles)


def test_a_part_of_an_image_is_found_again_in_another_light_and_at_its_border():
    """Of its rectangle, only what is in the mask must be alike; half of that must lie inside."""
    noise = [torch.rand(40, 50, generator=torch.Generator().manual_seed(seed)) for seed in (0, 1, 2)]
    image, mask = noise[0], torch.zeros(40, 50, dtype=torch.bool)
    mask[10:20, 12:24] = True
    mask[10:16, 12:20] = False
    around = torch.tensor([4, 1])
    for x, y, inside in ((7, -5, 1), (-9, 8, 1), (0, 0, 1), (24, 3, 1), (28, 0, 1), (30, 0, 0), (34, 0, 0)):
        wide = torch.cat([noise[1], noise[2]], 1)
        wide[10 + y : 20 + y, 12 + x : 24 + x][mask[10:20, 12:24]] = 0.6 * image[mask] + 0.3
        found = find_shift(image, mask, wide[:36, :50], around, 30)
        assert (found is not None and found.tolist() == [x, y]) == bool(inside)
    stripes = noise[0][:, :1].expand(40, 50)  # beyond the border they would go on
    found = find_shift(stripes, mask, torch.cat([noise[1][:, :49], stripes[:, :1]], 1), around, 40)
    assert found is None or found[0] < 30
    assert find_shift(image, mask, torch.full((40, 50), 0.5), around, 5) is None
    assert find_shift(image, mask & ~mask, image, around, 5) is None


def test_what_an_image_shows_beside_places_is_looked_at():
    camera = camera_at(width=200, height=100)
    at = [(100.0, 50.0), (112.0, 50.0), (100.0, 62.0), (140.0, 50.0), (199.5, 50.0), (205.0, 50.0)]
    points = torch.stack([camera.center + 2.0 * camera.directions(*pixel) for pixel in at]).float()
    assert near_places(camera, points, points[:1]).tolist() == [True, True, True, False, False, False]


def test_quaternions_turn_by_more_than_half_a_turn():
    angle = torch.tensor(3.5)  # radian
    half = torch.cat([torch.tensor([0.0, 0.0]), (angle / 2).sin()[None], (angle / 2).cos()[None]])
    for length in (1.0, 0.3):
        motion = torch.cat([torch.zeros(3), length * half - IDENTITY])[None]
        linear = node_maps(motion, torch.zeros(1, 3))[0, :9].reshape(3, 3) + torch.eye(3)
        torch.testing.assert_close(linear, rotation(0.0, 0.0, 3.5), atol=1e-5, rtol=0.0)


@torch.no_grad()
def test_a_quaternion_of_length_0_turns_nothing():
    """By the kernel and without it; a file may hold one."""
    rotations = (-IDENTITY).repeat(3, 1, 1)
    motion, maps = carry_nodes(torch.ones(3, 1, 3), rotations, torch.ones(1), torch.rand(3, 3))
    for found in (maps, node_maps(motion, torch.rand(3, 3))):
        torch.testing.assert_close(found, torch.tensor([0.0] * 9 + [1.0] * 3).repeat(3, 1))


def test_a_twist_that_is_no_number_leaves_the_pose(bodies):
    bodies.twists.data[0, 3] = torch.nan
    before = bodies.middles.clone()
    bodies.settle()
    assert torch.equal(bodies.middles, before)
    assert not bool(bodies.twists.any())


@pytest.mark.parametrize("bad", [2, -2])
def test_a_node_of_a_body_that_there_is_not_is_named(bodies, bad):
    state = {"sizes": bodies.sizes, GROUPS: bodies.of_node}
    assert bodies.misfit(state, "") is None
    state[GROUPS] = torch.where(torch.arange(60) == 3, bad, bodies.of_node)
    assert bodies.misfit(state, "") == GROUPS
