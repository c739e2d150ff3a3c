from functools import partial

import pytest
import torch

from forewarp.fields.radiance import FeatureRadiance
from forewarp.fields.trajectory import TrajectoryField
from forewarp.methods.method import parameter_count
from forewarp.methods.voxel.backward_warp import Deformation
from forewarp.methods.voxel.effects.background import StaticBackground
from forewarp.methods.voxel.effects.inpaint import UNet3d
from forewarp.methods.voxel.effects.upsample import LearnedUpsampler, TrilinearUpsampler
from forewarp.methods.voxel.effects.view_dependence import ViewNetwork
from forewarp.methods.voxel.stage import EFFECTS
from forewarp.scene.box import Lattice
from tests.support.tiny_scene import BOX, backward_model, built, forward_model

LATTICE = Lattice(BOX, (5, 4, 6))


def build(model, effects=EFFECTS, **numbers):
    static = (LATTICE, torch.ones(LATTICE.shape, dtype=torch.bool))
    return built(model, LATTICE, static=static, effects=effects, **numbers)


FULL = forward_model(
    radiance=partial(FeatureRadiance, alpha_init=1e-2, alpha_threshold=0.0, width=8),
    trajectory=partial(TrajectoryField, bases=3, nodes=8, features=2),
    view_dependence=ViewNetwork,
    upsampler=LearnedUpsampler,
    inpainter=partial(UNet3d, levels=2),
    background=partial(StaticBackground, features=3, alpha_init=1e-2, alpha_threshold=0.0),
)


def test_every_parameter_has_one_kind():
    kinds = build(FULL).param_groups()
    assert set(kinds) == {"density", "color", "grid", "flow", "network"}
    listed = [id(p) for parameters in kinds.values() for p in parameters]
    assert len(listed) == len(set(listed)) == len(list(build(FULL).parameters()))
    direct = build(forward_model()).param_groups()
    assert set(direct) == {"density", "color", "shading", "flow"}
    backward = backward_model(deformation=Deformation, view_dependence=None)
    assert set(build(backward).param_groups()) == {"density", "color", "flow"}


def test_parameter_count():
    method = build(forward_model(motion=None, trajectory=None, view_dependence=None))
    assert parameter_count(method) == 5 * 4 * 6 * (1 + 3)


@pytest.mark.parametrize("effect", EFFECTS)
def test_a_stage_uses_the_effects_that_it_names(effect):
    method = build(FULL, [effect])
    on = {name for name in EFFECTS if getattr(method, name) is not None}
    assert on == {effect}


def test_a_stage_may_interpolate_instead():
    method = build(FULL, ["motion"], upsample=1.5)
    assert type(method.upsampler) is TrilinearUpsampler
    assert method.upsampler.scale == 1.5


def test_the_up_layer_refines_what_it_is_given():
    alone, after = build(FULL, ["upsampler"]), build(FULL, ["upsampler", "inpainter"])
    assert alone.upsampler.project.in_channels == 4
    assert after.upsampler.project.in_channels == after.inpainter.width == 16


def test_one_layer_makes_the_residual_the_inpainters_or_the_up_layers():
    assert build(FULL).inpainter.head is None
    assert build(FULL, ["inpainter"]).inpainter.head is not None
    assert build(FULL, upsample=2.0).inpainter.head is not None


def test_density_is_measured_in_the_unit():
    assert build(forward_model()).radiance.activation.density_scale == 0.3


def test_backward_takes_none_of_the_forward_effects():
    with pytest.raises(TypeError, match="unexpected keyword argument 'inpainter'"):
        backward_model(deformation=Deformation, inpainter=partial(UNet3d, levels=2))
    method = build(backward_model(deformation=Deformation))
    assert not any(hasattr(method, name) for name in ("motion", "upsampler", "inpainter"))


MODELS = {
    forward_model: (
        "radiance",
        "motion",
        "trajectory",
        "upsampler",
        "inpainter",
        "view_dependence",
        "background",
    ),
    backward_model: ("radiance", "view_dependence", "background", "deformation"),
}


@pytest.mark.parametrize(("make", "name"), [(make, name) for make in MODELS for name in MODELS[make]])
def test_refuses_a_ghost_of_the_configuration(make, name):
    with pytest.raises(
        ValueError, match=f"model.{name}: expected a factory or null, but got .*choose model/{name}=none"
    ):
        make(**{name: {"width": 3}})


def test_refuses_half_a_choice():
    with pytest.raises(ValueError, match="model.deformation: expected a factory, but got null"):
        backward_model()
    with pytest.raises(ValueError, match="model.trajectory: expected a factory, but got null"):
        forward_model(trajectory=None)
