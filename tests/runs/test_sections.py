"""Sections of files are options of Hydra's groups: ours, and those of a folder of one's own."""

from unittest.mock import Mock

import pytest
from hydra.core.config_store import ConfigStore
from hydra.core.object_type import ObjectType
from hydra.errors import ConfigCompositionException

from forewarp.runs import sections
from forewarp.runs.sections import FileConfigSource, option_groups
from tests.support.configs import CONF, composed

MINE = {
    "model/mine.yaml": "name: mine\n_target_: mine.Method\nwidth: ${preset.width}\n",
    "numbers/mine_fast.yaml": """
stage: {only: {share: 1.0}}
preset: {rays: 7, background: white, width: 32}
exceptions:
  dnerf: {preset: {width: 48}}
scenes:
  specimen_still: {preset: {width: 64}}
""",
    "numbers/mine_faithful.yaml": """
defaults: [mine_fast, _self_]
stage: {only: {lr: 0.1}, more: {share: 0.5}}
preset: {rays: 9}
exceptions:
  dnerf: {seed: 5}
""",
    "numbers/particles.yaml": "exceptions: {dnerf: {seed: 5}, mine: {seed: 7}}",
    "options.yaml": """
# @package _global_
experiment: {mine: {defaults: [override /data: nhr]}}
capture: {mine: {capture: mine}}
""",
}


@pytest.fixture
def folder(tmp_path):
    for name, text in MINE.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text.lstrip())
    return tmp_path


@pytest.mark.slow
def test_a_folder_brings_a_method_and_its_numbers(folder):
    def mine(*words):
        return composed(f"hydra.searchpath=[file://{folder}]", "model=mine", "data.scene=x", *words)

    plain = mine()
    assert plain.model == {"name": "mine", "_target_": "mine.Method", "width": 32}
    assert plain.run == "runs/x/mine-fast-seed0"
    assert (plain.stage, "objective" in plain, plain.data.rays) == ({"only": {"share": 1.0}}, False, 7)
    assert mine("experiment=dnerf").model.width == 48
    assert mine("scene=specimen_still", "preset=fast").model.width == 64
    assert mine("capture=mine").capture == "mine"
    derived = mine("experiment=dnerf", "preset=faithful")
    assert derived.stage == {"only": {"share": 1.0, "lr": 0.1}, "more": {"share": 0.5}}
    assert (derived.seed, derived.model.width, derived.data.rays) == (5, 48, 9)
    with pytest.raises(ConfigCompositionException, match="Could not find 'stage/mine_demo'"):
        mine("preset=demo")


@pytest.mark.slow
def test_a_folder_has_exceptions_of_our_methods_for_its_data(folder):
    words = [f"hydra.searchpath=[file://{folder}]", "data.scene=x"]
    config = composed(*words, "experiment=mine")
    assert (config.seed, config.data.frames, config.preset.background) == (7, 100, "random")
    assert composed(*words, "experiment=dnerf").seed == 0  # where both have one, ours


def test_options_are_listed_beside_files():
    groups = option_groups(CONF)
    assert groups["trainer"] == ["auto", "cpu", "gpu"]
    assert groups["model/motion"] == ["cosines", "dct", "dct_features", "none", "spline"]
    assert "options" not in groups["model"]
    assert {"forward_fast", "particles", "particles_after_forward"} <= set(groups["stage"])
    assert "particles_faithful" in groups["stage"]  # by its defaults
    assert "particles_after_forward" not in groups["objective"]
    source = FileConfigSource("test", str(CONF))
    assert "one" in source.list("stage", ObjectType.GROUP)
    assert "one" not in source.list("stage", ObjectType.CONFIG)


@pytest.mark.slow
def test_a_plain_value_is_that_of_the_groups_key():
    config = composed("model/rotation=none", "model/color_over_time=cosines")
    assert (config.model.rotation, config.model.color_over_time) == (None, 2)


def test_a_sweep_is_stored_again_only_if_its_file_has_changed(tmp_path, monkeypatch):
    store = Mock()
    monkeypatch.setattr(ConfigStore, "instance", lambda: store)
    monkeypatch.setattr(sections, "_stored", {})
    for seed, count in ((1, 1), (1, 1), (2, 2), (1, 3)):
        (tmp_path / "mine.yaml").write_text(f"seed: {seed}\n")
        sections.serve(tmp_path)
        assert store.store.call_count == count
        assert store.store.call_args.args == ("mine", {"seed": seed}, "sweeps", "_global_")
