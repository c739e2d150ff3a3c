"""The sweeps behind the tables: every job composes, and its folder is named by what it computes."""

import shlex
from copy import deepcopy
from itertools import chain
from unittest.mock import patch

import pytest
import yaml
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from forewarp.methods.particles.options import EFFECTS
from forewarp.methods.voxel.structure import NAMES
from forewarp.report import settings
from forewarp.runs.build import build_run
from forewarp.runs.config import hashed
from forewarp.runs.overrides import key_of, merged
from hydra_plugins.forewarp_one_at_a_time import changed
from tests.support.configs import ROOT, composed

PAPER = {"dnerf": 24, "hypernerf": 12, "nhr": 12, "lego_complete": 9, "ablation_modules": 60}
PAPER |= {"ablation_losses": 32, "ablation_converged": 10, "resolution": 16, "methods": 24, "flow": 2}
OTHERS = {"accuracy_time", "effects", "price_list_forward", "price_list_particles", "search", "search_keys"}
OTHERS |= {"minutes"}
COUNTS = {"forward": 45, "particles": 48}
LISTS = {name: (ROOT / "sweeps" / f"price_list_{name}.yaml").read_text() for name in COUNTS}
CHANGES = {name: yaml.safe_load(text)["hydra"]["sweeper"]["changes"] for name, text in LISTS.items()}
HOOK = ["experiment=dnerf", "data.scene=hook"]


def jobs_of(sweep, *words):
    """The overrides of every job, as the sweeper multiplies them out, for all its scenes."""
    sweeper = composed(f"sweeps={sweep}", *words, hydra=True).hydra.sweeper
    params = [f"{key}={value}" for key, value in sweeper.params.items()]
    jobs = BasicSweeper.split_arguments(OverridesParser.create().parse_overrides(params), None)[0]
    return changed(jobs, sweeper.get("scenes", [""]))


def with_changes(sweep):
    """The overrides of every job with every change that the sweep lists."""
    return changed(jobs_of(sweep), composed(f"sweeps={sweep}", hydra=True).hydra.sweeper.changes)


def job_of(sweep, *overrides):
    """A job's config, put together as far as it goes without its data."""
    config = composed(f"sweeps={sweep}", *overrides, hydra=True)
    with patch.object(HydraConfig.instance(), "cfg", config):  # which names what was typed
        build_run(config)
    return config


def some_of(jobs, seen):
    """Jobs that have, together, every override that occurs and was not seen before."""
    kept = []
    for job in jobs[::-1]:
        if not seen.issuperset(job):
            seen |= {*job}
            kept.append(job)
    return kept


def test_no_sweep_is_forgotten():
    assert {path.stem for path in (ROOT / "sweeps").glob("*.yaml")} == PAPER.keys() | OTHERS


@pytest.mark.slow
@pytest.mark.parametrize(("sweep", "count"), PAPER.items())
def test_a_sweep_has_its_jobs(sweep, count):
    jobs = with_changes(sweep)
    assert len(jobs) == len({tuple(job) for job in jobs}) == count
    config = job_of(sweep, *jobs[-1])
    assert config.absent == "skip"
    assert config.run.startswith(f"runs/paper/{config.data.scene}/")


@pytest.mark.slow
def test_every_scene_and_choice_composes_and_has_a_folder_of_its_own():
    seen = set()
    for sweep in (*PAPER, "effects"):
        jobs = some_of(with_changes(sweep), seen)
        assert len({hashed(job_of(sweep, *job)).run for job in jobs}) == len(jobs), sweep


@pytest.mark.slow
def test_effects_are_compared_with_the_preset_with_all_and_with_none():
    jobs = jobs_of("effects")
    assert len(jobs) == 24
    auto, base, every, none = (job_of("effects", *job) for job in jobs if "scene=specimen_still" in job)
    folders = [config.run.split("-")[1] for config in (auto, base, every, none)]
    assert folders == ["auto", "base", "all_effects", "no_effects"]
    assert (auto.effects, base.effects) == ("auto", "given")
    assert None not in [every.model[name] for name in NAMES]
    assert {none.model[name] for name in NAMES} == {None}
    particles = job_of("effects", "model=particles", "ablation=all_effects_particles", "scene=specimen_still")
    assert None not in [particles.model[effect.name] for effect in EFFECTS]


