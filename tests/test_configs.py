"""Every configuration composes and instantiates; the command line wins; off is off."""

import re
from dataclasses import MISSING, fields
from functools import cache
from inspect import signature

import pytest
import torch
from hydra.errors import ConfigCompositionException
from omegaconf import OmegaConf

from forewarp.data import dnerf, hypernerf, nhr, posed_video
from forewarp.data.module import SceneDataModule
from forewarp.methods.voxel.effects.inpaint import UNet3d
from forewarp.methods.voxel.effects.upsample import LearnedUpsampler
from forewarp.methods.voxel.effects.view_dependence import SphericalHarmonics, ViewNetwork
from forewarp.methods.voxel.model import Ground
from forewarp.methods.voxel.stage import EFFECTS, VoxelStage
from forewarp.methods.voxel.terms import TERMS
from forewarp.renderer import Renderer
from forewarp.runs.build import build_run, model_of
from forewarp.scene.box import Box, Lattice
from forewarp.training.schedule import StageSettings
from tests.support.configs import CONF, ROOT, composed, groups, options

PRESETS, MODELS = options("preset"), options("model")
CHOICES = [(group, option) for group in groups() for option in options(group)]
OFF = [
    ("inpainter", "unet3d"),
    ("upsampler", "learned"),
    ("view_dependence", "mlp"),
    ("motion", "dct"),
    ("background", "grid"),
]


def run_of(*overrides):
    """A run put together, of a scene that need not exist."""
    return build_run(composed("data.scene=x", *overrides))


def method_of(model, frames=4):
    """A voxel method on a tiny lattice."""
    lattice = Lattice(Box((-1, -1, -1), (1, 1, 1)), (3, 4, 5))
    every = torch.ones(lattice.shape, dtype=torch.bool)
    ground = Ground(lattice, every, 0.5, lattice.box, frames, 0.0, (lattice, every))
    return model.build(ground, VoxelStage(num_voxels=[[0, 60]], effects=EFFECTS))


def model_for(group, option):
    """The method whose file an option is, where its name says so."""
    named = [m for m in MODELS if option.startswith(f"{m}_")]
    return [f"model={named[0]}"] if group.startswith(("stage", "objective", "model_")) and named else []


@pytest.mark.parametrize(("group", "option"), CHOICES)
def test_every_option_composes_and_instantiates(group, option):
    run = run_of(f"{group}={option}", *model_for(group, option))
    one = option == "no_coarse" or "tnerf" in f"{group}={option}"
    assert [stage.settings.name for stage in run.stages] == (["fine"] if one else ["coarse", "fine"])
    if group.startswith("model/"):
        assert isinstance(method_of(run.model), torch.nn.Module)


@pytest.mark.parametrize("name", [path.stem for path in CONF.glob("*.yaml")])
def test_every_command_has_a_config(name):
    config = composed("data.scene=x", name=name) if name == "train" else composed(name=name)
    assert OmegaConf.to_container(config, resolve=True, throw_on_missing=True)["paths"]


# A search has ranges in the place of options, and needs Optuna: tests/cli/test_search.py.
GRIDS = sorted(path.stem for path in (ROOT / "sweeps").glob("*.yaml") if path.stem != "search")


@pytest.mark.parametrize("sweep", GRIDS)
def test_every_sweep_is_found_and_names_options(sweep):
    params = composed(f"sweeps={sweep}", hydra=True).hydra.sweeper.params
    assert len(params) > 0
    for key, values in params.items():
        names = [value.strip() for value in str(values).split(",")]
        if key == "seed":
            assert re.fullmatch(r"range\(0, ?\d+\)", str(values))
        elif key in groups():  # each option composes, as is tested above
            assert set(names) <= set(options(key))
        else:
            for name in names:
                run_of(f"{key}={name}")


@cache
def swept(variant):
    """What a job of the sweep over variants composes."""
    common = ["experiment=dnerf", "data.scene=x", "sweeps=accuracy_time", "budget.minutes=3"]
    return composed(*common, f"variant={variant}")


@pytest.mark.parametrize("name", options("variant"))
def test_a_variant_names_itself_and_changes_what_it_is_compared_with(name):
    config = swept(name)
    assert config.variant.name == name
    assert config.variant.against in options("variant")
    assert config.run == f"{config.paths.runs}/accuracy_time/x/{name}-3min-seed0"
    assert (config.budget.minutes, config.data.held_out) == (3, 8)
    before = swept(config.variant.against)
    parts = ("model", "stage", "objective", "preset", "budget", "data", "trainer")
    same = all(config[key] == before[key] for key in parts)
    assert same is (name == "base")


def test_the_sweep_holds_every_variant_once():
    config = composed("sweeps=accuracy_time", hydra=True)
    listed = [name.strip() for name in config.hydra.sweeper.params.variant.split(",")]
    assert sorted(listed) == options("variant")


