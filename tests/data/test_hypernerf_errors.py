"""Bad HyperNeRF captures are refused in one line that names file and key."""

from dataclasses import replace

import numpy as np
import pytest

from forewarp.data.hypernerf import read_scene
from forewarp.data.images import write_png
from forewarp.scene.errors import SceneError
from forewarp.scene.lens import Lens
from tests.support.rig_scene import edit, hand, rig, truth, write_rig

CAMERA = "camera/left1_000000"
ITEM = "left1_000001"


def put(**entries):
    return lambda content: content.update(entries)


def without(key):
    return lambda content: content.pop(key)


def entry(**values):
    return lambda content: content[ITEM].update(values)


TWICE = [[1, 0, 0], [0, 2, 0], [0, 0, 1]]
BAD_JSON = {
    "no orientation": (CAMERA, without("orientation"), r"orientation: expected 3 x 3 numbers, but got None"),
    "2 x 3": (CAMERA, put(orientation=TWICE[:2]), "orientation: expected 3 x 3 numbers"),
    "words": (CAMERA, put(orientation=[["a"] * 3] * 3), "orientation: expected a number, but got 'a'"),
    "scaled": (CAMERA, put(orientation=TWICE), "orientation: expected a rotation, but got determinant 2"),
    "position": (CAMERA, put(position=[1, 2]), r"position: expected 3 numbers, but got \[1, 2\]"),
    "focal": (CAMERA, put(focal_length=0), "focal_length: expected a number in"),
    "aspect": (CAMERA, put(pixel_aspect_ratio=0), "pixel_aspect_ratio: expected a number in"),
    "skew": (CAMERA, put(skew="none"), "skew: expected a number .*got 'none'"),
    "principal": (CAMERA, put(principal_point=[4]), "principal_point: expected 2 numbers"),
    "radial": (CAMERA, put(radial_distortion=[0.1, 0.2]), "radial_distortion: expected 3 numbers"),
    "old": (CAMERA, put(tangential=[0.1]), "tangential: expected 2 numbers"),
    "lens": (CAMERA, put(radial_distortion=[-30.0, 0, 0]), "expected a lens that can be undone"),
    "size": (CAMERA, put(image_size=[12]), "image_size: expected 2 numbers"),
    "part of a pixel": (CAMERA, put(image_size=[12.5, 8]), "image_size: expected whole numbers"),
    "no size": (CAMERA, put(image_size=[0, 8]), r"image_size\[0\]: expected a number in \[1"),
    "other size": (
        CAMERA,
        put(image_size=[24, 8]),
        r"png: expected 12 x 4 pixels, the camera's .* got 6 x 4",
    ),
    "no scale": ("scene", without("scale"), "scene.json: scale: expected a number .*got None"),
    "scale 0": ("scene", put(scale=0), "scene.json: scale: expected a number in"),
    "center": ("scene", put(center=[0, 0]), "scene.json: center: expected 3 numbers"),
    "near": ("scene", put(near=-1), "scene.json: near: expected a number in"),
    "near and far": ("scene", put(near=9), "scene.json: near, far: expected near < far, but got 9 and 1.4"),
    "no ids": ("dataset", without("ids"), "train_ids: expected items of ids"),
    "ids": ("dataset", put(ids=5), "ids: expected a list of different names, but got 5"),
    "twice": ("dataset", lambda c: c["ids"].append(ITEM), "ids: expected a list of different names"),
    "train": ("dataset", put(train_ids=["x"]), "train_ids: expected items of ids, but got 'x'"),
    "val": ("dataset", put(val_ids=["left1_9"]), "val_ids: expected items of ids, but got 'left1_9'"),
    "both": ("dataset", put(val_ids=["left1_000000"]), "val_ids: expected none of train_ids, but got 'left1"),
    "no train": ("dataset", put(train_ids=[]), "train_ids: expected at least one beside val_ids"),
    "few": (
        "dataset",
        put(ids=["left1_000000"], train_ids=[], val_ids=[]),
        "ids: expected more than 4 items",
    ),
    "path": ("dataset", lambda c: c["ids"].append("../x") or c["val_ids"].append("../x"), "'../x'"),
    "no camera": ("dataset", lambda c: c["ids"].append("y") or c["val_ids"].append("y"), "'y'"),
    "no item": ("metadata", without(ITEM), "metadata.json: 'left1_000001': expected an object .*got None"),
    "no time": ("metadata", lambda c: c[ITEM].pop("time_id"), r"'left1_000001'.time_id: expected a number"),
    "no times": (
        "metadata",
        lambda c: [e.pop(k) for e in c.values() for k in ("time_id", "warp_id")],
        r"'left1_000000'.warp_id: expected a number .*got None",
    ),
    "half a time": ("metadata", entry(time_id=0.5), "time_id: expected a whole number, but got 0.5"),
    "before": ("metadata", entry(time_id=-1), r"time_id: expected a number in \[0"),
}


