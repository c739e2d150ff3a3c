"""What every format refuses; ``format=npz``."""

import inspect
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from scipy.spatial import KDTree

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
    return about, *(np.load(tmp_path / "npz" / f"{name}.npz") for name in ("trajectories", "method"))


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
    assert {"radiance.density", "radiance.color"} <= set(method.files)


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
    np.testing.assert_array_equal(method["means"], particles.method.means.detach())
