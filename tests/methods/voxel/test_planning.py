"""What motion and errors of a coarse stage say, and decisions from evidence and trials."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp.fields.curves import TrajectoryField
from forewarp.methods.effect import Asked
from forewarp.methods.voxel.planning import (
    EFFECTS,
    PLAIN,
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


def test_silhouettes_tell_motion_where_they_are():
    still = survey(ball_scene(times=[0.0] * 12))
    assert still.times == 1
    assert still.disagreement < 0.01
    scene = ball_scene()
    moving = survey(scene)
    assert (moving.frames, moving.times) == (12, 12)
    assert moving.disagreement > 0.1
    assert 0.7 < moving.cut_out < 1
    assert 90 < moving.spread <= 180
    opaque = torch.full((24, 24, 4), 255, dtype=torch.uint8)
    filled = survey(replace(scene, train=tuple(replace(f, load=lambda: opaque) for f in scene.train)))
    assert (filled.cut_out, filled.disagreement) == (0, 0)
    assert survey(replace(scene, has_alpha=False)).cut_out == 0


def test_a_shift_moves_all_and_tears_nothing():
    method = fitted(lambda at, time: time * at.new_tensor([0.8, 0, 0]).expand(len(at), 3))
    found = movement_of(method, [0, 0.5, 1])
    assert (found.moving, found.torn, found.distance) == (1.0, 0.0, pytest.approx(0.8))


def test_what_is_drawn_out_is_torn():
    method = fitted(lambda at, time: 2 * time * (at - at.mean(0)) * at.new_tensor([1.0, 0, 0]))
    found = movement_of(method, [0, 0.4, 1])
    assert (found.torn, found.at) == (1.0, 1)  # three voxels from one to the next
    assert movement_of(method, [0, 0.4]).torn == 0.0  # 1.8 voxels


def test_nothing_moves_where_nothing_does_or_is():
    found = movement_of(fitted(lambda at, time: torch.zeros_like(at)), [0, 1])
    assert (found.moving, found.distance, found.torn, found.left_out) == (0, 0, 0, (0.0,))
    assert found.bases() == 0
    empty = fitted(lambda at, time: torch.ones_like(at))
    torch.nn.init.constant_(empty.radiance.density, -8.0)
    assert movement_of(empty, [0, 1]) == Movement(0, 0, 0, 0.0, (0.0,))


def test_a_wave_needs_its_own_cosine():
    strength = torch.zeros(3, 8)
    strength[0, 4] = 1.0  # the fifth cosine
    method = fitted(lambda at, time: (strength @ dct_basis(time, 8, 20, 0.0)).expand(len(at), 3))
    method.motion.trajectory.coefficients = lambda points: strength.expand(len(points), 3, 8)
    found = movement_of(method, [i / 19 for i in range(20)])
    assert (len(found.left_out), found.bases()) == (9, 5)
    assert found.left_out[4] == pytest.approx(found.left_out[0])
    assert found.left_out[5:] == (0, 0, 0, 0)


def test_only_an_error_linear_in_direction_is_explained_by_direction():
    generator, views, count = torch.Generator().manual_seed(0), 24, 30  # each sees all places from one side
    where = torch.rand(count, 3, generator=generator).repeat(views, 1) + 0.01
    towards = torch.nn.functional.normalize(torch.randn(views, 3, generator=generator), dim=-1)
    slope, noise = (torch.randn(n, 3, generator=generator) for n in (3, views * count))
    towards = towards.repeat_interleave(count, 0)
    images = torch.arange(views).repeat_interleave(count)
    assert explained_by_direction(where, towards, towards @ slope, images, 0.05) > 0.6
    assert explained_by_direction(where, towards, noise, images, 0.05) < 0.02
    assert abs(explained_by_direction(where, towards, where.sin(), images, 0.05)) < 0.02  # of place alone
    assert explained_by_direction(where * float("nan"), towards, where, images, 0.05) == 0  # met nowhere


@pytest.mark.slow
def test_of_a_fitted_ball(tmp_path):
    data = ball_data()
    run = make_run(tmp_path, [stage(iterations=60)], data=data, model=forward_model(view_dependence=None))
    module = run.fit()
    targets = [data.targets("train")[i] for i in range(6)]
    found, coarser = (residual(module.method, targets, voxel_size=v, rays=300) for v in (0.05, 0.4))
    mean = sum(float(10 ** (-module.psnr_of(target) / 10)) for target in targets) / 6
    assert abs(10 ** (-found.psnr / 10) / mean - 1) < 0.3  # from half of the pixels
    assert found.by_direction < 0.3
    assert coarser.allowed < found.allowed


PICTURES = Survey(frames=50, times=50, cut_out=0.8, spread=160.0, disagreement=0.2)
MOTION = Movement(moving=0.4, distance=0.3, torn=0.2, at=0.9, left_out=(4.0, 2.0, 0.4, 0.1, 0.0))
ERRORS = Residual(psnr=28.0, by_direction=0.02, allowed=38.0)
YES, NO, UNSURE = Gain(1.0, 0.2, 2.0, 100), Gain(-0.1, 0.2, 20.0, 100), Gain(0.15, 0.2, 1.2, 100)
BARE, NARROW = replace(PICTURES, cut_out=0.0), replace(PICTURES, spread=6.0)
START = ["stage.coarse.start_alpha=1e-2", "stage.coarse.confine=0.0"]


def evidence(pictures=PICTURES, movement=MOTION, residual=ERRORS, gains=(), **known):
    return VoxelEvidence(pictures, movement=movement, residual=residual, gains=dict(gains), **known)


def asked(trials=True, bases=10, **typed):
    """Make a run to plan, with overrides that the user typed."""
    stages = {"coarse": {"num_voxels": [[0, 1000]]}, "fine": {"num_voxels": [[0, 8000], [0.5, 27000]]}}
    on = {effect.name: effect.on for effect in EFFECTS}
    typed = {key.replace("__", "/"): value for key, value in typed.items()}
    return Asked(stages, {"bases": bases}, typed, on.get, trials)


def decided(effect, found, to_plan=None):
    """The decision on one effect."""
    return next(d for d in VoxelPlanning().decide(found, to_plan or asked()) if d.effect == effect)


STILL = evidence(replace(PICTURES, disagreement=0.0), replace(MOTION, moving=0.0))
LAST_COUNTS = replace(MOTION, left_out=(4.0, 2.0, 1.5, 1.2, 0.0))  # the last of four cosines says much


@pytest.mark.parametrize(
    ("effect", "found", "choice", "because"),
    [
        ("motion", evidence(replace(PICTURES, times=1), None), "none", "1 time: nothing can be seen to move"),
        ("motion", evidence(), "dct", "20.0% of the foreground; 40% of the solid voxels move, by 0.3"),
        ("motion", STILL, "none", "0% of the solid voxels move"),
        *(
            ("motion", evidence(gains={"motion": gain}), choice, f"{gain}, more than 0.20 asked")
            for gain, choice in ((YES, "dct"), (NO, "none"), (UNSURE, "none"))
        ),
        ("view_dependence", evidence(), "none", "direction explains 2.0% of"),
        ("view_dependence", evidence(residual=replace(ERRORS, by_direction=0.2)), "sh", "explains 20.0% of"),
        (
            "view_dependence",
            evidence(NARROW, gains={"view_dependence": YES}),
            "none",
            "all cameras lie within 6 degrees: direction is not seen",
        ),
        ("inpainter", evidence(), "none", "20.0% of the solid voxels are torn"),
        ("inpainter", evidence(movement=replace(MOTION, torn=0.5)), "unet3d", "50.0% of the solid voxels"),
        ("inpainter", evidence(movement=None), "none", "0 % of the voxels move: nothing opens"),
        ("upsampler", evidence(), "none", "the last lattice allows 38.0 dB, 28.0 are reached"),
        ("upsampler", evidence(residual=replace(ERRORS, allowed=28.5)), "learned", "allows 28.5 dB"),
        ("bases", evidence(movement=LAST_COUNTS), "8", "4 of 4 cosines leave out no more than 0.5 voxels"),
        ("bases", evidence(), "4", "2 of 4 cosines"),
        ("bases", evidence(gains={"bases": NO}), "4", f"8 of them against 4: {NO}, more than 0.20 asked"),
        ("bases", evidence(gains={"bases": YES}), "8", f"8 of them against 4: {YES}"),
        ("background", evidence(), "none", "80% of the pixels are transparent"),
        ("background", evidence(BARE), "grid", "0 % of the pixels are transparent"),
        ("background", evidence(BARE, gains={"background": NO}), "none", f"transparent; {NO}"),
        ("background", evidence(BARE, None), "none", "but nothing moves: one field holds all"),
    ],
)
def test_evidence_decides_or_a_trial_and_is_named(effect, found, choice, because):
    decision = decided(effect, found, asked(bases=4))
    assert (decision.choice, decision.on) == (choice, choice not in ("none", "4"))
    assert because in decision.because
    if effect == "bases":
        assert decision.overrides == (("preset.bases=8", "stage.coarse.bases=[[0,8]]") if decision.on else ())
    else:
        start = START if effect == "background" and found.pictures is BARE else []
        assert decision.overrides == (f"model/{effect}={choice}", *start)


def test_what_is_typed_overrules():
    found = decided(
        "view_dependence", evidence(gains={"view_dependence": YES}), asked(model__view_dependence="none")
    )
    assert (found.choice, found.on, found.overrides) == ("none", False, ())
    assert found.because.startswith("as typed; ")
    found = decided("bases", evidence(), replace(asked(), typed={"preset.bases": "3"}))
    assert (found.choice, found.overrides, found.because[:10]) == ("3", (), "as typed; ")


@pytest.mark.parametrize(
    ("found", "open_questions"),
    [
        (evidence(), ["view_dependence", "inpainter"]),
        (evidence(movement=None), ["view_dependence"]),
        (evidence(NARROW), ["inpainter"]),
        (evidence(movement=None, residual=Residual(28.0, by_direction=-0.01, allowed=30.0)), ["upsampler"]),
    ],
)
def test_only_what_is_open_is_tried(found, open_questions):
    assert [e.name for e in EFFECTS if e.later and not e.rules_out(found)] == open_questions


def test_a_time_makes_dear_effects_dearer_the_shorter_it_is():
    gain = Gain(0.6, 0.1, 20.0, 100)
    known = {"gains": {"inpainter": gain}, "slope": 0.4, "steps": 100, "step": 0.01}
    free, long, short = (evidence(minutes=minutes, **known) for minutes in (None, 100.0, 0.5))
    assert 0 == free.price(gain) < long.price(gain) < short.price(gain)
    assert [e.pays("inpainter") for e in (free, long, short)] == [True, True, False]
    assert f"whose steps are worth {short.price(gain):.2f} dB" in decided("inpainter", short).because


def test_the_price_is_what_fewer_steps_cost_on_the_curve_that_was_seen():
    """PSNR = end - c / sqrt(steps), c from the slope between 50 and 100 steps of 0.1 s."""
    c, known = 0.5 / (50**-0.5 - 100**-0.5), {"minutes": 1.0, "slope": 0.5, "steps": 100, "step": 0.1}
    found, whole = evidence(**known), c * (150**-0.5 - 600**-0.5)
    assert found.price(Gain(0, 0, 4.0, 20)) == pytest.approx(whole)
    assert found.price(Gain(0, 0, 0.5, 100)) == 0
    assert found.price(Gain(0, 0, 4.0, None)) == 0  # the trial itself was of equal time
    # With 100 steps the minutes are enough with and without the effect.
    for most, price in ((100, 0.0), (300, c * (150**-0.5 - 300**-0.5)), (900, whole)):
        assert evidence(most_steps=most, **known).price(Gain(0, 0, 4.0, 20)) == pytest.approx(price)


def walk(found, asked, **answers):
    """Return what a plan begins with, and what it tries, given which effects pay."""
    noted = Noted(answers)
    VoxelPlanning().coarse(found, asked, noted)
    return noted.begun, noted.tried


def test_coarse_stages_ask_for_cosines_then_motion_then_the_background():
    (first,), tried = walk(evidence(BARE), asked(), bases=False, motion=True, background=True)
    assert first == ("coarse", ["model/motion=dct", "model/background=grid", *PLAIN, *START])
    questions = [("bases", True), ("motion", False), ("background", False)]
    assert [(effect, adds) for effect, _, adds in tried] == questions
    assert tried[0][1] == ["preset.bases=20", "stage.coarse.bases=[[0,20]]"]
    begun, _ = walk(evidence(BARE), asked(), bases=False, motion=False)  # what stands still is one field
    assert begun[1] == ("coarse-still-alone", ["model/background=none"], "changed")


def test_what_is_typed_is_not_asked():
    assert walk(evidence(), asked(trials=False))[1] == []
    assert walk(evidence(), asked(model__motion="dct"))[1] == []
    (((name, _),), _) = walk(evidence(), asked(model__motion="none"))
    assert name == "coarse-still"


def test_dear_effects_go_on_the_lattice_that_they_were_tried_on():
    with_it = {effect.name: effect.with_it(asked()) for effect in EFFECTS}
    coarse = "stage.coarse.effects=[motion,background]"
    assert with_it["inpainter"] == with_it["upsampler"] == (coarse, "stage.fine.num_voxels=[[0,8000]]")
    assert (with_it["view_dependence"], with_it["motion"]) == ((coarse,), ())
