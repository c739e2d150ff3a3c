"""``format=usd``, as usd-core reads it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.export.conftest import TIMES, exporter
from tests.support.full_disk import file_size_limit
from tests.support.particles import module_with, shaken, small_data
from tests.support.tiny_scene import camera_at

pytest.importorskip("pxr")
from pxr import Usd, UsdGeom, UsdVol

export = exporter("usd", degree=3, up="world", seconds=4.0)
FPS = 24


def opened(folder):
    """The stage and its particles."""
    stage = Usd.Stage.Open(str(folder / "scene.usdc"))
    return stage, UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/scene/particles"))


def quaternions(attribute, code):
    return np.array([[*q.GetImaginary(), q.GetReal()] for q in attribute.Get(code)])


def arrays(field, code):
    """What the particles are at a time code: centers, covariances, opacities and harmonics, as tensors."""
    positions, scales = (np.array(a.Get(code)) for a in (field.GetPositionsAttr(), field.GetScalesAttr()))
    axes = Rotation.from_quat(quaternions(field.GetOrientationsAttr(), code)).as_matrix() * scales[:, None]
    harmonics = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(code))
    degree = field.GetRadianceSphericalHarmonicsDegreeAttr().Get()
    parts = positions, axes @ axes.transpose(0, 2, 1), np.array(field.GetOpacitiesAttr().Get(code))
    return [
        torch.from_numpy(np.asarray(p, np.float32))
        for p in (*parts, harmonics.reshape(-1, (degree + 1) ** 2, 3))
    ]


def test_samples_are_the_run_and_between_them_it_goes_straight(particles, tmp_path):
    about = export(particles, tmp_path / "usd")
    stage, field = opened(tmp_path / "usd")
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 4 * FPS)
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == FPS
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetDefaultPrim().GetPath() == "/scene"
    assert about["degree"] == 2
    assert field.GetPositionsAttr().GetTimeSamples() == [time * 4 * FPS for time in TIMES]
    low, high = (torch.tensor(corner) for corner in field.GetExtentAttr().Get())
    for time in TIMES:
        cloud = particles.method.ellipsoids(time)
        wanted = cloud.centers, cloud.covariances, cloud.opacity, cloud.harmonics
        for found, value in zip(arrays(field, time * 4 * FPS), wanted):
            torch.testing.assert_close(found, value, atol=2e-5, rtol=1e-4)
        assert bool(((cloud.centers > low) & (cloud.centers < high)).all())
    away = []
    for before, after in zip(TIMES, TIMES[1:]):
        time = (before + after) / 2
        found, _, _, _ = arrays(field, time * 4 * FPS)
        away.append((found - particles.method.ellipsoids(time).centers).norm(dim=-1))
    off = {"largest": float(torch.cat(away).max()), "99 %": float(torch.cat(away).quantile(0.99))}
    assert 0 < off["99 %"] < off["largest"]
    assert about["off between times"] == pytest.approx(off, rel=1e-3)


def test_quaternions_go_the_shorter_way(particles, tmp_path):
    export(replace(particles, times=[i / 12 for i in range(13)]), tmp_path / "usd")
    _, field = opened(tmp_path / "usd")
    turned = [quaternions(field.GetOrientationsAttr(), 8.0 * i) for i in range(13)]
    assert min((a * b).sum(-1).min() for a, b in zip(turned, turned[1:])) >= 0


@pytest.mark.parametrize(("up", "axis"), [("world", "Z"), ("z", "Z"), ("y", "Y")])
def test_the_stage_says_which_axis_is_upwards_and_the_particles_are_turned_so(particles, tmp_path, up, axis):
    level = replace(particles, cameras=[camera_at(i / 8) for i in range(8)])
    export(level, tmp_path / "usd", up=up)
    stage, field = opened(tmp_path / "usd")
    assert UsdGeom.GetStageUpAxis(stage) == axis
    cloud = particles.method.ellipsoids(TIMES[1])
    turned = cloud if up == "world" else cloud.turned(level.rotation_to(up))
    for found, value in zip(arrays(field, TIMES[1] * 4 * FPS), (turned.centers, turned.covariances)):
        torch.testing.assert_close(found, value, atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(arrays(field, TIMES[1] * 4 * FPS)[3], turned.harmonics, atol=1e-4, rtol=1e-3)


def test_what_does_not_change_has_no_samples(particles, tmp_path):
    module = shaken(module_with(small_data(), motion=None, rotation=None))
    about = export(replace(particles, module=module), tmp_path / "usd")
    _, field = opened(tmp_path / "usd")
    assert about["sampled"] == []
    assert field.GetPositionsAttr().GetNumTimeSamples() == 0
    assert len(field.GetPositionsAttr().Get()) == about["particles"]
    assert about["off between times"]["largest"] == 0


def test_other_axes_and_methods_are_refused(particles, ball, tmp_path):
    with pytest.raises(ValueError, match="up: expected world, y or z with format=usd, but got -y"):
        export(particles, tmp_path / "usd", up="-y")
    with pytest.raises(ValueError, match="format=usd: expected a method made of particles, but got forward"):
        export(ball, tmp_path / "usd")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_an_error_and_keeps_the_file_that_was_there(particles, tmp_path):
    export(particles, tmp_path / "out")
    before = (tmp_path / "out" / "scene.usdc").read_bytes()
    with file_size_limit(2000), pytest.raises(OSError, match=r"too large|No space") as refused:
        export(particles, tmp_path / "out")
    assert refused.value.filename == str(tmp_path / "out" / "scene.usdc")
    assert (tmp_path / "out" / "scene.usdc").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
