"""Every configuration composes and instantiates; the command line wins; off is off."""

import re
from dataclasses import MISSING, fields
from functools import cache
from inspect import signature

import pytest
import torch
from hydra.errors import ConfigCompositionException
from hydra.utils import instantiate
from omegaconf import OmegaConf

from configs import CONF, ROOT, composed, groups, options
from forewarp.cli.runs import build_run
from forewarp.methods.voxel.effects.inpaint import UNet3d
from forewarp.methods.voxel.effects.upsample import LearnedUpsampler
from forewarp.methods.voxel.effects.view import SphericalHarmonics, ViewNetwork
from forewarp.renderer import Renderer
from forewarp.scene.box import Box, Lattice
from forewarp.training.settings import StageSettings

BUDGETS, MODELS = options("budget"), options("model")
CHOICES = [(group, option) for group in groups() for option in options(group)]
OFF = [
    ("inpainter", "unet3d"),
    ("upsampler", "learned"),
    ("view", "mlp"),
    ("motion", "dct"),
    ("background", "grid"),
]


def run_of(*overrides):
    """A run put together, of a scene that need not exist."""
    return build_run(composed("data.scene=x", *overrides))


def method_of(spec, frames=4):
    """A method on a tiny lattice."""
    lattice = Lattice(Box((-1, -1, -1), (1, 1, 1)), (3, 4, 5))
    return spec.build(
        lattice,
        torch.ones(lattice.shape, dtype=torch.bool),
        unit=0.5,
        scene_box=lattice.box,
        frames=frames,
        canonical_time=0.0,
        effects=("motion", "view", "upsampler", "inpainter"),
    )


@pytest.mark.parametrize(("group", "option"), CHOICES)
def test_every_option_composes_and_instantiates(group, option):
    run = run_of(f"{group}={option}")
    stages = ["fine"] if option == "no_coarse" else ["coarse", "fine"]
    assert [stage.settings.name for stage in run.stages] == stages
    if group.startswith("model"):
        assert isinstance(method_of(run.spec), torch.nn.Module)


@pytest.mark.parametrize("name", [path.stem for path in CONF.glob("*.yaml")])
def test_every_command_has_a_config(name):
    config = composed("data.scene=x", name=name) if name == "train" else composed(name=name)
    assert OmegaConf.to_container(config, resolve=True, throw_on_missing=True)["paths"]


@pytest.mark.parametrize("sweep", [path.stem for path in (ROOT / "sweeps").glob("*.yaml")])
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
    parts = ("model", "stage", "objective", "budget", "data", "renderer", "trainer")
    same = all(config[key] == before[key] for key in parts)
    assert same is (name == "base")


def test_the_sweep_holds_every_variant_once():
    config = composed("sweeps=accuracy_time", hydra=True)
    listed = [name.strip() for name in config.hydra.sweeper.params.variant.split(",")]
    assert sorted(listed) == options("variant")


def test_a_variant_wins_over_budget_and_experiment():
    common = ["experiment=dnerf", "data.scene=x"]
    assert method_of(run_of(*common, "variant=view_mlp").spec).view.__class__ is ViewNetwork
    assert composed(*common, "variant=preset_demo").budget.name == "demo"
    assert run_of(*common, "variant=backward").spec.warp == "backward"
    assert run_of(*common, "variant=unet_32").spec.inpainter is not None


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("budget", BUDGETS)
def test_budgets_go_with_models(budget, model):
    config = composed("data.scene=x", f"budget={budget}", f"model={model}")
    assert (config.budget.name, config.model.warp) == (budget, model)
    spec = instantiate(config.model, _convert_="all")
    if model == "backward":
        assert [spec.motion, spec.trajectory, spec.upsampler, spec.inpainter] == [None] * 4
        assert spec.deformation is not None
    build_run(config)


def test_faithful_is_the_papers_model():
    method = method_of(run_of("budget=faithful").spec, frames=40)
    assert isinstance(method.inpainter, UNet3d)
    assert method.inpainter.width == 64
    assert isinstance(method.upsampler, LearnedUpsampler)
    assert isinstance(method.view, ViewNetwork)
    assert method.motion.trajectory.bases == 15
    assert not method.motion.trajectory.at_nodes


