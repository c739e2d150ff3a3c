from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("pycolmap", reason="no pycolmap; make install adds it")

from forewarp.capture.frames import Frames, Source
from forewarp.capture.scene import Limits, draw, facts_of, limits_of, placed, summary, upwards, write
from forewarp.data.images import write_image
from forewarp.data.posed_video import read_scene
from forewarp.scene.box import Box
from tests.support.captures import cameras_on_arc, pose_errors, quiet, sparse_arc

ROTATION = Rotation.from_euler("xyz", [40, -70, 110], degrees=True).as_matrix()
ANYWHERE = (ROTATION, np.array([7.0, -3.0, 100.0]), 0.02)  # a world as structure from motion leaves it


def test_the_world_is_upright_centred_and_of_unit_distance():
    found = placed(sparse_arc().moved(*ANYWHERE))
    np.testing.assert_allclose(np.median(found.points, 0), 0, atol=0.05)
    assert np.median(found.distances()) == pytest.approx(1)
    axes = np.stack([np.asarray(camera.camera_to_world)[:3, :3] for camera in found.cameras.values()])
    assert np.abs(axes[:, 2, 0]).max() < 0.04  # the images' horizontal axes are level
    assert axes[:, 2, 1].max() < -0.9  # and their upward axes up
    ahead = axes[:, :, 2].mean(0)
    assert abs(ahead[0]) < 1e-9 < 0.5 < ahead[1]  # to y


@pytest.mark.parametrize("where", [(np.eye(3), np.zeros(3), 1.0), ANYWHERE])
def test_placing_is_a_similarity(where):
    before = sparse_arc(roll=0.05)
    found = placed(before.moved(*where))
    similarity, degrees, away = pose_errors(list(found.cameras.values()), list(before.cameras.values()))
    assert degrees.max() < 1e-4
    assert away.max() < 1e-9
    np.testing.assert_allclose(similarity(found.points), before.points, atol=1e-9)


@pytest.mark.parametrize(
    ("degrees", "roll", "most"), [(90, 0.0, 1.0), (90, 0.05, 4.0), (30, 0.0, 8.0), (0, 0, 18.0)]
)
def test_up_is_where_the_ground_is_not(degrees, roll, most):
    """Cameras look down by 17 degrees; the mean of the images' upward axes is off by as much."""
    up = upwards(list(cameras_on_arc(degrees=degrees, roll=roll).values()))
    assert np.degrees(np.arccos(up[2])) < most


def test_cameras_that_look_straight_down_can_be_placed():
    found = placed(sparse_arc(radius=1e-9, degrees=1, height=4.0))
    assert all(camera.camera_to_world.isfinite().all() for camera in found.cameras.values())


@pytest.mark.parametrize("outliers", [0, 5])
def test_limits_hold_what_is_seen_and_no_outliers(outliers):
    found = sparse_arc(outliers=outliers)
    limits = limits_of(found)
    assert (found.points[:400] >= limits.box.low).all()
    assert (found.points[:400] <= limits.box.high).all()
    assert limits.box.diagonal < 2 * np.sqrt(12)
    distances = found.distances()
    near = np.quantile(distances, 0.01)
    assert limits.near < near < 4 * limits.near
    if not outliers:
        assert distances.max() < limits.far < 2 * distances.max()


def test_limits_hold_what_moves_before_the_points():
    found = sparse_arc(radius=8.0)
    box = limits_of(found).box
    halfway = 0.5 * found.centers  # to the points
    assert ((halfway > box.low) & (halfway < box.high)).all()


def test_points_before_the_lens_neither_pull_near_to_it_nor_pass_unsaid():
    """As a logo burnt into a film leaves them."""
    found = placed(sparse_arc())
    assert not limits_of(found).has_nearer
    rows = np.arange(len(found.cameras))
    points = np.concatenate([found.points, found.centers + 1e-8])
    stuck = np.stack([rows, len(found.points) + rows], 1).repeat(40, 0)
    more = {"points": points, "seen": np.concatenate([found.seen, stuck])}
    more |= {name: np.resize(getattr(found, name), len(points)) for name in ("errors", "views")}
    limits = limits_of(replace(found, **more))
    assert limits.has_nearer
    assert limits.near == pytest.approx(0.01, rel=0.2)


