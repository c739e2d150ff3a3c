import time
from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp.methods.method import Step
from forewarp.methods.voxel.backward import Deformation
from forewarp.methods.voxel.structure import resample
from forewarp.ops.backend import numba_installed
from forewarp.ops.march import warm_up
from forewarp.progress import told_if_slow
from forewarp.renderer import Renderer
from forewarp.scene.box import Lattice
from forewarp.training.module import DynamicSceneModule
from forewarp.training.objective import total
from forewarp.training.schedule import Curriculum
from tests.support.kernels import watch
from tests.support.tiny_scene import (
    BOX,
    INPAINTER,
    backward_model,
    ball_data,
    begun,
    built,
    forward_model,
    stage,
    trainer,
)

BACKWARD = backward_model(deformation=partial(Deformation, width=8, layers=2))
DATA = ball_data(rays=64, frames=5, size=16)


class CountingRenderer(Renderer):
    calls = 0

    def __call__(self, *arguments, **named):
        self.calls += 1
        return super().__call__(*arguments, **named)


def module(model=None, weights=None, renderer=None, **changes):
    torch.manual_seed(0)
    method = built(model or forward_model(), Lattice(BOX, (9, 7, 6)), density_scale=0.2)
    for name in method.radiance.names:
        torch.nn.init.normal_(method.radiance.parameter(name))
    method.renderer = renderer or method.renderer
    made = stage(weights=weights, **changes)
    return DynamicSceneModule(
        begun(method, DATA.scene, made),
        objective=made.objective,
        settings=made.settings,
        curriculum=Curriculum([f.time for f in DATA.scene.train], 0.0),
    )


def batch(frame=3):
    DATA.picker = lambda: frame
    return DATA.batches.draw()


@pytest.mark.parametrize(
    ("inpainter", "photo_on", "calls"),
    [
        (None, None, 1),
        (None, ["inpainted"], 1),  # what is not there cannot be looked at
        (INPAINTER, None, 2),
        (INPAINTER, ["inpainted"], 1),
        (INPAINTER, ["upsampled"], 1),  # the first rendering, with an up-sampler or without
    ],
)
def test_only_what_a_term_looks_at_is_rendered(inpainter, photo_on, calls):
    renderer = CountingRenderer()
    made = module(forward_model(inpainter=inpainter), renderer=renderer, photo_on=photo_on)
    made.training_step(batch(), 0)
    assert renderer.calls == calls


def test_the_clock_starts_when_the_kernels_are_warm(monkeypatch):
    made, seen = module(), []
    monkeypatch.setattr(
        "forewarp.methods.voxel.model.warm_up", lambda device: seen.append((device, made.clock.seconds))
    )
    made.on_train_start()
    assert seen == [(made.device, 0)]
    assert made.clock.seconds > 0


def test_the_name_of_a_hook_is_noted_at_once(monkeypatch):
    """Lightning sets it dozens of times a step; a module's own way takes ten times as long."""
    made, slow = module(), []
    monkeypatch.setattr(torch.nn.Module, "__setattr__", lambda self, name, value: slow.append(name))
    made._current_fx_name = "hook"
    assert (made._current_fx_name, slow) == ("hook", [])


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(0.6, "coarse   0% | compiling what this method runs, once on a machine: up to a minute\n"), (0, "")],
)
def test_kernels_that_take_long_to_compile_are_told(monkeypatch, capsys, seconds, said):
    monkeypatch.setattr("forewarp.training.module.told_if_slow", partial(told_if_slow, after=0.2))
    monkeypatch.setattr("forewarp.methods.voxel.model.warm_up", lambda device: time.sleep(seconds))
    module().on_train_start()
    assert capsys.readouterr().err == said


def test_a_step_meets_warm_kernels_only(monkeypatch):
    if not numba_installed():
        pytest.skip("Numba is switched off")
    met = watch(monkeypatch, "voxels")
    before = torch.get_rng_state()
    warm_up()
    assert torch.equal(torch.get_rng_state(), before)
    warm = met.copy()
    met.clear()
    for model in (forward_model(), BACKWARD):
        made = module(model)
        made.training_step(batch(), 0).backward()
        resample(made.method.radiance, BOX, 500, keep_alpha=1e-2)
    assert len({name for name, *_ in met}) == 9
    assert met <= warm


def test_a_missing_rate_is_named():
    made = module()
    made.settings = replace(made.settings, lr={k: v for k, v in made.settings.lr.items() if k != "flow"})
    with pytest.raises(ValueError, match=r"stage.coarse.lr: expected a rate for 'flow', but got \['col"):
        made.configure_optimizers()


