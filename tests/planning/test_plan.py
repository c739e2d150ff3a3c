"""From a scene to its plan, and from the plan to a run."""

import json

import pytest
import yaml
from omegaconf import OmegaConf

from forewarp import clock
from forewarp.data.module import SceneDataModule
from forewarp.methods.particles.model import Particles
from forewarp.methods.voxel.forward import ForwardWarp
from forewarp.planning import plan as planning
from forewarp.planning.plan import refuse
from forewarp.planning.plan_file import read_plan, with_plan, write_plan
from forewarp.runs.build import build_run
from forewarp.runs.config import plain
from forewarp.synth.scenes import synthesize

TINY = ["data=dnerf", "preset=demo", "trainer=cpu", "logger=none"]
TINY += ["callbacks.pictures=null", "callbacks.accuracy=null", "callbacks.scalars=null", "threads=1"]
VOXELS = [
    "model=forward",
    "data.rays=64",
    "stage.coarse.num_voxels=[[0,800]]",
    "stage.fine.num_voxels=[[0,1000]]",
]


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
@pytest.mark.parametrize("model", [["model=particles"], VOXELS])
def test_a_plan_is_made_once_told_and_fitted(forewarp, ok, scenes, monkeypatch, in_tmp, model):
    kept = SceneDataModule.targets

    def guarded(self, split):
        assert split != "test", "a plan looked at test views"
        return kept(self, split)

    typed = [*model, *TINY, f"data.root={scenes}", "data.scene=vehicle"]
    with monkeypatch.context() as patch:
        patch.setattr(SceneDataModule, "targets", guarded)
        done = forewarp("plan", *typed)
    assert done.status == 0, done.err
    (file,) = in_tmp.glob("runs/vehicle/plan-*/plan.yaml")
    assert f"forewarp-train plan={file.relative_to(in_tmp)}" in done.out
    made = yaml.safe_load(file.read_text())
    assert (made["effects"]["motion"]["on"], made["effects"]["background"]["on"]) == (True, model != VOXELS)
    for effect, decision in made["effects"].items():
        assert effect in done.out
        assert decision["because"]
    assert made["evidence"].keys() == {"pictures"}  # what moves needs no fit
    assert made["evidence"]["pictures"]["times"] == 16
    assert "planned before, in" in forewarp("plan", *typed).out

    short = ["budget.iterations=4", "budget.minutes=null", "evaluate=false"]
    ok("train", f"plan={file}", *short, "model/view_dependence=none")
    (fit,) = (path.parents[1] for path in in_tmp.glob("runs/vehicle/planned-*/fine/done.json"))
    config = yaml.safe_load((fit / "config.yaml").read_text())
    assert config["model"]["view_dependence"] is None  # what is typed wins
    assert config["model"]["motion"] is not None
    assert (fit / "plan.yaml").read_text() == file.read_text()


@pytest.fixture(scope="module")
def stills(tmp_path_factory):
    """A folder with the scene ``still``, 40 images of 24 x 24 pixels in which nothing moves."""
    root = tmp_path_factory.mktemp("stills")
    sizes = {"size": 24, "frames": 40, "test_views": (1, 1, 0), "val_views": 0, "samples_per_pixel": 1}
    synthesize(root / "still", motion="still", **sizes)
    return root


@pytest.fixture
def made(forewarp, stills, in_tmp):
    """Plan the scene that stands still; returns ``plan.yaml`` and what was printed."""

    def plan(name, *typed):
        scene = [f"data.root={stills}", "data.scene=still", f"plan.folder={name}"]
        done = forewarp("plan", *TINY, *scene, *typed)
        assert done.status == 0, done.err
        return yaml.safe_load((in_tmp / name / "plan.yaml").read_text()), done.out

    return plan


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "model", "steps"),
    [(Particles, ["model=particles"], 30), pytest.param(ForwardWarp, VOXELS, 10, marks=pytest.mark.slow)],
)
def test_a_plan_depends_neither_on_the_budget_nor_on_the_clock(made, monkeypatch, method, model, steps):
    monkeypatch.setattr(method, "still_steps", steps)
    plan, printed = made("slow", *model, "budget.minutes=5")
    assert plan["fit"]["steps"] == steps
    assert plan["fit"]["share"] == pytest.approx(plan["fit"]["seconds"] / 300, abs=1e-3)  # both are rounded
    assert f"for {steps} steps of a still fit: " in " ".join(printed.split())
    monkeypatch.setitem(clock.KINDS, "wall", lambda read=clock.KINDS["wall"]: 100 * read())
    for number, budget in enumerate((["minutes=0.001"], ["minutes=null", "iterations=4"])):
        hasty, printed = made(f"fast{number}", *model, *(f"budget.{word}" for word in budget))
        assert hasty["fit"]["steps"] == steps
        assert hasty["fit"]["share"] > 1
        assert "% of the budget, on top of it" in " ".join(printed.split())
        for key in ("overrides", "effects", "evidence"):
            assert hasty[key] == plan[key], key


