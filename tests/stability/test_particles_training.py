"""Particles trained under bad conditions: odd scenes, rates far too high, other units of length."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch

from forewarp.data.module import SceneDataModule
from forewarp.fields.curves import Curve
from forewarp.methods.particles import model
from forewarp.methods.particles.model import Particles
from forewarp.methods.particles.nodes import Nodes, Skin
from forewarp.methods.particles.queries import trajectories
from forewarp.methods.particles.start import anywhere
from forewarp.ops.nodes import pull_nodes
from forewarp.scene.box import Box
from forewarp.scene.camera import Lens
from forewarp.scene.view import Moment
from tests.contract.fitting import stage_of
from tests.contract.table import METHODS
from tests.stability.test_training import FEW, SCENE, Diary, in_other_units, pictured
from tests.support.tiny_scene import ball_scene, make_run, photograph, same

pytestmark = pytest.mark.stability

ENTRY = METHODS["particles"]
OPTIONS = {"motion": "spline", "rotation": True, "view_dependence": 1, "color_over_time": 1}
OPTIONS |= {"opacity_over_time": 1, "background": 0.03}
NUMBERS = {"density": 20.0, "every": 0.01}  # of longer runs
USUAL = replace(
    ENTRY, weights={"photo": 1.0, "rigid": 1.0, "smooth": 8.0}
)  # as conf/objective/particles_fast.yaml


def fit(folder, scene, steps, rates=1.0, entry=ENTRY, **changes):
    """A fitted module of particles with all effects, and the losses of its steps."""
    diary = Diary()
    numbers = entry.numbers | changes.pop("numbers", {})
    lr = {kind: rates * rate for kind, rate in entry.lr.items()}
    method = partial(Particles, **OPTIONS | changes)
    stage = stage_of(entry, steps=steps, lr=lr, numbers=numbers, model=method)
    run = make_run(folder, [stage], data=SceneDataModule(lambda: scene, rays=1), callbacks=[diary])
    return run.fit(), diary.losses


def psnr(module, scene):
    """The mean PSNR of the test views, dB."""
    data = SceneDataModule(lambda: scene, rays=1)
    data.setup("test")
    return sum(float(module.psnr_of(target)) for target in data.test_dataloader()) / len(scene.test)


HARD = {
    **{f"times {times}": (ball_scene(size=16, times=times, canonical_time=times[0]), {}) for times in FEW},
    "white on white": (pictured(SCENE, 255), {}),
    "without matter": (pictured(SCENE, 0), {}),
    "opaque": (replace(pictured(SCENE, 255), has_alpha=False), {}),
    "one opaque picture": (replace(SCENE, train=SCENE.train[:1], has_alpha=False), {}),
    "a camera inside the box": (replace(SCENE, box=Box((-5, -5, -5), (5, 5, 5))), {}),
    "a scene 1e-6 thin": (replace(SCENE, box=Box((-1, -0.8, -1e-6), (1.2, 0.8, 1e-6))), {}),
    **{f"rates {rates} too high": (SCENE, {"steps": 25, "rates": rates}) for rates in (10.0, 300.0)},
    "jitter of all time there is": (SCENE, {"numbers": {"jitter": 3.0}}),
}


def check_sound(module, losses, scene, steps):
    """It took all its steps, is made of numbers, and so is what it draws."""
    assert len(losses) == steps
    assert all(0 <= loss < 1e4 for loss in losses)
    for part, value in module.method.state_dict().items():
        assert not value.is_floating_point() or value.isfinite().all(), part
    assert len(module.method.means) >= 1
    drawn = module.render(scene.test[0].camera, Moment(0.5), torch.ones(3))
    assert all(plane.isfinite().all() for plane in (drawn.rgb, drawn.depth, drawn.opacity))


@pytest.mark.parametrize("name", HARD)
def test_hard_scenes_train(tmp_path, name):
    scene, options = HARD[name]
    options = {"steps": 8} | options
    module, losses = fit(tmp_path, scene, **options)
    check_sound(module, losses, scene, options["steps"])


def coincide(method):
    """Put all particles at one place, and all nodes."""
    method.means.data[:] = method.means.data[:1]
    edges = method.nodes.edges.shape[1]
    method.nodes.__init__(method.means.data, 6, method.nodes.curve, rests=True, edges=edges)
    method.skin.__init__(method.nodes, method.means.data)


BAD = {
    "all outside the view": lambda m: m.means.data.add_(90.0),
    "all at a camera": lambda m: m.means.data.copy_(SCENE.train[0].camera.center.expand_as(m.means)),
    "opacity 0": lambda m: m.opacity.data.fill_(-1e4),
    "opacity 1": lambda m: m.opacity.data.fill_(1e4),
    "all faded, so that none would be left": lambda m: m.opacity.data.fill_(-5.0),
    "all faded but one": lambda m: m.opacity.data[1:].fill_(-5.0),
    "quaternions of length 0": lambda m: m.turns.data.zero_(),
    "scales of 0": lambda m: m.log_scales.data.fill_(-1e4),
    "scales of e^40": lambda m: m.log_scales.data.fill_(40.0),
    "nodes that coincide": coincide,
}


@pytest.mark.parametrize("name", BAD)
def test_bad_beginnings_train(tmp_path, monkeypatch, name):
    """As a step too long may have left it; density control and new links come in between."""
    made = Particles.__init__

    def spoiled(self, start, **options):
        made(self, start, **options)
        BAD[name](self)

    monkeypatch.setattr(Particles, "__init__", spoiled)
    monkeypatch.setattr(model, "first_points", lambda start, count: anywhere(start.scene.box, count))
    module, losses = fit(tmp_path, SCENE, 10, numbers={"every": 0.2, "relink": 1})
    assert int(module.method.round) >= 2
    check_sound(module, losses, SCENE, 10)


@pytest.mark.parametrize(("factor", "has_alpha"), [(1e-3, True), (2.0**14, False)])
def test_no_number_depends_on_the_unit_of_length(tmp_path, factor, has_alpha):
    """With all effects and terms on, the first steps are equal except for rounding.

    In much larger units squares of the smallest gradients underflow: the seventh step differs by 2 % at 2^20.
    """
    still = torch.tensor([[0.9, 0.1, 0.2], [-0.8, 0.3, -0.2]])
    scene = replace(ball_scene(frames=6, size=16), still=still, has_alpha=has_alpha)
    _, plain = fit(tmp_path / "plain", scene, 7)
    _, other = fit(tmp_path / "other", in_other_units(scene, factor), 7)
    assert other == pytest.approx(plain, rel=2e-3)


@pytest.mark.slow
def test_two_threads_train_alike(tmp_path, two_threads):
    """A short run with all effects and density control, twice on two threads: equal to the bit."""
    scene, found = ball_scene(frames=6, size=40), []
    for folder in ("once", "again"):
        module, losses = fit(tmp_path / folder, scene, 16, numbers={"every": 0.2})
        assert torch.get_num_threads() == 2
        found.append((module, losses))
    (once, losses), (again, same_losses) = found
    assert int(once.method.round) >= 2  # particles have been renewed
    assert losses == same_losses
    assert len(set(losses)) == 16
    assert same(once, again)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_other_units_train_to_the_same_accuracy(tmp_path, factor):
    """Runs that differ by rounding alone end up to half a dB apart, as what is split and goes differs; the
    first steps are compared tightly above.
    """
    scene, found = ball_scene(frames=24, size=48), []
    for folder, own in (("plain", scene), ("other", in_other_units(scene, factor))):
        module, _ = fit(tmp_path / folder, own, 1500, numbers=NUMBERS)
        found.append(psnr(module, own))
    assert found[0] > 30
    assert found[1] == pytest.approx(found[0], abs=1.0)


def averaged_psnr(module, truths, frames, factor):
    """The PSNR (dB) of views of frames, averaged over blocks of pixels, against the small ``truths``."""
    errors = []
    for truth, frame in zip(truths, frames):
        drawn = module.render(frame.camera, Moment(frame.time), torch.ones(3)).rgb
        drawn = torch.nn.functional.avg_pool2d(
            drawn.reshape(*frame.load().shape[:2], 3).permute(2, 0, 1), factor
        )
        straight = truth.load() / 255
        picture = torch.lerp(torch.ones(3), straight[..., :3], straight[..., 3:])
        errors.append((drawn.permute(1, 2, 0) - picture).square().mean())
    return float(-10 * torch.stack(errors).mean().log10())


@pytest.mark.slow
def test_pictures_of_two_sizes_train_to_the_same_accuracy(tmp_path):
    """By one preset, nothing typed; views of the larger are averaged to the smaller ones, then scored."""
    found, count, small = [], [], ball_scene(frames=24, size=32)
    for factor in (1, 3):
        scene = ball_scene(frames=24, size=32 * factor)
        module, _ = fit(tmp_path / str(factor), scene, 2500, entry=USUAL, numbers=NUMBERS)
        found.append(averaged_psnr(module, small.test, scene.test, factor))
        count.append(len(module.method.means))
    assert found[0] > 38
    assert found[1] > found[0]
    assert count[1] / count[0] == pytest.approx(3, rel=0.15)


def behind_a_lens(scene, lens):
    """The scene photographed anew through a lens, from the hull's frames to the test views."""

    def bent(frame):
        camera = replace(frame.camera, lens=lens)
        image = photograph(camera, frame.time)
        return replace(frame, camera=camera, load=lambda: image)

    return replace(
        scene, **{name: tuple(map(bent, getattr(scene, name))) for name in ("train", "val", "test")}
    )


