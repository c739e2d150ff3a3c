"""From a written scene to its numbers, and everything a user can get wrong on the way."""

import errno
import json
import shutil
from pathlib import Path

import lightning
import pytest
import yaml

from tests.support.commands import TINY
from tests.support.dnerf_scene import edit, write_tiny


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
    whole = {"protocol", "seconds", "steps", "peak_memory_bytes", "parameters", "effects", "test", "flow"}
    assert set(content) == whole
    assert set(content["steps"]) == {"coarse", "fine"}
    frames = {"render_per_frame", "render_again_per_frame"}
    assert set(content["seconds"]) == {"train", "coarse", "fine"} | frames
    assert content["seconds"]["train"] == pytest.approx(
        content["seconds"]["coarse"] + content["seconds"]["fine"]
    )
    assert list(content["test"]) == ["space", "time", "canonical"]
    for scores in content["test"].values():
        assert 10 < scores["psnr"] < 60
        assert {"ssim", "depth_delta_1.02"} <= set(scores)
    assert {"epe_moving", "epe_still", "motion_mean"} <= set(content["flow"])
    assert content["parameters"] > 1000
    assert content["peak_memory_bytes"] > 2**26
    expected = {"scene": "vehicle", "preset": "demo", "seed": 0, "method": "forward", "scored": "warped"}
    assert expected.items() <= content["protocol"].items()
    assert {"device", "threads", "versions", "background", "resolution"} <= set(content["protocol"])


def test_per_image_values_average_to_the_means(fitted):
    rows = json.loads((fitted / "per_image.json").read_text())["images"]
    means = numbers(fitted)["test"]
    for ability, scores in means.items():
        found = [row["scores"]["psnr"] for row in rows if row["ability"] == ability]
        assert scores["psnr"] == pytest.approx(sum(found) / len(found))


def test_it_says_what_it_does_and_nothing_else(fitted):
    out, err = (fitted / "said.txt").read_text().split("\n---\n")
    assert "canonical" in out
    assert "metrics.json" in out
    for noise in ("GPU available", "Tip:", "Warning", "weights_only", "Trainer.fit"):
        assert noise not in out + err
    told = [line.split()[0] for line in err.strip().splitlines()]
    # A slow machine says each more than once.
    assert list(dict.fromkeys(told)) == ["coarse", "fine", "test"]


def test_it_says_first_what_is_trained_where(fitted):
    first, second = (fitted / "said.txt").read_text().splitlines()[:2]
    assert first == "vehicle: 6 training images (32 x 32) and 5 test images (32 x 32), on the CPU"
    assert second == f"run: {fitted}"


def test_evaluating_twice_gives_the_same_numbers(forewarp, fitted, copied, scenes, tmp_path):
    moved = tmp_path / "moved"
    shutil.copytree(scenes, moved)
    done = forewarp("evaluate", f"run={copied}", f"data.root={moved}")
    assert done.status == 0, done.err
    assert "canonical" in done.out
    assert numbers(copied) == numbers(fitted)


def test_the_same_command_again_trains_nothing(forewarp, fitted, scenes, monkeypatch):
    def never(*_, **__):
        raise AssertionError("trained again")

    monkeypatch.setattr(lightning.Trainer, "fit", never)
    before, config = numbers(fitted), (fitted / "config.yaml").read_text()
    done = forewarp(*arguments(scenes, fitted), "threads=2")
    assert done.status == 0, done.err
    assert numbers(fitted) == before
    assert (fitted / "config.yaml").read_text() == config  # its numbers are not of two threads
    assert done.out.startswith(f"measured before: {fitted}; again with forewarp-evaluate run={fitted}")


def test_what_was_not_measured_since_is_measured_and_where_stages_stand_is_told(
    forewarp, fitted, copied, scenes
):
    (copied / "metrics.json").unlink()
    (copied / "fine" / "done.json").unlink()
    done = forewarp(*arguments(scenes, copied))
    assert done.status == 0, done.err
    lines = done.out.splitlines()
    assert lines[2] == "coarse: finished before"
    assert lines[3].startswith("fine: goes on at 100%, step ")
    found, expected = numbers(copied), numbers(fitted)
    assert found["test"] == expected["test"]


