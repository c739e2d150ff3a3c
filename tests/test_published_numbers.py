"""``preset=faithful`` of T-NeRF, D-NeRF, Nerfies and HyperNeRF has the published numbers, once composed."""

import pytest

from forewarp.methods.method import parameter_count
from forewarp.runs.build import model_of
from tests.support.configs import composed
from tests.support.sampled_methods import start

SYNTHETIC = {
    "steps": 800_000,
    "rays": 500,
    "samples": (64, 128),
    "density": "relu",
    "rates": (5e-4, pytest.approx(5e-4 * 0.1 ** (800 / 500), rel=1e-3)),
    "background": "white",
    "skip": 6,
    "weights": {"photo": 1.0},
    "jittered pictures": False,
}
RIG = {
    "steps": 250_000,
    "rays": 6144,
    "samples": (128, 128),
    "density": "softplus",
    "rates": (1e-3, pytest.approx(1e-4)),
    "skip": 5,
    "warp in": 80_000,
    "still points": 16_384,
    "frames in": 0,
}
TNERF = SYNTHETIC | {
    "octaves": {"position": 10, "direction": 4, "time": 4},
    "frames in": 0,
    "parameters": 600_452,
}
DNERF = SYNTHETIC | {
    "octaves": {"position": 10, "direction": 4, "time": 10},
    "first frames": 3,
    "parameters": 1_095_047,
}
NERFIES = RIG | {
    "octaves": {"position": 8, "direction": 4, "warp": 6},
    "weights": {"photo": 1.0, "coarse_photo": 1.0, "elastic": 1e-3, "still": 1.0},
    "elastic samples": None,
    "codes": {"code_size": 8, "camera_code_size": 2},
    "jittered pictures": False,
    "parameters": 1_275_410 - 2 + 3 * 8,  # one camera, where the rig has two; three times
}
HYPERNERF = RIG | {
    "octaves": {"position": 8, "direction": 4, "warp": 6, "ambient": 1},
    "weights": {"photo": 1.0, "coarse_photo": 1.0, "still": 1.0},
    "slice in": [1_000, 11_000],
    "codes": {"code_size": 8},
    "jittered pictures": True,
    "parameters": 1_305_616 + 3 * 8,
}
PUBLISHED = [
    ("tnerf", "dnerf_hook", TNERF),
    ("dnerf", "dnerf_hook", DNERF | {"frames in": 100_000}),
    ("dnerf", "dnerf_lego", DNERF | {"frames in": 10_000}),
    ("nerfies", "hypernerf_broom", NERFIES),
    ("hypernerf", "hypernerf_broom", HYPERNERF),
]


def numbers(config):
    """What a composed configuration says, in the units of the publications."""
    model, fine, steps = config.model, config.stage.fine, config.budget.iterations
    sampling, rate, weights = model.sampling, fine.lr.network, config.objective.fine.weights
    octaves = "_frequencies"
    return {
        "steps": steps,
        "rays": config.data.rays,
        "samples": (sampling.samples, sampling.fine_samples),
        "density": sampling.density,
        "jittered pictures": sampling.jitter_in_pictures,
        "rates": (rate, rate * fine.lr_final_factor),
        "background": config.data.background,
        "skip": model.skip,
        "octaves": {key.removesuffix(octaves): n for key, n in model.items() if key.endswith(octaves)},
        "weights": {name: weight for name, weight in weights.items() if weight},
        "frames in": round(fine.curriculum.all_in * steps),
        "first frames": fine.curriculum.start,
        "warp in": round(fine.get("warp_in", 0) * steps),
        "slice in": [round(fine.get(key, 0) * steps) for key in ("slice_from", "slice_in")],
        "codes": {key: n for key, n in model.items() if key.endswith("code_size")},
        "elastic samples": model.get("elastic_samples"),
        "still points": model.get("still_points"),
        "parameters": parameter_count(model_of(model)(start())),
    }


@pytest.mark.parametrize(("model", "scene", "published"), PUBLISHED)
def test_faithful_has_the_published_numbers(model, scene, published):
    config = composed(f"model={model}", f"scene={scene}", "preset=faithful")
    found, sampling = numbers(config), config.model.sampling
    assert {name: found[name] for name in published} == published
    assert (sampling.open_end, sampling.inside_box, sampling.occupancy) == (True, False, 0)
    assert config.stage.fine.lr_hold == config.stage.fine.max_gradient == 0