@pytest.mark.slow
def test_seeds_repeat_every_job():
    once, thrice = ({tuple(sorted(job)) for job in jobs_of("nhr", f"seeds={n}")} for n in (1, 3))
    again = [{tuple(word.replace("seed=0", f"seed={n}") for word in job) for job in once} for n in range(3)]
    assert set.union(*again) == thrice
    assert len(thrice) == 3 * len(once)


@pytest.mark.slow
def test_a_typed_scene_takes_the_place_of_those_of_a_sweep(ok, in_tmp):
    words = ["sweeps=minutes", "paths.scenes=nowhere", "score=null"]
    for typed, scenes in (
        (["dataset=dnerf", "data.scene=hook,lego"], ["dnerf/hook", "dnerf/lego"]),
        (["data.scene=broom2"], ["dnerf/broom2", "hypernerf/broom2"]),  # in the sweep's datasets
    ):
        said = ok("train", "--multirun", *words, *typed).out.splitlines()
        skipped = [line for line in said if line.startswith("skipped: ")]
        expected = [f"{scene}: no such scene" for scene in scenes]
        assert [line.split("nowhere/")[1] for line in skipped] == expected


@pytest.mark.slow
@pytest.mark.parametrize("method", CHANGES)
def test_changes_compose_and_have_folders_of_their_own(method):
    common, changes = ["experiment=dnerf", "data.scene=x"], CHANGES[method][::40]
    found = changed(jobs_of(f"price_list_{method}"), changes)
    words = ([word for part in job for word in shlex.split(part)] for job in found)
    jobs = [job_of(f"price_list_{method}", *common, *job) for job in words]
    assert len({hashed(job).run for job in jobs}) == len(changes)
    assert {(job.budget.minutes, job.data.held_out) for job in jobs} == {(3, 8)}
    assert jobs[0].model.name == method


def together(changes):
    """Group changes, each a list of words, so that those of a group set no key to two values.

    Of whole options each stays alone.
    """
    groups = []
    for words in map(shlex.split, changes):
        whole = any(key_of(word) in ("model", "preset", "stage.coarse") for word in words)
        values = {key_of(word): word for word in words}
        for group, known in groups:
            if not whole and known and all(known.get(key, word) == word for key, word in values.items()):
                group.append(words)
                known |= values
                break
        else:
            groups.append(([words], {} if whole else values))
    return [group for group, _ in groups]


@pytest.mark.slow
@pytest.mark.parametrize("method", CHANGES)
def test_every_change_composes_and_changes_something(method):
    sweep = f"price_list_{method}"
    (job,) = jobs_of(sweep)
    base = job_of(sweep, *HOOK, *job)
    for group in together(CHANGES[method][1:]):
        config = job_of(sweep, *HOOK, *merged(job, list(dict.fromkeys(chain(*group)))))
        for words in group:
            keys = [key_of(word) for word in words]
            changed_keys = [k for k in keys if OmegaConf.select(config, k) != OmegaConf.select(base, k)]
            assert changed_keys or any("." not in key for key in keys), words


@pytest.mark.slow
@pytest.mark.parametrize(("method", "count"), COUNTS.items())
def test_the_price_list_changes_one_thing_at_a_time(method, count):
    changes = CHANGES[method]
    assert changes[0] == ""
    assert len({frozenset(change.split()) for change in changes}) == len(changes) == count
    jobs = changed(jobs_of(f"price_list_{method}", "seeds=2"), changes)
    assert len(jobs) == 2 * count
    assert [job[-1] for job in jobs[2:4]] == [changes[1], changes[1]]
    assert [job[:2] for job in jobs[2:4]] == [[f"seed={seed}", "budget.minutes=3"] for seed in (0, 1)]


def test_a_job_is_named_by_what_was_typed_but_not_by_how_it_runs():
    scene = ["data=dnerf", "data.root=nowhere", "data.scene=x", "seed=3", "budget.minutes=2"]
    how = ["checkpoint_seconds=9", "score=ssim", "evaluate=false", "sentinel.skip=1", "trust=[x]"]
    how += [f"callbacks{word}" for word in (".pictures=null", ".accuracy=null")]
    how += ["absent=skip", "data_changed=accept"]
    words = ["model/motion=cosines", "stage.fine.density=45"]
    command = shlex.join(["forewarp-train", "sweeps=price_list_particles", *scene, *how, *words])
    assert list(settings.typed(command).values()) == words