def test_faithful_stages_are_the_papers():
    coarse, fine = run_of("budget=faithful").stages
    assert (coarse.settings.iterations, fine.settings.iterations) == (20_000, 100_000)
    assert (coarse.settings.start_alpha, fine.settings.start_alpha) == (1e-6, 1e-2)
    assert coarse.settings.box_alpha == 1e-3
    assert coarse.settings.effects == ["motion", "background"]
    assert not fine.settings.carry
    assert coarse.objective.weights["tv_depth"] == fine.objective.weights["tv_depth"] == 1e-1
    assert (coarse.objective.weights["point_color"], fine.objective.weights["point_color"]) == (1e-1, 1e-2)


@pytest.mark.parametrize(("effect", "on"), OFF)
@pytest.mark.parametrize("budget", BUDGETS)
def test_off_is_none_whatever_the_budget(budget, effect, on):
    spec = run_of(f"budget={budget}", f"model/{effect}=none").spec
    assert getattr(spec, effect) is None
    assert getattr(run_of(f"budget={budget}", f"model/{effect}={on}").spec, effect) is not None


def test_every_number_of_the_renderer_is_a_key_and_equals_its_default():
    defaults = {
        name: p.default for name, p in signature(Renderer.__init__).parameters.items() if name != "self"
    }
    config = OmegaConf.to_container(composed("data.scene=x").renderer)
    assert config == {"_target_": "forewarp.renderer.Renderer"} | defaults
    assert run_of("renderer.opaque=0").renderer.opaque == 0


def test_off_effects_own_nothing():
    off = [f"model/{effect}=none" for effect, _ in OFF]
    method = method_of(run_of(*off).spec)
    assert {name.split(".")[0] for name, _ in method.named_parameters()} == {"radiance"}


@pytest.mark.parametrize("order", [1, -1])
def test_the_command_line_wins_over_the_budget(order):
    overrides = ["budget=fast", "model/view=mlp"][::order]
    assert method_of(run_of("budget=fast").spec).view.__class__ is SphericalHarmonics
    assert method_of(run_of(*overrides).spec).view.__class__ is ViewNetwork


def test_the_command_line_wins_over_the_experiment():
    config = composed("experiment=dnerf", "data.scene=x", "budget=faithful", "data.box=null", "data.rays=7")
    assert (config.budget.name, config.data.box, config.data.rays) == ("faithful", None, 7)
    assert composed("experiment=dnerf", "data.scene=x").data.box == [-1.5] * 3 + [1.5] * 3


def test_a_ghost_is_refused():
    config = composed("model/inpainter=none", "+model.inpainter.width=32")
    with pytest.raises(Exception, match="model.inpainter: expected a factory or null, but got {'width': 32}"):
        instantiate(config.model, _convert_="all")


def test_an_unknown_key_is_refused():
    with pytest.raises(ConfigCompositionException, match=r"data\.scence"):
        composed("data.scence=x")


def test_budget_is_shared_out():
    run = run_of("budget=fast", "budget.minutes=20", "budget.iterations=1000")
    assert [stage.settings.minutes for stage in run.stages] == pytest.approx([8, 12])
    assert [stage.settings.iterations for stage in run.stages] == [400, 600]


def test_a_dropped_stage_leaves_its_share():
    (only,) = run_of("budget=fast", "budget.minutes=20", "~stage.fine").stages
    assert (only.settings.name, only.settings.minutes) == ("coarse", 20)
    (only,) = run_of("budget=fast", "stage.coarse=null").stages
    assert only.settings.name == "fine"


def test_every_stage_key_may_be_typed_and_starts_from_the_same():
    base = OmegaConf.to_container(OmegaConf.load(CONF / "stage" / "one" / "base.yaml"))
    for field in fields(StageSettings):
        if field.name in ("name", "minutes", "iterations"):  # named by its place; bounded by the budget
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
    assert set(coarse.objective.weights) == set(coarse.objective.terms)
    assert fine.objective.weights["flow_l1"] == 0.25


@pytest.mark.parametrize("data", options("data"))
def test_every_dataset_takes_a_canonical_time_and_the_budgets_background(data):
    common = [f"data={data}", "data.scene=x", "budget.background=black"]
    config = composed(*common, "data.canonical=middle")
    assert (config.data.canonical, config.data.background) == ("middle", "black")
    build_run(config)
    assert composed(*common, "ablation=canonical_middle").data.canonical == "middle"


def test_run_folder_is_named_after_the_choices():
    config = composed("data.scene=hook", "data=dnerf", "model=backward", "budget=demo", "seed=3")
    assert config.run == "runs/hook/backward-demo-seed3"
