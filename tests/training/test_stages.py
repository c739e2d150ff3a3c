import gc
import json
import os
import resource
import shutil
import signal
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import lightning
import pytest
import torch

from forewarp.fields.curves import TrajectoryField
from forewarp.interrupts import ENDING, signal_of
from forewarp.training import stages as stages_module
from forewarp.training.checkpoints import KeepCheckpoint
from tests.support import tiny_scene as tiny


def stages(**changes):
    """Two stages of 10 steps, of which the second ends by steps for each of its 12 pictures.

    The lattice of the second grows halfway; voxels are refreshed every fourth step.
    """
    common = {"iterations": 10, "refresh_every": 4, "start": "hull", "hull_frames": 3, "hull_grow": 0.1}
    common["background_num_voxels"] = [[0, 8**3]]
    coarse = tiny.stage("coarse", num_voxels=[[0, 10**3]], bases=[[0, 2], [0.5, 4]], **common)
    if "iterations" not in changes:
        changes |= {"iterations": 1000, "steps_per_picture": 10 / 12}
    return [coarse, tiny.stage("fine", num_voxels=[[0, 11**3], [0.5, 14**3]], **(common | changes))]


def run(folder, callbacks=(), plan=None, model=None, **changes):
    """A run of the stages of ``plan``, or of ``stages(**changes)``, over small images."""
    plan = stages(**changes) if plan is None else plan
    return tiny.make_run(
        folder, plan, data=tiny.ball_data(rays=64, size=16), model=model, callbacks=callbacks
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An uninterrupted run: its folder and its last module."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, run(folder).fit()


class Crash(lightning.Callback):
    """Exit without saving when the fine stage begins."""

    def on_train_start(self, trainer, module):
        if module.settings.name == "fine":
            raise SystemExit


@pytest.mark.slow
def test_a_continued_run_equals_an_uninterrupted_one_to_the_bit(tmp_path, whole):
    """Ended at a last step, between stages, and before, while and after the lattice grows."""
    fine = [tiny.Interrupt("fine", step) for step in (3, 5, 7)]
    for interruption in (tiny.Interrupt("coarse", 9), Crash(), *fine):
        with pytest.raises(SystemExit):
            run(tmp_path, [interruption]).fit()
    assert tiny.same(run(tmp_path).fit(), whole[1])


@pytest.mark.slow
def test_a_run_with_learned_nodes_and_rays_near_matter_continues_to_the_bit(tmp_path):
    nodes = tiny.forward_model(trajectory=partial(TrajectoryField, bases=4, nodes=16, kind="nodes"))
    for carry in ("all", "motion"):
        options = {
            "model": nodes,
            "near_share": 0.7,
            "carry": carry,
        }
        straight = run(tmp_path / carry, **options).fit()
        counts = straight.method.motion.trajectory.learned
        assert 0 < len(counts.voxels) < counts.lattice.count
        for interruption in (Crash(), tiny.Interrupt("fine", 3), tiny.Interrupt("fine", 7)):
            with pytest.raises(SystemExit):
                run(tmp_path / f"{carry} in parts", [interruption], **options).fit()
        assert tiny.same(run(tmp_path / f"{carry} in parts", **options).fit(), straight)


@pytest.mark.slow
def test_a_finished_run_is_loaded_and_one_that_was_not_noted_only_noted(tmp_path, whole):
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()}
    assert tiny.same(run(tmp_path, [Crash()]).fit(), whole[1])
    assert tiny.same(run(tmp_path).load(), whole[1])
    assert before == {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file()}
    (tmp_path / "fine" / "done.json").unlink()
    with pytest.raises(ValueError, match="fine: expected a finished stage, but got none; continue with"):
        run(tmp_path).load()
    assert tiny.same(run(tmp_path).fit(), whole[1])
    assert run(tmp_path).finished()["fine"]["steps"] == 10


@pytest.mark.slow
def test_what_a_run_leaves(whole):
    folder, module = whole
    assert {p.name for p in (folder / "fine").iterdir()} >= {"last.ckpt", "handover.json", "done.json"}
    assert not list(folder.rglob("*.part"))
    done = run(folder).finished()
    assert done["coarse"]["steps"] == done["fine"]["steps"] == 10
    assert (done["fine"]["seconds"] > 0, done["fine"]["frames_in_play"]) == (True, 12)
    handover = json.loads((folder / "coarse" / "handover.json").read_text())
    lattice = module.method.radiance.lattice
    assert lattice.box.low == pytest.approx(tuple(handover["low"]))
    assert lattice.count == pytest.approx(14**3, rel=0.3)
    assert module.method.motion.trajectory.bases_in_play == 4


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"voxel": 1}, "unexpected keyword argument 'voxel'"),
        ({"keep_alpha": 2.0}, "stage.fine: expected 0 < birth_alpha < keep_alpha < 1"),
        ({"keep_alpha": None}, "stage.fine: expected 0 < birth_alpha < keep_alpha < 1"),
        ({"curriculum": {"start": 0}}, "stage.fine.curriculum: expected start >= 1, "),
        ({"weights": {"photos": 1.0}}, "objective: expected a term of photo, .*but got 'photos'"),
    ],
)
def test_a_mistake_in_a_later_stage_is_refused_before_anything_is_trained(tmp_path, wrong, text):
    with pytest.raises((TypeError, ValueError), match=text):
        run(tmp_path, plan=[tiny.stage("coarse"), tiny.stage("fine", **wrong)]).fit()
    assert not (tmp_path / "coarse" / "last.ckpt").exists()


