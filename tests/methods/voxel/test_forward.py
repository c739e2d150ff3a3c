from functools import partial

import pytest
import torch

from forewarp.methods.voxel.effects import LearnedUpsampler, TrilinearUpsampler
from forewarp.renderer import Renderer
from forewarp.scene.box import Lattice
from forewarp.scene.view import Moment
from tests.support.tiny_scene import BOX, INPAINTER, built, camera_at, forward_model

LATTICE = Lattice(BOX, (7, 6, 5))
UPSAMPLERS = {"none": None, "trilinear": TrilinearUpsampler, "learned": partial(LearnedUpsampler, width=8)}


def build(**choices):
    """A method with random contents and random motion."""
    torch.manual_seed(0)
    active = torch.zeros(LATTICE.shape, dtype=torch.bool)
    active[1:5, 1:5, 1:4] = True
    method = built(forward_model(**choices), LATTICE, active, canonical_time=0.3)
    for parameter in method.radiance.rows():
        torch.nn.init.normal_(parameter)
    if method.motion is not None:
        torch.nn.init.normal_(method.motion.trajectory.network[-1].weight, std=0.02)
    return method


def draw(method, time, field=-1):
    """The field of a rendering, drawn."""
    fields = list(method.at(Moment(time)).fields.values())
    return Renderer()(fields[field], camera_at(0.1).rays(), torch.ones(3), method.view_dependence).rgb


@pytest.mark.parametrize("choices", [{}, {"upsampler": TrilinearUpsampler}, {"inpainter": INPAINTER}])
def test_at_the_canonical_time_the_picture_is_the_unwarped_one(choices):
    moving, still = build(**choices), build(motion=None, trajectory=None, **choices)
    still.load_state_dict({k: v for k, v in moving.state_dict().items() if not k.startswith("motion.")})
    assert torch.equal(draw(moving, 0.3), draw(still, 0.3))
    assert not torch.equal(draw(moving, 0.9), draw(still, 0.9))
    state = moving.at(Moment(0.3))
    assert (state.flow, state.dropped) == (None, 0)


@pytest.mark.parametrize("upsampler", UPSAMPLERS)
@pytest.mark.parametrize("coverage", [False, True])
def test_the_inpainter_starts_as_the_identity_to_the_bit(upsampler, coverage):
    inpainter = partial(INPAINTER, coverage_channel=coverage)
    method = build(inpainter=inpainter, upsampler=UPSAMPLERS[upsampler])
    for time in (0.3, 0.9):
        state = method.at(Moment(time))
        assert list(state.fields) == ["warped" if upsampler == "none" else "upsampled", "inpainted"]
        first, second = state.fields.values()
        assert first.lattice == second.lattice
        assert first.lattice.shape == ((7, 6, 5) if upsampler == "none" else (13, 11, 9))
        assert torch.equal(first.values, second.values)
        assert (state.inpaint_difference == 0).all()
        assert torch.equal(draw(method, time, 0), draw(method, time, 1))


def test_every_part_learns():
    method = build(upsampler=UPSAMPLERS["learned"], inpainter=INPAINTER)
    torch.nn.init.normal_(method.upsampler.head.weight)
    draw(method, 0.9).square().sum().backward()
    without = {n for n, p in method.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0}
    assert without == set()
    assert all(p.grad.isfinite().all() for p in method.parameters())


def test_everything_outside_the_box_leaves_an_empty_field():
    method = build()
    torch.nn.init.constant_(method.motion.trajectory.network[-1].bias, 100.0)
    state = method.at(Moment(0.9))
    assert (state.dropped, len(state.fields["warped"].values)) == (48, 0)
    assert torch.equal(draw(method, 0.9), torch.ones(24 * 24, 3))
