"""All parts of a fitted method are reached as ``module.method.<part>``."""

from functools import partial

import pytest
import torch

from forewarp.fields.radiance import DirectRadiance
from forewarp.fields.radiance_grid import RadianceGrid
from forewarp.methods.voxel.effects.background import StaticBackground, Together
from forewarp.methods.voxel.effects.inpaint import UNet3d
from forewarp.methods.voxel.effects.motion import Motion
from forewarp.methods.voxel.effects.upsample import LearnedUpsampler
from forewarp.methods.voxel.effects.view_dependence import SphericalHarmonics
from forewarp.methods.voxel.forward_warp import ForwardWarp
from forewarp.renderer import Renderer
from forewarp.scene.view import Moment, View
from tests.support.tiny_scene import ball_data, forward_model, make_run, stage

RENDERER = Renderer(step=0.7)
MODEL = forward_model(
    renderer=RENDERER,
    upsampler=partial(LearnedUpsampler, width=8),
    inpainter=partial(UNet3d, width=16, levels=2),
    background=partial(StaticBackground, features=3, alpha_init=1e-2, alpha_threshold=1e-4),
)


@pytest.fixture(scope="module")
def module(tmp_path_factory):
    """A fitted run of the paper's method with all effects."""
    data = ball_data(rays=64, size=16)
    fitting = stage(iterations=4, background_num_voxels=[[0, 8**3]])
    return make_run(tmp_path_factory.mktemp("run"), [fitting], data=data, model=MODEL).fit()


def test_a_module_wraps_fields_warper_inpainter_and_renderer(module):
    method = module.method
    assert type(method) is ForwardWarp
    wrapped = {name.removeprefix("method."): part for name, part in module.named_modules()}
    kinds = {
        "radiance": DirectRadiance,
        "motion": Motion,
        "upsampler": LearnedUpsampler,
        "inpainter": UNet3d,
        "view_dependence": SphericalHarmonics,
        "background": StaticBackground,
    }
    for name, kind in kinds.items():
        assert type(getattr(method, name)) is kind
        assert getattr(method, name) is wrapped[name]  # what Lightning trains, saves and moves
    assert method.renderer is RENDERER
    assert {id(p) for p in method.parameters()} == {id(p) for p in module.parameters()}


def test_a_newcomers_walk_from_the_canonical_field_to_a_picture(module):
    """The lines of ``ForwardWarp.at``, one after another, by hand."""
    method, moment = module.method, Moment(0.45)
    with torch.no_grad():
        canonical = method.radiance()
        assert isinstance(canonical, RadianceGrid)
        assert len(canonical.values) == len(method.radiance.voxels)
        flow = method.motion.flow(method.radiance, moment.time)
        assert flow.shape == (len(method.radiance.voxels), 3)
        warped, coverage, dropped = method.motion.warp(canonical, method.radiance.voxels, flow)
        assert len(coverage) == len(warped.values)
        fields, difference = method._inpaint(warped, coverage)
        still = method.background()
        together = Together(fields["inpainted"], still)
        view = View(ball_data(size=16).scene.test[1].camera)
        by_hand = method.renderer(together, view.rays(), torch.ones(3), method.view_dependence)

        snapshot = method.at(moment)
        assert snapshot.renderings == ("upsampled", "inpainted")
        assert (snapshot.moment, snapshot.dropped) == (moment, dropped)
        for ours, theirs in (
            (snapshot.canonical.values, canonical.values),
            (snapshot.flow, flow),
            (snapshot.coverage, coverage),
            (snapshot.inpaint_difference, difference),
            (snapshot.background.values, still.values),
            (snapshot.render(view, torch.ones(3)).rgb, by_hand.rgb),
        ):
            assert torch.equal(ours, theirs)
        assert torch.equal(module.render(view, moment, torch.ones(3)).rgb, by_hand.rgb)
        assert method.at(Moment(method.canonical_time)).flow is None  # there nothing is warped
