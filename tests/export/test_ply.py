import math
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from plyfile import PlyData
from scipy.special import expit, logit

from forewarp.export.ply import lattice_in, packed_columns, splat_columns, voxelize, write_ply
from forewarp.glb.writer import morton
from forewarp.ops.gaussians import FLAT, Gaussians
from forewarp.scene.box import Box
from forewarp.scene.camera import mean_up
from forewarp.scene.cloud import Ellipsoids
from forewarp.scene.view import Moment, View
from tests.export.conftest import TIMES, exporter
from tests.support.gaussians import NO_TINTS, still
from tests.support.tiny_scene import BOX, RADIUS, ball_center, camera_at

export = exporter("ply", degree=3, up="world", compressed=False)
TOOL = shutil.which("splat-transform")
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


def unpacked(path):
    """The properties of a compressed file, in the same form, as the format says."""
    file = PlyData.read(path)
    chunk, vertex = file["chunk"], file["vertex"]
    rows = np.arange(vertex.count) // 256

    def numbers(name, *widths):
        word, parts = np.asarray(vertex[name]).astype(np.uint64), []
        for width in reversed(widths):
            parts.append((word & np.uint64(2**width - 1)) / (2**width - 1))
            word = word >> np.uint64(width)
        return parts[::-1]

    def between(names, shares):
        ends = [
            [np.asarray(chunk[f"{end}_{name}"], np.float64)[rows] for end in ("min", "max")] for name in names
        ]
        return [low + (high - low) * share for (low, high), share in zip(ends, shares)]

    table = dict(zip("xyz", between("xyz", numbers("packed_position", 11, 10, 11))))
    scales = between(("scale_x", "scale_y", "scale_z"), numbers("packed_scale", 11, 10, 11))
    table |= {f"scale_{i}": value for i, value in enumerate(scales)}
    *shares, opacity = numbers("packed_color", 8, 8, 8, 8)
    table |= {f"f_dc_{i}": (value - 0.5) / FLAT for i, value in enumerate(between("rgb", shares))}
    table["opacity"] = logit(opacity)
    largest, *parts = numbers("packed_rotation", 2, 10, 10, 10)
    others = [(part - 0.5) * 2**0.5 for part in parts]
    quaternions = np.stack([(1 - sum(part**2 for part in others)) ** 0.5, *others], -1)
    places = [[i, *(j for j in range(4) if j != i)] for i in range(4)]
    back = np.argsort(places, -1)[np.rint(3 * largest).astype(int)]
    turned = np.take_along_axis(quaternions, back, -1)
    table |= {f"rot_{i}": turned[:, i] for i in range(4)}
    for p in file["sh"].properties if "sh" in file else ():
        steps = np.asarray(file["sh"][p.name], np.float64)
        table[p.name] = np.where(steps == 0, -4, np.where(steps == 255, 4, (steps + 0.5) / 32 - 4))
    return table


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
    base = read(folder / "canonical.ply")
    with np.load(folder / "motion.npz") as stored:
        motion = dict(stored)
    places = np.stack([base[axis] for axis in "xyz"], -1)
    for number, (time, camera) in enumerate(zip(TIMES, particles.cameras)):
        frame = read(folder / "frames" / f"frame_{number:04d}.ply")
        assert list(frame) == LAYOUT
        assert len(frame["x"]) == about["particles"] == len(particles.method.gaussians.means)
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
    write_ply(tmp_path / "a.ply", {"vertex": splat_columns(cloud, degree)})
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
    write_ply(tmp_path / "a.ply", {"vertex": splat_columns(cloud)})
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


def test_compressed_files_are_as_exact_as_their_bits_and_look_the_same(particles, tmp_path):
    plain, small = tmp_path / "plain", tmp_path / "small"
    export(particles, plain, degree=2)
    about = export(particles, small, compressed=True)
    files = sorted(file.name for file in small.rglob("*.ply"))
    assert files == [f"frame_{i:04d}.compressed.ply" for i in range(len(TIMES))]
    assert about["degree"] == about["degree of the run"] == 2  # columns of degree 3 would be 0
    order = morton(particles.method.template().centers.numpy()).argsort(kind="stable")
    for number, (time, camera) in enumerate(zip(TIMES, particles.cameras)):
        whole = read(plain / "frames" / f"frame_{number:04d}.ply")
        table = unpacked(small / "frames" / f"frame_{number:04d}.compressed.ply")
        wanted = {name: whole[name][order] for name in table}
        for name in ("x", "y", "z", *(f"scale_{i}" for i in range(3)), *(f"f_dc_{i}" for i in range(3))):
            step = np.ptp(wanted[name]) / (255 if name.startswith("f_dc") else 1023)
            np.testing.assert_allclose(table[name], wanted[name], atol=0.51 * step, err_msg=name)
        rest = columns(wanted, "f_rest").clip(-4, 4)
        np.testing.assert_allclose(columns(table, "f_rest"), rest, atol=0.51 / 32)
        np.testing.assert_allclose(expit(table["opacity"]), expit(wanted["opacity"]), atol=0.51 / 255)
        cosines = np.abs((columns(table, "rot") * columns(wanted, "rot")).sum(-1))
        assert cosines.min() > 1 - 1e-5
        snapshot = particles.method.at(Moment(time))
        image = snapshot.render(View(camera), torch.ones(3)).rgb.detach()
        assert float((drawn(table, snapshot, camera) - image).square().mean()) < 1e-4  # 40 dB


