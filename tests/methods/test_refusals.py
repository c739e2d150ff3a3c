"""What a published system cannot be built from is refused in a line that names the key to change."""

from functools import partial

import pytest

from forewarp.methods.dnerf import DNeRF
from forewarp.methods.hypernerf import HyperNeRF
from forewarp.methods.method import Start
from forewarp.methods.ndvg import NDVG
from forewarp.methods.nerf import NeRF
from forewarp.methods.nerfies import Nerfies
from forewarp.methods.rays import Marching, Sampling
from forewarp.methods.tineuvox import TiNeuVox
from forewarp.methods.tnerf import TNeRF
from tests.support.still_cameras import moving_scene

SAMPLED = (NeRF, TNeRF, DNeRF, Nerfies, HyperNeRF)
OPACITY = r"alpha_init: expected a number in \(0, 1\), but got"
STEPS = r"stage.fine.num_voxels: expected \[\[0, count\], .* ascending fractions and counts >= 8, but got"
PAIR = "expected two whole numbers >= 1, but got"
WHOLE = "expected a whole number >="
SCHEDULES = (64000, [0, 100], None, [[0, "a"]], [], [[0.5, 100]], [[0, 2]], [[0, 8], [0.5, 64], [0.3, 32]])


def made(kind, numbers=None, **options):
    return kind(Start(moving_scene(), "fine", {"num_voxels": [[0, 125]]} | (numbers or {})), **options)


REFUSED = [
    *(
        (partial(made, kind, {"num_voxels": given}), STEPS)
        for kind in (TiNeuVox, NDVG)
        for given in SCHEDULES
    ),
    *((partial(made, TiNeuVox, alpha_init=wrong), f"model.{OPACITY}") for wrong in (0, 1.0, None)),
    (partial(made, NDVG, {"alpha_init": 1.0}), f"stage.fine.{OPACITY} 1.0"),
    *((partial(made, NDVG, width=wrong), f"model.width: {PAIR}") for wrong in (64, [64], [64, 0], None)),
    (partial(made, NDVG, channels=[4, "a"]), f"model.channels: {PAIR}"),
    (partial(made, NDVG, {"deformation_voxels": 0}), "stage.fine.deformation_voxels: expected a number > 0"),
    (
        partial(made, NDVG, {"box_alpha": 1}),
        r"stage.fine.box_alpha: expected a number in \[0, 1\), but got 1",
    ),
    (partial(made, NDVG, {"sink": None}), "stage.fine.sink: expected a number >= 0, but got None"),
    (partial(made, NDVG, frequencies=-1), f"model.frequencies: {WHOLE} 0, but got -1"),
    (partial(made, TiNeuVox, feature_frequencies=-1), f"model.feature_frequencies: {WHOLE} 0, but got -1"),
    (partial(made, TiNeuVox, channels=0), f"model.channels: {WHOLE} 1, but got 0"),
    (
        partial(made, TiNeuVox, {"frozen_from": None}),
        r"stage.fine.frozen_from: expected a fraction in \[0, 1\]",
    ),
    (
        partial(made, TiNeuVox, {"color_threshold": 1}),
        r"stage.fine.color_threshold: expected a weight in \[0",
    ),
    (partial(Marching, step=0), "model.marching.step: expected a number > 0, but got 0"),
    (partial(Marching, step=None), "model.marching.step: expected a number > 0, but got None"),
    (
        partial(Marching, color_threshold=1.0),
        r"model.marching.color_threshold: expected a weight in \[0, 1\)",
    ),
    (partial(Marching, occupancy=-1), f"model.marching.occupancy: {WHOLE} 0, but got -1"),
    (partial(Marching, look_every=None), f"model.marching.look_every: {WHOLE} 0, but got None"),
    (partial(Sampling, occupancy=-1), f"model.sampling.occupancy: {WHOLE} 0, but got -1"),
    *(
        (partial(made, kind, position_frequencies=-1), f"model.position_frequencies: {WHOLE} 0, but got -1")
        for kind in SAMPLED
    ),
    *(
        (partial(made, kind, {"warp_in": None}), "stage.fine.warp_in: expected a fraction .* but got None")
        for kind in (Nerfies, HyperNeRF)
    ),
    (partial(made, Nerfies, warp_frequencies=-1), f"model.warp_frequencies: {WHOLE} 0, but got -1"),
    (partial(made, HyperNeRF, warp_frequencies=0), f"model.warp_frequencies: {WHOLE} 1, but got 0"),
    (partial(made, HyperNeRF, ambient_frequencies=0), f"model.ambient_frequencies: {WHOLE} 1, but got 0"),
]


@pytest.mark.parametrize(("call", "text"), REFUSED)
def test_refuses(call, text):
    with pytest.raises(ValueError, match=f"^{text}"):
        call()