@pytest.mark.slow
def test_a_run_with_a_target_is_planned_by_a_still_fit_without(forewarp, stills, in_tmp, monkeypatch):
    targets = []
    monkeypatch.setattr(planning, "build_run", lambda c: targets.append(plain(c.target)) or build_run(c))
    monkeypatch.setattr(Particles, "still_steps", 2)
    typed = [word for word in TINY if "accuracy" not in word] + [f"data.root={stills}", "data.scene=still"]
    done = forewarp("plan", "model=particles", *typed, "target.psnr=60")
    assert (done.status, targets) == (0, [{"psnr": 60, "plateau": None}, None]), done.err


@pytest.mark.slow
def test_what_is_typed_changes_no_evidence(made, monkeypatch):
    monkeypatch.setattr(Particles, "still_steps", 20)
    plan, _ = made("auto", "model=particles")
    moving, _ = made("typed", "model=particles", "model/motion=cosines", "model.view_dependence=2")
    assert moving["evidence"] == plan["evidence"]
    assert moving["effects"]["motion"]["choice"] == "cosines"
    every = [f"model/{name}=none" for name in plan["effects"]]
    assert "fit" not in made("all", "model=particles", *every)[0]  # nothing is left to decide


@pytest.mark.slow
def test_a_method_that_names_no_steps_keeps_its_preset(made, monkeypatch):
    monkeypatch.setattr(Particles, "still_steps", None)
    plan, printed = made("none", "model=particles")
    assert "fit" not in plan
    assert "still fit" not in printed.partition("\n")[0]
    motion = plan["effects"]["motion"]
    assert motion["on"]
    assert motion["because"].endswith("the method names no steps of a still fit, so it is left on")


@pytest.mark.slow
def test_auto_fits_a_scene_that_stands_still_without_what_it_does_not_call_for(forewarp, ok, in_tmp, stills):
    short = ["budget.iterations=30", "budget.minutes=null", "evaluate=false", "run=still"]
    typed = ["model=particles", *TINY, f"data.root={stills}", "data.scene=still", *short]
    ok("train", *typed, "effects=auto")
    made = yaml.safe_load((in_tmp / "still" / "plan.yaml").read_text())
    assert made["evidence"]["residual"].keys() == {"by_time", "by_direction"}
    fitted = [
        json.loads(path.read_text())["seconds"] for path in in_tmp.glob("runs/still/plan-*/still/*/done.json")
    ]
    assert made["seconds"] >= made["fit"]["seconds"] == round(sum(fitted), 1) > 0
    assert not any(made["effects"][name]["on"] for name in ("motion", "rotation", "background"))
    assert yaml.safe_load((in_tmp / "still" / "config.yaml").read_text())["model"]["motion"] is None
    assert {path.name for path in in_tmp.glob("runs/still/plan-*/*")} == {"still", "plan.yaml"}
    assert "fine: finished before" in forewarp("train", *typed, "effects=auto").out


@pytest.fixture(scope="module")
def specimens(tmp_path_factory):
    """A folder to write procedural scenes into, on first use."""
    return tmp_path_factory.mktemp("specimens")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "scene", "wanted"),
    [
        ("particles", "daylight", {"motion", "color_over_time", "view_dependence"}),
        ("particles", "still", set()),
        ("particles", "glossy", {"view_dependence"}),
        ("forward", "daylight", {"motion"}),
        ("forward", "still", set()),
    ],
)
def test_specimens_get_what_they_call_for(ok, specimens, in_tmp, model, scene, wanted):
    """However short the budget, and although no silhouettes of theirs disagree."""
    typed = [f"model={model}", f"scene=specimen_{scene}", f"paths.data={specimens}", "threads=1"]
    ok("plan", *typed, "trainer=cpu", "budget.minutes=0.01", "plan.folder=plan")
    effects = yaml.safe_load((in_tmp / "plan" / "plan.yaml").read_text())["effects"]
    judged = {"particles": {"motion", "color_over_time", "view_dependence"}, "forward": {"motion"}}[model]
    assert {name for name in judged if effects[name]["on"]} == wanted & judged


