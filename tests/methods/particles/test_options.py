"""Effects and numbers of a stage; which effects a plan asks for, in which order, and what it decides."""

from dataclasses import replace

import pytest
from omegaconf import OmegaConf

from forewarp.methods.effect import Asked, Evidence
from forewarp.methods.particles.model import Particles
from forewarp.methods.particles.options import EFFECTS, Effects, Numbers, ParticlesPlanning
from forewarp.metrics.gain import Gain
from forewarp.scene.frame import Survey
from tests.support.configs import composed
from tests.support.fakes import Noted

PICTURES = Survey(frames=50, times=50, cut_out=0.8, spread=160.0, disagreement=0.2)
NAMES = [effect.name for effect in EFFECTS]
YES, NO, UNSURE = Gain(1.0, 0.2, 1.2, 1000), Gain(-0.1, 0.2, 1.2, 1000), Gain(0.8, 0.9, 1.2, 1000)


def test_defaults_are_those_of_the_command():
    """Whoever builds particles in a notebook fits the method that ``forewarp-train`` fits."""
    config = OmegaConf.to_container(composed("model=particles", "preset=fast"), resolve=True)
    stage = config["stage"]["fine"]
    stage["effects"] = tuple(stage["effects"])
    assert Numbers(**{name: stage[name] for name in Particles.numbers}) == Numbers()
    assert Effects(**{name: config["model"][name] for name in NAMES}) == Effects()
    assert set(config["model"]) == {"name", "_target_", "_partial_", *NAMES}


def test_numbers_follow_the_images():
    numbers = Numbers()
    assert numbers.final_count(4.0, 100) == numbers.final_count(4.0, 200) == 180
    assert numbers.final_count(4.0, 25) == 90  # fewer images tell less
    assert (numbers.share_at(0.0), numbers.share_at(1.0)) == (0.5, 1.0)
    assert numbers.motion(100, 2)[1] == 4
    assert numbers.motion(20_000, 200)[0] > numbers.motion(5_000, 200)[0]
    decaying = Numbers(opacity_decay=0.1, crowd_decay=0.5)
    assert [decaying.decay(8.0, covered) for covered in (2.0, 8.0, 16.0)] == pytest.approx(
        [1 - 0.9 * (1 - 0.375), 0.1, 0.1]
    )


@pytest.mark.parametrize(
    ("made", "changes", "message"),
    [
        (Effects, {"view_dependence": 4}, "model.view_dependence: expected a degree of 1 to 3, or null"),
        (Effects, {"color_over_time": 0}, "model.color_over_time: expected a number of cosines >= 1"),
        (Effects, {"rotation": False}, "or null, but got False; choose model/rotation=none to switch it off"),
        (
            Effects,
            {"motion": "wobble"},
            "model.motion: expected spline or cosines, or null, but got 'wobble'",
        ),
        (Effects, {"background": 0}, "model.background: expected a number > 0, or null, but got 0"),
        (
            Numbers,
            {"effects": ["glow"]},
            r"stage.fine.effects: expected some of motion, .*but got \['glow'\]",
        ),
        (
            Numbers,
            {"initial_share": 0.0},
            r"stage.fine.initial_share: expected a number in \(0, 1\], but got 0",
        ),
        (Numbers, {"density": -1.0}, "stage.fine.density: expected a number > 0, but got -1.0"),
        (Numbers, {"edges": 0}, "stage.fine.edges: expected a whole number >= 1, but got 0"),
        (
            Numbers,
            {"opacity_decay": 1},
            r"stage.fine.opacity_decay: expected a number in \[0, 1\), but got 1",
        ),
        (Numbers, {"jitter": "some"}, "stage.fine.jitter: expected a number >= 0, but got 'some'"),
        (Numbers, {"shell": 0.5}, "stage.fine.shell: expected 0 or a number >= 1, but got 0.5"),
        (Numbers, {"natural_splines": 1}, "stage.fine.natural_splines: expected true or false, but got 1"),
    ],
)
def test_wrong_choices_are_refused(made, changes, message):
    with pytest.raises(ValueError, match=message):
        made(**changes)


def asked(trials=True, **typed):
    typed = {f"model/{name}": choice for name, choice in typed.items()}
    on = {effect.name: effect.on for effect in EFFECTS}
    return Asked({"coarse": {}, "fine": {}}, {}, typed, on.get, trials)


def walk(pictures, asked, pays):
    """The overrides that a plan begins with, and what it leaves out in turn; ``pays``: whether each pays."""
    noted = Noted(dict.fromkeys(NAMES, pays))
    ParticlesPlanning().coarse(Evidence(pictures), asked, noted)
    ((_, begin),) = noted.begun
    return begin, noted.tried


def decided(pictures, asked, at_rest=0.3, **gains):
    evidence = ParticlesPlanning().evidence(pictures, gains=gains, least=0.6)
    evidence.at_rest = dict.fromkeys(gains, at_rest)
    decisions = ParticlesPlanning().decide(evidence, asked)
    assert [decision.effect for decision in decisions] == NAMES
    assert all(any(c.isdigit() for c in decision.because) for decision in decisions)
    return {decision.effect: decision for decision in decisions}