def test_a_variant_wins_over_preset_and_experiment():
    common = ["experiment=dnerf", "data.scene=x"]
    assert method_of(run_of(*common, "variant=view_mlp").model).view_dependence.__class__ is ViewNetwork
    assert composed(*common, "variant=preset_demo").preset.name == "demo"
    assert run_of(*common, "variant=backward").model.deformation is not None
    assert run_of(*common, "variant=unet_32").model.inpainter is not None


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("preset", PRESETS)
def test_presets_go_with_models(preset, model):
    config = composed("data.scene=x", f"preset={preset}", f"model={model}")
    assert (config.preset.name, config.model.name) == (preset, model)
    assert callable(model_of(config.model))
    assert build_run(config).stages


def test_faithful_is_the_papers_model():
    method = method_of(run_of("preset=faithful").model, frames=40)
    assert isinstance(method.inpainter, UNet3d)
    assert method.inpainter.width == 64
    assert isinstance(method.upsampler, LearnedUpsampler)
    assert isinstance(method.view_dependence, ViewNetwork)
    assert method.motion.trajectory.bases == 15
    assert not method.motion.trajectory.at_nodes


def test_faithful_stages_are_the_papers():
    coarse, fine = run_of("preset=faithful").stages
    assert (coarse.settings.iterations, fine.settings.iterations) == (20_000, 100_000)
    first, last = coarse.settings.numbers, fine.settings.numbers
    assert (first["start_alpha"], last["start_alpha"]) == (1e-6, 1e-2)
    assert first["box_alpha"] == 1e-3
    assert first["effects"] == ["motion", "background"]
    assert not last["carry"]
    assert coarse.objective.weights["tv_depth"] == fine.objective.weights["tv_depth"] == 1e-1
    assert (coarse.objective.weights["point_color"], fine.objective.weights["point_color"]) == (1e-1, 1e-2)


@pytest.mark.parametrize(("effect", "on"), OFF)
@pytest.mark.parametrize("preset", PRESETS)
def test_off_is_none_whatever_the_preset(preset, effect, on):
    model = run_of(f"preset={preset}", f"model/{effect}=none").model
    assert getattr(model, effect) is None
    assert getattr(run_of(f"preset={preset}", f"model/{effect}={on}").model, effect) is not None


def test_every_number_of_the_renderer_is_a_key_and_equals_its_default():
    defaults = {
        name: p.default for name, p in signature(Renderer.__init__).parameters.items() if name != "self"
    }
    config = OmegaConf.to_container(composed("data.scene=x").model.renderer)
    assert config == {"_target_": "forewarp.renderer.Renderer"} | defaults
    assert run_of("model.renderer.early_stop_eps=0").model.renderer.early_stop_eps == 0


def test_off_effects_own_nothing():
    off = [f"model/{effect}=none" for effect, _ in OFF]
    method = method_of(run_of(*off).model)
    assert {name.split(".")[0] for name, _ in method.named_parameters()} == {"radiance"}


@pytest.mark.parametrize("order", [1, -1])
def test_the_command_line_wins_over_the_preset(order):
    overrides = ["preset=fast", "model/view_dependence=mlp"][::order]
    assert method_of(run_of("preset=fast").model).view_dependence.__class__ is SphericalHarmonics
    assert method_of(run_of(*overrides).model).view_dependence.__class__ is ViewNetwork


def test_the_command_line_wins_over_the_experiment():
    config = composed("experiment=dnerf", "data.scene=x", "preset=faithful", "data.box=null", "data.rays=7")
    assert (config.preset.name, config.data.box, config.data.rays) == ("faithful", None, 7)
    assert composed("experiment=dnerf", "data.scene=x").data.box == [-1.5] * 3 + [1.5] * 3


def test_a_ghost_is_refused():
    config = composed("model/inpainter=none", "+model.inpainter.width=32")
    with pytest.raises(Exception, match="model.inpainter: expected a factory or null, but got {'width': 32}"):
        model_of(config.model)


def test_an_unknown_key_is_refused():
    with pytest.raises(ConfigCompositionException, match=r"data\.scence"):
        composed("data.scence=x")


def test_budget_is_shared_out():
    run = run_of("preset=fast", "budget.minutes=20", "budget.iterations=1000")
    assert [stage.settings.minutes for stage in run.stages] == pytest.approx([8, 12])
    assert [stage.settings.iterations for stage in run.stages] == [400, 600]


def test_a_dropped_stage_leaves_its_share():
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
            given = [base[field.name], field.default]
            ours, expected = OmegaConf.to_container(OmegaConf.create(given))
            assert ours == expected, field.name


