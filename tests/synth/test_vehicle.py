import numpy as np
import pytest

from forewarp.synth.motions import GROUND, MOTIONS
from forewarp.synth.world import World


@pytest.fixture(scope="module", params=MOTIONS)
def world(request):
    return World(request.param)


def rows(world, name):
    """The vertices of one part."""
    faces = world.faces[[world.parts[i].name == name for i in world.part_of_face]]
    return np.unique(faces)


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.einsum("nd,nd->", np.cross(a, b), c) / 6


def test_every_part_is_closed_and_turned_outwards(world):
    for part in world.parts:
        edges = part.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        forward, backward = ({tuple(e) for e in side} for side in (edges, edges[:, ::-1]))
        assert len(forward) == len(edges), part.name
        assert forward == backward, part.name
        assert volume(part.vertices, part.faces) > 0, part.name


@pytest.mark.parametrize("time", [0.0, 0.35, 0.7, 1.0])
def test_everything_is_above_ground_and_in_sight(world, time):
    placed = world.place(time)
    assert np.linalg.norm(placed, axis=-1).max() < 1.365  # the sphere that fits into the view
    above = np.setdiff1d(np.arange(len(placed)), rows(world, "ground"))
    assert placed[above, 2].min() > GROUND


def test_static_parts_do_not_move_by_one_bit():
    world = World("lift_tilt")
    start, moving = world.place(0.0), {"boom", "boom_pins", "stick", "stick_pins", "bucket", "band", "ball"}
    for time in (0.3, 1.0):
        changed = (world.place(time) != start).any(-1)
        for part in world.parts:
            assert changed[rows(world, part.name)].any() == (part.name in moving), part.name


def test_the_drive_moves_all_but_ground_and_ball():
    world = World("drive")
    changed = (world.place(1.0) != world.place(0.0)).any(-1)
    still = {part.name for part in world.parts if not changed[rows(world, part.name)].any()}
    assert still == {"ground", "ball"}


def test_the_ball_mesh_keeps_its_volume():
    world = World("lift_tilt")
    faces = world.faces[[world.parts[i].name == "ball" for i in world.part_of_face]]
    volumes = [volume(world.place(t), faces) for t in np.linspace(0, 1, 7)]
    np.testing.assert_allclose(volumes, volumes[0], rtol=1e-9)


def test_a_point_at_a_corner_is_its_vertex(world):
    faces = np.array([3, 700, 5000])
    corner = world.points(faces, np.tile([0.0, 1.0, 0.0], (3, 1)), 0.4)
    np.testing.assert_array_equal(corner, world.place(0.4)[world.faces[faces, 1]])
