"""Words of earlier versions are answered with those that took their place."""

import re

import pytest
from omegaconf import OmegaConf

from configs import composed
from forewarp.cli.renamed import refuse_renamed, renewed
from forewarp.cli.runs import build_run, method_of


@pytest.mark.parametrize(
    ("word", "now"),
    [
        ("budget=fast", "preset=fast; the choice is called preset since 0.2"),
        ("budget=demo,fast", "preset=demo,fast;"),
        ("budget.bases=12", "preset.bases=12;"),
        ("++budget.inpainter_width=8", "++preset.inpainter_width=8;"),
        ("renderer.step=0.25", "model.renderer.step=0.25;"),
        ("model.warp=backward", "model=backward;"),
        ("experiment=hypernerf_faithful", "experiment=hypernerf preset=faithful;"),
        ("stage=demo", "stage=forward_demo;"),
        ("objective=faithful", "objective=forward_faithful;"),
        ("suits.budgets=[fast]", "no such word;"),
        ("~suits", "no such word;"),
    ],
)
def test_a_renamed_word_is_refused_with_the_new_one(word, now):
    with pytest.raises(ValueError, match=re.escape(f"{word}: expected {now}")) as refusal:
        refuse_renamed(["data.scene=x", word])
    assert "\n" not in str(refusal.value)


def test_words_of_today_are_not():
    words = [
        "preset=fast",
        "budget.minutes=3",
        "~budget.iterations",
        "model.renderer.step=1",
        "stage=forward_demo",
    ]
    refuse_renamed([*words, "--multirun", "experiment=hypernerf", "data.background=white"])


@pytest.mark.parametrize(
    "word", ["preset=fast", "preset.bases=12", "model.renderer.step=0.25", "stage=forward_demo"]
)
def test_what_is_advised_composes(word):
    assert composed("data.scene=x", word)


def test_a_run_of_an_earlier_version_is_read():
    now = OmegaConf.create(OmegaConf.to_container(composed("data.scene=x"), resolve=True))
    old = OmegaConf.create(OmegaConf.to_container(now))
    old.renderer, old.budget = old.model.pop("renderer"), {**old.pop("preset"), **old.budget}
    del old.model["name"]
    assert renewed(old) == now
    assert vars(method_of(old.model)[1]) == vars(method_of(now.model)[1])
    build_run(old)
    assert renewed(now) == now
    for spoiled in ({"model": None}, {"budget": 3, "model": {"warp": 1}, "renderer": {}}, {}):
        assert renewed(OmegaConf.create(spoiled)) == spoiled
