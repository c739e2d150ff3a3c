"""From a written scene to its numbers, and everything a user can get wrong on the way."""

import errno
import json
import shutil
from pathlib import Path

import lightning
import pytest
import torch
import yaml

from forewarp.training.stages import Run
from tests.support.commands import TINY
from tests.support.dnerf_scene import write_tiny


@pytest.fixture
def scenes(fitted):
    """The folder with the scene ``vehicle``, 32 x 32 pixels, that the shared run was fitted to."""
    return fitted.parent / "scenes"


@pytest.fixture
def copied(fitted, tmp_path):
    """A copy of the shared run, to be changed."""
    return shutil.copytree(fitted, tmp_path / "copied")


def arguments(root, run, *more, scene="vehicle"):
    """The command line of the shared run, with other words."""
    return ["train", *TINY, f"data.root={root}", f"data.scene={scene}", f"run={run}", *more]


def numbers(folder):
    """What metrics.json holds, but for seconds and the threads, which another test may have set."""
    content = json.loads((Path(folder) / "metrics.json").read_text())
    content.pop("seconds")
    content["protocol"].pop("threads")
    return content


def test_a_run_leaves_what_it_promises(fitted):
    for name in ("config.yaml", "metrics.json", "per_image.json", "coarse/handover.json", "coarse/last.ckpt"):
        assert (fitted / name).is_file()
    assert (fitted / "fine" / "last.ckpt").is_file()
    assert len(list((fitted / "images").glob("test_*/*.png"))) == 5
    assert len(list((fitted / "images" / "sheets").rglob("*.png"))) == 5
    assert not list(fitted.rglob("*.part"))
    for stage in ("coarse", "fine"):
        assert (fitted / stage / "images" / "100_compare.png").is_file()
        assert list((fitted / stage / "tensorboard").glob("events.*"))


def test_metrics_have_the_promised_shape(fitted):
    content = json.loads((fitted / "metrics.json").read_text())
    whole = {"protocol", "seconds", "clocks", "steps", "peak_memory_bytes", "parameters", "size", "effects"}
    whole |= {"test", "flow"}
    assert set(content) == whole
    seconds = content["seconds"]
    assert set(seconds) == {"train", "coarse", "fine", "render_per_frame", "render_again_per_frame"}
    assert seconds["train"] == pytest.approx(seconds["coarse"] + seconds["fine"])
    assert list(content["test"]) == ["space", "time", "canonical"]
    for scores in content["test"].values():
        assert 10 < scores["psnr"] < 60
        assert {"ssim", "depth_delta_1.02"} <= set(scores)
    assert {"epe_moving", "epe_still", "motion_mean"} <= set(content["flow"])
    assert (content["parameters"] > 1000, content["peak_memory_bytes"] > 2**26) == (True, True)
    expected = {"scene": "vehicle", "preset": "demo", "seed": 0, "method": "forward", "scored": "warped"}
    assert expected.items() <= content["protocol"].items()
    assert {"device", "threads", "versions", "background", "resolution"} <= set(content["protocol"])


def test_it_says_what_it_does_and_nothing_else(fitted):
    out, err = (fitted / "said.txt").read_text().split("\n---\n")
    first, second = out.splitlines()[:2]
    assert first == "vehicle: 6 training images (32 x 32) and 5 test images (32 x 32), on the CPU"
    assert second == f"run: {fitted}"
    assert "canonical" in out
    assert "metrics.json" in out
    for noise in ("GPU available", "Tip:", "Warning", "weights_only", "Trainer.fit"):
        assert noise not in out + err
    told = [line.split()[0] for line in err.strip().splitlines()]
    # A slow machine says each more than once.
    assert list(dict.fromkeys(told)) == ["coarse", "fine", "test"]


def test_evaluating_twice_gives_the_same_numbers(ok, fitted, copied, scenes, tmp_path):
    moved = tmp_path / "moved"
    shutil.copytree(scenes, moved)
    done = ok("evaluate", f"run={copied}", f"data.root={moved}")
    assert "canonical" in done.out
    assert numbers(copied) == numbers(fitted)
    ok("evaluate", f"run={copied}", f"data.root={moved}", "reduce=2")
    assert json.loads((copied / "metrics.json").read_text())["protocol"]["reduced"] == 2
    assert numbers(copied) != numbers(fitted)


