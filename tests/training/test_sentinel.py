"""Numbers that are not finite: named, stored, skipped where asked, and never in a checkpoint."""

import re
import shutil
from dataclasses import replace

import lightning
import pytest
import torch

from forewarp.training.sentinel import BrokenStep, Sentinel, first_bad
from tests.support.tiny_scene import INPAINTER, ball_data, forward_model, make_run, same, stage

NAN = float("nan")


class Poison(lightning.Callback):
    """Break a number at some steps, and note the weights after each."""

    def __init__(self, what, *steps):
        self.what, self.steps, self.weights = what, steps, {}

    def on_train_batch_start(self, trainer, module, batch, batch_idx):
        method = module.method
        if module.global_step in self.steps:
            if self.what == "parameter":
                method.radiance.color.data[0, 0] = NAN
            if self.what == "batch":
                batch.observations[0].rgb[3, 1] = NAN
            if self.what == "slope":  # finite values whose gradient is not
                terms_of, broken = method.terms_of, lambda state: (0 * state.flow.sum()).sqrt()
                also = lambda state: {"tv_flow": lambda: broken(state)}  # noqa: E731
                method.terms_of = lambda state, *given: terms_of(state, *given) | also(state)
            if self.what == "own gradients":  # as of a method that computes them itself
                look, gradients = method.look, {"radiance.color": NAN * method.radiance.color.detach()}
                method.look = lambda *given: replace(look(*given), gradients=gradients)

    def on_after_backward(self, trainer, module):
        if self.what == "gradient" and module.global_step in self.steps:
            module.method.radiance.density.grad[0, 0] = NAN

    def on_train_batch_end(self, trainer, module, *_):
        self.weights[module.global_step] = [p.detach().clone() for p in module.parameters()]
        if self.what == "moment" and module.global_step - 1 in self.steps:
            next(iter(trainer.optimizers[0].state.values()))["exp_avg_sq"][0] = float("inf")


def run(folder, poison, **changes):
    """A run of one stage with a checkpoint after every step."""
    data = ball_data(rays=64, frames=5, size=16)
    options = {"data": data, "callbacks": [poison], "checkpoint_seconds": 0.0} | changes
    return make_run(folder, [stage(iterations=8)], **options)


def broken(folder, poison, **changes):
    """Return the message of a run that stops."""
    with pytest.raises(BrokenStep) as stopped:
        run(folder, poison, **changes).fit()
    return str(stopped.value)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """Return folder and message of a run with a broken batch at step 5."""
    folder = tmp_path_factory.mktemp("stopped")
    return folder, broken(folder, Poison("batch", 5))


@pytest.mark.slow
def test_a_loss_that_is_not_finite_stops_the_stage_and_its_step_is_stored(stopped):
    folder, message = stopped
    path, found = folder / "coarse" / "broken" / "step_5.pt", "loss: batch[0].rgb (terms photo)"
    stored = torch.load(path, weights_only=True)
    (seen,) = stored["batch"]
    assert message == (
        f"stage.coarse: expected finite numbers, but got {found} at step 5, frame {stored['frame']} "
        f"(time {seen['time']:.4g}); its batch and weights are in {path}; begin anew with lower "
        f"stage.coarse.lr, or go on with resume={folder} sentinel.skip=1"
    )
    assert (stored["found"], stored["step"], seen["pixels"].shape) == (found, 5, (64,))
    assert seen["rgb"][3, 1].isnan()
    assert stored["state_dict"]["method.radiance.color"].isfinite().all()


@pytest.mark.slow
def test_a_run_that_stopped_goes_on_from_its_last_checkpoint(stopped, tmp_path):
    shutil.copytree(stopped[0], tmp_path, dirs_exist_ok=True)
    assert same(run(tmp_path, Poison("nothing")).fit(), run(tmp_path / "whole", Poison("nothing")).fit())


@pytest.mark.slow
def test_steps_are_skipped_where_asked_counted_and_change_no_weight(tmp_path):
    assert "at step 5" in broken(tmp_path, Poison("batch", 3, 5), skip=1)
    poison = Poison("batch", 5)
    ours = run(tmp_path, poison, skip=2)
    module, done = ours.fit(), ours.finished()["coarse"]  # the count is continued
    assert all(p.isfinite().all() for p in module.parameters())
    assert (done["skipped_steps"], done["steps"]) == (2, 8)
    assert {p.name for p in (tmp_path / "coarse" / "broken").iterdir()} == {"step_3.pt", "step_5.pt"}
    assert not all(map(torch.equal, poison.weights[7], poison.weights[6]))
    kept = torch.load(tmp_path / "coarse" / "broken" / "step_5.pt", weights_only=True)["state_dict"]
    assert all(map(torch.equal, poison.weights[6], (kept[name] for name, _ in module.named_parameters())))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "model", "found"),
    [
        ("parameter", None, "parameter: radiance.color"),
        ("slope", None, r"gradient: motion.trajectory.*\(terms tv_flow\)"),
        ("gradient", None, "gradient: radiance.density, though not when the step was repeated,"),
        ("own gradients", None, "gradient: radiance.color"),
        ("moment", None, "optimizer: exp_avg_sq of .*"),
        ("batch", forward_model(inpainter=INPAINTER), r"loss: batch\[0\].rgb \(terms photo\)"),
    ],
)
def test_what_is_not_finite_is_named_and_never_saved(tmp_path, what, model, found):
    assert re.search(f"but got {found} at step 5", broken(tmp_path, Poison(what, 5), model=model))
    kept = torch.load(tmp_path / "coarse" / "last.ckpt", weights_only=True)
    tensors = [*kept["state_dict"].values()]
    tensors += [v for state in kept["optimizer_states"][0]["state"].values() for v in state.values()]
    assert kept["global_step"] == 5
    assert all(v.isfinite().all() for v in tensors if torch.is_tensor(v))


@pytest.mark.slow
def test_a_step_that_cannot_be_stored_hides_nothing(tmp_path):
    (tmp_path / "coarse").mkdir()
    (tmp_path / "coarse" / "broken").write_text("")
    message = broken(tmp_path, Poison("batch", 5), skip=2)
    assert "expected finite numbers, but got loss: batch[0].rgb (terms photo) at step 5," in message
    assert "coarse/broken/step_5.pt could not be written (File exists); begin anew" in message


def test_a_gradient_whose_square_overflows_is_bad():
    large = [("a", torch.ones(3)), ("b", torch.tensor([1e20]))]
    assert (first_bad(large), first_bad(large, squared=True)) == (None, "b")
    with pytest.raises(ValueError, match="sentinel.skip: expected a whole number >= 0, but got -1"):
        Sentinel(".", skip=-1)
