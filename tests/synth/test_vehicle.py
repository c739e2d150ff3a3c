import numpy as np
import pytest

from forewarp.synth.vehicle import GROUND, MOTIONS
from forewarp.synth.world import World
from tests.synth.test_shapes import volume

MANY = np.linspace(0, 1, 41)


@pytest.mark.parametrize("motion", MOTIONS)
def test_every_motion_spans_few_low_frequencies(motion):
    """Ten cosines hold every joint's map to 5e-3: what a trajectory grid can learn."""
    maps = np.stack([np.concatenate(list(MOTIONS[motion](t).values())) for t in MANY]).reshape(len(MANY), -1)
    basis = np.cos(np.pi * (np.arange(len(MANY)) + 0.5)[:, None] / len(MANY) * np.arange(10))
    fitted = basis @ np.linalg.lstsq(basis, maps, rcond=None)[0]
    assert np.abs(fitted - maps).max() < 5e-3
    assert np.abs(maps - maps[0]).max() > 0.1


@pytest.mark.parametrize("motion", MOTIONS)
def test_band_and_ball_keep_their_volumes_and_the_band_follows_the_pin(motion):
    maps = [MOTIONS[motion](t) for t in MANY]
    for part, volume_at_rest in (("band", np.linalg.det(maps[0]["band"])), ("ball", 1)):
        volumes = np.linalg.det([at[part] for at in maps])
        np.testing.assert_allclose(volumes, volume_at_rest, rtol=1e-12)
    for at in maps:
        np.testing.assert_allclose(at["band"] @ (1, 0, 0, 1), at["stick"] @ (0.36, 0.125, 0, 1), atol=1e-12)


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
