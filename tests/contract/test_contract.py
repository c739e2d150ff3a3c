"""The contract, tested for every method in the table."""

import multiprocessing
import os
import signal
from contextlib import nullcontext
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import pytest
import torch

from forewarp.methods.method import HasBounds, HasMatter, HasTrajectories
from forewarp.scene.view import Moment, View
from forewarp.training.checkpoints import load_handover
from forewarp.training.objective import total
from tests.contract.fitting import Stop, batch_of, gradients_of, killed, module_of, run_of, stage_of
from tests.contract.scenes import DATASETS, TIMES, data_of
from tests.contract.table import METHODS
from tests.support.elsewhere import GPU, Elsewhere

WHITE = torch.ones(3)


def cost(name):
    """Methods whose parts another one has are tested by the slow tests alone."""
    return pytest.mark.slow if METHODS[name].slow else ()


each = pytest.mark.parametrize("name", [pytest.param(name, marks=cost(name)) for name in METHODS])
EFFECTS = [(name, effect) for name in METHODS for effect in METHODS[name].effects]
each_effect = pytest.mark.parametrize(("name", "effect"), EFFECTS)


def mostly_slow(name, dataset="dnerf"):
    """One method on one dataset is tested by the quick tests, too."""
    return () if (name, dataset) == ("particles", "dnerf") else pytest.mark.slow


each_mostly_slow = pytest.mark.parametrize("name", [pytest.param(n, marks=mostly_slow(n)) for n in METHODS])


def on(datasets):
    """Every method on every dataset."""
    pairs = [(name, dataset) for name in METHODS for dataset in datasets]
    params = [pytest.param(*pair, marks=mostly_slow(*pair), id="-".join(pair)) for pair in pairs]
    return pytest.mark.parametrize(("name", "dataset"), params)


def assert_equal_states(one, other):
    one, other = one.state_dict(), other.state_dict()
    assert one.keys() == other.keys()
    for key, value in one.items():
        if torch.is_tensor(value):
            assert torch.equal(value, other[key]), key


@each
@pytest.mark.parametrize("dataset", DATASETS)
def test_it_builds(name, dataset, scenes):
    data = data_of(dataset, scenes)
    module = module_of(METHODS[name], data)
    gradients = gradients_of(module, batch_of(data))
    assert module.last["loss"] > 0
    assert any(bool(g.any()) for g in gradients.values())


@pytest.mark.slow
@on(DATASETS)
def test_its_loss_falls(name, dataset, fitted):
    losses = fitted(name, dataset).losses
    assert len(losses) == METHODS[name].steps
    first, last = sum(losses[:5]) / 5, sum(losses[-10:]) / 10
    assert last < METHODS[name].falls * first


@on(DATASETS)
def test_a_checkpoint_gives_the_same_pictures(name, dataset, fitted):
    found = fitted(name, dataset)
    again = found.run.load()
    assert_equal_states(found.module, again)
    camera = data_camera(found)
    for time in (0.0, 0.37, 1.0):
        one, other = (m.render(camera, Moment(time), WHITE) for m in (found.module, again))
        for part in ("rgb", "depth", "opacity"):
            assert torch.equal(getattr(one, part), getattr(other, part)), (part, time)


def data_camera(found):
    return found.run.datamodule.scene.train[1].camera


@on(DATASETS)
def test_any_time_can_be_rendered(name, dataset, fitted):
    found = fitted(name, dataset)
    camera, times = data_camera(found), found.run.datamodule.scene.times
    for moment in (*map(Moment, (0.0, 1.0, times[1], 0.5 * (times[1] + times[2]))), Moment(times[2], 2, 0)):
        snapshot = found.module.method.at(moment)
        assert snapshot.moment == moment
        assert snapshot.holds(moment)
        for rendering in (None, *snapshot.renderings):
            with torch.no_grad():
                drawn = snapshot.render(View(camera), torch.tensor([0.2, 0.5, 0.9]), rendering)
            count = camera.width * camera.height
            assert drawn.rgb.shape == (count, 3)
            assert drawn.depth.shape == drawn.opacity.shape == (count,)
            assert all(bool(part.isfinite().all()) for part in (drawn.rgb, drawn.depth, drawn.opacity))
            assert bool(((drawn.opacity >= 0) & (drawn.opacity <= 1 + 1e-5)).all())
            assert bool((drawn.depth >= 0).all())
            assert drawn.opacity.amax() > 0.05  # something is there


