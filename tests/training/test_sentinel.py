import re
import shutil

import lightning
import pytest
import torch

from forewarp.scene.camera import Lens
from forewarp.training.bundle import read_bundle
from forewarp.training.sentinel import BrokenStep, Sentinel, diagnose, first_bad
from tests.support.tiny_scene import INPAINTER, ball_data, forward_model, make_run, stage

NAN = float("nan")


class Poison(lightning.Callback):
    """Break a number at some steps."""

    def __init__(self, what, *steps):
        self.what, self.steps = what, steps

    def on_train_batch_start(self, trainer, module, batch, batch_idx):
        if module.global_step in self.steps:
            with torch.no_grad():
                if self.what == "parameter":
                    module.method.radiance.color[0, 0] = NAN
                if self.what == "batch":
                    batch.observations[0].rgb[3, 1] = NAN
                if self.what == "slope":  # finite values whose gradient is not
                    module.method._terms["tv_flow"] = lambda seen: (0 * seen.state.flow.sum()).sqrt()

    def on_after_backward(self, trainer, module):
        if self.what == "gradient" and module.global_step in self.steps:
            module.method.radiance.density.grad[0, 0] = NAN

    def on_before_zero_grad(self, trainer, module, optimizer):
        if self.what == "moment" and module.global_step in self.steps:
            next(iter(optimizer.state.values()))["exp_avg_sq"][0] = float("inf")


def run(folder, poison, iterations=12, **changes):
    """A run of one stage with a checkpoint after every step."""
    model = changes.pop("model", None)
    ours = make_run(
        folder,
        [stage(iterations=iterations)],
        data=ball_data(rays=64, size=16),
        model=model,
        callbacks=[poison],
    )
    ours.checkpoint_seconds = 0.0
    for name, value in changes.items():
        setattr(ours, name, value)
    return ours


def broken(folder, poison, **changes):
    """Return the message of a run that stops, and the file of its step 5."""
    with pytest.raises(BrokenStep) as stopped:
        run(folder, poison, **changes).fit()
    return str(stopped.value), folder / "coarse" / "broken" / "step_5.pt"


def again(folder, path):
    """Repeat a stored step by a run without data; return what is found."""
    bundle = read_bundle(path)
    ours = make_run(folder / "elsewhere", [stage()], data=None)
    module = ours.rebuilt("coarse", bundle.scene)
    module.load_state_dict(bundle.state_dict)
    module.generator.set_state(bundle.noted["random"]["samples"])
    return str(diagnose(module, bundle.batch, bundle.noted["step"])), bundle


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """Return folder, message and stored step of a run with a broken batch at step 5."""
    folder = tmp_path_factory.mktemp("stopped")
    return folder, *broken(folder, Poison("batch", 5))


def test_a_loss_that_is_not_finite_stops_the_stage(stopped):
    folder, said, path = stopped
    told = "stage.coarse: expected finite numbers, but got loss: batch[0].rgb (terms photo) at step 5,"
    assert said.startswith(told)
    assert "\n" not in said
    assert f"python -m forewarp.replay {path}" in said
    found, bundle = again(folder, path)
    assert found == bundle.noted["found"] == "loss: batch[0].rgb (terms photo)"
    frame = bundle.scene.train[bundle.batch.frame]
    assert f"frame {frame.name} (time {frame.time:.4g})" in said


def test_the_last_checkpoint_is_the_one_before_and_the_run_goes_on_from_it(stopped, tmp_path):
    shutil.copytree(stopped[0], tmp_path, dirs_exist_ok=True)
    kept = torch.load(tmp_path / "coarse" / "last.ckpt", weights_only=True)
    assert kept["global_step"] == 5
    assert all(v.isfinite().all() for v in kept["state_dict"].values() if torch.is_tensor(v))
    module = run(tmp_path, Poison("nothing")).fit()
    whole = run(tmp_path / "whole", Poison("nothing")).fit()
    ours, theirs = ({k: v for k, v in m.state_dict().items() if torch.is_tensor(v)} for m in (module, whole))
    assert all(torch.equal(ours[k], theirs[k]) for k in theirs)


def test_steps_are_skipped_where_asked_counted_and_change_no_weight(tmp_path):
    class Diary(Poison):
        weights = {}

        def on_train_batch_end(self, trainer, module, *_):
            self.weights[module.global_step] = {n: p.detach().clone() for n, p in module.named_parameters()}

    diary = Diary("batch", 3, 5)
    ours = run(tmp_path, diary, skip=2)
    module = ours.fit()
    assert all(p.isfinite().all() for p in module.parameters())
    assert ours.finished()["coarse"]["skipped_steps"] == 2
    assert ours.finished()["coarse"]["steps"] == 12
    assert sorted(p.name for p in (tmp_path / "coarse" / "broken").iterdir()) == ["step_3.pt", "step_5.pt"]
    same = {
        a: all(torch.equal(v, diary.weights[a + 1][k]) for k, v in diary.weights[a].items()) for a in (5, 6)
    }
    assert same == {5: True, 6: False}


