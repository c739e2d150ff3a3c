import time
from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp.methods.method import Method, Step
from forewarp.methods.voxel.backward import Deformation
from forewarp.methods.voxel.structure import resample
from forewarp.ops.backend import numba_installed
from forewarp.ops.march import warm_up
from forewarp.progress import told_if_slow
from forewarp.renderer import Renderer
from forewarp.scene.box import Lattice
from forewarp.training.module import DynamicSceneModule
from forewarp.training.objective import Objective
from forewarp.training.schedule import Curriculum
from tests.support import tiny_scene as tiny
from tests.support.kernels import watch

BACKWARD = tiny.backward_model(deformation=partial(Deformation, width=8, layers=2))
DATA = tiny.ball_data(rays=64, frames=5, size=16)


class CountingRenderer(Renderer):
    calls = 0

    def __call__(self, *arguments, **named):
        self.calls += 1
        return super().__call__(*arguments, **named)


def module(model=None, weights=None, renderer=None, **changes):
    torch.manual_seed(0)
    method = tiny.built(model or tiny.forward_model(), Lattice(tiny.BOX, (9, 7, 6)), density_scale=0.2)
    for parameter in method.radiance.rows():
        torch.nn.init.normal_(parameter)
    method.renderer = renderer or method.renderer
    made = tiny.stage(weights=weights, **changes)
    curriculum = Curriculum([f.time for f in DATA.scene.train], 0.0)
    method = tiny.begun(method, DATA.scene, made)
    return DynamicSceneModule(method, objective=made.objective, settings=made.settings, curriculum=curriculum)


def batch(frame=3):
    DATA.picker = lambda: frame
    return DATA.batches.draw()


@pytest.mark.parametrize(
    ("model", "options", "calls"),
    [
        ({}, {}, 1),
        ({}, {"photo_on": ["inpainted"]}, 1),  # what is not there cannot be looked at
        ({"inpainter": tiny.INPAINTER}, {}, 2),
        ({"inpainter": tiny.INPAINTER}, {"photo_on": ["inpainted"]}, 1),
        ({"inpainter": tiny.INPAINTER}, {"photo_on": ["upsampled"]}, 1),  # the first, up-sampled or not
        ({}, {"weights": {"photo": 1.0, "tv_depth": 0.1}, "patches": 2}, 2),  # random views beside it
    ],
)
def test_only_what_a_term_looks_at_is_rendered(model, options, calls):
    renderer = CountingRenderer()
    module(tiny.forward_model(**model), renderer=renderer, **options).loss_of(batch())
    assert renderer.calls == calls


@pytest.mark.parametrize("seconds", [0.0, 0.15])
def test_the_clock_starts_when_the_kernels_are_warm_and_long_compiling_is_told(monkeypatch, capsys, seconds):
    made, seen = module(), []

    def compiling(device):
        seen.append((device, made.clock.seconds))
        time.sleep(seconds)

    monkeypatch.setattr("forewarp.training.module.told_if_slow", partial(told_if_slow, after=0.05))
    monkeypatch.setattr("forewarp.methods.voxel.model.warm_up", compiling)
    made.on_train_start()
    assert seen == [(made.device, 0)]
    assert 0 < made.clock.seconds < 0.1
    assert ("compiling what this method runs" in capsys.readouterr().err) == (seconds > 0)


def test_a_step_meets_warm_kernels_only(monkeypatch):
    if not numba_installed():
        pytest.skip("Numba is switched off")
    met = watch(monkeypatch, "voxels")
    before = torch.get_rng_state()
    warm_up()
    assert torch.equal(torch.get_rng_state(), before)
    warm = met.copy()
    met.clear()
    for model in (tiny.forward_model(), BACKWARD):
        made = module(model)
        made.loss_of(batch())[0].backward()
        resample(made.method.radiance, made.method.stage, None, Lattice.of_count(tiny.BOX, 500))
    assert len({name for name, *_ in met}) == 8
    assert met <= warm


def test_a_missing_rate_is_named():
    made = module()
    made.settings = replace(made.settings, lr={k: v for k, v in made.settings.lr.items() if k != "flow"})
    with pytest.raises(ValueError, match=r"stage.coarse.lr: expected a rate for 'flow', but got \['col"):
        made.configure_optimizers()


