"""How a voxel method is made for a stage, what it cannot be made from, and its loss terms."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp import losses
from forewarp.fields.curves import TrajectoryField
from forewarp.methods.method import Start
from forewarp.methods.voxel.effects import LearnedUpsampler, Motion, TrilinearUpsampler, UNet3d
from forewarp.methods.voxel.model import VoxelMethod, VoxelSnapshot
from forewarp.methods.voxel.structure import NAMES
from forewarp.ops.grid import neighbour_pairs
from forewarp.renderer import Marched
from forewarp.scene.box import Lattice
from forewarp.scene.cloud import Cloud, Handover
from forewarp.scene.view import Moment
from forewarp.training.checkpoints import make_handover
from tests.support import tiny_scene as tiny

LATTICE = Lattice(tiny.BOX, (5, 4, 6))
TRAJECTORY = partial(TrajectoryField, bases=3, nodes=8, features=2)
FULL = tiny.forward_model(**tiny.EVERYTHING, trajectory=TRAJECTORY)


@pytest.mark.parametrize("effect", NAMES)
def test_a_stage_uses_the_effects_that_it_names(effect):
    method = tiny.built(FULL, LATTICE, effects=[effect])
    assert {name for name in NAMES if getattr(method, name) is not None} == {effect}


def test_a_stage_may_interpolate_instead():
    upsampler = tiny.built(FULL, LATTICE, effects=["motion"], upsample=1.5).upsampler
    assert (type(upsampler), upsampler.scale) == (TrilinearUpsampler, 1.5)


SCENE = tiny.ball_scene(frames=6, size=16)


def fresh(model=None, scene=SCENE, frames=range(6), **numbers):
    """The method of a first stage."""
    numbers = {"num_voxels": [[0, 1500]]} | numbers
    return (model or tiny.forward_model())(Start(scene, "coarse", numbers, list(frames)))


def carried(before, handover, model=None, **numbers):
    """The method of a stage after another."""
    numbers = {"num_voxels": [[0, 1500]]} | numbers
    return (model or tiny.forward_model())(Start(SCENE, "fine", numbers, range(6), handover, before))


def left(method):
    """What a stage of this method leaves where all of the box is full."""
    return Handover(tiny.BOX, True, 6, notes=method.notes())


@pytest.mark.parametrize("radiance", [tiny.RADIANCE, tiny.FEATURES], ids=["voxels", "network"])
def test_a_fresh_method_starts_faint_everywhere(radiance):
    method = fresh(tiny.forward_model(radiance=radiance), start_alpha=0.03)
    lattice, grid = method.radiance.lattice, method.radiance()
    assert method.notes() == {"density_scale": lattice.voxel_size}
    alpha = grid.activation.alpha(grid.raw_density, lattice.voxel_size)
    torch.testing.assert_close(alpha, torch.full((lattice.count,), 0.03), rtol=1e-3, atol=0)


def test_the_hull_is_where_matter_may_be():
    radiance = fresh(start="hull", hull_frames=2, hull_grow=0.1).radiance
    everywhere = radiance.lattice.to_world(radiance.lattice.all_voxels())
    ball_now = (everywhere - tiny.ball_center(0.0)).norm(dim=-1) < 0.8 * tiny.RADIUS
    assert (radiance.index.flatten()[ball_now] >= 0).all()
    assert len(radiance.voxels) < 0.5 * len(everywhere)


def test_left_to_itself_it_starts_in_the_hull_where_there_is_alpha_and_in_the_box_elsewhere():
    for scene, start in ((SCENE, "hull"), (replace(SCENE, has_alpha=False), "box")):
        ours, expected = (fresh(scene=scene, frames=[0, 1], start=s, hull_frames=2) for s in ("auto", start))
        assert torch.equal(ours.radiance.voxels, expected.radiance.voxels)


def test_the_hull_of_a_moment_is_that_of_all_its_views():
    frames = [replace(frame, time=0.0) for frame in SCENE.train[:3]]
    scene = replace(SCENE, train=(*frames, *SCENE.train[3:]))
    first, all_three = (fresh(scene=scene, frames=range(4), start="hull", hull_frames=n) for n in (1, 3))
    assert torch.equal(first.radiance.voxels, all_three.radiance.voxels)


def test_what_only_waits_for_a_checkpoint_looks_at_no_picture():
    def refuse():
        raise AssertionError("a picture was loaded")

    scene = replace(SCENE, train=tuple(replace(frame, load=refuse) for frame in SCENE.train))
    numbers = {"num_voxels": [[0, 1500]], "start": "hull"}
    radiance = tiny.forward_model()(Start(scene, "fine", numbers, range(6), blank=True)).radiance
    assert len(radiance.voxels) == radiance.lattice.count
    with pytest.raises(AssertionError, match="a picture was loaded"):
        fresh(scene=scene, start="hull")


def test_carrying_keeps_matter_motion_and_unit():
    before = tiny.ball_method(SCENE)
    unit, path = before.radiance.activation.density_scale, before.motion.trajectory.state_dict()
    handover = make_handover(before, SCENE, None, 6)
    sigma, at = before.radiance().density, before.radiance.lattice.to_lattice
    points = tiny.ball_center(0.0) + 0.2 * (torch.rand(50, 3) - 0.5)
    expected = sigma(at(points)).detach()
    after = carried(before, handover, num_voxels=[[0, 4000]])
    lattice = after.radiance.lattice
    assert (lattice.box, after.radiance.activation.density_scale) == (handover.box, unit)
    assert lattice.count == pytest.approx(4000, rel=0.2)
    torch.testing.assert_close(after.radiance().density(lattice.to_lattice(points)), expected)
    for name, value in after.motion.trajectory.state_dict().items():
        assert torch.equal(value, path[name])


NODES = partial(TrajectoryField, bases=4, nodes=16, kind="nodes")
F2 = partial(TrajectoryField, bases=4, nodes=8, width=32, layers=3)


@pytest.mark.parametrize(
    ("trajectory", "carry"), [(NODES, "motion"), (NODES, "all"), (F2, "motion"), (NODES, "none")]
)
def test_motion_is_carried_with_matter_or_without(trajectory, carry):
    model = tiny.forward_model(trajectory=trajectory)
    before, times = fresh(model), torch.tensor([0.4, 1.0])
    last = list(before.motion.trajectory.parameters())[-1]
    torch.nn.init.normal_(last, std=0.01)
    before.radiance.density.data.normal_()
    points = 0.5 * torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) - 0.25
    went = before.trajectories(points, times).detach() - points[:, None]
    after = carried(before, left(before), model, num_voxels=[[0, 3000]], carry=carry)
    goes = after.trajectories(points, times).detach() - points[:, None]
    alike = (goes - went).norm() / went.norm()
    assert alike == 1.0 if carry == "none" else alike < (1e-5 if trajectory is not NODES else 0.5)
    assert (len(after.radiance.density.unique()) > 1) == (carry == "all")


def test_learned_nodes_begin_with_the_motion_of_another_method():
    class Turning(torch.nn.Module):
        moves = True

        def trajectories(self, points, times):
            return points[:, None] + times[:, None] * points[:, None] @ torch.eye(3).roll(1, 0) * 0.1

    model, times = tiny.forward_model(trajectory=NODES), torch.tensor([0.25, 0.8])
    after = carried(Turning(), Handover(tiny.BOX, True, 6), model)
    points = 0.5 * torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) - 0.25
    first = Turning().trajectories(points, torch.tensor([SCENE.canonical_time]))
    expected = points[:, None] + Turning().trajectories(points, times) - first
    torch.testing.assert_close(after.trajectories(points, times), expected, atol=5e-3, rtol=0)
    told = "motion begins as that of another method (carry)"
    cloud = Cloud(points, points, torch.ones(50), 0.1)
    handover = Handover(tiny.BOX, True, 6, cloud, times, Turning().trajectories(points, times))
    blank = Start(SCENE, "fine", {"num_voxels": [[0, 1500]]}, range(6), handover, blank=True)
    assert told in model(blank).departures()
    assert told not in fresh(model).departures()
    f2 = tiny.forward_model()
    still = carried(Turning(), Handover(tiny.BOX, True, 6), f2).trajectories(points, times)
    assert torch.equal(still[:, 0], still[:, 1])
    with pytest.raises(ValueError, match=r"^stage.fine.carry: expected all or none, as the network F2"):
        carried(Turning(), Handover(tiny.BOX, True, 6), f2, carry="motion")


@pytest.mark.parametrize("carry", ["all", "motion"])
@pytest.mark.parametrize("nodes", [0, 8])
def test_deformation_features_lie_at_nodes_or_voxels_and_are_carried_to_others(nodes, carry):
    model = tiny.forward_model(trajectory=partial(TrajectoryField, bases=3, nodes=nodes, features=2))
    before = fresh(model)
    torch.nn.init.normal_(before.motion.trajectory.network[-1].weight)
    features = before.motion.trajectory.features
    assert features.lattice == (before.motion.trajectory.lattice if nodes else before.radiance.lattice)
    assert any(features.grid is parameter for parameter in before.param_groups()["grid"])
    points = 0.5 * torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) - 0.25
    features.grid.data = features.lattice.to_world(features.voxels) @ torch.rand(3, 2)  # linear in the place
    times = torch.tensor([0.4, 1.0])
    expected = before.trajectories(points, times).detach()
    after = carried(before, left(before), model, num_voxels=[[0, 3000]], carry=carry)
    lattice = after.motion.trajectory.features.lattice
    assert lattice == (after.motion.trajectory.lattice if nodes else after.radiance.lattice)
    torch.testing.assert_close(after.trajectories(points, times), expected)


def test_carrying_into_a_stage_with_more_effects():
    before = fresh(tiny.forward_model(view_dependence=None))
    before.radiance.color.data[:] = 0.5
    after = carried(before, left(before))
    assert (after.radiance.shading == 0).all()
    torch.testing.assert_close(after.radiance.color.data, torch.full_like(after.radiance.color, 0.5))


def test_a_background_that_only_the_second_stage_has_starts_faint():
    model = tiny.forward_model(background=tiny.EVERYTHING["background"])
    before = fresh(model, effects=["motion"])
    assert before.background is None
    after = carried(before, left(before), model, start_alpha=0.2)
    grid = after.background()
    alpha = grid.activation.alpha(grid.raw_density, grid.lattice.voxel_size)
    torch.testing.assert_close(alpha, torch.full_like(alpha, 0.2))


def test_carrying_a_network():
    model = tiny.forward_model(radiance=tiny.FEATURES)
    before = fresh(model)
    torch.nn.init.normal_(before.radiance.network[-1].weight)
    networks = (made.radiance.network.parameters() for made in (carried(before, left(before), model), before))
    assert all(map(torch.equal, *networks))


def test_where_nothing_is_carried_the_box_and_the_unit_are_kept():
    before = tiny.ball_method(SCENE)
    handover = make_handover(before, SCENE, None, 6)
    radiance = carried(before, handover, carry=False).radiance
    assert radiance.lattice.box == handover.box
    assert radiance.activation.density_scale == before.radiance.activation.density_scale
    assert (radiance.density == radiance.density[0]).all()


def test_after_a_stage_of_another_method_only_its_box_is_used():
    box = tiny.BOX.scaled(0.5)
    radiance = carried(torch.nn.Linear(1, 1), Handover(box, True, 6, notes={"particles": 3.0})).radiance
    assert radiance.lattice.box == box
    assert radiance.activation.density_scale == radiance.lattice.voxel_size
    assert (radiance.density == radiance.density[0]).all()


OPAQUE = replace(tiny.ball_scene(frames=2, size=8), has_alpha=False)
PATHS = partial(TrajectoryField, tiny.BOX, bases=2, frames=5, canonical_time=0.0, nodes=8)
ODD = tiny.forward_model(upsampler=partial(TrilinearUpsampler, scale=1.5), inpainter=tiny.INPAINTER)


def refusing(model=None, **numbers):
    """A call that makes the method of a first stage over opaque images."""
    start = Start(OPAQUE, "coarse", {"num_voxels": [[0, 100]]} | numbers, [0])
    return partial(model or tiny.forward_model(), start)


SCHEDULE = r"stage.coarse.num_voxels: expected \[\[fraction, count\], ...\] .* but got"
SPREADING = "stage.coarse: expected 0 < birth_alpha < keep_alpha < 1"
SPLAT = "model.motion.{}: expected a .* in "
GHOST = "model.{0}: expected a factory or null, but got .*choose model/{0}=none"
STAGES = [
    *(({"num_voxels": given}, SCHEDULE) for given in ([], [[0.5, 100], [0, 100]], 100, [[2, 9]], [[0, 0]])),
    ({"bases": [[0, 1, 2]]}, "stage.coarse.bases: expected"),
    ({"effects": ["motion", "shine"]}, "stage.coarse.effects: expected some of .* got .*shine"),
    ({"start": "points"}, "stage.coarse.start: expected auto, box, hull or matter, but got 'points'"),
    (
        {"start": "matter"},
        "stage.coarse.start: expected auto, box or hull, as no stage before it left matter",
    ),
    ({"carry": "box"}, "stage.coarse.carry: expected all, motion or none, but got 'box'"),
    ({"near_share": 1.0}, r"stage.coarse.near_share: expected a number in \[0, 1\), but got 1.0"),
    ({"confine": 1.5}, r"stage.coarse.confine: expected a fraction in \[0, 1\], but got 1.5"),
    ({"start_alpha": 1.0}, r"stage.coarse.start_alpha: expected a number in \(0, 1\), but"),
    ({"box_alpha": 0.0}, r"stage.coarse.box_alpha: expected a number in \(0, 1\), but"),
    *((wrong, SPREADING) for wrong in ({"birth_alpha": 1e-2}, {"birth_alpha": 0.0}, {"keep_alpha": 1.0})),
]
GHOSTLY, FACTORY = {"width": 3}, "model.deformation: expected a factory, but got"
TRAJECTORIES = "model.trajectory: .* got None; choose another model/motion"
SPLATS = ({"tau": 0.0}, {"tau": 2.0}, {"fade": -0.1}, {"fade": 1.5}, {"rest": 0.5})
REFUSED = [
    *((refusing(**wrong), text) for wrong, text in STAGES),
    *((refusing(tiny.forward_model(**{n: GHOSTLY})), GHOST.format(n)) for n in ("inpainter", "background")),
    *((refusing(tiny.backward_model(deformation=wrong)), FACTORY) for wrong in (None, GHOSTLY)),
    (refusing(tiny.forward_model(trajectory=None)), TRAJECTORIES),
    *((lambda given=given: Motion(PATHS(), **given), SPLAT.format(*given)) for given in SPLATS),
    (partial(UNet3d, channels=4, width=12), "model.inpainter.width: expected a multiple of 16, but got 12"),
    (
        partial(UNet3d, channels=4, levels=1),
        "model.inpainter.levels: expected a whole number >= 2, but got",
    ),
    *((partial(TrilinearUpsampler, scale=s), "scale: expected a number > 1, but got") for s in (1, math.nan)),
    (partial(LearnedUpsampler, scale=1.5, channels=4), "whole number for the learned layer, but got 1.5"),
    (refusing(ODD), "model.upsampler.scale: expected a whole number beside an inpainter, but got 1.5"),
    (refusing(start="hull"), "stage.coarse.start: expected box, since the images of 'ball' have no alpha"),
]


@pytest.mark.parametrize(("call", "text"), REFUSED)
def test_refuses_by_the_name_of_the_key(call, text):
    with pytest.raises(ValueError, match=text):
        call()


PATCHES = torch.rand(2, 4, 4, generator=torch.Generator().manual_seed(3)), torch.ones(2, 4, 4)
STRAY = torch.randn(7, 3, generator=torch.Generator().manual_seed(3))
TRUTH = torch.rand(4, 3, generator=torch.Generator().manual_seed(9))


def drawn(seed):
    """A rendering of four rays that has three samples with a colour, of seven in all."""
    draw = partial(torch.rand, generator=torch.Generator().manual_seed(seed))
    parts = draw(4, 3), draw(4), draw(4), draw(4), draw(3), draw(3, 3)
    return Marched(*parts, torch.tensor([0, 0, 3]), 3, draw(7), torch.tensor([0, 0, 0, 0, 1, 3, 3]))


def terms_of(renderings, literal=(), **on):
    """The snapshot that terms are computed from, and their values, but for those of what is not on."""
    method = fresh(num_voxels=[[0, 64]])
    torch.nn.init.normal_(method.radiance.density)
    method.printed, method._patches_of = frozenset(literal), lambda *_: PATCHES
    method._stray = lambda *_: STRAY if on else None
    canonical = method.radiance()
    state = VoxelSnapshot(
        Moment(0.5), {}, canonical, method.renderer, length=0.5, **{k: v(canonical) for k, v in on.items()}
    )
    terms = method.terms_of(state, renderings, TRUTH, torch.Generator())
    assert tuple(terms) == VoxelMethod.terms
    values = {name: term() for name, term in terms.items()}
    return state, {name: value for name, value in values.items() if value is not None}


def test_every_term_is_the_pure_function_of_its_parts():
    both = {"upsampled": drawn(0), "inpainted": drawn(1)}
    state, found = terms_of(
        both,
        flow=lambda grid: grid.values[:, :3].sin(),
        inpaint_difference=lambda grid: grid.values.cos(),
        background=lambda grid: replace(grid, values=grid.values + 1),
    )
    grid, flow = state.canonical, state.flow / 0.5
    pairs = neighbour_pairs(grid.index)
    expected = {
        "photo": sum(losses.photometric(r.rgb, TRUTH) for r in both.values()),
        "point_color": sum(losses.point_color(r.weights, r.colors, r.ray_ids, TRUTH) for r in both.values()),
        "background_entropy": sum(losses.background_entropy(r.transmittance) for r in both.values()),
        "flow_l1": losses.flow_l1(flow),
        "inpaint_diff": losses.inpaint_diff(state.inpaint_difference),
        "tv_density": sum(losses.tv_density(g.raw_density, pairs) for g in (grid, state.background)),
        "tv_flow": losses.tv_flow(flow, pairs),
        "tv_depth": losses.tv_depth(*PATCHES),
        "static_points": losses.static_points(STRAY),
        "moving_opacity": losses.moving_opacity(grid.activation.alpha(grid.raw_density, grid.voxel_size)),
    }
    torch.testing.assert_close(found, expected)


def test_terms_of_effects_that_are_off_are_left_out():
    off = {"flow_l1", "tv_flow", "inpaint_diff", "static_points", "moving_opacity"}
    assert set(terms_of({"warped": drawn(0)})[1]) == set(VoxelMethod.terms) - off


def test_the_printed_forms():
    rendering = drawn(0)
    plain, printed = (terms_of({"warped": rendering}, literal)[1] for literal in ((), VoxelMethod.literal))
    assert printed["photo"].item() == pytest.approx(3 * plain["photo"].item())
    samples = rendering.weights, rendering.colors, rendering.ray_ids
    expected = losses.point_color(*samples, TRUTH, all_ray_ids=rendering.all_ray_ids)
    torch.testing.assert_close(printed["point_color"], expected)
    assert printed["point_color"] < plain["point_color"]
    expected = losses.sample_entropy(rendering.all_weights)
    torch.testing.assert_close(printed["background_entropy"], expected)


@pytest.mark.parametrize(("literal", "needed"), [((), False), (["photo"], False), (["point_color"], True)])
def test_the_weights_of_all_samples_are_kept_only_for_a_printed_form(literal, needed, monkeypatch):
    asked, march = [], VoxelSnapshot.march

    def noted(self, name, rays, background, **options):
        asked.append(options["keep_all_weights"])
        return march(self, name, rays, background, **options)

    monkeypatch.setattr(VoxelSnapshot, "march", noted)
    method = tiny.forward_model()(Start(SCENE, "fine", {"num_voxels": [[0, 64]]}, [0], literal=literal))
    method.look(tiny.ball_data(rays=4, frames=2, size=8).batches.draw(), {}, torch.Generator())
    assert asked == [needed]
