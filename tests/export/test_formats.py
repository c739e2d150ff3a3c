"""What every format refuses; ``format=npz``."""

import contextlib
import inspect
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from pygltflib import GLTF2
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from forewarp.export import formats
from forewarp.export.formats import CHOICES, FORMATS, NUMBERS, WHOLE_NUMBERS
from forewarp.export.tracks import Source
from tests.export.conftest import TIMES, exporter
from tests.support.configs import ROOT
from tests.support.tiny_scene import RADIUS, ball_center


@pytest.mark.parametrize("kind", FORMATS)
def test_a_method_that_knows_no_matter_is_refused_in_one_line(tmp_path, kind):
    if FORMATS[kind].package:
        pytest.importorskip(FORMATS[kind].package)
    source = Source(SimpleNamespace(method=object()), "tnerf", [], [0.0])
    options = dict.fromkeys(FORMATS[kind].options)
    with pytest.raises(ValueError, match=f"format={kind}: expected a method .*, but got tnerf"):
        exporter(kind)(source, tmp_path / "out", **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("kind", "extra"), [("mesh", "export"), ("usd", "usd")])
def test_without_its_extra_a_format_says_what_to_install(monkeypatch, kind, extra):
    monkeypatch.setattr(formats, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=rf"format={kind}: .* got none; install forewarp\[{extra}\]"):
        formats.require(kind)


@pytest.mark.parametrize("kind", FORMATS)
def test_options_are_arguments_with_defaults_in_the_config_and_limits(kind):
    function = getattr(import_module(f"forewarp.export.{FORMATS[kind].module}"), f"export_{kind}")
    parameters = inspect.signature(function).parameters.values()
    assert [p.name for p in parameters if p.kind is p.KEYWORD_ONLY] == list(FORMATS[kind].options)
    config = OmegaConf.load(ROOT / "conf" / "export.yaml")
    for name in FORMATS[kind].options:
        assert name in config
        assert sum(name in limits for limits in (CHOICES, NUMBERS, WHOLE_NUMBERS)) == 1


def load(source, tmp_path, **options):
    about = exporter("npz")(source, tmp_path / "npz", **options)
    files = (np.load(tmp_path / "npz" / f"{name}.npz") for name in ("trajectories", "method"))
    with contextlib.ExitStack() as stack:
        return about, *(dict(stack.enter_context(file)) for file in files)


@pytest.mark.slow
def test_voxels_go_where_the_method_says_and_are_seen_from_their_side(ball, tmp_path):
    about, tracks, method = load(ball, tmp_path, points=150, views=3)
    points = torch.from_numpy(tracks["points"])
    assert about["points"] == len(points) == 150
    np.testing.assert_allclose(tracks["times"], TIMES)
    wanted = ball.method.trajectories(points, torch.tensor(TIMES))
    np.testing.assert_allclose(tracks["positions"], wanted, atol=1e-6)
    np.testing.assert_allclose(tracks["colors"][:, 1], torch.sigmoid(2 * points), atol=1e-5)
    visible = torch.from_numpy(tracks["visible"])
    assert visible.shape == (150, len(TIMES), 3)
    for row, time in enumerate(TIMES):
        of_ball = ~ball.method.is_still(points)
        normal = (wanted[of_ball, row] - ball_center(time)) / RADIUS
        for column, pose in enumerate(torch.from_numpy(tracks["camera_to_world"]).float()):
            faces = (normal * (pose[:3, 3] - wanted[of_ball, row])).sum(-1)  # > 0: towards the camera
            # The block stands before some of them.
            assert visible[of_ball, row, column][faces > 1.2].float().mean() > 0.85
            assert visible[of_ball, row, column][faces < -1.2].float().mean() < 0.05
    camera = ball.cameras[int(tracks["cameras"][1])]
    np.testing.assert_array_equal(tracks["intrinsics"][1][0], [camera.fx, 0, camera.cx])
    assert {"radiance.density", "radiance.color"} <= method.keys()


def test_particles_go_as_their_centers_with_colours_and_opacity_of_each_time(particles, tmp_path):
    _, tracks, method = load(particles, tmp_path, points=10**6, views=1)
    clouds = [particles.method.ellipsoids(time) for time in TIMES]
    chosen = KDTree(clouds[0].centers).query(tracks["positions"][:, 0])[1]
    assert len(set(chosen)) == len(chosen) > 30
    for row, cloud in enumerate(cloud[chosen] for cloud in clouds):
        for name, wanted in (("positions", cloud.centers), ("colors", cloud.colors)):
            np.testing.assert_allclose(tracks[name][:, row], wanted, atol=1e-6)
        np.testing.assert_allclose(tracks["opacity"][:, row], cloud.opacity, atol=1e-6)
    assert np.ptp(tracks["opacity"], 1).max() > 0.05
    np.testing.assert_array_equal(method["gaussians.means"], particles.method.gaussians.means.detach())