@pytest.mark.parametrize(
    ("what", "told", "found"),
    [
        ("parameter", "parameter: radiance.color", "parameter: radiance.color"),
        ("slope", r"gradient: motion.trajectory.*\(terms tv_flow\)", "None"),  # the poison is not stored
        ("gradient", "gradient: radiance.density, though not when the step was repeated,", "None"),
    ],
)
def test_what_is_not_finite_is_named(tmp_path, what, told, found):
    said, path = broken(tmp_path, Poison(what, 5))
    assert re.search(f"but got {told} at step 5", said)
    assert again(tmp_path, path)[0] == found


def test_a_broken_optimizer_is_never_saved(tmp_path):
    with pytest.raises(BrokenStep, match=r"optimizer: exp_avg_sq of "):
        run(tmp_path, Poison("moment", 5)).fit()
    kept = torch.load(tmp_path / "coarse" / "last.ckpt", weights_only=True)
    states = kept["optimizer_states"][0]["state"].values()
    assert kept["global_step"] == 5
    assert all(v.isfinite().all() for s in states for v in s.values())


def test_one_too_many_stops_and_the_count_is_continued(tmp_path):
    with pytest.raises(BrokenStep, match="at step 5"):
        run(tmp_path, Poison("batch", 3, 5), skip=1).fit()
    with pytest.raises(BrokenStep, match="at step 7"):
        run(tmp_path, Poison("batch", 7), skip=1).fit()
    done = run(tmp_path, Poison("batch", 7), skip=2)
    done.fit()
    assert done.finished()["coarse"]["skipped_steps"] == 2


def test_a_bundle_holds_lenses_and_no_images():
    from forewarp.training.bundle import _plain_scene, _scene

    scene = ball_data(size=16).scene
    object.__setattr__(scene.train[0].camera, "lens", Lens((0.1, 0.0, 0.0), (0.01, 0.0)))
    copy = _scene(_plain_scene(scene))
    assert copy.train[0].camera.lens == scene.train[0].camera.lens
    assert torch.equal(copy.train[1].camera.rays().directions, scene.train[1].camera.rays().directions)
    with pytest.raises(ValueError, match="expected a scene with images"):
        copy.train[0].load()


def test_an_inpainters_step_is_taken_again(tmp_path):
    model = forward_model(inpainter=INPAINTER)
    said, path = broken(tmp_path, Poison("batch", 5), model=model)
    bundle = read_bundle(path)
    module = make_run(tmp_path / "e", [stage()], model=model).rebuilt("coarse", bundle.scene)
    module.load_state_dict(bundle.state_dict)
    assert str(diagnose(module, bundle.batch, 5)) == bundle.noted["found"]


@pytest.mark.parametrize("skip", [0, 2])
def test_a_bundle_that_cannot_be_written_hides_nothing(tmp_path, skip):
    (tmp_path / "coarse").mkdir()
    (tmp_path / "coarse" / "broken").write_text("")
    with pytest.raises(BrokenStep) as stopped:
        run(tmp_path, Poison("batch", 5), skip=skip).fit()
    said = str(stopped.value)
    assert "expected finite numbers, but got loss: batch[0].rgb (terms photo) at step 5," in said
    assert "coarse/broken/step_5.pt could not be written (File exists); begin anew" in said
    assert "forewarp.replay" not in said


SPOIL = {
    "noted.random": lambda c: c["noted"].pop("random"),
    "noted.random.torch": lambda c: c["noted"]["random"].pop("torch"),
    "noted.stage": lambda c: c["noted"].update(stage=7),
    "config": lambda c: c.update(config=None),
    "state_dict": lambda c: c.update(state_dict=[]),
    "batch.frame": lambda c: c["batch"].update(frame=99),
    "batch": lambda c: c["batch"]["observations"][0].update(rgb=torch.zeros(3)),
    "batch.observations": lambda c: c["batch"].update(observations=[]),
    "batch.time": lambda c: c["batch"]["observations"][0].update(time=2.0),
    "batch.pixels": lambda c: c["batch"]["observations"][0]["pixels"].fill_(10**6),
    "scene": lambda c: c.pop("scene"),
    "frames": lambda c: c["scene"].update(frames=[7]),
    "TypeError": lambda c: c["batch"]["observations"][0].update(
        rgb=torch.zeros(1).expand(64, 3)
    ),  # more than the file holds
}


@pytest.mark.parametrize("name", SPOIL)
def test_a_bundle_with_a_wrong_part_is_refused_in_one_line(stopped, tmp_path, name):
    content = torch.load(stopped[2], weights_only=True)
    SPOIL[name](content)
    torch.save(content, tmp_path / "a.pt")
    with pytest.raises(ValueError, match="a.pt: expected a step that a run left in broken/, but got") as no:
        read_bundle(tmp_path / "a.pt")
    assert len(str(no.value).splitlines()) == 1


def test_a_skip_below_zero_is_refused():
    with pytest.raises(ValueError, match="sentinel.skip: expected a whole number of steps >= 0, but got -1"):
        Sentinel(".", skip=-1)


def test_a_gradient_whose_square_overflows_is_bad():
    large = [("a", torch.ones(3)), ("b", torch.tensor([1e20]))]
    assert first_bad(large) is None
    assert first_bad(large, squared=True) == "b"