def test_random_views_are_rendered_only_for_their_term():
    renderer = CountingRenderer()
    module(weights={"photo": 1.0, "tv_depth": 0.0}, renderer=renderer).training_step(batch(), 0)
    assert renderer.calls == 1
    module(weights={"photo": 1.0, "tv_depth": 0.1}, renderer=renderer, patches=2).training_step(batch(), 0)
    assert renderer.calls == 3


@pytest.mark.parametrize("model", [forward_model(), BACKWARD], ids=["forward", "backward"])
def test_points_known_to_be_static_hold_the_motion(model):
    made = module(model, {"static_points": 1.0})
    method = made.method
    head = (method.motion.trajectory if hasattr(method, "motion") else method.deformation).network[-1]
    torch.nn.init.constant_(head.bias, 0.1)
    assert made.training_step(batch(), 0) == 0  # none is known
    method.static_points = torch.tensor([[0.9, 0.1, 0.2], [-0.8, 0.3, -0.2]])
    loss = made.training_step(batch(), 0)
    loss.backward()
    assert loss > 0
    assert head.bias.grad.abs().sum() > 0


def test_gradients_are_clipped_where_asked():
    for limit in (0.0, 1e-3):
        made = module(max_gradient=limit)
        (1e3 * made.training_step(batch(), 0)).backward()
        made.configure_gradient_clipping(made.configure_optimizers())
        norm = sum(p.grad.square().sum() for p in made.method.parameters() if p.grad is not None) ** 0.5
        assert (norm <= 1.001e-3) == (limit > 0)


def test_an_image_in_chunks_is_the_image():
    made = module()
    target = DATA.targets("test")[1]
    whole = made.render(target.frame.camera, target.moment, target.background)
    field = made.method.at(target.moment).fields["warped"]
    parts = made.method.renderer.picture(
        field, target.frame.camera.rays(), target.background, made.method.view_dependence, chunk=100
    )
    for name in ("rgb", "depth", "opacity"):
        torch.testing.assert_close(getattr(whole, name), getattr(parts, name))


def test_validation_logs_the_psnr_of_whole_images():
    made = module()
    ours = trainer([])
    ours.limit_val_batches = 1.0
    (logged,) = ours.validate(made, datamodule=DATA, verbose=False)
    target = DATA.targets("val")[0]
    drawn = made.render(target.frame.camera, target.moment, target.background).rgb
    error = (drawn.reshape(target.rgb.shape) - target.rgb).square().mean()
    assert logged["val/psnr"] == pytest.approx(-10 * torch.log10(error).item(), abs=1e-3)


def test_without_cameras_there_are_no_random_views():
    made = module()
    method = begun(made.method, replace(DATA.scene, train=()), stage())
    assert method.patches is None
    none = DynamicSceneModule(
        method, objective=made.objective, settings=made.settings, curriculum=made.curriculum
    )
    assert none.training_step(batch(), 0).isfinite()


def test_gradients_and_terms_of_a_method_are_checked():
    one = torch.ones(())
    with pytest.raises(ValueError, match="expected gradients of some of a, but got none"):
        total(Step({"photo": lambda: one}, one, gradients={}), {"photo": 1.0}, {"a": one})
    with pytest.raises(ValueError, match="expected gradients of some of a, but got b"):
        total(Step({"photo": lambda: one}, one, gradients={"b": one}), {"photo": 1.0}, {"a": one})
    with pytest.raises(ValueError, match="expected look to give the term 'slow'"):
        total(Step({"photo": lambda: one}, one), {"slow": 1.0}, {})


def test_a_method_that_brings_no_gradients_is_told_which_it_has(monkeypatch):
    made, one = module(), torch.ones(())
    step = Step({"photo": lambda: one}, one, gradients={})
    monkeypatch.setattr(DynamicSceneModule, "look", lambda *_: step)
    monkeypatch.setattr(made.objective, "factors", lambda number: {"photo": 1.0})
    first = next(name for name, _ in made.method.named_parameters())
    with pytest.raises(ValueError, match=f"expected gradients of some of {first}, .*, but got none"):
        made.training_step(batch(), 0)


def test_what_is_drawn_when_training_begins_changes_nothing_after_it():
    """A checkpoint's generator state is restored last, so that a continued run draws the same numbers."""
    made, checkpoint = module(), {}
    made.on_save_checkpoint(checkpoint)
    made.on_load_checkpoint(checkpoint)
    torch.rand(3)  # by callbacks, whose hooks come before the module's
    made.on_train_start()
    made.on_train_end()
    assert torch.equal(torch.get_rng_state(), checkpoint["forewarp"]["torch"])
