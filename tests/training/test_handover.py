import json
from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp.fields.radiance import FeatureRadiance
from forewarp.scene.box import Box
from forewarp.training.handover import (
    Handover,
    carried_method,
    fresh_method,
    load_handover,
    make_handover,
    save_handover,
    write_json,
)
from forewarp.training.settings import StageSettings
from tiny_scene import BOX, RADIUS, RATES, ball_center, ball_scene, forward_model

SCENE = ball_scene(frames=6, size=16)


def settings(**changes):
    return StageSettings(
        **({"name": "coarse", "voxels": [[0, 1500]], "rates": RATES, "iterations": 5} | changes)
    )


def fresh(spec=None, **changes):
    return fresh_method(spec or forward_model(), settings(**changes), SCENE, BOX, None, list(range(6)))


def ball(raw=8.0):
    """A method whose canonical grid is the ball, with some motion."""
    torch.manual_seed(0)
    method, unit = fresh()
    points = method.radiance.lattice.to_world(method.radiance.voxels)
    inside = (points - ball_center(0.0)).norm(dim=-1) < RADIUS
    method.radiance.density.data = torch.where(inside, raw, -9.0)[:, None]
    torch.nn.init.normal_(method.radiance.color)
    torch.nn.init.normal_(method.motion.trajectory.network[-1].weight, std=1e-3)
    return method, unit


def test_round_trip(tmp_path):
    handover = Handover((-1.0, 0.25, 1 / 3), (1.0, 2.0, 3.0), 0.1, True, 17)
    save_handover(handover, tmp_path)
    read = load_handover(tmp_path)
    assert read.box == handover.box == Box((-1, 0.25, 1 / 3), (1, 2, 3))
    assert replace(read, low=tuple(read.low), high=tuple(read.high)) == handover


def test_half_a_file_is_never_taken_for_one(tmp_path):
    path = tmp_path / "done.json"
    write_json(path, {"seconds": 1.0})
    with pytest.raises(TypeError):
        write_json(path, {"seconds": object()})
    assert json.loads(path.read_text()) == {"seconds": 1.0}


def test_a_stage_leaves_the_tight_box():
    method, unit = ball()
    handover = make_handover(method, SCENE, unit, 6, alpha=1e-2, pad=2.0)
    assert handover.tight
    assert handover.unit == unit
    assert handover.frames_in_play == 6
    center, margin = ball_center(0.0), RADIUS + 4 * method.radiance.lattice.pitch
    for low, high, middle in zip(handover.low, handover.high, center.tolist()):
        assert middle - margin < low < middle - 0.5 * RADIUS
        assert middle + 0.5 * RADIUS < high < middle + margin


def test_a_stage_that_found_nothing_keeps_its_box_and_says_so():
    method, unit = ball(raw=-9.0)
    handover = make_handover(method, SCENE, unit, 6, alpha=1e-2)
    assert not handover.tight
    assert handover.box == method.radiance.lattice.box


def test_a_fresh_method_starts_faint_everywhere():
    method, unit = fresh(start_alpha=0.03)
    lattice = method.radiance.lattice
    assert unit == lattice.pitch
    grid = method.radiance()
    alpha = grid.activation.alpha(grid.raw_density, lattice.pitch)
    torch.testing.assert_close(alpha, torch.full((lattice.count,), 0.03), rtol=1e-3, atol=0)


def test_a_network_starts_faint_as_well():
    radiance = partial(FeatureRadiance, alpha_init=1e-2, skip_alpha=0.0, width=4)
    method, _ = fresh(forward_model(radiance=radiance), start_alpha=0.03)
    grid = method.radiance()
    alpha = grid.activation.alpha(grid.raw_density, grid.lattice.pitch)
    torch.testing.assert_close(alpha, torch.full_like(alpha, 0.03), rtol=1e-3, atol=0)


def test_the_hull_is_where_matter_may_be():
    method, _ = fresh(start="hull", hull_frames=2, hull_grow=0.1)
    points = method.radiance.lattice.to_world(method.radiance.voxels)
    everywhere = method.radiance.lattice.to_world(method.radiance.lattice.all_voxels())
    ball_now = (everywhere - ball_center(0.0)).norm(dim=-1) < 0.8 * RADIUS
    assert (method.radiance.index.flatten()[ball_now] >= 0).all()
    assert len(points) < 0.5 * len(everywhere)


def test_the_hull_needs_alpha():
    scene = replace(SCENE, has_alpha=False)
    with pytest.raises(
        ValueError, match="stage.coarse.start: expected box, since the images of 'ball' have no alpha"
    ):
        fresh_method(forward_model(), settings(start="hull"), scene, BOX, None, [0])


def test_left_to_itself_it_starts_in_the_hull_where_there_is_alpha_and_in_the_box_elsewhere():
    for scene, start in ((SCENE, "hull"), (replace(SCENE, has_alpha=False), "box")):
        ours, expected = (
            fresh_method(forward_model(), settings(start=s, hull_frames=2), scene, BOX, None, [0, 1])[0]
            for s in ("auto", start)
        )
        assert torch.equal(ours.radiance.voxels, expected.radiance.voxels)


def test_the_hull_of_a_moment_is_that_of_all_its_views():
    frames = [replace(frame, time=0.0) for frame in SCENE.train[:3]]
    scene = replace(SCENE, train=(*frames, *SCENE.train[3:]))
    one, three = (
        fresh_method(forward_model(), settings(start="hull", hull_frames=n), scene, BOX, None, [0, 1, 2, 3])[
            0
        ]
        for n in (1, 3)
    )
    assert torch.equal(one.radiance.voxels, three.radiance.voxels)


def test_carrying_keeps_matter_motion_and_unit():
    before, unit = ball()
    path = before.motion.trajectory.state_dict()
    handover = make_handover(before, SCENE, unit, 6, alpha=1e-2)
    sigma, at = before.radiance().density, before.radiance.lattice.to_lattice
    points = ball_center(0.0) + 0.2 * (torch.rand(50, 3) - 0.5)
    expected = sigma(at(points)).detach()
    after = carried_method(
        forward_model(), settings(name="fine", voxels=[[0, 4000]]), SCENE, before, handover
    )
    assert after.radiance.lattice.box == handover.box
    assert after.radiance.activation.unit == unit
    assert after.radiance.lattice.count == pytest.approx(4000, rel=0.2)
    torch.testing.assert_close(after.radiance().density(after.radiance.lattice.to_lattice(points)), expected)
    for name, value in after.motion.trajectory.state_dict().items():
        assert torch.equal(value, path[name])


def test_carrying_into_a_stage_with_more_effects():
    plain = forward_model(view=None)
    before, unit = fresh(plain)
    before.radiance.density.data[:] = 3.0
    before.radiance.color.data[:] = 0.5
    handover = Handover(BOX.low, BOX.high, unit, True, 6)
    after = carried_method(forward_model(), settings(), SCENE, before, handover)
    assert (after.radiance.shading == 0).all()
    torch.testing.assert_close(after.radiance.color.data, torch.full_like(after.radiance.color, 0.5))


def test_carrying_a_network():
    spec = forward_model(radiance=partial(FeatureRadiance, alpha_init=1e-2, skip_alpha=0.0, width=4))
    before, unit = fresh(spec)
    torch.nn.init.normal_(before.radiance.network[-1].weight)
    handover = Handover(BOX.low, BOX.high, unit, True, 6)
    after = carried_method(spec, settings(), SCENE, before, handover)
    for ours, theirs in zip(after.radiance.network.parameters(), before.radiance.network.parameters()):
        assert torch.equal(ours, theirs)
