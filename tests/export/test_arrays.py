import numpy as np
import torch
from scipy.spatial import KDTree

from forewarp.export.formats import write
from tests.export.conftest import TIMES
from tests.support.tiny_scene import RADIUS, ball_center


def load(source, tmp_path, **options):
    about = write("npz", source, tmp_path / "npz", {}, lambda *n: None, **options)
    return about, *(np.load(tmp_path / "npz" / f"{name}.npz") for name in ("trajectories", "method"))


def test_voxels_go_where_the_method_says_and_are_seen_from_their_side(ball, tmp_path):
    about, found, own = load(ball, tmp_path, points=150, views=3)
    points, count = torch.from_numpy(found["points"]), len(TIMES)
    assert found["positions"].shape == (150, count, 3)
    assert about["points"] == 150
    np.testing.assert_allclose(found["times"], TIMES)
    wanted = ball.method.trajectories(points, torch.tensor(TIMES))
    np.testing.assert_allclose(found["positions"], wanted, atol=1e-6)
    np.testing.assert_allclose(found["colors"][:, 1], torch.sigmoid(2 * points), atol=1e-5)
    assert found["visible"].shape == (150, count, 3)
    seen = torch.from_numpy(found["visible"])
    for row, time in enumerate(TIMES):
        of_ball = ~ball.method.is_still(points)
        normal = (wanted[of_ball, row] - ball_center(time)) / RADIUS
        for column, pose in enumerate(torch.from_numpy(found["camera_to_world"]).float()):
            faces = (normal * (pose[:3, 3] - wanted[of_ball, row])).sum(-1)  # > 0: towards the camera
            # The block stands before some of them.
            assert seen[of_ball, row, column][faces > 1.2].float().mean() > 0.85
            assert seen[of_ball, row, column][faces < -1.2].float().mean() < 0.05
    camera = ball.cameras[int(found["cameras"][1])]
    np.testing.assert_array_equal(found["intrinsics"][1][0], [camera.fx, 0, camera.cx])
    assert {"radiance.density", "radiance.color"} <= set(own.files)


def test_particles_go_as_their_centers_with_colours_and_opacity_of_each_time(particles, tmp_path):
    _, found, own = load(particles, tmp_path, points=10**6, views=1)
    clouds = [particles.method.ellipsoids(time) for time in TIMES]
    chosen = KDTree(clouds[0].centers).query(found["positions"][:, 0])[1]
    assert len(set(chosen)) == len(chosen) > 50
    clouds = [cloud[chosen] for cloud in clouds]
    for row, cloud in enumerate(clouds):
        np.testing.assert_allclose(found["positions"][:, row], cloud.centers, atol=1e-6)
        np.testing.assert_allclose(found["colors"][:, row], cloud.colors, atol=1e-6)
        np.testing.assert_allclose(found["opacity"][:, row], cloud.opacity, atol=1e-6)
    assert np.ptp(found["opacity"], 1).max() > 0.05
    np.testing.assert_array_equal(own["means"], particles.method.means.detach())