def test_a_run_with_views_set_aside_leaves_its_curve(forewarp, scenes, tmp_path):
    run = tmp_path / "run"
    more = ["data.held_out=2", "callbacks.accuracy.first=0.001", "budget.iterations=4", "evaluate=false"]
    done = forewarp(*arguments(scenes, run, *more, "stage.coarse.num_voxels=[[0,500]]", "~stage.fine"))
    assert done.status == 0, done.err
    assert len((run / "accuracy_time.csv").read_text().splitlines()) > 1
    assert (run / "accuracy_time.png").stat().st_size > 1000
    command = yaml.safe_load((run / "config.yaml").read_text())["command"]
    assert command.startswith("forewarp-train data=dnerf ")
    assert "data.held_out=2" in command


def test_what_does_not_matter_may_change(forewarp, copied, scenes):
    done = forewarp(*arguments(scenes, copied, "evaluate=false", "checkpoint_seconds=5"))
    assert f"fitted: {copied}; measure it with forewarp-evaluate run={copied}\n" in done.out
    assert yaml.safe_load((copied / "config.yaml").read_text())["checkpoint_seconds"] == 5


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            "seed=1",
            "config.yaml: seed: expected 0, as the run that this folder holds, but got 1 (and 1 more keys); "
            "use run=<another folder>, or delete this one",
        ),
        (
            "budget.minutes=9",
            "config.yaml: budget.minutes: expected 0.9, as the run that this folder holds, but got 9; use",
        ),
        ("model/view_dependence=sh", "config.yaml: model.view_dependence: expected "),
    ],
)
def test_another_configuration_is_refused(refused, fitted, scenes, change, line):
    assert line in refused(*arguments(scenes, fitted, change))


def test_another_dataset_is_refused_by_its_scene(refused, fitted, scenes, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(scenes / "vehicle", other / "lorry")
    words = arguments(other, fitted, scene="lorry")
    line = refused(*["data=synthetic" if word == "data=dnerf" else word for word in words])
    assert "data.scene: expected vehicle, as the run that this folder holds, but got lorry" in line


def test_a_checkpoint_of_another_configuration_is_refused(refused, copied):
    saved = yaml.safe_load((copied / "config.yaml").read_text())
    saved["model"]["view_dependence"] = {
        "_target_": "forewarp.methods.voxel.effects.view_dependence.SphericalHarmonics",
        "_partial_": True,
    }
    (copied / "config.yaml").write_text(yaml.safe_dump(saved))
    line = refused("evaluate", f"run={copied}")
    assert "last.ckpt: expected a checkpoint of this configuration, but got one that differs in" in line


def test_a_corrupt_checkpoint_is_named(refused, copied):
    (copied / "fine" / "last.ckpt").write_bytes(b"nonsense")
    line = refused("evaluate", f"run={copied}")
    assert "last.ckpt: expected a checkpoint, but it cannot be read" in line


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (None, "expected the configuration of a run, but got none"),
        ("[", "expected YAML"),
        ("a: 1", "expected the key data"),
    ],
)
def test_a_folder_that_is_no_run(refused, tmp_path, content, line):
    if content is not None:
        (tmp_path / "config.yaml").write_text(content)
    assert line in refused("evaluate", f"run={tmp_path}")


def test_an_unfinished_run_is_not_measured_nor_rendered(refused, copied):
    (copied / "fine" / "done.json").unlink()
    for name in ("evaluate", "render"):
        assert "fine: expected a finished stage, but got none" in refused(name, f"run={copied}")
    assert not (copied / "videos").exists()


def test_no_run_is_named(refused):
    assert refused("evaluate").startswith("run: expected the folder of a run, but got nothing")


def spoil_image(folder):
    (folder / "train" / "r_1.png").write_bytes((folder / "train" / "r_1.png").read_bytes()[:60])


