"""Rigs of fixed cameras in the layout of DyNeRF: videos or folders of frames, and poses_bounds.npy."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from forewarp.data.batches import Sampler
from forewarp.data.checks import blind_frames
from forewarp.data.films import STORE
from forewarp.data.images import CACHE, write_image
from forewarp.data.module import MulticamDataModule
from forewarp.data.multicam import FILE, read_scene, write_poses
from forewarp.data.rigs import held_cameras, refuse_copied_poses
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame
from tests.support.films import numbered, write_film
from tests.support.written_scenes import fixed_cameras, grey, placed, refused, say_linear, write_multicam

CAMERAS = fixed_cameras(3)


@pytest.fixture(scope="module")
def films(tmp_path_factory):
    """The root of a rig of videos, which no test changes."""
    root = tmp_path_factory.mktemp("films")
    write_multicam(root / "toy", CAMERAS[:2], count=4)
    return root


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """The root of a rig of three cameras whose six frames are images in folders."""
    root = tmp_path_factory.mktemp("frames")
    for k, camera in enumerate(CAMERAS):
        for n in range(6):
            write_image(root / "toy" / f"cam{k:02d}" / f"{n:04d}.png", grey(camera, n, k))
    write_poses(root / "toy", CAMERAS, near=14.0, far=30.0)
    return root


@pytest.fixture
def folder(frames, tmp_path):
    """A copy to change."""
    return shutil.copytree(frames / "toy", tmp_path / "toy")


def tells(image):
    """The numbers of the camera and the frame that ``grey`` tells."""
    return [round((float(image[..., x, 0].float().mean()) - 20) / 20) for x in (2, -2)]


@pytest.mark.slow
def test_films_are_read_as_a_rig_whose_first_camera_is_held_out(films):
    scene = read_scene(films, "toy")
    assert [f.name for f in scene.test] == [f"cam00/{n:04d}" for n in range(4)]
    assert {f.ability for f in scene.test} == {"space"}
    assert [(f.camera_id, f.time) for f in scene.train] == [(1, n / 3) for n in range(4)]
    assert [tells(f.load()) for f in scene.train] == [[1, n] for n in range(4)]
    expected = {"dataset": "multicam", "resolution": [24, 16], "scale": 2, "frames": 4, "views": 2}
    expected |= {"test_cameras": ["cam00"], "test_moments": [], "test_frames": 4}
    assert expected.items() <= scene.protocol.items()
    assert scene.protocol["seconds"] == pytest.approx(3 / 30, abs=1e-3)
    assert "assumed" not in scene.protocol
    for frame in (scene.test[0], scene.train[0]):
        camera = placed(scene, CAMERAS[frame.camera_id])
        torch.testing.assert_close(frame.camera.camera_to_world, camera.camera_to_world)
        assert frame.camera.fx == frame.camera.fy == CAMERAS[0].fx / 2
    assert float(scene.test[0].camera.center.norm()) == pytest.approx(1)


@pytest.mark.slow
def test_with_no_room_in_memory_or_on_disk_each_frame_is_sought_in_its_film(films, monkeypatch):
    whole = [frame.load() for frame in read_scene(films, "toy").train]
    monkeypatch.setattr(CACHE, "limit", 2000)
    monkeypatch.setattr(STORE, "limit", 0)
    scene = read_scene(films, "toy")
    (line,) = scene.protocol["assumed"]
    assert "all frames take 1.23e-05 GB, more than data.cache_bytes" in line
    assert line.endswith("mkdir cam00; ffmpeg -i cam00.mp4 cam00/%04d.png")
    for frame, expected in zip(scene.train, whole):
        torch.testing.assert_close(frame.load(), expected, rtol=0, atol=0)


def test_axes_of_a_row_are_down_right_backwards(frames, tmp_path):
    shutil.copytree(frames / "toy", tmp_path / "toy")
    row = [0, 1, 0, 0, 32, -1, 0, 0, 0, 48, 0, 0, 1, 5, 60, 2, 9]  # at (0, 0, 5), y up, looking along -z
    np.save(tmp_path / "toy" / FILE, np.array([row] * 3) + np.arange(3)[:, None] * (np.arange(17) == 3))
    pose = read_scene(tmp_path, "toy", normalise=False, scale=1).test[0].camera.camera_to_world
    assert pose.tolist() == [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 5], [0, 0, 0, 1]]


def test_folders_of_frames_go_before_films_and_may_be_smaller(frames, tmp_path):
    write_poses(tmp_path / "toy", CAMERAS, near=14.0, far=30.0)
    for k, camera in enumerate(CAMERAS):
        small = camera.resized(24, 16)
        for n in range(4):
            write_image(tmp_path / "toy" / f"cam{k:02d}" / "images" / f"{n:04d}.png", grey(small, n, 9 - k))
        (tmp_path / "toy" / f"cam{k:02d}.mp4").touch()
    half, quarter = read_scene(tmp_path, "toy"), read_scene(tmp_path, "toy", scale=4)
    assert half.protocol["resolution"] == [24, 16]
    assert quarter.protocol["resolution"] == [12, 8]
    assert [tells(scene.train[-1].load()) for scene in (half, quarter)] == [[7, 3]] * 2
    assert half.train[-1].name == "cam02/0003"
    large = read_scene(frames, "toy", scale=1).train[0]
    assert (large.load().shape, large.camera.fx) == ((32, 48, 4), CAMERAS[0].fx)


def test_cameras_and_moments_are_held_out_by_name_and_told_apart(frames):
    scene = read_scene(frames, "toy", test_cameras=["cam02"], test_moments=[1, 4], test_every=2)
    abilities = ("space", "time", "space_time")
    kinds = {kind: [f.name for f in scene.test if f.ability == kind] for kind in abilities}
    assert kinds == {
        "space": ["cam02/0000", "cam02/0002"],
        "time": ["cam00/0001", "cam01/0001", "cam00/0004", "cam01/0004"],
        "space_time": ["cam02/0001", "cam02/0004"],
    }
    assert [f.name for f in scene.train] == [f"cam{k:02d}/{n:04d}" for n in (0, 2, 3, 5) for k in (0, 1)]
    only = read_scene(frames, "toy", test_cameras=[], test_moments=[3])
    assert {f.name for f in only.test} == {"cam00/0003", "cam01/0003", "cam02/0003"}
    assert len(read_scene(frames, "toy", frames=3).train) == 6


def test_a_step_has_several_cameras_of_one_moment(frames):
    data = MulticamDataModule(frames, "toy", views_per_step=2, rays=8)
    assert isinstance(data.batches, Sampler)
    for _ in range(4):
        moments = [observation.moment for observation in data.batches.draw().observations]
        assert {moment.camera for moment in moments} == {1, 2}
        assert len({moment.time for moment in moments}) == 1


def test_cameras_of_other_lengths_are_cut_to_the_shortest(folder):
    (folder / "cam01" / "0005.png").unlink()
    scene = read_scene(folder.parent, "toy")
    assert scene.times == (0.0, 0.25, 0.5, 0.75, 1.0)
    line = f"{folder}: cam01 has 5 frames, others up to 6: all are cut to the first 5"
    assert scene.protocol["assumed"] == [line]
    assert "assumed" not in read_scene(folder.parent, "toy", frames=5).protocol


def test_a_camera_is_looked_through_once_for_all_its_frames(frames, monkeypatch):
    scene, project, calls = read_scene(frames, "toy"), Camera.project, []
    monkeypatch.setattr(
        Camera, "project", lambda camera, points: calls.append(camera) or project(camera, points)
    )
    assert blind_frames(scene) == 0
    assert len(calls) == 2 < len(scene.train)
    away = replace(scene, box=Box((90, 90, 90), (91, 91, 91)))
    assert blind_frames(away) == len(scene.train)


def rows(change):
    """A change of poses_bounds.npy."""

    def harm(folder):
        np.save(folder / FILE, change(np.load(folder / FILE)))

    return harm


def written(name, size=(32, 48)):
    """A change that writes an image."""
    return lambda folder: write_image(folder / name, np.zeros((*size, 3), np.uint8))


def opencv(array):
    """The same cameras with OpenCV's axes."""
    blocks = array[:, :15].reshape(-1, 3, 5).copy()
    blocks[..., [0, 1]] = blocks[..., [1, 0]]
    blocks[..., 2] *= -1
    return np.concatenate([blocks.reshape(-1, 15), array[:, 15:]], 1)


