from dataclasses import replace

import pytest
import torch

from forewarp.methods.effect import switched
from forewarp.methods.method import Start
from forewarp.methods.particles import density, model
from forewarp.methods.particles.model import Particles
from forewarp.methods.particles.options import Numbers
from forewarp.methods.particles.start import widths
from forewarp.ops.gaussians import moved
from forewarp.scene.view import Moment, View
from tests.contract.scenes import data_of, write_hypernerf
from tests.support.kernels import watch
from tests.support.particles import EVERY, MOVING, look, module_with


@pytest.mark.parametrize(
    "options", [{}, EVERY | {"view_dependence": 2}, {"rotation": None}, {"view_dependence": None}]
)
def test_gradients_are_those_of_autograd(data, options):
    """What a step gives by itself, against the picture's graph; without jitter both see the same time."""
    module = module_with(data, numbers={"jitter": 0.0}, **options)
    method = module.method
    generator = torch.Generator().manual_seed(0)
    for name, p in method.named_parameters():
        if name != "means":  # round particles have no turn
            p.data += 0.1 * torch.randn(p.shape, generator=generator)
    method.nodes.seen.copy_(torch.tensor([0.0, 1.0]))
    data.picker = lambda: 3
    batch = next(iter(data.train_dataloader()))
    step = method.look(batch, {"photo": 1.0}, module.generator)
    seen = batch.observations[0]
    drawn = method.at(seen.moment).render(View(seen.view.camera), seen.background)
    straight = seen.rgb.float() / 255
    truth = torch.lerp(seen.background.expand(len(straight), 3), straight[:, :3], straight[:, 3:])
    loss = ((drawn.rgb - truth).square() + 0.05**2).sqrt().sub(0.05).sum() / method.covered
    loss.backward()
    assert float(step.terms["photo"]()) == pytest.approx(float(loss.detach()), rel=1e-3)
    for name, p in method.named_parameters():
        error = float((p.grad - step.gradients[name]).norm() / p.grad.norm().clamp(min=1e-9))
        assert error < 2e-3, name


@pytest.mark.slow
def test_particles_of_opaque_pictures_begin_no_larger_than_they_are_apart_there(data, tmp_path):
    write_hypernerf(tmp_path / "hypernerf")
    opaque = data_of("hypernerf", tmp_path)
    for scene, limited in ((opaque.scene, True), (replace(opaque.scene, has_alpha=True), False)):
        opaque.scene = scene
        method = module_with(opaque).method
        widest = widths(scene, method.means.data, float(method.covered))
        larger = method.log_scales.data.exp()[:, 0] > 1.001 * widest
        assert bool(larger.any()) != limited


def test_with_all_effects_off_there_are_bare_particles(data):
    method = module_with(data, **dict.fromkeys(MOVING)).method
    assert not method.moves
    assert set(dict(method.named_parameters())) == {"means", "log_scales", "turns", "opacity", "color"}
    assert not set(dict(method.named_buffers())) & {"skin.links", "skin.shares"}
    assert set(method.param_groups()) == set(dict(method.named_parameters()))
    assert set(switched(method).values()) == {False}


@pytest.mark.parametrize("effect", EVERY)
def test_an_effect_that_is_off_is_absent_and_the_others_are_there(data, effect):
    method = module_with(data, **EVERY | {effect: None}).method
    gone = {effect} | ({"rotation", "background"} if effect == "motion" else set())
    assert {name for name, on in switched(method).items() if not on} == gone


def test_operators_get_nothing_of_what_is_off(data, monkeypatch):
    seen = {}

    def spied(name):
        kept = getattr(model, name)

        def spy(*given, **named):
            seen[name] = given
            return kept(*given, **named)

        monkeypatch.setattr(model, name, spy)

    spied("compare")
    look(module_with(data, **dict.fromkeys(MOVING)), data)
    particles, warp, _, tints, fades, *_ = seen["compare"]
    assert particles.colors.shape[1] == particles.opacity.shape[1] == warp.links.shape[1] == 1
    assert (len(tints), fades.tolist(), int(warp.weights.count_nonzero())) == (0, [1.0], 0)
    look(module_with(data, **EVERY), data)
    particles, warp, _, tints, fades, *_ = seen["compare"]
    assert (particles.colors.shape[1], particles.opacity.shape[1], warp.links.shape[1]) == (6, 3, 6)
    assert (len(tints), len(fades)) == (2, 3)