TYPES = {5126: np.float32, 5125: np.uint32}


class File:
    """A file as pygltflib reads it."""

    def __init__(self, path):
        self.gltf = GLTF2().load(path)
        self.primitive = self.gltf.meshes[0].primitives[0]

    def array(self, number):
        accessor = self.gltf.accessors[number]
        view = self.gltf.bufferViews[accessor.bufferView]
        data = self.gltf.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
        values = np.frombuffer(data, TYPES[accessor.componentType]).reshape(accessor.count, -1)
        if accessor.min:  # pygltflib's own default is empty
            np.testing.assert_array_equal(values.min(0), np.float32(accessor.min))
            np.testing.assert_array_equal(values.max(0), np.float32(accessor.max))
        return values

    def played(self, second):
        """Corners (N, 4, 3) and colours (N, 4, 3) when the animation is at a second."""
        animation = self.gltf.animations[0]
        sampler = animation.samplers[0]
        assert (sampler.interpolation, animation.channels[0].target.path) == ("LINEAR", "weights")
        clock, weights = self.array(sampler.input)[:, 0], self.array(sampler.output).reshape(len(TIMES), -1)
        now = [np.interp(second, clock, column) for column in weights.T]
        parts = []
        for name in ("POSITION", "COLOR_0"):
            base = self.array(getattr(self.primitive.attributes, name))
            moved = [target.get(name) for target in self.primitive.targets]
            parts.append(base + sum(w * self.array(n) for w, n in zip(now, moved) if n is not None))
        return [part.reshape(-1, 4, 3) for part in parts]


def export(source, folder, **options):
    about = exporter("gltf", points=10**5, seconds=2.0)(source, folder, **options)
    return about, File(folder / "points.glb")


def encoded(color):
    """Linear to sRGB."""
    return np.where(color <= 0.0031308, 12.92 * color, 1.055 * np.clip(color, 0, 1) ** (1 / 2.4) - 0.055)


def test_particles_move_change_colour_and_fade(particles, tmp_path):
    about, file = export(particles, tmp_path / "gltf")
    clouds = [particles.method.ellipsoids(time) for time in TIMES]
    most = torch.stack([cloud.opacity for cloud in clouds]).amax(0)
    chosen = KDTree(clouds[0].centers).query(file.played(0)[0].mean(1))[1]
    assert len(set(chosen)) == len(chosen) == about["points"] > 30
    clouds = [cloud[chosen] for cloud in clouds]
    for time, cloud in zip(TIMES, clouds):
        corners, colors = file.played(2.0 * time)
        np.testing.assert_allclose(corners.mean(1), cloud.centers, atol=1e-5)
        np.testing.assert_allclose(encoded(colors[:, 0]), cloud.colors, atol=2e-3)
        radius = np.linalg.norm(corners - corners.mean(1, keepdims=True), axis=-1)
        np.testing.assert_allclose(radius[:, 2], about["radius"] * cloud.opacity / most[chosen], atol=1e-5)
    between = file.played(2 * 0.7)[0].mean(1)
    np.testing.assert_allclose(between, (clouds[1].centers + clouds[2].centers) / 2, atol=1e-5)


def test_voxels_move_and_have_only_the_colours_of_the_first_time(ball, tmp_path):
    about, file = export(ball, tmp_path / "gltf", points=100)
    assert len(file.played(0)[0]) == about["points"] == 100
    first = torch.from_numpy(file.played(0)[0].mean(1)).float()
    wanted = ball.method.trajectories(first, torch.tensor(TIMES))
    np.testing.assert_allclose(file.played(2.0)[0].mean(1), wanted[:, 2], atol=1e-5)
    np.testing.assert_allclose(encoded(file.played(1.3)[1][:, 3]), torch.sigmoid(2 * first), atol=2e-3)
    faces = file.array(file.primitive.indices).reshape(-1, 3)
    corners = file.played(0)[0].reshape(-1, 3)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middles = np.repeat(first.numpy(), 4, 0)
    assert ((normals * (corners.mean(1) - middles)).sum(-1) > 0).all()  # they face outwards
    rotation = Rotation.from_quat(file.gltf.nodes[0].rotation)
    np.testing.assert_allclose(rotation.apply([0, 0, 1]), [0, 1, 0], atol=0.1)  # the cameras stand about z


def test_few_points_at_one_time_are_a_still(ball, tmp_path):
    object.__setattr__(ball, "times", (0.4,))
    about, file = export(ball, tmp_path / "gltf", points=4)
    assert not file.gltf.animations
    assert not file.primitive.targets
    assert about["radius"] > 0  # without a fourth neighbour, of the points' own size
