"""Particles trained under bad conditions: odd scenes, too high rates, other units of length, all sizes."""

import copy
from dataclasses import replace
from functools import cache, partial

import pytest
import torch

from forewarp.data.module import SceneDataModule
from forewarp.fields.curves import Curve
from forewarp.methods.particles import start
from forewarp.methods.particles.deformation import Deformation
from forewarp.methods.particles.gaussians import GaussianModel
from forewarp.methods.particles.model import Particles
from forewarp.methods.particles.nodes import Nodes
from forewarp.ops.gaussians import BLUR
from forewarp.scene.box import Box
from forewarp.scene.camera import Lens
from forewarp.scene.view import Moment
from tests.contract.fitting import module_of, stage_of
from tests.contract.table import METHODS
from tests.stability.test_training import FEW, SCENE, Diary, in_other_units, pictured
from tests.support.particles import BARE, EVERY, look, module_with, shaken, small_data
from tests.support.tiny_scene import ball_scene, make_run, photograph

pytestmark = pytest.mark.stability

ENTRY = METHODS["particles"]
OPTIONS = EVERY | {"color_over_time": 1, "opacity_over_time": 1}
NUMBERS = {"density": 20.0, "density_interval": 0.01}  # of longer runs
LONGER = 600  # steps of these


def fit(folder, scene, steps, rates=1.0, weights=ENTRY.weights, **numbers):
    """A fitted module of particles with all effects, and the losses of its steps."""
    diary, lr = Diary(), {kind: rates * rate for kind, rate in ENTRY.lr.items()}
    method, numbers = partial(Particles, **OPTIONS), ENTRY.numbers | numbers
    stage = stage_of(ENTRY, steps=steps, lr=lr, numbers=numbers, model=method, weights=weights)
    run = make_run(folder, [stage], data=SceneDataModule(lambda: scene, rays=1), callbacks=[diary])
    return run.fit(), diary.losses


def fit_longer(folder, scene, steps=LONGER):
    """A module fitted for longer, by the weights of the presets, and the mean PSNR of its test views, dB."""
    module, _ = fit(folder, scene, steps, weights={"photo": 1.0, "rigid": 1.0, "smooth": 8.0}, **NUMBERS)
    data = SceneDataModule(lambda: scene, rays=1)
    data.setup("test")
    return module, sum(float(module.psnr_of(target)) for target in data.test_dataloader()) / len(scene.test)


HARD = {
    **{f"times {t}": (ball_scene(size=16, times=t, canonical_time=t[0]), {}) for t in FEW[::3]},
    "white on white": (pictured(SCENE, 255), {}),
    "without matter": (pictured(SCENE, 0), {}),
    "one opaque image": (replace(SCENE, train=SCENE.train[:1], has_alpha=False), {}),
    "a camera inside the box": (replace(SCENE, box=Box((-5, -5, -5), (5, 5, 5))), {}),
    "a scene 1e-6 thin": (replace(SCENE, box=Box((-1, -0.8, -1e-6), (1.2, 0.8, 1e-6))), {}),
    **{f"rates {rates} too high": (SCENE, {"steps": 20, "rates": rates}) for rates in (10.0, 300.0)},
    "jitter of all time there is": (SCENE, {"jitter": 3.0}),
}


def check_sound(module, losses, scene, steps):
    """It took all its steps, is made of numbers, and so is what it draws."""
    assert len(losses) == steps
    assert all(0 <= loss < 1e4 for loss in losses)
    for part, value in module.method.state_dict().items():
        assert not value.is_floating_point() or value.isfinite().all(), part
    assert len(module.method.gaussians.means) >= 1
    drawn = module.render(scene.test[0].camera, Moment(0.5), torch.ones(3))
    assert all(plane.isfinite().all() for plane in (drawn.rgb, drawn.depth, drawn.opacity))


@pytest.mark.slow
@pytest.mark.parametrize("name", HARD)
def test_hard_scenes_train(tmp_path, name):
    scene, options = HARD[name]
    options = {"steps": 6} | options
    module, losses = fit(tmp_path, scene, **options)
    check_sound(module, losses, scene, options["steps"])


