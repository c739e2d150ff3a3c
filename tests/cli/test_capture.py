"""forewarp-capture as people call it; the parts are tested in tests/capture."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from PIL import Image

pytest.importorskip("pycolmap", reason="no pycolmap; make install adds it")

from forewarp.cli.capture import check
from forewarp.data.posed_video import PosedShot, read_scene, write_scene
from forewarp.scene.box import Box
from forewarp.synth.raycast import render
from forewarp.synth.recordings import synthesize_multicam
from forewarp.synth.scenes import random_cameras
from forewarp.synth.world import World
from tests.bench.rigs import compared
from tests.support.captures import cameras_on_arc, hand_film, pose_errors, write_model
from tests.support.configs import CONF
from tests.support.films import numbered, write_film

POINTS = np.random.default_rng(0).uniform(-1, 1, (200, 3))


def write_images(folder, cameras, seed=0):
    """An image of noise for each camera."""
    folder.mkdir()
    rng = np.random.default_rng(seed)
    for name, camera in cameras.items():
        Image.fromarray(rng.integers(0, 256, (camera.height, camera.width, 3), np.uint8)).save(folder / name)


FILM = "video=a.mp4"


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "expected video=FILE, videos=FOLDER or images=FOLDER, but got none; set one of them"),
        ([FILM, "images=empty"], "video, videos, images: expected .* but got video and images; set one"),
        (["videos=a.mp4"], "videos: expected an existing folder, but got another thing"),
        (["videos=empty", "colmap=empty"], "colmap: expected images=FOLDER beside it, but got videos="),
        (["videos=empty", "out=empty/new"], "out: expected a folder apart from .*new with videos=empty"),
        ([FILM, "without=[a]"], "without: expected videos=FOLDER beside it, but got video=; remove it"),
        (["videos=empty", "without=a"], r"without: expected a list .* but got a; write without=\[a\]"),
        (["videos=empty", "fixed=x"], "fixed: expected true, false or null, but got 'x'"),
        (["videos=empty", "rate=0"], "rate: expected pictures a second, above 0, but got 0"),
        (["video=none.mp4"], "video: expected an existing file, but got none: none.mp4"),
        (["video=empty"], "video: expected an existing file, .* got another thing: empty; set images=empty"),
        (["video=empty/frame_%05d.png"], "video: expected an existing file, .*; set images=empty"),
        (["images=a.mp4"], "images: expected an existing folder, but got another thing"),
        ([FILM, "colmap=empty"], "colmap: expected images=FOLDER beside it, but got video="),
        (["video=A.R3D", "masks=empty"], "masks: expected none beside a scan of Record3D, but got one"),
        ([FILM, "frames=2"], "frames: expected a whole number of at least 3, but got 2"),
        ([FILM, "size=10"], "size: expected a whole number of at least 64, but got 10"),
        ([FILM, "seed=-1"], r"seed: expected a whole number in \[0, 2147483548\], but got -1"),
        ([FILM, "lens=FOV"], "lens: expected SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL"),
        ([FILM, "matching=x"], "matching: expected auto, sequential or exhaustive, but got 'x'"),
        ([FILM, "out=."], "out: expected a folder to be made, but got ., which you are in"),
        (
            ["images=empty", "out=empty/new"],
            "out: .* apart from what is read, but got empty/new with images=",
        ),
        ([FILM, "masks=empty", "out=empty/new"], "out: .* but got empty/new with masks=empty; set out="),
        (["images=full/empty", "out=full"], "what is read, but got full with images=full/empty; set"),
        ([FILM, "out=full"], "full: expected no folder, an empty one, or one written before"),
    ],
)
def test_mistakes_end_before_anything_is_loaded(in_tmp, words, says):
    for folder in ("empty", "full/empty"):
        (in_tmp / folder).mkdir(parents=True)
    for file in ("a.mp4", "A.R3D", "full/theirs"):
        (in_tmp / file).touch()
    config = OmegaConf.merge(OmegaConf.load(CONF / "capture.yaml"), OmegaConf.from_dotlist(words))
    with pytest.raises(ValueError, match=says):
        check(config)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["images=2024_11"], "images: expected an existing folder, but got none: 2024_11;"),
        (["video=VID (1),a=b.mp4"], "video: expected an existing file, but got none: VID (1),a=b.mp4;"),
        (["images=empty"], "empty: expected a folder of many pictures, PNG or JPEG, but got none"),
    ],
)
def test_a_refusal_is_one_line_and_leaves_nothing(refused, in_tmp, words, says):
    (in_tmp / "empty").mkdir()
    assert says in refused("capture", "threads=1", *words)
    assert sorted(path.name for path in in_tmp.iterdir()) == ["empty"]


def test_without_its_package_it_says_what_to_install(in_tmp, monkeypatch):
    (in_tmp / "a.mp4").touch()
    config = OmegaConf.merge(OmegaConf.load(CONF / "capture.yaml"), {"video": "a.mp4"})
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *rest: None)
    with pytest.raises(ImportError, match=r"expected pycolmap, but got none; install forewarp\[capture\]"):
        check(config)


def turned(count):
    """A camera that turns on the spot inside a patterned sphere."""
    pattern = np.random.default_rng(0).integers(0, 256, (60, 120, 3)).astype(np.uint8)
    columns, rows = np.meshgrid(np.arange(240) - 119.5, np.arange(180) - 89.5)
    rays = np.stack([columns / 200, rows / 200, np.ones_like(rows)], -1)
    frames = []
    for angle in np.linspace(0, 0.9, count):
        x = rays[..., 0] * np.cos(angle) + rays[..., 2] * np.sin(angle)
        z = -rays[..., 0] * np.sin(angle) + rays[..., 2] * np.cos(angle)
        across, up = np.arctan2(x, z), np.arctan2(rays[..., 1], np.hypot(x, z))
        frames.append(pattern[(30 + up * 30).astype(int), (40 + across * 30).astype(int)])
    return np.stack(frames)


@pytest.mark.slow
def test_a_camera_that_turns_is_refused(refused, in_tmp):
    write_film(in_tmp / "a.mp4", turned(6))
    said = refused("capture", "video=a.mp4", "out=new/hand", "threads=1", "features=400")
    assert "is explained by turning it; it only turns" in said
    assert "force=true; what was found stays in new/.hand.work" in said
    work = in_tmp / "new" / ".hand.work"
    assert (work / "database.db").is_file()
    assert len(list((work / "pictures").iterdir())) == 6


@pytest.mark.slow
def test_hardly_any_texture_is_refused(refused, in_tmp):
    write_film(in_tmp / "few.mp4", numbered(4))
    said = refused("capture", "threads=1", "video=few.mp4")
    assert "hundreds of features to match, but got 6 in a picture; there is hardly any" in said


@pytest.mark.slow
def test_a_camera_that_stands_is_refused_also_by_images_with_spaces_and_alpha(refused, in_tmp):
    """That it stands is known from the matches alone."""
    (in_tmp / "p").mkdir()
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (30, 40, 3)).repeat(6, 0).repeat(6, 1)
    for n in range(3):
        noisy = (image + rng.integers(-3, 4, image.shape)).clip(0, 255).astype(np.uint8)
        Image.fromarray(noisy).convert("RGBA").save(in_tmp / "p" / f"IMG {n}.png")
    said = refused("capture", "images=p", "threads=1", "features=400")
    assert "camera: expected one that moves, but got matches that shift by 0." in said


@pytest.mark.slow
def test_poses_that_are_known_become_a_scene(ok, refused, in_tmp):
    cameras = cameras_on_arc(8)
    write_images(in_tmp / "pictures", cameras)
    write_model(in_tmp / "sparse" / "0", cameras, POINTS, lens=(0.02, 0.0, 0.0, 0.0))
    words = ["images=pictures", "colmap=sparse/0", "out=captures/hand"]
    said = ok("capture", *words).out.splitlines()
    assert said[0].startswith("registered: 8 of 8 pictures, 320 x 240 pixels")
    words_of_next = "experiment=video_with_poses data.root=captures data.scene=hand budget.minutes=5"
    assert said[-2:] == ["next:", f"  forewarp-train {words_of_next}"]
    names = {path.name for path in (in_tmp / "captures" / "hand").iterdir()}
    assert names == {"transforms.json", "capture.json", "capture.png", "points.npy", "images", "images_2"}
    for scale in (1, 2):
        scene = read_scene("captures", "hand", scale=scale)
        frames = sorted((*scene.train, *scene.test), key=lambda frame: frame.time)
        assert [frame.time for frame in frames] == pytest.approx(np.linspace(0, 1, 8))
        _, degrees, away = pose_errors([frame.camera for frame in frames], list(cameras.values()))
        assert max(degrees.max(), away.max()) < 1e-5
        assert frames[0].camera.width == 320 // scale
        assert len(scene.still) == 200
        low, high = np.array(scene.box.low), np.array(scene.box.high)
        assert ((scene.still.numpy() > low) & (scene.still.numpy() < high)).all()
    assert "expected a new folder, but got a scene; set overwrite=true" in refused("capture", *words)
    assert not [path for path in (in_tmp / "captures").iterdir() if path.name != "hand"]


@pytest.mark.slow
def test_poses_without_points_become_a_scene_whose_limits_its_reader_derives(ok, in_tmp):
    cameras = cameras_on_arc(8)
    write_images(in_tmp / "pictures", cameras)
    write_model(in_tmp / "sparse" / "0", cameras, POINTS[:0])
    said = ok("capture", "images=pictures", "colmap=.", "out=captures/hand").out.splitlines()
    assert said[2] == "points: none; box, near and far are derived when the scene is read"
    assert not (in_tmp / "captures" / "hand" / "capture.png").exists()
    scene = read_scene("captures", "hand")
    frames = sorted((*scene.train, *scene.test), key=lambda frame: frame.time)
    _, degrees, away = pose_errors([frame.camera for frame in frames], list(cameras.values()))
    assert max(degrees.max(), away.max()) < 1e-5


@pytest.mark.slow
def test_known_poses_keep_cut_outs_as_they_are_stored(ok, refused, in_tmp):
    """With names as phones give them, of which the next line can be typed."""
    name = "VID (1), it's"
    cameras = {f"IMG_{n}.png": camera for n, camera in enumerate(cameras_on_arc(14).values())}
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned, but the poses are of the images as stored
    (in_tmp / name).mkdir()
    for file in cameras:
        cut_out = np.zeros((240, 320, 4), np.uint8)
        cut_out[:120, :160] = (200, 100, 50, 255)
        Image.fromarray(cut_out).save(in_tmp / name / file, exif=exif)
    few = dict(list(cameras.items())[:6])  # fewer than half
    write_model(in_tmp / "sparse", few, POINTS)
    said = ok("capture", f"images={name}", "colmap=sparse").out.splitlines()
    about = json.loads((in_tmp / "captures" / name / "capture.json").read_text())
    assert list(about["originals"].values()) == list(cameras)
    assert about["left_out"] == list(cameras)[6:]
    written = json.loads((in_tmp / "captures" / name / "transforms.json").read_text())["frames"]
    centers = np.array([frame["transform_matrix"] for frame in written])[:, :3, 3]
    known = np.stack([camera.center for camera in few.values()])
    assert centers == pytest.approx(known, abs=1e-6)  # the model's world stays
    words = shlex.split(said[-1])
    assert words[:2] == ["forewarp-train", "experiment=video_with_poses"]
    read = OverridesParser.create().parse_overrides(words[1:])
    assert [override.value() for override in read[1:]] == ["captures", name, 5]
    for scale in (1, 2):
        scene = read_scene("captures", name, scale=scale)
        assert len(scene.train) + len(scene.test) == 6
        assert scene.has_alpha
        pixels = scene.train[0].load()
        assert pixels.shape[:2] == (240 // scale, 320 // scale)
        assert pixels[0, 0].tolist() == [200, 100, 50, 255]
        assert pixels[-1, -1, 3] == 0
    write_model(in_tmp / "small", {name: c.resized(160, 120) for name, c in few.items()}, POINTS)
    said = refused("capture", f"images={name}", "colmap=small", "out=small_hand")
    assert "expected cameras of 320 x 240 pixels, as the pictures, but got 160 x 120" in said


@pytest.mark.slow
def test_masks_that_changed_are_read_again(forewarp, refused, in_tmp, monkeypatch):
    """Work that was interrupted is gone on with by the same masks alone."""
    cameras = cameras_on_arc(3)
    write_images(in_tmp / "pictures", cameras)
    (in_tmp / "masks").mkdir()

    def write_masks(value):
        for name in cameras:
            Image.new("L", (320, 240), value).save(in_tmp / "masks" / f"{name[:-4]}.png")

    def stop(*arguments):
        raise KeyboardInterrupt

    words = ["images=pictures", "masks=masks", "out=hand"]
    write_masks(255)
    with monkeypatch.context() as patched:
        patched.setattr("forewarp.capture.poses.find_features", stop)
        assert forewarp("capture", *words).status == 130
    write_masks(100)  # no label either, without a 0
    assert "what moves is bright, but got none above 127 of 255" in refused("capture", *words)


@pytest.mark.slow
def test_a_video_becomes_a_scene_that_is_trained_also_when_interrupted(ok, in_tmp):
    video, cameras = hand_film(in_tmp / "hand.mp4")
    words = [f"video={video}", "out=captures/hand", "frames=14", "threads=1"]
    command = [str(Path(sys.executable).with_name("forewarp-capture")), *words]
    work = in_tmp / "captures" / ".hand.work"
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ)
    signal.signal(signal.SIGINT, before)
    while not (work / "pairs.txt").exists():
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    said = process.communicate()[1]
    assert process.returncode == 130, said
    assert "interrupted; run the same command again" in said
    assert (work / "database.db").exists()
    assert not (in_tmp / "captures" / "hand").exists()
    done = ok("capture", *words)
    assert "frames" not in done.err  # taken before
    assert [path.name for path in (in_tmp / "captures").iterdir()] == ["hand"]
    about = json.loads((in_tmp / "captures" / "hand" / "capture.json").read_text())
    assert about["registered"] >= 12
    scene = read_scene("captures", "hand")
    frames = sorted((*scene.train, *scene.test), key=lambda frame: frame.time)
    rows = [int(frame.name.rpartition("_")[2]) - 1 for frame in frames]
    stamps = np.array([n * (n + 30) for n in rows])
    spread = (stamps - stamps[0]) / (stamps[-1] - stamps[0])
    assert [frame.time for frame in frames] == pytest.approx(spread, abs=1e-3)
    _, degrees, away = pose_errors([frame.camera for frame in frames], [cameras[row] for row in rows])
    assert degrees.max() < 1.0
    assert away.max() < 0.03
    rests = [frame.load_resting for frame in frames if frame.load_resting is not None]
    assert [float(mask().float().mean()) > 0.5 for mask in rests] == [True, True]
    words = ["data.root=captures", "data.scene=hand", "data.scale=1", "trainer=cpu", "logger=none", "run=run"]
    budget = ["budget.minutes=null", "budget.iterations=40", "threads=1"]
    ok("train", "experiment=video_with_poses", *words, *budget)
    assert json.loads((in_tmp / "run" / "metrics.json").read_text())["test"]["all"]["psnr"] > 12


@pytest.mark.slow
def test_a_rig_of_videos_becomes_a_scene_that_is_trained(ok, refused, in_tmp):
    """Cameras begin apart at two rates; one that films another place is named and left out, and what was
    found of the others stays.
    """
    synthesize_multicam(in_tmp / "rig", cameras=4, frames=24, size=320, samples_per_pixel=1, workers=1)
    noise = np.random.default_rng(0).integers(0, 256, (1, 60, 80, 3)).repeat(24, 0).repeat(4, 1).repeat(4, 2)
    sound = ["-i", str(in_tmp / "rig" / "cam00.mp4"), "-map", "0:v", "-map", "1:a"]
    write_film(in_tmp / "rig" / "wall (1).mp4", noise.astype(np.uint8), inputs=sound)
    words = ["videos=rig", "out=captures/rig", "threads=1", "lens=SIMPLE_RADIAL"]
    said = refused("capture", *words)
    assert "wall (1): expected a camera that sees what the others see, but got" in said
    assert "leave it out (without=['wall (1)']), or go on without it (force=true); what was found" in said
    done = ok("capture", *words, "without=['wall (1)']")
    lines = done.out.splitlines()
    assert lines[0] == "offsets: by sound"
    assert "left out: wall (1)" in lines
    assert "data.root=captures data.scene=rig 'data.test_cameras=[cam02]'" in lines[-1]
    facts, _ = compared(in_tmp / "rig", in_tmp / "captures" / "rig")
    assert facts["cameras"] == "4 of 4"
    assert facts["offset_ms"] < 2
    assert facts["degrees"][1] < 0.8  # of a hundred points; of images twice as wide 0.04
    assert facts["size_percent"][1] < 3  # 0.15
    about = json.loads((in_tmp / "captures" / "rig" / "capture.json").read_text())
    cameras = about["cameras"].values()
    assert all(camera["fixed"] and camera["certainty"] > 3 for camera in cameras)
    assert [round(camera["rate"], 2) for camera in cameras] == [29.97, 30.0, 29.97, 30.0]
    assert 0.002 < about["moving"] < 0.2
    scene = read_scene("captures", "rig", test_cameras=["cam00"], test_moments=[5])
    assert {frame.ability for frame in scene.test} == {"space", "time", "space_time"}
    assert len({frame.time for frame in scene.train}) == len(scene.train)  # times of their own
    rest = ["data.test_cameras=[cam00]", "data.scale=2", "trainer=cpu", "logger=none", "run=run", "threads=1"]
    budget = ["budget.minutes=null", "budget.iterations=60"]
    ok("train", "experiment=video_with_poses", "data.root=captures", "data.scene=rig", *rest, *budget)
    scores = json.loads((in_tmp / "run" / "metrics.json").read_text())["test"]
    assert scores["space"]["psnr"] > 10


@pytest.mark.slow
def test_a_capture_written_by_hand_is_fitted(ok, tmp_path):
    world, times = World("lift"), [i / 23 for i in range(24)]
    cameras = [replace(c, near=0.0, far=1.0) for c in random_cameras(24, 32, np.random.default_rng(3))]
    pictures = (render(world, time, camera, 1)[0] for time, camera in zip(times, cameras))
    shots = (PosedShot(f"{t:.3f}.png", c, image, t) for t, c, image in zip(times, cameras, pictures))
    write_scene(tmp_path / "data" / "mine", shots, near=2.0, far=6.0, aabb=Box((-1, -1, -1), (1, 1, 1)))
    words = [f"data.root={tmp_path}/data", "data.scene=mine", "trainer=cpu", "logger=none", "seed=0"]
    budget = ["budget.minutes=null", "budget.iterations=300", "callbacks.pictures=null"]
    ok("train", "data=video_with_poses", "model=particles", *words, *budget, f"run={tmp_path}/run")
    scores = json.loads((tmp_path / "run" / "metrics.json").read_text())["test"].values()
    assert min(score["psnr"] for score in scores) > 17.0  # an image of one colour: 11 to 15