@pytest.mark.slow
def test_an_ablation_takes_one_thing_from_all():
    def ablated(name):
        return composed(*HOOK, "preset=fast", f"ablation={name}")

    full = ablated("full")
    parts = {"no_upsampling": "upsampler", "no_inpainter": "inpainter", "no_view": "view_dependence"}
    for name, part in parts.items():
        model = ablated(name).model
        assert [key for key in full.model if full.model[key] != model[key]] == [part]
        assert model[part] is None is not full.model[part]
    for name, terms in {"no_tv": ["tv_density", "tv_flow", "tv_depth"], "no_flow": ["flow_l1"]}.items():
        weights, before = ablated(name).objective.fine.weights, full.objective.fine.weights
        assert [term for term in before if before[term] != weights[term]] == terms
        assert all(weights[term] == 0 for term in terms)
    assert ablated("canonical_middle").data.canonical == "middle"


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["demo", "fast", "faithful", "compact"])
def test_the_whole_method_has_the_papers_weights_and_networks_in_the_fine_stage(preset):
    tv_flow = 2.1e-4 if preset == "demo" else 1e-3
    config = composed(*HOOK, f"preset={preset}", "ablation=full")
    networks = {"upsampler", "inpainter"}
    assert networks.isdisjoint(config.stage.coarse.effects)
    assert networks <= set(config.stage.fine.effects)
    weights = config.objective.fine.weights
    assert (weights.tv_depth, weights.inpaint_diff, weights.tv_flow) == (1e-1, 1e-5, tv_flow)


def folder_of(config, **changes):
    """The folder of a job whose config was changed at these keys (dots written as __)."""
    config = deepcopy(config)
    for key, value in changes.items():
        OmegaConf.update(config, key.replace("__", "."), value)
    return hashed(config).run


@pytest.mark.slow
def test_a_job_is_known_by_what_it_computes():
    sweeps = "losses", "modules"
    job, other = (composed(f"sweeps=ablation_{sweep}", *HOOK, "ablation=full") for sweep in sweeps)
    same = folder_of(job)
    assert same == folder_of(other)
    assert "{hash}" not in same
    others = [{"seed": 1}, {"budget__minutes": 3}, {"data__rays": 7}, {"stage__fine__share": 0.1}]
    others += [{"trainer__precision": "bf16-mixed"}, {"threads": 1}]
    assert len({same, *(folder_of(job, **changes) for changes in others)}) == 1 + len(others)
    assert folder_of(job, sheets=1, trainer__accelerator="cpu") == same
    steps = {"budget__minutes": None, "budget__iterations": 5}  # without minutes the machine does not count
    assert folder_of(job, **steps, threads=1) == folder_of(job, **steps)
    folders = [folder_of(job, **steps, trainer__precision=p) for p in (None, "32-true", "bf16-mixed")]
    assert folders[0] == folders[1] != folders[2]
    assert folder_of(composed("data.scene=x", "data=dnerf")) == "runs/x/particles-fast-seed0"


@pytest.mark.slow
def test_what_stands_alone_begins_as_the_coarse_stage_would():
    full, alone = (composed(*HOOK, "preset=fast", f"ablation={name}").stage for name in ("full", "no_coarse"))
    assert alone.coarse is None
    changed = {key for key in full.fine if full.fine[key] != alone.fine[key]}
    assert changed <= {"start", "lr_hold", "bases", "hull_frames", "hull_grow", "confine", "curriculum", "lr"}
    assert all(alone.fine[key] == full.coarse[key] for key in changed - {"lr"})
    assert alone.fine.lr == {**full.fine.lr, "flow": full.coarse.lr.flow}


@pytest.mark.slow
def test_jobs_of_minutes_have_folders_of_their_own():
    last = sorted(job[-1] for job in jobs_of("minutes"))[-2:]
    assert last == ["data.scene=moving-hand", "data.scene=mutant"]
    assert len(jobs_of("minutes")) == 7
    changes = [[], ["seed=1"], ["budget.minutes=5"], ["model=forward"], ["stage.fine.density=45"]]
    changes += [["data.root=elsewhere"], ["data.half_resolution=false"]]
    jobs = [job_of("minutes", *HOOK, "budget.minutes=1", *words) for words in changes]
    assert len({hashed(job).run for job in jobs}) == len(jobs)
    assert hashed(jobs[0]).run.startswith("runs/minutes/hook/particles-1min-seed0-")
    assert (jobs[0].budget.clock, jobs[0].threads) == ("processor", 1)