def test_a_stage_uses_the_effects_that_it_names(data):
    module = module_with(data, **EVERY, numbers={"effects": ["rotation", "color_over_time"]})
    on = {name for name, is_on in switched(module.method).items() if is_on}
    assert on == {"color_over_time"}  # nothing turns that does not move


def test_what_appears_later_is_not_thrown_away(data):
    module = module_with(data, **EVERY, numbers={"every": 0.1})
    method, optimizer = module.method, module.configure_optimizers()
    method.opacity.data.fill_(-20.0)
    method.fade.data[:3, 0] = -15.0  # the first cosine falls from 0 to -2
    assert (density.most_opaque(method) > 0).nonzero()[:, 0].tolist() == [0, 1, 2]
    method.advance(0.15, 1, optimizer)
    assert len(method.means) == 3


def test_without_motion_its_terms_are_none(data):
    step = look(module_with(data, motion=None), data)
    assert step.terms["rigid"]() is None
    assert step.terms["smooth"]() is None


@pytest.mark.parametrize("motion", ["spline", "cosines"])
def test_points_go_with_the_particles_beside_them(data, motion):
    method = module_with(data, motion=motion).method
    generator = torch.Generator().manual_seed(0)
    for p in method.nodes.parameters():
        p.data += 0.05 * torch.randn(p.shape, generator=generator)
    method.skin.learned.data += torch.randn(method.skin.learned.shape, generator=generator)
    times = torch.tensor([method.canonical_time, 0.7])
    place, later = (moved(method.means.data, method.warp(float(time)))[0] for time in times)
    paths = method.trajectories(place[:20], times)
    torch.testing.assert_close(paths[:, 0], place[:20])
    torch.testing.assert_close(paths[:, 1], later[:20], atol=2e-3, rtol=0)  # others are near, too
    assert float((paths[:, 1] - paths[:, 0]).norm(dim=-1).amin()) > 0.01
    beside = place[:20] + 0.1 * torch.randn(20, 3, generator=generator)
    torch.testing.assert_close(method.trajectories(beside, times[:1])[:, 0], beside)


def test_a_snapshot_holds_its_time(data):
    snapshot = module_with(data).method.at(Moment(0.5, 2, 0))
    assert snapshot.holds(Moment(0.5))
    assert not snapshot.holds(Moment(0.51))


def test_rates_of_lengths_are_of_the_scenes_extent(data):
    module = module_with(data)
    optimizer = module.configure_optimizers()
    extent, before = float(module.method.extent), {g["name"]: g["lr"] for g in optimizer.param_groups}
    module.method.advance(0.5, 0, optimizer)
    changed = {g["name"]: g["lr"] / before[g["name"]] for g in optimizer.param_groups}
    assert {name: factor for name, factor in changed.items() if factor != 1} == pytest.approx(
        {"means": extent, "shifts": extent, "skin": len(data.scene.train) / 100}
    )


