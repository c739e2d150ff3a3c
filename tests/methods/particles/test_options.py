"""Effects, and the numbers of a stage."""

import pytest
from omegaconf import OmegaConf

from forewarp.methods.particles.model import Particles
from forewarp.methods.particles.options import EFFECTS, Effects, Numbers
from tests.support.configs import composed

NAMES = [effect.name for effect in EFFECTS]


def test_defaults_are_those_of_the_command():
    """Whoever builds particles in a notebook fits the method that ``forewarp-train`` fits."""
    config = OmegaConf.to_container(composed("model=particles", "preset=fast"), resolve=True)
    stage = config["stage"]["fine"]
    stage["effects"] = tuple(stage["effects"])
    stage["image_scale"] = tuple(map(tuple, stage["image_scale"]))
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
        (
            Numbers,
            {"image_scale": [[0.5, 2]]},
            r"stage.fine.image_scale: expected \[\[0, count\], .*, but got \[\[0.5, 2\]\]",
        ),
        (Numbers, {"natural_splines": 1}, "stage.fine.natural_splines: expected true or false, but got 1"),
    ],
)
def test_wrong_choices_are_refused(made, changes, message):
    with pytest.raises(ValueError, match=message):
        made(**changes)