def test_every_effect_is_on_at_first_and_then_left_out():
    begin, drops = walk(PICTURES, asked(), True)
    assert begin == [f"model/{effect.name}={effect.on}" for effect in EFFECTS]
    assert [effect for effect, *_ in drops] == NAMES
    assert drops[0] == ("motion", ["model/motion=none", "model/rotation=none", "model/background=none"], 1)
    assert drops[-1] == ("view_dependence", ["model/view_dependence=none"], 2)
    _, drops = walk(replace(PICTURES, cut_out=0.0), asked(), True)  # stand-ins for motion go first
    assert [(effect, longer) for effect, _, longer in drops] == [
        *(("opacity_over_time", 1), ("color_over_time", 1), ("motion", 3)),
        *(("rotation", 1), ("background", 3), ("view_dependence", 2)),
    ]


def test_what_does_not_move_does_not_turn():
    _, drops = walk(PICTURES, asked(), False)
    assert not {"rotation", "background"} & {effect for effect, *_ in drops}
    found = decided(PICTURES, asked(), motion=NO)
    for name in ("rotation", "background"):
        assert (found[name].choice, found[name].because[:8]) == ("none", "0 nodes:")


@pytest.mark.parametrize(
    ("changes", "tried"),
    [({"times": 1}, ["view_dependence"]), ({"spread": 6.0}, NAMES[:-1]), ({"times": 1, "spread": 6.0}, [])],
)
def test_what_images_cannot_show_is_not_tried(changes, tried):
    pictures = replace(PICTURES, **changes)
    begin, drops = walk(pictures, asked(), True)
    assert [effect for effect, *_ in drops] == tried
    assert [o for o in begin if not o.endswith("=none")] == [
        f"model/{effect.name}={effect.on}" for effect in EFFECTS if effect.name in tried
    ]
    found = decided(pictures, asked(), **dict.fromkeys(tried, YES))
    assert [name for name in NAMES if found[name].on] == tried


def test_what_is_typed_is_not_tried_and_wins():
    _, drops = walk(PICTURES, asked(motion="none", view_dependence="harmonics"), True)
    assert [effect for effect, *_ in drops] == ["opacity_over_time", "color_over_time"]
    found = decided(PICTURES, asked(motion="cosines", color_over_time="none"), rotation=YES, motion=NO)
    assert (found["motion"].choice, found["motion"].overrides) == ("cosines", ())
    assert found["motion"].because.startswith("as typed; ")
    assert (found["rotation"].on, found["color_over_time"].on) == (True, False)


@pytest.mark.parametrize(("gain", "on"), [(YES, True), (NO, False), (UNSURE, False)])
def test_an_effect_stays_if_it_is_missed_beyond_noise(gain, on):
    found = decided(PICTURES, asked(), motion=YES, color_over_time=gain)["color_over_time"]
    assert (found.on, found.choice) == (on, "cosines" if on else "none")
    assert found.overrides == (f"model/color_over_time={found.choice}",)
    assert found.because == f"{gain}, more than {max(gain.noise, 0.6):.2f} asked"


@pytest.mark.parametrize(
    ("gain", "at_rest", "on"),
    [(-0.05, 0.3, True), (-0.25, 0.3, False), (1.0, 0.02, False), (0.0, 0.1, True), (0.0, 0.0999, False)],
)
def test_the_background_is_found_by_what_rests_and_left_out_where_it_costs_accuracy(gain, at_rest, on):
    gain = Gain(gain, 0.1, 1.0, 1000)
    found = decided(PICTURES, asked(), at_rest, motion=YES, background=gain)["background"]
    assert (found.on, found.choice) == (on, "still" if on else "none")
    assert found.because == f"{at_rest:.1%} at rest, 10% asked; {gain}, -0.2 or more asked"


def test_the_bound_is_less_in_longer_trials():
    for psnr, on in ((0.5, True), (0.4, False)):
        gain = Gain(psnr, 0.1, 1.0, 1000)
        found = decided(PICTURES, asked(), motion=YES, view_dependence=gain, color_over_time=gain)
        assert (found["view_dependence"].on, found["color_over_time"].on) == (on, False)


@pytest.mark.parametrize(
    ("effect", "psnr", "at_rest", "hopeless"),
    [
        *(("rotation", 0.1, 0.0, True), ("rotation", 0.5, 0.0, False), ("background", 0.1, 0.3, False)),
        *(("background", 0.1, 0.0, True), ("background", 0.1, 0.09, False)),  # another seed may have more
        *(("background", -0.3, 0.3, False), ("background", -0.5, 0.3, True)),
    ],
)
def test_another_seed_is_tried_where_it_may_decide(effect, psnr, at_rest, hopeless):
    evidence = ParticlesPlanning().evidence(PICTURES, least=0.6)
    evidence.gains[effect], evidence.at_rest[effect] = Gain(psnr, 0.2, 1.0, 9), at_rest
    assert evidence.hopeless(effect) is hopeless


def test_without_trials_silhouettes_decide_on_motion_and_what_nodes_do():
    every, none = ["motion", "rotation", "background"], []
    for disagreement, cut_out, nodes in ((0.2, 0.8, every), (0.0, 0.8, none), (0.0, 0.0, every[:2])):
        pictures = replace(PICTURES, disagreement=disagreement, cut_out=cut_out)
        assert walk(pictures, asked(trials=False), True)[1] == []
        found = decided(pictures, asked(trials=False))
        assert [name for name in NAMES if found[name].on] == nodes
