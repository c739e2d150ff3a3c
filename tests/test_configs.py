"""Every configuration composes and instantiates; the command line wins; off is off."""

from dataclasses import MISSING, fields
from inspect import signature
from itertools import zip_longest

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from forewarp.data import dnerf, hypernerf, multicam, nhr, posed_video
from forewarp.data.module import SceneDataModule
from forewarp.methods.particles.options import Effects
from forewarp.methods.voxel.forward import ForwardWarp
from forewarp.methods.voxel.structure import VoxelStage
from forewarp.renderer import Renderer
from forewarp.runs.build import build_run
from forewarp.runs.sections import parsed
from forewarp.scene.box import Lattice
from forewarp.training.schedule import StageSettings
from tests.support.configs import CONF, composed, options
from tests.support.tiny_scene import BOX, built

PRESETS, MODELS = options("preset"), options("model")
EXPERIMENTS = options("experiment")
OF_THE_TABLES = [model for model in MODELS if model not in ("forward", "backward", "particles")]
IN_SMALL = ("forward", "backward")  # with preset=compact
OF_PARTICLES = {"rotation": "nodes", "view_dependence": "harmonics", "color_over_time": "cosines"}
OF_PARTICLES |= {"opacity_over_time": "cosines", "exposure": "cosines", "background": "still"}
OF_PARTICLES = [("motion", "spline"), ("motion", "cosines"), *OF_PARTICLES.items()]
OF_PARTICLES = [(f"model/{effect}", option) for effect, option in OF_PARTICLES]
OFF = [("inpainter", "unet3d"), ("upsampler", "learned"), ("view_dependence", "mlp"), ("motion", "dct")]
OFF += [("background", "grid")]


def run_of(*overrides):
    """A run put together, of a scene that need not exist."""
    return build_run(composed("data.scene=x", *overrides))


def method_of(model, frames=4):
    """A voxel method on a tiny lattice."""
    return built(model, Lattice(BOX, (3, 4, 5)), frames=frames, num_voxels=[[0, 60]])


def rows_of(*chosen):
    """Command lines that choose every option of some groups once, several groups on a line."""
    pairs = ([(group, option) for option in options(group)] for group in chosen)
    columns = [["=".join(pair) for pair in column if pair not in OF_PARTICLES] for column in pairs]
    return [[word for word in row if word is not None] for row in zip_longest(*columns)]


@pytest.mark.slow
@pytest.mark.parametrize("words", rows_of("capture", "logger", "trainer"), ids=" ".join)
def test_options_of_every_method_compose_and_instantiate(words):
    for tracker in {"logger=wandb", "logger=mlflow"} & {*words}:
        pytest.importorskip(tracker.removeprefix("logger="), reason="needs forewarp[trackers]")
    assert [stage.settings.name for stage in run_of(*words).stages] == ["coarse", "fine"]


GROUPS = [f"model/{effect}" for effect, _ in OFF]


@pytest.mark.slow
@pytest.mark.parametrize("words", rows_of(*GROUPS, "model/radiance"), ids=" ".join)
def test_options_of_voxels_compose_and_instantiate(words):
    model = run_of("model=forward", *words).model
    assert isinstance(method_of(model), torch.nn.Module)
    chosen = {word.removeprefix("model/").split("=")[0] for word in words if not word.endswith("=none")}
    assert None not in [model.keywords[effect] for effect in chosen]


@pytest.mark.slow
def test_effects_of_particles_are_switched():
    off = run_of(*(f"{group}=none" for group, _ in OF_PARTICLES[1:])).model.keywords
    assert off == dict.fromkeys(group.removeprefix("model/") for group, _ in OF_PARTICLES)
    given = run_of(*(f"{group}={option}" for group, option in OF_PARTICLES[1:])).model.keywords
    assert None not in given.values()
    assert Effects(**given)
    with pytest.raises(ValueError, match="model.view_dependence: expected a degree of 1 to 3, or null, but"):
        Effects(**given | {"view_dependence": "mlp"})


