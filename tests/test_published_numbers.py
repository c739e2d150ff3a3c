"""``preset=faithful`` of the published systems has the published numbers, once composed, and their faults."""

import pytest
import torch

from forewarp.methods.method import Start, parameter_count
from forewarp.runs.build import build_run, model_of
from forewarp.scene.cloud import Handover
from forewarp.training.schedule import Curriculum
from tests.support.configs import composed
from tests.support.full_size import at_full_size
from tests.support.sampled_methods import start
from tests.support.sliding_square import moving_scene

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
NERF = SYNTHETIC | {
    "steps": 200_000,
    "rays": 1024,
    "rates": (5e-4, pytest.approx(5e-4 * 0.1 ** (200 / 500), rel=1e-3)),
    "octaves": {"position": 10, "direction": 4},
    "weights": {"photo": 1.0, "coarse_photo": 1.0},
    "frames in": 0,
    "parameters": 1_191_688,
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
    ("nerf", "hook", NERF),
    ("tnerf", "hook", TNERF),
    ("dnerf", "hook", DNERF | {"frames in": 100_000}),
    ("dnerf", "lego", DNERF | {"frames in": 10_000}),
    ("nerfies", "broom2", NERFIES),
    ("hypernerf", "broom2", HYPERNERF),
]


def of_preset(preset, model, scene="hook"):
    """The composed configuration of a published system."""
    dataset = "hypernerf" if scene == "broom2" else "dnerf"
    return composed(f"model={model}", f"experiment={dataset}", f"data.scene={scene}", f"preset={preset}")


def octaves(model):
    """The octaves of a model's encodings."""
    given = {key: n for key, n in model.items() if key.endswith("frequencies")}
    return {key.removesuffix("frequencies").rstrip("_"): n for key, n in given.items()}


