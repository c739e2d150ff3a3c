import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from forewarp.capture.look import two_sides
from forewarp.capture.place import limits_of, placed, upwards
from tests.support.alignment import pose_errors
from tests.support.sparse_scene import cameras_on_arc, sparse_arc

TURN = Rotation.from_euler("xyz", [40, -70, 110], degrees=True).as_matrix()
ANYWHERE = (TURN, np.array([7.0, -3.0, 100.0]), 0.02)  # a world as structure from motion leaves it


def test_the_world_is_upright_centred_and_of_unit_distance():
    found = placed(sparse_arc().moved(*ANYWHERE))
    np.testing.assert_allclose(np.median(found.points, 0), 0, atol=0.05)
    assert np.median(found.distances()) == pytest.approx(1)
    axes = np.stack([np.asarray(camera.camera_to_world)[:3, :3] for camera in found.cameras.values()])
    assert np.abs(axes[:, 2, 0]).max() < 0.04  # the pictures' horizontal axes are level
    assert axes[:, 2, 1].max() < -0.9  # and their upward axes up
    ahead = axes[:, :, 2].mean(0)
    assert abs(ahead[0]) < 1e-9 < 0.5 < ahead[1]  # to y


@pytest.mark.parametrize("where", [(np.eye(3), np.zeros(3), 1.0), ANYWHERE])
def test_placing_is_a_similarity(where):
    sparse = sparse_arc(roll=0.05)
    found = placed(sparse.moved(*where))
    similarity, degrees, away = pose_errors(list(found.cameras.values()), list(sparse.cameras.values()))
    assert degrees.max() < 1e-4
    assert away.max() < 1e-9
    np.testing.assert_allclose(similarity(found.points), sparse.points, atol=1e-9)


@pytest.mark.parametrize(
    ("degrees", "roll", "most"), [(90, 0.0, 1.0), (90, 0.05, 4.0), (30, 0.0, 8.0), (0, 0, 18.0)]
)
def test_up_is_where_the_ground_is_not(degrees, roll, most):
    """Cameras look down by 17 degrees; the mean of the pictures' upward axes is off by as much."""
    up = upwards(list(cameras_on_arc(degrees=degrees, roll=roll).values()))
    assert np.degrees(np.arccos(up[2])) < most


def test_cameras_that_look_straight_down_can_be_placed():
    found = placed(sparse_arc(radius=1e-9, degrees=1, height=4.0))
    assert all(camera.camera_to_world.isfinite().all() for camera in found.cameras.values())


@pytest.mark.parametrize("outliers", [0, 5])
def test_limits_hold_what_is_seen_and_no_outliers(outliers):
    sparse = sparse_arc(outliers=outliers)
    limits = limits_of(sparse)
    inside = sparse.points[:400]
    low, high = np.array(limits.box.low), np.array(limits.box.high)
    assert (inside >= low).all()
    assert (inside <= high).all()
    assert limits.box.diagonal < 2 * np.sqrt(12)
    distances = sparse.distances()
    near = np.quantile(distances, 0.01)
    assert limits.near < near < 4 * limits.near
    if not outliers:
        assert distances.max() < limits.far < 2 * distances.max()


def test_limits_hold_what_moves_before_the_points():
    sparse = sparse_arc(radius=8.0)
    for camera in sparse.cameras.values():
        at = 0.5 * np.asarray(camera.center)  # halfway to the points
        box = limits_of(sparse).box
        assert all(low < v < high for low, v, high in zip(box.low, at, box.high))


def test_the_picture_shows_cameras_points_and_box():
    sparse = placed(sparse_arc())
    picture = two_sides(sparse, limits_of(sparse))
    height, width, _ = picture.shape
    assert width == 2 * height
    for half in (picture[:, :height], picture[:, height:]):
        blue, red = (half[..., 2] - half[..., 0] > 0.4).sum(), (half[..., 0] - half[..., 2] > 0.4).sum()
        assert min(int(blue), int(red)) > 100
        assert 0.5 < float((half > 0.99).all(-1).float().mean()) < 0.98