@pytest.mark.parametrize("case", BAD_JSON)
def test_bad_files_are_one_clear_line(tmp_path, case):
    name, change, match = BAD_JSON[case]
    edit(write_rig(tmp_path / "toy"), name, change)
    with pytest.raises(SceneError, match=match) as caught:
        read_scene(tmp_path, "toy")
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_a_name_with_a_line_break_stays_one_line(tmp_path):
    folder = write_rig(tmp_path / "toy")
    edit(folder, "dataset", lambda c: c["ids"].append("a\nb"))
    with pytest.raises(SceneError, match=r"'a\\nb': expected an object") as caught:
        read_scene(tmp_path, "toy")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "match"),
    [
        (f"{CAMERA}.json", r"left1_000000.json: expected a readable file, but got No such file"),
        ("rgb/2x/left1_000000.png", r"left1_000000.png: expected an image, but got No such file"),
        ("scene.json", r"scene.json: expected a readable file"),
        ("metadata.json", r"metadata.json: expected a readable file"),
        ("dataset.json", r"expected a scene with dataset.json, but got none; scenes in .*: other$"),
    ],
)
def test_missing_files(tmp_path, name, match):
    write_rig(tmp_path / "other", rig(times=1))
    (write_rig(tmp_path / "toy") / name).unlink()
    with pytest.raises(SceneError, match=match):
        read_scene(tmp_path, "toy")


def test_a_missing_scale_names_those_that_exist(tmp_path):
    write_rig(tmp_path / "toy", hand(5), scales=(1, 2, 4))
    with pytest.raises(SceneError, match=r"8x: expected a folder of images.* set data.scale .*: 1x, 2x, 4x$"):
        read_scene(tmp_path, "toy", scale=8)


def test_bad_scales(tmp_path):
    write_rig(tmp_path / "toy", hand(5))
    with pytest.raises(SceneError, match=r"data.scale: expected a whole number of at least 1, but got 0"):
        read_scene(tmp_path, "toy", scale=0)


@pytest.mark.parametrize(
    ("points", "match"),
    [
        (np.zeros((4, 2)), r"points.npy: expected points \(N, 3\), but got shape \(4, 2\)"),
        (np.zeros(3), r"points.npy: expected points \(N, 3\)"),
        (np.zeros((0, 3)), r"points.npy: expected points \(N, 3\)"),
        (np.full((2, 3), np.nan), r"points.npy: expected finite numbers"),
        (np.full((2, 3), 1e30), r"points.npy: expected points within 1e"),
    ],
)
def test_bad_points(tmp_path, points, match):
    write_rig(tmp_path / "toy", points=points)
    with pytest.raises(SceneError, match=match):
        read_scene(tmp_path, "toy")


def test_points_that_are_no_array(tmp_path):
    (write_rig(tmp_path / "toy") / "points.npy").write_bytes(b"version https://git-lfs")
    with pytest.raises(SceneError, match=r"points.npy: expected a NumPy file"):
        read_scene(tmp_path, "toy")


def test_trajectories_that_begin_elsewhere(tmp_path):
    write_rig(tmp_path / "toy", trajectories=truth(canonical=0.25))
    with pytest.raises(SceneError, match=r"begin at the canonical time 0.5"):
        read_scene(tmp_path, "toy")


def test_an_image_of_another_size(tmp_path):
    folder = write_rig(tmp_path / "toy")
    write_png(folder / "rgb" / "2x" / f"{ITEM}.png", np.zeros((5, 6, 3), np.uint8))
    with pytest.raises(SceneError, match=rf"{ITEM}.png: expected 6 x 4 pixels, the camera's image_size / 2"):
        read_scene(tmp_path, "toy")


def test_bad_boxes(tmp_path):
    write_rig(tmp_path / "toy")
    with pytest.raises(SceneError, match="data.box: expected six numbers"):
        read_scene(tmp_path, "toy", box=[1, 2])


FIRST, *_ = rig()
BAD_SHOTS = {
    "twice": ([FIRST, FIRST], "shots: expected different names"),
    "split": (
        [replace(FIRST, split="test")],
        "each of train, val or '', but got 'left1_000000' of split 'test'",
    ),
    "float": ([replace(FIRST, rgb=FIRST.rgb / 255)], "left1_000000: expected uint8"),
    "alpha": ([replace(FIRST, rgb=np.zeros((8, 12, 4), np.uint8))], r"expected uint8 \(8, 12, 3\)"),
    "odd": (rig(size=(11, 8)), r"multiples of \(1, 2\)"),
}


@pytest.mark.parametrize("case", BAD_SHOTS)
def test_the_writer_refuses_what_could_not_be_read(tmp_path, case):
    shots, match = BAD_SHOTS[case]
    with pytest.raises(ValueError, match=match):
        write_rig(tmp_path / "toy", shots)


def test_a_lens_that_nothing_passes(tmp_path):
    write_rig(tmp_path / "toy", rig(lens=Lens((-30.0, 0.0, 0.0))))
    with pytest.raises(SceneError, match=r"radial_distortion: expected a lens that can be undone"):
        read_scene(tmp_path, "toy")
