"""Words of earlier versions are answered with those that took their place."""

import re
from pathlib import Path

import pytest

from forewarp.cli.prepare import refuse_renamed_keys
from forewarp.runs.overrides import refuse_renamed
from tests.support.configs import composed


@pytest.mark.parametrize(
    ("word", "now"),
    [
        ("budget=demo,fast", "preset=demo,fast; the choice is called preset since 0.2"),
        ("++budget.inpainter_width=8", "++preset.inpainter_width=8;"),
        ("renderer.step=0.25", "model.renderer.step=0.25;"),
        ("model.warp=backward", "model=backward;"),
        ("experiment=hypernerf_faithful", "experiment=hypernerf preset=faithful;"),
        ("stage=demo", "stage=forward_demo;"),
        ("suits.budgets=[fast]", "no such override;"),
        ("+stage.fine.rates={}", "+stage.fine.lr={};"),
        ("stage.coarse.final_rate=0.1", "stage.coarse.lr_final_factor=0.1;"),
        ("stage.fine.background_voxels=[]", "stage.fine.background_num_voxels=[];"),
        ("model/view=none", "model/view_dependence=none;"),
        ("model.view.width=32", "model.view_dependence.width=32;"),
        ("~suits", "no such override;"),
        ("budget.skip_alpha=0", "preset.alpha_threshold=0; the method's numbers are called preset since 0.2"),
        ("hydra.sweeper.params.stage.fine.rates.flow=1", "hydra.sweeper.params.stage.fine.lr.flow=1;"),
        ("+variant=mine", "+ablation=mine; move your file from variant/ to ablation/"),
        ("variant=base,unet_16", "no such override; type model=forward and the change, as preset.rays=1024;"),
        ("ablation=voxels_20,voxels_40", "no such override; sweeps=resolution has these sizes"),
    ],
)
def test_a_renamed_word_is_refused_with_the_new_one(word, now):
    with pytest.raises(ValueError, match=re.escape(f"{word}: expected {now}")) as refusal:
        refuse_renamed(["data.scene=x", word])
    assert "\n" not in str(refusal.value)


def test_no_sweep_of_today_is():
    assert (
        refuse_renamed(
            [f"sweeps={path.stem}" for path in (Path(__file__).parents[2] / "sweeps").glob("*.yaml")]
        )
        is None
    )


def test_words_of_today_are_not():
    words = ["preset=fast", "budget.minutes=3", "~budget.iterations", "model.renderer.step=1", "--multirun"]
    words += ["stage=forward_demo", "ablation=my_voxels_2", "+variant={name: mine}", "data.background=white"]
    assert refuse_renamed(words) is None


@pytest.mark.parametrize(
    ("typed", "line"),
    [
        ("+preset={skip_alpha: 0.0}", "preset.skip_alpha: expected preset.alpha_threshold;"),
        ("+modules.alone.hold=0", "modules.alone.hold: expected modules.alone.lr_hold;"),
        ("+stage={fine: {voxels: []}}", "stage.fine.voxels: expected stage.fine.num_voxels;"),
        ("+model.view.width=3", "model.view: expected model.view_dependence;"),
    ],
)
def test_keys_of_a_composed_config_are_refused_unless_the_method_is_anothers(typed, line):
    config = composed("model=forward", typed)
    with pytest.raises(ValueError, match=re.escape(line)):
        refuse_renamed_keys(config)
    config.model._target_ = "theirs.methods.Mist"
    assert refuse_renamed_keys(config) is None


@pytest.mark.parametrize("model", ["forward", "backward", "tnerf", "particles"])
def test_no_key_of_today_is_refused(model):
    assert refuse_renamed_keys(composed(f"model={model}")) is None
