"""A step of particles, their effects and rates, on every device and without kernels."""

import re
from dataclasses import replace

import pytest
import torch

from forewarp.data.batches import composited
from forewarp.methods.effect import switched
from forewarp.methods.method import Start
from forewarp.methods.particles import model
from forewarp.methods.particles.model import Particles
from forewarp.scene.view import Moment, View
from forewarp.training.checkpoints import misfits
from forewarp.training.objective import set_gradients
from tests.contract.fitting import Losses, run_of, stage_of
from tests.contract.table import METHODS
from tests.stability.report import BACKENDS, implementation
from tests.support.elsewhere import GPU, Elsewhere
from tests.support.particles import BARE, EVERY, FACTORS, data_of, look, module_with, shaken, small_data

DATA = small_data()


@pytest.mark.parametrize(
    "options", [{}, EVERY | {"view_dependence": 2}, {"rotation": None}, {"view_dependence": None}]
)
def test_gradients_are_those_of_autograd(options):
    """What a step gives by itself, against the image's graph; without jitter both see the same time."""
    module = module_with(DATA, numbers={"jitter": 0.0}, **options)
    method, generator = module.method, torch.Generator().manual_seed(0)
    for name, p in method.named_parameters():
        if name != "gaussians.means":  # round particles have no rotation
            p.data += 0.1 * torch.randn(p.shape, generator=generator)
    method.deformation.nodes.seen_times.copy_(torch.tensor([0.0, 1.0]))
    step = look(module, DATA, 3, {"photo": 1.0})
    seen = next(iter(DATA.train_dataloader())).observations[0]
    drawn = method.at(seen.moment).render(View(seen.view.camera), seen.background)
    straight = seen.rgb.float() / 255
    truth = torch.lerp(seen.background.expand(len(straight), 3), straight[:, :3], straight[:, 3:])
    loss = ((drawn.rgb - truth).square() + 0.05**2).sqrt().sub(0.05).sum() / method.covered_pixels
    loss.backward()
    assert float(step.terms["photo"]()) == pytest.approx(float(loss.detach()), rel=1e-3)
    for name, p in method.named_parameters():
        error = float((p.grad - step.gradients[name]).norm() / p.grad.norm().clamp(min=1e-9))
        assert error < 2e-3, name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("factors", "scale"), [({"photo": 1.0}, 1), ({"photo": 1.0}, 2), ({"photo": 1.0, "dssim": 0.2}, 1)]
)
def test_pixels_that_do_not_count_change_nothing(factors, scale, monkeypatch):
    monkeypatch.setattr(model, "SMALLEST", 10)
    DATA.asks = Particles.asks
    batch = next(iter(DATA.train_dataloader()))
    seen, steps = batch.observations[0], []
    valid = torch.zeros(seen.view.shape, dtype=torch.bool)
    valid[: len(valid) // 2] = True
    module = module_with(DATA, numbers={"jitter": 0.0, "image_scale": [[0, scale]]})
    shaken(module).method.deformation.nodes.seen_times.copy_(torch.tensor([0.0, 1.0]))
    for add in (0, 99):
        rgb = seen.rgb + (~valid.flatten())[:, None].byte() * add
        masked = replace(batch, observations=(replace(seen, rgb=rgb, valid=valid.flatten()),))
        module.method.small.clear()  # else the second image would be the first
        steps.append(module.method.look(masked, factors, module.generator))
    for name, gradient in steps[0].gradients.items():
        if "dssim" not in factors:  # a window of it may reach beyond the edge
            assert torch.equal(gradient, steps[1].gradients[name]), name
    assert steps[0].squared_error == steps[1].squared_error or "dssim" in factors
    seen = replace(seen, valid=valid.flatten())
    seen = seen if scale == 1 else seen.smaller(scale)
    drawn = module.method.at(seen.moment).render(View(seen.view.camera), seen.background)
    error = (drawn.rgb - composited(seen.rgb, seen.background))[seen.valid].square().mean()
    assert float(steps[0].squared_error) == pytest.approx(float(error.detach()), rel=1e-3)


def test_a_checkpoint_of_earlier_names_loads_and_renders_the_same():
    """Its names had no parts: ``means``, ``nodes.positions``, ``round``."""
    module, fresh = shaken(module_with(DATA, **EVERY)), module_with(DATA, **EVERY)
    state = {f"method.{name}": value for name, value in module.method.state_dict().items()}
    earlier = {re.sub(r"\.(gaussians|density|deformation)\.", ".", name): v for name, v in state.items()}
    assert not earlier.keys() & {name for name in state if name.count(".") > 1 and "exposure" not in name}
    assert misfits(fresh, fresh.method.current_names(earlier, "method.")) == []
    fresh.load_state_dict(earlier)
    view, black = View(DATA.scene.train[0].camera), torch.zeros(3)
    images = [made.method.at(Moment(0.3)).render(view, black).rgb for made in (module, fresh)]
    assert torch.equal(*images)
    for was, now in (
        ("nodes.bodies.of_node", "deformation.nodes.groups"),
        ("nodes.bodies.lead", "hook.bodies.lead"),
    ):
        assert Particles.current_names(module.method, {was: None}).keys() == {now}


def test_image_losses_are_weighted_with_the_photo_term():
    """Their gradients are those of the photo term, by its kernel, and of each loss by itself."""
    module, steps = module_with(DATA, numbers={"jitter": 0.0}), []
    shaken(module).method.deformation.nodes.seen_times.copy_(torch.tensor([0.0, 1.0]))
    for factors in ({"photo": 1.0}, {"dssim": 1.0}, {"photo": 2.0, "dssim": 0.5}):
        steps.append(look(module, DATA, 3, factors))
    assert all(step.terms.pop("depth")() is None for step in steps)
    photo, dssim, both = ({name: float(value()) for name, value in step.terms.items()} for step in steps)
    assert (both["photo"], both["dssim"]) == pytest.approx((photo["photo"], dssim["dssim"]), rel=1e-5)
    assert dssim["dssim"] > 0.01
    for name, gradient in steps[2].gradients.items():
        expected = 2.0 * steps[0].gradients[name] + 0.5 * steps[1].gradients[name]
        assert float((gradient - expected).norm()) <= 1e-4 * float(expected.norm()) + 1e-12, name


def test_images_are_smaller_at_first(monkeypatch):
    """A step compares with an image that is made once; its terms are a share of all of it, as before."""
    monkeypatch.setattr(model, "SMALLEST", 5)
    scales = {"image_scale": [[0, 4], [0.5, 2], [0.75, 1]], "jitter": 0.0}
    module, made, sizes = module_with(DATA, numbers=scales), [], {}
    smaller = model.Observation.smaller
    monkeypatch.setattr(model.Observation, "smaller", lambda seen, by: made.append(by) or smaller(seen, by))
    losses, compared = [], model.compare

    def compare(*args, **keys):
        sizes[of[0]] = len(args[5])
        return compared(*args, **keys)

    monkeypatch.setattr(model, "compare", compare)
    for progress in (0.0, 0.4, 0.5, 0.9):
        of = [progress]
        module.method.progress = progress
        losses.append(float(look(module, DATA, 3, {"photo": 1.0}).terms["photo"]()))
    assert sizes == {0.0: 25, 0.4: 25, 0.5: 100, 0.9: 400}
    assert made == [4, 2]
    assert losses[0] == losses[1]
    assert losses[0] == pytest.approx(losses[-1], rel=0.5)
    monkeypatch.setattr(model, "SMALLEST", 10)
    module.method.progress, of[0] = 0.0, "no smaller than that"
    look(module, DATA, 2, {"photo": 1.0})
    assert sizes[of[0]] == 100


def with_depth(data, shown=slice(None)):
    """The data with the depth of its images' pixels, measured where they show the ball."""
    scene = data.scene

    def measured(frame):
        depth = (frame.load()[..., 3] > 127) * 4.0
        return lambda: torch.stack([depth, torch.ones_like(depth)])

    train = list(scene.train)
    train[shown] = [replace(frame, load_sensed=measured(frame)) for frame in train[shown]]
    return data_of(replace(scene, train=tuple(train)))


@pytest.mark.parametrize("beside", [{}, {"dssim": 0.3}])
def test_depth_is_a_term_that_weighs_as_it_says(beside):
    data = with_depth(DATA)
    module = module_with(data, numbers={"jitter": 0.0}, weights={"photo": 1.0, "depth": 1.0})
    shaken(module).method.deformation.nodes.seen_times.copy_(torch.tensor([0.0, 1.0]))
    data.asks, steps = module.method.asks, []
    for factors in ({"photo": 1.0}, {"photo": 1.0, "depth": 1.0}, {"photo": 2.0, "depth": 0.5}):
        steps.append(look(module, data, 3, factors | beside))
    once, twice = (float(step.terms["depth"]()) for step in steps[1:])
    assert once == pytest.approx(twice, rel=1e-5)
    assert once > 0.01
    if beside:
        return
    for name, gradient in steps[2].gradients.items():
        expected = 1.5 * steps[0].gradients[name] + 0.5 * steps[1].gradients[name]
        assert float((gradient - expected).norm()) <= 1e-4 * float(expected.norm()) + 1e-12, name


def test_depth_is_not_asked_for_where_it_has_no_weight_or_no_sensor():
    data = with_depth(DATA, slice(1, 2))
    off = module_with(data, weights={"photo": 1.0, "depth": 0.0}).method
    assert (off.asks.sensed, off.has_planes) == (False, False)
    on = module_with(data, weights={"photo": 1.0, "depth": 1.0})
    assert (on.method.asks.sensed, on.method.has_planes) == (True, True)
    data.asks = on.method.asks
    factors = {"photo": 1.0, "depth": 1.0}
    found = [look(on, data, index, factors).terms["depth"]() for index in (0, 1)]
    assert found[0] is None
    assert float(found[1]) > 0


def test_two_views_of_a_time_count_as_one_step():
    module = module_with(DATA, numbers={"jitter": 0.0})
    batch = next(iter(DATA.train_dataloader()))
    twice = type(batch)(batch.observations * 2, batch.frame)
    one, two = (module.method.look(b, {"photo": 1.0}, module.generator) for b in (batch, twice))
    assert float(one.terms["photo"]()) == pytest.approx(float(two.terms["photo"]()), rel=1e-5)
    torch.testing.assert_close(
        *(step.gradients["gaussians.means"] for step in (one, two)), rtol=1e-3, atol=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("effect", [None, *EVERY])
def test_an_effect_that_is_off_is_absent_and_the_others_are_there(effect):
    module = module_with(DATA, **(BARE if effect is None else EVERY | {effect: None}))
    gone = set(EVERY) if effect is None else {effect}
    gone |= {"rotation", "background"} if effect == "motion" else set()
    assert {name for name, on in switched(module.method).items() if not on} == gone
    if "motion" in gone:
        step = look(module, DATA)
        assert all(step.terms[name]() is None for name in ("rigid", "smooth", "static"))
    if effect is None:
        names = {"means", "scales", "quaternions", "opacity", "colors"}
        assert set(module.method.values()) == set(module.method.param_groups()) == names
        assert not any(name.startswith("deformation.") for name in module.method.state_dict())


@pytest.mark.slow
@pytest.mark.parametrize(("options", "counts"), [(BARE, (1, 1, 1, 0, 1)), (EVERY, (6, 3, 6, 2, 3))])
def test_operators_get_nothing_of_what_is_off(monkeypatch, options, counts):
    seen, compare = [], model.compare
    monkeypatch.setattr(model, "compare", lambda *args, **keys: seen.append(args) or compare(*args, **keys))
    look(module_with(DATA, **options), DATA)
    particles, warp, _, color_basis, opacity_basis, *_ = seen[0]
    found = particles.colors.shape[1], particles.opacity.shape[1], warp.links.shape[1]
    assert (*found, len(color_basis), len(opacity_basis)) == counts
    assert bool(warp.weights.any()) == (options is EVERY)


def test_a_stage_uses_the_effects_that_it_names():
    module = module_with(DATA, **EVERY, numbers={"effects": ["rotation", "color_over_time"]})
    on = {name for name, is_on in switched(module.method).items() if is_on}
    assert on == {"color_over_time"}  # nothing rotates that does not move


def test_rates_of_lengths_are_of_the_scenes_extent():
    module = module_with(DATA)
    optimizer, extent = module.configure_optimizers(), float(module.method.extent)
    before = {g["name"]: g["lr"] for g in optimizer.param_groups}
    module.method.advance(0.5, 0, optimizer)
    factors = {g["name"]: g["lr"] / before[g["name"]] for g in optimizer.param_groups}
    expected = {"means": extent, "node_translations": extent, "skinning": len(DATA.scene.train) / 100}
    assert factors == pytest.approx(dict.fromkeys(before, 1.0) | expected)


def test_what_stands_right_before_a_camera_is_to_go():
    module = module_with(DATA)
    method, camera = module.method, DATA.scene.train[0].camera
    ahead = camera.rays(torch.tensor([camera.height // 2 * camera.width + camera.width // 2])).directions[0]
    method.gaussians.means.data[5] = (
        camera.center + 0.1 * ahead * (method.gaussians.means.data[5] - camera.center).norm()
    )
    look(module, DATA, 0)
    assert method.density.unseen_rounds.isinf().nonzero().flatten().tolist() == [5]


def test_particles_grow_to_what_the_images_call_for():
    numbers = {"density_interval": 0.1, "initial_share": 0.5, "density_until": 1.0, "density": 400.0}
    module = module_with(DATA, numbers=numbers)
    method, optimizer = module.method, module.configure_optimizers()
    assert len(method.gaussians.means) == round(0.5 * float(method.final_count))
    for number in range(1, 10):
        look(module, DATA)
        method.advance(number / 10, number, optimizer)
    assert len(method.gaussians.means) == pytest.approx(float(method.final_count), rel=0.05)
    assert (
        len(method.deformation.skinning.links)
        == len(method.density.gradient_sum)
        == len(method.gaussians.means)
    )
    start = Start(DATA.scene, "fine", {"density": 800.0}, range(3), before=method)
    assert int(Particles(start).final_count) == pytest.approx(2 * int(method.final_count), abs=1)


@pytest.mark.slow
def test_a_stage_and_its_queries_stay_on_their_device():
    options = EVERY | {"background": 10.0}
    numbers = {"density_interval": 0.1, "relink": 1, "density": 400.0, "density_until": 1.0, "rest_from": 0.3}
    with Elsewhere():
        module = shaken(module_with(DATA, **options, numbers=numbers))
        method, camera = module.method.to("cuda"), DATA.scene.train[0].camera
        optimizer = module.configure_optimizers()
        method.warm_up()
        begun = len(method.gaussians.means)
        for number in range(1, 6):
            method.advance(number / 10, number, optimizer)
            DATA.picker = lambda number=number: number
            batch = next(iter(DATA.train_dataloader())).to("cuda")
            step = method.look(batch, FACTORS, module.generator)
            set_gradients(method, step.gradients)  # which refuses those of another device
            optimizer.step()
        assert {t.device for t in method.state_dict().values()} == {GPU}
        assert len(method.gaussians.means) > begun
        assert method.deformation.resting.any()
        snapshot = method.at(Moment(0.6, 2, 0))
        assert (snapshot.holds(Moment(0.6)), snapshot.holds(Moment(0.61))) == (True, False)
        for view in (View(camera), View(camera, torch.tensor([3, 4])), View(camera, crop=(1, 1, 4, 4))):
            drawn = snapshot.render(view, torch.ones(3))
            assert {part.device for part in vars(drawn).values()} == {GPU}
        points, times = torch.zeros(5, 3), torch.tensor([0.2, 0.8])
        found = [method.trajectories(points.to("cuda"), times.to("cuda"))]
        found += method.movement([0.1, 0.9]).values()
        for cloud in (method.matter(), method.ellipsoids(0.3), method.template()):
            found += [part for part in vars(cloud).values() if isinstance(part, torch.Tensor)]
        assert {part.device for part in found} == {GPU}
        assert method.bounds([0.0, 0.5]) is not None
        after = Particles(Start(DATA.scene, "fine", {}, range(3), before=method), **options)
        assert {t.device.type for t in after.state_dict().values()} == {"cpu"}


@pytest.mark.slow
def test_without_numba_particles_learn_the_same(tmp_path):
    pytest.importorskip("numba")
    found = {}
    for name in BACKENDS:
        losses = Losses()
        with implementation(name):
            run_of([stage_of(METHODS["particles"], steps=8)], small_data(), tmp_path / name, losses).fit()
        found[name] = losses.values
    assert len(found["reference"]) == 8
    assert found["reference"] == pytest.approx(found["Numba"], rel=0.02)