@pytest.mark.parametrize("count", [1, 255, 257])
def test_chunks_that_are_not_full_or_alike_are_packed(tmp_path, count):
    harmonics = torch.full((count, 1, 3), 0.3)
    cloud = Ellipsoids(torch.ones(count, 3), torch.eye(3).expand(count, 3, 3), torch.ones(count), harmonics)
    write_ply(tmp_path / "a.ply", packed_columns(splat_columns(cloud, 0)))
    file, table = PlyData.read(tmp_path / "a.ply"), unpacked(tmp_path / "a.ply")
    assert (file["chunk"].count, file["vertex"].count) == (-(-count // 256), count)
    assert "sh" not in file
    np.testing.assert_array_equal(table["x"], 1)
    np.testing.assert_allclose(table["f_dc_1"], 0.3, atol=1e-6)
    np.testing.assert_allclose(columns(table, "rot"), [[1, 0, 0, 0]] * count, atol=1e-3)


@pytest.mark.parametrize(("up", "axis"), [("world", "z"), ("-y", "y"), ("y", "y")])
def test_headers_say_which_axis_is_vertical(particles, tmp_path, up, axis):
    level = replace(particles, cameras=[camera_at(i / 8) for i in range(8)])
    for compressed in (False, True):
        folder = tmp_path / f"{compressed}"
        export(level, folder, up=up, compressed=compressed)
        (file,) = folder.glob("frames/frame_0000*")
        assert PlyData.read(file).comments == [f"Vertical axis: {axis}"]


def test_voxels_are_not_compressed(ball, tmp_path):
    with pytest.raises(ValueError, match="compressed: expected a run of particles, but got one of forward"):
        export(ball, tmp_path / "ply", compressed=True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.skipif(TOOL is None, reason="no splat-transform: npm install -g @playcanvas/splat-transform")
def test_splat_transform_reads_them_and_makes_spz_and_sog_of_one_time(particles, tmp_path):
    export(particles, tmp_path / "small", compressed=True)
    export(particles, tmp_path / "plain", degree=2)

    def turn_into(source, target):
        subprocess.run([TOOL, "-q", "-w", "-g", "cpu", source, target], check=True, capture_output=True)
        return target

    path = tmp_path / "small" / "frames" / "frame_0001.compressed.ply"
    back, table = read(turn_into(path, tmp_path / "back.ply")), unpacked(path)
    for name in table:
        np.testing.assert_allclose(back[name], table[name], atol=1e-4, err_msg=name)
    frame = tmp_path / "plain" / "frames" / "frame_0001.ply"
    whole = read(frame)
    for kind, step in (("spz", 2e-3), ("sog", 0.02)):
        made = read(turn_into(turn_into(frame, tmp_path / f"a.{kind}"), tmp_path / f"{kind}.ply"))
        assert len(made["x"]) == len(whole["x"])
        for axis in "xyz":
            np.testing.assert_allclose(np.sort(made[axis]), np.sort(whole[axis]), atol=step)


export_mesh = exporter("mesh", resolution=40, level=0.5, files="ply", up="world")


def meshes(folder, files="ply"):
    return [trimesh.load(folder / f"mesh_{i:04d}.{files}", process=False) for i in range(len(TIMES))]


@pytest.mark.slow
@pytest.mark.parametrize("files", ["ply", "obj"])
def test_the_ball_is_where_it_is_at_each_time(ball, tmp_path, files):
    ball.method.bounds = lambda times: BOX
    about = export_mesh(ball, tmp_path / "mesh", files=files, resolution=60)
    for mesh, *facts, time in zip(meshes(tmp_path / "mesh", files), about["vertices"], about["faces"], TIMES):
        assert [len(mesh.vertices), len(mesh.faces)] == facts
        assert mesh.is_watertight
        part = max(mesh.split(), key=lambda part: part.volume)  # beside the block
        np.testing.assert_allclose(part.center_mass, ball_center(time), atol=0.01)
        assert part.volume == pytest.approx(4 / 3 * math.pi * RADIUS**3, rel=0.1)  # > 0: faces look outwards
        shown = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255
        painted = torch.sigmoid(2 * torch.from_numpy(np.asarray(mesh.vertices)))
        assert abs(shown - painted.numpy()).max() < 0.03


@pytest.mark.slow
def test_it_can_be_turned_upright(ball, tmp_path):
    ball.method.bounds = lambda times: BOX
    for up in ("world", "-y"):
        export_mesh(ball, tmp_path / up, resolution=30, up=up)
    rotation = ball.rotation_to("-y").T.numpy()
    for plain, turned in zip(meshes(tmp_path / "world"), meshes(tmp_path / "-y")):
        np.testing.assert_allclose(turned.vertices, np.asarray(plain.vertices) @ rotation, atol=1e-5)
        assert turned.volume > 0


def dense(cloud, points, blur):
    """Opacity and colour of ellipsoids at points, one by one."""
    through, depth, color = np.ones(len(points)), np.zeros(len(points)), np.zeros((len(points), 3))
    for center, covariance, opacity, shown in zip(
        *(part.double().numpy() for part in (cloud.centers, cloud.covariances, cloud.opacity, cloud.colors))
    ):
        away = points - center
        q = np.einsum("pi,ij,pj->p", away, np.linalg.inv(covariance + blur * np.eye(3)), away)
        alpha = opacity * np.exp(-0.5 * q)
        alpha[alpha < 1 / 255] = 0
        through *= 1 - alpha
        depth -= np.log1p(-alpha)
        color -= np.log1p(-alpha)[:, None] * shown
    return 1 - through, color / np.maximum(depth, 1e-12)[:, None]


def test_ellipsoids_on_a_lattice_are_those_one_by_one(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    centers, roots = (torch.randn(40, *shape, generator=generator) for shape in ((3,), (3, 3)))
    opacity, harmonics = torch.rand(40, generator=generator), torch.randn(40, 1, 3, generator=generator)
    cloud = Ellipsoids(0.3 * centers, 0.1 * roots, opacity, harmonics)
    lattice = lattice_in(Box((-1, -0.8, -0.9), (0.6, 1, 1)), 20)
    wanted = dense(cloud, lattice.to_world(lattice.all_voxels()).numpy(), (0.5 * lattice.spacing[0]) ** 2)
    some = wanted[0] > 0.3
    assert some.sum() > 100
    for pairs in (1 << 19, 500):
        monkeypatch.setattr("forewarp.export.ply._CHUNK", pairs)
        opacity, colors = voxelize(cloud, lattice)
        # Boxes hold a little more than the ellipsoids that end where nothing is drawn.
        np.testing.assert_allclose(opacity.flatten(), wanted[0], atol=0.05)
        assert abs(opacity.flatten().numpy() - wanted[0]).mean() < 3e-3
        np.testing.assert_allclose(colors.reshape(-1, 3)[some], wanted[1][some], atol=0.05)


@pytest.mark.slow
def test_particles_have_their_opacity_at_the_vertices(particles, tmp_path):
    about = export_mesh(particles, tmp_path / "mesh", level=0.4)
    for mesh, time in zip(meshes(tmp_path / "mesh"), TIMES):
        some = np.arange(0, len(mesh.vertices), max(1, len(mesh.vertices) // 300))
        points, blur = np.asarray(mesh.vertices)[some], (0.5 * about["spacing"]) ** 2
        opacity, color = dense(particles.method.ellipsoids(time), points, blur)
        assert abs(opacity - 0.4).mean() < 0.08
        shown = np.asarray(mesh.visual.vertex_colors)[some, :3] / 255
        assert abs(shown - color).mean() < 0.06


def test_nothing_found_is_one_line(particles, tmp_path, monkeypatch):
    particles.method.gaussians.opacity.data -= 2
    between = "level: expected a number between the lowest and the highest opacity at time 0, "
    with pytest.raises(ValueError, match=between + r"0 and 0\.\d+, but got 0.9"):
        export_mesh(particles, tmp_path / "mesh", level=0.9)
    full = torch.linspace(0.6, 1, 8).reshape(2, 2, 2), torch.ones(2, 2, 2, 3)
    monkeypatch.setattr("forewarp.export.ply.voxelize", lambda *_: full)
    with pytest.raises(ValueError, match=between + "0.6 and 1, but got 0.5"):
        export_mesh(particles, tmp_path / "mesh")
    monkeypatch.setattr(particles.method, "bounds", lambda times: None)
    with pytest.raises(ValueError, match="run: expected matter to make a mesh of, but got none; train it"):
        export_mesh(particles, tmp_path / "mesh")
    assert list(tmp_path.iterdir()) == []