def test_a_device_that_there_is_not_is_refused_before_a_folder_is_made(
    refused, scenes, tmp_path, monkeypatch
):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    line = refused(*arguments(scenes, tmp_path / "run", "trainer=gpu"))
    assert line == "trainer.accelerator: expected a GPU, but found none; use trainer=cpu"
    assert not (tmp_path / "run").exists()


def test_an_option_that_another_one_removes_is_named(refused):
    line = refused("train", "data=synthetic", "~model/rotation", "model.rotation=true")
    assert line.startswith(
        "model.rotation: expected an option, but got one that another one typed here removes"
    )


def test_metrics_tell_by_which_commit_the_run_was_trained_not_measured(ok, copied, scenes):
    noted = json.loads((copied / "fine" / "done.json").read_text())
    (copied / "fine" / "done.json").write_text(json.dumps(noted | {"commit": "0123abcde"}))
    ok("evaluate", f"run={copied}")
    assert json.loads((copied / "metrics.json").read_text())["protocol"]["commit"] == "0123abcde"


def test_a_gpu_that_is_gone_is_refused_before_a_run_is_measured(refused, copied, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(Run, "load", lambda _: pytest.fail("loaded"))
    assert "trainer.accelerator: expected a GPU" in refused("evaluate", f"run={copied}", "trainer=gpu")


def test_the_same_command_again_trains_nothing(ok, fitted, scenes, monkeypatch):
    def never(*_, **__):
        raise AssertionError("trained again")

    monkeypatch.setattr(lightning.Trainer, "fit", never)
    before, config = numbers(fitted), (fitted / "config.yaml").read_text()
    done = ok(*arguments(scenes, fitted), "threads=2")
    assert numbers(fitted) == before
    assert (fitted / "config.yaml").read_text() == config  # its numbers are not of two threads
    assert done.out.startswith(f"measured before: {fitted}; again with forewarp-evaluate run={fitted}")


def test_what_was_not_measured_since_is_measured_and_where_stages_stand_is_told(ok, fitted, copied, scenes):
    (copied / "metrics.json").unlink()
    (copied / "fine" / "done.json").unlink()
    done = ok(*arguments(scenes, copied))
    lines = done.out.splitlines()
    assert lines[2] == "coarse: finished before"
    assert lines[3].startswith("fine: goes on at 100%, step ")
    assert numbers(copied)["test"] == numbers(fitted)["test"]


def test_a_run_with_views_set_aside_leaves_its_curve(ok, scenes, tmp_path):
    run = tmp_path / "run"
    more = ["data.held_out=2", "callbacks.accuracy.first=0.001", "budget.iterations=4", "evaluate=false"]
    ok(*arguments(scenes, run, *more, "stage.coarse.num_voxels=[[0,500]]", "~stage.fine"))
    assert len((run / "accuracy_time.csv").read_text().splitlines()) > 1
    assert (run / "accuracy_time.png").stat().st_size > 1000
    command = yaml.safe_load((run / "config.yaml").read_text())["command"]
    assert command.startswith("forewarp-train model=forward data=dnerf ")
    assert "data.held_out=2" in command


def test_what_does_not_matter_may_change(forewarp, copied, scenes):
    done = forewarp(*arguments(scenes, copied, "evaluate=false", "checkpoint_seconds=5"))
    assert f"fitted: {copied}; measure it with forewarp-evaluate run={copied}\n" in done.out
    assert yaml.safe_load((copied / "config.yaml").read_text())["checkpoint_seconds"] == 5


def test_another_configuration_is_refused(refused, fitted, scenes):
    line = refused(*arguments(scenes, fitted, "seed=1"))
    line, _, advice = line.partition("; ")
    assert line.endswith("seed: expected 0, as the run that this folder holds, but got 1 (and 1 more keys)")
    assert advice == "use run=<another folder>, or delete this one"
    assert "budget.minutes: expected 0.9, as" in refused(*arguments(scenes, fitted, "budget.minutes=9"))
    assert "model.name: expected forward, as" in refused(*arguments(scenes, fitted, "model=backward"))


def test_a_config_that_lacks_its_data_is_refused(refused, in_tmp):
    Path("config.yaml").write_text("a: 1")
    assert "expected the key data" in refused("evaluate", "run=.")


def test_a_mistaken_scene_ends_in_one_line_and_leaves_nothing(refused, scenes, in_tmp):
    line = refused(*arguments(scenes, "run", scene="lorry"))
    assert line.endswith(f"with transforms_train.json, but got none; scenes in {scenes}: vehicle")
    write_tiny(in_tmp / "tiny")
    Path("tiny/train/r_1.png").unlink()
    line = "train/r_1.png: expected an image, but got No such file"
    assert line in refused(*arguments(in_tmp, "run", scene="tiny"))
    assert not Path("run").exists()


def test_an_unfinished_run_is_not_measured_nor_rendered(refused, copied):
    (copied / "fine" / "done.json").unlink()
    for name in ("evaluate", "render"):
        assert "fine: expected a finished stage, but got none" in refused(name, f"run={copied}")
    assert not (copied / "videos").exists()


def test_a_scene_for_the_folder_of_scenes_is_put_right(refused, scenes, in_tmp):
    line = refused(*arguments(scenes / "vehicle", "run"))
    assert line.endswith(f"but got none; did you mean data.root={scenes} data.scene=vehicle?")


def test_the_folder_of_all_datasets_is_put_right(refused, scenes, in_tmp):
    line = refused(*arguments(scenes.parent, "run"))
    assert line.endswith(f"but got none; did you mean data.root={scenes}?")


def test_a_full_disk_names_the_file_and_leaves_no_half(refused, scenes, in_tmp, monkeypatch):
    def full(self, path, *_, **__):
        Path(path).write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(lightning.Trainer, "save_checkpoint", full)
    line = refused(*arguments(scenes, "run", "budget.iterations=2"))
    assert line.startswith("run/coarse/last.ckpt: expected room to write, but got No space left on device;")
    assert [path.name for path in Path("run/coarse").iterdir() if "ckpt" in path.name] == []


@pytest.mark.parametrize(
    ("word", "least"), [("views=0", 1), ("views=all", 1), ("sheets=-1", 0), ("reduce=1", 2)]
)
def test_numbers_of_views_are_checked_before_training(refused, scenes, in_tmp, word, least):
    line = refused(*arguments(scenes, "run", word))
    assert f"expected a whole number of at least {least}, but got {word.split('=')[1]}" in line


def test_pictures_that_cannot_be_reduced_are_refused_before_training(refused, scenes, in_tmp):
    line = refused(*arguments(scenes, "run", "reduce=7"))
    assert line.startswith("reduce: expected pictures with sides that 7 divides, but got ")
    assert not Path("run").exists()


def test_settings_of_a_failed_start_do_not_bind(refused, ok, scenes, in_tmp):
    assert "model.motion: expected 0 < tau" in refused(*arguments(scenes, "run", "model.motion.tau=7"))
    ok(*arguments(scenes, "run", "budget.iterations=2", "evaluate=false", "~stage.fine"))


def test_renderings_of_an_inpainter_are_both_scored(ok, scenes, in_tmp):
    more = ["model/inpainter=unet3d", "model/upsampler=trilinear", "budget.iterations=2", "sheets=1"]
    ok(*arguments(scenes, "run", *more, "stage.coarse.num_voxels=[[0,500]]", "~stage.fine"))
    content = json.loads(Path("run/metrics.json").read_text())
    assert content["protocol"]["renderings"] == ["upsampled", "inpainted"]
    assert list(content["test"]) == list(content["test_upsampled"])
    assert set(content["seconds"]) == {"train", "coarse", "render_per_frame", "render_again_per_frame"}