@on(DATASETS)
def test_pixels_and_crops_are_parts_of_the_whole_picture(name, dataset, fitted):
    found = fitted(name, dataset)
    camera = data_camera(found)
    background = torch.rand(camera.width * camera.height, 3, generator=torch.Generator().manual_seed(1))
    pixels = torch.tensor([5, 3, 77, 5, camera.width * camera.height - 1])
    whole = found.module.render(View(camera), Moment(0.3), background)
    for view in (View(camera, pixels), View(camera, crop=(3, 2, 7, 9))):
        part = found.module.render(view, Moment(0.3), background[view.indices])
        for key in ("rgb", "depth", "opacity"):
            expected = getattr(whole, key)[view.indices]
            torch.testing.assert_close(getattr(part, key), expected, atol=1e-5, rtol=1e-5)


@each_mostly_slow
def test_gradients_and_all_terms_are_finite(name, scenes):
    data, entry = data_of("dnerf", scenes), METHODS[name]
    terms = module_of(entry, data).method.terms
    module = module_of(entry, data, weights=dict.fromkeys(terms, 1e-2))
    gradients = gradients_of(module, batch_of(data))
    assert gradients
    assert all(bool(g.isfinite().all()) for g in gradients.values())
    raw = {key: value for key, value in module.last.items() if key.startswith("loss")}
    assert {"loss", "loss/photo"} <= raw.keys() <= {"loss", *(f"loss/{term}" for term in terms)}
    assert all(torch.tensor(value).isfinite() for value in raw.values())


@each_mostly_slow
def test_every_parameter_has_one_rate(name, scenes):
    module = module_of(METHODS[name], data_of("dnerf", scenes))
    grouped = [id(p) for group in module.method.param_groups().values() for p in group]
    assert sorted(grouped) == sorted(map(id, module.method.parameters()))
    assert sum(len(g["params"]) for g in module.configure_optimizers().param_groups) == len(grouped)


@each_mostly_slow
def test_a_term_of_weight_zero_is_never_called(name, scenes):
    data, entry = data_of("dnerf", scenes), METHODS[name]
    terms = module_of(entry, data).method.terms
    for off in terms:
        module = module_of(entry, data, weights=dict.fromkeys(terms, 1e-2) | {off: 0.0})
        factors, batch = module.objective.factors(0), batch_of(data)
        assert off not in factors
        step = module.look(batch, factors)
        refusing = dict(step.terms) | {off: lambda off=off: pytest.fail(f"{off} was called")}
        _, raw = total(replace(step, terms=refusing), factors)
        assert off not in raw


def full_model(entry):
    """Return the model with all its effects."""
    return partial(entry.model, **{k: v for e in entry.effects.values() for k, v in e.on.items()})


@pytest.mark.slow
@each_effect
def test_an_effect_that_is_off_is_absent_and_one_that_is_on_is_called(name, effect, scenes, monkeypatch):
    entry, data = METHODS[name], data_of("dnerf", scenes)
    part = entry.effects[effect]
    for of, function in part.parts:
        monkeypatch.setattr(of, function, lambda *a, at=f"{of.__name__}.{function}", **k: pytest.fail(at))
    module = module_of(entry, data, model=partial(full_model(entry), **dict.fromkeys(part.on)))
    data.picker = lambda: TIMES - 1  # a time at which things have moved
    gradients_of(module, batch_of(data))
    assert not owned(module, part.owns or (effect,))
    module = module_of(entry, data, model=full_model(entry))
    assert part.parts or owned(module, part.owns or (effect,))
    with pytest.raises(pytest.fail.Exception) if part.parts else nullcontext():
        gradients_of(module, batch_of(data))


