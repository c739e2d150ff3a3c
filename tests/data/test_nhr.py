"""NHR scenes: what is written is read, points are where they are seen, bad files are one line."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from forewarp.data.images import write_jpeg
from forewarp.data.nhr import DomeFrame, read_scene, write_scene
from forewarp.scene.errors import SceneError
from tests.support.nhr_scene import BALLS, COLORS, STEP, dome, dome_frames, place, truth, write_dome


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A root with the scene ``toy``; not to be changed."""
    root = tmp_path_factory.mktemp("nhr")
    write_dome(root / "toy", trajectories=truth())
    return root


@pytest.fixture
def toy(written, tmp_path):
    """A copy of the scene, to be spoilt."""
    return Path(shutil.copytree(written / "toy", tmp_path / "toy"))


def spoil(path: Path, line: int, change) -> None:
    """Change one line, numbered from 1, of a text file; None takes it away."""
    lines = path.read_text().split("\n")
    changed = change(lines[line - 1]) if change else None
    lines[line - 1 : line] = [] if changed is None else [changed]
    path.write_text("\n".join(lines))


def test_round_trip(written):
    scene = read_scene(written, "toy", half_resolution=False)
    cameras, frames = dome(), list(dome_frames(dome()))
    by_name = {frame.name: frame for frame in scene.train + scene.test}
    assert list(by_name) == [
        *(f"{f}/img_{k:04d}" for f in range(3) for k in (1, 2, 3)),
        *(f"{f}/img_0000" for f in range(3)),
    ]
    for f in range(3):
        for k, camera in enumerate(cameras):
            frame = by_name[f"{f}/img_{k:04d}"]
            assert (frame.time, frame.ability) == (f / 2, "all" if k else "space")
            read = frame.camera
            torch.testing.assert_close(read.camera_to_world, camera.camera_to_world, atol=1e-6, rtol=0)
            for name in ("width", "height", "fx", "fy", "cx", "cy", "skew"):
                assert getattr(read, name) == getattr(camera, name)
            rgba, mask = frame.load().numpy(), frames[f].masks[k]
            assert rgba.shape == (camera.height, camera.width, 4)
            assert np.array_equal(rgba[..., 3], mask)
            off = np.abs(rgba[..., :3].astype(int) - frames[f].images[k])[mask > 0]
            assert off.mean() < 6
    assert scene.val == ()
    assert (scene.canonical_time, scene.has_alpha, scene.times) == (0.0, True, (0, 0.5, 1))
    assert torch.equal(scene.truth.points, truth().points)
    assert scene.protocol == {
        "dataset": "nhr",
        "resolution": [[60, 48], [48, 60]],
        "half_resolution": False,
        "frames": 3,
        "views": 4,
        "test_views": [0],
        "test_frames": 3,
        "mask_box": True,
    }


