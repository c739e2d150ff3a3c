"""NHR scenes: what is written is read, points are where they are seen, files by others are understood."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from forewarp.data import images
from forewarp.data.cameras import FLIP
from forewarp.data.nhr import read_scene
from tests.support.written_scenes import (
    BALLS,
    COLORS,
    STEP,
    dome,
    dome_frames,
    dome_truth,
    place,
    refused,
    say_linear,
    write_dome,
)

KEYS = ("width", "height", "fx", "fy", "cx", "cy", "skew")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A root with the scene ``toy``; not to be changed."""
    root = tmp_path_factory.mktemp("nhr")
    write_dome(root / "toy", trajectories=dome_truth())
    return root


@pytest.fixture
def toy(written, tmp_path):
    """A copy of the scene, to be spoilt."""
    return Path(shutil.copytree(written / "toy", tmp_path / "toy"))


def test_round_trip(written):
    scene = read_scene(written, "toy", half_resolution=False)
    frames = {frame.name: frame for frame in scene.train + scene.test}
    names = [f"{f}/img_{k:04d}" for f in range(3) for k in (1, 2, 3)]
    assert list(frames) == [*names, *(f"{f}/img_0000" for f in range(3))]
    for f, moment in enumerate(dome_frames(dome())):
        for k, camera in enumerate(dome()):
            frame = frames[f"{f}/img_{k:04d}"]
            assert (frame.time, frame.ability) == (f / 2, "all" if k else "space")
            pose = frame.camera.camera_to_world
            torch.testing.assert_close(pose, camera.camera_to_world, atol=1e-6, rtol=0)
            assert [getattr(frame.camera, key) for key in KEYS] == [getattr(camera, key) for key in KEYS]
            rgba, mask = frame.load().numpy(), moment.masks[k]
            assert np.array_equal(rgba[..., 3], mask)
            assert np.abs(rgba[..., :3].astype(int) - moment.images[k])[mask > 0].mean() < 6
    assert (scene.val, scene.canonical_time, scene.has_alpha, scene.times) == ((), 0.0, True, (0, 0.5, 1))
    assert torch.equal(scene.truth.points, dome_truth().points)
    expected = {"dataset": "nhr", "resolution": [[60, 48], [48, 60]], "half_resolution": False, "frames": 3}
    assert scene.protocol == expected | {"views": 4, "test_views": [0], "test_frames": 3, "mask_box": True}