def owned(module, names):
    """What a method has stored under names that begin so."""
    return [key for key in module.method.state_dict() if key.startswith(names)]


STEPS, STOP = 14, 9


@pytest.fixture(scope="module")
def straight(scenes, tmp_path_factory):
    """``straight(name)`` returns the module after an uninterrupted run of a few steps."""

    @cache
    def fit(name):
        stages = [stage_of(METHODS[name], steps=STEPS)]
        return run_of(stages, data_of("dnerf", scenes), tmp_path_factory.mktemp("run")).fit()

    return fit


@each_mostly_slow
def test_two_runs_of_one_seed_are_equal(name, straight, scenes, tmp_path):
    torch.manual_seed(5)  # nothing that was drawn before matters
    again = run_of([stage_of(METHODS[name], steps=STEPS)], data_of("dnerf", scenes), tmp_path).fit()
    assert_equal_states(straight(name), again)
    assert straight(name).last == again.last


@pytest.mark.slow
@each
def test_a_run_that_was_stopped_continues_exactly(name, straight, scenes, tmp_path):
    stages = [stage_of(METHODS[name], steps=STEPS)]
    with pytest.raises(SystemExit):
        run_of(stages, data_of("dnerf", scenes), tmp_path, Stop(STOP)).fit()
    torch.manual_seed(5)
    told = []
    again = run_of(stages, data_of("dnerf", scenes), tmp_path, tell=told.append).fit()
    assert told == [f"fine: resuming at {STOP / STEPS:.0%}, step {STOP}"]
    assert_equal_states(straight(name), again)
    assert straight(name).last == again.last