def set_to(row, column, value):
    def change(array):
        array[row, column] = value
        return array

    return rows(change)


def suffixed(folder, left_out):
    """Let names of images not end in their number; the cameras named lack one image, and have one more."""
    for place in folder.glob("cam*"):
        images = sorted(place.iterdir())
        for number, image in enumerate(images):
            later = number + (number >= left_out.get(place.name, len(images)))
            image.rename(place / f"{later:04d}_v2.png")


def called(names):
    """Give the cameras other names; those of films are of empty ones."""

    def rename(folder):
        for name, place in zip(names, sorted(folder.glob("cam*")), strict=True):
            if "." in name:
                shutil.rmtree(place)
                (folder / name).touch()
            else:
                place.rename(folder / name)

    return rename


BAD = [
    (rows(lambda a: a[:2]), rf"{FILE}: expected a row for each of 3 cameras, cam00 to cam02, but got 2 rows"),
    (rows(lambda a: a[:, :15]), r"npy: expected 17 numbers for each camera, but got shape \(3, 15\)"),
    (lambda folder: (folder / FILE).write_bytes(b"text"), "npy: expected a NumPy file, but got one that"),
    (set_to(1, 3, np.nan), r"row 1 \(cam01\): expected 4 x 4 or 3 x 4 finite numbers"),
    (set_to(1, 0, 3), r"row 1 \(cam01\): expected a rotation"),
    (set_to(2, 14, 0), r"row 2 \(cam02\): focal length: expected a number in \[0.48, 4800\], but got 0"),
    (set_to(2, 9, 48.5), r"row 2 \(cam02\): height and width: expected whole numbers, but got 32 and 48.5"),
    (set_to(2, 16, 3), r"row 2 \(cam02\): bounds: expected 0 < near < far, but got 14 and 3"),
    (set_to(2, 16, 3e4), r"row 2 \(cam02\): expected far within 10 times .*, 30, but got .* set data.far"),
    (set_to(2, 15, 0.014), r"row 2 \(cam02\): expected near within 10 times .*, 14, but got 0.014, as of"),
    (
        rows(lambda a: a[[0, 1, 1]]),
        "npy: expected a pose for each camera, but got one for cam01/0000 and cam02/0000, whose",
    ),
    (set_to(2, 9, 50), "cam02: expected 50 x 32 or 25 x 16 pixels as .* say, but got 48 x 32"),
    (lambda folder: [shutil.rmtree(place) for place in folder.glob("cam*")], "a video for each camera"),
    (
        called(["left", "middle", "right"]),
        "3 of other names, as left; rename them to cam00, cam01 .. in the order of the rows of poses",
    ),
    (
        called(["GX010042.MP4", "GX010043.MP4", "GX010044.MP4"]),
        "as GX010042.MP4; rename them to cam00.MP4, cam",
    ),
    (called(["192.168.1.95.mp4", "192.168.1.96.mp4", "192.168.1.100.mp4"]), "as 192.168.1.95.mp4; rename"),
    (written("cam01/0003.png", (16, 24)), "0003.png: expected 48 x 32 pixels as the first, but got 24 x 16"),
    (
        lambda folder: (folder / "cam01" / "0003.png").rename(folder / "cam01" / "0013.png"),
        "cam01: expected a frame of the number of cam00/0003.png, but got 0004.png; remove a frame that",
    ),
    (
        lambda folder: suffixed(folder, {"cam01": 3}),
        "cam01: expected a frame of the number of cam00/0003_v2.png, but got 0004_v2.png; remove a",
    ),
]