def numbers(config):
    """What a composed configuration says, in the units of the publications."""
    model, fine, steps = config.model, config.stage.fine, config.budget.iterations
    sampling, rate, weights = model.sampling, fine.lr.network, config.objective.fine.weights
    return {
        "steps": steps,
        "rays": config.data.rays,
        "samples": (sampling.samples, sampling.fine_samples),
        "density": sampling.density,
        "jittered pictures": sampling.jitter_in_pictures,
        "rates": (rate, rate * fine.lr_final_factor),
        "background": config.data.background,
        "skip": model.skip,
        "octaves": octaves(model),
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
    config = of_preset("faithful", model, scene)
    found, sampling = numbers(config), config.model.sampling
    assert {name: found[name] for name in published} == published
    assert (sampling.open_end, sampling.inside_box, sampling.occupancy) == (True, False, 0)
    assert config.stage.fine.lr_hold == config.stage.fine.max_gradient == 0


NDVG = {
    "rays": 8192,
    "background": "white",
    "octaves": {"": 5, "direction": 4},
    "march": (0.5, True),
    "sink": 1.0,
    "max gradient": 0.0,
}
NDVG_PRIORS = {"tv_deformation": 1.0, "canonical": 1000.0}
NDVG_RATES = {"density": 1e-1, "color": 1e-1, "deformation": 1e-1, "network": 1e-3}
NDVG_COARSE = NDVG | {
    "steps": 5000,
    "rates": NDVG_RATES,
    "at last": pytest.approx(0.1 ** (5 / 20), rel=1e-3),
    "voxels": [[0, 1_024_000]],
    "deformation": 1_664_000,
    "alpha": 1e-6,
    "no colour below": 0.0,
    "weights": {"background_entropy": 1e-2, "point_color": 1e-1, "flow_l1": 1e-1} | NDVG_PRIORS,
    "box_alpha": 1e-3,
    "frames": [10, 10, 166],  # in play at steps 0, 300 and 4999
    "view_dependence": False,
}
NDVG_FINE = NDVG | {
    "steps": 10_000,
    "rates": NDVG_RATES,
    "at last": pytest.approx(0.1 ** (10 / 20), rel=1e-3),
    "voxels": [[0, 512_000], [1000, 1_024_000], [2000, 2_048_000], [3000, 160**3]],
    "deformation": pytest.approx(190**3, rel=1e-3),
    "alpha": 1e-2,
    "no colour below": 1e-4,
    "weights": {"background_entropy": 1e-3, "point_color": 1e-2, "flow_l1": 1e-2} | NDVG_PRIORS,
    "frames": [200, 200, 200],
    "view_dependence": True,
    "carry": False,
    "masked": True,
    "parameters": 80_724_519,
}
TINEUVOX = {
    "steps": 20_000,
    "rays": 4096,
    "background": "white",
    "octaves": {"position": 10, "time": 8, "feature": 2, "direction": 4},
    "march": (0.5, False),
    "no colour below": 1e-4,
    "rates": {"grid": 8e-2, "deformation": 6e-4, "network": 8e-4},
    "at last": 0.1,
    "weights": {"background_entropy": 1e-3, "point_color": 1e-2, "still": 1.0},
    "frames": [200, 200, 200],
    "frozen from": 19_000,
    "max gradient": 0.0,
}
TINEUVOX_RIG = TINEUVOX | {
    "background": "black",
    "rates": {"grid": 1e-1, "deformation": 7e-4, "network": 1e-3},
    "weights": TINEUVOX["weights"] | {"tv_grid": pytest.approx(1e-5 / 4096, rel=1e-3)},
}
TINEUVOX_S = {"alpha": 1e-2, "network": (4, 64)}
TINEUVOX_B = {"alpha": 1e-3, "network": (6, 256)}


def growing(side, times, parameters):
    """Twice the voxels every 2,000 steps, so many times, up to a side; and what there is to learn."""
    voxels = [[2000 * k, side**3 // 2 ** (times - k)] for k in range(times + 1)]
    return {"voxels": voxels, "parameters": parameters}


OF_GRIDS = [
    ("ndvg", "hook", "coarse", NDVG_COARSE),
    ("ndvg", "hook", "fine", NDVG_FINE),
    ("ndvg", "broom2", "fine", NDVG_FINE | {"background": "black"}),
    ("tineuvox_s", "hook", "fine", TINEUVOX | TINEUVOX_S | growing(100, 3, 4_028_667)),
    ("tineuvox_b", "hook", "fine", TINEUVOX | TINEUVOX_B | growing(160, 3, 24_828_837)),
    ("tineuvox_s", "broom2", "fine", TINEUVOX_RIG | TINEUVOX_S | growing(100, 4, 4_031_759)),
    ("tineuvox_b", "broom2", "fine", TINEUVOX_RIG | TINEUVOX_B | growing(160, 4, 24_844_995)),
]


def made_by(config, name, frames=3):
    """A composed stage's method on a scene of three pictures and points that never move.

    The stage before saw ``frames`` of the pictures. Grids are small at first.
    """
    scene, run = moving_scene(still=torch.zeros(4, 3)), build_run(config)
    (stage,) = (one for one in run.stages if one.settings.name == name)
    numbers, weights = dict(stage.settings.numbers), stage.objective.weights
    if "num_voxels" in numbers:
        numbers["num_voxels"] = [[0, 1000], [1, numbers["num_voxels"][-1][1]]]
    handover = Handover(scene.box, False, frames)
    given = Start(scene, name, numbers, handover=handover, blank=True, weights=weights)
    with torch.device("meta" if config.model.name == "neural_volumes" else "cpu"):
        return run.model(given)


def numbers_of_grids(config, name):
    """What a composed configuration says of a stage, in the units of the publications."""
    model, stage = config.model, config.stage[name]
    run, made = build_run(config), made_by(config, name)
    settings = next(one.settings for one in run.stages if one.settings.name == name)
    steps, voxels = settings.iterations, stage.num_voxels
    weights = dict(config.objective[name].weights)
    assert weights.pop("photo") == 1
    curriculum, in_play = Curriculum([i / 199 for i in range(200)], 0.0, **settings.curriculum), []
    for step in (0, 300, steps - 1):
        curriculum.fraction = settings.fraction(step, 0)
        in_play.append(curriculum.in_play)
    threshold = stage.get("color_threshold")
    return {
        "steps": steps,
        "rays": config.data.rays,
        "background": config.data.background,
        "octaves": octaves(model),
        "march": (model.marching.step, model.marching.jitter),
        "no colour below": model.marching.color_threshold if threshold is None else threshold,
        "rates": dict(stage.lr),
        "at last": stage.lr_final_factor,
        "max gradient": stage.max_gradient,
        "voxels": [[round(begin * steps), count] for begin, count in voxels],
        "deformation": stage.get("deformation_voxels", 0) * voxels[-1][1],
        "alpha": stage.get("alpha_init", model.get("alpha_init")),
        "weights": {key: weight for key, weight in weights.items() if weight},
        "frames": in_play,
        "frozen from": stage.get("frozen_from", 1) * steps,
        "network": (model.get("channels"), model.width),
        "parameters": at_full_size(made, made.last_voxels),
    } | {key: stage.get(key) for key in ("sink", "box_alpha", "view_dependence", "carry", "masked")}


@pytest.mark.parametrize(("model", "scene", "stage", "published"), OF_GRIDS)
def test_faithful_grids_have_the_published_numbers(model, scene, stage, published):
    config = of_preset("faithful", model, scene)
    found = numbers_of_grids(config, stage)
    assert {name: found[name] for name in published} == published


def test_faithful_neural_volumes_has_the_published_numbers():
    config = of_preset("faithful", "neural_volumes")
    asked = {"picture_size": [512, 384], "tower": [64, 64, 128, 128, 256, 256, 256], "code": 256}
    asked |= {"decoder": [1024, 512, 512, 256, 256, 128, 128], "maps": 16, "warp_side": 32, "step": 4 / 256}
    assert config.model.items() >= asked.items()
    fine, weights = config.stage.fine, config.objective.fine.weights
    assert (config.budget.iterations, config.data.rays, config.data.background) == (500_000, 128**2, "white")
    assert (dict(fine.lr), fine.lr_final_factor, fine.max_gradient) == ({"network": 1e-4}, 1, 0)
    priors = {"code_prior": 1e-3, "opacity_prior": 1e-2, "opacity_variation": 1e-2}
    assert dict(weights) == pytest.approx({"photo": (255 / 25) ** 2} | priors)
    assert parameter_count(made_by(config, "fine")) == 105_492_964 + 6  # of one camera


JUMP = "offsets jump at the canonical time (continuous)"
STILL = "points that never move are not looked at (weights.still)"
UNSEEN = "the first stage never sees the last 1 training pictures (pool)"
PADDED = "the grid is padded with zeros (padded)"
FROZEN = "the grid stays as it is from 0.95 of the stage on (frozen_from)"
FAULTS = {
    "nerf": [],
    "tnerf": [],
    "dnerf": [JUMP],
    "nerfies": [],
    "hypernerf": ["pictures are drawn with random samples (jitter_in_pictures)"],
    "ndvg": [JUMP, STILL],
    "tineuvox_s": [PADDED, FROZEN],
    "tineuvox_b": [PADDED, FROZEN],
    "neural_volumes": [
        "at first the warp draws all points to the middle (from_identity)",
        "at first most rays are opaque (first_opacity)",
        "pictures are drawn with random steps (jitter_in_pictures)",
    ],
}


@pytest.mark.parametrize("model", FAULTS)
def test_faults_of_the_released_code_are_on_in_faithful_and_off_in_fast(model):
    for preset, kept in (("faithful", FAULTS[model]), ("fast", [])):
        config = of_preset(preset, model)
        assert made_by(config, "fine").faults() == kept
        if model == "ndvg":
            assert made_by(config, "fine", frames=2).faults() == [*kept[:1], UNSEEN, *kept[1:]]


def test_the_papers_method_names_what_it_does_otherwise():
    forward = ["model=forward", "experiment=dnerf", "data.scene=hook", "preset=fast"]
    plain = made_by(composed(*forward), "coarse").departures()
    assert plain == [
        *("no up-sampling", "no inpainter", "voxels hold density and colour, without the network F1"),
        "motion (F2) at the nodes of a coarse lattice",
    ]
    assert made_by(composed(*forward, "ablation=full"), "fine").departures() == plain[2:]
    assert "colour without direction" in made_by(composed(*forward, "ablation=no_view"), "fine").departures()
