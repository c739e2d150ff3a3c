"""Bad captures are refused in one line that names file and key."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from forewarp.data.images import write_png
from forewarp.data.posed_video import PosedShot, read_scene, write_scene
from forewarp.scene.camera import look_at
from forewarp.scene.errors import SceneError
from tests.support.posed_scene import MIDDLE, UP, cameras, edit, shots, write_tiny


def frame(**entries):
    return lambda content: content["frames"][1].update(entries)


def top(**entries):
    return lambda content: content.update(entries)


def without(key):
    return lambda content: content["frames"][1].pop(key)


BAD = {
    "no frames": (lambda c: c.pop("frames"), r"frames: expected a list of at least one frame, but got None"),
    "empty": (top(frames=[]), r"frames: expected a list of at least one"),
    "word": (lambda c: c["frames"].append("x"), r"frames\[10\]: expected an object, but got 'x'"),
    "one": (lambda c: c.update(frames=c["frames"][:1]), r"expected a frame to test on, but got none of 1"),
    "no pose": (without("transform_matrix"), r"frames\[1\].transform_matrix: expected 4 x 4 finite .*None"),
    "no path": (without("file_path"), r"frames\[1\].file_path: expected a path .*got None"),
    "no image": (frame(file_path="images/x.png"), r"x.png: expected an image, but got No such file"),
    "no jpeg": (frame(file_path="images/x.jpg"), r"x.jpg: expected an image, but got No such file"),
    "no suffix": (frame(file_path="images/x"), r"file_path: expected an image, PNG or JPEG, but got no"),
    "long": (frame(file_path="x" * 999), r"file_path: expected an image, PNG or JPEG, but got no"),
    "twice": (frame(file_path="./images/frame_1.png"), r"expected each image once, but got images/frame_1"),
    "no mask": (frame(mask_path="m.png"), r"m.png: expected an image, but got No such file"),
    "one mask": (
        frame(mask_path="images/frame_1.png"),
        r"mask_path: expected one in all frames or in none.*1 of",
    ),
    "mask number": (frame(mask_path=3), r"frames\[1\].mask_path: expected a path"),
    "one time": (
        frame(time=0.5),
        r"frames: time: expected one in all frames or in none, but got 1 of 10 and",
    ),
    "late": (frame(time=3), r"frames\[1\].time: expected a number in \[0, 1\], but got 3"),
    "no focal": (lambda c: c.pop("fl_x"), r"frames\[0\].fl_x: expected a number in .*got None"),
    "focal 0": (top(fl_x=0), r"json: fl_x: expected a number in \[0.3, 3000\], but got 0"),
    "own focal": (frame(fl_x=-30), r"frames\[1\].fl_x: expected a number in .*got -30"),
    "far centre": (top(cx=3000), r"json: cx: expected a number in \[-30, 60\], but got 3000"),
    "size": (top(w=60), r"frame_1.png: expected 60 x 20 pixels as .*json: w and h say, but got 30 x 20"),
    "own size": (frame(h=10), r"frame_2.png: expected 30 x 10 pixels"),
    "fisheye": (top(camera_model="OPENCV_FISHEYE"), r"json: camera_model: expected one of OPENCV, .*FISHEYE"),
    "own model": (frame(camera_model=["x"]), r"frames\[1\].camera_model: expected one of OPENCV"),
    "k4": (top(k4=0.1), r"json: k4: expected 0, but got 0.1; undistort the images"),
    "fold": (top(k1=-40.0), r"json: k1: expected a lens that can be undone all over the picture, but got"),
    "near": (top(near=-1), r"json: near: expected a number in \[0, 1e\+09\], but got -1"),
    "far": (top(far=float("inf")), r"json: far: expected a number .*got inf"),
    "ends": (top(near=7, far=6), r"json: expected near < far, but got 7 and 6"),
    "aabb": (top(aabb=[1, 2]), r"json: aabb: expected \[\[x0, y0, z0\], \[x1, y1, z1\]\]"),
    "turned aabb": (top(aabb=[[0, 0, 1], [1, 1, 0]]), r"aabb: expected .* each low end below its high end"),
    "lists": (top(test_filenames="images/frame_1.png"), r"test_filenames: expected a list of paths"),
    "listed": (top(test_filenames=["images/x.png"]), r"test_filenames: expected paths of frames.*images/x"),
    "list of 1": (top(test_filenames=[1]), r"test_filenames\[0\]: expected a path"),
    "no test": (top(test_filenames=[]), r"expected a frame to test on, but got none of 10"),
    "shared": (
        top(train_filenames=["images/frame_1.png"], test_filenames=["images/frame_1.png"]),
        r"expected lists of filenames that share none",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_transforms_are_one_clear_line(tmp_path, case):
    change, match = BAD[case]
    edit(write_tiny(tmp_path / "toy"), change)
    with pytest.raises(SceneError, match=match) as caught:
        read_scene(tmp_path, "toy")
    assert len(str(caught.value).splitlines()) == 1
    assert str(tmp_path) in str(caught.value)


OPTIONS = [
    ({"scale": 3}, r"data.scale: expected one of \(1, 2, 4, 8\), but got 3"),
    ({"scale": 2}, r"images_2/frame_1.png: expected an image, but got No such file"),
    ({"near": -1}, r"data.near: expected a number"),
    ({"near": 200}, r"expected near < far, but got 200 and 120; set data.near, data.far"),
    ({"far": 0}, r"data.far: expected a number"),
    ({"box": [1, 2]}, r"data.box: expected six numbers"),
    ({"normalise": "yes"}, r"data.normalise: expected true or false, but got 'yes'"),
    ({"canonical": "last"}, r"data.canonical: expected middle or first, but got 'last'"),
    ({"test_every": 1}, r"data.test_every: expected a whole number of at least 2, but got 1"),
    ({"test_every": 21}, r"expected a frame to test on, but got none of 10; name some in test_filenames"),
]


@pytest.mark.parametrize(("options", "match"), OPTIONS)
def test_bad_options(tmp_path, options, match):
    write_tiny(tmp_path / "toy")
    with pytest.raises(SceneError, match=match):
        read_scene(tmp_path, "toy", **options)


def test_a_missing_capture_names_those_that_exist(tmp_path):
    write_tiny(tmp_path / "hand")
    with pytest.raises(SceneError, match=r"expected a scene with transforms.json, but got none; .*: hand$"):
        read_scene(tmp_path, "foot")


def test_masks_have_the_images_size(tmp_path):
    write_tiny(tmp_path / "toy")
    write_png(tmp_path / "toy" / "m.png", np.zeros((4, 4, 3), np.uint8))
    edit(tmp_path / "toy", lambda c: [f.update(mask_path="m.png") for f in c["frames"]])
    with pytest.raises(SceneError, match=r"m.png: expected 30 x 20 pixels as frame_1.png, but got 4 x 4"):
        read_scene(tmp_path, "toy")


def test_smaller_images_need_a_folder(tmp_path):
    write_tiny(tmp_path / "toy")
    (tmp_path / "toy" / "images" / "frame_1.png").rename(tmp_path / "toy" / "frame_1.png")
    edit(tmp_path / "toy", lambda c: c["frames"][0].update(file_path="frame_1.png"))
    with pytest.raises(SceneError, match=r"expected images in a folder, but got frame_1; set data.scale=1"):
        read_scene(tmp_path, "toy", scale=2)


@pytest.mark.parametrize("turn", [False, True])
def test_a_camera_in_one_place_needs_its_ends(tmp_path, turn):
    views = []
    for i in range(10):
        target = MIDDLE + torch.tensor([20.0, 3.0 * i if turn else 0.0, 0.0])
        views.append(replace(cameras(1)[0], camera_to_world=look_at(MIDDLE, target, UP)))
    write_tiny(tmp_path / "toy", views=views, near=None)
    with pytest.raises(SceneError, match=r"expected cameras that move, but got one place; set data.near and"):
        read_scene(tmp_path, "toy")
    scene = read_scene(tmp_path, "toy", near=1)
    for f in scene.train:
        assert f.camera.near < float(-f.camera.center @ f.camera.camera_to_world[:3, 2]) < f.camera.far


def looking_out(span):
    """Cameras on a part of a circle that look away from its middle."""
    for i, camera in enumerate(cameras(10)):
        angle = torch.tensor(span * i / 10)
        offset = torch.stack([angle.cos(), angle.sin(), torch.tensor(0.0)])
        yield replace(camera, camera_to_world=look_at(MIDDLE + offset, MIDDLE + 2 * offset, UP))


def test_cameras_that_part_look_at_what_lies_before_them(tmp_path):
    write_tiny(tmp_path / "out", views=[*looking_out(1.0)], near=None, far=None)
    for frame in read_scene(tmp_path, "out").train:
        assert float(-frame.camera.center @ frame.camera.camera_to_world[:3, 2]) > frame.camera.near > 0


def test_cameras_that_look_in_all_directions_are_refused(tmp_path):
    write_tiny(tmp_path / "out", views=[*looking_out(2 * np.pi)])
    with pytest.raises(
        SceneError, match="expected cameras that look at something in common, but got views in"
    ):
        read_scene(tmp_path, "out")


CAMERA, PIXELS = cameras(1)[0], np.zeros((20, 30, 3), np.uint8)
WRITES = [
    (PosedShot("a.png", CAMERA, PIXELS / 1.0), "a.png: expected uint8 pixels of shape"),
    (PosedShot("a.png", CAMERA, PIXELS[:4]), "a.png: expected uint8 pixels of shape"),
    (PosedShot("a.png", replace(CAMERA, skew=1.0), PIXELS), "no skew, but got .* a skew of 1"),
    (PosedShot("a.png", CAMERA, PIXELS, 2.0), "a.png: time: expected a number in"),
    (PosedShot("a.png", CAMERA, PIXELS, None, "training"), "expected a split of train, val, test, but got"),
    (PosedShot("a.png", replace(CAMERA, camera_to_world=2 * CAMERA.camera_to_world), PIXELS), "a rotation"),
]


CUT_OUT = np.zeros((20, 30, 4), np.uint8)
WRITES += [
    (PosedShot("a", CAMERA, PIXELS), r"a: expected a name in .png, .*, but got ''"),
    (PosedShot("a.tif", CAMERA, PIXELS), r"a.tif: expected a name in .png, .*, but got '.tif'"),
    (PosedShot("a.jpg", CAMERA, CUT_OUT), "a.jpg: expected 3 channels, as a JPEG has no alpha, but got 4"),
    (PosedShot("../../a.png", CAMERA, PIXELS), "expected a path inside the scene folder"),
]


@pytest.mark.parametrize(("shot", "match"), WRITES)
def test_the_writer_refuses_what_could_not_be_read(tmp_path, shot, match):
    with pytest.raises(ValueError, match=match):
        write_scene(tmp_path, [shot])


@pytest.mark.parametrize("second", ["a.png", "a.jpg", "./a.png"])
def test_the_writer_refuses_two_images_of_one_name(tmp_path, second):
    both = [PosedShot(name, CAMERA, PIXELS) for name in ("a.png", second)]
    with pytest.raises(ValueError, match=r"a.*: expected names that differ without their suffix"):
        write_scene(tmp_path, both)


def test_mixed_alpha_is_refused(tmp_path):
    mixed = [*shots(10)][:5] + [*shots(10, channels=4)][5:]
    write_scene(tmp_path / "toy", mixed, near=20, far=120)
    with pytest.raises(
        SceneError, match=r"file_path: alpha: expected one in all frames or in none, but got 5"
    ):
        read_scene(tmp_path, "toy")
