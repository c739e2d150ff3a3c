import numpy as np
import pytest

from forewarp.synth.raycast import LIGHT_AT, Posed
from forewarp.synth.vehicle import HIGH, LOW
from forewarp.synth.world import World


@pytest.fixture(scope="module")
def world():
    return World("drive", has_room=True)


def test_every_ray_from_inside_ends(world):
    directions = np.random.default_rng(0).normal(size=(3000, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    hits = Posed(world, 0.3).first_hits(np.tile([0.0, -2.5, 0.8], (3000, 1)), directions)
    assert len(hits.ray) == 3000
    names = {world.parts[i].name for i in world.part_of_face[hits.face]}
    assert {"floor", "ceiling", "left", "right", "front", "back"} <= names


def test_walls_cast_no_shadow_and_never_move(world):
    above = np.array([[0.0, 0.0, 1.5]])
    towards = LIGHT_AT - above
    towards /= np.linalg.norm(towards)
    assert Posed(world, 0.0).is_free(above, towards).all()
    assert len(Posed(world, 0.0).first_hits(above, towards).ray) == 1  # though the ceiling is in the way
    walls = np.unique(world.faces[~world.casts])
    np.testing.assert_array_equal(world.place(0.0)[walls], world.place(0.9)[walls])
    assert min(*HIGH, -LOW[0], -LOW[1]) > 1.365  # all that moves stays within this of the middle
