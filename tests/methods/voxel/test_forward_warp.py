from functools import partial

import pytest
import torch

from forewarp.fields.radiance import FeatureRadiance
from forewarp.methods.voxel.effects.inpaint import UNet3d
from forewarp.methods.voxel.effects.upsample import LearnedUpsampler, TrilinearUpsampler
from forewarp.methods.voxel.forward_warp import ForwardWarp
from forewarp.methods.voxel.stage import EFFECTS
from forewarp.renderer import Renderer
from forewarp.scene.box import Lattice
from forewarp.scene.view import Moment
from tests.support.tiny_scene import BOX, built, camera_at, forward_model

LATTICE = Lattice(BOX, (7, 6, 5))
INPAINTER = partial(UNet3d, width=16, levels=2)


def build(effects=EFFECTS, frames=5, seed=0, **choices):
    """A method with random contents and random motion."""
    torch.manual_seed(seed)
    active = torch.zeros(LATTICE.shape, dtype=torch.bool)
    active[1:5, 1:5, 1:4] = True
    method = built(
        forward_model(**choices), LATTICE, active, frames=frames, canonical_time=0.3, effects=effects
    )
    for name in method.radiance.names:
        torch.nn.init.normal_(method.radiance.parameter(name))
    if method.motion is not None:
        torch.nn.init.normal_(method.motion.trajectory.network[-1].weight, std=0.02)
    return method


def picture(method, time, field=-1):
    rays = camera_at(0.1).rays()
    with torch.no_grad():
        fields = list(method.at(Moment(time)).fields.values())
        return Renderer()(fields[field], rays, torch.ones(3), method.view_dependence).rgb


def heads(method):
    return {n.split(".")[0] for n, _ in [*method.named_parameters(), *method.named_buffers()]}


def test_effects_that_are_off_own_no_parameters_and_no_buffers():
    off = build(motion=None, trajectory=None, view_dependence=None)
    assert heads(off) == {"radiance"}
    assert (off.motion, off.upsampler, off.inpainter, off.view_dependence) == (None, None, None, None)
    assert {n for n, _ in off.radiance.named_parameters()} == {"density", "color"}
    full = build(upsampler=partial(LearnedUpsampler, width=8), inpainter=INPAINTER)
    assert heads(full) == {"radiance", "motion", "upsampler", "inpainter"}  # harmonics own nothing
    assert heads(build(effects=(), upsampler=TrilinearUpsampler, inpainter=INPAINTER)) == {"radiance"}


def test_one_time_builds_no_motion():
    method = build(frames=1)
    assert method.motion is None
    assert torch.equal(picture(method, 0.0), picture(method, 0.9))


@pytest.mark.parametrize("choices", [{}, {"upsampler": TrilinearUpsampler}, {"inpainter": INPAINTER}])
def test_at_the_canonical_time_the_picture_is_the_unwarped_one(choices):
    moving, still = build(**choices), build(motion=None, trajectory=None, **choices)
    still.load_state_dict({k: v for k, v in moving.state_dict().items() if not k.startswith("motion.")})
    assert torch.equal(picture(moving, 0.3), picture(still, 0.3))
    assert not torch.equal(picture(moving, 0.9), picture(still, 0.9))
    state = moving.at(Moment(0.3))
    assert state.flow is None
    assert state.dropped == 0


def test_a_state_holds_what_was_computed():
    state = build().at(Moment(0.9))
    assert list(state.fields) == ["warped"]
    assert state.flow.shape == (4 * 4 * 3, 3)
    assert len(state.coverage) == len(state.fields["warped"].values)
    assert state.inpaint_difference is None


UPSAMPLERS = {"none": None, "trilinear": TrilinearUpsampler, "learned": partial(LearnedUpsampler, width=8)}


@pytest.mark.parametrize("time", [0.3, 0.9])
@pytest.mark.parametrize("upsampler", UPSAMPLERS)
@pytest.mark.parametrize("coverage", [False, True])
def test_the_inpainter_starts_as_the_identity_to_the_bit(time, upsampler, coverage):
    inpainter = partial(INPAINTER, coverage_channel=coverage)
    method = build(inpainter=inpainter, upsampler=UPSAMPLERS[upsampler])
    state = method.at(Moment(time))
    assert list(state.fields) == ["warped" if upsampler == "none" else "upsampled", "inpainted"]
    first, second = state.fields.values()
    assert first.lattice == second.lattice
    assert first.lattice.shape == ((7, 6, 5) if upsampler == "none" else (13, 11, 9))
    assert torch.equal(first.values, second.values)
    assert (state.inpaint_difference == 0).all()
    assert torch.equal(picture(method, time, 0), picture(method, time, 1))


@pytest.mark.parametrize("upsampler", UPSAMPLERS)
def test_without_an_inpainter_it_is_the_same_picture(upsampler):
    plain = build(upsampler=UPSAMPLERS[upsampler])
    inpainted = build(upsampler=UPSAMPLERS[upsampler], inpainter=INPAINTER)
    shared = {k: v for k, v in plain.state_dict().items() if not k.startswith("upsampler.")}
    inpainted.load_state_dict(shared, strict=False)
    torch.testing.assert_close(picture(plain, 0.9), picture(inpainted, 0.9), atol=1e-5, rtol=0)


def test_every_part_learns():
    method = build(upsampler=UPSAMPLERS["learned"], inpainter=INPAINTER)
    torch.nn.init.normal_(method.upsampler.head.weight)
    state = method.at(Moment(0.9))
    drawn = Renderer()(
        state.fields["inpainted"], camera_at(0.1).rays(), torch.ones(3), method.view_dependence
    )
    drawn.rgb.square().sum().backward()
    without = {n for n, p in method.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0}
    assert without == set()
    assert all(p.grad.isfinite().all() for p in method.parameters())


def test_features_through_a_network_serve_as_well():
    radiance = partial(FeatureRadiance, alpha_init=1e-2, alpha_threshold=0.0, grid_features=3, width=8)
    state = build(radiance=radiance).at(Moment(0.9))
    assert state.fields["warped"].values.shape[1] == 13


def test_everything_outside_the_box_leaves_an_empty_field():
    method = build()
    torch.nn.init.constant_(method.motion.trajectory.network[-1].bias, 100.0)
    state = method.at(Moment(0.9))
    assert state.dropped == 48
    assert len(state.fields["warped"].values) == 0
    assert torch.equal(picture(method, 0.9), torch.ones(24 * 24, 3))


def test_paths():
    points = torch.rand(4, 3)
    times = torch.tensor([0.3, 0.9])
    assert torch.equal(build(motion=None).trajectories(points, times), points[:, None].expand(4, 2, 3))
    moving = build().trajectories(points, times)
    assert torch.equal(moving[:, 0], points)
    assert not torch.equal(moving[:, 1], points)


@pytest.mark.parametrize("name", ["motion", "upsampler", "inpainter", "view_dependence"])
def test_refuses_a_ghost_of_the_configuration(name):
    with pytest.raises(
        ValueError, match=f"model.{name}: expected a module or null, but got dict; choose model/{name}=none"
    ):
        ForwardWarp(build().radiance, canonical_time=0.0, **{name: {"width": 16}})


def test_refuses_a_broken_scale_beside_an_inpainter():
    with pytest.raises(
        ValueError, match="model.upsampler.scale: expected a whole number beside an inpainter, but got 1.5"
    ):
        build(upsampler=partial(TrilinearUpsampler, scale=1.5), inpainter=INPAINTER)
