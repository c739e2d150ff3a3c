"""How a voxel method is made for a stage, and what it cannot be made from, by the name of the key."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp.fields.curves import TrajectoryField
from forewarp.methods.method import Start
from forewarp.methods.voxel.effects import LearnedUpsampler, Motion, TrilinearUpsampler, UNet3d
from forewarp.methods.voxel.losses import voxel_terms
from forewarp.methods.voxel.structure import EFFECTS, VoxelStage
from forewarp.scene.box import Lattice
from forewarp.scene.cloud import Handover
from forewarp.training.handover import make_handover
from tests.support.tiny_scene import (
    BOX,
    EVERYTHING,
    FEATURES,
    INPAINTER,
    RADIANCE,
    RADIUS,
    backward_model,
    ball_center,
    ball_method,
    ball_scene,
    built,
    forward_model,
)

LATTICE = Lattice(BOX, (5, 4, 6))


def build(model, effects=EFFECTS, **numbers):
    return built(model, LATTICE, effects=effects, **numbers)


FULL = forward_model(**EVERYTHING, trajectory=partial(TrajectoryField, bases=3, nodes=8, features=2))


@pytest.mark.parametrize("effect", EFFECTS)
def test_a_stage_uses_the_effects_that_it_names(effect):
    method = build(FULL, [effect])
    on = {name for name in EFFECTS if getattr(method, name) is not None}
    assert on == {effect}


def test_a_stage_may_interpolate_instead():
    method = build(FULL, ["motion"], upsample=1.5)
    assert type(method.upsampler) is TrilinearUpsampler
    assert method.upsampler.scale == 1.5


SCENE = ball_scene(frames=6, size=16)


def fresh(model=None, scene=SCENE, frames=range(6), **numbers):
    """The method of a first stage."""
    return (model or forward_model())(
        Start(scene, "coarse", {"num_voxels": [[0, 1500]]} | numbers, list(frames))
    )


def carried(before, handover, model=None, name="coarse", **numbers):
    """The method of a stage after another."""
    numbers = {"num_voxels": [[0, 1500]]} | numbers
    return (model or forward_model())(Start(SCENE, name, numbers, range(6), handover, before))


def left(method):
    """What a stage of this method leaves where all of the box is full."""
    return Handover(BOX, True, 6, notes=method.notes())


@pytest.mark.parametrize("radiance", [RADIANCE, FEATURES], ids=["voxels", "network"])
def test_a_fresh_method_starts_faint_everywhere(radiance):
    method = fresh(forward_model(radiance=radiance), start_alpha=0.03)
    lattice, grid = method.radiance.lattice, method.radiance()
    assert method.notes() == {"density_scale": lattice.voxel_size}
    alpha = grid.activation.alpha(grid.raw_density, lattice.voxel_size)
    torch.testing.assert_close(alpha, torch.full((lattice.count,), 0.03), rtol=1e-3, atol=0)


def test_the_hull_is_where_matter_may_be():
    method = fresh(start="hull", hull_frames=2, hull_grow=0.1)
    points = method.radiance.lattice.to_world(method.radiance.voxels)
    everywhere = method.radiance.lattice.to_world(method.radiance.lattice.all_voxels())
    ball_now = (everywhere - ball_center(0.0)).norm(dim=-1) < 0.8 * RADIUS
    assert (method.radiance.index.flatten()[ball_now] >= 0).all()
    assert len(points) < 0.5 * len(everywhere)


def test_left_to_itself_it_starts_in_the_hull_where_there_is_alpha_and_in_the_box_elsewhere():
    for scene, start in ((SCENE, "hull"), (replace(SCENE, has_alpha=False), "box")):
        ours, expected = (fresh(scene=scene, frames=[0, 1], start=s, hull_frames=2) for s in ("auto", start))
        assert torch.equal(ours.radiance.voxels, expected.radiance.voxels)


def test_the_hull_of_a_moment_is_that_of_all_its_views():
    frames = [replace(frame, time=0.0) for frame in SCENE.train[:3]]
    scene = replace(SCENE, train=(*frames, *SCENE.train[3:]))
    one, three = (fresh(scene=scene, frames=range(4), start="hull", hull_frames=n) for n in (1, 3))
    assert torch.equal(one.radiance.voxels, three.radiance.voxels)


def test_what_only_waits_for_a_checkpoint_looks_at_no_picture():
    def refuse():
        raise AssertionError("a picture was loaded")

    scene = replace(SCENE, train=tuple(replace(frame, load=refuse) for frame in SCENE.train))
    blank = Start(
        scene, "fine", {"num_voxels": [[0, 1500]], "start": "hull"}, range(6), before=None, blank=True
    )
    method = forward_model()(blank)
    assert len(method.radiance.voxels) == method.radiance.lattice.count
    with pytest.raises(AssertionError, match="a picture was loaded"):
        fresh(scene=scene, start="hull")


def test_carrying_keeps_matter_motion_and_unit():
    before = ball_method(SCENE)
    unit, path = before.radiance.activation.density_scale, before.motion.trajectory.state_dict()
    handover = make_handover(before, SCENE, None, 6)
    sigma, at = before.radiance().density, before.radiance.lattice.to_lattice
    points = ball_center(0.0) + 0.2 * (torch.rand(50, 3) - 0.5)
    expected = sigma(at(points)).detach()
    after = carried(before, handover, name="fine", num_voxels=[[0, 4000]])
    assert after.radiance.lattice.box == handover.box
    assert after.radiance.activation.density_scale == unit
    assert after.radiance.lattice.count == pytest.approx(4000, rel=0.2)
    torch.testing.assert_close(after.radiance().density(after.radiance.lattice.to_lattice(points)), expected)
    for name, value in after.motion.trajectory.state_dict().items():
        assert torch.equal(value, path[name])


def test_carrying_into_a_stage_with_more_effects():
    before = fresh(forward_model(view_dependence=None))
    before.radiance.density.data[:] = 3.0
    before.radiance.color.data[:] = 0.5
    after = carried(before, left(before))
    assert (after.radiance.shading == 0).all()
    torch.testing.assert_close(after.radiance.color.data, torch.full_like(after.radiance.color, 0.5))


def test_carrying_a_network():
    model = forward_model(radiance=FEATURES)
    before = fresh(model)
    torch.nn.init.normal_(before.radiance.network[-1].weight)
    after = carried(before, left(before), model)
    for ours, theirs in zip(after.radiance.network.parameters(), before.radiance.network.parameters()):
        assert torch.equal(ours, theirs)


def test_where_nothing_is_carried_the_box_and_the_unit_are_kept():
    before = ball_method(SCENE)
    handover = make_handover(before, SCENE, None, 6)
    after = carried(before, handover, carry=False)
    assert after.radiance.lattice.box == handover.box
    assert after.radiance.activation.density_scale == before.radiance.activation.density_scale
    assert (after.radiance.density == after.radiance.density[0]).all()


def test_after_a_stage_of_another_method_only_its_box_is_used():
    box = BOX.scaled(0.5)
    after = carried(torch.nn.Linear(1, 1), Handover(box, True, 6, notes={"particles": 3.0}))
    assert after.radiance.lattice.box == box
    assert after.radiance.activation.density_scale == after.radiance.lattice.voxel_size
    assert (after.radiance.density == after.radiance.density[0]).all()


OPAQUE = replace(ball_scene(frames=2, size=8), has_alpha=False)
PATHS = partial(TrajectoryField, BOX, bases=2, frames=5, canonical_time=0.0, nodes=8)
ODD = forward_model(upsampler=partial(TrilinearUpsampler, scale=1.5), inpainter=INPAINTER)
OPACITIES, OPACITY = (
    "stage.coarse: expected 0 < birth_alpha < keep_alpha < 1",
    r"expected a number in \(0, 1\), but",
)


def made(model):
    """Make the method of a first stage."""
    return model(Start(OPAQUE, "coarse", {"num_voxels": [[0, 100]]}, [0]))


GHOST = "model.{0}: expected a factory or null, but got .*choose model/{0}=none"
STAGES = [
    ({"num_voxels": []}, r"stage.coarse.num_voxels: expected \[\[fraction, count\], ...\] .* but got \[\]"),
    ({"num_voxels": [[0.5, 100], [0, 100]]}, "stage.coarse.num_voxels: expected .* ascending fractions"),
    ({"num_voxels": 100}, "stage.coarse.num_voxels: expected .* but got 100"),
    ({"num_voxels": [[2, 100]]}, "stage.coarse.num_voxels: expected"),
    ({"num_voxels": [[0, 0]]}, "stage.coarse.num_voxels: expected"),
    ({"bases": [[0, 1, 2]]}, "stage.coarse.bases: expected"),
    ({"effects": ["motion", "shine"]}, "stage.coarse.effects: expected some of .* got .*shine"),
    ({"start": "points"}, "stage.coarse.start: expected auto, box or hull, but got 'points'"),
    ({"confine": 1.5}, r"stage.coarse.confine: expected a fraction in \[0, 1\], but got 1.5"),
    ({"start_alpha": 1.0}, f"stage.coarse.start_alpha: {OPACITY}"),
    ({"box_alpha": 0.0}, f"stage.coarse.box_alpha: {OPACITY}"),
    *((wrong, OPACITIES) for wrong in ({"birth_alpha": 1e-2}, {"birth_alpha": 0.0}, {"keep_alpha": 1.0})),
]
REFUSED = [
    *(
        (partial(VoxelStage, **({"name": "coarse", "num_voxels": [[0, 8000]]} | wrong)), text)
        for wrong, text in STAGES
    ),
    *(
        (lambda name=name: made(forward_model(**{name: {"width": 3}})), GHOST.format(name))
        for name in ("inpainter", "background")
    ),
    *(
        (
            lambda wrong=wrong: made(backward_model(deformation=wrong)),
            "model.deformation: expected a factory, but got",
        )
        for wrong in (None, {"width": 3})
    ),
    (
        lambda: made(forward_model(trajectory=None)),
        "model.trajectory: expected a factory, but got null; choose another model/motion",
    ),
    *(
        (
            lambda wrong=wrong: Motion(PATHS(), **wrong),
            "model.motion: expected 0 < tau <= 1, 0 <= fade <= 1 and",
        )
        for wrong in ({"tau": 0.0}, {"tau": 2.0}, {"fade": -0.1}, {"fade": 1.5}, {"rest": 0.5})
    ),
    *(
        (
            partial(UNet3d, channels=4, **wrong),
            "model.inpainter: expected a width that is a multiple of 16 and",
        )
        for wrong in ({"width": 12}, {"levels": 1})
    ),
    *(
        (partial(TrilinearUpsampler, scale=scale), "model.upsampler.scale: expected a number > 1, but got")
        for scale in (1, 0.5, float("nan"))
    ),
    (partial(LearnedUpsampler, scale=1.5, channels=4), "expects a whole number, but got 1.5"),
    (
        lambda: built(ODD, Lattice(BOX, (7, 6, 5))),
        "model.upsampler.scale: expected a whole number beside an inpainter, but got 1.5",
    ),
    (
        lambda: forward_model()(Start(OPAQUE, "coarse", {"num_voxels": [[0, 100]], "start": "hull"}, [0])),
        "stage.coarse.start: expected box, since the images of 'ball' have no alpha",
    ),
    (partial(voxel_terms, ["ssim"]), r"objective.literal: .* but got \['ssim'\]"),
]


@pytest.mark.parametrize(("call", "text"), REFUSED)
def test_refuses_by_the_name_of_the_key(call, text):
    with pytest.raises(ValueError, match=text):
        call()
