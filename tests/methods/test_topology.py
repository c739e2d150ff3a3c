"""What appears at once: a field that knows the time can show it, one that is only bent in space cannot."""

from functools import partial

import pytest

from forewarp.data.module import SceneDataModule
from forewarp.methods.dnerf import DNeRF
from forewarp.methods.hypernerf import HyperNeRF
from forewarp.methods.nerfies import Nerfies
from forewarp.methods.rays import Sampling
from forewarp.methods.tnerf import TNeRF
from forewarp.training.objective import Objective
from forewarp.training.schedule import StageSettings
from forewarp.training.stages import Stage
from tests.support.still_cameras import niche_scene
from tests.support.tiny_scene import make_run

FIELD = {"width": 48, "layers": 3, "skip": None, "position_frequencies": 4, "direction_frequencies": 1}
WARP = {"warp_width": 32, "warp_layers": 3, "warp_skip": None, "warp_frequencies": 3}
KINDS = {
    "tnerf": partial(TNeRF, **FIELD, time_frequencies=2),
    "hypernerf": partial(HyperNeRF, **FIELD, **WARP, slice_width=32),
    "dnerf": partial(DNeRF, **FIELD, time_frequencies=2),
    "nerfies": partial(Nerfies, **FIELD, **WARP, elastic_samples=64),
}


def psnr_on_the_niche(kind, folder):
    """The mean PSNR of the training pictures after 2,000 steps."""
    rates = {"lr": {"network": 3e-3}, "lr_final_factor": 0.1}
    settings = StageSettings.of("fine", iterations=2000, curriculum={"all_in": 0.0}, **rates)
    weights = {"photo": 1.0, "elastic": 1e-3}
    weights = {name: weights[name] for name in weights.keys() & set(KINDS[kind].func.terms)}
    data = SceneDataModule(niche_scene, rays=128, seed=2)
    model = partial(KINDS[kind], sampling=Sampling(16, 0, density="softplus", open_end=False))
    module = make_run(folder, [Stage(settings, Objective(weights))], data=data, model=model).fit()
    return sum(float(module.psnr_of(target)) for target in data.targets("train")) / 8


@pytest.mark.slow
def test_fields_that_know_the_time_show_what_appears_better_than_bent_ones(tmp_path):
    psnr = {kind: psnr_on_the_niche(kind, tmp_path / kind) for kind in KINDS}
    print({kind: round(value, 1) for kind, value in psnr.items()})  # for docs/methods.md
    assert min(psnr["tnerf"], psnr["hypernerf"]) > max(psnr["nerfies"], psnr["dnerf"]) + 1, psnr
