"""The sweeps behind the paper's tables: every job composes, and is known by what it computes."""

import pytest
from hydra._internal.config_repository import ConfigRepository
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser

from forewarp.runs.build import build_run
from forewarp.runs.config import hashed
from tests.support.configs import ROOT, composed, options

PAPER = {
    "dnerf": 8,
    "hypernerf": 4,
    "nhr": 4,
    "lego_complete": 3,
    "ablation_modules": 60,
    "ablation_losses": 32,
    "resolution": 16,
    "methods": 32,
}


def names(group):
    """The options of a group, sweeps among them."""
    return sorted(p.stem for p in (ROOT / "sweeps").glob("*.yaml")) if group == "sweeps" else options(group)


COUNTERPARTS = ["dnerf", "hypernerf", "nhr", "lego_complete"]


def jobs_of(sweep, *words):
    """The overrides of every job, as Hydra's sweeper multiplies them out."""
    config = composed(f"sweeps={sweep}", *words, hydra=True)
    params = [f"{key}={value}" for key, value in config.hydra.sweeper.params.items()]
    return BasicSweeper.split_arguments(OverridesParser.create().parse_overrides(params), None)[0]


def job_of(sweep, *overrides):
    """A job's config, put together as far as it goes without its data."""
    config = composed(f"sweeps={sweep}", *overrides)
    build_run(config)
    return config


@pytest.mark.parametrize(("sweep", "count"), PAPER.items())
def test_a_sweep_has_its_jobs(sweep, count):
    jobs = jobs_of(sweep)
    assert len(jobs) == len({tuple(job) for job in jobs}) == count
    config = job_of(sweep, *jobs[-1])
    assert config.absent == "skip"
    assert config.run.startswith(f"runs/paper/{config.data.scene}/")


def test_no_sweep_is_forgotten():
    assert {path.stem for path in (ROOT / "sweeps").glob("*.yaml")} == {
        *PAPER,
        "accuracy_time",
        "effects",
        "search",
    }


def test_effects_are_compared_on_every_specimen():
    jobs = jobs_of("effects")
    assert len(jobs) == 18
    for job in jobs[:3]:
        config = job_of("effects", *job)
        assert config.run.startswith("runs/effects/still/")
        assert config.variant.name in config.run
    auto, every, paper = (
        composed("sweeps=effects", "scene=specimen_room", f"ablation={a}")
        for a in ("auto", "all_effects", "full")
    )
    assert auto.effects == "auto"
    assert {
        e
        for e in ("motion", "view_dependence", "upsampler", "inpainter", "background")
        if every.model[e] is None
    } == set()
    assert every.model.trajectory.features > 0
    assert paper.model.background is None


@pytest.mark.parametrize("sweep", ["dnerf", "methods"])
def test_seeds_repeat_every_job(sweep):
    once, thrice = ({tuple(sorted(job)) for job in jobs_of(sweep, f"seeds={n}")} for n in (1, 3))
    assert len(thrice) == 3 * len(once)
    for seed in range(3):
        assert {tuple(word.replace("seed=0", f"seed={seed}") for word in job) for job in once} <= thrice


@pytest.mark.slow
@pytest.mark.parametrize("sweep", PAPER)
def test_every_job_composes_and_has_a_folder_of_its_own(sweep):
    folders = [hashed(job_of(sweep, *job)).run for job in jobs_of(sweep)]
    assert len(set(folders)) == len(folders)


@pytest.mark.parametrize("dataset", COUNTERPARTS)
def test_a_counterpart_stands_in_for_each_dataset(dataset):
    config = job_of("ablation_modules", f"scene=counterpart_{dataset}", "ablation=full", "preset=demo")
    assert "Synthetic" in config.data._target_
    assert (config.preset.name, config.variant.name) == ("demo", "full")
    assert config.stage.fine.num_voxels == [[0, 13824]]


NAMING = [f"{group}={name}" for group in ("ablation", "variant", "sweeps") for name in names(group)]


@pytest.mark.parametrize("choice", [choice for choice in NAMING if choice != "sweeps=methods"])
def test_what_reproduces_the_paper_names_its_method(choice, monkeypatch):
    if choice == "sweeps=search":
        pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    expected = "backward" if choice == "variant=backward" else "forward"
    load = ConfigRepository.load_config

    def with_another_default(self, config_path):
        found = load(self, config_path)
        if config_path == "train":
            (model,) = [d for d in found.defaults_list if getattr(d, "group", None) == "model"]
            model.value = "backward" if expected == "forward" else "forward"
        return found

    monkeypatch.setattr(ConfigRepository, "load_config", with_another_default)
    assert composed("data.scene=x", choice).model.name == expected


