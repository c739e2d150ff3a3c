"""What the publications of NeRF, T-NeRF, D-NeRF, Nerfies and HyperNeRF let one check, and their gradients.

The networks here have a skip, as the published ones.
"""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from torch.autograd import gradcheck
from torch.testing import assert_close

from forewarp.fields.networks import ScrewWarp, TimeCodes
from forewarp.methods.rays import Sampling
from forewarp.ops.encode import positional_encoding
from forewarp.ops.nodes import geman_mcclure
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Moment, View
from tests.support.sampled_methods import GENTLE, KINDS, batch, learned, shown, start
from tests.support.still_cameras import camera, moving_scene, over_white, static_ceiling
from tests.support.tiny_scene import BOX, RADIUS, TRAVEL, ball_center, photograph

POINT = 3 * (1 + 2 * 3)  # channels of an encoded point of the small methods
SKIP = {"skip": 2}
SKIPS = SKIP | {"warp_skip": 2}
BENT = ("nerfies", "hypernerf")  # space, by a warp
NARROW = {"width": 8, "layers": 2, "position_frequencies": 1}
NARROW_WARP = {"warp_width": 8, "warp_layers": 2, "warp_frequencies": 2}


def skipping(kind, *, sampling=None, **changes):
    """A small method whose networks read their input again in the second layer."""
    torch.manual_seed(0)
    asked = Sampling(12, 12, **GENTLE) if sampling is None else sampling
    return KINDS[kind](start(), sampling=asked, **((SKIPS if kind in BENT else SKIP) | changes))


@torch.no_grad()
def liven(made):
    """Give heads that start near 0 values of the size of others."""
    for name, parameter in made.named_parameters():
        for part, factor in (("warp.turn", 1e3), ("warp.shift", 1e3), ("slice.head", 1e4)):
            if name == f"{part}.weight":
                parameter.mul_(factor)
    return made


def double_and_narrow(kind, fine_samples=0, **changes):
    """A method in float64 with few parameters, whose octaves and ambient coordinates are partly in."""
    sampling = Sampling(4, fine_samples, **GENTLE)
    changes = NARROW | (NARROW_WARP if kind in BENT else {}) | changes
    made = liven(skipping(kind, sampling=sampling, **changes)).double()
    made.advance(0.03, 1, None)
    return made


def points_in_double(count):
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(1)).double()


@pytest.mark.parametrize(
    ("kind", "changes"), [*((kind, {}) for kind in KINDS), ("dnerf", {"continuous": True})]
)
def test_gradients_of_a_field_against_differences(kind, changes):
    made = double_and_narrow(kind, **changes)
    points = points_in_double(3).requires_grad_()
    assert gradcheck(lambda x, *_: shown(made, 0.75, x), (points, *made.parameters()), fast_mode=True)


@pytest.mark.parametrize("of", ["coarse", "fine"])
def test_gradients_of_both_passes_against_differences(of):
    made = double_and_narrow("nerf", fine_samples=4)
    rays = View(camera(3)).rays().to(torch.float64)
    background = torch.ones(3, dtype=torch.float64)

    def looked(*_):
        seen = made.along(Moment(0.5), rays, background)
        return seen.rgb if of == "fine" else seen.coarse.rgb

    assert gradcheck(looked, tuple(getattr(made, of).parameters()), fast_mode=True)


def test_gradients_of_the_regularisers_against_differences():
    made = double_and_narrow("nerfies")
    points, warp = points_in_double(4), made.warp

    def strain(code, *_):
        return warp.elastic(points, code, 0.7)

    def stray(table, *_):
        return warp.stray(points, table, 0.7, None, torch.Generator().manual_seed(0))

    table = made.codes.table.detach().clone().requires_grad_()
    code = table.detach()[1].clone().requires_grad_()
    with torch.no_grad():  # so that the robust terms are not at their ends
        warp.shift.weight.mul_(0.05)
        warp.turn.weight.mul_(0.05)
    assert 0.02 < float(strain(code).detach().mean()) < 1.9
    assert gradcheck(strain, (code, *warp.parameters()), fast_mode=True)
    with torch.no_grad():
        warp.shift.weight.mul_(0.02)
        warp.turn.weight.mul_(0.02)
    assert 0.02 < float(stray(table).detach()) < 1.9
    assert gradcheck(stray, (table, *warp.parameters()), fast_mode=True)


def test_nerf_draws_the_same_picture_at_all_times():
    made, view, white = skipping("nerf"), View(camera()), torch.ones(3)
    with torch.no_grad():
        one, other = (made.at(Moment(time)).render(view, white) for time in (0.0, 0.7))
    assert one.rgb.equal(other.rgb)
    assert one.depth.equal(other.depth)
    one, other = (made.along(Moment(time), view.rays(), white) for time in (0.0, 0.7))
    assert one.coarse.rgb.equal(other.coarse.rgb)


