"""What is off is never called: every part that a scene does not call for raises, and a step is made."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp import losses
from forewarp.fields.trajectory import TrajectoryField
from forewarp.fields.voxel_grid import VoxelGrid
from forewarp.methods.voxel.effects import background, inpaint, motion, upsample, view_dependence
from forewarp.methods.voxel.terms import TERMS
from forewarp.scene.box import Lattice
from forewarp.training.module import DynamicSceneModule
from forewarp.training.objective import total
from forewarp.training.schedule import Curriculum
from tests.support.tiny_scene import BOX, ball_data, begun, built, forward_model, stage

LATTICE = Lattice(BOX, (9, 8, 7))
PARTS = {
    "motion": [(motion.Motion, "flow"), (motion.Motion, "warp"), (TrajectoryField, "coefficients")],
    "view_dependence": [
        (view_dependence.SphericalHarmonics, "forward"),
        (view_dependence.ViewNetwork, "forward"),
    ],
    "upsampler": [
        (upsample.LearnedUpsampler, "alone"),
        (upsample.LearnedUpsampler, "residual"),
        (upsample.TrilinearUpsampler, "forward"),
    ],
    "inpainter": [(inpaint.UNet3d, "features"), (inpaint.UNet3d, "residual")],
    "background": [(background.StaticBackground, "forward"), (background.Together, "density")],
}
STILL = partial(background.StaticBackground, features=3, alpha_init=1e-2, alpha_threshold=0.0)
ON = {
    "motion": {"motion": motion.Motion},
    "view_dependence": {"view_dependence": view_dependence.SphericalHarmonics},
    "upsampler": {"upsampler": partial(upsample.LearnedUpsampler, width=8)},
    "inpainter": {"inpainter": partial(inpaint.UNet3d, width=16, levels=2)},
    "background": {"background": STILL},
}
OFF = {"motion": None, "view_dependence": None}


def a_step(effects, weights=None, **choices):
    """Look at a batch of the ball through a method with these effects and no others, and learn from it."""
    torch.manual_seed(0)
    chosen = OFF | {key: value for effect in effects for key, value in ON[effect].items()} | choices
    static = (LATTICE, torch.ones(LATTICE.shape, dtype=torch.bool))
    method = built(forward_model(**chosen), LATTICE, frames=12, static=static)
    data = ball_data(rays=32)
    data.setup("fit")
    made = stage(weights=weights or {"photo": 1.0})
    module = DynamicSceneModule(
        begun(method, replace(data.scene, still=torch.zeros(4, 3)), made),
        objective=made.objective,
        settings=made.settings,
        curriculum=Curriculum(list(data.scene.times), 0.0),
    )
    data.picker = lambda: 7  # a time at which things have moved
    factors = module.objective.factors(0)
    loss, raw = total(module.look(next(iter(data.train_dataloader())), factors), factors, {})
    loss.backward()
    return method, raw


def forbid(monkeypatch, of, name):
    def refuse(*arguments, **options):
        raise AssertionError(f"{of.__name__}.{name} was called")

    monkeypatch.setattr(of, name, refuse)


@pytest.mark.parametrize("off", PARTS)
def test_an_effect_that_is_off_is_never_called_and_owns_nothing(off, monkeypatch):
    for part in PARTS[off]:
        forbid(monkeypatch, *part)
    method, _ = a_step([effect for effect in ON if effect != off])
    assert getattr(method, off) is None
    assert not [name for name, _ in method.named_parameters() if name.startswith(off)]
    assert not [name for name, _ in method.named_buffers() if name.startswith(off)]


@pytest.mark.parametrize("on", PARTS)
def test_an_effect_that_is_on_is_called(on, monkeypatch):
    for part in PARTS[on]:
        forbid(monkeypatch, *part)
    with pytest.raises(AssertionError, match="was called"):
        a_step([on])


def test_without_any_effect_there_is_a_radiance_field_and_nothing_else(monkeypatch):
    for part in (part for parts in PARTS.values() for part in parts):
        forbid(monkeypatch, *part)
    method, _ = a_step([])
    assert {name.split(".")[0] for name, _ in method.named_parameters()} == {"radiance"}
    assert {name.split(".")[0] for name, _ in method.named_buffers()} == {"radiance"}
    assert set(method.radiance.names) == {"density", "color"}  # and no features for a view network


def test_trajectory_features_that_are_off_are_no_grid():
    def grids(features):
        trajectory = partial(TrajectoryField, bases=4, nodes=8, width=16, layers=2, features=features)
        method, _ = a_step(["motion"], trajectory=trajectory)
        return [part for part in method.motion.modules() if isinstance(part, VoxelGrid)]

    assert len(grids(4)) == 1
    assert grids(0) == []


@pytest.mark.parametrize("off", sorted(TERMS))
def test_a_term_of_weight_zero_computes_nothing(off, monkeypatch):
    function = {"photo": "photometric"}.get(off, off)
    monkeypatch.setattr(losses, function, lambda *a, **k: pytest.fail(f"{off} was called"))
    weights = dict.fromkeys(TERMS, 1e-3) | {off: 0.0}
    _, raw = a_step(["motion", "inpainter", "background"], weights)
    assert raw.keys() == set(TERMS) - {off}