@pytest.mark.slow
def test_pictures_through_a_lens_train_to_the_same_accuracy(tmp_path):
    plain = ball_scene(frames=24, size=48)
    bent = behind_a_lens(plain, Lens(k=(0.02, 0.0, 0.0), p=(0.08, -0.08)))
    taken_for_plain = replace(
        bent, train=tuple(replace(frame, camera=replace(frame.camera, lens=None)) for frame in bent.train)
    )
    found = []
    for number, scene in enumerate((plain, bent, taken_for_plain)):
        module, _ = fit(tmp_path / str(number), scene, 1500, entry=USUAL, numbers=NUMBERS)
        found.append(psnr(module, scene))
    assert found[0] > 35
    assert found[1] == pytest.approx(found[0], abs=1.0)
    assert found[2] < found[1] - 1  # 1.75 when this was written: a lens that is left out is seen


def paths(nodes, points, times):
    """Where points go that are particles themselves."""
    canonical, skin = nodes.curve.canonical_time, Skin(nodes, points)
    parts = {
        "means": torch.nn.Parameter(points.clone()),
        "opacity": torch.nn.Parameter(torch.zeros(len(points), 1)),
    }
    method = SimpleNamespace(nodes=nodes, skin=skin, canonical_time=canonical, **parts)
    return trajectories(method, points, torch.tensor(times, dtype=torch.float64))


