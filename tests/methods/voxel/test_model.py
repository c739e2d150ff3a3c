from functools import partial

import pytest
import torch

from forewarp.effects.background import StaticBackground
from forewarp.effects.inpaint import UNet3d
from forewarp.effects.upsample import LearnedUpsampler, TrilinearUpsampler
from forewarp.effects.view import ViewNetwork
from forewarp.fields.radiance import FeatureRadiance
from forewarp.fields.trajectory import TrajectoryField
from forewarp.methods.backward_warp import Deformation
from forewarp.methods.spec import parameter_count, parameter_kinds
from forewarp.scene.box import Lattice
from forewarp.training.settings import EFFECTS
from tiny_scene import BOX, forward_spec

LATTICE = Lattice(BOX, (5, 4, 6))


def build(spec, effects=EFFECTS, **changes):
    options = {
        "unit": 0.3,
        "scene_box": BOX,
        "frames": 5,
        "canonical_time": 0.0,
        "effects": effects,
        "still": (LATTICE, torch.ones(LATTICE.shape, dtype=torch.bool)),
    } | changes
    return spec.build(LATTICE, torch.ones(LATTICE.shape, dtype=torch.bool), **options)


FULL = forward_spec(
    radiance=partial(FeatureRadiance, alpha_init=1e-2, skip_alpha=0.0, width=8),
    trajectory=partial(TrajectoryField, bases=3, nodes=8, features=2),
    view=ViewNetwork,
    upsampler=LearnedUpsampler,
    inpainter=partial(UNet3d, levels=2),
    background=partial(StaticBackground, features=3, alpha_init=1e-2, skip_alpha=0.0),
)


def test_every_parameter_has_one_kind():
    kinds = parameter_kinds(build(FULL))
    assert set(kinds) == {"density", "color", "grid", "flow", "network"}
    listed = [id(p) for parameters in kinds.values() for p in parameters]
    assert len(listed) == len(set(listed)) == len(list(build(FULL).parameters()))
    direct = parameter_kinds(build(forward_spec()))
    assert set(direct) == {"density", "color", "shading", "flow"}
    backward = forward_spec(warp="backward", deformation=Deformation, view=None)
    assert set(parameter_kinds(build(backward))) == {"density", "color", "flow"}


def test_parameter_count():
    method = build(forward_spec(motion=None, trajectory=None, view=None))
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
    assert build(forward_spec()).radiance.activation.unit == 0.3


def test_backward_takes_none_of_the_forward_effects():
    spec = forward_spec(warp="backward", deformation=Deformation, inpainter=partial(UNet3d, levels=2))
    assert not hasattr(build(spec), "inpainter")


@pytest.mark.parametrize("name", ["motion", "trajectory", "upsampler", "inpainter", "view", "deformation"])
def test_refuses_a_ghost_of_the_configuration(name):
    with pytest.raises(
        ValueError, match=f"model.{name}: expected a factory or null, but got .*choose model/{name}=none"
    ):
        forward_spec(**{name: {"width": 3}})


def test_refuses_half_a_choice():
    with pytest.raises(ValueError, match="model.warp: expected forward or backward, but got 'sideways'"):
        forward_spec(warp="sideways")
    with pytest.raises(ValueError, match="model.deformation: expected a factory, but got null"):
        forward_spec(warp="backward")
    with pytest.raises(ValueError, match="model.trajectory: expected a factory, but got null"):
        forward_spec(trajectory=None)