@torch.no_grad()
def give_without(template, other, columns):
    """Give a template the weights of another that reads more channels, without these columns of its input."""
    state, own = dict(other.state_dict()), template.state_dict()
    for name, weight in state.items():
        if weight.shape != own[name].shape:
            kept = torch.ones(weight.shape[1], dtype=torch.bool)
            kept[columns] = False
            state[name] = weight[:, kept]
    template.load_state_dict(state)


def assert_look_alike(one, other, at=(0.25, 0.5)):
    for time in at:
        for ours, theirs in zip(shown(one, time), shown(other, time)):
            assert_close(ours, theirs)


def test_tnerf_without_the_columns_of_its_time_is_the_nerf_of_its_weights():
    timed, static = skipping("tnerf"), skipping("nerf")
    times = slice(POINT, POINT + 5)
    give_without(static.fine, timed.network, times)
    first, again = timed.network.trunk.layers[:2]
    for layer in (first, again):
        assert not shown(timed, 0.2)[0].equal(shown(timed, 0.3)[0])
        with torch.no_grad():
            layer.weight[:, times] = 0
    assert_look_alike(timed, static)


def test_dnerf_at_the_canonical_time_is_its_nerf_alone():
    made = skipping("dnerf")
    points = torch.randn(64, 3, generator=torch.Generator().manual_seed(3))
    toward = positional_encoding(torch.tensor([0.0, 0.6, 0.8]), 1).expand(64, -1)
    raw, color = made.template(positional_encoding(points, 3), toward)
    density, seen = shown(made, 0.0)
    assert density.equal(torch.nn.functional.softplus(raw))
    assert seen.equal(color)
    for time, moves in ((0.0, False), (0.5, True)):
        made.zero_grad(set_to_none=True)
        made.look(batch(time), {}, torch.Generator().manual_seed(0)).terms["photo"]().backward()
        met = {name for name, p in made.named_parameters() if p.grad is not None and p.grad.any()}
        parts = {"template"} | ({"offsets", "offset_head"} if moves else set())
        assert {name.split(".")[0] for name in met} == parts


def test_the_second_time_is_a_neighbours_side_and_offsets_are_summed():
    made, found = skipping("dnerf"), []

    def offset(points, time):
        found.append(time)
        return time * torch.ones_like(points)

    made.offset = offset
    seen, draw = SimpleNamespace(points=torch.zeros(7, 4, 3)), torch.Generator().manual_seed(0)
    for time, low, high in ((0.0, 0.0, 0.5), (0.5, 0.0, 1.0), (1.0, 0.5, 1.0)):
        term = made.extra_terms(seen, batch(time), {}, draw)["second_time"]
        between = []
        for _ in range(200):
            value = float(term())
            own, other = found[-2:]
            assert own == time
            assert value == pytest.approx(7 * 4 * 3 * (time - other) ** 2, rel=1e-4, abs=1e-6)
            between.append(other)
        between = torch.tensor(between)
        assert low <= float(between.min()) < low + 0.05
        assert high - 0.05 < float(between.max()) <= high
        assert float(between.mean()) == pytest.approx((low + high) / 2, abs=0.05)


def test_nerfies_starts_as_near_the_identity_as_published():
    torch.manual_seed(0)
    points, warp = 0.8 * torch.rand(500, 3) - 0.4, ScrewWarp(8)
    code = TimeCodes((0.0, 1.0), 8)(0.0)
    for window, published in ((0.0, 1.0e-4), (6.0, 1.3e-3)):
        moved = (warp(points, code, window) - points).norm(dim=-1).mean()
        assert float(moved.detach()) == pytest.approx(published, rel=0.5)


@pytest.mark.parametrize("kind", BENT)
def test_octaves_that_are_not_in_count_nowhere(kind):
    made = liven(skipping(kind))
    waves = slice(3, 3 + 36)
    for progress, matters in ((0.0, False), (1.0, True)):
        made.advance(progress, 1, None)
        for layer in made.warp.trunk.layers[:2]:  # the second reads the input again
            before = shown(made, 0.5)[0]
            with torch.no_grad():
                layer.weight[:, waves] += 1.0
            assert shown(made, 0.5)[0].equal(before) != matters


@pytest.mark.parametrize("factor", [2.0, 1.01])
def test_the_elastic_term_of_a_warp_that_scales(factor):
    warp = ScrewWarp(2, frequencies=1, width=6, layers=2, skip=None)
    eye = torch.eye(3)
    with torch.no_grad():
        for parameter in warp.parameters():
            parameter.zero_()
        warp.trunk.layers[0].weight[:, :3] = torch.cat([eye, -eye])  # one of x and -x passes the ReLU
        warp.trunk.layers[1].weight.copy_(torch.eye(6))
        warp.shift.weight.copy_((factor - 1) * torch.cat([eye, -eye], 1))
    points = torch.randn(9, 3)
    assert_close(warp(points, torch.zeros(2), 1.0), factor * points)
    found = warp.elastic(points, torch.zeros(2), 1.0)
    expected = geman_mcclure(torch.tensor(3 * math.log(factor) ** 2 / 0.03**2))
    assert_close(found, expected.expand(9), rtol=1e-4, atol=0)