@pytest.mark.parametrize("name", [path.stem for path in CONF.glob("*.yaml") if path.stem != "options"])
def test_every_command_has_a_config(name):
    config = composed("data.scene=x", name=name) if name == "train" else composed(name=name)
    assert OmegaConf.to_container(config, resolve=True, throw_on_missing=True)["paths"]


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_off_is_none_whatever_the_preset(preset):
    off = run_of("model=forward", f"preset={preset}", *(f"model/{effect}=none" for effect, _ in OFF)).model
    assert [off.keywords[effect] for effect, _ in OFF] == [None] * len(OFF)
    assert {name.split(".")[0] for name, _ in method_of(off).named_parameters()} == {"radiance"}


@pytest.mark.slow
def test_every_number_of_the_renderer_is_a_key_and_equals_its_default():
    parameters = list(signature(Renderer.__init__).parameters.values())[1:]
    config = composed("data.scene=x", "model=forward", "preset=faithful").model.renderer
    assert config == {"_target_": "forewarp.renderer.Renderer"} | {p.name: p.default for p in parameters}


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, -1])
def test_the_command_line_wins_over_the_preset_and_the_experiment(order):
    words = ["experiment=dnerf", "preset=faithful", "data.box=null", "data.rays=7"]
    words += ["model=forward", "model/view_dependence=sh"]
    config = composed(*words[::order], "data.scene=x")
    assert (config.preset.name, config.data.box, config.data.rays) == ("faithful", None, 7)
    assert "SphericalHarmonics" in config.model.view_dependence._target_


FORWARD = ["model=forward", "experiment=dnerf"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "handed"),
    [
        (FORWARD, True),
        ([*FORWARD, "start_motion=own"], False),
        ([*FORWARD, "preset=faithful"], False),
        ([*FORWARD, "preset=faithful", "start_motion=particles"], True),
        ([*FORWARD, "ablation=no_tv"], False),  # whose coarse stage is that of the tables
        ([*FORWARD, "sweeps=effects", "ablation=base"], False),
        ([*FORWARD, "sweeps=price_list_forward"], False),
        (["model=backward", "experiment=dnerf"], False),
        (["model=forward", "experiment=lego_complete"], False),
    ],
)
def test_motion_begins_as_that_of_particles_where_that_was_found_better(words, handed):
    config = composed("data.scene=x", *words)
    assert list(config.stage) == ["coarse", "fine"]
    assert ("model" in config.stage.coarse, config.stage.fine.start == "matter") == (handed, handed)
    assert (config.preset.coefficients == "nodes") == handed


@pytest.mark.slow
def test_budget_is_shared_out_and_every_weight_may_be_typed():
    weights = ["objective.coarse.weights.tv_depth=0.5", "objective.fine.weights.flow_l1=0.25"]
    stages = run_of("model=forward", "budget.minutes=20", "budget.iterations=1000", *weights).stages
    assert [stage.settings.minutes for stage in stages] == pytest.approx([8, 12])
    assert [stage.settings.iterations for stage in stages] == [400, 600]
    coarse, fine = (stage.objective.weights for stage in stages)
    assert (coarse["tv_depth"], fine["tv_depth"], fine["flow_l1"]) == (0.5, 0.0, 0.25)
    assert set(coarse) == set(ForwardWarp.terms)


@pytest.mark.slow
@pytest.mark.parametrize(("dropped", "left"), [("~stage.fine", "coarse"), ("stage.coarse=null", "fine")])
def test_the_stage_that_is_left_has_the_whole_budget(dropped, left):
    (only,) = run_of("budget.minutes=20", dropped).stages
    assert (only.settings.name, only.settings.minutes) == (left, 20)


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


@pytest.mark.slow
@pytest.mark.parametrize("data", options("data"))
def test_every_dataset_takes_a_canonical_time_and_the_presets_background(data):
    config = composed("data.scene=x", "data.canonical=middle", name=f"data/{data}")
    outside = {"preset": {"background": "black", "rays": 8}, "paths": {"data": "a", "scenes": "b"}, "seed": 0}
    config = OmegaConf.create(outside | OmegaConf.to_container(config))
    assert (config.data.canonical, config.data.background) == ("middle", "black")
    assert isinstance(instantiate(config.data, _convert_="all"), SceneDataModule)


def every_section():
    """Every method and preset, with each experiment that its file has exceptions for, or any other."""
    for i, model in enumerate(MODELS):
        for j, preset in enumerate(PRESETS):
            if preset == "compact" and model not in IN_SMALL:
                continue
            names = [f"{model}_{preset}", *([model] if preset == "demo" else [])]
            files = [CONF / "numbers" / f"{name}.yaml" for name in names]
            texts = [parsed(file.read_text()).content for file in files if file.is_file()]
            own = {experiment for text in texts for experiment in text.get("exceptions", {})}
            for experiment in sorted(own) or [EXPERIMENTS[(3 * i + j) % len(EXPERIMENTS)]]:
                yield model, preset, experiment


