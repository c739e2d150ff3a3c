"""Which effects of particles are asked for, in which order, and what is decided from the answers."""

from dataclasses import replace

import pytest

from forewarp.methods.effect import Asked, Begin, Drop, Evidence
from forewarp.methods.particles.options import EFFECTS, ParticlesPlanning
from forewarp.metrics.gain import Gain
from forewarp.scene.silhouettes import Survey

PICTURES = Survey(frames=50, times=50, cut_out=0.8, spread=160.0, disagreement=0.2)
NAMES = [effect.name for effect in EFFECTS]
YES, NO, UNSURE = Gain(1.0, 0.2, 1.2, 1000), Gain(-0.1, 0.2, 1.2, 1000), Gain(0.8, 0.9, 1.2, 1000)


def asked(trials=True, **typed):
    typed = {f"model/{name}": choice for name, choice in typed.items()}
    on = {effect.name: effect.on for effect in EFFECTS}
    return Asked({"coarse": {}, "fine": {}}, {}, typed, on.get, trials)


def walk(pictures, asked, answers):
    """What a plan begins with, and the effects that it leaves out in turn; ``answers`` say which pay."""
    steps = ParticlesPlanning().coarse(Evidence(pictures), asked)
    begin, drops = next(steps), []
    answer = None
    while True:
        try:
            drops.append(steps.send(answer))
        except StopIteration:
            return begin, drops
        answer = answers[drops[-1].effect]


def decided(pictures, asked, at_rest=0.3, **gains):
    evidence = ParticlesPlanning().evidence(pictures, gains=gains, least=0.6)
    evidence.at_rest = dict.fromkeys(gains, at_rest)
    made = ParticlesPlanning().decide(evidence, asked)
    assert [decision.effect for decision in made] == NAMES
    assert all(any(c.isdigit() for c in decision.because) for decision in made)
    return {decision.effect: decision for decision in made}


def test_every_effect_is_on_at_first_and_then_left_out():
    begin, drops = walk(PICTURES, asked(), dict.fromkeys(NAMES, True))
    assert begin == Begin("coarse", tuple(f"model/{effect.name}={effect.on}" for effect in EFFECTS))
    assert [drop.effect for drop in drops] == NAMES
    off = ("model/motion=none", "model/rotation=none", "model/background=none")
    assert drops[0] == Drop("motion", off)
    assert drops[-1] == Drop("view_dependence", ("model/view_dependence=none",), 2)


def test_where_nothing_is_cut_out_motion_is_tried_for_longer_and_without_what_could_stand_in():
    _, drops = walk(replace(PICTURES, cut_out=0.0), asked(), dict.fromkeys(NAMES, True))
    assert [(drop.effect, drop.longer) for drop in drops] == [
        *(("opacity_over_time", 1), ("color_over_time", 1)),
        *(("motion", 3), ("rotation", 1), ("background", 3), ("view_dependence", 2)),
    ]


def test_what_does_not_move_does_not_turn():
    _, drops = walk(PICTURES, asked(), dict.fromkeys(NAMES, False))
    assert not {"rotation", "background"} & {drop.effect for drop in drops}
    found = decided(PICTURES, asked(), motion=NO)
    for name in ("rotation", "background"):
        assert (found[name].choice, found[name].because[:8]) == ("none", "0 nodes:")


@pytest.mark.parametrize(
    ("changes", "tried"),
    [({"times": 1}, ["view_dependence"]), ({"spread": 6.0}, NAMES[:-1]), ({"times": 1, "spread": 6.0}, [])],
)
def test_what_pictures_cannot_show_is_not_tried(changes, tried):
    pictures = replace(PICTURES, **changes)
    begin, drops = walk(pictures, asked(), dict.fromkeys(NAMES, True))
    assert [drop.effect for drop in drops] == tried
    assert [o for o in begin.overrides if not o.endswith("=none")] == [
        f"model/{effect.name}={effect.on}" for effect in EFFECTS if effect.name in tried
    ]
    found = decided(pictures, asked(), **dict.fromkeys(tried, YES))
    assert [name for name in NAMES if found[name].on] == tried