def test_what_stands_right_before_a_camera_is_to_go(data):
    module = module_with(data)
    method, camera = module.method, data.scene.train[0].camera
    ahead = camera.rays(torch.tensor([camera.height // 2 * camera.width + camera.width // 2])).directions[0]
    method.means.data[5] = camera.center + 0.1 * ahead * (method.means.data[5] - camera.center).norm()
    data.picker = lambda: 0
    method.look(next(iter(data.train_dataloader())), {"photo": 1.0}, module.generator)
    assert method.idle.isinf().nonzero().flatten().tolist() == [5]


def test_what_is_opaque_can_still_fade(data):
    module = module_with(data)
    method, optimizer = module.method, module.configure_optimizers()
    method.opacity.data.fill_(20.0)  # 1 in float32, without a slope
    method.advance(0.5, 0, optimizer)
    assert method.opacity.sigmoid().min() > 0.997
    gradient = look(module, data).gradients["opacity"]
    assert (gradient[method.shown > 0] != 0).float().mean() > 0.9


def test_what_is_opaque_at_some_time_can_still_fade(data):
    module = module_with(data, opacity_over_time=3)
    method, optimizer = module.method, module.configure_optimizers()
    solid = method.opacity.data
    solid[:4, 0] = torch.tensor([20.0, 5.0, -8.0, 6.0])
    before = solid.clone()
    method.fade.data[1:3, 0] = -9.0  # the first cosine falls from 0 to -2
    method.fade.data[3:, 0] = 2.0
    method.advance(0.5, 0, optimizer)
    assert solid[:4, 0].tolist() == pytest.approx([6.0, -12.0, -12.0, 6.0])
    assert torch.equal(solid[4:], before[4:])
    fades = torch.stack([method.over_time(i / 64)[1] for i in range(65)])
    logits = method.gaussians().opacity.detach() @ fades.T
    assert float(logits.amax()) == pytest.approx(6.0, abs=1e-4)


def test_without_opacity_over_time_only_what_is_too_opaque_changes(data):
    module = module_with(data)
    solid, optimizer = module.method.opacity.data, module.configure_optimizers()
    solid[:, 0] = torch.linspace(-20, 20, len(solid))
    before = solid.clone()
    module.method.advance(0.5, 0, optimizer)
    assert torch.equal(solid, before.clamp(max=6.0))


@pytest.mark.parametrize("share", [0.0, 1e-3, 0.2])
def test_a_picture_takes_opacity_of_what_it_shows_as_the_rate_falls(data, share):
    module = module_with(data, numbers={"opacity_decay": share, "settled": 0.0})
    method, optimizer = module.method, module.configure_optimizers()
    (group,) = (group for group in optimizer.param_groups if group["name"] == "opacity")
    method.means.data[:3] = 90.0  # beside every picture
    method.opacity.data[:, 0] = torch.linspace(-8, 6, len(method.opacity))
    for factor in (1.0, 0.25, 0.0):
        group["lr"] = factor * group["base_lr"]
        before = method.opacity.data.clone()
        method.advance(0.5, 0, optimizer)
        method.shown.zero_()
        look(module, data)
        assert torch.equal(method.opacity.data, before)  # a step that is dropped changes nothing
        method.opacity.grad = torch.zeros_like(method.opacity)
        optimizer.step()
        wanted = torch.where(method.shown[:, None] > 0, 1 - factor * share, 1.0).double()
        assert 0 < int(method.shown.sum()) < len(wanted) - 3
        left = method.opacity.data.double().sigmoid() / before.double().sigmoid()
        torch.testing.assert_close(left, wanted, rtol=1e-5, atol=0)
        assert torch.equal(method.opacity.data, before) == (factor * share == 0)
    group["base_lr"] = group["lr"] = 0.0  # what does not learn does not decay
    method.advance(0.5, 0, optimizer)
    look(module, data)
    optimizer.step()
    assert torch.equal(method.opacity.data, before)


def test_a_dropped_step_takes_no_opacity(data):
    module = module_with(data, numbers={"opacity_decay": 0.1})
    method, optimizer = module.method, module.configure_optimizers()
    method.advance(0.5, 0, optimizer)
    before = method.opacity.data.clone()
    look(module, data)
    optimizer.step()  # no gradients
    method.opacity.grad = torch.zeros_like(method.opacity)
    optimizer.step()  # nor is it made up for
    assert torch.equal(method.opacity.data, before)


def test_what_is_crowded_decays(data):
    module = module_with(data, numbers={"opacity_decay": 0.1, "crowd_decay": 0.5, "density": 400.0})
    method, optimizer = module.method, module.configure_optimizers()
    most = float(method.most)
    assert most > 2 * float(method.covered)
    for covered, wanted in ((most / 4, 1 - 0.9 * (1 - 0.375)), (most, 0.1), (2 * most, 0.1), (0.0, 0.55)):
        method.covered.fill_(covered)
        method.advance(0.5, 0, optimizer)
        assert method.decay == pytest.approx(wanted)


def test_particles_grow_to_what_the_pictures_call_for(data):
    numbers = {"every": 0.1, "first": 0.5, "settled": 1.0, "density": 400.0}  # some hundreds, of 6 pictures
    module = module_with(data, numbers=numbers)
    method, optimizer = module.method, module.configure_optimizers()
    assert len(method.means) == round(0.5 * float(method.most))
    for number in range(1, 10):
        look(module, data)
        method.advance(number / 10, number, optimizer)
    assert len(method.means) == pytest.approx(float(method.most), rel=0.05)
    assert len(method.skin.links) == len(method.pulled) == len(method.means)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"view_dependence": 4}, "model.view_dependence: expected a degree of 1 to 3, or null, but got 4"),
        (
            {"color_over_time": 0},
            "model.color_over_time: expected a number of cosines >= 1, or null, but got 0",
        ),
        (
            {"rotation": False},
            "model.rotation: expected true, or null, but got False; choose model/rotation=none",
        ),
        ({"motion": "wobble"}, "model.motion: expected spline or cosines, or null, but got 'wobble'"),
        (
            {"numbers": {"effects": ["glow"]}},
            r"stage.fine.effects: expected some of motion, .*, but got \['glow'\]",
        ),
        ({"numbers": {"first": 0.0}}, r"stage.fine.first: expected a number in \(0, 1\], but got 0.0"),
        ({"numbers": {"density": -1.0}}, "stage.fine.density: expected a number > 0, but got -1.0"),
        ({"numbers": {"edges": 0}}, "stage.fine.edges: expected a whole number >= 1, but got 0"),
        ({"numbers": {"jitter": "some"}}, "stage.fine.jitter: expected a number >= 0, but got 'some'"),
    ],
)
def test_refused(data, changes, text):
    with pytest.raises(ValueError, match=text):
        module_with(data, **changes)


