"""The systems of the paper's tables give what their authors' code gives with the same weights.

``official.npz`` holds what that code gave in double precision, and the points and directions it was asked at;
weights follow from their names. Networks are narrow, encodings as published. The code: D-NeRF 2137203 (also
for NeRF), Nerfies 1a38512, HyperNeRF d433ebe, NDVG 3128d3a, TiNeuVox d1f3adb, Neural Volumes 8c5fad4, whose
``grid_sample`` put points on corners when it was written.
"""

import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from forewarp.methods.dnerf import DNeRF
from forewarp.methods.hypernerf import HyperNeRF
from forewarp.methods.method import Start
from forewarp.methods.ndvg import NDVG
from forewarp.methods.nerf import NeRF
from forewarp.methods.nerfies import Nerfies
from forewarp.methods.neural_volumes import NeuralVolumes, code_prior, opacity_prior, opacity_variation
from forewarp.methods.rays import Marching, Sampling
from forewarp.methods.tineuvox import TiNeuVox
from forewarp.scene.camera import Rays
from forewarp.scene.view import Moment
from tests.support.sampled_methods import batch
from tests.support.still_cameras import moving_scene

STORED = dict(np.load(Path(__file__).with_name("official.npz")))
POINTS, DIRECTIONS = (torch.from_numpy(STORED[name]) for name in ("points", "directions"))
RAYS = Rays((POINTS - 3 * DIRECTIONS)[:6], DIRECTIONS[:6], 2.0, 4.0)
GRID = {"num_voxels": [[0, 1000]], "alpha_init": 1e-2}
WARP = {"width": 16, "warp_width": 12, "sampling": Sampling(8, 8, density="softplus")}
VOLUMES = {"tower": [8] * 7, "features": 16, "code": 12, "decoder": (32, 16, 16), "maps": 4, "warp_side": 6}
VOLUMES |= {"warp_width": 16, "weight_width": 8, "step": 1 / 16}
MAKE = {
    "nerf": partial(NeRF, width=16, sampling=Sampling(8, 8)),
    "dnerf": partial(DNeRF, width=16, sampling=Sampling(8, 8)),
    "nerfies": partial(Nerfies, **WARP),
    "hypernerf": partial(HyperNeRF, **WARP, slice_width=10),
    "ndvg": partial(NDVG, width=(12, 16), marching=Marching()),
    "tineuvox": partial(TiNeuVox, width=16, camera=True),
    "neural_volumes": partial(NeuralVolumes, **VOLUMES),
}
# Last layers of warps, which are to move points a little.
SMALL = ("warp.turn", "warp.shift", "network.6", "offsets.4")


def made(kind):
    """Make a method in double precision, whose weights follow from their names."""
    start = Start(moving_scene(POINTS), "fine", dict(GRID) if kind in ("ndvg", "tineuvox") else {})
    method = MAKE[kind](start).double()
    with torch.no_grad():
        for name, parameter in method.named_parameters():
            draw = np.random.RandomState(zlib.crc32(name.encode())).standard_normal(tuple(parameter.shape))
            spread = 1.3 / parameter[0].numel() ** 0.5 if parameter.ndim > 1 else 0.1
            spread *= 0.01 if kind != "neural_volumes" and name.startswith(SMALL) else 1
            bias = 0.5 if name.endswith("density_head.bias") else 0.0  # so that ReLU lets some through
            parameter.copy_(bias + spread * torch.from_numpy(draw))
    return method


def picture():
    """What Neural Volumes' encoder sees (1, 3, 512, 334), standardised."""
    return torch.from_numpy(np.random.RandomState(1).standard_normal((1, 3, 512, 334)))


def code():
    """What its decoder is given (12,), with which maps reach beyond the cube."""
    return torch.from_numpy(np.random.RandomState(2).standard_normal(12))


def along(method, time, background):
    seen = method.along(Moment(time, camera=0), RAYS, torch.full((3,), background).double())
    return seen, {"rgb": seen.rgb} | ({} if seen.coarse is None else {"coarse": seen.coarse.rgb})


def of_nerf(method):
    return along(method, 0.5, 1.0)[1]


def of_dnerf(method):
    return {"offset": method.backward_flow(POINTS, 0.5)} | {
        f"{time}": along(method, time, 1.0)[1]["rgb"] for time in (0.0, 0.5)
    }


def of_warp(method):
    for name, value in (("window", 2.5), ("windows", torch.tensor([2.5, 0.75]))):
        if hasattr(method, name):
            getattr(method, name).copy_(torch.as_tensor(value))
    seen, found = along(method, 0.5, 0.0)
    found["warped"] = method.warp(POINTS, method.codes(0.5), 2.5)
    strain = method.warp.elastic(seen.coarse.points.reshape(-1, 3), method.codes(0.5), 2.5)
    found["elastic"] = (seen.coarse.weights.reshape(-1) * strain).sum() / len(RAYS)
    if "elastic" in method.terms:  # of a step that had more rays than were looked along
        term = method.extra_terms(seen, batch(), torch.Generator())["elastic"]()
        torch.testing.assert_close(term * (144 / len(RAYS)), found["elastic"])
    code = method.codes(0.5)[None]
    return found | {"still": method.warp.stray(POINTS, code, 2.5, None, torch.Generator())}


def of_grids(method):
    field = method.field(Moment(0.5, camera=0))
    density, color = field.at_world(POINTS)
    opacity = -torch.expm1(-density * 0.5 * method.activation.density_scale)
    return {"opacity": opacity, "color": color(slice(None), DIRECTIONS)}


def of_volumes(method):
    mean, deviation = method.encoder(torch.nn.functional.pad(picture(), (25, 25)))
    volumes = method.volumes(code())
    towards = torch.nn.functional.normalize(torch.cat([0.3 * DIRECTIONS[:, :2], torch.ones(16, 1)], 1), dim=1)
    rays = Rays(torch.tensor([0.1, -0.2, -3.0]).double().expand(16, 3), towards, 0.0, 9.0)
    seen = method.march(volumes, rays, torch.ones(3).double(), method.tint(0))
    found = {"mean": mean, "deviation": deviation, "warp": volumes.warp.flatten()[::13]}
    found |= {"template": volumes.template.flatten()[::37], "rgb": seen.rgb, "opacity": seen.opacity}
    found |= {"code_prior": code_prior(mean, deviation), "opacity_prior": opacity_prior(seen.opacity)}
    return found | {"opacity_variation": opacity_variation(volumes.template[3])}


FOUND = {"nerf": of_nerf, "dnerf": of_dnerf, "nerfies": of_warp, "hypernerf": of_warp}
FOUND |= {"ndvg": of_grids, "tineuvox": of_grids, "neural_volumes": of_volumes}


@pytest.mark.slow
@pytest.mark.parametrize("kind", FOUND)
def test_a_system_gives_what_its_authors_code_gives(kind, monkeypatch):
    monkeypatch.setattr("forewarp.fields.networks._JITTER", 0.0)
    found = FOUND[kind](made(kind))
    names = {name.partition("/")[2] for name in STORED if name.startswith(f"{kind}/")}
    assert set(found) == names
    for name, value in found.items():
        expected = torch.from_numpy(STORED[f"{kind}/{name}"])
        torch.testing.assert_close(value.detach(), expected, rtol=1e-6, atol=1e-8, msg=f"{name}: {{}}".format)
