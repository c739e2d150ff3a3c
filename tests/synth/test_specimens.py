"""Each specimen is what it is said to call for: measured on its meshes and its pictures."""

import numpy as np
import pytest
import yaml

from forewarp.synth.cameras import random_cameras, stream
from forewarp.synth.raycast import Posed, camera_rays, light_points, render
from forewarp.synth.specimens import SPECIMENS
from forewarp.synth.world import World
from tests.support.configs import CONF

TIMES = np.linspace(0, 1, 41)


def paths(name):
    """Places (6, V, 3) of every vertex."""
    world = World(name)
    return np.stack([world.place(time) for time in TIMES[::8]])


@pytest.mark.parametrize("name", SPECIMENS)
def test_it_moves_exactly_where_motion_is_called_for(name):
    places = paths(name)
    moved = np.abs(places - places[0]).max()
    called_for = yaml.safe_load((CONF / "scene" / f"specimen_{name}.yaml").read_text())["calls_for"]
    assert (moved > 0.1) if "motion" in called_for else (moved == 0)


@pytest.mark.parametrize("name", ["rigid", "quick", "room"])
def test_parts_keep_their_shape(name):
    world, places = World(name), paths(name)
    for part in np.unique(world.part_of_face):
        faces = world.faces[world.part_of_face == part]
        edges = np.concatenate([faces[:, :2], faces[:, 1:]])
        lengths = [np.linalg.norm(at[edges[:, 0]] - at[edges[:, 1]], axis=-1) for at in places]
        np.testing.assert_allclose(np.ptp(lengths, axis=0), 0, atol=1e-9)


def test_the_band_is_drawn_out_beyond_what_a_splat_holds_together():
    joints = SPECIMENS["band"].joints
    assert max(np.linalg.norm(joints(time)["sheet"][:3, 0]) for time in TIMES) == pytest.approx(5.0)


def test_the_quick_one_needs_more_cosines_than_the_slow_one():
    steps = np.pi * (np.arange(len(TIMES)) + 0.5) / len(TIMES)
    basis = np.cos(steps[:, None] * np.arange(7))
    left = {}
    for name in ("rigid", "quick"):
        places = np.stack([SPECIMENS[name].joints(time)["chassis"].ravel() for time in TIMES])
        left[name] = np.abs(basis @ np.linalg.lstsq(basis, places, rcond=None)[0] - places).max()
    assert left["rigid"] < 5e-3 < 0.015 < left["quick"]


def test_only_the_glossy_one_has_gloss():
    gloss = {name: max(part.material.gloss for part in World(name).parts) for name in SPECIMENS}
    assert [name for name in gloss if gloss[name] > 0] == ["glossy"]


def test_light_is_thrown_back_in_one_direction():
    posed = Posed(World("glossy"), 0.0)
    origins, directions = camera_rays(random_cameras(1, 60, stream(0, 2))[0])
    hits = posed.first_hits(np.asarray(origins), directions)
    matte, seen = posed.color(hits, light_points(6)), posed.color(hits, light_points(6), directions)
    assert (seen >= matte - 1e-12).all()
    assert (seen - matte).max() > 0.2
    assert np.median(seen - matte) < 0.1


def test_the_room_fills_every_picture():
    specimen = SPECIMENS["room"]
    for camera in random_cameras(6, 24, stream(0, 3), specimen.azimuth, specimen.rise):
        rgba, depth = render(World("room"), 0.5, camera, 1, 1)
        assert (rgba[..., 3] == 255).all()
        assert (depth > 0).all()