@pytest.mark.slow
def test_a_sweep_plans_the_method_of_its_file(ok, scenes, in_tmp):
    scene = [*TINY, f"data.root={scenes}", "data.scene=vehicle", "hydra.sweeper.scenes=['seed=1']"]
    short = [*VOXELS[1:], "budget.iterations=4", "budget.minutes=null", "evaluate=false"]
    ok("train", "--multirun", "sweeps=effects", "ablation=auto", *scene, *short)
    (file,) = in_tmp.glob("runs/vehicle/plan-*/plan.yaml")
    made = yaml.safe_load(file.read_text())
    assert (made["overrides"][0], made["effects"]["motion"]["choice"]) == ("model=forward", "dct")


@pytest.mark.slow
def test_whole_images_get_the_effects_of_whole_images(ok, scenes, in_tmp, monkeypatch):
    monkeypatch.setattr("forewarp.methods.effect.CUT_OUT", 2.0)
    typed = ["model=forward", *TINY, f"data.root={scenes}", "data.scene=vehicle"]
    ok("plan", *typed)
    (file,) = in_tmp.glob("runs/vehicle/plan-*/plan.yaml")
    made = yaml.safe_load(file.read_text())
    assert "capture=video" in made["overrides"]
    assert made["effects"]["background"] == {
        "choice": "grid",
        "on": True,
        "because": made["effects"]["background"]["because"],
    }
    ok("plan", *typed, "capture=cut_out", "plan.folder=typed")
    assert not yaml.safe_load((in_tmp / "typed" / "plan.yaml").read_text())["effects"]["background"]["on"]


@pytest.mark.slow
def test_mistakes_are_one_line(refused, words, in_tmp):
    assert "use model=particles, model=forward or" in refused("plan", "model=tnerf", *words[len(VOXELS) :])
    assert refused("train", *words, "effects=some") == "effects: expected given or auto, but got 'some'"
    assert not (in_tmp / "runs").exists()


@pytest.mark.parametrize(
    ("resume", "typed", "said"),
    [
        (None, ["~seed"], "~seed: expected overrides that set a key, as a plan keeps them; use seed=null"),
        ("runs/x", [], "resume: expected nothing where a run is planned"),
    ],
)
def test_what_cannot_be_planned_is_refused_by_its_key(resume, typed, said):
    with pytest.raises(ValueError, match=f"^{said}"):
        refuse(OmegaConf.create({"resume": resume}), typed)
    refuse(OmegaConf.create({"resume": None}), [])


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


@pytest.mark.parametrize(
    "word",
    [
        *("++preset.note=${oc.env:HOME}", r"++preset.note=$\{oc.env:HOME\}", "++preset.note='${a}'"),
        *("++preset.note=[{a: ${oc.env:HOME}}]", "paths.runs=/elsewhere", "paths.runs='/else where'"),
    ],
)
def test_a_plan_reads_no_environment_and_writes_nowhere_else(tmp_path, word):
    write_plan(tmp_path / "plan.yaml", {"typed": ["data.scene=x"], "overrides": [word], "of": "0"})
    with pytest.raises(ValueError, match="expected overrides that a plan has.* type it beside plan="):
        read_plan(tmp_path / "plan.yaml")
    assert read_plan(tmp_path / "plan.yaml", typed=[word])["overrides"] == [word]


def test_a_plan_may_say_that_runs_lie_where_it_does(tmp_path):
    word = f"paths.runs={tmp_path}"
    write_plan(tmp_path / "x" / "plan.yaml", {"typed": ["data.scene=x", word], "overrides": [], "of": "0"})
    assert word in read_plan(tmp_path / "x" / "plan.yaml")["typed"]


@pytest.mark.slow
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
        with pytest.raises(ValueError, match=f"{word}: expected none beside plan="):
            with_plan("train", [f"plan={file}", word])
    assert with_plan("train", [f"plan={file}", "model=forward"])[-1] == "model=forward"
    assert with_plan("plan", ["plan.folder=x"]) == ["plan.folder=x"]
