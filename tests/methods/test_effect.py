"""What a scene's images say of each effect, and what is chosen."""

from dataclasses import replace

import pytest

from forewarp.methods.effect import Evidence, Residual, decide
from forewarp.methods.particles.options import EFFECTS as PARTICLES
from forewarp.methods.voxel.backward import BackwardWarp
from forewarp.methods.voxel.structure import EFFECTS as VOXELS
from forewarp.scene.frame import Survey

PICTURES = Survey(frames=50, times=50, cut_out=0.8, spread=160.0, disagreement=0.02, one_camera=True)
QUIET = replace(PICTURES, disagreement=0.0)
NODES = {"motion": "spline", "rotation": "nodes", "background": "still"}
OF_PARTICLES = NODES | {"color_over_time": "cosines", "view_dependence": "harmonics"}
OF_VOXELS = {"motion": "dct", "view_dependence": "sh", "upsampler": "learned", "inpainter": "unet3d"}


def on(effects, preset, pictures, typed=None, **residual):
    """Names of the effects that are on."""
    found = Residual(**{"by_time": 0.0, "by_direction": 0.0} | residual) if residual else None
    decisions = decide(effects, Evidence(pictures, found), preset, typed or {})
    assert [decision.effect for decision in decisions] == [effect.name for effect in effects]
    assert all(decision.because for decision in decisions)
    return {decision.effect for decision in decisions if decision.on}


@pytest.mark.parametrize(
    ("pictures", "residual", "expected"),
    [
        (PICTURES, {}, set(OF_PARTICLES)),
        (replace(PICTURES, times=1), {}, {"view_dependence"}),
        (replace(PICTURES, spread=6.0), {}, set(OF_PARTICLES) - {"view_dependence"}),
        (replace(QUIET, cut_out=0.0), {}, set(OF_PARTICLES)),  # no silhouettes, no evidence
        (QUIET, {"by_time": -0.05, "by_direction": 0.05}, set()),
        (QUIET, {"by_time": -0.05, "by_direction": 0.2}, {"view_dependence"}),
        (QUIET, {"by_time": 0.03, "by_direction": 0.05}, set(OF_PARTICLES)),  # a time has few directions
    ],
)
def test_scenes_that_call_for_different_things_get_different_things(pictures, residual, expected):
    assert on(PARTICLES, OF_PARTICLES, pictures, **residual) == expected


def test_voxels_are_decided_by_the_same_evidence():
    assert on(VOXELS, OF_VOXELS, PICTURES) == set(OF_VOXELS)
    assert on(VOXELS, OF_VOXELS | {"background": "grid"}, PICTURES) == set(OF_VOXELS)
    assert "background" in on(VOXELS, OF_VOXELS | {"background": "grid"}, replace(PICTURES, cut_out=0.0))
    still = on(VOXELS, OF_VOXELS, QUIET, by_time=0.0, by_direction=0.2)
    assert still == {"view_dependence", "upsampler"}  # nothing moves, so nothing opens
    whole = {"view_dependence": "sh", "background": "grid"}
    assert on(BackwardWarp.effects, whole, replace(PICTURES, cut_out=0.0)) == set(whole)


def test_the_preset_and_what_is_typed_win():
    assert on(PARTICLES, {"motion": "spline"}, PICTURES) == {"motion"}
    decisions = decide(PARTICLES, Evidence(replace(PICTURES, times=1)), OF_PARTICLES, {"motion": "cosines"})
    motion, rotation = decisions[:2]
    assert (motion.choice, rotation.choice) == ("cosines", "nodes")
    assert motion.because == "as typed; 1 time: nothing can be seen to change"
    exposure = {"exposure": "cosines"}
    assert on(PARTICLES, exposure, PICTURES) == {"exposure"}
    assert on(PARTICLES, exposure, replace(PICTURES, one_camera=False)) == set()  # each camera has its own
    (opacity,) = (d for d in decide(PARTICLES, Evidence(PICTURES), OF_PARTICLES, {}) if "opacity" in d.effect)
    assert (opacity.choice, opacity.because) == ("none", "off in the preset")


@pytest.mark.parametrize(
    ("changes", "rests"),
    [({}, True), ({"frames": 39}, False), ({"times": 1}, False), ({"disagreement": 0.002}, False)],
)
def test_few_images_that_show_no_change_say_nothing(changes, rests):
    assert Evidence(replace(QUIET, **changes)).silhouettes_rest is rests


def test_silhouettes_alone_switch_nothing_off():
    assert on(PARTICLES, OF_PARTICLES, QUIET) == set(OF_PARTICLES)
    unfit = Evidence(QUIET, unfit="a still fit shows nothing")
    decisions = {d.effect: d for d in decide(PARTICLES, unfit, OF_PARTICLES, {})}
    assert {name for name, decision in decisions.items() if decision.on} == set(OF_PARTICLES)
    assert decisions["motion"].because.endswith("and a still fit shows nothing, so it is left on")


def test_each_reason_has_its_number():
    reasons = {d.effect: d.because for d in decide(PARTICLES, Evidence(PICTURES), OF_PARTICLES, {})}
    assert reasons["motion"] == "50 times; a static shape explains all but 2.0% of the silhouettes"
    assert reasons["view_dependence"] == "cameras differ by 160 degrees"
    told = Evidence(QUIET, Residual(by_time=-0.04, by_direction=0.22))
    reasons = {d.effect: d.because for d in decide(PARTICLES, told, OF_PARTICLES, {})}
    assert reasons["motion"].endswith("0.0% of the silhouettes, and time 0% of what a still fit leaves over")
    assert reasons["rotation"] == "does nothing without motion"
    assert reasons["view_dependence"].endswith("it explains 22% of what a still fit leaves over")
