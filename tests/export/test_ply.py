from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from plyfile import PlyData
from scipy.special import expit

from forewarp.export.ply import splat_columns, write_ply
from forewarp.ops.gaussians import FLAT, Gaussians
from forewarp.scene.camera import mean_up
from forewarp.scene.cloud import Ellipsoids
from forewarp.scene.view import Moment, View
from tests.export.conftest import TIMES, exporter
from tests.support.gaussians import NO_TINTS, still

export = exporter("ply", degree=3, up="world")
LAYOUT = [
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{i}" for i in range(45)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]


def read(path):
    """The properties of a file of splats, as plyfile reads them."""
    vertices = PlyData.read(path)["vertex"]
    return {p.name: np.asarray(vertices[p.name], np.float64) for p in vertices.properties}


def columns(table, name):
    return np.stack([table[key] for key in table if key.rstrip("0123456789").rstrip("_") == name], -1)


def drawn(table, snapshot, camera):
    """The image (P, 3) that a viewer of splats draws of a file, as our own rasterizer does."""
    rest = columns(table, "f_rest")
    harmonics = [columns(table, "f_dc")[:, None], rest.reshape(len(rest), 3, -1).transpose(0, 2, 1)]
    parts = [np.stack([table[axis] for axis in "xyz"], -1), columns(table, "scale"), columns(table, "rot")]
    parts += [table["opacity"][:, None], np.concatenate(harmonics, 1)]
    bare = Gaussians(*(torch.from_numpy(part.astype(np.float32)) for part in parts))
    own = type(snapshot)(snapshot.moment, bare, still(bare), NO_TINTS, torch.ones(1), snapshot.blur)
    return own.render(View(camera), torch.ones(3)).rgb.detach()


def test_a_viewer_draws_the_images_of_the_run_and_the_motion_moves_the_canonical_file(particles, tmp_path):
    about, folder = export(particles, tmp_path / "ply"), tmp_path / "ply"
    base, motion = read(folder / "canonical.ply"), np.load(folder / "motion.npz")
    places = np.stack([base[axis] for axis in "xyz"], -1)
    for number, (time, camera) in enumerate(zip(TIMES, particles.cameras)):
        frame = read(folder / "frames" / f"frame_{number:04d}.ply")
        assert list(frame) == LAYOUT
        assert len(frame["x"]) == about["particles"] == len(particles.method.means)
        snapshot = particles.method.at(Moment(time))
        wanted = snapshot.render(View(camera), torch.ones(3)).rgb.detach()
        assert float(wanted.std()) > 0.05
        torch.testing.assert_close(drawn(frame, snapshot, camera), wanted, atol=2e-3, rtol=0)
        maps = motion["maps"][number][motion["links"]]  # (N, L, 3, 4)
        steps = maps[..., :3] @ places[:, None, :, None] + maps[..., 3:]
        moved = places + (motion["weights"][..., None] * steps[..., 0]).sum(1)
        np.testing.assert_allclose(np.stack([frame[axis] for axis in "xyz"], -1), moved, atol=1e-5)
        logit = base["opacity"] + motion["opacity_over_time"] @ motion["opacity_basis"][number]
        np.testing.assert_allclose(expit(frame["opacity"]), expit(logit), atol=1e-5)
        tint = np.einsum("nkc,k->nc", motion["color_over_time"], motion["color_basis"][number])
        np.testing.assert_allclose(columns(frame, "f_dc"), columns(base, "f_dc") + tint / FLAT, atol=1e-4)
    np.testing.assert_allclose(motion["times"], TIMES)
    assert np.abs(motion["maps"][2] - motion["maps"][0]).max() > 0.05


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_file_has_the_coefficients_of_its_degree(tmp_path, degree):
    harmonics = torch.arange(2 * 9 * 3, dtype=torch.float32).reshape(2, 9, 3)
    cloud = Ellipsoids(torch.zeros(2, 3), torch.eye(3).repeat(2, 1, 1), torch.rand(2), harmonics)
    write_ply(tmp_path / "a.ply", splat_columns(cloud, degree))
    table = read(tmp_path / "a.ply")
    count = (degree + 1) ** 2 - 1
    assert len([name for name in table if name.startswith("f_rest")]) == 3 * count
    np.testing.assert_array_equal(columns(table, "f_dc"), harmonics[:, 0])
    for i, channel in np.ndindex(count, 3):
        wanted = harmonics[:, 1 + i, channel] if i < 8 else 0
        np.testing.assert_array_equal(table[f"f_rest_{channel * count + i}"], wanted)


def test_extremes_are_finite(tmp_path):
    opacity, harmonics = torch.tensor([0.0, 1.0, 1.0]), torch.tensor([9.0, -9.0, 0.0])
    roots = torch.stack([torch.zeros(3, 3), torch.diag(torch.tensor([1.0, 0, 0])), torch.eye(3)])
    cloud = Ellipsoids(torch.zeros(3, 3), roots, opacity, harmonics[:, None, None].expand(3, 1, 3))
    write_ply(tmp_path / "a.ply", splat_columns(cloud))
    table = read(tmp_path / "a.ply")
    assert all(np.isfinite(column).all() for column in table.values())
    np.testing.assert_allclose(expit(table["opacity"]), opacity, atol=2e-6)
    np.testing.assert_allclose(columns(table, "rot")[2], [1, 0, 0, 0])


def test_voxels_are_points_of_the_surface_that_move(ball, tmp_path):
    about = export(ball, tmp_path / "ply")
    frames = [trimesh.load(tmp_path / "ply" / "frames" / f"frame_{i:04d}.ply") for i in range(len(TIMES))]
    first = torch.from_numpy(np.asarray(frames[0].vertices)).float()
    assert len(first) == about["points"] > 100
    paths = ball.method.trajectories(first, torch.tensor(TIMES))
    wanted = torch.sigmoid(2 * first)  # what the fixture painted
    for number, frame in enumerate(frames):
        torch.testing.assert_close(torch.from_numpy(np.asarray(frame.vertices)).float(), paths[:, number])
        shown = torch.from_numpy(np.asarray(frame.colors)[:, :3].astype(np.float32)) / 255
        torch.testing.assert_close(shown, wanted, atol=0.003, rtol=0)
    moved = (paths[:, 2] - paths[:, 0]).norm(dim=-1)
    assert {round(float(m), 3) for m in moved} == {0.0, 0.8}


@pytest.mark.parametrize("up", ["y", "-y", "z"])
def test_turned_files_are_seen_by_turned_cameras_as_before(particles, tmp_path, up):
    export(particles, tmp_path / "ply", degree=2, up=up)
    rotation = particles.rotation_to(up)
    sign, axis = -1.0 if up[0] == "-" else 1.0, "xyz".index(up[-1])
    assert float((rotation @ mean_up(list(particles.cameras)))[axis]) == pytest.approx(sign)
    assert float(torch.linalg.det(rotation)) == pytest.approx(1)
    snapshot, camera = particles.method.at(Moment(TIMES[1])), particles.cameras[3]
    pose = camera.camera_to_world.clone()
    pose[:3] = rotation @ pose[:3]
    table = read(tmp_path / "ply" / "frames" / "frame_0001.ply")
    wanted = snapshot.render(View(camera), torch.ones(3)).rgb.detach()
    turned = drawn(table, snapshot, replace(camera, camera_to_world=pose))
    torch.testing.assert_close(turned, wanted, atol=2e-3, rtol=0)
