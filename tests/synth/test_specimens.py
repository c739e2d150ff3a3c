"""Each specimen is what it is said to call for: measured on its meshes and its pictures."""

import numpy as np
import pytest
import yaml

from forewarp.synth.raycast import Posed, camera_rays, light_points, render, surface_points
from forewarp.synth.scenes import centers_of, random_cameras, stream
from forewarp.synth.vehicle import GROUND
from forewarp.synth.world import _STAY, SPECIMENS, World
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


@pytest.mark.parametrize("name", ["rigid", "quick", "room", "spin"])
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


def test_the_wings_turn_by_a_sixth_of_a_turn_and_stay_where_they_are():
    (start, end) = (SPECIMENS["spin"].joints(time)["wings"] for time in (0.0, 1.0))
    assert np.degrees(np.arccos(end[0, 0])) == pytest.approx(60.0)
    np.testing.assert_allclose(start, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(end[:, 2:], np.eye(4)[:, 2:], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "rests"), [("rigid", True), ("quick", True), ("band", True), ("spin", False)]
)
def test_something_rests_where_the_background_is_called_for(name, rests):
    own = yaml.safe_load((CONF / "model_scene" / f"particles_specimen_{name}.yaml").read_text())["calls_for"]
    assert ("background" in own) is rests
    stays = np.ptp(paths(name), axis=0).max(-1) == 0
    assert (stays.mean() > 0.05) if rests else not stays.any()


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


def test_by_daylight_shades_change_and_nothing_else():
    camera = random_cameras(1, 40, stream(0, 2))[0]
    (first, near), (last, far) = (render(World("daylight"), time, camera, 1) for time in (0.0, 0.7))
    np.testing.assert_array_equal(near, far)
    np.testing.assert_array_equal(first[..., 3], last[..., 3])
    seen = first[..., 3] > 0
    assert np.abs(first[seen].astype(int) - last[seen])[:, :3].max(-1).mean() > 10


def test_the_light_of_a_day_stands_on_one_side_of_the_globe_and_then_on_the_other():
    world = World("daylight")
    for time, side in ((0.0, -1), (1.0, 1)):
        posed = Posed(world, time)
        start = np.array([[3.0 * s, 0.0, GROUND + 0.7] for s in (-1, 1)])
        hits = posed.first_hits(start, np.array([[1.0, 0, 0], [-1.0, 0, 0]]))
        shade = posed.color(hits, light_points(24, posed.light)) / posed._albedo(hits)
        bright, dark = (shade[0], shade[1]) if side < 0 else (shade[1], shade[0])
        assert (bright > dark + 0.1).all()


@pytest.mark.parametrize("time", [0.0, 0.4, 0.5, 0.65, 1.0])
def test_blocks_are_where_they_are_and_nowhere_else(time):
    there = {n: begin <= time <= end for n, (begin, end) in _STAY.items()}
    posed = Posed(World("blocks"), time)
    above = np.array([[0, 0.45, 2.0], [-0.45, 0, 2.0], [0, -0.45, 2.0], [0.45, 0, 2.0]])
    hits = posed.first_hits(above, np.tile([0.0, 0, -1], (4, 1)))
    named = [posed.world.parts[posed.world.part_of_face[face]].name for face in hits.face]
    assert named == [n if there[n] else "plate" for n in ("north", "west", "south", "east")]
    beside, along = np.array([[-0.6, 0.45, GROUND + 0.2]]), np.array([[1.0, 0, 0]])
    assert bool(posed.is_free(beside, along)[0]) is not there["north"]


def test_points_are_drawn_on_what_is_there_at_first():
    world = World("blocks")
    centers = centers_of(random_cameras(6, 8, stream(0, 1)))
    faces, _ = surface_points(world, 300, centers, stream(0, 2))
    named = {world.parts[part].name for part in np.unique(world.part_of_face[faces])}
    assert named == {"plate", "pillar", "north", "west"}


def test_the_room_fills_every_picture():
    specimen = SPECIMENS["room"]
    for camera in random_cameras(6, 24, stream(0, 3), specimen.azimuth, specimen.rise):
        rgba, depth = render(World("room"), 0.5, camera, 1, 1)
        assert (rgba[..., 3] == 255).all()
        assert (depth > 0).all()
