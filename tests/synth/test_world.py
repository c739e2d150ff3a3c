"""Each specimen is what it is said to call for: measured on its meshes and its images."""

import numpy as np
import pytest

from forewarp.synth.raycast import Posed, camera_rays, light_points, render
from forewarp.synth.scenes import random_cameras
from forewarp.synth.vehicle import GROUND, MOTIONS
from forewarp.synth.world import BLOCKS, LIGHT_AT, ROOM_HIGH, ROOM_LOW, SPECIMENS, World
from tests.synth.test_shapes import volume

TIMES = np.linspace(0, 1, 41)


def cameras(count, size, *where):
    return random_cameras(count, size, np.random.default_rng([0, 2]), *where)


def paths(name):
    """Places (6, V, 3) of every vertex."""
    world = World(name)
    return np.stack([world.place(time) for time in TIMES[::8]])


@pytest.mark.parametrize("name", SPECIMENS)
def test_four_of_them_stand_still(name):
    moved = np.abs(np.diff(paths(name)[[0, -2]], axis=0)).max()
    assert (moved == 0) if name in ("still", "glossy", "daylight", "blocks") else (moved > 0.1)


@pytest.mark.parametrize("name", ["rigid", "quick", "room", "spin"])
def test_parts_keep_their_shape(name):
    world, places = World(name), paths(name)
    a, b = world.faces[:, :2].T
    lengths = [np.linalg.norm(at[a] - at[b], axis=-1) for at in places]
    np.testing.assert_allclose(np.ptp(lengths, axis=0), 0, atol=1e-9)