def test_every_weight_may_be_typed():
    config = composed("objective.coarse.weights.tv_depth=0.5", "objective.fine.weights.flow_l1=0.25")
    coarse, fine = build_run(config).stages
    assert (coarse.objective.weights["tv_depth"], fine.objective.weights["tv_depth"]) == (0.5, 0.0)
    assert set(coarse.objective.weights) == set(TERMS)
    assert fine.objective.weights["flow_l1"] == 0.25


@pytest.mark.parametrize("data", options("data"))
def test_every_dataset_takes_a_canonical_time_and_the_presets_background(data):
    common = [f"data={data}", "data.scene=x", "preset.background=black"]
    config = composed(*common, "data.canonical=middle")
    assert (config.data.canonical, config.data.background) == ("middle", "black")
    build_run(config)
    assert composed(*common, "ablation=canonical_middle").data.canonical == "middle"


def test_run_folder_is_named_after_the_choices():
    config = composed("data.scene=hook", "data=dnerf", "model=backward", "preset=demo", "seed=3")
    assert config.run == "runs/hook/backward-demo-seed3"


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("experiment", options("experiment"))
@pytest.mark.parametrize("preset", PRESETS)
def test_every_method_fits_every_experiment_in_every_preset(preset, experiment, model):
    common = [f"experiment={experiment}", f"preset={preset}", f"model={model}", "data.scene=x"]
    config = composed(*common)
    assert (config.model.name, config.preset.name) == (model, preset)
    build_run(config)


@pytest.mark.parametrize("model", ["forward", "backward"])
def test_each_number_of_a_method_is_taken_where_it_is_keyed(model):
    hypernerf = ["experiment=hypernerf", "data.scene=x", f"model={model}"]
    fast, faithful = composed(*hypernerf), composed(*hypernerf, "preset=faithful")
    assert [c.preset.bases for c in (fast, faithful)] == [8, 25]  # model x preset x experiment
    assert fast.objective.fine.weights.static_points == 1e-2  # model x experiment
    assert (fast.preset.rays, faithful.budget.iterations) == (4096, 120000)  # model x preset
    band, still = (composed(f"scene=specimen_{name}", f"model={model}") for name in ("band", "still"))
    assert (band.stage.fine.num_voxels, still.stage.coarse.num_voxels) == ([[0, 15625]], [[0, 46656]])


def test_effects_follow_the_pictures_and_the_command_line_wins():
    def chosen(*words):
        return composed("data.scene=x", *words, hydra=True).hydra.runtime.choices

    assert chosen("experiment=hypernerf")["model/view_dependence"] == "none"
    assert chosen("experiment=hypernerf")["model/background"] == "grid"
    assert chosen("data=hypernerf")["model/background"] == "none"
    assert chosen("experiment=video_with_poses")["model/view_dependence"] == "sh"
    typed = ["experiment=hypernerf", "preset=demo", "model/view_dependence=mlp", "model/background=none"]
    assert [chosen(*typed)[f"model/{effect}"] for effect in ("view_dependence", "background")] == [
        "mlp",
        "none",
    ]
    assert chosen("experiment=hypernerf", "variant=view_mlp")["model/view_dependence"] == "mlp"


FOREIGN = {
    "model/mine.yaml": "defaults:\n  - _self_\n\nname: mine\n_target_: mine.Method\nwidth: ${preset.width}\n",
    "stage/mine_fast.yaml": "only: {share: 1.0}\n",
    "model_preset/mine_fast.yaml": "# @package _global_\npreset: {rays: 7, background: white, width: 32}\n",
    "model_experiment/mine_dnerf.yaml": "# @package _global_\npreset: {width: 48}\n",
    "model_preset_experiment/mine_fast_nhr.yaml": "# @package _global_\npreset: {rays: 9}\n",
    "model_scene/mine_dnerf_hook.yaml": "# @package _global_\npreset: {width: 64}\n",
}


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
    assert mine("scene=dnerf_hook").model.width == 64
    with pytest.raises(ConfigCompositionException, match="Could not find 'stage/mine_demo'"):
        mine("preset=demo")


READERS = {
    "dnerf": dnerf.read_scene,
    "hypernerf": hypernerf.read_scene,
    "nhr": nhr.read_scene,
    "video_with_poses": posed_video.read_scene,
}


@pytest.mark.parametrize("data", READERS)
def test_what_a_reader_takes_is_a_key_and_equals_its_default(data):
    config = OmegaConf.load(CONF / "data" / f"{data}.yaml")
    for name, parameter in signature(READERS[data]).parameters.items():
        if parameter.kind is parameter.KEYWORD_ONLY:
            assert config[name] == parameter.default, name
    common = {n: p.default for n, p in signature(SceneDataModule.__init__).parameters.items()}
    for name in ("held_out", "cache_bytes"):
        assert config.get(name, common[name]) == common[name]


def test_precision_is_a_key():
    assert composed("data.scene=x").trainer.precision is None
    assert composed("data.scene=x", "trainer.precision=bf16-mixed").trainer.precision == "bf16-mixed"
