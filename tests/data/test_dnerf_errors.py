"""Bad D-NeRF scenes are refused in one line that names file and key."""

from pathlib import Path

import numpy as np
import pytest

from forewarp.data.dnerf import Shot, read_scene, write_scene
from forewarp.scene.errors import SceneError
from tests.support.dnerf_scene import edit, shots, write_tiny


def frame(**entries):
    return lambda content: content["frames"][1].update(entries)


def without(key):
    return lambda content: content["frames"][1].pop(key)


BAD_TRANSFORMS = {
    "no angle": (lambda c: c.pop("camera_angle_x"), r"camera_angle_x: expected a number .*got None"),
    "angle 0": (lambda c: c.update(camera_angle_x=0), r"camera_angle_x: expected radians inside \(0, pi\)"),
    "angle pi": (lambda c: c.update(camera_angle_x=np.pi), r"camera_angle_x: expected radians inside"),
    "angle 40": (lambda c: c.update(camera_angle_x=40), r"camera_angle_x: expected a number in \[0, 3.1"),
    "no frames": (lambda c: c.pop("frames"), r"frames: expected a list of at least one frame, but got None"),
    "empty split": (lambda c: c.update(frames=[]), r"frames: expected a list of at least one"),
    "frame list": (lambda c: c["frames"].append([1]), r"frames\[4\]: expected an object, but got \[1\]"),
    "no pose": (
        without("transform_matrix"),
        r"frames\[1\].transform_matrix: expected 4 x 4 finite numbers, but got None",
    ),
    "late": (frame(time=1.5), r"frames\[1\].time: expected a number in \[0, 1\], but got 1.5"),
    "no path": (without("file_path"), r"frames\[1\].file_path: expected a path .*got None"),
    "no image": (frame(file_path="./train/r_9"), r"r_9.png: expected an image, but got No such file"),
    "no depth": (frame(depth_file_path="d.npy"), r"frames\[1\].depth_file_path: expected an existing file"),
    "ability": (frame(ability="flight"), r"frames\[1\].ability: expected one of space, time, canonical"),
}


@pytest.mark.parametrize("case", BAD_TRANSFORMS)
def test_bad_transforms_are_one_clear_line(tmp_path, case):
    change, match = BAD_TRANSFORMS[case]
    edit(write_tiny(tmp_path / "toy"), "train", change)
    with pytest.raises(SceneError, match=match) as caught:
        read_scene(tmp_path, "toy")
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def cut(path: Path, keep: float) -> None:
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content)


def other_size(path: Path) -> None:
    write_tiny(path.parents[2] / "other", size=(4, 4))
    path.write_bytes((path.parents[2] / "other" / "train" / path.name).read_bytes())


BAD_IMAGES = {
    "truncated": (lambda p: cut(p, 0.7), "expected a whole image, but got a truncated or harmed one"),
    "harmed": (flip, "expected a whole image, but got a truncated or harmed one"),
    "size": (other_size, "expected 8 x 6 pixels as the first, but got 4 x 4"),
}


@pytest.mark.parametrize("case", BAD_IMAGES)
def test_bad_images_are_found_when_the_scene_is_read(tmp_path, case):
    change, match = BAD_IMAGES[case]
    change(write_tiny(tmp_path / "toy") / "train" / "r_2.png")
    with pytest.raises(SceneError, match=rf"r_2.png: {match}"):
        read_scene(tmp_path, "toy")


@pytest.mark.parametrize(
    ("case", "match"), [("harmed", "harmed one; copy"), ("size", "expected 8 x 6 pixels, but got")]
)
def test_images_that_go_bad_later_are_refused_too(tmp_path, case, match):
    write_tiny(tmp_path / "toy")
    scene = read_scene(tmp_path, "toy")
    BAD_IMAGES[case][0](tmp_path / "toy" / "train" / "r_2.png")
    with pytest.raises(SceneError, match=match):
        scene.train[2].load()


def test_files_that_are_no_transforms(tmp_path):
    path = write_tiny(tmp_path / "toy") / "transforms_train.json"
    for text, match in (
        ('{\n"a": 1,\n}', r"transforms_train.json: line 3: expected JSON, but got"),
        ("[1]", r"expected a JSON object at the top, but got list"),
        ("", r"line 1: expected JSON"),
        (b"\xff\xfe\x00", r"expected JSON, but got"),
    ):
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        with pytest.raises(SceneError, match=match):
            read_scene(tmp_path, "toy")


