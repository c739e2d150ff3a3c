"""``preset=faithful`` of the published systems has the published numbers, once composed, and their faults."""

import pytest
import torch
from omegaconf import OmegaConf

from forewarp.methods.method import Start, parameter_count
from forewarp.runs.build import build_run
from forewarp.scene.box import Box, Lattice
from forewarp.scene.cloud import Handover
from forewarp.training.schedule import Curriculum
from tests.support.configs import composed
from tests.support.sampled_methods import at_full_size
from tests.support.still_cameras import moving_scene

approx, BOX = pytest.approx, Box((-1, -1.5, -2), (1, 1.5, 2))


def under(key, **numbers):
    """Numbers by their keys of the composed configuration."""
    return {f"{key}.{name}": number for name, number in numbers.items()}


def fine(**numbers):
    return under("stage.fine", **numbers)


def sampled(**numbers):
    return under("model.sampling", **numbers)


def weighed(**weights):
    return {"objective.fine.weights": {"photo": 1.0, **weights}}


# What the publications say.
ALONG_RAYS = sampled(open_end=True, inside_box=False, occupancy=0, fine_samples=128, jitter_in_pictures=False)
ALONG_RAYS |= fine(lr_hold=0, max_gradient=0) | {"stage.fine.curriculum.all_in": 0}
ALONG_RAYS |= under("model", direction_frequencies=4)
SYNTHETIC = ALONG_RAYS | under("budget", iterations=800_000) | under("data", rays=500, background="white")
SYNTHETIC |= under("model", position_frequencies=10, skip=6) | sampled(samples=64, density="relu")
SYNTHETIC |= {"stage.fine.lr.network": 5e-4} | fine(lr_final_factor=approx(0.1 ** (800 / 500), rel=1e-3))
RIG = ALONG_RAYS | under("budget", iterations=250_000) | under("data", rays=6144)
RIG |= under("model", position_frequencies=8, warp_frequencies=6, skip=5, code_size=8, still_points=16_384)
RIG |= sampled(samples=128, density="softplus")
RIG |= {"stage.fine.lr.network": 1e-3} | fine(lr_final_factor=0.1, warp_in=80 / 250)
NERF = SYNTHETIC | under("budget", iterations=200_000) | under("data", rays=1024) | weighed(coarse_photo=1.0)
NERF |= fine(lr_final_factor=approx(0.1 ** (200 / 500), rel=1e-3))
TNERF = SYNTHETIC | under("model", time_frequencies=4) | weighed()
DNERF = SYNTHETIC | under("model", time_frequencies=10) | weighed(second_time=0.0)
DNERF |= under("stage.fine.curriculum", start=3, all_in=100 / 800)
NERFIES = RIG | under("model", camera_code_size=2, elastic_samples=None)
NERFIES |= weighed(coarse_photo=1.0, elastic=1e-3, still=1.0)
HYPERNERF = RIG | under("model", ambient_frequencies=1) | sampled(jitter_in_pictures=True)
HYPERNERF |= fine(slice_from=1 / 250, slice_in=11 / 250) | weighed(coarse_photo=1.0, still=1.0)
MARCHED = {"step": 0.5, "color_threshold": 1e-4}
NDVG = under("budget", iterations=15_000) | under("data", rays=8192, background="white")
NDVG |= under("model", frequencies=5, direction_frequencies=4, marching=MARCHED | {"jitter": True})
NDVG |= under("stage.coarse", num_voxels=[[0, 1_024_000]], deformation_voxels=1.625, alpha_init=1e-6)
NDVG |= under("stage.coarse", color_threshold=0.0, box_alpha=1e-3, view_dependence=False)
NDVG["stage.coarse.share"] = approx(5 / 15, rel=1e-3)
NDVG["stage.coarse.lr_final_factor"] = approx(0.1 ** (5 / 20), rel=1e-3)
NDVG_FINE = fine(num_voxels=[[0, 512_000], [0.1, 1_024_000], [0.2, 2_048_000], [0.3, 160**3]])
NDVG_FINE |= fine(alpha_init=1e-2, color_threshold=None, carry=False, masked=True, view_dependence=True)
NDVG_FINE |= fine(deformation_voxels=approx(190**3 / 160**3, rel=1e-3)) | {"stage.fine.curriculum.all_in": 0}
NDVG_FINE |= fine(lr_final_factor=approx(0.1 ** (10 / 20), rel=1e-3))
for stage, weight in (("coarse", 0.1), ("fine", 0.01)):
    rates = {"density": 0.1, "color": 0.1, "deformation": 0.1, "network": 1e-3}
    NDVG |= under(f"stage.{stage}", sink=1.0, max_gradient=0, lr=rates)
    NDVG[f"objective.{stage}.weights"] = {
        **{"photo": 1, "point_color": weight, "background_entropy": weight / 10, "flow_l1": weight},
        **{"tv_deformation": 1.0, "canonical": 1000.0, "still": 0.0},
    }