@pytest.mark.parametrize(("harm", "match"), BAD)
def test_a_harmed_rig_is_refused_in_a_line(folder, harm, match):
    harm(folder)
    with refused(match) as caught:
        read_scene(folder.parent, "toy")
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"scale": 3}, "data.scale: expected a divisor of both sides of 48 x 32 pixels, but got 3"),
        ({"scale": 0}, "data.scale: expected a whole number of at least 1, but got 0"),
        ({"frames": 0}, "data.frames: expected a whole number of at least 1, but got 0"),
        ({"test_cameras": ["cam07"]}, r"some of .* cam00, cam01, cam02, not all, but got no camera cam07"),
        ({"test_cameras": "cam00"}, "data.test_cameras: expected some of the cameras"),
        ({"test_cameras": ["cam00", "cam01", "cam02"]}, "data.test_cameras: expected some of the cameras"),
        ({"test_cameras": []}, "expected a camera or a moment to test on, but got none; name some in"),
        ({"test_moments": [6]}, r"data.test_moments: expected numbers of 0 to 5, not all, but got \[6\]"),
        ({"test_moments": [0, 1, 2, 3, 4, 5]}, "data.test_moments: expected numbers"),
        ({"near": 20, "far": 3}, "expected near < far, but got 20 and 3"),
        ({"normalise": "no"}, "data.normalise: expected true or false, but got 'no'"),
        ({"box": [1, 2]}, "data.box: expected six numbers"),
    ],
)
def test_bad_options_are_refused_in_a_line(frames, options, match):
    with refused(match):
        read_scene(frames, "toy", **options)