def coincide(method):
    """Put all particles at one place, and all nodes."""
    method.gaussians.means.data[:] = method.gaussians.means.data[:1]
    points, nodes = method.gaussians.means.data, method.deformation.nodes
    nodes.__init__(points, 6, nodes.curve, rests=True, edges=nodes.edges.shape[1])
    method.deformation.skinning.__init__(nodes, points)


BAD = {
    "all outside the view": lambda m: m.gaussians.means.data.add_(90.0),
    "all at a camera": lambda m: m.gaussians.means.data.copy_(
        SCENE.train[0].camera.center.expand_as(m.gaussians.means)
    ),
    "opacity 0": lambda m: m.gaussians.opacity.data.fill_(-1e4),
    "opacity 1": lambda m: m.gaussians.opacity.data.fill_(1e4),
    "all faded, so that none would be left": lambda m: m.gaussians.opacity.data.fill_(-5.0),
    "all faded but one": lambda m: m.gaussians.opacity.data[1:].fill_(-5.0),
    "quaternions of length 0": lambda m: m.gaussians.quaternions.data.zero_(),
    "scales of 0": lambda m: m.gaussians.scales.data.fill_(-1e4),
    "scales of e^40": lambda m: m.gaussians.scales.data.fill_(40.0),
    "nodes that coincide": coincide,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BAD)
def test_bad_beginnings_train(tmp_path, monkeypatch, name):
    """As a step too long may have left it; density control and new links come in between."""
    made = Particles.__init__

    def spoiled(self, start, **options):
        made(self, start, **options)
        BAD[name](self)

    monkeypatch.setattr(Particles, "__init__", spoiled)
    monkeypatch.setattr(start, "first_points", lambda of, count, shell: start.anywhere(of.scene.box, count))
    module, losses = fit(tmp_path, SCENE, 8, density_interval=0.2, relink=1)
    assert int(module.method.density.round) >= 2
    check_sound(module, losses, SCENE, 8)


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "has_alpha"), [(1e-3, True), (2.0**14, False)])
def test_no_number_depends_on_the_unit_of_length(tmp_path, factor, has_alpha):
    """With all effects and terms on, the first steps are equal except for rounding.

    In much larger units squares of the smallest gradients underflow: the seventh step differs by 2 % at 2^20.
    """
    still = torch.tensor([[0.9, 0.1, 0.2], [-0.8, 0.3, -0.2]])
    scene = replace(ball_scene(frames=6, size=16), still=still, has_alpha=has_alpha)
    _, plain = fit(tmp_path / "plain", scene, 7)
    _, losses = fit(tmp_path / "other", in_other_units(scene, factor), 7)
    assert losses == pytest.approx(plain, rel=2e-3)


def behind_a_lens(scene, lens):
    """The scene photographed anew through a lens, from the hull's frames to the test views."""

    def bent(frame):
        camera = replace(frame.camera, lens=lens)
        image = photograph(camera, frame.time)
        return replace(frame, camera=camera, load=lambda: image)

    splits = {name: tuple(map(bent, getattr(scene, name))) for name in ("train", "val", "test")}
    return replace(scene, **splits)


@pytest.mark.slow
def test_other_units_and_images_through_a_lens_train_to_the_same_accuracy(tmp_path):
    """Runs that differ by rounding alone end up to a dB apart, as what is split and goes differs."""
    plain = ball_scene(frames=24, size=32)
    bent = behind_a_lens(plain, Lens(k=(0.02, 0.0, 0.0), p=(0.16, -0.16)))
    unbent = [replace(frame, camera=replace(frame.camera, lens=None)) for frame in bent.train]
    scenes = plain, in_other_units(plain, 1e-3), bent, replace(bent, train=tuple(unbent))
    found = [fit_longer(tmp_path / str(i), scene)[1] for i, scene in enumerate(scenes)]
    assert found[0] > 28
    assert found[1:3] == pytest.approx([found[0]] * 2, abs=1.5)
    assert found[3] < found[2] - 1  # a lens that is left out is seen


def enlarged(scene, factor):
    """The scene with every training image's pixels repeated, and cameras to match."""

    def grown(frame):
        image = frame.load().repeat_interleave(factor, 0).repeat_interleave(factor, 1)
        camera = frame.camera.resized(factor * frame.camera.width, factor * frame.camera.height)
        return replace(frame, camera=camera, load=lambda: image)

    return replace(scene, train=tuple(map(grown, scene.train)))