@pytest.mark.slow
@pytest.mark.parametrize(("model", "preset", "experiment"), list(every_section()))
def test_every_section_of_numbers_composes_and_instantiates(model, preset, experiment):
    config = composed(f"model={model}", f"preset={preset}", f"experiment={experiment}", "data.scene=x")
    assert (config.model.name, config.preset.name) == (model, preset)
    build_run(config)
    if model in OF_THE_TABLES and experiment in ("hypernerf", "demo_hypernerf"):
        # Trained over the background that they are measured on.
        assert (config.data.background, config.data.eval_background) == ("black", "black")
        assert config.model.get("camera") == (True if "tineuvox" in model else None)


@pytest.mark.slow
@pytest.mark.parametrize("model", IN_SMALL)
def test_compact_differs_from_faithful_in_sizes_and_ends_alone(model):
    words = "data.scene=x", f"model={model}"
    both = (composed(*words, f"preset={preset}") for preset in ("faithful", "compact"))
    faithful, compact = (OmegaConf.to_container(config, resolve=True) for config in both)
    sizes = {"share", "num_voxels", "background_num_voxels", "patches", "curriculum"}
    sizes |= {"start_alpha", "lr_hold", "lr_final_factor"}
    for config in (faithful, compact):
        for part in ("preset", "budget", "run", "modules", "plan"):
            config.pop(part, None)
        config["data"].pop("rays")
        (config["model"].get("inpainter") or {}).pop("width", None)
        for stage in config["stage"].values():
            assert sizes <= set(stage)
            assert all(stage.pop(size) is not None for size in sizes)
    assert compact == faithful


@pytest.mark.slow
@pytest.mark.parametrize("model", ["forward", pytest.param("backward", marks=pytest.mark.slow)])
def test_each_number_of_a_method_is_taken_where_it_is_keyed(model):
    hypernerf = ["experiment=hypernerf", "data.scene=broom2", f"model={model}"]
    fast, faithful = composed(*hypernerf), composed(*hypernerf, "preset=faithful")
    assert [c.preset.bases for c in (fast, faithful)] == [8, 25]  # of the preset, for an experiment
    assert [c.objective.fine.weights.static_points for c in (fast, faithful)] == [1e-2, 0]  # printed: none
    assert (fast.preset.rays, faithful.budget.iterations) == (1024, 120000)
    assert fast.stage.fine.num_voxels[-1][1] == 343000
    assert fast.stage.coarse.effects == []  # at rest first
    assert "motion" in faithful.stage.coarse.effects
    assert composed("scene=specimen_band", f"model={model}").stage.fine.num_voxels == [[0, 15625]]


@pytest.mark.slow
def test_effects_follow_the_images_and_the_command_line_wins():
    def chosen(*words):
        choices = composed("data.scene=x", "model=forward", *words, hydra=True).hydra.runtime.choices
        return choices["model/view_dependence"], choices["model/background"]

    assert chosen("experiment=video_with_poses") == ("sh", "grid")
    typed = ["experiment=hypernerf", "preset=demo", "model/view_dependence=mlp", "model/background=none"]
    assert chosen(*typed) == ("mlp", "none")
    assert chosen("experiment=hypernerf", "ablation=full") == ("mlp", "grid")


READERS = {"dnerf": dnerf, "hypernerf": hypernerf, "nhr": nhr, "video_with_poses": posed_video}
READERS |= {"multicam": multicam}


@pytest.mark.parametrize("data", READERS)
def test_what_a_reader_takes_is_a_key_and_equals_its_default(data):
    config = OmegaConf.load(CONF / "data" / f"{data}.yaml")
    for name, parameter in signature(READERS[data].read_scene).parameters.items():
        if parameter.kind is parameter.KEYWORD_ONLY:
            assert config[name] == parameter.default, name
    common = {n: p.default for n, p in signature(SceneDataModule.__init__).parameters.items()}
    for name in ("held_out", "cache_bytes"):
        assert config.get(name, common[name]) == common[name]