def test_poses_in_other_axes_are_named(tmp_path):
    """Of four cameras and more it can be told."""
    (tmp_path / "toy").mkdir()
    for k, camera in enumerate(cameras := fixed_cameras(4)):
        write_image(tmp_path / "toy" / f"cam{k:02d}" / "0.png", grey(camera, 0, k))
    blocks = [np.c_[c.camera_to_world[:3].numpy(), [c.height, c.width, c.fx]].flatten() for c in cameras]
    np.save(tmp_path / "toy" / FILE, np.c_[np.array(blocks), [[14.0, 30.0]] * 4])
    with refused("look at one thing only if the axes are OpenCV's; convert them"):
        read_scene(tmp_path, "toy")


def test_names_of_many_cameras_are_shortened():
    with refused("some of the cameras cam00, cam01 .. cam19, not all, but got no camera x"):
        held_cameras(["x"], [f"cam{k:02d}" for k in range(20)], [])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("numbers", "says"),
    [
        ((0, 1), None),
        ((1, 2), None),
        ((2, 3), "cam01: expected all 4 frames, as cam00.mp4 has, but got 2, from 0002.png to 0003.png"),
        ((0, 2), "cam01: expected all 4 frames"),
        ((10, 20, 30, 40), None),
    ],
)
def test_frames_in_a_folder_are_compared_with_the_films_beside_it(films, tmp_path, numbers, says):
    folder = shutil.copytree(films / "toy", tmp_path / "toy")
    (folder / "cam01.mp4").unlink()
    for k, number in enumerate(numbers):
        write_image(folder / "cam01" / f"{number:04d}.png", grey(CAMERAS[1], k, 1))
    if says:
        with refused(says):
            read_scene(tmp_path, "toy")
        return
    scene = read_scene(tmp_path, "toy")
    assert scene.protocol["frames"] == len(numbers)
    line = (
        f"{folder}: cam01 has 2 frames, others up to 4: all are cut to the first 2; a film that begins later"
    )
    assert ("".join(scene.protocol.get("assumed", ())).startswith(line)) == (len(numbers) == 2)


def test_a_film_that_may_begin_later_is_said_also_of_few_frames(films, tmp_path):
    folder = shutil.copytree(films / "toy", tmp_path / "toy")
    write_film(folder / "cam01.mp4", numbered(3, (32, 48)), stamps="N*1000/30")
    (line,) = read_scene(tmp_path, "toy", frames=2).protocol["assumed"]
    assert "cam01.mp4 has 3 frames, others up to 4: all are cut to the first 2; a film that begins" in line


