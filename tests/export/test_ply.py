from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from plyfile import PlyData
from scipy.special import expit

from forewarp.export.formats import write
from forewarp.export.ply import splat_columns, write_ply
from forewarp.ops.gaussians import FLAT, Gaussians
from forewarp.scene.cloud import Ellipsoids
from forewarp.scene.paths import mean_up
from forewarp.scene.view import Moment, View
from tests.export.conftest import TIMES
from tests.support.gaussians import NO_TINTS, still

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


def gaussians(table):
    """What a viewer of splats makes of a file."""
    rest = columns(table, "f_rest")
    harmonics = [columns(table, "f_dc")[:, None], rest.reshape(len(rest), 3, -1).transpose(0, 2, 1)]
    parts = [np.stack([table[axis] for axis in "xyz"], -1), columns(table, "scale"), columns(table, "rot")]
    parts += [table["opacity"][:, None], np.concatenate(harmonics, 1)]
    return Gaussians(*(torch.from_numpy(part.astype(np.float32)) for part in parts))


@pytest.fixture
def written(particles, tmp_path):
    told = []
    about = write(
        "ply", particles, tmp_path / "ply", {"scene": "x"}, lambda *n: told.append(n), degree=3, up="world"
    )
    assert told == [(1, 3), (2, 3), (3, 3)]
    return particles, tmp_path / "ply", about


def test_a_viewer_draws_the_pictures_of_the_run(written):
    source, folder, about = written
    snapshots = [source.method.at(Moment(time)) for time in TIMES]
    for number, (snapshot, camera) in enumerate(zip(snapshots, source.cameras)):
        table = read(folder / "frames" / f"frame_{number:04d}.ply")
        assert list(table) == LAYOUT
        assert len(table["x"]) == about["particles"] == len(source.method.means)
        bare = gaussians(table)
        own = type(snapshot)(snapshot.moment, bare, still(bare), NO_TINTS, torch.ones(1), snapshot.blur)
        found, wanted = (s.render(View(camera), torch.ones(3)).rgb.detach() for s in (own, snapshot))
        assert float(wanted.std()) > 0.05
        torch.testing.assert_close(found, wanted, atol=2e-3, rtol=0)


def test_the_motion_moves_the_canonical_file_to_every_frame(written):
    source, folder, _ = written
    base, motion = read(folder / "canonical.ply"), np.load(folder / "motion.npz")
    places = np.stack([base[axis] for axis in "xyz"], -1)
    for number in range(len(TIMES)):
        frame = read(folder / "frames" / f"frame_{number:04d}.ply")
        maps = motion["maps"][number][motion["links"]]  # (N, L, 3, 4)
        steps = maps[..., :3] @ places[:, None, :, None] + maps[..., 3:]
        moved = places + (motion["weights"][..., None] * steps[..., 0]).sum(1)
        np.testing.assert_allclose(np.stack([frame[axis] for axis in "xyz"], -1), moved, atol=1e-5)
        logit = base["opacity"] + motion["opacity_over_time"] @ motion["opacity_basis"][number]
        np.testing.assert_allclose(expit(frame["opacity"]), expit(logit), atol=1e-5)
        tint = np.einsum("nkc,k->nc", motion["color_over_time"], motion["color_basis"][number])
        np.testing.assert_allclose(columns(frame, "f_dc"), columns(base, "f_dc") + tint / FLAT, atol=1e-4)
    np.testing.assert_allclose(motion["times"], TIMES)
    moves = np.abs(motion["maps"][2] - motion["maps"][0]).max()
    assert moves > 0.05


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_file_has_the_coefficients_of_its_degree(tmp_path, degree):
    harmonics = torch.arange(2 * 9 * 3, dtype=torch.float32).reshape(2, 9, 3)
    cloud = Ellipsoids(torch.zeros(2, 3), torch.eye(3).repeat(2, 1, 1), torch.rand(2), harmonics)
    write_ply(tmp_path / "a.ply", splat_columns(cloud, degree))
    table = read(tmp_path / "a.ply")
    count = (degree + 1) ** 2 - 1
    assert len([name for name in table if name.startswith("f_rest")]) == 3 * count
    np.testing.assert_array_equal(columns(table, "f_dc"), harmonics[:, 0])
    for i in range(count):
        for channel in range(3):
            wanted = harmonics[:, 1 + i, channel] if i < 8 else 0
            np.testing.assert_array_equal(table[f"f_rest_{channel * count + i}"], wanted)


def test_extremes_are_finite(tmp_path):
    opacity = torch.tensor([0.0, 1.0, 1.0])
    roots = torch.stack([torch.zeros(3, 3), torch.diag(torch.tensor([1.0, 0, 0])), torch.eye(3)])
    cloud = Ellipsoids(
        torch.zeros(3, 3), roots, opacity, torch.tensor([[[9.0] * 3], [[-9.0] * 3], [[0.0] * 3]])
    )
    write_ply(tmp_path / "a.ply", splat_columns(cloud))
    table = read(tmp_path / "a.ply")
    assert all(np.isfinite(column).all() for column in table.values())
    np.testing.assert_allclose(expit(table["opacity"]), opacity, atol=2e-6)
    np.testing.assert_allclose(columns(table, "rot")[2], [1, 0, 0, 0])


def test_voxels_are_points_of_the_surface_that_move(ball, tmp_path):
    about = write("ply", ball, tmp_path / "ply", {}, lambda *n: None, degree=3, up="world")
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
    write("ply", particles, tmp_path / "ply", {}, lambda *n: None, degree=2, up=up)
    turn = particles.turn_to(up)
    sign, axis = -1.0 if up[0] == "-" else 1.0, "xyz".index(up[-1])
    assert float((turn @ mean_up(list(particles.cameras)))[axis]) == pytest.approx(sign)
    assert float(torch.linalg.det(turn)) == pytest.approx(1)
    snapshot, camera = particles.method.at(Moment(TIMES[1])), particles.cameras[3]
    bare = gaussians(read(tmp_path / "ply" / "frames" / "frame_0001.ply"))
    own = type(snapshot)(snapshot.moment, bare, still(bare), NO_TINTS, torch.ones(1), snapshot.blur)
    pose = camera.camera_to_world.clone()
    pose[:3] = turn @ pose[:3]
    found = own.render(View(replace(camera, camera_to_world=pose)), torch.ones(3)).rgb
    wanted = snapshot.render(View(camera), torch.ones(3)).rgb.detach()
    torch.testing.assert_close(found, wanted, atol=2e-3, rtol=0)
