"""What holds for every format: how it is rewritten and boxed; what cannot be used is refused in one line."""

import shutil
from dataclasses import replace
from itertools import islice
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image

from forewarp.data import dnerf, hypernerf, nhr, posed_video
from forewarp.data.dnerf import Shot
from forewarp.data.nhr import DomeFrame
from forewarp.data.posed_video import PosedShot
from tests.support.written_scenes import (
    BALLS,
    GONE,
    RIG_TRUTH,
    STEP,
    dnerf_shots,
    dome,
    dome_frames,
    dome_truth,
    edit,
    hand,
    posed_cameras,
    posed_shots,
    refused,
    rig,
    write_dnerf,
    write_dome,
    write_lego,
    write_rig,
    write_video,
)

READ = {
    "dnerf": dnerf.read_scene,
    "lego": dnerf.read_lego_complete,
    "rig": hypernerf.read_scene,
    "dome": nhr.read_scene,
    "video": posed_video.read_scene,
}


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A root with a scene of each format; not to be changed."""
    root = tmp_path_factory.mktemp("whole")
    write_dnerf(root / "dnerf")
    write_lego(root / "lego")
    write_rig(root / "rig", points=np.zeros((2, 3)), trajectories=RIG_TRUTH)
    write_dome(root / "dome")
    write_video(root / "video")
    iio.imwrite(root / "video" / "m.png", np.zeros((4, 4, 3), np.uint8))
    return root


@pytest.fixture
def scene(written, tmp_path):
    """Copy one of them, to be harmed."""
    return lambda name: Path(shutil.copytree(written / name, tmp_path / name))


def harm(path, how):
    """Take a file or folder away (None), or change a text, a JSON file, an array or an image."""
    if how is None:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    elif isinstance(how, bytes):
        path.write_bytes(how)
    elif path.suffix == ".json":
        edit(path, how)
    elif callable(how):
        how(path)
    elif path.suffix == ".npz":
        np.savez(path, **how)
    else:
        (np.save if path.suffix == ".npy" else iio.imwrite)(path, np.asarray(how))


def cut(path):
    path.write_bytes(path.read_bytes()[: -path.stat().st_size // 3])


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content)


def line(number, change):
    """Change the words of a line, numbered from 1; None takes it away."""

    def spoil(path):
        lines = path.read_text().split("\n")
        lines[number - 1 : number] = [] if change is None else [" ".join(change(lines[number - 1].split()))]
        path.write_text("\n".join(lines))

    return spoil


def flat(folder):
    for path in folder.iterdir():
        np.save(path, np.load(path) * [1, 1, 0, 1, 1, 1])


WHOLE, OUT = "expected a whole image, but got a truncated or harmed one", "expected a path inside the scene"
T, TIME, FRAMES = "transforms_train.json", "transforms_test_time.json", "transforms.json"
CAMERA, ITEM, ITEMS, WORLD = "camera/left1_000000.json", "left1_000001", "dataset.json", "scene.json"
POSES, LENSES, CLOUD, ALL_CLOUDS = "CamPose.inf", "Intrinsic.inf", "pointclouds/frame2.npy", "pointclouds"
TRUTH, DEPTH, PIXELS = "trajectories.npz", "test_time/r_0_depth.npy", np.zeros((6, 8, 4), np.uint8)
TWO = np.zeros((2, 3))
BAD = {
    "dnerf": [
        (T, None, "expected a scene with transforms_train.json, but got none; scenes in .*: none"),
        (T, b'{\n"a": 1,\n}', "transforms_train.json: line 3: expected JSON, but got"),
        (T, b"\xff\xfe\x00", "line 1: expected text in UTF-8, but got the byte 0x00"),
        (T, {"camera_angle_x": GONE}, "expected fl_x or camera_angle_x, but got neither"),
        (T, {"camera_angle_x": 0}, r"camera_angle_x: expected radians inside \(0, pi\)"),
        (T, {"frames": []}, "frames: expected a list of at least one frame"),
        (T, {"frames.1": [1]}, r"frames\[1\]: expected an object, but got \[1\]"),
        (T, {"frames.1.transform_matrix": GONE}, r"frames\[1\].transform_matrix: expected 4 x 4 .*None"),
        (
            T,
            lambda c: [f.update(transform_matrix=[*zip(*f["transform_matrix"])]) for f in c["frames"]],
            r"the last row 0 0 0 1, but got \[.*; transpose it",
        ),
        (T, {"frames.1.time": "1"}, r"time: expected a number in \[-1e\+20, 1e\+20\], but got '1'"),
        (T, {"frames.0.time": 50, "frames.1.time": 99}, "times of test frames: expected one unit in all spl"),
        (T, {"frames.1.depth_file_path": "/etc/x"}, f"depth_file_path: {OUT}"),
        (T, {"frames.1.depth_file_path": "e" * 999}, "depth_file_path: expected an existing file"),
        (T, {"frames.1.ability": "flight"}, "ability: expected space, time, canonical or all"),
        ("train/r_2.png", flip, f"r_2.png: {WHOLE}"),
        ("train/r_2.png", PIXELS[:4, :4], "r_2.png: expected 8 x 6 pixels as the first, .* 4 x 4; .*remove"),
        ("transforms_test_time.json", b"{}", "test.json: expected it or one file per ability, but got both"),
    ],
    "lego": [
        (TIME, {"frames.0.ability": "all"}, "got test_time/r_0 without an ability; use data=dnerf"),
        (TIME, {"frames.0.depth_file_path": "train/r_0.png"}, "r_0.png: expected depth_scale in the transf"),
        (TIME, {"frames.0.depth_scale": 0}, r"frames\[0\].depth_scale: expected a number in"),
        (TRUTH, {"points": TWO}, r"expected arrays points and times, but got \['points'\]"),
        (TRUTH, {"points": TWO, "times": [0, 1]}, r"expected points \(N, T, 3\) and times \(T,\)"),
        (TRUTH, {"points": np.full((2, 1, 3), np.inf), "times": [0]}, "points: expected finite numbers"),
        (TRUTH, {"points": np.array([None]), "times": [0]}, "expected a NumPy file, but got one that cannot"),
        (TRUTH, {"points": TWO[None], "times": [0, 2]}, "but got 0 to 2"),
    ],
    "rig": [
        (TRUTH, {"points": TWO[None], "times": [0.25, 1]}, "begin at the canonical time 0.5"),
        (CAMERA, None, "left1_000000.json: expected the camera of an image, but got none"),
        (CAMERA, {"orientation": GONE}, "orientation: expected 3 x 3 numbers, but got None"),
        (CAMERA, {"orientation.0": [2, 0, 0]}, "orientation: expected a rotation"),
        (CAMERA, {"position": [1, 2]}, r"position: expected 3 numbers, but got \[1, 2\]"),
        (CAMERA, {"focal_length": 0}, "focal_length: expected a number in"),
        (CAMERA, {"radial_distortion": [-30, 0, 0]}, "radial_distortion: expected a lens that can be undone"),
        (CAMERA, {"image_size": [12.5, 8]}, "image_size: expected whole numbers"),
        (CAMERA, {"image_size": [24, 8]}, "png: expected 12 x 4 pixels, the camera's .* got 6 x 4"),
        (WORLD, {"scale": GONE}, "scene.json: scale: expected a number .*got None"),
        (WORLD, {"near": 9}, "scene.json: near, far: expected near < far, but got 9 and 1.4"),
        (ITEMS, lambda c: c["ids"].append(ITEM), "ids: expected a list of different names"),
        (ITEMS, {"train_ids": ["x"]}, "train_ids: expected items of dataset.json's ids, but got 'x'"),
        (ITEMS, {"val_ids": ["left1_000000"]}, "val_ids: expected none of the items to train on"),
        (ITEMS, {"train_ids": []}, "train_ids: expected at least one beside val_ids"),
        (ITEMS, {"ids": [ITEM], "train_ids": [], "val_ids": []}, "ids: expected more than 4 items"),
        (ITEMS, lambda c: c["ids"].append("a\nb"), r"'a\\nb': expected an object for this item"),
        ("metadata.json", {f"{ITEM}.time_id": GONE}, rf"'{ITEM}'.time_id: expected a number"),
        ("metadata.json", {f"{ITEM}.time_id": 0.5}, "time_id: expected a whole number, but got 0.5"),
        ("points.npy", TWO[:, :2], r"points.npy: expected points \(N, 3\), but got shape \(2, 2\)"),
    ],
    "video": [
        ("images/frame_1.png", np.zeros((20, 30, 4), np.uint8), "alpha: expected one in all frames or"),
        (FRAMES, lambda c: c.update(frames=c["frames"][:1]), "at least 3 images, one of them to test"),
        (FRAMES, {"frames.1.file_path": "./images/frame_1.png"}, "expected each image once, but got imag"),
        (FRAMES, {"frames.1.mask_path": "images/frame_1.png"}, "mask_path: expected one in all .*1 of"),
        (FRAMES, lambda c: [e.update(mask_path="m.png") for e in c["frames"]], "m.png: expected 30 x 20 "),
        (FRAMES, lambda c: [e.update(mask_path="../x.png") for e in c["frames"]], f"mask_path: {OUT}"),
        (FRAMES, {"frames.1.time": 0.5}, "frames: time: expected one in all .*1 of 10"),
        (
            FRAMES,
            {f"frames.{i}.time": i / 5 for i in range(9)} | {"frames.9.time": 99},
            "frame_10: expected a time",
        ),
        (FRAMES, {"moving_from": ["a"]}, r"json: moving_from: expected text, but got \['a'\]"),
        (FRAMES, {"fl_x": GONE, "fl_y": GONE}, "fl_x: expected fl_x or camera_angle_x, but got neither"),
        (FRAMES, {"frames.1.fl_x": -30}, r"frames\[1\].fl_x: expected a number in .*got -30"),
        (FRAMES, {"w": 60}, "frame_1.png: expected 60 x 20 pixels as .*json: w and h say, but got 30 x 20"),
        (FRAMES, {"camera_model": "OPENCV_FISHEYE"}, "json: camera_model: expected OPENCV, .*FISHEYE"),
        (FRAMES, {"k4": 0.1}, "json: k4: expected 0, but got 0.1; undistort the images"),
        (FRAMES, {"k1": -40}, "json: k1: expected a lens that can be undone all over the picture, but got"),
        (FRAMES, {"near": -1}, r"json: near: expected a number in \[0, 1e\+09\], but got -1"),
        (FRAMES, {"near": 7, "far": 6}, "json: expected near < far, but got 7 and 6"),
        (FRAMES, {"aabb": [[0, 0, 1], [1, 1, 0]]}, "aabb: expected .* each low end below its high end"),
        (FRAMES, {"test_filenames": "images/frame_1.png"}, "test_filenames: expected a list of paths"),
        (
            FRAMES,
            {"test_filenames": ["images/x.png"]},
            "test_filenames: .*images/x.*; remove it from",
        ),
        (
            FRAMES,
            dict.fromkeys(["train_filenames", "test_filenames"], ["images/frame_1"]),
            "expected train_filenames and test_filenames that share no file, but got images/frame_1 in both",
        ),
        (
            FRAMES,
            {"val_filenames": ["frame_1.png", "frame_2"], "test_filenames": ["images/frame_1.png"]},
            "expected val_filenames and test_filenames that share no file",
        ),
        (FRAMES, {"test_filenames": ["other/frame_1.png"]}, "test_filenames: expected paths of frames"),
    ],
    "dome": [
        (POSES, b" \n", "expected at least one camera"),
        (POSES, line(2, lambda w: w[:11]), "inf: line 2: expected 12 finite numbers, but got 11"),
        (POSES, line(2, lambda w: [w[0] + "0", *w[1:3], *w[:3], *w[6:]]), "line 2: expected a rotation"),
        (POSES, line(4, None), "Intrinsic.inf: .*got 4 there and 3 in CamPose.inf; write the block"),
        (".", lambda p: write_dome(p, dome(1), 1), "expected at least 2 cameras, one to"),
        (".", lambda p: write_dome(p, dome(2, sizes=((1, 1),)), 1), "at least 2 x 2 pixels to halve"),
        (LENSES, None, "expected a readable file, but got No such file"),
        (LENSES, line(2, lambda w: w[:2]), "line 1: expected the number 0 of .* got 0 70 0.7 0 71.5"),
        (LENSES, line(4, lambda w: "002"), "line 1: expected the number 0 .* fx s cx, .* 0 0 2$"),
        (LENSES, line(6, lambda w: "2"), "line 6: expected the number 1 of a camera"),
        (LENSES, line(19, None), "line 16: expected 10 finite numbers, but got 7 values"),
        ("img", None, "img: expected a folder of images for each frame, named by its number, but got none"),
        (
            "img/1/mask/img_0002.jpg",
            None,
            "img_0002.jpg: expected the mask of an image, .*; add it, or",
        ),
        ("img/1/img_0004.jpg", PIXELS[..., 0], "expected images of the 4 cameras of CamPose.inf, but got"),
        ("img/1/img_0002.jpg", PIXELS[..., 0], "expected 60 x 48 pixels as in .*, but got 8 x 6"),
        ("img/1/img_0001.jpg", cut, f"img_0001.jpg: {WHOLE}"),
        (
            CLOUD,
            None,
            "frame2.npy: expected a point cloud of each frame, .* set data.box",
        ),
        (CLOUD, np.full((2, 6), np.nan), "frame2.npy: expected finite numbers, .*in row 0"),
        (CLOUD, np.diag([0, 1e30, 0, 0, 0, 0]), r"within 1e\+09 units, but got 1e\+30 in row 1"),
        (ALL_CLOUDS, flat, "pointclouds: expected points that span a box, .*; set data.box"),
    ],
}


def rows(table):
    """Flatten ``{key: [(a, b), ...]}`` to rows (key, a, b)."""
    return [(key, *row) for key, group in table.items() for row in group]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "file", "how", "match"), rows(BAD))
def test_a_harmed_scene_is_refused_when_it_is_read(scene, name, file, how, match):
    folder = scene(name)
    harm(folder / file, how)
    with refused(match) as caught:
        READ[name](folder.parent, name)
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)


LATER = {
    "dnerf": [
        ("train/r_2.png", flip, "harmed one; copy"),
        ("train/r_2.png", PIXELS[:4], "r_2.png: expected 8 x 6 pixels, but got 8 x 4"),
    ],
    "dome": [("img/0/mask/img_0001.jpg", PIXELS[..., 0], "0001.jpg: expected 48 x 60 pixels, but got 8 x 6")],
    "lego": [
        (DEPTH, b"", "r_0_depth.npy: expected a NumPy file"),
        (DEPTH, np.ones((8, 6)), r"shape \(6, 8\), but got shape \(8, 6\)"),
        (DEPTH, np.full((6, 8), np.nan), "expected finite depths >= 0"),
        (DEPTH, np.full((6, 8), 1e300), "expected finite depths >= 0"),  # beyond single precision
        (DEPTH, -np.ones((6, 8)), "but got values from -1.0 to -1.0"),
        ("d.png", PIXELS[..., 0], "d.png: expected a grey PNG of 16 bits a pixel, but got mode L"),
        ("d.png", np.zeros((6, 9), np.uint16), r"shape \(6, 8\), but got shape \(6, 9\)"),
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "file", "how", "match"), rows(LATER))
def test_what_goes_bad_later_is_refused_when_it_is_loaded(scene, name, file, how, match):
    folder = scene(name)
    if file == "d.png":
        iio.imwrite(folder / file, np.zeros((6, 8), np.uint16))
        edit(folder / TIME, {"frames.0.depth_file_path": file, "depth_scale": 1})
    whole = READ[name](folder.parent, name)
    harm(folder / file, how)
    loads = [load for f in (*whole.train, *whole.test) for load in (f.load, f.load_depth) if load is not None]
    with refused(match) as caught:
        _ = [load() for load in loads]
    assert "\n" not in str(caught.value)


OPTIONS = {
    "dnerf": [
        ({"half_resolution": "yes"}, "data.half_resolution: expected true, false or auto, but got 'yes'"),
        ({"near": 6, "far": 2}, "data.near, data.far: expected near < far, but got 6 and 2"),
        ({"box": [1, 2]}, "data.box: expected six numbers"),
    ],
    "rig": [
        ({"scale": 0}, "data.scale: expected a whole number of at least 1, but got 0"),
        ({"scale": 8}, "8x: expected a folder of images.* set data.scale .*: 1x, 2x$"),
    ],
    "dome": [
        ({"test_cameras": [4]}, r"some of the cameras 0, 1, 2, 3, not all, but got no camera 4"),
        ({"test_cameras": [1, 1]}, "data.test_cameras: expected"),
        ({"test_moments": [3]}, "data.test_moments: expected numbers of 0 to 2"),
        ({"frames": 0}, "data.frames: expected a whole number of at least 1, but got 0"),
        ({"test_every": 1.5}, "data.test_every: expected a whole number of at least 1, but got 1.5"),
        ({"half_resolution": "auto"}, "data.half_resolution: expected true or false, but got 'auto'"),
    ],
    "video": [
        ({"scale": 3}, r"data.scale: expected 1, 2, 4 or 8, but got 3"),
        ({"scale": 2}, "expected the images that it lists, as .*images_2/frame_1.png, but got none of them"),
        ({"near": 200}, "expected near < far, but got 200 and 120; set data.near, data.far"),
        ({"far": -1}, "data.far: expected a number"),
        ({"normalise": "yes"}, "data.normalise: expected true or false, but got 'yes'"),
        ({"test_every": 1}, "data.test_every: expected a whole number of at least 2, but got 1"),
    ],
}


@pytest.mark.parametrize(("name", "options", "match"), rows(OPTIONS))
def test_bad_options(written, name, options, match):
    with refused(match):
        READ[name](written, name, **options)


@pytest.mark.parametrize("name", READ)
def test_a_missing_scene_names_those_that_exist(written, name):
    with refused(rf"expected a scene with .*; scenes in .*: .*\b{name}\b"):
        READ[name](written, "nowhere")
    with refused("data.root: expected an existing folder"):
        READ[name](written / "nowhere", name)


def test_sides_that_cannot_be_halved(tmp_path):
    write_dnerf(tmp_path / "odd", size=(5, 8))
    with refused("expected even sides to halve, but got 8 x 5"):
        dnerf.read_scene(tmp_path, "odd", half_resolution=True)


def test_smaller_images_need_a_folder(scene):
    folder = scene("video")
    (folder / "images" / "frame_1.png").rename(folder / "frame_1.png")
    edit(folder / FRAMES, {"frames.0.file_path": "frame_1.png"})
    with refused("expected images in a folder, but got frame_1; set data.scale=1"):
        posed_video.read_scene(folder.parent, "video", scale=2)


def write_splits(folder, splits):
    dnerf.write_scene(folder, splits, camera_angle_x=1)


def write_moment(folder, frame):
    nhr.write_scene(folder, dome(), [frame])


def shot(name="a", **changes):
    return replace(Shot(name, 0, np.eye(4), PIXELS), **changes)


RIG, *_ = rig()
DOME = next(dome_frames(dome()))
RGB, ONE = np.zeros((20, 30, 3), np.uint8), posed_cameras(1)[0]
POSED = PosedShot("a.png", ONE, RGB)
UNWRITABLE = {
    write_splits: [
        ({"training": []}, r"splits: expected train, val and test, but got \['training'\]"),
        ({"train": [shot(), shot()]}, "expected shots of different names"),
        ({"train": [shot(rgba=PIXELS / 1.0)]}, "expected uint8 pixels"),
        ({"train": [shot(), shot("b", rgba=PIXELS[:2])]}, r"uint8 pixels of .* got uint8 of \(2, 8, 4\)"),
        ({"train": [shot(pose=2 * np.eye(4))]}, "train/a: pose: expected a rotation"),
    ],
    write_rig: [
        ([RIG, RIG], "shots: expected different names"),
        ([replace(RIG, split="test")], "of train, val or '', but got 'left1_000000' of split 'test'"),
        ([replace(RIG, rgb=RIG.rgb / 255)], "left1_000000: expected uint8"),
        (rig(size=(11, 8)), "cannot reshape"),
    ],
    write_moment: [
        (DomeFrame(DOME.images[:1], DOME.masks, DOME.points), "is shorter than"),
        (DomeFrame(DOME.masks, DOME.masks, DOME.points), "frame 0: img_0000.jpg: expected uint8 pixels of"),
    ],
    posed_video.write_scene: [
        ([replace(POSED, pixels=RGB / 1.0)], "a.png: expected uint8 pixels of shape"),
        ([replace(POSED, camera=replace(ONE, skew=1.0))], "a camera without skew, but got a skew of 1"),
        ([replace(POSED, camera=replace(ONE, camera_to_world=torch.zeros(4, 4)))], "a rotation"),
        ([replace(POSED, time=2.0)], "a.png: time: expected a number in"),
        ([replace(POSED, split="training")], "a.png: split: expected train, val or test, but got"),
        ([replace(POSED, name="a.tif")], "a.tif: suffix: expected .png, .*, but got '.tif'"),
        ([replace(POSED, name="a.jpg", pixels=np.dstack([RGB, RGB[..., :1]]))], r"\(20, 30, 3\), but got"),
        ([replace(POSED, name="../../a.png")], "expected a path inside the scene folder"),
        ([POSED, replace(POSED, name="./a.jpg")], "a.*: expected names that differ without"),
    ],
}


def test_a_dome_has_no_lenses(tmp_path):
    with refused("cameras: expected none with a lens, as the format has none"):
        nhr.write_scene(tmp_path, [ONE], [DOME])


@pytest.mark.parametrize(("write", "what", "match"), rows(UNWRITABLE))
def test_the_writers_refuse_what_could_not_be_read(tmp_path, write, what, match):
    with pytest.raises(ValueError, match=match):
        write(tmp_path / "toy", what)


@pytest.mark.parametrize(
    ("name", "suffix"),
    [("dnerf", "jpg"), ("rig", "jpg"), ("dome", "jpg"), ("video", "jpg"), ("video", "png")],
)
def test_images_that_are_to_be_turned_are_read_as_stored_and_named(scene, name, suffix):
    folder, exif = scene(name), Image.Exif()
    exif[0x0112] = 6
    for file in [file for file in folder.rglob("*.png") if file.stem != "m" and suffix == "jpg"]:
        with Image.open(file) as image:
            image.convert("RGB").save(file.with_suffix(".jpg"))
        file.unlink()
        for listed in folder.glob("*.json"):
            listed.write_text(listed.read_text().replace(f"{file.stem}.png", f"{file.stem}.jpg"))
    before = READ[name](folder.parent, name)
    file = before.train[0].load.path
    with Image.open(file) as image:
        image.save(file, exif=exif)
    after = READ[name](folder.parent, name)
    assert after.train[0].camera.width == before.train[0].camera.width
    (line,) = [line for line in after.protocol["assumed"] if "EXIF" in line]
    assert f"1 images are read as stored, although their EXIF orientation turns them ({file.name}" in line


@pytest.mark.parametrize("name", ["rig", "video", "dome"])
def test_images_turned_by_a_quarter_are_named(scene, name):
    folder = scene(name)
    with Image.open(file := READ[name](folder.parent, name).train[1].load.path) as image:
        image.rotate(90, expand=True).save(file)
    with refused(rf"{file.name}: .*width and height are exchanged: turn its pixels"):
        READ[name](folder.parent, name)


TWO_VIEWS, SPLITS = dome(2), ["train"] * 5 + ["test"] * 5
FORMATS = {  # what reads it, what writes a scene with all that may be there, what writes shots and no more
    "dnerf": (dnerf.read_scene, write_lego, lambda f, cut: write_dnerf(f, test=cut(dnerf_shots(2)))),
    "hypernerf": (
        hypernerf.read_scene,
        lambda f: write_rig(f, points=np.zeros((1, 3)), trajectories=RIG_TRUTH),
        lambda folder, cut: write_rig(folder, cut(hand(5))),
    ),
    "nhr": (
        nhr.read_scene,
        lambda folder: write_dome(folder, trajectories=dome_truth()),
        lambda folder, cut: nhr.write_scene(folder, TWO_VIEWS, cut(dome_frames(TWO_VIEWS, 2))),
    ),
    "video": (
        posed_video.read_scene,
        lambda folder: write_video(folder, splits=SPLITS),
        lambda folder, cut: posed_video.write_scene(folder, cut(posed_shots()), near=20, far=120),
    ),
}


def cut_short(shots):
    yield from islice(shots, 1)
    raise KeyboardInterrupt


@pytest.mark.parametrize("name", FORMATS)
def test_a_rewritten_scene_keeps_nothing_of_the_old_one(tmp_path, name):
    read, write, rewrite = FORMATS[name]
    write(tmp_path / "toy")
    with pytest.raises(KeyboardInterrupt):
        rewrite(tmp_path / "toy", cut_short)
    with refused("expected a scene with"):
        read(tmp_path, "toy")
    for folder in ("toy", "fresh"):
        rewrite(tmp_path / folder, iter)
    found, expected = read(tmp_path, "toy"), read(tmp_path, "fresh")
    assert {**found.protocol, "assumed": None} == {**expected.protocol, "assumed": None}
    assert (found.truth, found.still) == (None, None)
    for split in ("train", "val", "test"):
        assert [f.name for f in getattr(found, split)] == [f.name for f in getattr(expected, split)]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dnerf", "hypernerf", "nhr"])
def test_a_box_is_as_given_or_bounds_all_training_rays(tmp_path, name):
    read, write, _ = FORMATS[name]
    write(tmp_path / "toy")
    assert read(tmp_path, "toy", box=[-1, -2, -3, 1, 2, 3]).box.high == (1, 2, 3)
    if name == "nhr":  # what its point clouds span, a tenth more on each side
        low, high = BALLS.min(0), (BALLS + 2 * STEP).max(0)
        expected, near = (low - 0.1 * (high - low), high + 0.1 * (high - low)), 1e-6
    else:
        scene, points = read(tmp_path, "toy"), []
        for camera in (frame.camera for frame in scene.train):
            rays = camera.rays()
            points += [rays.origins + d * rays.directions for d in (camera.near, camera.far)]
        points = torch.cat(points)
        # 3 x 3 pixels stand for all; between them the far sphere bulges a little.
        expected, near = (points.amin(0), points.amax(0)), 0.1
    box = read(tmp_path, "toy").box
    for end, found in zip(expected, (box.low, box.high)):
        assert found == pytest.approx(end.tolist(), abs=near)