def test_a_sweep_over_methods_has_both():
    jobs = [composed("sweeps=methods", *job) for job in jobs_of("methods")[:2]]
    assert sorted(config.model.name for config in jobs) == ["backward", "forward"]
    assert composed("sweeps=dnerf", "data.scene=x", "model=backward").model.name == "backward"
    assert composed("sweeps=accuracy_time", "data.scene=x", "variant=backward").model.name == "backward"


def test_an_ablation_takes_one_thing_from_all():
    common = ["scene=dnerf_hook", "preset=fast"]
    full = composed(*common, "ablation=full")
    assert None not in (full.model.upsampler, full.model.inpainter, full.model.view_dependence)
    without = {
        "no_upsampling": "upsampler",
        "no_inpainter": "inpainter",
        "no_view": "view_dependence",
    }
    for name, part in without.items():
        model = composed(*common, f"ablation={name}").model
        assert [key for key in full.model if full.model[key] != model[key]] == [part]
        assert model[part] is None
    for name, terms in {"no_tv": ["tv_density", "tv_flow", "tv_depth"], "no_flow": ["flow_l1"]}.items():
        weights = composed(*common, f"ablation={name}").objective.fine.weights
        before = full.objective.fine.weights
        assert [term for term in before if before[term] != weights[term]] == terms
        assert all(weights[term] == 0 for term in terms)


def test_a_job_is_known_by_what_it_computes():
    full = ["scene=dnerf_hook", "ablation=full"]
    same = [hashed(composed(f"sweeps={s}", *full)).run for s in ("ablation_modules", "ablation_losses")]
    assert same[0] == same[1]
    assert "{hash}" not in same[0]
    others = (["seed=1"], ["budget.minutes=3"], ["data.rays=7"], ["stage.fine.share=0.1"])
    changed = {hashed(composed("sweeps=ablation_losses", *full, *more)).run for more in others}
    assert len(changed - set(same)) == len(others)
    shown = hashed(composed("sweeps=ablation_losses", *full, "sheets=1", "threads=1", "trainer=cpu")).run
    assert shown == same[0]
    plain = composed("data.scene=x", "data=dnerf")
    assert hashed(plain).run == "runs/x/forward-fast-seed0"


def test_the_canonical_middle_reaches_the_data():
    run = build_run(composed("scene=dnerf_hook", "ablation=canonical_middle"))
    assert run.datamodule._canonical == "middle"


@pytest.mark.parametrize("preset", ["demo", "fast"])
def test_what_stands_alone_begins_as_the_coarse_stage_would(preset):
    common = ["scene=dnerf_hook", f"preset={preset}"]
    coarse = composed(*common, "ablation=full").stage.coarse
    full, alone = (composed(*common, f"ablation={name}").stage for name in ("full", "no_coarse"))
    assert alone.coarse is None
    changed = {key for key in full.fine if full.fine[key] != alone.fine[key]}
    assert changed <= {"start", "lr_hold", "bases", "hull_frames", "hull_grow", "confine", "curriculum", "lr"}
    assert all(alone.fine[key] == coarse[key] for key in changed - {"lr"})
    assert alone.fine.lr == {**full.fine.lr, "flow": coarse.lr.flow}


@pytest.mark.parametrize("preset", ["demo", "fast", "faithful"])
def test_the_voxel_networks_come_with_the_fine_stage(preset):
    common = ["scene=dnerf_hook", f"preset={preset}"]
    for name in ("full", "no_tv", "no_up_photo"):
        stage = composed(*common, f"ablation={name}").stage
        assert not {"upsampler", "inpainter"} & set(stage.coarse.effects)
        assert {"upsampler", "inpainter"} <= set(stage.fine.effects)


def test_captures_have_numbers_of_their_own_in_every_preset():
    quick, faithful = composed("scene=hypernerf_broom"), composed("scene=hypernerf_broom", "preset=faithful")
    assert (quick.preset.bases, faithful.preset.bases) == (8, 25)
    assert quick.model.view_dependence is None
    assert faithful.model.view_dependence is not None
    for config in (quick, faithful):
        assert config.data.scene == "broom2"
        assert config.model.background is not None
        assert config.stage.fine.num_voxels[-1][1] == 343000
        assert config.objective.fine.weights.static_points == 1e-2


def test_where_minutes_bound_a_run_its_precision_counts():
    full = ["sweeps=dnerf", "scene=dnerf_hook"]
    half = "trainer.precision=bf16-mixed"
    assert hashed(composed(*full)).run != hashed(composed(*full, half)).run
    steps = ["budget.minutes=null", "budget.iterations=5"]
    assert hashed(composed(*full, *steps)).run == hashed(composed(*full, *steps, half)).run
