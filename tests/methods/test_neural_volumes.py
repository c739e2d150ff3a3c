"""Neural Volumes: sizes, priors, warp and march, and what it can learn."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from torch.autograd import gradcheck

from forewarp.methods import neural_volumes
from forewarp.methods.method import Start, parameter_count
from forewarp.methods.neural_volumes import (
    AffineMixture,
    NeuralVolumes,
    PictureEncoder,
    VolumeDecoder,
    Volumes,
)
from forewarp.scene.camera import Rays
from forewarp.scene.frame import Frame
from forewarp.scene.view import Batch, Moment, Observation, View
from tests.support.sampled_methods import learns_what_moves, psnr_after
from tests.support.still_cameras import TIMES, camera, moving_scene, picture

SMALL = {"picture_size": (16, 16), "tower": (8, 16), "features": 32, "code": 12, "decoder": (32, 16, 16, 8)}
SMALL |= {"maps": 4, "warp_side": 6, "warp_width": 16, "weight_width": 8, "step": 1 / 16}
WHITE = torch.ones(3)
MENDED = {"from_identity": True, "first_opacity": 0.1, "first_deviation": 0.05, "jitter_in_pictures": False}
KIND = partial(NeuralVolumes, **SMALL, **MENDED)
WEIGHTS = {"photo": 104.04, "code_prior": 1e-3, "opacity_prior": 1e-2, "opacity_variation": 1e-2}


def method(scene=None, kind=KIND, **options):
    torch.manual_seed(0)
    return kind(Start(scene or moving_scene(), "fine", {}), **options)


def rig(cameras=(0, 1, 2, 3), times=TIMES):
    """Several fixed cameras at every instant."""
    frames = (
        Frame(f"{c}_{t}", t, camera(), partial(picture, t), camera_id=c) for t in times for c in cameras
    )
    return replace(moving_scene(), train=tuple(frames))


def drawn(made, time=0.5, camera_id=0):
    return made.at(Moment(time, camera=camera_id)).render(View(camera()), torch.ones(3))


def solid(opacity, side=4, **options):
    """A cube of one colour and opacity, without a warp."""
    template = torch.full((4, side, side, side), 0.25)
    template[3] = opacity
    warp = method(**options).warp.lattice.permute(3, 0, 1, 2)
    return Volumes(template, warp)


def test_published_count_of_four_cameras():
    start = Start(rig(), "fine", {}, blank=True)
    with torch.device("meta"):
        assert parameter_count(NeuralVolumes(start)) == 114_807_524 + 4 * 6


@pytest.mark.parametrize(("opacity", "reached"), [(0.3, 0.6), (0.2, 0.4), (2.0, 1.0)])
@pytest.mark.parametrize("seed", [None, 0])
def test_opacity_adds_up_along_a_ray(opacity, reached, seed):
    rays = Rays(torch.tensor([[0.1, -3.0, 0.2], [9.0, -3.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]] * 2), 1, 9)
    draw = None if seed is None else torch.Generator().manual_seed(seed)
    seen = method().march(solid(opacity), rays, torch.tensor([1.0, 0.5, 0.0]), None, draw)
    torch.testing.assert_close(seen.opacity, torch.tensor([reached, 0.0]), atol=2 * opacity / 16, rtol=0)
    behind = torch.tensor([1.0, 0.5, 0.0])
    expected = seen.opacity[:, None] * 0.25 + (1 - seen.opacity[:, None]) * behind
    torch.testing.assert_close(seen.rgb, expected)
    assert seen.depth[1] == 0
    assert 2 < float(seen.depth[0]) < 3.1


def test_priors_at_known_values():
    for opacity, value in ((0.0, 0.0), (1.0, 0.0), (0.5, 1.186)):
        prior = neural_volumes.opacity_prior(torch.full((5,), opacity))
        assert float(prior) == pytest.approx(value, abs=1e-3)
    assert float(neural_volumes.code_prior(torch.zeros(4), torch.zeros(4))) == 0
    assert float(neural_volumes.code_prior(torch.ones(4), torch.zeros(4))) == pytest.approx(0.5)
    assert float(neural_volumes.opacity_variation(torch.full((3, 4, 5), 0.3))) == pytest.approx(1e-5**0.5)
    step = torch.ones(3, 3, 3)
    step[2] = torch.e
    assert float(neural_volumes.opacity_variation(step)) == pytest.approx((1 + 1e-5**0.5) / 2, rel=1e-4)


def maps_of(**options):
    """A warp whose maps do not depend on the code."""
    options = {"from_identity": False} | options
    warp = AffineMixture(4, maps=3, side=6, width=8, weight_width=8, **options)
    with torch.no_grad():
        for head in (warp.scale, warp.turn, warp.shift):
            head[-1].weight.zero_()
            head[-1].bias.zero_()
    return warp


def test_maps_start_as_the_identity_or_as_released_as_any():
    warp = maps_of(from_identity=True)
    torch.testing.assert_close(warp(torch.randn(4)).permute(1, 2, 3, 0), warp.lattice)
    assert not maps_of(from_identity=False)(torch.randn(4)).any()


def test_weights_of_maps_go_on_beyond_the_cube():
    warp = maps_of()
    warp.scale[-1].bias.data.copy_(torch.tensor([3.0] * 3 + [0.5] * 3 + [1.0] * 3))
    found = warp(torch.zeros(4))  # a code for which all weights are 1
    torch.testing.assert_close(found.permute(1, 2, 3, 0), (3.0 + 0.5 + 1.0) / 3 * warp.lattice)


def released_deviation(layer, gain):
    """Return the standard deviation of first weights by the released code: Glorot's, of the weights that an
    output of the layer reads.
    """
    size = layer.weight[0, 0].numel() // (8 if isinstance(layer, torch.nn.ConvTranspose3d) else 1)
    return gain * (2 / (sum(layer.weight.shape[:2]) * size)) ** 0.5


@pytest.mark.slow
def test_first_values_are_the_released_ones():
    torch.manual_seed(0)
    leaky = (2 / 1.04) ** 0.5
    encoder = PictureEncoder(1, (32, 32), tower=(16, 32), width=64, code=24)
    decoder = VolumeDecoder(24, (1024, 512, 512, 256, 256, 128, 128))
    warp = AffineMixture(24, maps=16, side=8, width=128, weight_width=64, from_identity=False)
    before_leaky = [encoder.towers[0][0], encoder.towers[0][2], encoder.joined, decoder.first]
    before_leaky += [decoder.grow[-2], warp.scale[0], warp.weight[0]]
    last = [encoder.mean, encoder.deviation, decoder.grow[-1], warp.turn[-1], warp.shift[-1], warp.weight[-1]]
    with torch.no_grad():
        for layer, gain in [(layer, leaky) for layer in before_leaky] + [(layer, 1.0) for layer in last]:
            deviation = released_deviation(layer, gain)
            assert not layer.bias.any()
            assert float(layer.weight.std()) == pytest.approx(deviation, rel=0.1)
            assert 0.9 < float(layer.weight.abs().max()) / (3**0.5 * deviation) <= 1.0001
    blocks = decoder.grow[-1].weight.unflatten(2, (2, 2)).unflatten(4, (2, 2)).unflatten(6, (2, 2))
    assert blocks.equal(blocks[:, :, :, :1, :, :1, :, :1].expand_as(blocks))
    assert not blocks[:, :, 0].equal(blocks[:, :, 1])


def test_a_map_scales_turns_and_shifts():
    warp = maps_of(from_identity=True)
    for head, bias in (
        (warp.scale, [1.0, 0.0, 0.0]),
        (warp.turn, [0.0, 0.0, 0.0, 1.0]),  # (1, 0, 0, 1): a quarter about z
        (warp.shift, [2.0, 0.0, 0.0]),
    ):
        head[-1].bias.data.copy_(torch.tensor(bias).repeat(3))
    found = warp.moved(torch.randn(4), torch.tensor([[1.2, 0.5, 0.3]]))
    expected = torch.tensor([[[-1.0, 1.0, 0.3]]]).expand(3, 1, 3)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)  # 1e-5 is added to squared lengths


def test_a_volume_is_read_with_x_last_and_points_on_its_corners():
    volume = torch.zeros(1, 3, 4, 5)
    volume[0, 0, 3, 4] = 1.0
    points = torch.tensor([[1.0, 1.0, -1.0], [0.75, 1.0, -1.0], [1.5, 1.0, -1.0]])
    torch.testing.assert_close(neural_volumes.read(volume, points)[:, 0], torch.tensor([1.0, 0.5, 0.0]))


def test_pictures_are_of_cameras_that_see_every_instant():
    shapes = [made.pictures.shape[:2] for made in (method(rig()), method(rig(), pictures=2), method())]
    assert shapes == [(3, 3), (3, 2), (3, 1)]
    scene = moving_scene()
    alone = replace(scene, train=tuple(replace(frame, camera_id=None) for frame in scene.train))
    assert method(alone).gain is None
    with pytest.raises(ValueError, match="model.pictures: .* at most 1, .* 3; set model.pictures=null"):
        method(pictures=3)


def test_a_picture_is_fitted_over_white():
    rgba = torch.zeros(4, 8, 4, dtype=torch.uint8)
    rgba[:, 4:] = torch.tensor([10, 20, 30, 255], dtype=torch.uint8)
    small = neural_volumes.fitted_picture(rgba, (6, 8))
    assert (small[:, 1:5, :2] == 255).all()
    assert small[:, 1, 7].tolist() == [10, 20, 30]
    assert (small[:, [0, 5]] == 100).all()  # the mean of pictures, which the encoder reads as 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"picture_size": (18, 16)}, r"picture_size: expected .* in multiples of 4.*\[18, 16\]"),
        ({"first_opacity": -1.0}, r"first_opacity: expected a number > 0 or null, but got -1"),
        ({"first_deviation": 0.0}, r"first_deviation: expected a number > 0 or null, but got 0"),
        ({"step": 0.0}, r"step: expected a length in \(0, 1\], but got 0.0"),
    ],
)
def test_wrong_numbers_are_refused(options, message):
    with pytest.raises(ValueError, match=f"^model.{message}"):
        method(**options)


def test_codes_between_times_are_interpolated():
    made = method()
    first, second = (made.encoded(i)[0] for i in (0, 1))
    assert made.code_at(0.5).equal(second)
    torch.testing.assert_close(made.code_at(0.125), 0.75 * first + 0.25 * second)
    assert not first.equal(second)


@pytest.mark.parametrize("jitter", [False, True])
def test_pictures_are_drawn_alike(jitter):
    made, jittered = (method(jitter_in_pictures=jitters) for jitters in (jitter, not jitter))
    with torch.no_grad():
        first, again, plain = (drawn(one).rgb for one in (made, made, jittered))
        made.pictures[1] = 0
        other = drawn(made).rgb
    assert first.equal(again)
    assert not first.equal(other)  # time enters through the pictures alone
    assert not first.equal(plain)


def test_gains_are_of_known_cameras():
    made = method(rig((0, 1, 500_000)))
    assert made.gain.shape == made.bias.shape == (3, 3)
    with torch.no_grad():
        before = drawn(made, camera_id=0).rgb
        assert drawn(made, camera_id=7).rgb.equal(before)
        made.gain[2] = 2.5
        made.bias[2] = 0.3 * 255
        changed = {camera_id: drawn(made, camera_id=camera_id).rgb for camera_id in (0, 500_000, 7)}
        made.gain.fill_(1.5)
        made.bias.fill_(25.5)
        mean = drawn(made, camera_id=0).rgb
    assert changed[0].equal(before)
    assert not changed[500_000].equal(before)
    torch.testing.assert_close(changed[7], mean)  # of a camera that took no training picture


def batch(*cameras):
    """Views of one picture by cameras of these ids."""
    rgb = torch.rand(144, 3, generator=torch.Generator().manual_seed(0))
    return Batch(tuple(Observation(Moment(0.5, camera=c), View(camera()), rgb, WHITE) for c in cameras), 0)


def test_each_view_of_a_batch_is_seen_by_the_gains_of_its_camera():
    made = method(rig((1, 4)))
    made.gain.data[1] = 2.0
    both, first, second = (
        made.look(batch(*cameras), WEIGHTS, torch.Generator().manual_seed(0))
        for cameras in ((1, 4), (1, 1), (4, 4))
    )
    both.terms["photo"]().backward()
    assert made.gain.grad.ne(0).all()
    assert made.bias.grad.ne(0).all()
    whole, ones, others = (dict(step.tensors())["rgb"].detach() for step in (both, first, second))
    torch.testing.assert_close(whole, torch.cat([ones[:144], others[144:]]))
    assert not ones.allclose(others)


def test_a_dead_start_is_named():
    made, draw = method(first_opacity=200.0), torch.Generator().manual_seed(0)
    for _ in range(19):
        made.look(batch(None), {}, draw)
    with pytest.raises(ValueError, match="all clear or all opaque in each of 20 steps.*; set it to 0.1, or"):
        made.look(batch(None), {}, draw)
    assert "set it to 0.1" not in method().dead_start.advice


def test_a_step_reaches_every_parameter():
    made = method()
    step = made.look(batch(0), WEIGHTS, torch.Generator().manual_seed(0))
    values = {name: term() for name, term in step.terms.items()}
    assert values["photo"].item() == step.squared_error.item()
    assert set(values) == set(NeuralVolumes.terms)
    sum(WEIGHTS[name] * value for name, value in values.items()).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() and p.grad.any() for p in made.parameters())
    assert {"code", "template", "warp", "rgb"} == {name for name, _ in step.tensors()}


def test_the_released_faults_and_what_mends_them_are_named():
    released = {"first_opacity": None, "jitter_in_pictures": True}
    assert [fault.split()[-1] for fault in method(**released).faults()] == [f"({key})" for key in released]
    mended = method()
    assert mended.faults() == []
    for note in ("the warp starts near the identity", "first opacity 0.1", "pictures are drawn without"):
        assert note in mended.protocol()["departures"]


def test_gradients_against_differences():
    made = method(decoder=(8, 4), maps=2, warp_side=3, code=4).double()
    rays = View(camera(3)).rays()

    def look(code):
        volumes = made.volumes(code)
        seen = made.march(volumes, rays, torch.ones(3).double(), made.tint(0))
        return seen.rgb.sum(), seen.opacity.sum(), neural_volumes.opacity_variation(volumes.template[3])

    assert gradcheck(look, [torch.randn(4, dtype=torch.float64, requires_grad=True)])


@pytest.mark.slow
def test_one_view_is_learned_beyond_the_background_alone(tmp_path):
    scene = replace(moving_scene(), train=moving_scene().train[:1])
    truth = scene.train[0].load().double() / 255
    bare = -10 * torch.log10((truth[..., 3:] * (1 - truth[..., :3])).square().mean())
    how = {"read": lambda: scene, "rays": 144, "iterations": 60}
    assert psnr_after(KIND, tmp_path, WEIGHTS, **how) > bare + 3


@pytest.mark.slow
def test_it_learns_what_moves(tmp_path):
    assert learns_what_moves(KIND, tmp_path, WEIGHTS, rays=144, iterations=300)
