"""Gain and bias of all colours over time."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from forewarp.methods.particles.exposure import basis_at, count_of, gain_and_bias, lit, to_unlit
from forewarp.methods.particles.model import Particles
from forewarp.metrics.image import psnr
from forewarp.scene.view import Moment, View
from tests.contract.fitting import run_of, stage_of
from tests.contract.table import METHODS, RATES
from tests.support.particles import BARE, MOVING, data_of, module_with, shaken, small_data
from tests.support.tiny_scene import ball_scene


def drift(time):
    """A gain over time, 1 on average."""
    return 1 + 0.25 * math.cos(2 * math.pi * time)


def filmed(frame):
    """A frame as a phone takes it whose exposure drifts."""
    rgba = frame.load().float()
    rgba[..., :3] *= 0.75 * drift(frame.time)
    pixels = rgba.clamp(0, 255).round().to(torch.uint8)
    return replace(frame, load=lambda: pixels)


def drifting():
    """A scene of a moving ball, with an exposure that drifts."""
    scene = ball_scene(frames=16, size=20)
    parts = {name: tuple(map(filmed, getattr(scene, name))) for name in ("train", "test")}
    return data_of(replace(scene, **parts))


def fitted(data, folder, **options):
    """A run on a scene."""
    entry, lr = METHODS["particles"], RATES | {"exposure": 1e-2}
    model = partial(Particles, **MOVING | {"view_dependence": None} | options)
    return run_of([stage_of(entry, model=model, lr=lr, steps=500)], data, folder).fit().method


@pytest.mark.slow
def test_a_drift_is_told_from_the_scene_and_held_out_images_are_lit_by_it(tmp_path):
    data, scores = drifting(), []
    for name, options in (("with", {"exposure": 3}), ("without", {})):
        method = fitted(data, tmp_path / name, **options)
        for target in data.targets("test"):
            drawn = method.at(target.moment).render(View(target.frame.camera), target.background).rgb
            scores.append(psnr(drawn.detach().reshape(target.rgb.shape), target.rgb))
        if name == "with":
            moments = [Moment(time, filmed=True) for time in (0.0, 0.25, 0.5)]
            lights = [method.light(moment).detach() for moment in moments]
            greys = torch.stack([0.4 * gain + bias for gain, bias in lights]).mean(1)
            expected = torch.tensor([drift(time) for time in (0.0, 0.25, 0.5)])
            torch.testing.assert_close(greys / greys[1], expected, atol=0.12, rtol=0)
    assert sum(scores[:3]) / 3 > sum(scores[3:]) / 3 + 0.5


def test_only_images_of_the_cameras_that_filmed_are_lit():
    data = small_data()
    method = shaken(module_with(data, **BARE | {"exposure": 1})).method
    view, behind = View(data.scene.train[0].camera), torch.zeros(3)

    def drawn(moment):
        return method.at(moment).render(view, behind).rgb.detach()

    scene = drawn(Moment(0.0))
    assert not torch.equal(drawn(Moment(0.0, filmed=True)), scene)
    assert torch.equal(drawn(Moment(0.0, camera=7, filmed=True)), scene)
    assert not method.at(Moment(0.0)).holds(Moment(0.0, filmed=True))


def test_gradients_lead_back_as_those_of_autograd():
    draw = partial(torch.randn, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    colors, asked, basis = [draw(7, 1, 3), draw(7, 3, 3)], draw(7, 4, 3), [1.0, 0.4, -0.7]
    leaves = [t.requires_grad_() for t in (*colors, 0.1 * draw(3, 2, 3))]
    light = gain_and_bias(leaves[2], basis)
    expected = torch.autograd.grad((lit(torch.cat(leaves[:2], 1), light) * asked).sum(), leaves)
    with torch.no_grad():
        by_colors, by_exposure = to_unlit(leaves[:2], asked.split([1, 3], 1), light, basis)
    torch.testing.assert_close((*by_colors, by_exposure), expected)


def test_cameras_that_film_together_have_exposures_of_their_own():
    scene = ball_scene(frames=8)
    assert count_of(12, scene) == 2
    rig = replace(scene, train=tuple(replace(f, camera_id=i % 2) for i, f in enumerate(scene.train)))
    together = replace(scene, train=(*scene.train, *scene.train))
    assert count_of(12, rig) == count_of(12, together) == 0


def test_the_scene_itself_is_lit_as_its_film_is_on_average():
    coefficients = 0.1 * torch.randn(5, 2, 3, generator=torch.Generator().manual_seed(0))
    times = [(i + 0.5) / 100 for i in range(100)]
    lights = torch.stack([gain_and_bias(coefficients, basis_at(5, time, False)) for time in times])
    torch.testing.assert_close(lights.mean(0), torch.tensor([[1.0] * 3, [0.0] * 3]))
    assert basis_at(2, 0.3, is_window=True)[0] == 1.0  # of which the mean may differ