def test_the_band_is_drawn_out_and_the_wings_turn_by_a_sixth_of_a_turn():
    assert [SPECIMENS["band"].joints(time)["sheet"][0, 0] for time in (0, 1)] == pytest.approx([1, 5])
    c, s = np.cos(np.pi / 3), np.sin(np.pi / 3)
    turned = [[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.testing.assert_allclose(SPECIMENS["spin"].joints(1)["wings"], turned, atol=1e-12)


def beyond_cosines(values, count):
    """What the first cosines leave of values (T, N) over ``TIMES``: the largest error."""
    basis = np.cos(np.pi * (np.arange(len(TIMES)) + 0.5)[:, None] / len(TIMES) * np.arange(count))
    return np.abs(basis @ np.linalg.lstsq(basis, values, rcond=None)[0] - values).max()


def test_the_quick_one_needs_more_cosines_than_the_slow_one():
    slow, quick = (
        np.stack([SPECIMENS[n].joints(t)["chassis"].ravel() for t in TIMES]) for n in ("rigid", "quick")
    )
    assert beyond_cosines(slow, 7) < 5e-3 < 0.015 < beyond_cosines(quick, 7)


def test_only_the_glossy_one_throws_light_back_in_one_direction():
    gloss = {name: max(part.material.gloss for part in World(name).parts) for name in SPECIMENS}
    assert [name for name in gloss if gloss[name] > 0] == ["glossy"]
    posed = Posed(World("glossy"), 0.0)
    origins, directions = camera_rays(cameras(1, 60)[0])
    hits = posed.first_hits(origins, directions)
    matte, seen = posed.color(hits, light_points(6)), posed.color(hits, light_points(6), directions)
    assert (seen >= matte - 1e-12).all()
    assert (seen - matte).max() > 0.2
    assert np.median(seen - matte) < 0.1


def test_by_daylight_shades_change_and_nothing_else():
    camera = cameras(1, 40)[0]
    (first, near), (last, far) = (render(World("daylight"), time, camera, 1) for time in (0.0, 0.7))
    np.testing.assert_array_equal(near, far)
    np.testing.assert_array_equal(first[..., 3], last[..., 3])
    seen = first[..., 3] > 0
    assert np.abs(first[seen].astype(int) - last[seen])[:, :3].max(-1).mean() > 10


@pytest.mark.parametrize("time", [0.0, 0.4, 0.5, 0.65, 1.0])
def test_blocks_are_where_they_are_and_nowhere_else(time):
    there = {name: begin <= time <= end for name, ((begin, end), *_) in BLOCKS.items()}
    posed = Posed(World("blocks"), time)
    above = np.array([[0.45 * x, 0.45 * y, 2.0] for _, (x, y), _ in BLOCKS.values()])
    hits = posed.first_hits(above, np.tile([0.0, 0, -1], (4, 1)))
    named = [posed.world.parts[posed.world.part_of_face[face]].name for face in hits.face]
    assert named == [name if there[name] else "plate" for name in BLOCKS]
    beside, along = np.array([[-0.6, 0.45, GROUND + 0.2]]), np.array([[1.0, 0, 0]])
    assert bool(posed.is_free(beside, along)[0]) is not there["north"]


@pytest.mark.slow
def test_the_corner_fills_every_image():
    room = SPECIMENS["room"]
    for camera in cameras(6, 24, room.azimuth, room.rise):
        rgba, depth = render(World("room"), 0.5, camera, 1, 1)
        assert (rgba[..., 3] == 255).all()
        assert (depth > 0).all()


def test_walls_of_a_room_end_every_ray_cast_no_shadow_and_never_move():
    world = World("drive", has_room=True)
    posed = Posed(world, 0.3)
    directions = np.random.default_rng(0).normal(size=(3000, 3))
    hits = posed.first_hits(np.tile([0.0, -2.5, 0.8], (3000, 1)), directions)
    assert len(hits.ray) == 3000
    names = {world.parts[i].name for i in world.part_of_face[hits.face]}
    assert {"floor", "ceiling", "left", "right", "front", "back"} <= names
    above = np.array([[0.0, 0.0, 1.5]])
    assert posed.is_free(above, LIGHT_AT - above).all()
    assert len(posed.first_hits(above, LIGHT_AT - above).ray) == 1  # though the ceiling is in the way
    walls = np.unique(world.faces[~world.casts])
    np.testing.assert_array_equal(world.place(0.0)[walls], world.place(0.9)[walls])
    assert min(*ROOM_HIGH, -ROOM_LOW[0], -ROOM_LOW[1]) > 1.365  # all that moves stays within this


@pytest.mark.parametrize("motion", MOTIONS)
def test_every_motion_spans_few_low_frequencies(motion):
    """Ten cosines hold every joint's map to 5e-3: what a trajectory grid can learn."""
    maps = np.stack([np.stack([*MOTIONS[motion](time).values()]).ravel() for time in TIMES])
    assert beyond_cosines(maps, 10) < 5e-3
    assert np.abs(maps - maps[0]).max() > 0.1


@pytest.mark.parametrize("motion", MOTIONS)
def test_band_and_ball_keep_their_volumes_and_the_band_follows_the_pin(motion):
    maps = [MOTIONS[motion](t) for t in TIMES]
    for part, volume_at_rest in (("band", np.linalg.det(maps[0]["band"])), ("ball", 1)):
        volumes = np.linalg.det([at[part] for at in maps])
        np.testing.assert_allclose(volumes, volume_at_rest, rtol=1e-12)
    for at in maps:
        np.testing.assert_allclose(at["band"] @ (1, 0, 0, 1), at["stick"] @ (0.36, 0.125, 0, 1), atol=1e-12)


def test_wheels_roll_without_slipping():
    start, end = MOTIONS["drive"](0), MOTIONS["drive"](1)
    angles = [np.arctan2(*(np.linalg.inv(at["chassis"]) @ at["wheel0"])[[2, 0], 0]) for at in (start, end)]
    assert angles[0] - angles[1] == pytest.approx(0.42 / 0.16)  # the way over the radius


def test_every_part_is_closed_and_turned_outwards():
    for part in World().parts:
        edges = part.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        forward, backward = ({tuple(e) for e in side} for side in (edges, edges[:, ::-1]))
        assert len(forward) == len(edges), part.name
        assert forward == backward, part.name
        assert volume((part.vertices, part.faces)) > 0, part.name


@pytest.mark.parametrize(
    ("motion", "moving"),
    [
        ("lift", {"boom", "boom_pins", "stick", "stick_pins", "bucket", "band"}),
        ("lift_tilt", {"boom", "boom_pins", "stick", "stick_pins", "bucket", "band", "ball"}),
        ("drive", {part.name for part in World().parts} - {"ground", "ball"}),
    ],
)
def test_exactly_what_a_motion_moves_moves_above_ground_and_in_sight(motion, moving):
    world = World(motion)
    places = np.stack([world.place(time) for time in (0.0, 0.35, 0.7, 1.0)])
    assert np.linalg.norm(places, axis=-1).max() < 1.365  # the sphere that fits into the view
    part_of_vertex = np.repeat([p.name for p in world.parts], [len(p.vertices) for p in world.parts])
    assert places[:, part_of_vertex != "ground", 2].min() > GROUND
    changed = (places[-1] != places[0]).any(-1)  # by one bit
    assert set(part_of_vertex[changed]) == moving
