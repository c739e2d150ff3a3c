import numpy as np
import pytest

from forewarp.synth.vehicle import GROUND, MOTIONS
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


def test_a_point_at_a_corner_is_its_vertex(world):
    faces = np.array([3, 700, 5000])
    corner = world.points(faces, np.tile([0.0, 1.0, 0.0], (3, 1)), 0.4)
    np.testing.assert_array_equal(corner, world.place(0.4)[world.faces[faces, 1]])


def test_exactly_what_a_motion_moves_moves():
    arm = {"boom", "boom_pins", "stick", "stick_pins", "bucket", "band", "ball"}
    for motion, expected in (("lift_tilt", arm), ("drive", None)):
        world = World(motion)
        if expected is None:
            expected = {part.name for part in world.parts} - {"ground", "ball"}
        changed = (world.place(1.0) != world.place(0.0)).any(-1)  # by one bit
        assert {part.name for part in world.parts if changed[rows(world, part.name)].any()} == expected
