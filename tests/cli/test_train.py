"""From a written scene to its numbers, as one types it: begun, gone on with, and refused."""

import json
import os
import shutil
from importlib.metadata import version

import imageio.v3 as iio
import lightning
import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from forewarp import load
from forewarp.fields.curves import TrajectoryField
from forewarp.methods.particles.model import Particles
from forewarp.methods.voxel.forward import ForwardWarp
from forewarp.runs.session import locked
from forewarp.training.checkpoints import load_handover
from tests.support.commands import TINY
from tests.support.written_scenes import write_dnerf

# A run of one stage and 6 steps, beside ``data.root`` and ``run``.
SHORT = ["budget.iterations=6", "stage.coarse.num_voxels=[[0,800]]", "~stage.fine", "logger=none"]
SHORT += ["callbacks.pictures=null", "evaluate=false"]


@pytest.fixture
def scenes(fitted):
    """The folder with the scene ``vehicle``, 32 x 32 pixels, that the shared run was fitted to."""
    return fitted.parent / "scenes"


@pytest.fixture
def copied(fitted, tmp_path):
    """A copy of the shared run, to be changed."""
    return shutil.copytree(fitted, tmp_path / "copied")


@pytest.fixture
def begun(copied):
    """A copy of the shared run that was interrupted after its last step."""
    (copied / "metrics.json").unlink()
    (copied / "fine" / "done.json").unlink()
    return copied


def arguments(root, run, *more, scene="vehicle"):
    """The command line of the shared run, with further overrides."""
    return ["train", *TINY, f"data.root={root}", f"data.scene={scene}", f"run={run}", *more]


def read(path):
    return json.loads(path.read_text())


def numbers(folder):
    """What metrics.json holds, but for seconds, and the threads, which another test may have set."""
    content = read(folder / "metrics.json")
    content.pop("seconds")
    content["protocol"].pop("threads")
    return content


def test_a_run_leaves_what_it_promises_and_says_so(fitted):
    for name in ("config.yaml", "metrics.json", "per_image.json", "coarse/handover.json", "coarse/last.ckpt"):
        assert (fitted / name).is_file()
    assert f"torch=={version('torch')}" in (fitted / "packages.txt").read_text().split()
    assert (fitted / "fine" / "last.ckpt").is_file()
    assert len(list((fitted / "images").glob("test_*/*.png"))) == 5
    assert len(list((fitted / "images" / "sheets").rglob("*.png"))) == 5
    assert not list(fitted.rglob("*.part"))
    for stage in ("coarse", "fine"):
        assert (fitted / stage / "images" / "100_compare.png").is_file()
    assert len(list((fitted / "tensorboard").glob("events.*"))) == 1
    out, err = (fitted / "said.txt").read_text().split("\n---\n")
    first, second = out.splitlines()[:2]
    assert first == "vehicle: 6 training images (32 x 32) and 5 test images (32 x 32), on the CPU"
    assert second == f"run: {fitted}"
    assert "canonical" in out
    assert "metrics.json" in out
    told = [line.split()[0] for line in err.strip().splitlines()]
    # A slow machine says each more than once. A run so short is doubted.
    assert list(dict.fromkeys(told)) == ["coarse", "fine", "test", "warning:", "likely"]
    assert "likely cause 1: too little training" in err
    assert read(fitted / "metrics.json")["protocol"]["doubts"][0].startswith("training images are reached to")


def test_metrics_have_the_promised_shape(fitted):
    content = read(fitted / "metrics.json")
    whole = {"protocol", "seconds", "clocks", "steps", "peak_memory_bytes", "parameters", "size", "effects"}
    assert set(content) == whole | {"test", "metrics", "flow", "flow_variation", "canonical_shape", "absent"}
    assert content["metrics"]["depth_delta_1.02"]["higher_is_better"]
    assert content["metrics"].keys() == {name for scores in content["test"].values() for name in scores}
    seconds = content["seconds"]
    assert set(seconds) == {"train", "coarse", "fine", "render_per_frame", "render_again_per_frame"}
    assert seconds["train"] == pytest.approx(seconds["coarse"] + seconds["fine"])
    assert list(content["test"]) == ["space", "time", "canonical"]
    for scores in content["test"].values():
        assert 10 < scores["psnr"] < 60
        assert {"ssim", "depth_delta_1.02"} <= set(scores)
    assert {"epe_moving", "epe_still", "motion_mean"} <= set(content["flow"])
    assert (content["parameters"] > 1000, content["peak_memory_bytes"] > 2**26) == (True, True)
    expected = {"scene": "vehicle", "preset": "demo", "seed": 0, "method": "forward", "scored": "warped"}
    assert expected.items() <= content["protocol"].items()
    assert {"device", "threads", "versions", "background", "resolution"} <= set(content["protocol"])