def test_the_files_are_as_the_format_says(written):
    """By hand: z axis, x axis, y axis, centre; images from 0, point clouds from 1."""
    toy, camera = written / "toy", dome()[2]
    pose = camera.camera_to_world
    line = np.loadtxt(toy / "CamPose.inf")[2]
    assert np.array_equal(line, torch.cat([pose[:3, 2], pose[:3, 0], pose[:3, 1], pose[:3, 3]]))
    block = (toy / "Intrinsic.inf").read_text().split("\n\n")[2].split("\n")
    assert block[0] == "2"
    matrix = [[camera.fx, camera.skew, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    assert [[float(v) for v in row.split()] for row in block[1:]] == matrix
    assert sorted(path.name for path in (toy / "img").iterdir()) == ["0", "1", "2"]
    clouds = sorted((toy / "pointclouds").iterdir())
    assert [path.name for path in clouds] == ["frame1.npy", "frame2.npy", "frame3.npy"]
    assert np.allclose(np.load(clouds[0])[:, :3], BALLS)


def test_the_box_holds_all_frames_and_a_tenth_more(written):
    box = read_scene(written, "toy").box
    low, high = BALLS.min(0), (BALLS + 2 * STEP).max(0)
    assert box.low == pytest.approx(tuple(low - 0.1 * (high - low)))
    assert box.high == pytest.approx(tuple(high + 0.1 * (high - low)))
    assert read_scene(written, "toy", box=[-1, -2, -3, 1, 2, 3]).box.low == (-1, -2, -3)


@pytest.mark.parametrize("half", [False, True])
def test_true_points_are_seen_where_the_cameras_say(written, half):
    scene = read_scene(written, "toy", half_resolution=half)
    for frame in scene.train + scene.test:
        f, rgba = int(frame.name.split("/")[0]), frame.load().double()
        row, column = torch.meshgrid(*(torch.arange(n) + 0.5 for n in rgba.shape[:2]), indexing="ij")
        for point, color in zip(BALLS + f * STEP, COLORS, strict=True):
            pixel, depth = frame.camera.project(torch.from_numpy(point))
            like = (rgba[..., :3] - torch.from_numpy(color)).abs().amax(-1) < 70
            weight = rgba[..., 3] * like
            assert depth > 0
            seen = torch.stack([(weight * column).sum(), (weight * row).sum()]) / weight.sum()
            # A ball that another one covers in part is seen elsewhere.
            if float(weight.sum()) > 0.9 * 255 * 16 * np.pi / (4 if half else 1):
                assert (seen - pixel).norm() < (0.3 if half else 0.4), (frame.name, point)
                assert np.allclose(pixel * (2 if half else 1), place(dome()[int(frame.name[-4:])], point))


def test_most_balls_are_seen_whole(written):
    """Guards the test above against comparing nothing."""
    frames = read_scene(written, "toy", half_resolution=False).train
    areas = [float(frame.load()[..., 3].sum()) / 255 for frame in frames]
    assert sum(area > 0.95 * 3 * 4 * np.pi for area in areas) >= len(frames) / 2  # three discs apart


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
    scene = read_scene(tmp_path, "odd", test_views=[1])
    camera = scene.train[0].camera
    assert (camera.width, camera.height) == (30, 24)
    assert (camera.fx, camera.cx, camera.skew) == (35.0, cameras[0].cx / 2, 0.35)
    assert scene.train[0].load().shape == (24, 30, 4)
    assert scene.times == (0.0,)


def test_held_out_views(tmp_path):
    write_dome(tmp_path / "many", dome(56, sizes=((2, 2),)), 1)
    views = read_scene(tmp_path, "many").protocol["test_views"]
    assert views == [0, 9, 18, 28, 37, 46]
    scene = read_scene(tmp_path, "many", test_views=[7, 3])
    assert [frame.name for frame in scene.test] == ["0/img_0003", "0/img_0007"]
    assert len(scene.train) == 54


def test_the_first_frames_and_every_other_one_measured(written):
    scene = read_scene(written, "toy", frames=2)
    assert (scene.times, len(scene.train), len(scene.test)) == ((0, 1), 6, 2)
    scene = read_scene(written, "toy", test_every=2, frames=200)
    assert [frame.name for frame in scene.test] == ["0/img_0000", "2/img_0000"]


@pytest.mark.parametrize(("frames", "there"), [(3, 5), (2, 3), (5, 5), (9, 5)])
def test_true_trajectories_keep_step_with_the_frames_that_are_read(tmp_path, frames, there):
    write_dome(tmp_path / "toy", count=there, trajectories=truth(there))
    scene = read_scene(tmp_path, "toy", frames=frames)
    places = {f.time: BALLS + int(f.name.split("/")[0]) * STEP for f in scene.train}
    times = scene.truth.times.tolist()
    assert times == pytest.approx(list(scene.times))
    for i, moment in enumerate(scene.times):
        assert scene.truth.points[:, i].numpy() == pytest.approx(places[moment], abs=1e-6)
    assert max(times) <= 1


def test_one_frame_has_no_trajectories(written):
    assert read_scene(written, "toy", frames=1).truth is None


INTRINSICS = {
    "a mark in front": lambda text: "\ufeff" + text,
    "one line a camera": lambda text: text.replace("\n\n", "|").replace("\n", " ").replace("|", "\n"),
    "all in one line": lambda text: " ".join(text.split()),
    "from 1": lambda text: re.sub(r"^(\d+)$", lambda m: str(int(m[1]) + 1), text, flags=re.MULTILINE),
}


@pytest.mark.parametrize("case", INTRINSICS)
def test_intrinsics_by_others(toy, case):
    expected = [f.camera for f in read_scene(toy.parent, "toy", half_resolution=False).train]
    path = toy / "Intrinsic.inf"
    path.write_text(INTRINSICS[case](path.read_text()), encoding="utf-8")
    found = [f.camera for f in read_scene(toy.parent, "toy", half_resolution=False).train]
    for one, other in zip(expected, found, strict=True):
        for name in ("width", "fx", "fy", "cx", "cy", "skew"):
            assert getattr(one, name) == getattr(other, name)


def test_a_mark_before_the_poses(toy):
    path = toy / "CamPose.inf"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert read_scene(toy.parent, "toy").protocol["views"] == 4


def test_files_by_others(toy):
    """Blanks and blank lines, three-channel masks, soft mask values, clouds as .obj, a leading mark."""
    text = (toy / "Intrinsic.inf").read_text()
    (toy / "Intrinsic.inf").write_text(text.replace("\n", "  \n\n ").replace(" 0.0", "   0"))
    poses = (toy / "CamPose.inf").read_text()
    (toy / "CamPose.inf").write_text("\n" + poses.replace(" ", "\t ") + "\n\n")
    grey = np.array([[[127, 255, 255], [128, 0, 0]]], np.uint8).repeat(24, 0).repeat(30, 1).repeat(2, 0)
    write_jpeg(toy / "img" / "0" / "mask" / "img_0000.jpg", grey, quality=100)
    cloud = toy / "pointclouds" / "frame2.npy"
    rows = [" ".join(map(str, row)) for row in np.load(cloud).tolist()]
    cloud.with_suffix(".obj").write_text("# points\n" + "".join(f"v {row}\n" for row in rows))
    cloud.unlink()
    scene = read_scene(toy.parent, "toy", half_resolution=False)
    assert scene.train[0].camera.fx == 71.0
    alpha = scene.test[0].load()[..., 3]
    assert (alpha[:, :29] == 0).all()
    assert (alpha[:, 31:] == 255).all()


def test_a_rewritten_scene_keeps_nothing_of_the_old_one(toy):
    write_dome(toy, dome(2), 1)
    scene = read_scene(toy.parent, "toy")
    assert (scene.protocol["frames"], scene.protocol["views"], scene.truth) == (1, 2, None)
    assert not (toy / "img" / "1").exists()


def test_a_run_cut_short_leaves_no_readable_scene(toy):
    def broken():
        yield from dome_frames(dome(), 1)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_scene(toy, dome(), broken())
    with pytest.raises(SceneError, match=r"expected a scene with CamPose.inf"):
        read_scene(toy.parent, "toy")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda f: DomeFrame(f.images[1:], f.masks, f.points), r"frame 0: expected 4 images .*got \(3, 4\)"),
        (
            lambda f: DomeFrame(f.masks, f.masks, f.points),
            r"frame 0: img_0000.jpg: expected the camera's size",
        ),
    ],
)
def test_the_writer_refuses_what_does_not_fit(tmp_path, change, match):
    frame = change(next(dome_frames(dome())))
    with pytest.raises(ValueError, match=match):
        write_scene(tmp_path / "x", dome(), [frame])