@pytest.mark.slow
def test_films_of_two_rates_or_none_at_all_are_refused(films, tmp_path):
    folder = shutil.copytree(films / "toy", tmp_path / "toy")
    write_film(folder / "cam01.mp4", numbered(6, (32, 48)), stamps="N*40")
    with refused("cam01.mp4: expected .* of cam00.mp4, 30 a second, but got 25 a second, 0.02 s apart"):
        read_scene(tmp_path, "toy")
    (folder / "cam01.mp4").write_bytes(b"text")
    with refused("cam01.mp4: expected a video, but got another file; copy it again"):
        read_scene(tmp_path, "toy")


@pytest.mark.slow
def test_films_that_drift_are_said(films, tmp_path):
    folder = shutil.copytree(films / "toy", tmp_path / "toy")
    for name, step in (("cam00", "40"), ("cam01", "40.2")):
        write_film(folder / f"{name}.mp4", numbered(30, (32, 48)), stamps=f"N*{step}")
    (line,) = read_scene(tmp_path, "toy").protocol["assumed"]
    assert "cam01.mp4: runs apart from cam00.mp4, by 0.12 frames at the end of 30; convert both" in line
    assert "assumed" not in read_scene(tmp_path, "toy", frames=15).protocol


def test_cameras_of_which_one_says_that_it_is_linear_are_said(folder):
    for path in (folder / "cam01").iterdir():
        say_linear(path)
    (line,) = read_scene(folder.parent, "toy").protocol["assumed"]
    assert f"{folder}: 6 of 18 images say that they are linear" in line


@pytest.mark.parametrize("change", [{"fy": 1.0}, {"cx": 3.0}])
def test_cameras_that_the_layout_cannot_tell_are_not_written(tmp_path, change):
    with refused("camera 0: expected square pixels, the principal point"):
        write_poses(tmp_path, [replace(CAMERAS[0], **change)], near=1, far=2)


def test_gaps_in_frame_numbers_are_gaps_in_time(folder):
    assert "assumed" not in read_scene(folder.parent, "toy").protocol
    for place in folder.glob("cam*"):
        (place / "0002.png").unlink()
        (place / "0003.png").unlink()
    scene = read_scene(folder.parent, "toy")
    assert scene.times == pytest.approx((0, 0.2, 0.8, 1))
    assert "times are those of the numbers in the images' names" in scene.protocol["assumed"][0]


def test_one_camera_is_tested_on_moments_alone(tmp_path):
    for n in range(4):
        write_image(tmp_path / "toy" / "cam00" / f"{n:04d}.png", grey(CAMERAS[0], n, 0))
    write_poses(tmp_path / "toy", CAMERAS[:1], near=14.0, far=30.0)
    with refused("a camera or a moment to test on, but got none; name some in"):
        read_scene(tmp_path, "toy")
    assert len(read_scene(tmp_path, "toy", test_moments=[1]).train) == 3


def test_a_camera_that_counts_from_another_number_is_named(folder):
    for path in sorted((folder / "cam02").iterdir(), reverse=True):
        path.rename(path.with_name(f"{int(path.stem) + 1:04d}.png"))
    with refused("if only its count begins at another number, rename its frames by -1; else remove a frame"):
        read_scene(folder.parent, "toy")


def test_copied_poses_are_of_images_that_differ_in_two_folders_or_of_two_cameras():
    def frame(name, bright, camera_id=None):
        pixels = torch.full((32, 48, 4), bright, dtype=torch.uint8)
        return Frame(name, 0.5, CAMERAS[0], lambda: pixels, camera_id=camera_id)

    for other in (frame("a/2", 90), frame("b/1", 9), replace(frame("b/1", 90), time=0.6)):
        refuse_copied_poses([frame("a/1", 9), other], "toy")
    for pair in ([frame("a/1", 9), frame("b/1", 90)], [frame("a/1", 9, 0), frame("a/2", 90, 1)]):
        with refused(f"toy: expected a pose for each camera, but got one for a/1 and {pair[1].name}, whose"):
            refuse_copied_poses(pair, "toy")


