"""What of the paper's datasets is in a folder: complete, as published, or what lacks."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml

from forewarp.data.images import write_image
from forewarp.data.published import (
    ABSENT,
    AS_PUBLISHED,
    COMPLETE,
    DATASETS,
    INCOMPLETE,
    Blender,
    digest_of,
)
from tests.support.configs import ROOT
from tests.support.written_scenes import edit, real, write_dnerf, write_dome, write_rig

DNERF, HYPERNERF, NHR, LEGO = DATASETS
POSES = [f"transforms_{split}.json" for split in ("train", "val", "test")]


def found(dataset, root, wanted):
    return next(replace(dataset, scenes={"scene": wanted}).found(root))


@pytest.fixture
def dnerf(tmp_path):
    """The folder of a scene, and what is published of it."""
    folder = write_dnerf(tmp_path / "dnerf" / "scene")
    names = [path.relative_to(folder).as_posix() for path in folder.rglob("*.png")]
    counts = {
        split: sum(name.startswith(f"{split}/") for name in names) for split in ("train", "val", "test")
    }
    digests = digest_of(folder, POSES), digest_of(folder, [*POSES, *names])
    return folder, Blender(counts, *digests, (8, 6))


def test_the_very_files_are_as_published(tmp_path, dnerf):
    made = found(DNERF, tmp_path, dnerf[1])
    assert (made.state, made.is_complete) == (AS_PUBLISHED, True)
    assert made.words.endswith("images of 8 x 6, every byte")


@pytest.mark.parametrize(
    ("place", "root", "says"),
    [
        ("dnerf/data/scene", ".", "found in dnerf/data/scene: move it to dnerf/scene"),
        ("data/scene", ".", "found in data/scene: move it to dnerf/scene"),
        ("dnerf/scene/scene", ".", "found in dnerf/scene/scene: move it to dnerf/scene"),
        ("dnerf/scene", "dnerf", "found in {0}/dnerf/scene: check the folder above, {0}"),
    ],
)
def test_what_lies_elsewhere_is_found(tmp_path, dnerf, place, root, says):
    shutil.move(dnerf[0], tmp_path / "moved")
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    shutil.move(tmp_path / "moved", tmp_path / place)
    made = found(DNERF, tmp_path / root, dnerf[1])
    assert (made.state, made.words) == (ABSENT, says.format(tmp_path))


def test_a_scene_of_another_dataset_with_the_same_name_is_not_taken_for_it(tmp_path, dnerf):
    shutil.move(dnerf[0], tmp_path / "blender" / "scene")
    fewer(tmp_path / "blender" / "scene")
    assert found(DNERF, tmp_path, dnerf[1]).words == ""


def another_image(folder):
    write_image(folder / "train" / "r_0.png", np.zeros((6, 8, 4), np.uint8))


def another_size(folder):
    for path in folder.rglob("*.png"):
        write_image(path, np.zeros((3, 4, 4), np.uint8))


def another_pose(folder):
    edit(folder / "transforms_train.json", lambda content: content.update(note=1))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (another_image, "poses are the published ones, some images are not"),
        (another_size, "of 4 x 3; poses are the published ones, images half as large, as the protocol"),
        (another_pose, "transforms_*.json are not the published ones"),
    ],
)
def test_what_differs_but_is_whole_is_complete(tmp_path, dnerf, change, says):
    change(dnerf[0])
    made = found(DNERF, tmp_path, dnerf[1])
    assert made.state == COMPLETE
    assert says in made.words


def without_image(folder):
    (folder / "train" / "r_1.png").unlink()


def torn_image(folder):
    (folder / "val" / "r_0.png").write_bytes(b"\x89PNG")


def fewer(folder):
    edit(folder / "transforms_test.json", lambda content: content["frames"].pop())


def without_poses(folder):
    (folder / "transforms_train.json").unlink()


def torn_poses(folder):
    (folder / "transforms_val.json").write_text("{")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (without_image, "1 missing, the first train/r_1.png; get it again"),
        (torn_image, "val/r_0.png: expected a PNG or JPEG, but got another file"),
        (fewer, "transforms_test.json: frames: expected "),
        (torn_poses, "transforms_val.json: line 1: expected JSON"),
        (without_poses, "transforms_train.json: expected a readable"),
    ],
)
def test_what_lacks_is_named(tmp_path, dnerf, change, says):
    change(dnerf[0])
    made = found(DNERF, tmp_path, dnerf[1])
    assert (made.state, made.is_complete) == (INCOMPLETE, False)
    assert says in made.words


def test_captures_of_two_phones_are_counted_and_lack_by_name(tmp_path):
    folder = write_rig(tmp_path / "hypernerf" / "scene")
    count = len(list((folder / "camera").iterdir()))
    for wanted, told in ((count, ""), (count // 2, ""), (99, "; the authors' table counts 99")):
        made = found(HYPERNERF, tmp_path, wanted)
        assert (made.state, made.words) == (COMPLETE, f"{count} images of 6 x 4 (rgb/2x){told}")
    shutil.rmtree(folder / "rgb" / "2x")
    assert f"{count} missing, the first rgb/2x/" in found(HYPERNERF, tmp_path, count).words
    (folder / "scene.json").unlink()
    assert "scene.json: expected a readable file" in found(HYPERNERF, tmp_path, count).words


def test_a_dome_needs_all_images_masks_and_clouds(tmp_path):
    folder = write_dome(tmp_path / "nhr" / "scene", count=3)
    made = found(NHR, tmp_path, 3)
    assert (made.state, made.words) == (COMPLETE, "3 frames of 4 cameras, images of 48 x 60 and 60 x 48")
    assert "expected 4 frames, numbered folders, but got 3" in found(NHR, tmp_path, 4).words
    (folder / "pointclouds" / "frame2.npy").unlink()
    assert "1 missing, the first pointclouds/frame2.npy" in found(NHR, tmp_path, 3).words
    (folder / "img" / "1" / "mask" / "img_0002.jpg").unlink()
    assert "1 missing, the first img/1/mask/img_0002.jpg" in found(NHR, tmp_path, 3).words


@pytest.mark.parametrize("dataset", DATASETS, ids=lambda dataset: dataset.folder)
def test_the_scenes_are_those_of_the_tables(dataset):
    sweep = yaml.safe_load((ROOT / "sweeps" / f"{dataset.folder}.yaml").read_text())
    words = [words.split() for words in sweep["hydra"]["sweeper"]["scenes"]]
    assert {word for pair in words for word in pair} == {
        f"experiment={dataset.folder}",
        *(f"data.scene={scene}" for scene in dataset.scenes),
    }


def test_digests_are_those_of_the_released_files():
    folder = real("dnerf_800/hellwarrior")
    names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    assert digest_of(folder, names) == DNERF.scenes["hellwarrior"].everything
    assert DNERF.check(folder, DNERF.scenes["hellwarrior"])[0] == AS_PUBLISHED
    half = real("dnerf")
    for scene in ("bouncingballs", "hook", "jumpingjacks", "lego", "mutant"):
        assert digest_of(half / scene, POSES) == DNERF.scenes[scene].poses
