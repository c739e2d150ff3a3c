"""Errors made on purpose: does the residual say what they go with?"""

import torch

from forewarp.methods.voxel.evidence import _explained, residual
from tests.support.tiny_scene import ball_data, forward_model, make_run, stage


def samples(views=24, places=30, seed=0):
    """Places (P, 3), unit directions (P, 3) and the picture of each: every picture sees all from one side."""
    generator = torch.Generator().manual_seed(seed)
    where = torch.rand(places, 3, generator=generator).repeat(views, 1) + 0.01
    towards = torch.nn.functional.normalize(torch.randn(views, 3, generator=generator), dim=-1)
    return where, towards.repeat_interleave(places, 0), torch.arange(views).repeat_interleave(places)


def test_an_error_linear_in_direction_is_explained():
    where, towards, views = samples()
    slope = torch.randn(3, 3, generator=torch.Generator().manual_seed(1))
    assert _explained(where, towards, towards @ slope, views, 0.05) > 0.6


def test_noise_is_not():
    where, towards, views = samples()
    noise = torch.randn(len(where), 3, generator=torch.Generator().manual_seed(2))
    assert _explained(where, towards, noise, views, 0.05) < 0.02


def test_an_error_of_the_place_alone_is_not():
    where, towards, views = samples()
    assert abs(_explained(where, towards, where.sin(), views, 0.05)) < 0.02


def test_what_is_met_nowhere_says_nothing():
    where, towards, views = samples()
    assert _explained(where * float("nan"), towards, where, views, 0.05) == 0


def test_of_a_fitted_ball(tmp_path):
    data = ball_data()
    run = make_run(tmp_path, [stage(iterations=60)], data=data, model=forward_model(view_dependence=None))
    module = run.fit()
    targets = [data.targets("train")[i] for i in range(6)]
    found = residual(module.method, targets, voxel_size=0.05, rays=300)
    drawn = sum(float(10 ** (-module.psnr_of(target) / 10)) for target in targets) / 6
    assert abs(10 ** (-found.psnr / 10) / drawn - 1) < 0.3  # from half of the pixels
    assert found.by_direction < 0.3
    coarser = residual(module.method, targets, voxel_size=0.4, rays=300)
    assert coarser.allowed < found.allowed