def test_rows_without_the_turn_of_llff_are_named(tmp_path):
    cameras = fixed_cameras(6)
    for k in range(6):
        write_image(tmp_path / "toy" / f"cam{k:02d}" / "0000.png", grey(cameras[k], 0, k))
    for turned in (False, True):
        write_poses(tmp_path / "toy", cameras, near=14.0, far=30.0)
        if turned:  # right, up, backwards
            table = np.load(tmp_path / "toy" / FILE)
            blocks = table[:, :15].reshape(-1, 3, 5)
            blocks[..., :2] = np.stack([blocks[..., 1], -blocks[..., 0]], -1)
            np.save(tmp_path / "toy" / FILE, table)
        told = "".join(read_scene(tmp_path, "toy").protocol.get("assumed") or [])
        assert ("turned by a quarter about their axes" in told) == turned


def test_films_of_other_names_are_said_or_refused(folder):
    (folder / "cam02").rename(folder / "left")
    with refused("a row for each of 2 cameras, cam00, cam01, but got 3 rows, as if left were cameras, too"):
        read_scene(folder.parent, "toy")
    write_poses(folder, CAMERAS[:2], near=14.0, far=30.0)
    (line,) = read_scene(folder.parent, "toy").protocol["assumed"]
    assert line.endswith("toy: left not read, as names of cameras begin with cam")


def test_files_that_go_with_frames_are_left_out_and_twins_refused(folder):
    for path in sorted(folder.glob("cam*/*.png")):
        shutil.copy(path, path.with_name(f"{path.stem}_mask.png"))
    (folder / "cam00_flow").mkdir()
    shutil.copy(folder / "cam00/0000.png", folder / "cam00_flow")
    scene = read_scene(folder.parent, "toy")
    assert [tells(f.load()) for f in scene.test] == [[0, n] for n in range(6)]
    said = [f"{folder}: cam00_flow is left out", f"{folder}/cam00: 0000_mask.png and 5 more are left out"]
    assert [line[: len(start)] for line, start in zip(scene.protocol["assumed"], said)] == said
    shutil.copy(folder / "cam02/0003.png", folder / "cam02/0003.jpg")
    with refused("cam02: expected one image of each name, but got 0003.jpg and 0003.png"):
        read_scene(folder.parent, "toy")


def test_one_of_two_films_or_folders_of_a_camera_is_said(films, tmp_path):
    folder = shutil.copytree(films / "toy", tmp_path / "toy")
    shutil.copy(folder / "cam00.mp4", folder / "cam01.mov")
    scene = read_scene(tmp_path, "toy")
    assert [tells(f.load())[0] for f in scene.train] == [1] * 4
    assert scene.protocol["assumed"] == [f"{folder}: cam01.mp4 is read, not cam01.mov; remove what is old"]
    (folder / "cam01.mov").unlink()
    for n in range(4):
        write_image(folder / "cam00" / f"{n:04d}.png", grey(CAMERAS[0], n, 0))
    (line,) = read_scene(tmp_path, "toy").protocol["assumed"]
    assert line == f"{folder}: cam00/ is read, not cam00.mp4; remove what is old"


def test_frames_counted_in_hexadecimal_need_a_pattern(folder):
    for camera in folder.glob("cam*"):
        for n, path in enumerate(sorted(camera.iterdir())):
            path.rename(camera / f"{n + 7:04x}.png")
    with refused("cam00: .* names as '000a': .* hexadecimal numbers; .*data.name_pattern"):
        read_scene(folder.parent, "toy")
    scene = read_scene(folder.parent, "toy", name_pattern="(?P<frame>[0-9a-f]+)")
    assert scene.times == pytest.approx(np.linspace(0, 1, len(scene.times)))
