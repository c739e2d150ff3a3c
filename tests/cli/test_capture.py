"""forewarp-capture as people call it; the parts are tested in tests/capture."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from PIL import Image

from forewarp.data.posed_video import read_scene
from tests.support.alignment import pose_errors
from tests.support.films import numbered, write_film
from tests.support.handheld import WALKS, cameras_of, pictures_of
from tests.support.sparse_scene import cameras_on_arc, write_model

needs_pycolmap = pytest.mark.skipif(
    not __import__("importlib.util").util.find_spec("pycolmap"), reason="no pycolmap; make install adds it"
)
POINTS = np.random.default_rng(0).uniform(-1, 1, (200, 3))


def write_pictures(folder, cameras, seed=0):
    """A picture of noise for each camera."""
    folder.mkdir()
    rng = np.random.default_rng(seed)
    for name, camera in cameras.items():
        Image.fromarray(rng.integers(0, 256, (camera.height, camera.width, 3), np.uint8)).save(folder / name)


@pytest.fixture
def things(in_tmp):
    """What people may give by mistake."""
    (in_tmp / "text.mp4").write_text("no video")
    (in_tmp / "empty").mkdir()
    write_film(in_tmp / "one.mp4", numbered(1))
    write_film(in_tmp / "few.mp4", numbered(4))
    write_pictures(in_tmp / "pictures", cameras_on_arc(4))
    Image.new("RGB", (8, 8)).save(in_tmp / "pictures" / "odd.png")
    return in_tmp


@needs_pycolmap
@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "video, images: expected video=FILE or images=FOLDER, but got neither; set one of them"),
        (
            ["video=few.mp4", "images=empty"],
            "video, images: expected video=FILE or images=FOLDER, but got both",
        ),
        (["video=none.mp4"], "video: expected an existing file, but got none: none.mp4"),
        (["video=empty"], "video: expected an existing file, but got another thing: empty"),
        (["images=one.mp4"], "images: expected an existing folder, but got another thing"),
        (["video=few.mp4", "colmap=empty"], "colmap: expected images=FOLDER beside it, but got video="),
        (["images=empty", "colmap=empty"], "expected a folder of many pictures, PNG or JPEG, but got none"),
        (["images=pictures"], "odd.png: expected 320 x 240 pixels as the first, but got 8 x 8"),
        (["images=empty"], "empty: expected a folder of many pictures, PNG or JPEG, but got none"),
        (
            ["video=few.mp4", "masks=empty"],
            "empty: expected 4 masks, one for each frame or picture, or masks",
        ),
        (["video=text.mp4"], "text.mp4: expected a video, but got another file"),
        (["video=one.mp4"], "one.mp4: expected a video of many frames, but got one frame"),
        (
            ["video=few.mp4"],
            "hundreds of features to match, but got 6 in a picture; there is hardly any texture",
        ),
        (["video=few.mp4", "frames=2"], "frames: expected a whole number of at least 3, but got 2"),
        (["video=few.mp4", "size=10"], "size: expected a whole number of at least 64, but got 10"),
        (["video=few.mp4", "seed=-1"], "seed: expected a whole number of at least 0, but got -1"),
        (
            ["video=few.mp4", "lens=FOV"],
            "lens: expected one of SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL",
        ),
        (
            ["video=few.mp4", "matching=x"],
            "matching: expected one of auto, sequential, exhaustive, but got 'x'",
        ),
        (["video=few.mp4", "out=."], "out: expected a folder to be made, but got ., which you are in"),
        (["images=2024_11"], "images: expected an existing folder, but got none: 2024_11;"),
        (["video=VID (1),a=b.mp4"], "video: expected an existing file, but got none: VID (1),a=b.mp4;"),
        (
            ["video=few.mp4", "out=pictures"],
            "pictures: expected no folder, an empty one, or one written before",
        ),
    ],
)
def test_mistakes_end_in_one_line_and_leave_nothing(refused, things, words, says):
    before = sorted(path.relative_to(things) for path in things.rglob("*"))
    assert says in refused("capture", "threads=1", *words)
    assert sorted(path.relative_to(things) for path in things.rglob("*")) == before


def test_without_its_package_it_says_what_to_install(refused, things, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *rest: None)
    assert (
        refused("capture", "video=few.mp4")
        == "capture: expected pycolmap, but got none; install forewarp[capture]"
    )


def stood(count):
    """A camera on a tripod before a sharp pattern, with a little noise."""
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (30, 40, 3)).repeat(6, 0).repeat(6, 1)
    noise = rng.integers(-3, 4, (count, *picture.shape))
    return (picture + noise).clip(0, 255).astype(np.uint8)


def turned(count):
    """A camera that turns on the spot inside a patterned sphere."""
    rng = np.random.default_rng(0)
    pattern = rng.integers(0, 256, (60, 120, 3)).astype(np.uint8)
    columns, rows = np.meshgrid(np.arange(240) - 119.5, np.arange(180) - 89.5)
    rays = np.stack([columns / 200, rows / 200, np.ones_like(rows)], -1)
    frames = []
    for angle in np.linspace(0, 0.9, count):
        x = rays[..., 0] * np.cos(angle) + rays[..., 2] * np.sin(angle)
        z = -rays[..., 0] * np.sin(angle) + rays[..., 2] * np.cos(angle)
        across, up = np.arctan2(x, z), np.arctan2(rays[..., 1], np.hypot(x, z))
        frames.append(pattern[(30 + up * 30).astype(int), (40 + across * 30).astype(int)])
    return np.stack(frames)


@needs_pycolmap
@pytest.mark.parametrize(
    ("frames", "says"),
    [
        (stood, "camera: expected one that moves, but got matches that shift"),
        (turned, "is explained by turning it; it only turns"),
    ],
)
def test_cameras_that_do_not_walk_are_refused(refused, in_tmp, frames, says):
    write_film(in_tmp / "a.mp4", frames(6))
    assert says in refused("capture", "video=a.mp4", "out=new/hand", "threads=1", "features=400")
    assert [path.name for path in in_tmp.iterdir()] == ["a.mp4"]


@needs_pycolmap
def test_pictures_with_spaces_and_alpha_are_matched(refused, in_tmp):
    """That they stand is known from their matches alone."""
    (in_tmp / "p").mkdir()
    for n, frame in enumerate(stood(3)):
        Image.fromarray(frame).convert("RGBA").save(in_tmp / "p" / f"IMG {n}.png")
    said = refused("capture", "images=p", "threads=1", "features=400")
    assert "camera: expected one that moves, but got matches that shift by 0." in said


@needs_pycolmap
def test_poses_that_are_known_become_a_scene(ok, refused, in_tmp):
    cameras = cameras_on_arc(8)
    write_pictures(in_tmp / "pictures", cameras)
    write_model(in_tmp / "sparse" / "0", cameras, POINTS, lens=(0.02, 0.0, 0.0, 0.0))
    words = ["images=pictures", "colmap=sparse/0", "out=captures/hand"]
    said = ok("capture", *words).out.splitlines()
    assert said[0].startswith("registered: 8 of 8 pictures, 320 x 240 pixels")
    assert said[-1] == "next: forewarp-train experiment=video_with_poses data.root=captures data.scene=hand"
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
    ok("capture", *words, "overwrite=true")
    assert not [path for path in (in_tmp / "captures").iterdir() if path.name != "hand"]


@needs_pycolmap
def test_known_poses_keep_cut_outs_as_they_are_stored(ok, refused, in_tmp):
    cameras = {f"IMG_{n}.png": camera for n, camera in enumerate(cameras_on_arc(8).values())}
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned, but the poses are of the pictures as stored
    (in_tmp / "p").mkdir()
    for name in cameras:
        cut_out = np.zeros((240, 320, 4), np.uint8)
        cut_out[:120, :160] = (200, 100, 50, 255)
        Image.fromarray(cut_out).save(in_tmp / "p" / name, exif=exif)
    write_model(in_tmp / "sparse", cameras, POINTS)
    ok("capture", "images=p", "colmap=sparse", "out=hand")
    for scale in (1, 2):
        scene = read_scene(".", "hand", scale=scale)
        assert scene.has_alpha
        pixels = scene.train[0].load()
        assert pixels.shape[:2] == (240 // scale, 320 // scale)
        assert pixels[0, 0].tolist() == [200, 100, 50, 255]
        assert pixels[-1, -1, 3] == 0
    other = {name: camera.resized(160, 120) for name, camera in cameras.items()}
    write_model(in_tmp / "small", other, POINTS)
    said = refused("capture", "images=p", "colmap=small", "out=small_hand")
    assert "expected cameras of 320 x 240 pixels, as the pictures, but got 160 x 120" in said


@needs_pycolmap
@pytest.mark.parametrize("name", ["20241122_101500", "my hand", "VID (1), it's"])
def test_the_next_line_can_be_typed_as_it_is_printed(ok, in_tmp, name):
    """Names as phones give them: of the folder, of the pictures, and of the scene."""
    cameras = cameras_on_arc(14)
    theirs = {f"IMG{n}.jpg": camera for n, camera in enumerate(cameras.values(), 1)}
    write_pictures(in_tmp / name, theirs)
    write_model(in_tmp / "sparse", dict(list(theirs.items())[:6]), POINTS)  # fewer than half
    said = ok("capture", f"images={name}", "colmap=sparse").out.splitlines()
    about = json.loads((in_tmp / "captures" / name / "capture.json").read_text())
    assert list(about["originals"].values()) == list(theirs)
    assert about["left_out"] == list(theirs)[6:]
    words = shlex.split(said[-1].removeprefix("next: "))
    assert words[:2] == ["forewarp-train", "experiment=video_with_poses"]
    read = OverridesParser.create().parse_overrides(words[1:])
    assert [override.value() for override in read[1:]] == ["captures", name]
    scene = read_scene("captures", name)
    assert len(scene.train) + len(scene.test) == 6


@needs_pycolmap
def test_masks_that_changed_are_read_again(forewarp, refused, in_tmp, monkeypatch):
    """Work that was interrupted is gone on with by the same masks alone."""
    cameras = cameras_on_arc(3)
    write_pictures(in_tmp / "pictures", cameras)
    (in_tmp / "masks").mkdir()
    for name in cameras:
        Image.new("L", (320, 240), 255).save(in_tmp / "masks" / f"{name[:-4]}.png")
    words = ["images=pictures", "masks=masks", "out=hand"]

    def stop(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("forewarp.capture.poses.find_features", stop)
        assert forewarp("capture", *words).status == 130
    for name in cameras:
        Image.new("L", (320, 240), 1).save(in_tmp / "masks" / f"{name[:-4]}.png")
    assert "brighter than 127 of 255, but got at most 1" in refused("capture", *words)


def film(folder, count=30):
    """A hand-held film of the room, 320 x 240, and its true cameras."""
    walk, times = WALKS["room"], np.linspace(0, 1, count)
    cameras = cameras_of(walk, times, 4.0, size=(320, 240))
    pictures = np.stack(list(pictures_of(walk, times, cameras, samples=2, workers=1)))
    return write_film(folder / "hand.mp4", pictures, stamps="N*(N+30)*3"), cameras


@needs_pycolmap
@pytest.mark.slow
def test_a_video_becomes_a_scene_that_is_trained_also_when_interrupted(ok, in_tmp):
    video, cameras = film(in_tmp)
    words = [f"video={video}", "out=captures/hand", "frames=20", "threads=1"]
    command = [sys.executable, "-m", "forewarp.cli.capture", *words]
    work = in_tmp / "captures" / ".hand.work"
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background ignores it
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ)
    signal.signal(signal.SIGINT, before)
    while not (work / "pairs.txt").exists():
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    said = process.communicate()[1]
    assert process.returncode == 130
    assert "interrupted; run the same command again" in said
    assert (work / "database.db").exists()
    assert not (in_tmp / "captures" / "hand").exists()
    done = ok("capture", *words)
    assert "frames" not in done.err  # taken before
    assert [path.name for path in (in_tmp / "captures").iterdir()] == ["hand"]
    about = json.loads((in_tmp / "captures" / "hand" / "capture.json").read_text())
    assert about["registered"] >= 18
    scene = read_scene("captures", "hand")
    frames = sorted((*scene.train, *scene.test), key=lambda frame: frame.time)
    rows = [int(frame.name.rpartition("_")[2]) - 1 for frame in frames]
    stamps = np.array([n * (n + 30) for n in rows])
    spread = (stamps - stamps[0]) / (stamps[-1] - stamps[0])
    assert [frame.time for frame in frames] == pytest.approx(spread, abs=1e-3)
    _, degrees, away = pose_errors([frame.camera for frame in frames], [cameras[row] for row in rows])
    assert degrees.max() < 1.0
    assert away.max() < 0.03
    words = ["data.root=captures", "data.scene=hand", "data.scale=2", "trainer=cpu", "logger=none", "run=run"]
    ok(
        "train",
        "experiment=video_with_poses",
        *words,
        "budget.minutes=null",
        "budget.iterations=40",
        "threads=1",
    )
    assert json.loads((in_tmp / "run" / "metrics.json").read_text())["test"]["all"]["psnr"] > 12