@pytest.fixture(scope="module")
def clean():
    """A process context that forks from a server with everything imported and no thread pool started."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
        patch.setenv("OMP_NUM_THREADS", "1")
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["tests.contract.fitting"])
        yield context


@pytest.mark.slow
@each
def test_a_run_that_was_killed_continues_exactly(name, straight, scenes, tmp_path, clean):
    whole = straight(name)  # first: reads kernels, so that the child finds them compiled
    child = clean.Process(target=killed, args=(name, "dnerf", scenes, tmp_path, STOP, STEPS))
    child.start()
    child.join(300)  # on a busy machine the first one imports for a minute
    assert child.exitcode == -signal.SIGKILL
    assert os.listdir(tmp_path / "fine") == ["last.ckpt"]
    again = run_of([stage_of(METHODS[name], steps=STEPS)], data_of("dnerf", scenes), tmp_path).fit()
    assert_equal_states(whole, again)
    assert whole.last == again.last


@pytest.mark.slow
@pytest.mark.parametrize("place", ["after", "before"])
@each
def test_it_works_beside_a_voxel_stage(name, place, scenes, tmp_path):
    """Fit a stage of each method, then load the second without the first."""
    names, data = ("forward", name) if place == "after" else (name, "forward"), data_of("dnerf", scenes)
    stages = [stage_of(METHODS[n], s, steps=6) for n, s in zip(names, ("coarse", "fine"))]
    run = run_of(stages, data, tmp_path)
    module = run.fit()
    check_handover(load_handover(tmp_path / "coarse"), data.scene)
    check_handover(load_handover(tmp_path / "fine"), data.scene)
    assert_equal_states(module, run.load())


def check_handover(handover, scene):
    """Check that a handover is finite and near the scene."""
    around = scene.box.scaled(1.5)
    low, high = torch.tensor(around.low), torch.tensor(around.high)
    for corner in (handover.box.low, handover.box.high):
        assert bool(((torch.tensor(corner) >= low) & (torch.tensor(corner) <= high)).all())
    assert handover.frames_in_play == len(scene.train)
    if handover.cloud is None:
        return
    cloud = handover.cloud
    assert bool(((cloud.points >= low) & (cloud.points <= high)).all())
    for share in (cloud.colors, cloud.opacity):
        assert bool(((share >= 0) & (share <= 1)).all())
    if handover.paths is not None:
        assert handover.paths.shape == (len(cloud), len(handover.times), 3)
        away = (handover.paths - cloud.points[:, None]).norm(dim=-1)
        assert bool((away < scene.box.diagonal).all())  # which NaN is not
        canonical = handover.times == torch.tensor(scene.canonical_time, dtype=handover.times.dtype)
        assert bool((away[:, canonical] < 1e-4 * scene.box.diagonal).all())


def kinds_of(method, entry, losses):
    """Return what a method says of itself, by the heads of the columns of docs/results/conformance.md."""
    can = {"trajectories": HasTrajectories, "bounds": HasBounds, "matter": HasMatter}
    asks, share = method.asks, sum(losses[-10:]) / 10 / (sum(losses[:5]) / 5)
    asked = [f"{asks.kind} of side {asks.side}" if asks.kind == "crops" else asks.kind]
    asked += [f"{asks.neighbours} neighbouring times"] * bool(asks.neighbours)
    asked += [f"up to {asks.instant} pictures of the time"] * bool(asks.instant)
    return {
        "size in": method.size[0],
        "asks for": ", ".join(asked),
        "loss terms": ", ".join(method.terms),
        "effects": ", ".join(entry.effects) or "none",
        "abilities": ", ".join(word for word, kind in can.items() if isinstance(method, kind)) or "none",
        "loss falls": f"below {entry.falls:.0%} in {entry.steps} steps" if share < entry.falls else "**no**",
    }


@each
def test_what_it_says_it_can_do_it_does(name, fitted, record_property):
    found = fitted(name, "dnerf")
    method, scene = found.module.method, found.run.datamodule.scene
    for key, value in kinds_of(method, METHODS[name], found.losses).items():
        record_property(key, value)
    what, much = method.size
    assert isinstance(what, str)
    assert much > 0
    assert all(isinstance(v, str) for v in method.protocol().values())
    with torch.no_grad():
        if isinstance(method, HasMatter):
            cloud = method.matter()
            assert cloud.points.shape == cloud.colors.shape == (len(cloud), 3)
            assert cloud.opacity.shape == (len(cloud),)
            assert cloud.size > 0
        if isinstance(method, HasTrajectories):
            assert isinstance(method.moves, bool)
            points = torch.tensor([scene.box.center]).repeat(4, 1)
            paths = method.trajectories(points, torch.linspace(0, 1, 5))
            assert paths.shape == (4, 5, 3)
            assert bool(paths.isfinite().all())
        if isinstance(method, HasBounds) and (box := method.bounds(list(scene.times))) is not None:
            assert all(h > l for l, h in zip(box.low, box.high))


# Every method on a GPU that only pretends to be one: no operator is given tensors of two devices.


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_steps_and_a_picture_stay_on_their_device(scenes, name):
    data = data_of("dnerf", scenes)
    module = module_of(METHODS[name], data)
    method = module.method
    with Elsewhere():
        method.to("cuda")
        optimizer = module.configure_optimizers()
        for number in (1, 2):
            method.advance(number / 10, number, optimizer)
            gradients_of(module, batch_of(data).to("cuda"))
            optimizer.step()
        assert {p.device for p in method.parameters()} == {GPU}
        with torch.no_grad():
            drawn = method.at(Moment(0.5)).render(View(data.scene.train[0].camera), torch.ones(3).to("cuda"))
        assert {part.device for part in vars(drawn).values()} == {GPU}


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")
@pytest.mark.parametrize("name", METHODS)
def test_a_gpu_takes_the_step_that_the_cpu_takes(name, scenes, monkeypatch):
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    data, batch, found = data_of("dnerf", scenes), None, []
    for place in ("cpu", "cuda"):
        module = module_of(METHODS[name], data)
        batch = batch or batch_of(data)
        module.method.to(place)
        gradients = gradients_of(module, batch.to(place))
        found.append((module.last["loss"], {name: g.cpu().double() for name, g in gradients.items()}))
    (loss, here), (theirs, there) = found
    assert theirs == pytest.approx(loss, rel=1e-4)
    assert here.keys() == there.keys()
    for part, gradient in here.items():  # float32, and sums in another order
        assert (there[part] - gradient).norm() <= 0.01 * gradient.norm() + 1e-7, part
