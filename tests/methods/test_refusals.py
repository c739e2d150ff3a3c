"""What a published system cannot be built from is refused in a line that names the key to change."""

import re

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

OPACITY, FRACTION = "a number in (0, 1)", "a fraction in [0, 1]"
STEPS = "[[0, count], [fraction, count], ...] with ascending fractions and counts >= 8"
PAIR = "two whole numbers >= 1"
WHOLE, ONE = "a whole number >= 0", "a whole number >= 1"
SCHEDULES = (64000, [0, 100], None, [[0, "a"]], [], [[0.5, 100]], [[0, 2]], [[0, 8], [0.5, 64], [0.3, 32]])
REFUSED = [  # by the key: what is made, a wrong value, what is expected
    *(("stage.fine.num_voxels", kind, given, STEPS) for kind in (TiNeuVox, NDVG) for given in SCHEDULES),
    *(("model.alpha_init", TiNeuVox, wrong, OPACITY) for wrong in (0, 1.0, None)),
    ("stage.fine.alpha_init", NDVG, 1.0, OPACITY),
    *(("model.width", NDVG, wrong, PAIR) for wrong in (64, [64], [64, 0], None)),
    ("model.channels", NDVG, [4, "a"], PAIR),
    ("stage.fine.deformation_voxels", NDVG, 0, "a number > 0"),
    ("stage.fine.box_alpha", NDVG, 1, "a number in [0, 1)"),
    ("stage.fine.sink", NDVG, None, "a number >= 0"),
    ("model.frequencies", NDVG, -1, WHOLE),
    ("model.feature_frequencies", TiNeuVox, -1, WHOLE),
    ("model.channels", TiNeuVox, 0, ONE),
    ("stage.fine.frozen_from", TiNeuVox, None, FRACTION),
    ("stage.fine.color_threshold", TiNeuVox, 1, "a weight in [0, 1)"),
    *(("model.marching.step", Marching, wrong, "a number > 0") for wrong in (0, None)),
    ("model.marching.color_threshold", Marching, 1.0, "a weight in [0, 1)"),
    ("model.marching.occupancy", Marching, -1, WHOLE),
    ("model.marching.look_every", Marching, None, WHOLE),
    ("model.sampling.occupancy", Sampling, -1, WHOLE),
    ("model.sampling.density", Sampling, "gelu", "relu or softplus"),
    *(("model.position_frequencies", kind, -1, WHOLE) for kind in (NeRF, TNeRF, DNeRF, Nerfies, HyperNeRF)),
    *(("stage.fine.warp_in", kind, None, FRACTION) for kind in (Nerfies, HyperNeRF)),
    ("model.warp_frequencies", Nerfies, -1, WHOLE),
    ("model.warp_frequencies", HyperNeRF, 0, ONE),
    ("model.ambient_frequencies", HyperNeRF, 0, ONE),
]


@pytest.mark.parametrize(("key", "kind", "wrong", "wanted"), REFUSED)
def test_refuses(key, kind, wrong, wanted):
    place, _, name = key.rpartition(".")
    numbers, options = {"num_voxels": [[0, 125]]}, {name: wrong}
    if place == "stage.fine":
        numbers, options = numbers | options, {}
    given = () if kind in (Marching, Sampling) else (Start(moving_scene(), "fine", numbers),)
    with pytest.raises(ValueError, match=f"^{re.escape(f'{key}: expected {wanted}, but got {wrong!r}')}$"):
        kind(*given, **options)