@pytest.mark.slow
def test_the_drawing_shows_cameras_points_and_box():
    found = placed(sparse_arc())
    image = draw(found, limits_of(found))
    height = image.shape[1] // 2
    title, image = image[:-height], image[-height:]
    assert 0.01 < float((title < 0.5).float().mean()) < 0.2  # letters
    for half in (image[:, :height], image[:, height:]):
        blue, red = (half[..., 2] - half[..., 0] > 0.4).sum(), (half[..., 0] - half[..., 2] > 0.4).sum()
        assert min(int(blue), int(red)) > 100
        assert 0.5 < float((half > 0.99).all(-1).float().mean()) < 0.98


def test_facts_are_those_of_the_capture_and_are_told_with_advice():
    """Cameras on an arc of radius 4 over 70 degrees; two of 14 images have no pose."""
    found = sparse_arc()
    ours = [*found.cameras, "frame_000013.jpg", "frame_000014.jpg"]
    originals = {name: f"IMG {n}.jpg" for n, name in enumerate(ours, 1)}
    times = {name: float(n) for n, name in enumerate(ours)}
    sizes = dict.fromkeys(times, (320, 240))
    frames = Frames(Path("pictures"), None, times, range(14), 14, 1.0, sizes, originals)
    limits = Limits(0.5, 2.0, Box((-1, -1, -1), (1, 2, 3)))
    facts = facts_of(Source(images=Path("p")), frames, found, limits, None) | {"moving": 0.12}
    chord = 2 * 4 * np.sin(np.radians(70 / 11) / 2)
    assert facts["path"] == pytest.approx(11 * chord)
    assert facts["camera"]["degrees"] == pytest.approx(2 * np.degrees(np.arctan(160 / 300)))
    assert facts["left_out"] == ["IMG 13.jpg", "IMG 14.jpg"]
    assert facts["originals"] == originals
    left_out = "left out: 2 pictures without a pose (IMG 13.jpg, IMG 14.jpg)"
    assert summary(facts) == [
        "registered: 12 of 14 pictures, 320 x 240 pixels, reprojection error 0.50 pixels",
        f"camera: 56 degrees wide; its path is {11 * chord:.2f} long, where what it sees is 1 away",
        "points: 400; box 2.00 x 3.00 x 4.00, near 0.50, far 2.00",
        "moving: 12% of the pixels; test frames are scored there and elsewhere",
        f"{left_out}; film slower and with more of what stands still",
    ]
    known = summary(facts | {"searched": False, "sure_points": 300})
    assert known[2].startswith("points: 400, 300 of them sure; box")
    assert known[4] == left_out
    assert any("as captions or logos" in line for line in summary(facts | {"has_nearer": True}))


@pytest.mark.slow
def test_what_is_burnt_in_is_said_and_no_frame_trains_on_it(tmp_path):
    found = sparse_arc(count=4)
    sizes, times = dict.fromkeys(found.cameras, (320, 240)), dict(zip(found.cameras, range(4)))
    for name in found.cameras:
        write_image(tmp_path / "pictures" / name, np.full((240, 320, 3), 90, np.uint8))
    frames = Frames(tmp_path / "pictures", None, times, range(4), 4, 1.0, sizes, {})
    burnt = np.zeros((240, 320), bool)
    burnt[10:50, 260:310] = True
    limits = limits_of(found)
    source = Source(video=Path("a.mp4"))
    written = write(tmp_path / "hand", source, frames, found, limits, quiet, burnt)
    for scale in (1, 2):
        scene = read_scene(tmp_path, "hand", scale=scale)
        for frame in (*scene.train, *scene.test):
            np.testing.assert_array_equal(frame.load_valid(), ~burnt[::scale, ::scale])
    said = summary(facts_of(source, frames, found, limits, burnt) | written)
    start = "burnt in: a logo or a caption in 2.6 % of the images (top right), left out of poses"
    assert any(line.startswith(start) for line in said)