def test_trackers_get_a_name_for_each_thing(fitted):
    content = read(fitted / "metrics.json")
    events = EventAccumulator(str(fitted / "tensorboard"))
    events.Reload()
    last = {name: events.Scalars(name)[-1] for name in events.Tags()["scalars"]}
    expected = {f"test/{kind}/{name}": v for kind, of in content["test"].items() for name, v in of.items()}
    expected |= {"test/flow/epe_moving": content["flow"]["epe_moving"]}
    stages = [read(fitted / stage / "done.json") for stage in ("coarse", "fine")]
    assert all(
        stage["code"]["forewarp"] and {"torch", "numpy", "python"} <= set(stage["versions"])
        for stage in stages
    )
    spent = {clock: sum(stage["clocks"][clock] for stage in stages) for clock in ("wall", "processor")}
    expected |= {f"test/seconds_training_{clock}": seconds for clock, seconds in spent.items()}
    per_image = [image["seconds"] for image in read(fitted / "per_image.json")["images"]]
    expected |= {"test/seconds_image_wall": sum(per_image) / len(per_image)}
    expected |= {"test/peak_memory_process_bytes": max(stage["peak_memory_bytes"] for stage in stages)}
    expected |= {"test/parameters": content["parameters"]}
    found = {name: point.value for name, point in last.items() if name.startswith("test/")}
    assert found == pytest.approx(expected, rel=1e-6)
    assert {last[name].step for name in expected} == {sum(content["steps"].values())}
    named = {name.split("/")[0] for name in last}
    assert named == {"train", "lr", "grad_norm", "val", "curve", "test"}
    groups = [
        {name.split("/")[1] for name in last if name.startswith(kind)} for kind in ("lr/", "grad_norm/")
    ]
    assert groups[0] == groups[1] >= {"density", "color", "flow"}
    (text,) = events.Tensors("config/text_summary")
    logged, stored = text.tensor_proto.string_val[0].decode(), (fitted / "config.yaml").read_text()
    assert "fine:" in logged
    assert [str(fitted.parent) in one for one in (stored, logged)] == [True, False]
    (film,) = events.Images("film/test")
    assert (film.step, film.width, film.height) == (sum(content["steps"].values()), 32, 32)
    assert film.encoded_image_string == (fitted / "videos" / "test.gif").read_bytes()
    assert 4 <= len(iio.imread(film.encoded_image_string, extension=".gif")) <= 30


@pytest.mark.slow
def test_evaluating_again_gives_the_same_numbers_or_others(ok, fitted, copied, scenes, tmp_path):
    moved = shutil.copytree(scenes, tmp_path / "moved")
    done = ok("evaluate", f"run={copied}", f"data.root={moved}")
    assert "canonical" in done.out
    assert numbers(copied) == numbers(fitted)
    path = copied / "fine" / "done.json"
    trained_by = {"code": {"forewarp": {"commit": "0123abcde"}}}  # not what measures it
    path.write_text(json.dumps(read(path) | trained_by))
    ok("evaluate", f"run={copied}", f"data.root={moved}", "reduce=2", "eval_background=black")
    protocol = read(copied / "metrics.json")["protocol"]
    assert (protocol["reduced"], protocol["commit"]) == (2, "0123abcde")
    assert protocol["background"] == "black"
    assert numbers(copied)["test"] != numbers(fitted)["test"]


@pytest.mark.slow
def test_the_same_command_again_trains_nothing(ok, fitted, scenes, monkeypatch):
    monkeypatch.setattr(lightning.Trainer, "fit", lambda *_, **__: pytest.fail("trained again"))
    before, config = numbers(fitted), (fitted / "config.yaml").read_text()
    done = ok(*arguments(scenes, fitted), "threads=2")
    assert numbers(fitted) == before
    assert (fitted / "config.yaml").read_text() == config  # its numbers are not of two threads
    assert done.out.startswith(f"measured before: {fitted}; again with\n  forewarp-evaluate run={fitted}\n")


@pytest.mark.slow
def test_a_begun_run_is_finished_and_measured_and_what_does_not_matter_may_change(ok, fitted, begun, scenes):
    done = ok(*arguments(scenes, begun, "checkpoint_seconds=5"))
    lines = done.out.splitlines()
    assert lines[2] == "coarse: finished before"
    assert lines[3].startswith("fine: resuming at 100%, step ")
    assert numbers(begun)["test"] == numbers(fitted)["test"]
    assert yaml.safe_load((begun / "config.yaml").read_text())["checkpoint_seconds"] == 5


