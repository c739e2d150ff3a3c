"""Every configuration composes and instantiates; the command line wins; off is off."""

from dataclasses import MISSING, fields
from inspect import signature
from itertools import product

import pytest
import torch
from hydra.errors import ConfigCompositionException
from hydra.utils import instantiate
from omegaconf import OmegaConf

from forewarp.data import dnerf, hypernerf, nhr, posed_video
from forewarp.data.module import SceneDataModule
from forewarp.methods.particles.options import Effects
from forewarp.methods.voxel.effects import LearnedUpsampler, SphericalHarmonics, UNet3d, ViewNetwork
from forewarp.methods.voxel.losses import TERMS
from forewarp.methods.voxel.structure import VoxelStage
from forewarp.renderer import Renderer
from forewarp.runs.build import build_run
from forewarp.scene.box import Lattice
from forewarp.training.schedule import StageSettings
from tests.support.configs import CONF, composed, groups, options
from tests.support.tiny_scene import BOX, built

PRESETS, MODELS = options("preset"), options("model")
EXPERIMENTS = options("experiment")
OF_THE_TABLES = [model for model in MODELS if model not in ("forward", "backward", "particles")]
# Crossed with each other below, jobs of tests/test_sweeps.py (scene, ablation), or always on.
ELSEWHERE = {"preset", "model", "experiment", "stage", "objective", "data", "scene", "ablation"}
DEFAULTS = {("capture", "cut_out"), ("logger", "tensorboard"), ("trainer", "auto")}
DEFAULTS |= {("model/renderer", "march"), ("model/sampling", "along_rays"), ("model/marching", "equal_steps")}
VOXELS = {"model/motion", "model/view_dependence", "model/background"}  # also groups of voxel methods
OF_PARTICLES = [
    ("model/motion", "spline"),
    ("model/motion", "cosines"),
    ("model/rotation", "nodes"),
    ("model/view_dependence", "harmonics"),
    ("model/color_over_time", "cosines"),
    ("model/opacity_over_time", "cosines"),
    ("model/background", "still"),
]
CHOICES = {(group, option) for group in groups() if group not in ELSEWHERE for option in options(group)}
CHOICES = sorted(CHOICES - DEFAULTS)
OFF = [("inpainter", "unet3d"), ("upsampler", "learned"), ("view_dependence", "mlp"), ("motion", "dct")]
OFF += [("background", "grid")]


def run_of(*overrides):
    """A run put together, of a scene that need not exist."""
    return build_run(composed("data.scene=x", *overrides))


def method_of(model, frames=4):
    """A voxel method on a tiny lattice."""
    return built(model, Lattice(BOX, (3, 4, 5)), frames=frames, num_voxels=[[0, 60]])


@pytest.mark.parametrize(("group", "option"), CHOICES)
def test_every_option_composes_and_instantiates(group, option):
    of_particles = (group, option) in OF_PARTICLES or group in {of for of, choice in OF_PARTICLES} - VOXELS
    of_voxels = group.startswith("model/") and not of_particles
    run = run_of(f"{group}={option}", f"model={'forward' if of_voxels else 'particles'}")
    assert [stage.settings.name for stage in run.stages] == ["coarse", "fine"]
    if of_voxels:
        assert isinstance(method_of(run.model), torch.nn.Module)


@pytest.mark.slow
def test_effects_of_particles_are_switched_one_by_one():
    off = [f"{group}=none" for group, _ in OF_PARTICLES]
    assert set(run_of("model=particles", *off).model.keywords.values()) == {None}
    for group, option in OF_PARTICLES:
        given = run_of("model=particles", *off, f"{group}={option}").model.keywords
        on = {name: choice for name, choice in given.items() if choice is not None}
        assert on.keys() == {group.removeprefix("model/")}
        assert Effects(**given)
    assert run_of("capture=video").model.keywords["view_dependence"] is None


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_particles_are_the_default(experiment):
    config = composed(f"experiment={experiment}", "data.scene=x")
    assert (config.model.name, composed().model.name) == ("particles", "particles")
    assert composed(f"experiment={experiment}", "data.scene=x", "model=forward").model.name == "forward"


def test_an_effect_of_voxels_is_refused_by_particles():
    given = run_of("model=particles", "model/view_dependence=mlp").model.keywords
    with pytest.raises(ValueError, match="model.view_dependence: expected a degree of 1 to 3, or null, but"):
        Effects(**given)