@pytest.mark.parametrize("model", [tiny.forward_model(), BACKWARD], ids=["forward", "backward"])
def test_points_known_to_be_static_hold_the_motion(model):
    made = module(model, {"static_points": 1.0})
    method = made.method
    head = (method.motion.trajectory if hasattr(method, "motion") else method.deformation).network[-1]
    torch.nn.init.constant_(head.bias, 0.1)
    assert made.loss_of(batch())[0] == 0  # none is known
    method.static_points = torch.tensor([[0.9, 0.1, 0.2], [-0.8, 0.3, -0.2]])
    loss, _ = made.loss_of(batch())
    loss.backward()
    assert loss > 0
    assert head.bias.grad.abs().sum() > 0


def test_validation_logs_the_psnr_of_whole_images():
    made, target = module(), DATA.targets("val")[0]
    (logged,) = tiny.trainer([], limit_val_batches=1.0).validate(made, datamodule=DATA, verbose=False)
    drawn = made.render(target.frame.camera, target.moment, target.background).rgb
    error = (drawn.reshape(target.rgb.shape) - target.rgb).square().mean()
    assert logged["val/psnr"] == pytest.approx(-10 * torch.log10(error).item(), abs=1e-3)


def test_without_cameras_there_are_no_random_views():
    method = tiny.begun(module().method, replace(DATA.scene, train=()), tiny.stage())
    assert method.patches is None


def test_what_is_drawn_when_training_begins_changes_nothing_after_it():
    """A checkpoint's generator state is restored last, so that a continued run draws the same numbers."""
    made, checkpoint = module(), {}
    made.on_save_checkpoint(checkpoint)
    made.on_load_checkpoint(checkpoint)
    torch.rand(3)  # by callbacks, whose hooks come before the module's
    made.on_train_start()
    made.on_train_end()
    assert torch.equal(torch.get_rng_state(), checkpoint["forewarp"]["torch_rng"])


class Plane(Method):
    """One colour for all pixels; its gradients come from autograd, or are computed by itself."""

    def __init__(self, start, own):
        super().__init__()
        self.color, self.own, self.autocast = torch.nn.Parameter(torch.zeros(3)), own, []

    def look(self, batch, factors, generator):
        self.autocast.append(torch.is_autocast_enabled("cpu"))
        error = self.color - batch.observations[0].rgb
        loss, gradients = error.square().mean(), None
        if self.own:
            gradients, loss = {"color": 2 * error.detach().sum(0) / error.numel()}, loss.detach()
        else:
            self.color.register_hook(lambda _: self.autocast.append(torch.is_autocast_enabled("cpu")))
        return Step({"photo": lambda: loss}, loss.detach(), gradients=gradients)


def fitted(folder, own, limit=0.0, steps=5, **changes):
    made = tiny.stage(weights={"photo": 1.0}, iterations=steps, lr={"network": 0.1}, max_gradient=limit)
    made.settings.numbers.clear()
    run = tiny.make_run(folder, [made], data=DATA, model=partial(Plane, own=own))
    run.make_trainer = lambda where, callbacks, loggers: tiny.trainer(callbacks, **changes)
    return run.fit()


@pytest.mark.slow
@pytest.mark.parametrize("limit", [0.0, 1e-3])
def test_gradients_of_a_method_reach_the_optimiser_as_those_of_autograd_do(tmp_path, limit):
    ours, theirs = (fitted(tmp_path / str(own), own, limit) for own in (True, False))
    assert ours.global_step == theirs.global_step == 5
    torch.testing.assert_close(ours.method.color, theirs.method.color)
    assert (float(ours.method.color.grad.norm()) <= 1.001e-3) == (limit > 0)
    assert float(ours.method.color.detach().abs().min()) > 0.1


def test_mixed_precision_is_of_the_forward_pass_alone(tmp_path):
    method = fitted(tmp_path, own=False, steps=1, precision="bf16-mixed").method
    assert method.autocast == [True, False]


def test_a_printed_form_that_there_is_not_is_refused():
    made, objective = module(), Objective({}, literal=["tv_flow"])
    parts = {"settings": made.settings, "curriculum": made.curriculum}
    with pytest.raises(ValueError, match="objective.literal: expected some of photo, .* but got 'tv_flow'"):
        DynamicSceneModule(made.method, objective=objective, **parts)