@pytest.mark.slow
def test_a_run_is_resumed_by_its_folder_with_what_may_change(ok, refused, begun):
    before = yaml.safe_load((begun / "config.yaml").read_text())
    ok("train", f"resume={begun}", "threads=2", "sentinel.skip=3", "trainer=cpu", "evaluate=false")
    after = yaml.safe_load((begun / "config.yaml").read_text())
    assert after == before | {"threads": 2, "sentinel": {"skip": 3}, "evaluate": False, "run": str(begun)}
    assert after["command"].startswith("forewarp-train model=forward data=dnerf ")
    line = refused("train", f"resume={begun}", "seed=3")
    assert line.startswith("seed: expected no such key beside resume=, whose config.yaml holds it, but got")


@pytest.mark.slow
def test_changed_data_are_refused_unless_accepted(ok, refused, begun, scenes, tmp_path):
    moved = shutil.copytree(scenes, tmp_path / "moved")
    path, config = moved / "vehicle" / "transforms_train.json", begun / "config.yaml"
    path.write_text(path.read_text() + " ")
    config.write_text(config.read_text().replace(str(scenes), str(moved)))
    words = ["train", f"resume={begun}", "evaluate=false"]
    line = refused(*words)
    assert "data.json: expected the data that the run was begun with, but got others" in line
    assert "transforms_train.json; use run=..., or go on with data_changed=accept" in line
    ok(*words, "data_changed=accept")
    ok(*words)  # it was accepted once for all
    path.write_text(path.read_text() + " ")
    assert "expected the data" in refused(*words)  # and not what comes later


@pytest.mark.slow
def test_a_folder_in_work_is_refused(refused, copied):
    with locked(copied):
        line = refused("train", f"resume={copied}")  # measured before
        assert f"expected a run that nobody works on, but got one of process {os.getpid()} on " in line
        (copied / "metrics.json").unlink()
        for name in ("train", "evaluate"):
            assert "nobody works on" in refused(name, str(copied))


@pytest.mark.slow
def test_a_run_with_views_set_aside_leaves_its_curve(ok, scenes, tmp_path):
    run = tmp_path / "run"
    done = ok(*arguments(scenes, run, *SHORT, "data.held_out=2", "callbacks.accuracy.first=0.001"))
    assert len((run / "accuracy_time.csv").read_text().splitlines()) > 1
    assert (run / "accuracy_time.png").stat().st_size > 1000
    assert f"fitted: {run}; measure it with\n  forewarp-evaluate run={run}\n" in done.out


@pytest.mark.slow
def test_renderings_of_an_inpainter_are_both_scored(ok, scenes, tmp_path):
    more = ["model/inpainter=unet3d", "model/upsampler=trilinear", "budget.iterations=2"]
    ok(*arguments(scenes, tmp_path / "run", *SHORT, *more, "evaluate=true", "sheets=0", "views=2"))
    content = read(tmp_path / "run" / "metrics.json")
    assert content["protocol"]["renderings"] == ["upsampled", "inpainted"]
    assert list(content["test"]) == list(content["test_upsampled"])
    assert set(content["seconds"]) == {"train", "coarse", "render_per_frame", "render_again_per_frame"}


@pytest.mark.slow
def test_another_configuration_is_refused(refused, fitted, scenes):
    line, _, advice = refused(*arguments(scenes, fitted, "seed=1")).partition("; ")
    assert line.endswith("seed: expected 0, as the run that this folder holds, but got 1 (and 1 more keys)")
    assert advice == "use run=<another folder>, or delete this one"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("trainer=gpu", "trainer.accelerator: expected a GPU, but found none; use trainer=cpu"),
        ("reduce=7", "reduce: expected pictures with sides that 7 divides, but got "),
        ("views=0", "views: expected a whole number of at least 1, but got 0"),
        ("data.scene=lorry", "but got none; scenes in {root}: vehicle"),
        ("data.scene=tiny", "train/r_1.png: expected a whole image, but got a truncated or harmed one"),
    ],
)
def test_what_cannot_be_trained_makes_no_folder(refused, scenes, in_tmp, monkeypatch, word, says):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    root = scenes
    if word == "data.scene=tiny":
        root = in_tmp
        write_dnerf(root / "tiny")
        image = root / "tiny" / "train" / "r_1.png"
        image.write_bytes(image.read_bytes()[:-9])
    assert says.format(root=root) in refused(*arguments(root, "run"), word)
    assert not (in_tmp / "run").exists()


