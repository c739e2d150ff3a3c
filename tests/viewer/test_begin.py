"""Where pages begin, and how they are sent splats; where there is no browser to test them in."""

import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from forewarp.scene.cloud import Ellipsoids
from forewarp.viewer.begin import begin_at, fitted_fov, silent, splat_arrays, vertical_fov
from tests.support.browser import NEEDED, chromium
from tests.support.tiny_scene import ball_scene


class Server:
    """Notes what it is told, as viser's server does."""

    def __init__(self):
        self.initial_camera, self.ups = SimpleNamespace(), []
        self.scene = SimpleNamespace(set_up_direction=self.ups.append)


@pytest.mark.parametrize(("side", "away"), [(1, 2.0), (-1, 7.0)])
def test_a_page_begins_where_a_camera_stands_and_turns_about_a_point_ahead(side, away):
    camera, server = ball_scene().train[0].camera, Server()
    pose = camera.camera_to_world
    center, ahead = pose[:3, 3], pose[:3, 2]
    focus = center + side * 2 * ahead + 0.3 * pose[:3, 0]
    begin_at(server, pose, vertical_fov(camera), focus, torch.tensor([0.0, 0, 1]), away=7.0)
    seen = server.initial_camera
    np.testing.assert_allclose(seen.position, center)
    np.testing.assert_allclose(seen.look_at, center + away * ahead)
    assert seen.fov == pytest.approx(2 * np.arctan(0.5 * camera.height / camera.fy))
    assert server.ups == [(0, 0, 1)]


@pytest.mark.parametrize(("width", "height"), [(400, 400), (1000, 400), (390, 844)])
def test_a_canvas_shows_the_whole_image(width, height):
    camera = ball_scene().train[0].camera
    down = math.tan(0.5 * fitted_fov(camera, width, height))
    across = down * width / height
    assert down >= 0.5 * camera.height / camera.fy - 1e-9
    assert across >= 0.5 * camera.width / camera.fx - 1e-9
    assert min(down / (camera.height / camera.fy), across / (camera.width / camera.fx)) == pytest.approx(0.5)


def test_splats_keep_their_shape_in_half_precision():
    places, roots = torch.ones(1, 3), 3e-5 * torch.eye(3)[None]
    small = Ellipsoids(places, roots, torch.full((1,), 0.5), torch.zeros(1, 1, 3))
    centers, covariances, colors, opacity = splat_arrays(small, 1e-2)
    np.testing.assert_allclose(centers, [[100, 100, 100]], rtol=1e-6)
    sent = covariances[0].astype(np.float16).astype(float)
    np.testing.assert_allclose(1e-4 * sent, 9e-10 * np.eye(3), rtol=0.01)
    assert (colors.tolist(), opacity.tolist()) == ([[0.5] * 3], [[0.5]])


def test_silence_ends(capsys):
    with silent():
        print("viser listens")
    print("here")
    assert capsys.readouterr().out == "here\n"


@pytest.mark.parametrize(
    ("needed", "outcome"), [("", pytest.skip.Exception), ("1", pytest.fail.Exception)], ids=["skip", "fail"]
)
@pytest.mark.parametrize("lacks", ["playwright", "chromium"])
def test_a_missing_browser_skips_its_tests_or_fails_where_it_is_needed(monkeypatch, lacks, needed, outcome):
    monkeypatch.setenv(NEEDED, needed)
    if lacks == "playwright":
        monkeypatch.setitem(sys.modules, "playwright.sync_api", None)
    else:
        pytest.importorskip("playwright.sync_api", reason="no playwright; make install-browser adds it")
        monkeypatch.setattr("shutil.which", lambda name: "/nowhere/chromium")
    with pytest.raises(outcome, match=f"no {lacks}.*make install-browser"), chromium():
        pass