@pytest.mark.parametrize("name", [path.stem for path in CONF.glob("*.yaml") if path.stem != "options"])
def test_every_command_has_a_config(name):
    config = composed("data.scene=x", name=name) if name == "train" else composed(name=name)
    assert OmegaConf.to_container(config, resolve=True, throw_on_missing=True)["paths"]


def test_faithful_is_the_papers_model():
    method = method_of(run_of("model=forward", "preset=faithful").model, frames=40)
    assert isinstance(method.inpainter, UNet3d)
    assert method.inpainter.width == 64
    assert isinstance(method.upsampler, LearnedUpsampler)
    assert isinstance(method.view_dependence, ViewNetwork)
    assert method.motion.trajectory.bases == 15
    assert not method.motion.trajectory.at_nodes


def test_faithful_stages_are_the_papers():
    coarse, fine = run_of("model=forward", "preset=faithful").stages
    assert (coarse.settings.iterations, fine.settings.iterations) == (20_000, 100_000)
    first, last = coarse.settings.numbers, fine.settings.numbers
    assert (first["start_alpha"], last["start_alpha"]) == (1e-6, 1e-2)
    assert first["box_alpha"] == 1e-3
    assert first["effects"] == ["motion", "background"]
    assert not last["carry"]
    assert coarse.objective.weights["tv_depth"] == fine.objective.weights["tv_depth"] == 1e-1
    assert (coarse.objective.weights["point_color"], fine.objective.weights["point_color"]) == (1e-1, 1e-2)


@pytest.mark.parametrize("preset", PRESETS)
def test_off_is_none_whatever_the_preset(preset):
    off = run_of("model=forward", f"preset={preset}", *(f"model/{effect}=none" for effect, _ in OFF)).model
    on = run_of(
        "model=forward", f"preset={preset}", *(f"model/{effect}={choice}" for effect, choice in OFF)
    ).model
    for effect, _ in OFF:
        assert off.keywords[effect] is None
        assert on.keywords[effect] is not None
    assert {name.split(".")[0] for name, _ in method_of(off).named_parameters()} == {"radiance"}


def test_every_number_of_the_renderer_is_a_key_and_equals_its_default():
    defaults = {
        name: p.default for name, p in signature(Renderer.__init__).parameters.items() if name != "self"
    }
    config = OmegaConf.to_container(composed("data.scene=x", "model=forward").model.renderer)
    assert config == {"_target_": "forewarp.renderer.Renderer"} | defaults
    assert (
        run_of("model=forward", "model.renderer.early_stop_eps=0").model.keywords["renderer"].early_stop_eps
        == 0
    )


@pytest.mark.parametrize("order", [1, -1])
def test_the_command_line_wins_over_the_preset_and_the_experiment(order):
    overrides = ["model=forward", "preset=fast", "model/view_dependence=mlp"][::order]
    assert type(method_of(run_of("model=forward", "preset=fast").model).view_dependence) is SphericalHarmonics
    assert type(method_of(run_of(*overrides).model).view_dependence) is ViewNetwork
    words = ["experiment=dnerf", "data.scene=x", "preset=faithful", "data.box=null", "data.rays=7"][::order]
    config = composed(*words)
    assert (config.preset.name, config.data.box, config.data.rays) == ("faithful", None, 7)


def test_budget_is_shared_out():
    run = run_of("model=forward", "budget.minutes=20", "budget.iterations=1000")
    assert [stage.settings.minutes for stage in run.stages] == pytest.approx([8, 12])
    assert [stage.settings.iterations for stage in run.stages] == [400, 600]
    (only,) = run_of("preset=fast", "budget.minutes=20", "~stage.fine").stages
    assert (only.settings.name, only.settings.minutes) == ("coarse", 20)
    (only,) = run_of("preset=fast", "stage.coarse=null").stages
    assert only.settings.name == "fine"


def test_every_stage_key_may_be_typed_and_starts_from_the_same():
    base = OmegaConf.to_container(OmegaConf.load(CONF / "stage" / "one" / "base.yaml"))
    for field in (*fields(StageSettings), *fields(VoxelStage)):
        # Named by its place; bounded by the budget; all other keys.
        if field.name in ("name", "minutes", "iterations", "numbers"):
            continue
        assert field.name in base
        if field.default is not MISSING:
            ours, expected = OmegaConf.to_container(OmegaConf.create([base[field.name], field.default]))
            assert ours == expected, field.name