@pytest.mark.slow
def test_a_broken_step_ends_in_one_line_and_is_stored(refused, scenes, in_tmp):
    line = refused(*arguments(scenes, "run", *SHORT, "stage.coarse.lr.color=1e39"))
    assert line.startswith("stage.coarse: expected finite numbers, but got parameter: radiance.color at step")
    assert "; its batch and weights are in run/coarse/broken/step_1.pt; begin anew with lower" in line
    stored = torch.load(in_tmp / "run" / "coarse" / "broken" / "step_1.pt", weights_only=True)
    assert stored["found"] == "parameter: radiance.color"


@pytest.mark.slow
def test_skipped_steps_are_told(ok, scenes, in_tmp, monkeypatch):
    from forewarp.data.batches import Sampler

    draw, drawn = Sampler.draw, []

    def spoiled(self):
        batch = draw(self)
        drawn.append(batch)
        if len(drawn) == 2:
            batch.observations[0].rgb[0] = float("nan")
        return batch

    monkeypatch.setattr(Sampler, "draw", spoiled)
    done = ok(*arguments(scenes, "run", *SHORT, "sentinel.skip=1"))
    assert "coarse: 1 broken steps skipped; each lies in run/coarse/broken" in done.out


@pytest.mark.slow
def test_particles_begin_where_voxels_found_matter(ok, refused, scenes, in_tmp, monkeypatch):
    for start in ("hull_surface", "swept", "anywhere"):
        fail = lambda *_: pytest.fail("they began somewhere else")  # noqa: E731
        monkeypatch.setattr(f"forewarp.methods.particles.start.{start}", fail)
    words = ["train", "data=dnerf", f"data.root={scenes}", "data.scene=vehicle", "trainer=cpu", "threads=1"]
    words += ["logger=none", "run=run", "sheets=0", "evaluate=false", "stage=particles_after_forward"]
    words += ["stage.coarse.num_voxels=[[0,800]]", "stage.coarse.start_alpha=0.5"]
    words += ["budget.minutes=null", "budget.iterations=6"]
    assert "expected a number, as the method is trained on single rays" in refused(*words)
    ok(*words, "preset.rays=64")
    assert len(load_handover(in_tmp / "run" / "coarse").cloud) >= 16
    assert isinstance(load(in_tmp / "run").method, Particles)
    line = refused(*words, "preset.rays=64", "model/radiance=mlp")
    assert "model/radiance: expected an option of model=particles" in line  # of the run as ever


@pytest.mark.slow
def test_voxels_begin_with_the_motion_of_particles(ok, scenes, in_tmp, monkeypatch):
    took, fit = [], TrajectoryField.fit
    monkeypatch.setattr(TrajectoryField, "fit", lambda own, *known: took.append(known[0]) or fit(own, *known))
    words = ["train", "model=forward", "start_motion=particles", "data=dnerf", f"data.root={scenes}"]
    words += ["data.scene=vehicle", "trainer=cpu", "threads=1", "logger=none", "run=run", "sheets=0"]
    words += ["evaluate=false", "stage.fine.num_voxels=[[0,800]]", "preset.nodes=12", "preset.rays=64"]
    ok(*words, "budget.minutes=null", "budget.iterations=6")
    assert [type(paths.__self__) for paths in took] == [Particles]
    method = load(in_tmp / "run").method
    assert isinstance(method, ForwardWarp)
    assert method.motion.trajectory.learned.lattice == method.motion.trajectory.lattice


@pytest.mark.slow
def test_paths_and_names_are_taken_as_typed(fitted, in_tmp, ok):
    root, name = in_tmp / "josé + familie", "Größe [2], it's (1)"
    shutil.copytree(fitted.parent / "scenes" / "vehicle", root / name)
    words = [*(word for word in TINY if not word.startswith(("stage.fine", "data.scene", "budget"))), *SHORT]
    ok("train", *words, f"data.root={root}", f"data.scene={name}", f"run={root}/läufe/{name}")
    ok("train", f"resume={root}/läufe/{name}", "evaluate=false")
    ok("evaluate", f"run={root}/läufe/{name}", f"data.root={root}", "views=1", "sheets=0")
    assert (root / "läufe" / name / "metrics.json").is_file()


@pytest.mark.slow
def test_plan_only_says_what_a_run_costs_and_writes_nothing(ok, scenes, in_tmp):
    done = ok(*arguments(scenes, "run", "plan_only=true"))
    first, *_, last = done.out.splitlines()
    assert (first, last) == ("1 job", "  run: run")
    assert not [*in_tmp.iterdir()]