def test_numbers_follow_the_pictures():
    numbers = Numbers()
    assert numbers.most(4.0, 100) == numbers.most(4.0, 200) == 180
    assert numbers.most(4.0, 25) == 90  # fewer pictures tell less
    assert numbers.share_at(0.0) == 0.5
    assert numbers.share_at(1.0) == 1.0
    assert numbers.motion(100, 2)[1] == 4
    assert numbers.motion(20_000, 200)[0] > numbers.motion(5_000, 200)[0]


def test_two_views_of_a_time_count_as_one_step(data):
    module = module_with(data, numbers={"jitter": 0.0})
    data.picker = lambda: 2
    batch = next(iter(data.train_dataloader()))
    twice = type(batch)(batch.observations * 2, batch.frame)
    one, two = (module.method.look(b, {"photo": 1.0}, module.generator) for b in (batch, twice))
    assert float(one.terms["photo"]()) == pytest.approx(float(two.terms["photo"]()), rel=1e-5)
    torch.testing.assert_close(one.gradients["means"], two.gradients["means"], rtol=1e-3, atol=1e-6)


def test_the_first_steps_meet_warm_kernels_only(data, monkeypatch):
    met = watch(monkeypatch, "project", "rasterize", "backward", "nodes", "adam")
    module = module_with(data, **EVERY)
    module.method.warm_up()
    warm = met.copy()
    met.clear()
    optimizer = module.configure_optimizers()
    look(module, data)
    for group in optimizer.param_groups:
        for p in group["params"]:
            p.grad = torch.ones_like(p)
    optimizer.step()
    assert len(met) > 5
    assert met <= warm


def test_a_stage_has_as_many_particles_as_its_own_density_says(data):
    first = module_with(data).method
    start = Start(data.scene, "fine", {"density": 2 * first.stage.density}, range(3), before=first)
    assert int(Particles(start).most) == pytest.approx(2 * int(first.most), abs=1)