def words(change):
    """A line's words changed."""
    return lambda line: " ".join(change(line.split()))


POSES, LENSES = "CamPose.inf", "Intrinsic.inf"
BAD_TEXT = {
    "eleven": (POSES, 2, words(lambda w: w[:11]), r"line 2: expected 12 finite numbers, but got 11"),
    "word": (POSES, 3, words(lambda w: ["x", *w[1:]]), r"line 3: expected 12 finite numbers"),
    "mirror": (
        POSES,
        2,
        words(lambda w: [str(-float(v)) for v in w[:3]] + w[3:]),
        r"line 2: expected a rotation, but got determinant -1",
    ),
    "pose gone": (POSES, 4, None, r"Intrinsic.inf: expected as many cameras .*got 4 there and 3 in"),
    "two in a row": (
        LENSES,
        2,
        words(lambda w: w[:2]),
        r"line 3: expected a row 0 fy cy, but got 71.5 23.2 0",
    ),
    "another index": (LENSES, 6, lambda line: "2", r"line 6: expected the number 1 of a camera, but got '2'"),
    "from 2": (LENSES, 1, lambda line: "2", r"line 1: expected the number 0 of a camera, but got '2'"),
    "no index": (LENSES, 6, None, r"line 6: expected the number 1 of a camera, but got '71.0"),
    "row gone": (LENSES, 3, None, r"line 3: focal length: expected a number .*got 0"),
    "last gone": (LENSES, 19, None, r"line 18: expected nine numbers of camera 3, .* after 6"),
    "focal 0": (LENSES, 2, words(lambda w: ["0", *w[1:]]), r"line 2: focal length: expected"),
    "no pinhole": (LENSES, 4, lambda line: "0 0 2", r"line 4: expected the row 0 0 1, but got 0 0 2"),
    "sheared": (LENSES, 3, lambda line: "1 70 20", r"line 3: expected a row 0 fy cy, but got 1 70 20"),
}


def refused(toy: Path, match: str, **options) -> None:
    """Reading is one line that names the folder."""
    with pytest.raises(SceneError, match=match) as caught:
        read_scene(toy.parent, "toy", **options)
    assert "\n" not in str(caught.value)
    assert str(toy) in str(caught.value)


@pytest.mark.parametrize("case", BAD_TEXT)
def test_bad_camera_files(toy, case):
    name, line, change, match = BAD_TEXT[case]
    spoil(toy / name, line, change)
    refused(toy, re.escape(f"{toy / name}: ") + match if "as many" not in match else match)


def grown(path: Path) -> None:
    write_jpeg(path, np.zeros((48, 62, 3) if path.parent.name == "1" else (48, 62), np.uint8))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def cloud(change):
    return lambda path: np.save(path, change(np.load(path)))