def test_a_missing_scene_names_those_that_exist(tmp_path):
    write_tiny(tmp_path / "ball")
    write_tiny(tmp_path / "arm")
    (tmp_path / "notes").mkdir()
    with pytest.raises(SceneError, match=r"but got none; scenes in .*: arm, ball$"):
        read_scene(tmp_path, "lego")
    with pytest.raises(SceneError, match=r"data.root: expected an existing folder"):
        read_scene(tmp_path / "nowhere", "lego")


def test_the_test_split_is_one_kind_of_file(tmp_path):
    folder = write_tiny(tmp_path / "toy")
    stock = folder / "transforms_test.json"
    (folder / "transforms_test_space.json").write_text(stock.read_text())
    with pytest.raises(
        SceneError, match=r"transforms_test.json: expected it or one file per ability, but got both"
    ):
        read_scene(tmp_path, "toy")
    stock.unlink()
    assert {f.ability for f in read_scene(tmp_path, "toy").test} == {"space"}
    (folder / "transforms_test_space.json").unlink()
    with pytest.raises(SceneError, match="but got neither"):
        read_scene(tmp_path, "toy")


def test_stray_files_are_ignored(tmp_path):
    folder = write_tiny(tmp_path / "toy")
    (folder / "train" / "transforms.json").write_text("broken")
    (folder / "train" / "r_900.png").write_bytes(b"")
    assert len(read_scene(tmp_path, "toy").train) == 4


BAD_OPTIONS = [
    ({"half_resolution": "yes"}, "data.half_resolution: expected true, false or auto, but got 'yes'"),
    ({"near": 6, "far": 2}, "data.near, data.far: expected near < far, but got 6 and 2"),
    ({"box": [1, 2]}, "data.box: expected six numbers"),
]


@pytest.mark.parametrize(("options", "match"), BAD_OPTIONS)
def test_bad_options(tmp_path, options, match):
    write_tiny(tmp_path / "toy")
    with pytest.raises(SceneError, match=match):
        read_scene(tmp_path, "toy", **options)


def test_odd_sides_cannot_be_halved(tmp_path):
    splits = {"train": shots(1, size=(5, 8)), "test": shots(1, size=(5, 8))}
    write_scene(tmp_path / "toy", splits, camera_angle_x=1)
    with pytest.raises(SceneError, match=r"expected even sides to halve, but got 8 x 5"):
        read_scene(tmp_path, "toy", half_resolution=True)


POSE, PIXELS = np.eye(4), np.zeros((6, 8, 4), np.uint8)
BAD_SPLITS = {
    "split": ({"training": []}, r"splits: expected train, val and test, but got \['training'\]"),
    "twice": ({"train": [Shot("a", 0, POSE, PIXELS)] * 2}, "expected shots of different names"),
    "float": ({"train": [Shot("a", 0, POSE, PIXELS / 1.0)]}, "expected uint8 pixels"),
    "rgb": ({"train": [Shot("a", 0, POSE, PIXELS[..., :3])]}, r"expected rgba \(6, 8\) \+ \(4,\)"),
    "sizes": ({"train": [Shot("a", 0, POSE, PIXELS), Shot("b", 0, POSE, PIXELS[:2])]}, "expected rgba"),
    "time": ({"train": [Shot("a", 2, POSE, PIXELS)]}, r"train/a: time: expected a number in \[0, 1\]"),
    "pose": ({"train": [Shot("a", 0, 2 * POSE, PIXELS)]}, "train/a: pose: expected a rotation"),
    "ability": ({"train": [Shot("a", 0, POSE, PIXELS, ability="time")]}, "in test only"),
    "mixed": ({"test": [Shot("a", 0, POSE, PIXELS), Shot("b", 0, POSE, PIXELS, None, "time")]}, "both kinds"),
    "mixed2": (
        {"test": [Shot("b", 0, POSE, PIXELS, None, "time"), Shot("a", 0, POSE, PIXELS)]},
        "both kinds",
    ),
}


@pytest.mark.parametrize("case", BAD_SPLITS)
def test_the_writer_refuses_what_could_not_be_read(tmp_path, case):
    splits, match = BAD_SPLITS[case]
    with pytest.raises(ValueError, match=match):
        write_scene(tmp_path, splits, camera_angle_x=1)
