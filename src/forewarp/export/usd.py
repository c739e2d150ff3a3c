"""``format=usd``: particles as a ``ParticleField3DGaussianSplat`` of OpenUSD 26.03, with time samples."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from forewarp.export.ply import ALONG
from forewarp.export.tracks import Progress, Source
from forewarp.files import disk_error
from forewarp.scene.camera import mean_up
from forewarp.scene.cloud import Ellipsoids

_FPS = 24.0  # time codes a second, OpenUSD's own default
_REACH = 3.0  # standard deviations that the extent holds


def export_usd(
    source: Source, folder: Path, progress: Progress, *, degree: int, up: str, seconds: float | None
) -> dict:
    """Write ``scene.usdc``: one prim, whose attributes that change have a sample at each time, between which
    readers interpolate linearly.

    Args:
        source: the scene and its times.
        folder: to write into.
        progress: called after each time.
        degree: of the spherical harmonics, at most that of the run.
        up: the axis that points upwards, ``y`` or ``z``; ``world``: that of the two along which the data's
            own world is upright, else z.
        seconds: duration from time 0 to time 1; None: see ``Source.lasts``.

    Returns:
        the facts for ``about.json``.

    Raises:
        ValueError: for a method without particles, for another axis, or an OpenUSD that knows no Gaussians.
        OSError: where the file cannot be written whole.
    """
    from pxr import Gf, Tf, Usd, UsdGeom, UsdVol, Vt

    if not source.has_ellipsoids:
        raise source.without_particles("usd")
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        version = ".".join(map(str, Usd.GetVersion()[1:]))
        raise ValueError(f"format=usd: expected OpenUSD 26.03 or later, but got {version}; update usd-core")
    axis, rotation = upright(source, up)
    own_degree = math.isqrt(source.method.template().harmonics.shape[1]) - 1
    degree = min(degree, own_degree)
    clouds, total = [], len(source.times)
    for number, time in enumerate(source.times, 1):
        clouds.append(samples(source.method.ellipsoids(time).in_data(source.in_files), rotation, degree))
        progress(number, total)
    for before, cloud in zip(clouds, clouds[1:]):  # the shorter way round
        flips = (before["orientations"] * cloud["orientations"]).sum(-1, keepdims=True) < 0
        cloud["orientations"] = np.where(flips, -1, 1).astype(np.float32) * cloud["orientations"]
    seconds = source.lasts if seconds is None else seconds
    codes = [time * seconds * _FPS for time in source.times]

    file = folder / "scene.usdc"
    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageUpAxis(stage, axis.upper())
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(_FPS)
    stage.SetFramesPerSecond(_FPS)
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])
    if any(source.shift):
        stage.GetRootLayer().customLayerData = {"shift": Gf.Vec3d(*source.shift)}
    root = UsdGeom.Xform.Define(stage, "/scene")
    stage.SetDefaultPrim(root.GetPrim())
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/scene/particles")
    field.CreateRadianceSphericalHarmonicsDegreeAttr(degree)
    field.CreateSortingModeHintAttr("cameraDistance")
    reach = _REACH * max(float(cloud["scales"].max()) for cloud in clouds)
    places = np.stack([cloud["positions"] for cloud in clouds])
    low, high = places.min((0, 1)) - reach, places.max((0, 1)) + reach
    field.CreateExtentAttr(Vt.Vec3fArray([Gf.Vec3f(*low.tolist()), Gf.Vec3f(*high.tolist())]))
    attributes = {
        "positions": (field.CreatePositionsAttr(), Vt.Vec3fArray),
        "orientations": (field.CreateOrientationsAttr(), Vt.QuatfArray),
        "scales": (field.CreateScalesAttr(), Vt.Vec3fArray),
        "opacities": (field.CreateOpacitiesAttr(), Vt.FloatArray),
        "harmonics": (field.CreateRadianceSphericalHarmonicsCoefficientsAttr(), Vt.Vec3fArray),
    }
    sampled = []
    for name, (attribute, array) in attributes.items():
        values = [array.FromNumpy(np.ascontiguousarray(cloud[name])) for cloud in clouds]
        attribute.Set(values[0])
        if any(not np.array_equal(cloud[name], clouds[0][name]) for cloud in clouds[1:]):
            sampled.append(name)
            for code, value in zip(codes, values):
                attribute.Set(value, code)
    try:
        stage.Save()
    except Tf.ErrorException as error:
        raise disk_error(str(error), file) from error
    facts = {"particles": len(clouds[0]["positions"]), "degree": degree, "degree of the run": own_degree}
    facts |= {"seconds": seconds, "sampled": sampled, "off between times": off_between(source)}
    turned = "" if rotation is None else ", turned from the data's world by rotation"
    colors = "sRGB, as in the images: 1/2 + 0.28209479177387814 of the first coefficient is the mean"
    facts["rotation"] = torch.eye(3).tolist() if rotation is None else rotation.tolist()
    return facts | {"axes in the file": f"{axis} up{turned}", "colors": colors}


def upright(source: Source, up: str) -> tuple[str, Tensor | None]:
    """Return the axis, ``y`` or ``z``, that points upwards, and the rotation (3, 3) that turns the world so;
    None: as it is.

    Raises:
        ValueError: for an axis that OpenUSD has not.
    """
    if up not in ("world", "y", "z"):
        raise ValueError(f"up: expected world, y or z with format=usd, but got {up}")
    if up == "world":
        for axis, along in zip("yz", mean_up(source.cameras)[1:]):
            if along > ALONG:
                return axis, None
        up = "z"
    return up, source.rotation_to(up)


def samples(cloud: Ellipsoids, rotation: Tensor | None, degree: int) -> dict[str, np.ndarray]:
    """Return a time's sample of each attribute, float32; quaternions lie as OpenUSD's do: x, y, z, w."""
    cloud = cloud if rotation is None else cloud.turned(rotation)
    scales, quaternions = cloud.axes
    harmonics = cloud.harmonics[:, : (degree + 1) ** 2].reshape(-1, 3)
    parts = cloud.centers, quaternions.roll(-1, -1), scales, cloud.opacity, harmonics
    names = "positions", "orientations", "scales", "opacities", "harmonics"
    return {name: part.detach().float().cpu().numpy() for name, part in zip(names, parts)}


def off_between(source: Source) -> dict[str, float]:
    """Measure how far a straight way between samples leads from the run's own, halfway between two times:
    the data's units, the largest distance and that which 99 % of the particles stay below.
    """
    centers = [source.method.ellipsoids(time).centers for time in source.times]
    away = [torch.zeros(1)]
    for times, ends in zip(pairwise(source.times), pairwise(centers)):
        middle = source.method.ellipsoids(sum(times) / 2).centers
        away.append((middle - sum(ends) / 2).norm(dim=-1).cpu())
    distances = torch.cat(away) / source.world.scale
    # Not Tensor.quantile, which takes 16 million numbers at most.
    return {"largest": float(distances.max()), "99 %": float(np.quantile(distances.numpy(), 0.99))}