def test_the_elastic_term_is_summed_over_coarse_samples_and_averaged_over_rays():
    made = liven(skipping("nerfies", elastic_samples=None))
    draw = torch.Generator().manual_seed(0)
    seen = made.along(Moment(0.5), View(camera()).rays(), torch.ones(3), draw)
    strain = made.warp.elastic(seen.coarse.points.reshape(-1, 3), made.codes(0.5), 0.0).detach()
    expected = float((seen.coarse.weights.detach().reshape(-1) * strain).sum() / 144)
    term = made.extra_terms(seen, batch(), {}, draw)["elastic"]
    found = term()
    found.backward()
    assert float(found.detach()) == pytest.approx(expected, rel=1e-4)
    assert made.warp.shift.weight.grad.any()
    assert all(p.grad is None for p in (*made.coarse.parameters(), *made.fine.parameters()))
    made.elastic_samples = 400  # of 144 x 12
    drawn = torch.stack([term().detach() for _ in range(30)])
    assert float(drawn.std()) > 0
    assert float(drawn.mean()) == pytest.approx(expected, rel=0.1)


def test_hypernerf_without_its_slice_is_the_nerfies_of_its_weights():
    sliced, bent = liven(skipping("hypernerf")), skipping("nerfies", camera_code_size=0)
    bent.codes.load_state_dict(sliced.codes.state_dict())
    bent.warp.load_state_dict(sliced.warp.state_dict())
    for which in ("coarse", "fine"):
        give_without(getattr(bent, which), getattr(sliced, which), slice(POINT, POINT + 4))
    bent.window.fill_(2.5)
    sliced.windows.copy_(torch.tensor([2.5, 0.0]))
    assert_look_alike(sliced, bent)
    views = [made.along(Moment(0.25), View(camera()).rays(), torch.ones(3)) for made in (sliced, bent)]
    for one, other in (views, [seen.coarse for seen in views]):
        assert_close(one.rgb, other.rgb)
    sliced.windows[1] = 1.0
    assert not shown(sliced, 0.25)[0].allclose(shown(bent, 0.25)[0])


def test_ambient_coordinates_of_0_are_encoded_as_sines_and_cosines_of_0():
    made, points = skipping("hypernerf"), torch.randn(5, 3)
    with torch.no_grad():
        made.slice.head.weight.zero_()
    for window, features in ((0.0, [0.0, 0.0, 0.0, 0.0]), (1.0, [0.0, 0.0, 1.0, 1.0])):
        made.windows.copy_(torch.tensor([6.0, window]))
        encoded = made.fields(Moment(0.5))[1].encoded(points)
        assert encoded.shape == (5, POINT + 4)
        assert encoded[:, POINT:].tolist() == [features] * 5


def one_view():
    scene = moving_scene()
    return replace(scene, train=scene.train[:1])


@pytest.mark.slow
def test_nerf_learns_one_still_view_by_heart(tmp_path):
    rgb = over_white(one_view().train[0].load())
    mean_color = float(-10 * torch.log10((rgb - rgb.mean((0, 1))).square().mean()))
    assert learned("nerf", tmp_path, one_view)[1] > mean_color + 15


WHEN = 0.25  # the ball has moved by half its radius


def shifted_ball(size=16):
    """A ball at two times, each seen by the same three cameras."""

    def seen(time, angle):
        middle = torch.tensor([-0.1, 0.1, 0.0])
        center = middle + torch.tensor([2.2 * math.sin(angle), -2.2 * math.cos(angle), 0.5])
        pose = look_at(center, middle, torch.tensor([0.0, 0.0, 1.0]))
        lens = Camera(size, size, 1.5 * size, 1.5 * size, size / 2, size / 2, pose, 1.2, 3.2)
        return Frame(f"r_{time}_{angle}", time, lens, partial(photograph, lens, time))

    train = tuple(seen(time, angle) for time in (0.0, WHEN) for angle in (-0.6, 0.0, 0.6))
    return Scene("ball", train, (), train[:1], BOX, 0.0, has_alpha=True)


@pytest.mark.slow
def test_dnerf_finds_the_shift_of_what_it_sees(tmp_path):
    images = torch.stack([frame.load() for frame in shifted_ball().train]).reshape(2, -1, 4)
    made, psnr = learned("dnerf", tmp_path, shifted_ball, iterations=600, rays=128)
    outward = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)))
    found = made.offset(ball_center(WHEN) + 0.9 * RADIUS * outward, WHEN).detach().median(0).values
    assert psnr > static_ceiling(images) + 3
    assert_close(found, -WHEN * torch.tensor(TRAVEL), atol=0.05, rtol=0)