NDVG_RIG = {key: value for key, value in NDVG.items() if ".coarse" not in key} | NDVG_FINE
NDVG_RIG |= under("budget", iterations=10_000) | under("data", background="black", canonical=0)
NDVG_RIG["stage.coarse"] = None
# The NeRF of HyperNeRF's tables.
NERF_RIG = {key: RIG[key] for key in RIG if key in SYNTHETIC} | under("model", glorot=True, width=256)
TINEUVOX = under("budget", iterations=20_000) | under("data", rays=4096)
TINEUVOX |= under("model", position_frequencies=10, time_frequencies=8, feature_frequencies=2)
TINEUVOX |= under("model", direction_frequencies=4, marching=MARCHED | {"jitter": False})
TINEUVOX |= fine(frozen_from=0.95, lr_final_factor=0.1, max_gradient=0) | {"stage.fine.curriculum.all_in": 0}
WEIGHTS = {"point_color": 1e-2, "background_entropy": 1e-3, "still": 1.0}
PLAIN = TINEUVOX | under("data", background="white") | weighed(**WEIGHTS, tv_grid=0.0)
PLAIN |= fine(lr={"grid": 8e-2, "deformation": 6e-4, "network": 8e-4})
TINEUVOX_RIG = TINEUVOX | under("data", background="black")
TINEUVOX_RIG |= weighed(**WEIGHTS, tv_grid=approx(1e-5 / 4096, rel=1e-3))
TINEUVOX_RIG |= fine(lr={"grid": 1e-1, "deformation": 7e-4, "network": 1e-3})
TINEUVOX_S = under("model", alpha_init=1e-2, channels=4, width=64)
TINEUVOX_B = under("model", alpha_init=1e-3, channels=6, width=256)