def test_every_weight_may_be_typed():
    weights = ["objective.coarse.weights.tv_depth=0.5", "objective.fine.weights.flow_l1=0.25"]
    config = composed("model=forward", *weights)
    coarse, fine = build_run(config).stages
    assert (coarse.objective.weights["tv_depth"], fine.objective.weights["tv_depth"]) == (0.5, 0.0)
    assert set(coarse.objective.weights) == set(TERMS)
    assert fine.objective.weights["flow_l1"] == 0.25


@pytest.mark.parametrize("data", options("data"))
def test_every_dataset_takes_a_canonical_time_and_the_presets_background(data):
    common = [f"data={data}", "data.scene=x", "preset.background=black"]
    config = composed(*common, "data.canonical=middle")
    assert (config.data.canonical, config.data.background) == ("middle", "black")
    assert isinstance(instantiate(config.data, _convert_="all"), SceneDataModule)


def every_experiment():
    """Every method with every experiment and preset; those that say nothing new are slow."""
    for i, experiment in enumerate(EXPERIMENTS):
        for j, model in enumerate(MODELS):
            for k, preset in enumerate(PRESETS):
                quick = k == (i + j) % 3 and (model == "forward" or i < 3)
                yield pytest.param(experiment, model, preset, marks=[] if quick else pytest.mark.slow)


@pytest.mark.parametrize(("experiment", "model", "preset"), list(every_experiment()))
def test_every_method_fits_every_experiment_in_every_preset(experiment, model, preset):
    common = [f"experiment={experiment}", f"preset={preset}", f"model={model}", "data.scene=x"]
    config = composed(*common)
    assert (config.model.name, config.preset.name) == (model, preset)
    build_run(config)


@pytest.mark.slow
@pytest.mark.parametrize("model", ["forward", "backward"])
def test_each_number_of_a_method_is_taken_where_it_is_keyed(model):
    hypernerf = ["experiment=hypernerf", "data.scene=x", f"model={model}"]
    fast, faithful = composed(*hypernerf), composed(*hypernerf, "preset=faithful")
    assert [c.preset.bases for c in (fast, faithful)] == [8, 25]  # model x preset x experiment
    assert fast.objective.fine.weights.static_points == 1e-2  # model x experiment
    assert (fast.preset.rays, faithful.budget.iterations) == (4096, 120000)  # model x preset
    broom = composed("experiment=hypernerf", "data.scene=broom2", f"model={model}")  # scene
    assert (broom.data.scene, broom.stage.fine.num_voxels[-1][1]) == ("broom2", 343000)
    band, still = (composed(f"scene=specimen_{name}", f"model={model}") for name in ("band", "still"))
    assert (band.stage.fine.num_voxels, still.stage.coarse.num_voxels) == ([[0, 15625]], [[0, 46656]])


def test_systems_of_the_tables_have_their_numbers_of_a_dataset():
    ndvg = composed("experiment=hypernerf", "data.scene=x", "model=ndvg", "preset=faithful")
    assert (list(k for k, v in ndvg.stage.items() if v), ndvg.budget.iterations) == (["fine"], 10000)
    assert ndvg.data.canonical == 0
    lego = composed("experiment=lego_complete", "data.scene=x", "model=ndvg", "preset=faithful")
    assert lego.data.box is None
    volumes = composed("experiment=hypernerf", "data.scene=x", "model=neural_volumes", "preset=faithful")
    assert volumes.data.background == volumes.data.eval_background == "black"


def test_the_nerf_of_captures_is_the_one_of_hypernerfs_tables():
    config = composed("experiment=hypernerf", "data.scene=broom2", "model=nerf", "preset=faithful")
    asked = {"skip": 5, "position_frequencies": 8, "glorot": True, "width": 256, "layers": 8}
    assert config.model.items() >= asked.items()
    looks = {"density": "softplus", "samples": 128, "fine_samples": 128, "open_end": True}
    assert config.model.sampling.items() >= looks.items()
    assert (config.data.rays, config.budget.iterations) == (6144, 250_000)
    assert (config.stage.fine.lr.network, config.stage.fine.lr_final_factor) == (1e-3, 0.1)


@pytest.mark.slow
def test_published_systems_train_over_the_background_that_they_are_measured_on():
    for model, experiment in product(OF_THE_TABLES, ("hypernerf", "demo_hypernerf")):
        config = composed(f"experiment={experiment}", "data.scene=x", f"model={model}")
        assert (config.data.background, config.data.eval_background) == ("black", "black"), (
            model,
            experiment,
        )
        assert config.model.get("camera") == (True if "tineuvox" in model else None)
    for words, color in (
        ("experiment=hypernerf", "data.scene=broom2", "black"),
        ("experiment=dnerf", "data.scene=lego", "white"),
    ):
        data = composed(words, "model=nerfies", "preset=faithful").data
        assert (data.background, data.eval_background) == (color, color)


