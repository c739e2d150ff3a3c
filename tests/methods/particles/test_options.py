"""Effects, and the numbers of a stage."""

import re

import pytest
from omegaconf import OmegaConf

from forewarp.methods.particles import options
from forewarp.methods.particles.model import Particles
from forewarp.methods.particles.options import EFFECTS, Effects, Numbers
from tests.support.configs import composed

NAMES = [effect.name for effect in EFFECTS]


@pytest.mark.slow
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
    decays = [decaying.decay(8.0, covered) for covered in (2.0, 8.0, 16.0)]
    assert decays == pytest.approx([1 - 0.9 * (1 - 0.375), 0.1, 0.1])


COSINES, FORM = "a number of cosines >= 1", "[[0, count], [fraction, count], ...] with ascending fractions"
WRONG_EFFECTS = [
    ("view_dependence", 4, "a degree of 1 to 3"),
    ("color_over_time", 0, COSINES),
    ("rotation", False, "true"),
    ("motion", "wobble", "spline or cosines"),
    ("background", 0, "a number > 0"),
]
WRONG_NUMBERS = [
    ("effects", ["glow"], f"some of {', '.join(options.NAMES)}"),
    ("initial_share", 0.0, "a number in (0, 1]"),
    ("density", -1.0, "a number > 0"),
    ("edges", 0, "a whole number >= 1"),
    ("opacity_decay", 1, "a number in [0, 1)"),
    ("jitter", "some", "a number >= 0"),
    ("shell", 0.5, "0 or a number >= 1"),
    ("image_scale", [[0.5, 2]], f"{FORM} and counts >= 1"),
    ("natural_splines", 1, "true or false"),
]


@pytest.mark.parametrize(("key", "wrong", "wanted"), WRONG_EFFECTS)
def test_wrong_effects_are_refused(key, wrong, wanted):
    off = f"choose model/{key}=none to switch it off"
    message = f"model.{key}: expected {wanted}, or null, but got {wrong!r}; {off}"
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        Effects(**{key: wrong})


@pytest.mark.parametrize(("key", "wrong", "wanted"), WRONG_NUMBERS)
def test_wrong_numbers_are_refused(key, wrong, wanted):
    message = f"stage.fine.{key}: expected {wanted}, but got {wrong!r}"
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        Numbers(**{key: wrong})