BAD_FILES = {
    "no image": ("img/1/img_0002.jpg", Path.unlink, r"expected an image of every camera .*, but got none"),
    "no mask": ("img/1/mask/img_0002.jpg", Path.unlink, r"expected an image of every camera"),
    "one more": (
        "img/1/img_0004.jpg",
        lambda p: shutil.copy(p.with_name("img_0000.jpg"), p),
        r"expected images of the 4 cameras of CamPose.inf, but got another",
    ),
    "image size": ("img/1/img_0002.jpg", grown, r"expected 60 x 48 pixels as in .*, but got 62 x 48"),
    "mask size": ("img/0/mask/img_0002.jpg", grown, r"expected 60 x 48 pixels as in .*, but got 62 x 48"),
    "truncated": ("img/1/img_0001.jpg", cut, r"expected a whole image, but got a truncated or harmed one"),
    "no cloud": ("pointclouds/frame2.npy", Path.unlink, r"expected a NumPy file, but got No such file"),
    "cloud shape": (
        "pointclouds/frame1.npy",
        cloud(lambda c: c[:, :5]),
        r"expected points \(N, 6\), but got",
    ),
    "cloud empty": ("pointclouds/frame1.npy", cloud(lambda c: c[:0]), r"expected points \(N, 6\), but got"),
    "cloud nan": (
        "pointclouds/frame3.npy",
        cloud(lambda c: c * np.nan),
        r"expected finite numbers, .*in row 0",
    ),
    "cloud far off": (
        "pointclouds/frame2.npy",
        cloud(lambda c: np.where(c == c[1, 2], 1e30, c)),
        r"expected points within 1e\+09 units, but got 1e\+30 in row 1; export it again",
    ),
    "cloud text": ("pointclouds/frame3.npy", lambda p: p.write_text("v 1"), r"expected a NumPy file"),
    "no lenses": ("Intrinsic.inf", Path.unlink, r"expected a readable file, but got No such file"),
    "no poses": ("CamPose.inf", lambda p: p.write_text(" \n"), r"expected at least one camera"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files(toy, case):
    name, change, match = BAD_FILES[case]
    change(toy / name)
    refused(toy, re.escape(str(toy / name)) + ".*" + match)


def test_a_missing_frame_is_named(toy):
    shutil.rmtree(toy / "img" / "1")
    refused(toy, r"img/1: expected a folder of images, but got none")
    shutil.rmtree(toy / "img")
    refused(toy, r"img/0: expected a folder of images, but got none")


def test_a_flat_cloud_has_no_box(toy):
    for path in (toy / "pointclouds").glob("*.npy"):
        cloud(lambda c: c * [1, 1, 0, 1, 1, 1])(path)
    refused(toy, r"pointclouds: expected points that span a box, .*; set data.box")
    assert read_scene(toy.parent, "toy", box=[-1, -1, -1, 1, 1, 1]).box.high == (1, 1, 1)


def test_one_camera_is_too_few(tmp_path):
    write_dome(tmp_path / "toy", dome(1), 1)
    refused(tmp_path / "toy", r"CamPose.inf: expected at least 2 cameras, one to measure, but got 1")


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (
            {"test_views": [4]},
            r"data.test_views: expected different cameras of 0 to 3, not all, but got \[4\]",
        ),
        ({"test_views": [0, 1, 2, 3]}, "data.test_views: expected"),
        ({"test_views": []}, "data.test_views: expected"),
        ({"test_views": [1, 1]}, "data.test_views: expected"),
        ({"test_views": 1}, "data.test_views: expected"),
        ({"frames": 0}, "data.frames: expected a whole number of at least 1, but got 0"),
        ({"test_every": 1.5}, "data.test_every: expected a whole number of at least 1, but got 1.5"),
        ({"half_resolution": "auto"}, "data.half_resolution: expected true or false, but got 'auto'"),
        ({"box": [1, 2, 3]}, "data.box: expected six numbers"),
    ],
)
def test_bad_settings(written, options, match):
    with pytest.raises(SceneError, match=match):
        read_scene(written, "toy", **options)


def test_images_that_go_bad_later_are_refused_too(toy):
    scene = read_scene(toy.parent, "toy")
    grown(toy / "img" / "0" / "mask" / "img_0001.jpg")
    with pytest.raises(SceneError, match=r"mask/img_0001.jpg: expected 48 x 60 pixels, but got 62 x 48"):
        scene.train[0].load()


def test_reading_a_scene_decodes_no_image(written, monkeypatch):
    def decode(*_):
        raise AssertionError

    monkeypatch.setattr("forewarp.data.images._decode", decode)
    scene = read_scene(written, "toy")
    with pytest.raises(AssertionError):
        scene.train[0].load()