def test_an_objective_without_its_class_is_named(tmp_path):
    stage = replace(tiny.stage("fine"), objective={"weights": {}})
    with pytest.raises(
        ValueError, match="stage.fine.objective: expected _target_: forewarp.training.objective"
    ):
        run(tmp_path, plan=[stage]).check()


class Diary(lightning.Callback):
    """Record learning rate, bases, lattice and frames of every step."""

    def __init__(self):
        self.steps = []

    def on_before_optimizer_step(self, trainer, module, optimizer):
        rates = {g["name"]: g["lr"] / g["base_lr"] for g in optimizer.param_groups}
        parameters = {id(p) for g in optimizer.param_groups for p in g["params"]}
        assert parameters == {id(p) for p in module.method.parameters()}
        bases = int(module.method.motion.trajectory.bases_in_play)
        lattice = module.method.radiance.lattice.count
        self.steps.append((module.settings.name, rates["flow"], bases, lattice, module.curriculum.in_play))


@pytest.mark.slow
def test_rates_bases_lattice_and_frames_follow_the_fraction(tmp_path):
    diary = Diary()
    run(tmp_path, [diary], lr_hold=0.5, curriculum={"start": 2, "all_in": 0.5}).fit()
    coarse, fine = ([s[1:] for s in diary.steps if s[0] == name] for name in ("coarse", "fine"))
    assert [bases for _, bases, _, _ in coarse] == [2] * 5 + [4] * 5
    assert len({lattice for _, _, lattice, _ in coarse}) == 1
    rates, _, lattices, playing = zip(*fine)
    assert list(rates) == pytest.approx([1] * 5 + [0.1 ** (k / 5) for k in range(5)])
    assert len(set(lattices[:5])) == len(set(lattices[5:])) == 1
    assert lattices[5] > lattices[4]
    assert playing == (2, 4, 6, 8, 10, 12, 12, 12, 12, 12)


@pytest.mark.slow
def test_times_come_in_by_steps_and_what_a_short_stage_leaves_out_is_told(tmp_path):
    told, diary = [], Diary()
    ours = run(tmp_path, [diary], iterations=10, curriculum={"start": 2, "iterations_per_time": 3})
    ours.tell = told.append
    ours.fit()
    assert [step[-1] for step in diary.steps if step[0] == "fine"] == [2, 2, 2, 3, 3, 3, 4, 4, 4, 5]
    (line,) = told
    assert line.startswith("fine: ended when 5 of 12 training images had come in; for all, set a larger bu")
    assert line.endswith(" or stage.fine.curriculum.iterations_per_time=null")


CLEARED = Path("/proc/self/clear_refs")


