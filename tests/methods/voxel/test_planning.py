"""What motion and errors of a coarse stage say, and decisions from evidence and trials."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp.fields.curves import TrajectoryField
from forewarp.methods.effect import Asked
from forewarp.methods.voxel import planning as decisions
from forewarp.methods.voxel.planning import (
    Movement,
    Residual,
    VoxelEvidence,
    VoxelPlanning,
    explained_by_direction,
    movement_of,
    residual,
)
from forewarp.metrics.gain import Gain
from forewarp.ops.curves import dct_basis
from forewarp.scene.box import Lattice
from forewarp.scene.frame import Survey, survey
from tests.support.fakes import Noted
from tests.support.tiny_scene import BOX, ball_data, ball_scene, built, forward_model, make_run, stage

LATTICE = Lattice(BOX, (12, 9, 8))


def fitted(flow):
    """A method whose flow is given."""
    active = torch.zeros(LATTICE.shape, dtype=torch.bool)
    active[3:8, 3:6, 3:6] = True
    model = forward_model(trajectory=partial(TrajectoryField, bases=8, nodes=8, width=16, layers=2))
    method = built(model, LATTICE, active, density_scale=0.2, frames=20, effects=("motion",))
    with torch.no_grad():
        method.radiance.parameter("density").fill_(8.0)
    method.motion.flow = lambda voxels, time: flow(LATTICE.to_world(voxels.voxels), time)
    return method


def test_a_scene_that_stands_still_isexplained_by_direction_by_its_hull():
    still = ball_scene(times=[0.0] * 12)
    assert survey(still).times == 1
    assert survey(still).disagreement < 0.01
    moving = survey(ball_scene())
    assert (moving.frames, moving.times) == (12, 12)
    assert moving.disagreement > 0.1
    assert 0.7 < moving.cut_out < 1
    assert 90 < moving.spread <= 180


def test_alpha_that_is_nowhere_transparent_says_nothing():
    scene = ball_scene()
    opaque = torch.full((24, 24, 4), 255, dtype=torch.uint8)
    filled = replace(scene, train=tuple(replace(f, load=lambda: opaque) for f in scene.train))
    found = survey(filled)
    assert (found.cut_out, found.disagreement) == (0, 0)
    assert survey(replace(scene, has_alpha=False)).cut_out == 0


def test_a_shift_moves_all_and_tears_nothing():
    found = movement_of(
        fitted(lambda at, time: time * at.new_tensor([0.8, 0, 0]).expand(len(at), 3)), [0, 0.5, 1]
    )
    assert (found.moving, found.torn) == (1.0, 0.0)
    assert found.distance == pytest.approx(0.8)


def test_what_is_drawn_out_is_torn():
    def stretched(at, time):
        return 2 * time * (at - at.mean(0)) * at.new_tensor([1.0, 0, 0])

    found = movement_of(fitted(stretched), [0, 0.4, 1])
    assert found.torn == 1.0  # three voxels from one to the next
    assert found.at == 1
    assert movement_of(fitted(stretched), [0, 0.4]).torn == 0.0  # 1.8 voxels


def test_nothing_moves_where_nothing_does():
    found = movement_of(fitted(lambda at, time: torch.zeros_like(at)), [0, 1])
    assert (found.moving, found.distance, found.torn, found.left_out) == (0, 0, 0, (0.0,))
    assert found.bases() == 0


def test_no_matter_does_not_move():
    method = fitted(lambda at, time: torch.ones_like(at))
    with torch.no_grad():
        method.radiance.parameter("density").fill_(-8.0)
    assert movement_of(method, [0, 1]) == Movement(0, 0, 0, 0.0, (0.0,))


def test_a_wave_needs_its_own_cosine():
    times = [i / 19 for i in range(20)]
    method = fitted(lambda at, time: wave(at, time))
    trajectory = method.motion.trajectory
    strength = torch.zeros(3, 8)
    strength[0, 4] = 1.0  # the fifth cosine

    def wave(at, time):
        basis = dct_basis(time, 8, trajectory.frames, 0.0)
        return (strength @ basis).expand(len(at), 3)

    trajectory.coefficients = lambda points: strength.expand(len(points), 3, 8)
    found = movement_of(method, times)
    assert len(found.left_out) == 9
    assert found.bases() == 5
    assert found.left_out[4] == pytest.approx(found.left_out[0])
    assert found.left_out[5:] == (0, 0, 0, 0)


def samples(views=24, places=30, seed=0):
    """Return places (P, 3), directions (P, 3) and images (P,); each image sees all places from one side."""
    generator = torch.Generator().manual_seed(seed)
    where = torch.rand(places, 3, generator=generator).repeat(views, 1) + 0.01
    towards = torch.nn.functional.normalize(torch.randn(views, 3, generator=generator), dim=-1)
    return where, towards.repeat_interleave(places, 0), torch.arange(views).repeat_interleave(places)


def test_only_an_error_linear_in_direction_isexplained_by_direction():
    where, towards, views = samples()
    generator = torch.Generator().manual_seed(1)
    slope, noise = (torch.randn(n, 3, generator=generator) for n in (3, len(where)))
    assert explained_by_direction(where, towards, towards @ slope, views, 0.05) > 0.6
    assert explained_by_direction(where, towards, noise, views, 0.05) < 0.02
    assert abs(explained_by_direction(where, towards, where.sin(), views, 0.05)) < 0.02  # of the place alone
    assert explained_by_direction(where * float("nan"), towards, where, views, 0.05) == 0  # met nowhere


def test_of_a_fitted_ball(tmp_path):
    data = ball_data()
    run = make_run(tmp_path, [stage(iterations=60)], data=data, model=forward_model(view_dependence=None))
    module = run.fit()
    targets = [data.targets("train")[i] for i in range(6)]
    found = residual(module.method, targets, voxel_size=0.05, rays=300)
    drawn = sum(float(10 ** (-module.psnr_of(target) / 10)) for target in targets) / 6
    assert abs(10 ** (-found.psnr / 10) / drawn - 1) < 0.3  # from half of the pixels
    assert found.by_direction < 0.3
    coarser = residual(module.method, targets, voxel_size=0.4, rays=300)
    assert coarser.allowed < found.allowed


MOVING = VoxelEvidence(
    Survey(frames=50, times=50, cut_out=0.8, spread=160.0, disagreement=0.2),
    movement=Movement(moving=0.4, distance=0.3, torn=0.2, at=0.9, left_out=(4.0, 2.0, 0.4, 0.1, 0.0)),
    residual=Residual(psnr=28.0, by_direction=0.02, allowed=38.0),
)
YES, NO, UNSURE = Gain(1.0, 0.2, 2.0, 100), Gain(-0.1, 0.2, 20.0, 100), Gain(0.15, 0.2, 1.2, 100)


def evidence(**changes):
    return replace(MOVING, gains={}, **changes)


def with_gains(**gains):
    return replace(MOVING, gains=gains)


def asked(trials=True, bases=10, **typed):
    """Make a run to plan, with overrides that the user typed."""
    stages = {"coarse": {"num_voxels": [[0, 1000]]}, "fine": {"num_voxels": [[0, 8000], [0.5, 27000]]}}
    on = {effect.name: effect.on for effect in decisions.EFFECTS}
    typed = {key.replace("__", "/"): value for key, value in typed.items()}
    return Asked(stages, {"bases": bases}, typed, on.get, trials)


def test_one_time_needs_no_trial_to_stand_still():
    pictures = replace(MOVING.pictures, times=1)
    found = decisions.of_motion(evidence(pictures=pictures, movement=None), asked())
    assert (found.choice, found.on, found.overrides) == ("none", False, ("model/motion=none",))
    assert found.because == "1 time: nothing can be seen to move"


@pytest.mark.parametrize(("gain", "choice"), [(YES, "dct"), (NO, "none"), (UNSURE, "none")])
def test_a_trial_decides_and_is_named(gain, choice):
    found = decisions.of_motion(with_gains(motion=gain), asked())
    assert found.choice == choice
    assert found.because.endswith(f"; {gain}, more than {max(gain.noise, 0.1):.2f} asked")
    assert "20.0% of the foreground" in found.because
    assert "40% of the solid voxels move, by 0.3" in found.because


def test_without_trials_the_evidence_decides():
    still = replace(MOVING.movement, moving=0.0)
    agree = replace(MOVING.pictures, disagreement=0.0)
    assert decisions.of_motion(evidence(), asked()).on
    assert not decisions.of_motion(evidence(movement=still, pictures=agree), asked()).on
    assert not decisions.of_view(evidence(), asked()).on
    assert decisions.of_view(evidence(residual=replace(MOVING.residual, by_direction=0.2)), asked()).on
    assert not decisions.of_inpainter(evidence(), asked()).on
    assert decisions.of_inpainter(evidence(movement=replace(MOVING.movement, torn=0.5)), asked()).on
    assert not decisions.of_upsampler(evidence(), asked()).on
    limited = replace(MOVING.residual, allowed=28.5)
    assert decisions.of_upsampler(evidence(residual=limited), asked()).choice == "learned"


def open_questions(found):
    """The later effects that the evidence does not rule out."""
    return [e.name for e in decisions.EFFECTS if e.later and not e.rules_out(found)]


def test_only_what_is_open_is_tried():
    assert open_questions(evidence()) == ["view_dependence", "inpainter"]
    assert open_questions(evidence(movement=None)) == ["view_dependence"]
    sure = Residual(psnr=28.0, by_direction=-0.01, allowed=30.0)
    assert open_questions(evidence(movement=None, residual=sure)) == ["upsampler"]


def test_cameras_that_stand_together_see_no_direction():
    narrow = evidence(pictures=replace(MOVING.pictures, spread=6.0))
    assert open_questions(narrow) == ["inpainter"]
    found = decisions.of_view(replace(narrow, gains={"view_dependence": YES}), asked())
    assert (found.choice, found.because) == (
        "none",
        "all cameras lie within 6 degrees: direction is not seen",
    )


def test_bases_follow_the_spectrum_or_the_trial():
    left = (4.0, 2.0, 1.5, 1.2, 0.0)  # the last of four has much to say
    flat = replace(MOVING.movement, left_out=left)
    assert decisions.of_bases(evidence(movement=flat), asked(bases=4)).choice == "8"
    assert decisions.of_bases(evidence(), asked(bases=4)).choice == "4"
    tried = decisions.of_bases(with_gains(bases=NO), asked(bases=4))
    assert (tried.choice, tried.on) == ("4", False)
    why = "2 of 4 cosines leave out no more than 0.5 voxels; 8 of them against 4: "
    assert tried.because == f"{why}{NO}, more than 0.20 asked"
    assert decisions.of_bases(with_gains(bases=YES), asked(bases=4)).choice == "8"


def test_a_background_needs_something_that_moves_before_it():
    bare = replace(MOVING.pictures, cut_out=0.0)
    start = ["stage.coarse.start_alpha=1e-2", "stage.coarse.confine=0.0"]
    assert decisions.of_background(evidence(), asked(), True).because.startswith("80% of the pixels")
    assert not decisions.of_background(evidence(), asked(), True).on
    found = decisions.of_background(evidence(pictures=bare), asked(), True)
    assert (found.choice, found.overrides) == ("grid", ("model/background=grid", *start))
    still = decisions.of_background(evidence(pictures=bare), asked(), False)
    assert (still.on, still.overrides) == (False, ("model/background=none", *start))
    against = replace(with_gains(background=NO), pictures=bare)
    assert decisions.of_background(against, asked(), True).overrides == (
        "model/background=none",
        *start,
    )


def test_a_time_makes_dear_effects_dearer_the_shorter_it_is():
    gain = Gain(0.6, 0.1, 20.0, 100)
    known = {"slope": 0.4, "steps": 100, "step": 0.01}
    free, long, short = (
        replace(with_gains(inpainter=gain), minutes=minutes, **known) for minutes in (None, 100.0, 0.5)
    )
    assert free.price(gain) == 0
    assert 0 < long.price(gain) < short.price(gain)
    assert [e.pays("inpainter") for e in (free, long, short)] == [True, True, False]
    assert (
        f"whose steps are worth {short.price(gain):.2f} dB" in decisions.of_inpainter(short, asked()).because
    )


def test_the_price_is_what_fewer_steps_cost_on_the_curve_that_was_seen():
    """PSNR = end - c / sqrt(steps), c from the slope between 50 and 100 steps of 0.1 s."""
    c = 0.5 / (50**-0.5 - 100**-0.5)
    found = replace(with_gains(), minutes=1.0, slope=0.5, steps=100, step=0.1)
    assert found.price(Gain(0, 0, 4.0, 20)) == pytest.approx(c * (150**-0.5 - 600**-0.5))
    assert found.price(Gain(0, 0, 0.5, 100)) == 0
    assert found.price(Gain(0, 0, 4.0, None)) == 0  # the trial itself was of equal time
    bounded = {most: replace(found, most_steps=most).price(Gain(0, 0, 4.0, 20)) for most in (100, 300, 900)}
    assert bounded[100] == 0  # with and without it the minutes are enough for all steps there are
    assert bounded[300] == pytest.approx(c * (150**-0.5 - 300**-0.5))
    assert bounded[900] == found.price(Gain(0, 0, 4.0, 20))


def walk(found, asked, **answers):
    """Return what a plan begins with, and what it tries, given which effects pay."""
    noted = Noted(answers)
    VoxelPlanning().coarse(found, asked, noted)
    return noted.begun, noted.tried


def test_coarse_stages_ask_for_cosines_then_motion_then_the_background():
    bare = evidence(pictures=replace(MOVING.pictures, cut_out=0.0))
    (first,), tried = walk(bare, asked(), bases=False, motion=True, background=True)
    start = ["stage.coarse.start_alpha=1e-2", "stage.coarse.confine=0.0"]
    assert first == (
        "coarse",
        ["model/motion=dct", "model/background=grid", *decisions.PLAIN, *start],
    )
    assert [(effect, adds) for effect, _, adds in tried] == [
        *(("bases", True), ("motion", False), ("background", False))
    ]
    assert tried[0][1] == ["preset.bases=20", "stage.coarse.bases=[[0,20]]"]
    begun, _ = walk(bare, asked(), bases=False, motion=False)  # what stands still is one field
    assert begun[1] == ("coarse-still-alone", ["model/background=none"], "changed")


def test_what_is_typed_is_not_asked():
    assert walk(evidence(), asked(trials=False))[1] == []
    assert walk(evidence(), asked(model__motion="dct"))[1] == []
    (((name, _),), _) = walk(evidence(), asked(model__motion="none"))
    assert name == "coarse-still"


def test_dear_effects_go_on_the_lattice_that_they_were_tried_on():
    with_it = {effect.name: effect.with_it(asked()) for effect in decisions.EFFECTS}
    coarse = "stage.coarse.effects=[motion,background]"
    assert with_it["inpainter"] == with_it["upsampler"] == (coarse, "stage.fine.num_voxels=[[0,8000]]")
    assert with_it["view_dependence"] == (coarse,)
    assert with_it["motion"] == ()


def test_what_is_typed_overrules():
    found = with_gains(view_dependence=YES)
    by_hand = {d.effect: d for d in VoxelPlanning().decide(found, asked(model__view_dependence="none"))}
    assert (
        by_hand["view_dependence"].choice,
        by_hand["view_dependence"].on,
        by_hand["view_dependence"].overrides,
    ) == ("none", False, ())
    assert by_hand["view_dependence"].because.startswith("as typed; ")
    assert {d.effect: d for d in VoxelPlanning().decide(found, asked())}["view_dependence"].on
