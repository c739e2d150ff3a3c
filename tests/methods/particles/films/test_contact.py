"""What moves in a film begins at the distance of the ground that it stands on."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from forewarp.methods.method import Start
from forewarp.methods.particles.films.bodies import Poses
from forewarp.methods.particles.films.contact import place_on_ground, things_on_the_ground
from forewarp.methods.particles.films.tracking import _again, body_of
from forewarp.methods.particles.model import Particles
from forewarp.ops.gaussians import FLAT, moved
from forewarp.scene.frame import where_seen
from forewarp.scene.view import Moment, Observation, View
from tests.support.particles import BARE, MOVING, look, module_with, small_data

DATA = small_data()
FRAME = min(DATA.scene.train, key=lambda frame: abs(frame.time - DATA.scene.canonical_time))
SIZE = FRAME.camera.height, FRAME.camera.width
FARTHER = 3.0  # times the ball's distance, of the ground


def masked(*boxes):
    """A mask (H, W) bool of rectangles (top, bottom, left, right)."""
    mask = torch.zeros(SIZE, dtype=torch.bool)
    for top, bottom, left, right in boxes:
        mask[top:bottom, left:right] = True
    return mask


def scene_with(mask, **more):
    frames = [replace(frame, **{"load_moving": lambda: mask} | more) for frame in DATA.scene.train]
    return replace(DATA.scene, train=tuple(frames))


@pytest.fixture
def before():
    """A ball at rest, half of whose particles lie on a wall behind it."""
    method = module_with(DATA, **BARE).method
    rays = FRAME.camera.rays(torch.arange(SIZE[0] * SIZE[1]))
    away = FARTHER * float((method.gaussians.means.data - FRAME.camera.center.float()).norm(dim=-1).median())
    count = len(method.gaussians.means) // 2
    wall = rays.origins + away * rays.directions
    method.gaussians.means.data[:count] = wall[torch.arange(count) % len(wall)]
    return method, away


def test_each_thing_stands_on_the_ground_below_it_unless_it_reaches_the_lower_edge():
    moving = masked((2, 8, 1, 5), (9, 14, 8, 13), (3, SIZE[0], 15, 19))
    depth = torch.full(SIZE, 9.0)
    depth[8, 1:5], depth[14, 8:13] = 2.0, torch.tensor([5.0, 5.0, 0.0, 0.0, 5.0])  # not known everywhere
    found = sorted(things_on_the_ground(moving, depth), key=lambda thing: thing[1])
    assert [(int(mask.sum()), distance) for mask, distance in found] == [(24, 2.0), (25, 5.0)]
    depth[8:] = 0.0
    assert things_on_the_ground(moving, depth) == []  # no ground is known


@pytest.mark.parametrize(
    ("light", "small"), [(None, 0.11), (torch.tensor([[0.5] * 3, [0.1] * 3]), 0.13)], ids=["large", "light"]
)
def test_particles_of_what_moves_are_replaced_at_the_distance_of_the_ground(
    before, monkeypatch, light, small
):
    """It is a body only if all that moves, here 12 % of the image, is small."""
    method, away = before
    monkeypatch.setattr("forewarp.methods.particles.films.contact.SMALL_MOVERS", small)
    monkeypatch.setattr(method, "light", lambda moment: light)
    mask = masked((6, 12, 6, 14))
    monkeypatch.setattr(
        "forewarp.methods.particles.films.contact.things_on_the_ground", lambda moving, depth: [(mask, away)]
    )
    old = {name: value.clone() for name, value in method.values().items()}
    new = place_on_ground(old, scene_with(mask), method.drawn, method.light_of)
    moves, body_of = new.pop("is_placed"), new.pop("body_of")
    assert torch.equal(body_of, torch.where(moves & (small > 0.12), 0, -1))
    assert new.keys() == old.keys()
    assert {len(value) for value in new.values()} == {len(moves)}
    distances = (new["means"] - FRAME.camera.center.float()).norm(dim=-1)
    row, column, _ = where_seen(FRAME.camera, new["means"])
    inside = torch.stack([row - 5, 12 - row, column - 5, 14 - column]).amin(0)[moves]  # pixels to the edge
    bulge = (9 - (3 - inside) ** 2).sqrt() / FRAME.camera.fx
    torch.testing.assert_close(distances[moves], away * (1 - bulge))
    assert bool(mask[row, column][moves].all())
    left = mask[row.clamp(0, SIZE[0] - 1), column.clamp(0, SIZE[1] - 1)] & ~moves
    assert bool((distances[left] > 0.99 * away).all())  # nothing is left before it
    colors, truth = 0.5 + FLAT * new["colors"][moves, 0], FRAME.load()[row[moves], column[moves], :3] / 255
    colors = colors if light is None else light[0] * colors + light[1]
    torch.testing.assert_close(colors, truth, atol=1e-4, rtol=0.0)
    row, column, _ = where_seen(FRAME.camera, old["means"])
    outside = ~mask[row.clamp(0, SIZE[0] - 1), column.clamp(0, SIZE[1] - 1)]
    behind = outside & ((old["means"] - FRAME.camera.center.float()).norm(dim=-1) > 0.99 * away)
    kept = {tuple(place) for place in new["means"][~moves].tolist()}
    assert {tuple(place) for place in old["means"][behind].tolist()} <= kept
    assert len(old["means"]) > len(kept) >= int(behind.sum()) > 0
    shared = torch.arange(len(old["means"]))  # a window leaves these as they are
    new = place_on_ground(old | {"shared": shared}, scene_with(mask), method.drawn, method.light_of)
    assert torch.equal(new["shared"], torch.cat([shared, shared.new_full((int(moves.sum()),), -1)]))


@pytest.mark.parametrize(
    "changes",
    [
        {"load_moving": None},
        {"load_sensed": lambda: torch.ones(2, *SIZE)},
        {"load_valid": lambda: torch.zeros(SIZE, dtype=torch.bool)},
    ],
)
def test_without_masks_or_known_ground_or_with_measured_depth_nothing_changes(before, changes):
    method, _ = before
    mask = masked((6, 12, 6, 14))
    old = method.values()
    assert place_on_ground(old, scene_with(mask), method.drawn, method.light_of) is not old
    assert place_on_ground(old, scene_with(mask, **changes), method.drawn, method.light_of) is old


@pytest.mark.parametrize("trusts", [True, False])
def test_what_was_set_down_follows_nodes(before, monkeypatch, trusts):
    """Masks count only where the stage trusts them; what they show to move never rests."""
    monkeypatch.setattr("forewarp.methods.particles.nodes._FEWEST", 1)  # a few particles are a body
    monkeypatch.setattr("forewarp.methods.particles.films.contact.SMALL_MOVERS", 0.2)
    method, _ = before
    rests = torch.ones(SIZE, dtype=torch.bool)
    scene = scene_with(masked((6, 12, 6, 14)), load_resting=lambda: rests)
    numbers = {"rest_by_masks": trusts, "bodies": 0.5}
    start = Start(scene, "fine", numbers, list(range(len(scene.train))), None, method, False)
    fine = Particles(start, **MOVING | {"background": 0.03})
    count = len(fine.gaussians.means) - len(method.gaussians.means)
    if trusts:
        fresh = (fine.gaussians.opacity.data[:, 0] == 2.0).nonzero()[:, 0]
        assert len(fresh)
        assert not bool(fine.deformation.resting[fresh].any())
        assert bool((fine.deformation.skinning.shares[fresh].sum(-1) > 0.99).all())
        assert len(fine.hook.bodies) == 1
        followed = fine.deformation.nodes.groups[fine.deformation.skinning.links[fresh].long()]
        assert bool((followed[fine.deformation.skinning.shares[fresh] > 0] == 0).all())
        assert bool(fine.deformation.resting.any())
        # An export before the nodes take over has the motion of bodies too, and leaves them the lead.
        bodies, slow = fine.hook.bodies, torch.tensor([0.1, 0.0, 0.05])
        for time in bodies.times:
            bodies.put(time, Poses(torch.eye(3)[None], bodies.rest + time * slow), torch.ones(3))
        for time in bodies.times:
            exact, written = (
                moved(fine.gaussians.means.data, form.warp(time))[0] for form in (fine, fine.moving())
            )
            torch.testing.assert_close(written, exact, atol=2e-3, rtol=0.0)
            torch.testing.assert_close(exact[fresh], fine.gaussians.means.data[fresh] + time * slow)
        assert fine.is_led
    else:
        assert count == 0
        assert len(fine.hook.bodies) == 0


def test_a_checkpoint_is_loaded_without_a_look_at_masks(before):
    def unread():
        raise AssertionError("a mask was read")

    method, _ = before
    scene = scene_with(None, load_moving=unread)
    start = Start(scene, "fine", {"rest_by_masks": True}, [0], None, method, True)
    assert len(Particles(start, **MOVING).gaussians) == len(method.gaussians.means)


@pytest.fixture
def led(before, monkeypatch):
    """Particles of a fine stage with a body, and their scene."""
    monkeypatch.setattr("forewarp.methods.particles.nodes._FEWEST", 1)
    monkeypatch.setattr("forewarp.methods.particles.films.contact.SMALL_MOVERS", 0.2)
    rests = torch.ones(SIZE, dtype=torch.bool)
    scene = scene_with(masked((6, 12, 6, 14)), load_resting=lambda: rests)
    numbers = {"rest_by_masks": True, "bodies": 0.5}
    start = Start(scene, "fine", numbers, list(range(len(scene.train))), None, before[0], False)
    return Particles(start, **MOVING | {"background": 0.03}), scene


def test_a_body_is_moved_to_where_it_is_as_large_as_shown(led):
    """In the second of four rounds and the others, once each; in the first its shape is not known yet."""
    fine, scene = led
    bodies, view = fine.hook.bodies, View(FRAME.camera)
    moment = Moment(next(time for time in sorted(fine.frames) if not bodies.seen[bodies.row(time)]))
    row = bodies.row(moment.time)
    bodies.seen[row] = True
    drawn = fine.at(moment).render(view, torch.zeros(3)).rgb
    image = torch.cat([(255 * drawn.clamp(0, 1)).round(), torch.full((len(drawn), 1), 255.0)], 1)
    seen = Observation(moment, view, image.to(torch.uint8), torch.zeros(3))
    eye, there = FRAME.camera.center.float(), bodies.middles[0, row].clone()

    def off(progress, share):
        fine.progress = progress
        if share is not None:
            bodies.middles[0, row] = eye + share * (there - eye)
        fine.hook.before_image(fine, seen)
        return float((bodies.middles[0, row] - eye).norm() / (there - eye).norm()) - 1

    assert abs(off(0.12, 1.05) - 0.05) < 1e-5
    assert abs(off(0.13, None)) < 0.03
    assert abs(off(0.24, 0.95) + 0.05) < 1e-5
    assert abs(off(0.26, None)) < 0.03
    seen = replace(seen, moment=Moment(scene.canonical_time))  # there it is where it was set down
    row = bodies.row(scene.canonical_time)
    assert abs(off(0.4, 1.05) - 0.05) < 1e-5


def test_a_body_is_seen_again_beside_where_it_was(led):
    """A pixel beside it, as far away and turned as it would go on. What is around it goes elsewhere, and
    the camera pans.
    """
    fine, scene = led
    bodies = fine.hook.bodies
    row = bodies.row(scene.canonical_time)
    held = bodies.middles[:, row]
    before = fine.frames[bodies.times[row]]
    camera = before.camera
    panned = replace(camera, cx=camera.cx + 4)
    fine.gaussians.opacity.data.fill_(1.0)
    image = torch.randint(0, 255, (*SIZE, 3), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    other = image.flip(0, 1)
    rows, columns, _ = where_seen(
        camera, fine.gaussians.means.data[fine.deformation.skinning.shares.sum(-1) > 0]
    )
    window = [slice(int(x.amin()) - 1, int(x.amax()) + 2) for x in (rows, columns)]
    went = [slice(part.start + off, part.stop + off) for part, off in zip(window, (1, 3), strict=True)]
    other[tuple(went)] = image[tuple(window)]
    frames = {bodies.times[row]: replace(before, load=lambda: image)}
    frames[0.9] = replace(before, camera=panned, load=lambda: other)
    turns = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])[None]
    found = _again(bodies, fine, frames, 0.9, row, Poses(turns, held))
    assert torch.equal(found.turns, turns)
    was, now, eye = camera.project(held)[0], panned.project(found.middles)[0], camera.center.float()
    torch.testing.assert_close(now - was, torch.tensor([[3.0, 1.0]]).to(was), atol=1e-3, rtol=0)
    torch.testing.assert_close((found.middles - eye).norm(), (held - eye).norm())
    frames[0.9] = replace(before, load=lambda: torch.full_like(image, 90))
    assert torch.equal(_again(bodies, fine, frames, 0.9, row, Poses(turns, held)).middles, held)


def test_what_rests_beside_a_body_is_not_of_it(led):
    fine, _ = led
    rests = fine.deformation.skinning.shares.sum(-1) == 0
    fine.deformation.skinning.links[rests] = fine.deformation.skinning.links[body_of(fine) == 0][:1]
    assert bool(rests.any())
    assert bool((body_of(fine)[rests] == -1).all())


def test_bodies_grow_until_they_touch_the_ground_and_images_stay_alike(led):
    fine, scene = led
    bodies, view, eye = fine.hook.bodies, View(FRAME.camera), FRAME.camera.center.float()
    canonical, time = scene.canonical_time, next(t for t in sorted(fine.frames) if t != scene.canonical_time)
    row, far = bodies.row(time), (bodies.rest - eye).norm(dim=-1)
    fine.gaussians.opacity.data[body_of(fine) < 0] = -20.0  # these would hide them

    def images():
        canon, turned = (fine.at(Moment(t)).render(view, torch.zeros(3)) for t in (canonical, time))
        return canon.opacity, turned.opacity, turned.rgb  # at rest all are equally far away, in any order

    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])[None]
    bodies.put(time, Poses(turn, eye + 0.5 * (bodies.rest - eye)), eye)
    before, means, nodes = (
        images(),
        fine.gaussians.means.data.clone(),
        fine.deformation.nodes.positions.clone(),
    )
    fine.hook.put_on_ground(fine)  # no ground is known
    assert torch.equal(fine.gaussians.means.data, means)
    bodies.farthest[:, row] = 1.2 * 0.5 * far
    fine.hook.put_on_ground(fine)
    for image, other in zip(images(), before, strict=True):
        torch.testing.assert_close(image, other, atol=1e-5, rtol=0)
    torch.testing.assert_close((bodies.middles[:, row] - eye).norm(dim=-1), 1.2 * 0.5 * far)
    torch.testing.assert_close((bodies.rest - eye).norm(dim=-1), 1.2 * far)
    grown = torch.where(bodies.of_node >= 0, 1.2, 1.0)[:, None]
    torch.testing.assert_close(fine.deformation.nodes.positions - eye, grown * (nodes - eye))
    bodies.farthest[:, row] = 0.1 * far  # too far already
    fine.hook.put_on_ground(fine)
    torch.testing.assert_close((bodies.rest - eye).norm(dim=-1), 1.2 * far)


@pytest.mark.slow
def test_bodies_lead_until_their_share_of_the_stage_is_over(led):
    """A step at an image follows them there, and is of their poses alone; nothing rests before it is over."""
    fine, scene = led
    groups = [{"name": n, "params": p, "lr": 1e-3, "base_lr": 1e-3} for n, p in fine.param_groups().items()]
    optimizer, bodies = fine.optimizer(groups), fine.hook.bodies
    index = max(range(len(scene.train)), key=lambda i: abs(scene.train[i].time - scene.canonical_time))
    time = scene.train[index].time
    assert not bool(bodies.seen[bodies.row(time)])
    found = look(
        SimpleNamespace(method=fine, generator=torch.Generator()), DATA, index, {"photo": 1.0}
    ).gradients
    assert bool(bodies.seen[bodies.row(time)])
    assert bool(found["hook.bodies.twists"][:, bodies.row(time)].any())
    assert not bool(
        found["deformation.nodes.translations"].any() | found["deformation.nodes.rotations"].any()
    )
    fine.density.round.fill_(44)
    fine.advance(0.4501, 0, optimizer)
    assert fine.is_led
    assert not bool(fine.deformation.nodes.stopped.any())
    assert not bool(fine.deformation.nodes.translations.any())
    row = bodies.row(time)
    bodies.farthest[:, row] = 1.3 * (bodies.middles[:, row] - bodies.eyes[row]).norm(dim=-1)
    fine.advance(0.5, 0, optimizer)
    away = (bodies.middles[:, row] - bodies.eyes[row]).norm(dim=-1)
    torch.testing.assert_close(away, bodies.farthest[:, row])  # put on the ground
    assert not fine.is_led
    assert bool(fine.deformation.nodes.translations.any())