@pytest.mark.skipif(not os.access(CLEARED, os.W_OK), reason=f"{CLEARED} cannot be written: not Linux")
def test_the_peak_counts_from_the_reset_without_what_earlier_runs_left(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    gc.collect()
    gc.disable()
    try:
        before = stages_module.peak_memory_bytes()
        circle = [torch.ones(50_000_000)]  # 200 MB, touched
        circle.append(circle)  # freed by the garbage collector alone
        during = stages_module.peak_memory_bytes()
        del circle
        assert during > before + 190e6
        assert stages_module.peak_memory_bytes() > during - 10e6  # the kernel counts in batches of pages
        stages_module.reset_peak_memory()
        assert stages_module.peak_memory_bytes() < during - 150e6
    finally:
        gc.enable()


def test_elsewhere_the_peak_is_that_of_the_process(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(stages_module, "_PROCESS", tmp_path / "nowhere")
    stages_module.reset_peak_memory()  # does nothing, and says nothing
    unit = 1 if sys.platform == "darwin" else 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
    assert stages_module.peak_memory_bytes() == peak


@pytest.mark.slow
def test_every_stage_counts_its_own_memory(tmp_path, monkeypatch):
    order = []
    monkeypatch.setattr(stages_module, "reset_peak_memory", lambda: order.append("reset"))
    monkeypatch.setattr(stages_module, "peak_memory_bytes", lambda: order.append("peak") or 7)
    ours = run(tmp_path, plan=[tiny.stage("coarse", iterations=2), tiny.stage("fine", iterations=2)])
    ours.fit()
    ours.fit()  # all is finished
    assert order == ["reset", "peak"] * 2
    assert ours.finished()["fine"]["peak_memory_bytes"] == 7


@pytest.mark.slow
@pytest.mark.parametrize("choices", [{"motion": None, "trajectory": None}, tiny.EVERYTHING])
def test_the_least_and_the_whole_model_train_carry_and_load(tmp_path, choices):
    data, model = tiny.ball_data(rays=64, size=16), tiny.forward_model(**choices)
    ours = tiny.make_run(tmp_path, stages(iterations=4), data=data, model=model)
    module = ours.fit()
    assert all(p.isfinite().all() for p in module.parameters())
    assert tiny.same(ours.load(), module)


def test_a_scene_of_one_time_needs_no_motion_and_no_rate_for_it(tmp_path):
    rates = {name: rate for name, rate in tiny.RATES.items() if name != "flow"}
    still = [tiny.stage(iterations=4, lr=rates)]
    module = tiny.make_run(tmp_path, still, data=tiny.ball_data(rays=64, size=16, times=[0.0] * 4)).fit()
    assert module.method.motion is None


class CtrlC(lightning.Callback):
    """Press Ctrl-C once or more in the middle of a step, or send another signal."""

    def __init__(self, stage, step, times=1, number=signal.SIGINT):
        self.stage, self.step, self.times, self.number = stage, step, times, number

    def on_before_backward(self, trainer, module, loss):
        if module.settings.name == self.stage and module.global_step == self.step:
            for _ in range(self.times):
                signal.raise_signal(self.number)


@pytest.fixture(autouse=True)
def _listening():
    """Handle Ctrl-C, which is ignored if the tests run in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def pressed(folder, *presses):
    """Run until a signal ends it; Lightning turns KeyboardInterrupt into SystemExit."""
    before = [signal.getsignal(number) for number in ENDING]
    with pytest.raises(SystemExit) as leaving:
        run(folder, [CtrlC(*presses)]).fit()
    assert [signal.getsignal(number) for number in ENDING] == before
    return signal_of(leaving.value.__context__)


ENDED = "fine: ended after 10 steps, 0.833333 for each of 12 training pictures; for as many as the budget "
ENDED += "has: stage.fine.steps_per_picture=null"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "step", "number"), [("coarse", 5, signal.SIGINT), ("fine", 9, signal.SIGTERM)]
)
def test_a_request_to_end_keeps_the_step_that_it_met(tmp_path, whole, capsys, name, step, number):
    assert pressed(tmp_path, name, step, 1, number) == number
    assert torch.load(tmp_path / name / "last.ckpt", weights_only=True)["global_step"] == step + 1
    again = "Ctrl-C" if number == signal.SIGINT else "SIGTERM"
    assert f"ends this step and saves it; {again} again stops at once" in capsys.readouterr().err
    ours, told = run(tmp_path), []
    ours.tell = told.append
    assert tiny.same(ours.fit(), whole[1])
    before = ["coarse: finished before"] if name == "fine" else []
    assert told == [*before, f"{name}: resuming at {10 * (step + 1)}%, step {step + 1}", ENDED]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_request_to_end_stops_at_once(tmp_path, number):
    assert pressed(tmp_path, "coarse", 5, 2, number) == number
    assert not (tmp_path / "coarse" / "last.ckpt").exists()


@pytest.mark.slow
def test_a_folder_that_is_deleted_while_a_run_works_in_it_is_said(tmp_path):
    class Deleted(lightning.Callback):
        def on_train_end(self, trainer, module):
            shutil.rmtree(tmp_path / "coarse")
            (tmp_path / "coarse").mkdir()  # as whoever writes an image would

    with pytest.raises(ValueError, match="coarse: expected the folder that this run works in, but it was"):
        run(tmp_path, [Deleted()]).fit()
    assert list((tmp_path / "coarse").iterdir()) == []


@pytest.mark.slow
def test_ctrl_c_that_no_step_follows_stops_before_the_next_stage(tmp_path, whole):
    class AtTheEnd(lightning.Callback):
        def on_train_end(self, trainer, module):
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, [AtTheEnd()]).fit()
    assert (tmp_path / "coarse" / "done.json").is_file()
    assert not (tmp_path / "fine").exists()
    assert tiny.same(run(tmp_path).fit(), whole[1])


def test_whoever_sees_to_signals_himself_is_left_alone(tmp_path):
    def handler(number, frame):
        pass

    keeper = KeepCheckpoint(tmp_path / "last.ckpt", 60, print)
    before = signal.signal(signal.SIGINT, handler)
    try:
        with keeper.listening():
            signal.raise_signal(signal.SIGINT)
            assert signal.getsignal(signal.SIGINT) is handler
        assert signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert not keeper.asked