@pytest.mark.parametrize("turns", [True, False])
@pytest.mark.parametrize("count", [1, 2, 9])
def test_nodes_that_coincide(turns, count):
    """Points that all lie at one place, or at two: nodes, shares, strain and paths are finite."""
    for apart in (0.0, 1e-6, 1.0):
        points = torch.full((count, 3), 0.3)
        points[count // 2 :, 0] += apart
        nodes = Nodes(points, 6, Curve("spline", 5, 9, 0.25), turns=turns, rests=True)
        for value in filter(lambda v: v is not None, (nodes.shift, nodes.turn)):
            value.data = torch.randn(value.shape, generator=torch.Generator().manual_seed(0))
        assert bool(nodes.edge_weights.any()) == (apart > 0 and len(nodes) > 1)
        links, shares = nodes.links(points + 0.1)
        torch.testing.assert_close(shares.sum(-1), torch.ones(count))
        assert int(links.max()) < len(nodes)
        motion, maps = nodes.carried(nodes.curve(0.7))
        pulled, strain = pull_nodes(
            motion.detach(), nodes.places, torch.ones_like(maps), nodes.edges, nodes.edge_weights, 1.0
        )
        found = [pulled, torch.tensor(strain), paths(nodes, points, [0.0, 0.25, 1.0])]
        found += [nodes.edge_weights, nodes.spread, nodes.reach_of([0.0, 1.0])]
        assert all(value.isfinite().all() for value in found)


@pytest.mark.parametrize("kind", ["spline", "cosines"])
@pytest.mark.parametrize("time", [0.0, 1e-12, 1e-7, 1 - 1e-7, 1.0])
def test_at_and_beside_the_canonical_time_and_the_ends(kind, time):
    for canonical in (0.0, 1.0):
        nodes = Nodes(torch.eye(3), 3, Curve(kind, 6, 9, canonical))
        for value in (nodes.shift, nodes.turn):
            value.data = torch.randn(value.shape, generator=torch.Generator().manual_seed(0))
        went = paths(nodes, torch.eye(3), [time])[:, 0] - torch.eye(3)
        assert went.isfinite().all()
        assert float(went.norm()) <= 100 * abs(time - canonical) + 1e-6  # no jump
        nodes.look_ahead(time)
        bent, slopes = nodes.spread_over_time(time, time, nodes.curve(time), torch.ones(3, 6), 1.0, 1.0)
        assert all(value.isfinite().all() for value in (torch.tensor(bent), *slopes.values()))
