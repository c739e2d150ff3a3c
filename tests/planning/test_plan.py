"""From a scene to its plan, and from the plan to a run."""

import json
import shutil
from types import SimpleNamespace

import pytest
import yaml
from omegaconf import OmegaConf

from forewarp.data.module import SceneDataModule
from forewarp.methods.particles.options import EFFECTS as PARTICLES
from forewarp.methods.particles.options import ParticlesPlanning
from forewarp.planning.plan import Planner, Trial, refuse
from forewarp.planning.plan_file import read_plan, with_plan, write_plan
from forewarp.scene.frame import Survey
from forewarp.synth.scenes import synthesize

TINY = ["data=dnerf", "preset=demo", "trainer=cpu", "logger=none"]
TINY += ["callbacks.pictures=null", "callbacks.accuracy=null", "callbacks.scalars=null", "threads=1"]
VOXELS = [
    "model=forward",
    "data.rays=64",
    "stage.coarse.num_voxels=[[0,800]]",
    "stage.fine.num_voxels=[[0,1000]]",
]
SHORT = ["plan.steps=8", "plan.trial_steps=3", "plan.seeds=1", "plan.held_out=3"]
EFFECTS = ["motion", "bases", "background", "view_dependence", "inpainter", "upsampler"]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A folder with the scene ``vehicle``, 24 x 24 pixels."""
    root = tmp_path_factory.mktemp("scenes")
    synthesize(root / "vehicle", size=24, frames=16, test_views=(1, 1, 0), val_views=0, samples_per_pixel=1)
    return root


@pytest.fixture
def words(scenes, in_tmp):
    """What one types of the tiny scene."""
    return [*VOXELS, *TINY, f"data.root={scenes}", "data.scene=vehicle"]


@pytest.mark.slow
def test_a_plan_is_made_once_told_and_fitted(forewarp, ok, words, monkeypatch, in_tmp):
    kept = SceneDataModule.targets

    def guarded(self, split):
        assert split != "test", "a plan looked at test views"
        return kept(self, split)

    with monkeypatch.context() as patch:
        patch.setattr(SceneDataModule, "targets", guarded)
        done = forewarp("plan", *words, *SHORT)
    assert done.status == 0, done.err
    (file,) = in_tmp.glob("runs/vehicle/plan-*/plan.yaml")
    assert f"forewarp-train plan={file.relative_to(in_tmp)}" in done.out
    made = yaml.safe_load(file.read_text())
    assert [e for e in EFFECTS if e in made["effects"]] == list(made["effects"])
    assert {"motion", "background", "view_dependence", "inpainter", "upsampler"} <= made["effects"].keys()
    for effect, decision in made["effects"].items():
        assert effect in done.out
        assert decision["because"]
        assert any(character.isdigit() for character in decision["because"])
    assert made["evidence"]["pictures"]["times"] == 16
    assert {"motion", "bases"} <= made["evidence"]["trials"].keys()

    again = forewarp("plan", *words, *SHORT)
    assert "coarse" not in again.out.partition("planned before, in")[0]  # what is there is read
    assert "± is two standard errors" in again.out

    short = ["budget.iterations=4", "budget.minutes=null", "evaluate=false", "model/inpainter=none"]
    ok("train", f"plan={file}", *short, "model/view_dependence=mlp")
    (fit,) = (path.parents[1] for path in in_tmp.glob("runs/vehicle/planned-*/fine/done.json"))
    config = yaml.safe_load((fit / "config.yaml").read_text())
    assert config["data"]["scene"] == "vehicle"
    assert config["model"]["view_dependence"]["_target_"].endswith("ViewNetwork")  # what is typed wins
    assert (config["model"]["motion"] is not None) == made["effects"]["motion"]["on"]
    assert (fit / "plan.yaml").read_text() == file.read_text()


def test_what_rests_is_the_mean_of_the_seeds_that_are_tried():
    planner = object.__new__(Planner)
    planner.settings = SimpleNamespace(seeds=3)
    planner.effects = {effect.name: effect for effect in PARTICLES}

    def tried(name, overrides, seed, steps=None, longer=1):
        return Trial((30.0, 31.0), 0.01, 10, 1.0, at_rest=0.2 * (1 + seed) if name == "with" else 0.0)

    planner._tried = tried
    pictures = Survey(frames=9, times=9, cut_out=0.8, spread=160.0, disagreement=0.2)
    for names, rests in ((("with", "without"), 0.4), (("without", "with"), 0.0)):
        planner.evidence = ParticlesPlanning().evidence(pictures, least=0.6)
        planner._try("background", *((name, []) for name in names))
        assert planner.evidence.at_rest == {"background": pytest.approx(rests)}


@pytest.mark.slow
def test_particles_are_planned_by_leaving_effects_out(forewarp, scenes, in_tmp, monkeypatch):
    """One after the other; what is not missed stays out of all later trials."""
    missed = {"motion": True, "rotation": False, "opacity_over_time": True}
    monkeypatch.setattr(
        "forewarp.methods.effect.Evidence.pays", lambda self, effect: missed.get(effect, False)
    )
    typed = [*TINY, f"data.root={scenes}", "data.scene=vehicle"]
    short = ["plan.steps=4", "plan.trial_steps=8", "plan.seeds=1", "plan.held_out=3"]
    done = forewarp("plan", *typed, *short, "model/background=none")
    assert done.status == 0, done.err
    (file,) = in_tmp.glob("runs/vehicle/plan-*/plan.yaml")
    made = yaml.safe_load(file.read_text())
    assert {name for name, decision in made["effects"].items() if decision["on"]} == {
        "motion",
        "opacity_over_time",
    }
    assert made["effects"]["background"]["because"].startswith("as typed; ")
    no = ["fine-no-motion", "fine-no-rotation", "fine-no-rotation-no-opacity_over_time"]
    no += ["fine-no-rotation-no-color_over_time", "fine-no-rotation-no-color_over_time-16"]
    no += ["fine-no-rotation-no-color_over_time-no-view_dependence-16"]
    trials = {path.name.removesuffix("-seed0") for path in file.parent.glob("fine*")}
    assert trials == {"fine", *no}
    last = yaml.safe_load((file.parent / f"{no[-1]}-seed0" / "config.yaml").read_text())["model"]
    assert (last["motion"], last["rotation"], last["opacity_over_time"]) == ("spline", None, 4)
    assert (last["color_over_time"], last["view_dependence"]) == (None, None)

    fitted = forewarp("train", f"plan={file}", "budget.iterations=6", "run=fit", "evaluate=false")
    assert fitted.status == 0, fitted.err
    config = yaml.safe_load((in_tmp / "fit" / "config.yaml").read_text())["model"]
    assert [name for name, choice in config.items() if choice is None] == [
        *("rotation", "view_dependence", "color_over_time", "background")
    ]


@pytest.mark.slow
def test_every_question_is_asked_where_all_is_open(ok, words, in_tmp, monkeypatch):
    """No alpha, and evidence that rules nothing out: each effect is tried, with its price."""
    monkeypatch.setattr("forewarp.methods.effect.CUT_OUT", 2.0)
    monkeypatch.setattr("forewarp.methods.voxel.planning.BY_DIRECTION", (-9.0, 9.0))
    monkeypatch.setattr("forewarp.methods.voxel.planning.TORN", (-1.0, 9.0))
    monkeypatch.setattr("forewarp.methods.voxel.planning.HEADROOM", (99.0, -99.0))
    monkeypatch.setattr(
        "forewarp.methods.effect.Evidence.pays", lambda self, effect: effect in self.gains or None
    )
    fitted, kept = [], Planner._fitted
    monkeypatch.setattr(Planner, "_fitted", lambda self, c, *a: (fitted.append(c.run), kept(self, c, *a))[1])
    ok("plan", *words, *SHORT, "plan.minutes=0.1", "stage.coarse.start_alpha=2e-2")
    assert len(fitted) == len(set(fitted))  # none of them twice
    (file,) = in_tmp.glob("runs/vehicle/plan-*/plan.yaml")
    for trial in file.parent.glob("fine*"):  # a coarse stage is shared, and not fitted again
        shared = trial / "coarse" / "last.ckpt"
        assert any(shared.samefile(one) for one in file.parent.glob("coarse*/coarse/last.ckpt")), trial
    made = yaml.safe_load(file.read_text())
    assert made["evidence"]["trials"].keys() == set(EFFECTS)
    assert all(decision["on"] for decision in made["effects"].values())
    assert "stage.coarse.effects=[motion,background]" in made["overrides"]
    assert "stage.fine.num_voxels=[[0,1000]]" in made["overrides"]
    ok("train", f"plan={file}", "budget.iterations=4", "run=fit", "evaluate=false")
    config = yaml.safe_load((in_tmp / "fit" / "config.yaml").read_text())
    assert config["stage"]["coarse"]["start_alpha"] == 2e-2  # typed before it was planned
    assert None not in [config["model"][e] for e in EFFECTS if e != "bases"]


@pytest.mark.slow
def test_auto_plans_and_fits_in_one_go_a_scene_of_one_time_without_motion(
    forewarp, ok, words, scenes, in_tmp
):
    shutil.copytree(scenes / "vehicle", in_tmp / "scenes" / "vehicle")
    for path in (in_tmp / "scenes" / "vehicle").glob("transforms_*.json"):
        content = json.loads(path.read_text())
        content["frames"] = [frame | {"time": 0.0} for frame in content["frames"]]
        path.write_text(json.dumps(content))
    (in_tmp / "scenes" / "vehicle" / "trajectories.npz").unlink()
    short = ["budget.iterations=8", "budget.minutes=null", "evaluate=false", "run=still"]
    typed = [*words, "data.root=scenes", *SHORT, *short, "plan.trials=false", "model/inpainter=none"]
    ok("train", *typed, "effects=auto")
    made = yaml.safe_load((in_tmp / "still" / "plan.yaml").read_text())
    assert made["effects"]["motion"]["because"].startswith("1 time")
    assert made["effects"]["inpainter"]["because"].startswith("as typed; ")
    assert (made["evidence"]["trials"], "trials" in str(made["overrides"])) == ({}, False)
    assert yaml.safe_load((in_tmp / "still" / "config.yaml").read_text())["model"]["motion"] is None
    assert {path.name for path in in_tmp.glob("runs/vehicle/plan-*/*")} == {"coarse-still", "plan.yaml"}
    assert "fine: finished before" in forewarp("train", *typed, "effects=auto").out


@pytest.mark.slow
def test_mistakes_are_one_line(refused, words, in_tmp):
    assert "use model=particles or model=forward" in refused("plan", *words, "model=backward")
    assert refused("plan", *words, "~stage.fine").startswith("stage: expected a coarse stage and another")
    assert refused("train", *words, "effects=some") == "effects: expected given or auto, but got some"
    assert not (in_tmp / "runs").exists()


NUMBERS = {"seeds": 1, "held_out": 2, "seconds": 9, "trial_seconds": 9}
NUMBERS |= dict.fromkeys(("steps", "trial_steps", "minutes", "least"))


@pytest.mark.parametrize(
    ("changes", "typed", "said"),
    [
        ({"seeds": 0}, [], "plan.seeds: expected a whole number >= 1, but got 0"),
        ({"seeds": None}, [], "plan.seeds: expected a whole number >= 1, but got None"),
        ({"held_out": 1}, [], "plan.held_out: expected a whole number >= 2, but got 1"),
        ({"steps": 0.5}, [], "plan.steps: expected a whole number >= 1, but got 0.5"),
        ({"seconds": None}, [], "plan.seconds: expected a number > 0, but got None"),
        ({"minutes": -1}, [], "plan.minutes: expected a number > 0, but got -1"),
        ({}, ["~seed"], "~seed: expected overrides that set a key, as a plan keeps them; use seed=null"),
        ({"resume": "runs/x"}, [], "resume: expected nothing where a run is planned"),
    ],
)
def test_what_cannot_be_planned_is_refused_by_its_key(changes, typed, said):
    config = {"plan": NUMBERS | changes, "stage": {"coarse": 1, "fine": 1}, "resume": changes.get("resume")}
    with pytest.raises(ValueError, match=f"^{said}"):
        refuse(OmegaConf.create(config), typed)
    refuse(OmegaConf.create(config | {"plan": NUMBERS, "resume": None}), [])


@pytest.mark.parametrize("text", ["", "[]", "overrides: [a=b]", "{", "typed: 3\noverrides: 4", "\0", None])
def test_what_is_no_plan_is_refused(tmp_path, text):
    file = tmp_path / "plan.yaml"
    if text is not None:
        file.write_text(text)
    with pytest.raises(ValueError, match=f"expected a file that forewarp-plan wrote, but got {file}"):
        with_plan("train", [f"plan={file}"])


@pytest.mark.parametrize(
    "word",
    [
        *("hydra/launcher=ray", "hydra.run.dir=/", "trainer._target_=os.system", "~stage.fine", "x", "-x=1"),
        *("experiment=../../evil", "model/view_dependence=../../evil", "scene=/evil", "experiment@x=a/b"),
        *("--config-dir=/", "a.b={_target_:theirs.Tint}"),
    ],
)
def test_a_plan_sets_no_code(tmp_path, word):
    write_plan(tmp_path / "plan.yaml", {"typed": ["data.scene=x"], "overrides": [word], "of": "0"})
    with pytest.raises(ValueError, match="expected overrides that a plan has"):
        read_plan(tmp_path / "plan.yaml", ["theirs"])


def test_what_a_plan_composes_names_no_code_of_others(refused, in_tmp):
    """Whatever words lead there: the config of a planned run is looked at before anything is made of it."""
    mine = in_tmp / "mine" / "experiment"
    mine.mkdir(parents=True)
    evil = "callbacks: {x: {_target_: shutil.copyfile, src: a, dst: b, _partial_: true}}"
    (mine / "evil.yaml").write_text(f"# @package _global_\n{evil}\n")
    file = in_tmp / "plan.yaml"
    write_plan(file, {"typed": ["data.scene=x"], "overrides": ["experiment=evil"], "of": "0"})
    said = refused("train", f"plan={file}", "evaluate=false", f"--config-dir={mine.parent}")
    assert "callbacks.x._target_: expected a class of forewarp, but got 'shutil.copyfile'" in said
    assert not (in_tmp / "runs").exists()


def test_a_plan_names_code_of_trusted_packages_and_never_trust(tmp_path):
    file, word = tmp_path / "plan.yaml", "model.view_dependence._target_=theirs.Tint"
    write_plan(file, {"typed": ["data.scene=x", "trust=[theirs]"], "overrides": [word], "of": "0"})
    with pytest.raises(ValueError, match=r"'theirs.Tint'; if you trust .* theirs, add trust=\[theirs\]"):
        with_plan("train", [f"plan={file}"])
    made = read_plan(file, typed=[word])  # what is typed now needs no trust
    assert (made["typed"], made["overrides"]) == (["data.scene=x"], [word])


def test_what_is_typed_beside_a_plan_wins(tmp_path):
    file = tmp_path / "plan.yaml"
    planned = ["model=forward", "model/view_dependence=sh", "model/inpainter=none", "model/motion=none"]
    planned.append("stage.coarse.bases=[]")
    typed = ["data.scene=x", "seed=3", "model.trajectory.features=2", "stage.coarse.bases=[[0,4]]"]
    write_plan(file, {"typed": typed, "overrides": planned, "of": "0"})
    found = with_plan("train", [f"plan={file}", "model/inpainter=unet3d", "seed=4"])
    assert found == [
        *("model=forward", "model/view_dependence=sh", "model/motion=none", "data.scene=x"),
        "stage.coarse.bases=[[0,4]]",
        *(f"planned='{file}'", "effects=given", "run='${paths.runs}/${data.scene}/planned-{hash}'"),
        *("model/inpainter=unet3d", "seed=4"),
    ]
    assert f"run={tmp_path}" in with_plan("train", [f"plan={file}", f"run={tmp_path}"])
    for word in ("model=backward", "resume=runs/x"):
        with pytest.raises(ValueError, match=f"{word}: expected no such override beside plan="):
            with_plan("train", [f"plan={file}", word])
    assert with_plan("train", [f"plan={file}", "model=forward"])[-1] == "model=forward"
    assert with_plan("plan", ["plan.seeds=1"]) == ["plan.seeds=1"]
