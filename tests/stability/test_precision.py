"""Half precision: convolutions may run in it under autocast, places and densities may not (cases 21, 22)."""

from functools import partial

import pytest
import torch

from forewarp.fields.networks import mlp
from forewarp.methods.voxel.backward import Deformation
from forewarp.renderer import Renderer
from forewarp.scene.box import Lattice
from forewarp.scene.view import Moment
from tests.support.tiny_scene import (
    BOX,
    EVERYTHING,
    INPAINTER,
    backward_model,
    built,
    camera_at,
    forward_model,
)

pytestmark = pytest.mark.stability

MODELS = {
    "everything": forward_model(**EVERYTHING | {"background": None}),
    "inpainter": forward_model(inpainter=INPAINTER),
    "backward": backward_model(deformation=partial(Deformation, width=16, layers=2)),
    "forward": forward_model(),
}


def method_of(choice, device):
    torch.manual_seed(0)
    lattice = Lattice(BOX, (8, 7, 6))
    made = built(MODELS[choice], lattice, density_scale=lattice.voxel_size)
    for parameter in made.parameters():  # nothing starts from zero, or half of it has no gradient
        parameter.data += 0.05 * torch.randn(parameter.shape)
    return made.to(device)


def picture(method, device):
    state = method.at(Moment(0.7))
    field = list(state.fields.values())[-1]
    drawn = Renderer()(
        field, camera_at(0.1, 8).rays().to(device), torch.ones(3, device=device), method.view_dependence
    )
    return state, drawn


@pytest.mark.parametrize("choice", MODELS)
def test_autocast_changes_what_convolutions_say_and_no_place_and_no_density(device, choice):
    method = method_of(choice, device)
    with torch.no_grad():
        state, drawn = picture(method, device)
    with torch.autocast(device.type, dtype=torch.bfloat16):
        other, half = picture(method, device)
        loss = (half.rgb - 0.3).square().mean()
    assert torch.equal(state.canonical.values, other.canonical.values)
    if state.flow is not None:
        assert torch.equal(state.flow, other.flow)
    exact = getattr(MODELS[choice], "inpainter", None) is None
    torch.testing.assert_close(drawn.rgb, half.rgb, atol=1e-4 if exact else 0.05, rtol=0)
    assert exact or not torch.equal(drawn.rgb, half.rgb)
    loss.backward()
    for name in ("rgb", "depth", "opacity", "weights", "colors"):
        assert getattr(half, name).dtype == torch.float32
        assert getattr(half, name).isfinite().all()
    for name, parameter in method.named_parameters():
        assert parameter.grad is None or parameter.grad.isfinite().all(), name


def test_a_network_given_half_precision_answers_in_full(device):
    made, half = mlp(3, 2, width=8, layers=3).to(device), torch.bfloat16
    x = torch.randn(5, 3, device=device)
    with torch.autocast(device.type, dtype=half):
        assert torch.equal(made(x), made(x.clone()))
        assert made(x.to(half)).dtype == torch.float32
    torch.testing.assert_close(made(x.to(half)), made(x.to(half).float()))
    assert made.double()(x.double()).dtype == torch.float64