def drop_matrix(content):
    content["frames"][2].pop("transform_matrix")


SPOILED = [
    (lambda f: (f / "train" / "r_1.png").unlink(), "train/r_1.png: expected an image, but got No such file"),
    (spoil_image, "train/r_1.png: expected a whole image, but got a truncated or harmed one"),
    (lambda f: (f / "transforms_train.json").write_text("{"), "transforms_train.json: line 1: expected JSON"),
    (
        lambda f: edit(f, "train", drop_matrix),
        "transforms_train.json: frames[2].transform_matrix: expected 4 x 4",
    ),
    (
        lambda f: shutil.copy(f.parent / "big" / "train" / "r_1.png", f / "train"),
        "expected 8 x 6 pixels as the first",
    ),
    (
        lambda f: edit(f, "train", lambda c: c["frames"][0].update(time=1.5)),
        "frames[0].time: expected a number in [0, 1]",
    ),
    (
        lambda f: edit(f, "test", lambda c: c.update(frames=[])),
        "transforms_test.json: frames: expected a list of at least",
    ),
]


@pytest.mark.parametrize(("spoil", "line"), SPOILED)
def test_bad_data_end_in_one_line_and_leave_nothing(refused, in_tmp, spoil, line):
    write_tiny(in_tmp / "scenes" / "big", size=(8, 8))
    spoil(write_tiny(in_tmp / "scenes" / "small"))
    assert line in refused(*arguments("scenes", "run", scene="small"))
    assert not Path("run").exists()


def test_an_unknown_scene_lists_the_known(refused, scenes, in_tmp):
    line = refused(*arguments(scenes, "run", scene="lorry"))
    assert line.endswith(
        f"expected a scene with transforms_train.json, but got none; scenes in {scenes}: vehicle"
    )


def test_a_scene_for_the_folder_of_scenes_is_put_right(refused, scenes, in_tmp):
    line = refused(*arguments(scenes / "vehicle", "run"))
    assert line.endswith(f"but got none; did you mean data.root={scenes} data.scene=vehicle?")


def test_a_missing_folder(refused, in_tmp):
    assert "data.root: expected an existing folder" in refused(*arguments("nowhere", "run"))


def test_a_run_folder_that_cannot_be(refused, scenes, in_tmp):
    Path("file").write_text("")
    line = refused(*arguments(scenes, "file/run"))
    assert line.startswith("run: file/run: expected a usable file or folder, but got Not a directory")


def test_a_full_disk_names_the_file_and_leaves_no_half(refused, scenes, in_tmp, monkeypatch):
    def full(self, path, *_, **__):
        Path(path).write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(lightning.Trainer, "save_checkpoint", full)
    line = refused(*arguments(scenes, "run", "budget.iterations=2"))
    assert line.startswith(
        "run/coarse/last.ckpt: expected room to write, but got No space left on device; free some"
    )
    assert [path.name for path in Path("run/coarse").iterdir() if "ckpt" in path.name] == []


def test_settings_of_a_failed_start_do_not_bind(refused, forewarp, scenes, in_tmp):
    assert "model.motion: expected 0 < tau" in refused(*arguments(scenes, "run", "model.motion.tau=7"))
    done = forewarp(*arguments(scenes, "run", "budget.iterations=2", "evaluate=false", "~stage.fine"))
    assert done.status == 0, done.err


def test_renderings_of_an_inpainter_are_both_scored(forewarp, scenes, in_tmp):
    more = ["model/inpainter=unet3d", "model/upsampler=trilinear", "budget.iterations=2", "sheets=1"]
    done = forewarp(*arguments(scenes, "run", *more, "stage.coarse.num_voxels=[[0,500]]", "~stage.fine"))
    assert done.status == 0, done.err
    content = json.loads(Path("run/metrics.json").read_text())
    assert content["protocol"]["renderings"] == ["upsampled", "inpainted"]
    assert list(content["test"]) == list(content["test_upsampled"])
    assert set(content["seconds"]) == {"train", "coarse", "render_per_frame", "render_again_per_frame"}
