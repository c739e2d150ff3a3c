import math

import numpy as np
import pytest
import torch
import trimesh

from forewarp.export.ply import lattice_in, voxelize
from forewarp.scene.box import Box
from forewarp.scene.cloud import Ellipsoids
from tests.export.conftest import TIMES, exporter
from tests.support.tiny_scene import BOX, RADIUS, ball_center

export = exporter("mesh", resolution=40, level=0.5, files="ply", up="world")


def meshes(folder, files="ply"):
    return [trimesh.load(folder / f"mesh_{i:04d}.{files}", process=False) for i in range(len(TIMES))]


@pytest.mark.parametrize("files", ["ply", "obj"])
def test_the_ball_is_where_it_is_at_each_time(ball, tmp_path, files):
    ball.method.bounds = lambda times: BOX
    about = export(ball, tmp_path / "mesh", files=files, resolution=60)
    for mesh, *facts, time in zip(meshes(tmp_path / "mesh", files), about["vertices"], about["faces"], TIMES):
        assert [len(mesh.vertices), len(mesh.faces)] == facts
        assert mesh.is_watertight
        part = max(mesh.split(), key=lambda part: part.volume)  # beside the block
        np.testing.assert_allclose(part.center_mass, ball_center(time), atol=0.01)
        assert part.volume == pytest.approx(4 / 3 * math.pi * RADIUS**3, rel=0.1)  # > 0: faces look outwards
        shown = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255
        painted = torch.sigmoid(2 * torch.from_numpy(np.asarray(mesh.vertices)))
        assert abs(shown - painted.numpy()).max() < 0.03


def test_it_can_be_turned_upright(ball, tmp_path):
    ball.method.bounds = lambda times: BOX
    for up in ("world", "-y"):
        export(ball, tmp_path / up, resolution=30, up=up)
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


def test_particles_have_their_opacity_at_the_vertices(particles, tmp_path):
    about = export(particles, tmp_path / "mesh", level=0.4)
    for mesh, time in zip(meshes(tmp_path / "mesh"), TIMES):
        some = np.arange(0, len(mesh.vertices), max(1, len(mesh.vertices) // 300))
        points, blur = np.asarray(mesh.vertices)[some], (0.5 * about["spacing"]) ** 2
        opacity, color = dense(particles.method.ellipsoids(time), points, blur)
        assert abs(opacity - 0.4).mean() < 0.08
        shown = np.asarray(mesh.visual.vertex_colors)[some, :3] / 255
        assert abs(shown - color).mean() < 0.06


def test_nothing_found_is_one_line(particles, tmp_path, monkeypatch):
    particles.method.opacity.data -= 2
    between = "level: expected a number between the lowest and the highest opacity at time 0, "
    with pytest.raises(ValueError, match=between + r"0 and 0\.\d+, but got 0.9"):
        export(particles, tmp_path / "mesh", level=0.9)
    full = torch.linspace(0.6, 1, 8).reshape(2, 2, 2), torch.ones(2, 2, 2, 3)
    monkeypatch.setattr("forewarp.export.ply.voxelize", lambda *_: full)
    with pytest.raises(ValueError, match=between + "0.6 and 1, but got 0.5"):
        export(particles, tmp_path / "mesh")
    monkeypatch.setattr(particles.method, "bounds", lambda times: None)
    with pytest.raises(ValueError, match="run: expected matter to make a mesh of, but got none; train it"):
        export(particles, tmp_path / "mesh")
    assert list(tmp_path.iterdir()) == []