def growing(side, times):
    """Twice the voxels every 2,000 of 20,000 steps, so many times, up to a side."""
    voxels = [[approx(0.1 * k), side**3 // 2 ** (times - k)] for k in range(times + 1)]
    return {"stage.fine.num_voxels": voxels}


# With the number of parameters: of one camera, and of three times.
PUBLISHED = [
    ("nerf", "hook", NERF, 1_191_688),
    ("nerf", "broom2", NERF_RIG, 1_179_400),
    ("tnerf", "hook", TNERF, 600_452),
    ("dnerf", "hook", DNERF, 1_095_047),
    ("dnerf", "lego", DNERF | {"stage.fine.curriculum.all_in": 10 / 800}, 1_095_047),
    ("nerfies", "broom2", NERFIES, 1_275_410 - 2 + 3 * 8),
    ("hypernerf", "broom2", HYPERNERF, 1_305_616 + 3 * 8),
    ("ndvg", "hook", NDVG | NDVG_FINE, 80_724_519),
    ("ndvg", "broom2", NDVG_RIG, 80_724_519),
    ("tineuvox_s", "hook", PLAIN | TINEUVOX_S | growing(100, 3), 4_028_667),
    ("tineuvox_b", "hook", PLAIN | TINEUVOX_B | growing(160, 3), 24_828_837),
    ("tineuvox_s", "broom2", TINEUVOX_RIG | TINEUVOX_S | growing(100, 4), 4_031_759),
    ("tineuvox_b", "broom2", TINEUVOX_RIG | TINEUVOX_B | growing(160, 4), 24_844_995),
]


def of_preset(preset, model, scene="hook"):
    """The composed configuration of a published system."""
    dataset = "hypernerf" if scene == "broom2" else "dnerf"
    return composed(f"model={model}", f"experiment={dataset}", f"data.scene={scene}", f"preset={preset}")


def made_by(config, name, frames=3):
    """A composed stage's method on a scene of three pictures and points that never move.

    The stage before saw ``frames`` of the pictures. Grids are small at first.
    """
    scene, run = moving_scene(still=torch.zeros(4, 3)), build_run(config)
    (stage,) = (one for one in run.stages if one.settings.name == name)
    numbers, terms = dict(stage.settings.numbers), stage.objective
    terms = {"weights": terms.weights, "literal": terms.literal}
    if "num_voxels" in numbers:
        numbers["num_voxels"] = [[0, 1000], [1, numbers["num_voxels"][-1][1]]]
    handover = Handover(scene.box, False, frames)
    given = Start(scene, name, numbers, handover=handover, blank=True, **terms)
    with torch.device("meta" if config.model.name == "neural_volumes" else "cpu"):
        return run.model(given)


@pytest.mark.slow
@pytest.mark.parametrize(("model", "scene", "published", "parameters"), PUBLISHED)
def test_faithful_has_the_published_numbers(model, scene, published, parameters):
    config = of_preset("faithful", model, scene)
    resolved = OmegaConf.create(OmegaConf.to_container(config, resolve=True))
    for key, value in published.items():
        found = OmegaConf.select(resolved, key)
        if key == "model.marching":
            found = {name: found[name] for name in value}
        assert found == value, key
    made, voxels = made_by(config, "fine"), OmegaConf.select(resolved, "stage.fine.num_voxels")
    assert (at_full_size(made, voxels[-1][1]) if voxels else parameter_count(made)) == parameters


@pytest.mark.slow
def test_ndvg_never_sees_the_last_images():
    (coarse, _) = build_run(of_preset("faithful", "ndvg")).stages
    assert coarse.settings.iterations == 5000
    curriculum, in_play = Curriculum([i / 199 for i in range(200)], 0.0, **coarse.settings.curriculum), []
    for curriculum.step in (0, 300, 4999):
        in_play.append(curriculum.in_play)
    assert in_play == [10, 10, 166]


@pytest.mark.slow
def test_faithful_neural_volumes_has_the_published_numbers():
    config = of_preset("faithful", "neural_volumes")
    asked = {"picture_size": [512, 384], "tower": [64, 64, 128, 128, 256, 256, 256], "code": 256}
    asked |= {"decoder": [1024, 512, 512, 256, 256, 128, 128], "maps": 16, "warp_side": 32, "step": 4 / 256}
    assert config.model.items() >= asked.items()
    fine, weights = config.stage.fine, config.objective.fine.weights
    assert (config.budget.iterations, config.data.rays, config.data.background) == (500_000, 128**2, "white")
    assert (dict(fine.lr), fine.lr_final_factor, fine.max_gradient) == ({"network": 1e-4}, 1, 0)
    priors = {"code_prior": 1e-3, "opacity_prior": 1e-2, "opacity_variation": 1e-2}
    assert dict(weights) == approx({"photo": (255 / 25) ** 2} | priors)
    assert parameter_count(made_by(config, "fine")) == 105_492_964 + 6  # of one camera


JUMP = "offsets jump at the canonical time (continuous)"
STILL = "points that never move are not looked at (weights.still)"
UNSEEN = "the first stage never sees the last 1 images (iterations_per_time)"
PADDED = "the grid is padded with zeros (padded)"
FROZEN = "the grid stays as it is from 0.95 of the stage on (frozen_from)"
OPAQUE = "at first most rays are opaque (first_opacity)"
JITTER = "pictures are drawn with random {} (jitter_in_pictures)"
FAULTS = {"nerf": [], "tnerf": [], "dnerf": [JUMP], "nerfies": [], "hypernerf": [JITTER.format("samples")]}
FAULTS |= {"ndvg": [JUMP, STILL], "tineuvox_s": [PADDED, FROZEN], "tineuvox_b": [PADDED, FROZEN]}
FAULTS["neural_volumes"] = [OPAQUE, JITTER.format("steps")]


@pytest.mark.slow
@pytest.mark.parametrize("model", FAULTS)
def test_faults_of_the_released_code_are_on_in_faithful_and_off_in_fast(model):
    for preset, kept in (("faithful", FAULTS[model]), ("fast", [])):
        config = of_preset(preset, model)
        assert made_by(config, "fine").faults() == kept
        if model == "ndvg":
            assert made_by(config, "fine", frames=2).faults() == [*kept[:1], UNSEEN, *kept[1:]]


# The paper's method by the place where it is printed: sections 3 and 4, and appendices A.2, A.4 and A.5.
WEIGHTS_FORWARD = {"photo": 1, "flow_l1": 1e-5, "tv_density": 1e-6, "tv_flow": 1e-3, "tv_depth": 1e-1}
NONE_PRINTED = {"static_points": 0, "moving_opacity": 0}
ENTROPIES = {"coarse": {"point_color": 1e-1, "background_entropy": 1e-2, "inpaint_diff": 0}}
ENTROPIES["fine"] = {"point_color": 1e-2, "background_entropy": 1e-3, "inpaint_diff": 1e-5}
RATES = {"grid": 1e-1, "network": 1e-3, "flow": 1e-3} | dict.fromkeys(("density", "color", "shading"), 1e-1)
F2 = {"features": 0, "frequencies": 5, "width": 64, "layers": 4, "bases": 15, "nodes": 0, "padding": 0}
VIEW = {"features": 12, "frequencies": 4, "width": 64, "layers": 2}
FORWARD = {
    "3.4 coarse: the feature is the colour": {"stage.coarse.effects": ["motion", "background"]},
    "A.2 F1": under("model.radiance", grid_features=12, frequencies=5, width=128, layers=3),
    "A.2 F2": under("model.trajectory", **F2),
    "A.2 F3": under("model.inpainter", levels=4, width=64, coverage_channel=False),
    "A.2 F4": under("model.view_dependence", **VIEW),
    "A.4 w1 to w7": {
        f"objective.{stage}.weights": WEIGHTS_FORWARD | NONE_PRINTED | own for stage, own in ENTROPIES.items()
    },
    "A.4 opacity at first": under("stage.coarse", start_alpha=1e-6, box_alpha=1e-3)
    | fine(start_alpha=1e-2, carry="motion"),
    "A.4 ten images, and one more every 60": under("stage.fine.curriculum", start=10, iterations_per_time=60)
    | under("stage.coarse.curriculum", iterations_per_time=60),
    "A.5 sizes, steps and rates": under("stage.coarse", num_voxels=[[0, 67**3]], upsample=1.5, share=20)
    | fine(num_voxels=[[0, 80**3]], upsample=None, share=100)
    | {"stage.coarse.lr": RATES, "stage.fine.lr": RATES}
    | {"model.upsampler.scale": 2, "budget.iterations": 120_000},
}
ON_CAPTURES = {
    "A.2 F2": under("model.trajectory", **F2 | {"features": 12, "bases": 25}),
    "A.5 sizes, steps and rates": FORWARD["A.5 sizes, steps and rates"] | fine(num_voxels=[[0, 70**3]]),
    "4.2 a static grid": fine(background_num_voxels=[[0, 160**3]]),
    "as all are measured": under("data", background="black", eval_background="black"),
}


@pytest.mark.slow
@pytest.mark.parametrize("dataset", ["dnerf", "hypernerf", "nhr", "lego_complete"])
def test_the_papers_method_has_its_printed_numbers(dataset):
    config = composed("model=forward", f"experiment={dataset}", "data.scene=x", "preset=faithful")
    resolved = OmegaConf.create(OmegaConf.to_container(config, resolve=True))
    captured = dataset == "hypernerf"
    for place, numbers in (FORWARD | (ON_CAPTURES if captured else {})).items():
        for key, value in numbers.items():
            assert OmegaConf.select(resolved, key) == value, (place, key)
    assert (resolved.model.background is not None) == captured
    trajectory, lattice = build_run(config).model.keywords["trajectory"], Lattice(BOX, (5, 6, 7))
    field = trajectory(BOX, frames=82, canonical_time=0.5, voxels=lattice)
    sizes = [tuple(layer.weight.shape) for layer in field.network if isinstance(layer, torch.nn.Linear)]
    inputs, outputs = (33 + 12, 3 * 25) if captured else (33, 3 * 15)
    assert sizes == [(64, inputs), (64, 64), (64, 64), (outputs, 64)]
    assert captured == (field.features is not None and field.features.grid.shape == (lattice.count, 12))


@pytest.mark.slow
def test_the_papers_method_names_what_it_does_otherwise():
    def of(*words, stage="fine"):
        words = ("model=forward", "experiment=dnerf", "data.scene=hook", "preset.inpainter_width=16", *words)
        return made_by(composed(*words), stage).departures()

    common = [
        "not normalised as printed: photo, point_color, background_entropy (literal)",
        "learning rates end at lr_final_factor times the first (printed: constant)",
        "matter fades where little of it is splatted (tau, fade)",
    ]
    ours = [
        "voxels hold density and colour, without the network F1",
        "voxels without matter are left out (refresh_every)",
        "motion (F2) at the nodes of a coarse lattice",
        "cosines of a longer period (padding)",
    ]
    added = "the inpainter and the up-layer add to the interpolated grid"
    faithful = of("preset=faithful")
    assert faithful == [added, *common]
    literal = "objective.fine.literal=[photo,point_color,background_entropy]"
    assert of("preset=faithful", literal) == [added, *common[1:]]
    fast = of("preset=fast", "start_motion=own", stage="coarse")
    assert sorted(fast) == sorted(["no up-sampling", "no inpainter", *common, *ours])
    assert sorted(of("preset=fast", "ablation=full")) == sorted([added, *common, *ours])
    assert "colour without direction" in of("preset=fast", "ablation=no_view")
    held = "points known to be static are held (static_points)"
    for preset in ("faithful", "fast"):
        words = ("model=forward", "experiment=hypernerf", "data.scene=broom2", f"preset={preset}")
        assert (held in made_by(composed(*words), "coarse").departures()) == (preset == "fast")
