"""What a command is refused for before anything heavy is loaded."""

import re
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf

from forewarp.cli.prepare import (
    READ,
    refuse_missing_scene,
    refuse_numbers,
    refuse_target_without_curve,
    refuse_unwatched,
)
from forewarp.data import module as data_module
from forewarp.data.files import LAYOUTS, SceneError
from forewarp.training.stopping import StopRule


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("views", 0, "a whole number of at least 1, but got 0"),
        ("views", "all", "a whole number of at least 1, but got 'all'"),
        ("sheets", -1, "a whole number of at least 0, but got -1"),
        ("sheets", None, "a whole number of at least 0, but got None"),
        ("reduce", 1, "a whole number of at least 2, but got 1"),
        ("fps", 0, "a number in [0.1, 1000], but got 0"),
        ("time", "soon", "a number in [0, 1], but got 'soon'"),
        *(("views", value, None) for value in (None, 3)),
        ("time", 0.5, None),
        ("absent", 1, None),
    ],
)
def test_numbers_are_in_their_range(key, value, says):
    config = OmegaConf.create({key: value} if key != "absent" else {})
    if says is None:
        refuse_numbers(config, "views", "time")
    else:
        with pytest.raises(ValueError, match=re.escape(f"{key}: expected {says}")):
            refuse_numbers(config, key)


def test_a_mistyped_scene_is_put_right(tmp_path):
    (tmp_path / "dnerf" / "hook").mkdir(parents=True)
    (tmp_path / "dnerf" / "hook" / "transforms_train.json").touch()
    dnerf = tmp_path / "dnerf"
    for root, advice in (
        (dnerf, f"scenes in {dnerf}: hook"),
        (dnerf / "hook", f"did you mean data.root={dnerf} data.scene=hook?"),
        (tmp_path, f"did you mean data.root={dnerf}?"),
    ):
        scene = "hook" if root == tmp_path else "lorry" if root == dnerf else "vehicle"
        data = {"_target_": "forewarp.data.module.DNeRFDataModule", "root": str(root), "scene": scene}
        with pytest.raises(ValueError) as refusal:  # noqa: PT011
            refuse_missing_scene(OmegaConf.create({"data": data}))
        assert str(refusal.value).endswith(f"with transforms_train.json, but got none; {advice}")
        refuse_missing_scene(OmegaConf.create({"data": data, "absent": "skip"}))


@pytest.mark.parametrize("name", READ)
def test_a_scene_is_told_by_the_file_that_its_reader_asks_for(name, tmp_path):
    marker, _ = LAYOUTS[READ[name]]
    datamodule = getattr(data_module, name)(tmp_path, "toy")
    with pytest.raises(SceneError, match=re.escape(f"toy: expected a scene with {marker}, but got none")):
        datamodule.setup("fit")


def test_every_module_that_reads_a_folder_has_a_layout():
    modules = (each for each in vars(data_module).values() if hasattr(each, "_reader"))
    assert {each.__name__ for each in modules} == {*READ}


def test_a_target_needs_the_curve_that_it_is_read_from():
    config = OmegaConf.create({"target": {"psnr": None, "plateau": 1.0}, "callbacks": {"accuracy": {}}})
    refuse_target_without_curve(config)
    config.callbacks.accuracy = None
    with pytest.raises(ValueError, match="^callbacks.accuracy: expected the curve that a target"):
        refuse_target_without_curve(config)
    config.target.plateau = None
    refuse_target_without_curve(config)


def test_a_target_needs_views_that_are_not_trained_on():
    def run_of(count, **target):
        data = SimpleNamespace(watched=lambda: range(count))
        return SimpleNamespace(target=StopRule(**target), datamodule=data)

    refuse_unwatched(run_of(0))
    refuse_unwatched(run_of(1, psnr=30))
    with pytest.raises(
        ValueError, match="^target: expected views that are .*, but got none; set data.held_out=8$"
    ):
        refuse_unwatched(run_of(0, plateau=1))