@pytest.mark.slow
def test_images_of_two_sizes_say_the_same():
    """The photo term, and the gradients of all terms together, of the same particles.

    What is in pixels is the blur alone: 0.1 square pixels of either image, so that a particle with the
    variance s^2 in the smaller one is narrower by the share 0.1 (1 - 1 / 4) / s^2 in the larger. Twice that
    is allowed for, as the loss is also a sum over four places of each pixel in place of its middle.
    """
    scene, numbers = ball_scene(frames=6, size=48), {"jitter": 0.0, "density": 20.0}
    data, twins_data = (SceneDataModule(lambda of=of: of, rays=1) for of in (scene, enlarged(scene, 2)))
    options = {"model": partial(Particles, **EVERY), "numbers": numbers}
    module, twin = (module_of(ENTRY, of, **options) for of in (data, twins_data))
    method = shaken(module).method
    method.deformation.nodes.seen_times.copy_(torch.tensor([0.0, 1.0]))
    assert float(twin.method.covered_pixels) == 4 * float(method.covered_pixels)
    assert float(twin.method.final_count) == pytest.approx(2 * float(method.final_count), rel=0.02)
    camera = scene.train[3].camera
    distances = (method.gaussians.means.data - camera.center.to(method.gaussians.means)).norm(dim=-1)
    variance = float((method.gaussians.scales.data.exp().mean(-1) * camera.fx / distances).square().median())
    most = 2 * BLUR * (1 - 1 / 4) / variance
    assert 0.005 < most < 0.02  # neither demands the impossible nor lets much pass
    other = copy.deepcopy(method)
    other.covered_pixels.copy_(twin.method.covered_pixels)
    twin.method = other
    step, larger = look(module, data, 3), look(twin, twins_data, 3)
    each = ({name: value() for name, value in s.terms.items()} for s in (step, larger))
    terms, others = ({name: float(v) for name, v in values.items() if v is not None} for values in each)
    assert terms["photo"] > 0.01
    assert others["photo"] == pytest.approx(terms["photo"], rel=most)
    assert (others["rigid"], others["smooth"]) == (terms["rigid"], terms["smooth"])  # know no images
    assert step.gradients.keys() == dict(method.named_parameters()).keys()
    for name, gradient in step.gradients.items():
        assert float((larger.gradients[name] - gradient).norm() / gradient.norm()) < most, name


@cache
def still_particles():
    return module_with(small_data(), **BARE).method


def paths(nodes, points, times):
    """Where points go that are particles themselves."""
    method = copy.copy(still_particles())  # a shallow copy: what is set below is the copy's
    method._modules = dict(method._modules)
    method.deformation = Deformation(nodes, points)
    values = method.values() | {"means": points, "opacity": torch.zeros(len(points), 1)}
    method.gaussians = GaussianModel(values, nodes.curve.canonical_time)
    method.canonical_time = nodes.curve.canonical_time
    return method.trajectories(points, torch.tensor(times, dtype=torch.float64))


def random_nodes(points, count, curve, **options):
    nodes = Nodes(points, count, curve, **options)
    for value in filter(lambda v: v is not None, (nodes.translations, nodes.rotations)):
        value.data = torch.randn(value.shape, generator=torch.Generator().manual_seed(0))
    return nodes


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["spline", "cosines"])
@pytest.mark.parametrize("time", [0.0, 1e-12, 1e-7, 1 - 1e-7, 1.0])
def test_at_and_beside_the_canonical_time_and_the_ends(kind, time):
    for canonical in (0.0, 1.0):
        nodes = random_nodes(torch.eye(3), 3, Curve(kind, 6, 9, canonical))
        went = paths(nodes, torch.eye(3), [time])[:, 0] - torch.eye(3)
        assert went.isfinite().all()
        assert float(went.norm()) <= 100 * abs(time - canonical) + 1e-6  # no jump
        nodes.extend(time)
        bent, gradients = nodes.backward(time, time, nodes.curve(time), torch.ones(3, 6), 1.0, 1.0)
        assert all(value.isfinite().all() for value in (torch.tensor(bent), *gradients.values()))