def test_what_is_typed_is_not_tried_and_wins():
    _, drops = walk(PICTURES, asked(motion="none", view_dependence="harmonics"), dict.fromkeys(NAMES, True))
    assert [drop.effect for drop in drops] == ["opacity_over_time", "color_over_time"]
    found = decided(PICTURES, asked(motion="cosines", color_over_time="none"), rotation=YES, motion=NO)
    assert (found["motion"].choice, found["motion"].overrides) == ("cosines", ())
    assert found["motion"].because.startswith("as typed; ")
    assert found["rotation"].on
    assert not found["color_over_time"].on


@pytest.mark.parametrize(("gain", "on"), [(YES, True), (NO, False), (UNSURE, False)])
def test_an_effect_stays_if_it_is_missed_beyond_noise(gain, on):
    found = decided(PICTURES, asked(), motion=YES, color_over_time=gain)["color_over_time"]
    assert (found.on, found.choice) == (on, "cosines" if on else "none")
    assert found.overrides == (f"model/color_over_time={found.choice}",)
    assert found.because == f"{gain}, more than {max(gain.noise, 0.6):.2f} asked"


@pytest.mark.parametrize(
    ("gain", "at_rest", "on"),
    [
        *((0.0, 0.3, True), (-0.05, 0.3, True), (-0.25, 0.3, False), (0.0, 0.02, False), (1.0, 0.02, False)),
        *((0.0, 0.1, True), (0.0, 0.0999, False)),
    ],
)
def test_the_background_is_found_by_what_rests_and_left_out_where_it_costs_accuracy(gain, at_rest, on):
    gain = Gain(gain, 0.1, 1.0, 1000)
    found = decided(PICTURES, asked(), at_rest, motion=YES, background=gain)["background"]
    assert (found.on, found.choice) == (on, "still" if on else "none")
    assert found.because == f"{at_rest:.1%} at rest, 10% asked; {gain}, -0.2 or more asked"


@pytest.mark.parametrize(("gain", "on"), [(0.5, True), (0.4, False)])
def test_the_bound_is_less_in_longer_trials(gain, on):
    gain = Gain(gain, 0.1, 1.0, 1000)
    found = decided(PICTURES, asked(), motion=YES, view_dependence=gain, color_over_time=gain)
    assert (found["view_dependence"].on, found["color_over_time"].on) == (on, False)


def test_another_seed_is_tried_where_it_may_decide():
    evidence = ParticlesPlanning().evidence(PICTURES, least=0.6)
    for effect, gain, at_rest, hopeless in (
        ("rotation", Gain(0.1, 0.2, 1.0, 9), 0.0, True),
        ("rotation", Gain(0.5, 0.2, 1.0, 9), 0.0, False),
        ("background", Gain(0.1, 0.2, 1.0, 9), 0.3, False),
        ("background", Gain(0.1, 0.2, 1.0, 9), 0.0, True),
        ("background", Gain(0.1, 0.2, 1.0, 9), 0.09, False),  # another seed may have more at rest
        ("background", Gain(-0.3, 0.2, 1.0, 9), 0.3, False),
        ("background", Gain(-0.5, 0.2, 1.0, 9), 0.3, True),
    ):
        evidence.gains[effect], evidence.at_rest[effect] = gain, at_rest
        assert evidence.hopeless(effect) is hopeless


def test_without_trials_silhouettes_decide_on_motion_and_what_nodes_do():
    every, none = ["motion", "rotation", "background"], []
    for disagreement, cut_out, nodes in ((0.2, 0.8, every), (0.0, 0.8, none), (0.0, 0.0, every[:2])):
        pictures = replace(PICTURES, disagreement=disagreement, cut_out=cut_out)
        begin, drops = walk(pictures, asked(trials=False), {})
        assert drops == []
        found = decided(pictures, asked(trials=False))
        assert [name for name in NAMES if found[name].on] == nodes