def test_the_files_are_as_the_format_says(written):
    """By hand: z axis, x axis, y axis, centre; images from 0, point clouds from 1."""
    toy, camera = written / "toy", dome()[2]
    pose, line = camera.camera_to_world, np.loadtxt(toy / "CamPose.inf")[2]
    assert np.array_equal(line, torch.cat([pose[:3, 2], pose[:3, 0], pose[:3, 1], pose[:3, 3]]))
    number, *rows = (toy / "Intrinsic.inf").read_text().split("\n\n")[2].split("\n")
    matrix = [[camera.fx, camera.skew, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    assert (number, [[float(v) for v in row.split()] for row in rows]) == ("2", matrix)
    assert sorted(path.name for path in (toy / "img").iterdir()) == ["0", "1", "2"]
    clouds = sorted((toy / "pointclouds").iterdir())
    assert [path.name for path in clouds] == ["frame1.npy", "frame2.npy", "frame3.npy"]
    assert np.allclose(np.load(clouds[0])[:, :3], BALLS)


@pytest.mark.parametrize("half", [False, True])
def test_true_points_are_seen_where_the_cameras_say(written, half):
    scene, whole = read_scene(written, "toy", half_resolution=half), 0
    for frame in scene.train + scene.test:
        f, rgba = int(frame.name.split("/")[0]), frame.load().double()
        row, column = torch.meshgrid(*(torch.arange(n) + 0.5 for n in rgba.shape[:2]), indexing="ij")
        for point, color in zip(BALLS + f * STEP, COLORS, strict=True):
            pixel, _ = frame.camera.project(torch.from_numpy(point))
            weight = rgba[..., 3] * ((rgba[..., :3] - torch.from_numpy(color)).abs().amax(-1) < 70)
            seen = torch.stack([(weight * column).sum(), (weight * row).sum()]) / weight.sum()
            # A ball that another one covers in part is seen elsewhere.
            if float(weight.sum()) > 0.9 * 255 * 16 * np.pi / (4 if half else 1):
                whole += 1
                assert (seen - pixel).norm() < (0.3 if half else 0.4), (frame.name, point)
                assert np.allclose(pixel * (2 if half else 1), place(dome()[int(frame.name[-4:])], point))
    assert whole >= len(scene.train + scene.test)  # a third of all balls


def test_near_and_far_hold_the_box(written):
    scene = read_scene(written, "toy")
    corners = torch.cartesian_prod(*map(torch.tensor, zip(scene.box.low, scene.box.high))).double()
    for frame in scene.train:
        away = (corners - frame.camera.center).norm(dim=-1)
        assert 0 < frame.camera.near < float(away.min())
        assert float(away.max()) < frame.camera.far < 1.5 * float(away.max())


def test_odd_sizes_are_halved_exactly(tmp_path):
    cameras = dome(3, sizes=((61, 49), (48, 60)))
    write_dome(tmp_path / "odd", cameras, 1)
    scene = read_scene(tmp_path, "odd", test_cameras=[1])
    camera = scene.train[0].camera
    assert (camera.width, camera.height) == (30, 24)
    assert (camera.fx, camera.cx, camera.skew) == (35.0, cameras[0].cx / 2, 0.35)
    assert scene.train[0].load().shape == (24, 30, 4)
    assert scene.times == (0.0,)


@pytest.mark.slow
def test_held_out_views(tmp_path, written):
    write_dome(tmp_path / "many", dome(56, sizes=((2, 2),)), 1)
    assert read_scene(tmp_path, "many").protocol["test_views"] == [0, 9, 18, 28, 37, 46]
    scene = read_scene(tmp_path, "many", test_cameras=[7, 3])
    assert [frame.name for frame in scene.test] == ["0/img_0003", "0/img_0007"]
    assert len(scene.train) == 54
    scene = read_scene(written, "toy", test_every=2, frames=200)
    assert [frame.name for frame in scene.test] == ["0/img_0000", "2/img_0000"]
    scene = read_scene(written, "toy", test_cameras=[], test_moments=[1])
    assert [(f.name, f.ability) for f in scene.test] == [(f"1/img_{k:04d}", "time") for k in range(4)]


@pytest.mark.parametrize(("frames", "there"), [(1, 3), (3, 5), (2, 3), (9, 5)])
def test_true_trajectories_keep_step_with_the_frames_that_are_read(tmp_path, frames, there):
    write_dome(tmp_path / "toy", count=there, trajectories=dome_truth(there))
    scene = read_scene(tmp_path, "toy", frames=frames)
    if frames == 1:
        assert scene.truth is None
        return
    assert scene.truth.times.tolist() == pytest.approx(list(scene.times))
    places = {f.time: BALLS + int(f.name.split("/")[0]) * STEP for f in scene.train}
    for i, moment in enumerate(scene.times):
        assert scene.truth.points[:, i].numpy() == pytest.approx(places[moment], abs=1e-6)


INTRINSICS = {
    "a mark in front": lambda text: "\ufeff" + text,
    "UTF-16": lambda text: text.encode("utf-16"),
    "one line a camera": lambda text: text.replace("\n\n", "|").replace("\n", " ").replace("|", "\n"),
    "all in one line": lambda text: " ".join(text.split()),
    "from 1": lambda text: re.sub(r"^(\d+)$", lambda m: str(int(m[1]) + 1), text, flags=re.MULTILINE),
    "blanks": lambda text: text.replace("\n", "  \n\n ").replace(" 0.0", "   0"),
}


@pytest.mark.parametrize("case", INTRINSICS)
def test_intrinsics_by_others(toy, case):
    def intrinsics():
        scene = read_scene(toy.parent, "toy", half_resolution=False)
        return [[getattr(frame.camera, key) for key in KEYS] for frame in scene.train]

    expected, path = intrinsics(), toy / "Intrinsic.inf"
    text = INTRINSICS[case](path.read_text())
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert intrinsics() == expected


def test_files_by_others(toy):
    """Blanks and blank lines, three-channel masks, soft mask values, clouds as .obj, a leading mark."""
    poses = "\ufeff\n" + (toy / "CamPose.inf").read_text().replace(" ", "\t ") + "\n\n"
    (toy / "CamPose.inf").write_text(poses, encoding="utf-8")
    grey = np.array([[[127] * 3, [128] * 3]], np.uint8).repeat(24, 0).repeat(30, 1).repeat(2, 0)
    Image.fromarray(grey).save(toy / "img" / "0" / "mask" / "img_0000.jpg", quality=100)
    cloud = toy / "pointclouds" / "frame2.npy"
    rows = [" ".join(map(str, row)) for row in np.load(cloud).tolist()]
    cloud.with_suffix(".obj").write_text("# points\n" + "".join(f"v {row}\n" for row in rows))
    cloud.unlink()
    alpha = read_scene(toy.parent, "toy", half_resolution=False).test[0].load()[..., 3]
    assert (alpha[:, :29] == 0).all()
    assert (alpha[:, 31:] == 255).all()


def test_an_excerpt_is_read_in_order(toy):
    """Folders 8, 10, 14; cameras from 1; clouds as the frames, or in their order."""
    expected = read_scene(toy.parent, "toy")
    image = expected.train[4].load()
    for f, number in ((2, 14), (1, 10), (0, 8)):
        for folder in (toy / "img" / str(f), toy / "img" / str(f) / "mask"):
            for k in (3, 2, 1, 0):
                (folder / f"img_{k:04d}.jpg").rename(folder / f"img_{k + 1:04d}.jpg")
        (toy / "img" / str(f)).rename(toy / "img" / f"{number:03d}")
        (toy / "pointclouds" / f"frame{f + 1}.npy").rename(toy / "pointclouds" / f"frame{number + 1}.npy")
    for renumbered in (False, True):
        scene = read_scene(toy.parent, "toy")
        assert [frame.name for frame in scene.test] == ["008/img_0001", "010/img_0001", "014/img_0001"]
        assert (scene.times, scene.box) == ((0, 1 / 3, 1), expected.box)
        assert torch.equal(scene.train[4].load(), image)
        line, *others = scene.protocol["assumed"]
        assert "frames 8 to 14 (3) and cameras from 1 taken in order" in line
        said = "pointclouds: frame0.npy to frame2.npy (3) taken in the order of the frames"
        assert [said in other for other in others] == [True] * renumbered
        for number, f in ((9, 0), (11, 1), (15, 2)):
            if (cloud := toy / "pointclouds" / f"frame{number}.npy").exists():
                cloud.rename(cloud.with_name(f"frame{f}.npy"))


def _columns(order):
    return lambda matrix: matrix[:3, order].T


@pytest.mark.parametrize(
    ("written_as", "said"),
    [
        (lambda pose: _columns([2, 0, 1, 3])(pose @ FLIP), "only if the axes are OpenGL's; convert them"),
        (lambda pose: _columns([2, 0, 1, 3])(np.linalg.inv(pose)), "only if they are world-to-camera; conv"),
        (_columns([0, 1, 2, 3]), "only if the columns are x, y, z, centre; convert them"),
        (lambda pose: _columns([0, 1, 2, 3])(pose @ FLIP), "x, y, z, centre and the axes are OpenGL's"),
        (lambda pose: pose[:3], "line 1: expected columns z, x, y, centre .*, but got its rows; write the"),
    ],
)
def test_poses_written_in_another_way_are_named(tmp_path, written_as, said):
    folder = write_dome(tmp_path / "toy", dome(8), 1)
    lines = [written_as(camera.camera_to_world.numpy()).flatten().tolist() for camera in dome(8)]
    (folder / "CamPose.inf").write_text("\n".join(" ".join(map(repr, line)) for line in lines))
    with refused(f"CamPose.inf: .*{said}"):
        read_scene(tmp_path, "toy")


@pytest.mark.parametrize(
    ("factor", "said"),
    [(0.5, "of images 1.99 times as small: scale them up"), (2, "of images 2.01 times as large: scale them")],
)
@pytest.mark.parametrize("half", [False, True])
def test_intrinsics_of_images_of_another_size_are_named(toy, factor, said, half):
    scaled = [[factor * n for n in (c.fx, c.skew, c.cx, 0, c.fy, c.cy)] for c in dome()]
    blocks = [" ".join(map(str, [k, *row, 0, 0, 1])) for k, row in enumerate(scaled)]
    (toy / "Intrinsic.inf").write_text("\n".join(blocks))
    with refused(f"Intrinsic.inf: camera 0: expected a principal point .*{said}"):
        read_scene(toy.parent, "toy", half_resolution=half)


def test_reading_a_scene_decodes_masks_of_its_first_frame_alone(written, monkeypatch):
    def decode(path, *mode, real=images._decode):
        assert path.parent == written / "toy" / "img" / "0" / "mask"
        return real(path, *mode)

    monkeypatch.setattr(images, "_decode", decode)
    scene = read_scene(written, "toy")
    with pytest.raises(AssertionError):
        scene.train[0].load()


def test_clouds_of_other_frames_are_not_taken(toy):
    """Frames 8 to 10 are there, clouds 1 to 11 less the tenth, which is frame 9's."""
    for f in range(3):
        (toy / "img" / str(f)).rename(toy / "img" / str(f + 8))
    for number in (4, 5, 6, 7, 8, 9, 11):
        shutil.copy(toy / "pointclouds" / "frame1.npy", toy / "pointclouds" / f"frame{number}.npy")
    with refused(r"frame10\.npy: expected"):
        read_scene(toy.parent, "toy")


def test_clouds_that_are_counted_from_0_are_taken_in_order(toy):
    expected = read_scene(toy.parent, "toy").box
    for number in (1, 2, 3):
        cloud = toy / "pointclouds" / f"frame{number}.npy"
        cloud.rename(cloud.with_name(f"frame{number - 1}.npy"))
    scene = read_scene(toy.parent, "toy")
    assert scene.box == expected
    assert "frame0.npy to frame2.npy (3) taken in the order of the frames" in scene.protocol["assumed"][0]


def test_clouds_that_are_counted_from_0_are_taken_so_of_the_first_frames(toy):
    """More clouds than frames that are read; with one more than frames there are, too, it is said."""
    expected = read_scene(toy.parent, "toy", frames=2).box
    for number in (1, 2, 3):
        cloud = toy / "pointclouds" / f"frame{number}.npy"
        cloud.rename(cloud.with_name(f"frame{number - 1}.npy"))
    scene = read_scene(toy.parent, "toy", frames=2)
    assert scene.box == expected
    assert "frame0.npy to frame1.npy (2) taken in the order" in scene.protocol["assumed"][0]
    shutil.copy(toy / "pointclouds" / "frame2.npy", toy / "pointclouds" / "frame3.npy")
    (line,) = read_scene(toy.parent, "toy", frames=2).protocol["assumed"]
    assert "frame0 to frame3 are there, of which frame1 is taken for img/0; remove frame0, or" in line


def test_images_of_which_some_are_linear_are_said(toy):
    for path in toy.glob("img/*/img_0002.jpg"):
        with Image.open(path) as image:
            image.save(path, "PNG")
        say_linear(path)
    (line,) = read_scene(toy.parent, "toy").protocol["assumed"]
    assert "img: 3 of 12 images say that they are linear" in line


def test_two_folders_of_one_number_are_named(toy):
    shutil.copytree(toy / "img" / "2", toy / "img" / "002")
    with refused(r"got 002 and 2; remove one"):
        read_scene(toy.parent, "toy")


def test_masks_of_another_kind_are_named(toy):
    mask = toy / "img" / "0" / "mask" / "img_0000.jpg"
    mask.rename(mask.with_suffix(".png"))
    with refused(r"img_0000.png: expected .*, but got another; write JPEG, \.jpg"):
        read_scene(toy.parent, "toy")


def test_an_image_that_is_missing_in_the_first_frame_is_named(toy):
    (toy / "img" / "0" / "img_0000.jpg").unlink()
    with refused(r"0/img_0000\.jpg: expected"):
        read_scene(toy.parent, "toy")


@pytest.mark.parametrize(
    ("files", "also"),
    [
        (("CamPose.inf",), ""),
        (("CamPose.inf", "Intrinsic.inf"), ", and the blocks of Intrinsic.inf"),
    ],
)
def test_rows_in_another_order_than_images_are_told_by_clouds(tmp_path, files, also):
    cameras = [replace(c, cx=c.cx + 6 * (k % 3)) for k, c in enumerate(dome(12, ((60, 48),)))]
    write_dome(tmp_path / "toy", cameras, count=1)
    read_scene(tmp_path, "toy")
    order = sorted(range(12), key=str)
    for name in files:
        path, end = tmp_path / "toy" / name, "\n" if name == "CamPose.inf" else "\n\n"
        rows = path.read_text().strip().split(end)
        rows = [rows[k] for k in order]
        if name == "Intrinsic.inf":
            rows = [re.sub(r"^\d+", str(k), row) for k, row in enumerate(rows)]
        path.write_text(end.join(rows) + end)
    said = "if rows are in the order of cameras' numbers as texts, as 1, 10, 11, 2: row 4 is of img_0002.jpg"
    with refused(f"expected a row for .*, and 100% {said}.*; put the rows of CamPose.inf{also} into"):
        read_scene(tmp_path, "toy")