@pytest.mark.slow
def test_frames_of_some_scenes_come_in_sooner_with_faithful_alone():
    faithful = composed("experiment=dnerf", "data.scene=x", "model=dnerf", "preset=faithful")
    for scene, all_in in (("lego", 0.0125), ("trex", 0.0125), ("bouncingballs", 0.0125), ("hook", 0.125)):
        faithful.data.scene = scene
        expected = {"start": 3, "all_in": all_in, "from_zero": True}
        assert build_run(faithful).stages[0].settings.curriculum.items() >= expected.items()
    for preset, all_in in (("faithful", 0.0125), ("fast", 0.3), ("demo", 0.0)):
        config = composed("experiment=dnerf", "data.scene=lego", "model=dnerf", f"preset={preset}")
        assert config.stage.fine.curriculum.all_in == all_in


@pytest.mark.slow
def test_effects_follow_the_pictures_and_the_command_line_wins():
    def chosen(*words):
        return composed("data.scene=x", "model=forward", *words, hydra=True).hydra.runtime.choices

    assert chosen("experiment=hypernerf")["model/view_dependence"] == "none"
    assert chosen("experiment=hypernerf")["model/background"] == "grid"
    assert chosen("data=hypernerf")["model/background"] == "none"
    assert chosen("experiment=video_with_poses")["model/view_dependence"] == "sh"
    typed = ["experiment=hypernerf", "preset=demo", "model/view_dependence=mlp", "model/background=none"]
    assert chosen(*typed).items() >= {"model/view_dependence": "mlp", "model/background": "none"}.items()
    assert chosen("experiment=hypernerf", "ablation=full")["model/view_dependence"] == "mlp"


FOREIGN = {
    "model/mine.yaml": "defaults:\n  - _self_\n\nname: mine\n_target_: mine.Method\nwidth: ${preset.width}\n",
    "numbers/mine_fast.yaml": """
stage: {only: {share: 1.0}}
preset: {rays: 7, background: white, width: 32}
exceptions:
  dnerf: {preset: {width: 48}}
  nhr: {preset: {rays: 9}}
scenes:
  specimen_still: {preset: {width: 64}}
""",
    "numbers/particles.yaml": "exceptions: {dnerf: {preset: {background: white}}, theirs: {seed: 7}}",
    "options.yaml": "# @package _global_\nexperiment: {theirs: {defaults: [override /data: nhr]}}",
}


@pytest.mark.slow
def test_a_package_brings_a_method_and_its_numbers(tmp_path):
    for name, text in FOREIGN.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)

    def mine(*words):
        return composed(f"hydra.searchpath=[file://{tmp_path}]", "model=mine", "data.scene=x", *words)

    plain, dnerf, nhr = mine(), mine("experiment=dnerf"), mine("experiment=nhr")
    assert (plain.model.name, plain.run) == ("mine", "runs/x/mine-fast-seed0")
    assert (list(plain.stage), "objective" in plain, "renderer" in plain.model) == (["only"], False, False)
    assert [c.model.width for c in (plain, dnerf, nhr)] == [32, 48, 32]
    assert [c.data.rays for c in (plain, dnerf, nhr)] == [7, 7, 9]
    assert mine("scene=specimen_still").model.width == 64
    theirs = mine("model=particles", "experiment=theirs")
    assert (theirs.seed, theirs.data.frames, theirs.preset.background) == (7, 100, "random")
    assert mine("model=particles", "experiment=dnerf").preset.background == "random"  # ours comes first
    with pytest.raises(ConfigCompositionException, match="Could not find 'stage/mine_demo'"):
        mine("preset=demo")


READERS = {"dnerf": dnerf, "hypernerf": hypernerf, "nhr": nhr, "video_with_poses": posed_video}


@pytest.mark.parametrize("data", READERS)
def test_what_a_reader_takes_is_a_key_and_equals_its_default(data):
    config = OmegaConf.load(CONF / "data" / f"{data}.yaml")
    for name, parameter in signature(READERS[data].read_scene).parameters.items():
        if parameter.kind is parameter.KEYWORD_ONLY:
            assert config[name] == parameter.default, name
    common = {n: p.default for n, p in signature(SceneDataModule.__init__).parameters.items()}
    for name in ("held_out", "cache_bytes"):
        assert config.get(name, common[name]) == common[name]
