"""Operators of particles under bad conditions, against float64 in both implementations."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.autograd import gradcheck

from forewarp.methods.particles import model
from forewarp.methods.particles.gaussians import GaussianModel
from forewarp.methods.particles.model import pinhole_of
from forewarp.ops import backend
from forewarp.ops.adam import AdamState, adam_rows
from forewarp.ops.gaussians import Gaussians, Splats, Warp, project, rasterize
from tests.stability import report
from tests.support.gaussians import NO_FADES, NO_TINTS, crowd, one, pinhole, still, straight
from tests.support.particles import EVERY, FACTORS, module_with, shaken, small_data

pytestmark = pytest.mark.stability

# Relative to the largest entry. Where all of a picture is covered many times over, what is let through ends a
# tile at a thousandth. Of a needle a tenth of a square pixel is the smaller side, and a few digits go.
COVERED = {"as large as the scene": 5e-3, "larger than all": 2e-2, "needles, 1 to 60,000": 4e-5}
NAMES = ("loss", *Gaussians._fields, "maps", "skin", "pixel_gradient")


def parts(found):
    return (torch.tensor([found.loss]), *found.particles, found.maps, found.skin, found.pixel_gradient)


def check_close(ours, exact, most):
    """Each tensor is within ``most`` of float64, relative to its largest entry."""
    for number, (a, b) in enumerate(zip(ours, exact, strict=True)):
        assert report.relative_error([a.cpu().double()], [b.cpu().double()]) <= most, number


@pytest.mark.parametrize("name", report.SEEN)
def test_pictures_and_gradients_keep_their_digits(place, name):
    most = COVERED.get(name, 2e-5)
    function, leaves = report.drawn(report.SEEN[name])
    both = torch.float64, torch.float32
    exact, ours = (report.answers(function, [t.to(place) for t in leaves], kind) for kind in both)
    assert float(exact[0][0][4].min()) < 1  # something is seen
    for one_kind, other in zip(exact, ours):
        check_close(other, one_kind, most)


@pytest.mark.parametrize("name", report.SEEN)
def test_what_a_step_gives_keeps_its_digits(place, name):
    exact, ours = (report.compared(report.SEEN[name], kind, place) for kind in (torch.float64, torch.float32))
    assert float(exact.pixel_gradient.sum()) > 0
    check_close(parts(ours), parts(exact), COVERED.get(name, 2e-5))


@pytest.mark.parametrize("name", report.UNSEEN)
def test_what_is_not_seen_changes_nothing_and_gets_no_gradient(place, name):
    function, leaves = report.drawn(report.UNSEEN[name])
    values, gradients = report.answers(function, [t.to(place) for t in leaves], torch.float32)
    assert bool((values[0][4] == 1).all())
    assert not bool(values[0][:4].any())
    found, none = (report.compared(report.UNSEEN[n], torch.float32, place) for n in (name, "none at all"))
    assert found.loss == pytest.approx(none.loss, rel=1e-6)
    assert not any(bool(part.any()) for part in (*gradients, *parts(found)[1:]))


def turned(seed):
    """A camera at a random place, most often among the particles, that looks anywhere."""
    generator = torch.Generator().manual_seed(seed)
    axes = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))[0]
    axes[:, 0] *= torch.linalg.det(axes)
    center = torch.randn(3, generator=generator, dtype=torch.float64)
    return replace(straight((21, 13)), rotation=tuple(axes.flatten().tolist()), center=tuple(center.tolist()))


@pytest.mark.parametrize("seed", range(0, 200_000, 25_013))
def test_random_views(place, seed):
    particles, warp, *bases = crowd(40, seed=seed % 97, dtype=torch.float32)
    hard = report.Hard(particles, warp, turned(seed), *bases)
    exact, ours = (report.compared(hard, kind, place) for kind in (torch.float64, torch.float32))
    check_close(parts(ours), parts(exact), 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("logit", [-4.0, 0.0, 8.0])
def test_thousands_on_one_pixel(place, logit):
    particles = one((0.09, 0.02, 0.0), scale=(1e-3, 2e-3, 3e-3), opacity=logit, color=(0.2, -0.1, 0.3))
    many = Gaussians(*(part.repeat(3000, *[1] * (part.dim() - 1)) for part in particles))
    many.means[:, 2].add_(torch.linspace(0, 1, 3000))
    many.colors.add_(torch.randn(many.colors.shape, generator=torch.Generator().manual_seed(0)))
    hard = report.Hard(many, still(many), straight((1, 1)), NO_TINTS, NO_FADES)
    exact, ours = (report.compared(hard, kind, place) for kind in (torch.float64, torch.float32))
    assert ours.loss == pytest.approx(exact.loss, abs=4e-3)
    # What is behind a thousandth of the light is passed over: by opacity, relative to the foremost.
    check_close(parts(ours)[1:], parts(exact)[1:], 5e-3)


@pytest.mark.slow
def test_of_a_crowded_tile_the_nearest_are_drawn(place):
    """The kernel looks at 32,768 of a tile, the reference at all."""
    kernel = place.type == "cpu" and backend.numba_installed()
    # The reference: in more than one piece of 2^20 pairs.
    count, looked_at = (36_000, 32_768) if kernel else (17_000, 17_000)
    generator = torch.Generator().manual_seed(0)
    numbers = torch.full((count, 10), 0.05)
    numbers[:, :2] = 8 * torch.rand(count, 2, generator=generator)
    numbers[:, 2:5] = torch.tensor([300.0, 0.0, 300.0])  # each on a pixel at most
    numbers[:, 6:9] = torch.rand(count, 3, generator=generator)
    numbers[:, 9] = torch.linspace(1, 2, count)
    draw = lambda n: rasterize(Splats(n, torch.ones_like(n[:, :2])), 8, 8).color  # noqa: E731
    exact = report.answers(draw, [numbers[:looked_at].double().to(place)], torch.float64)
    ours = report.answers(draw, [numbers.double().to(place)], torch.float32)
    check_close(ours[0], exact[0], 1e-3)
    check_close([ours[1][0][:looked_at]], exact[1], 5e-3)
    assert not bool(ours[1][0][looked_at:].any())


def test_nodes_keep_their_digits():
    for row in report.rows([report.node_cases]):
        for column, error in row.items():
            assert column in ("operator", "input") or error is None or error < 1e-6, (row, column)


@pytest.mark.parametrize("size", [1e-25, 1e-12, 1e6, 1e18])
def test_adam_takes_gradients_of_any_size(place, size):
    """A step is at most the rate; 32 rows are treated side by side, the last alone."""
    value = torch.zeros(33, 3, device=place)
    state = [torch.zeros_like(value), torch.zeros_like(value), value.new_zeros(33)]
    for _ in range(3):
        adam_rows([AdamState(value, torch.full_like(value, size), *state, 0.1)], (0.9, 0.99), 1e-30)
    expected = -0.3 if size > 1e-20 else None  # its square is 0 in float32
    assert bool(value.isfinite().all())
    assert expected is None or value.mean().item() == pytest.approx(expected, rel=1e-4)
    torch.testing.assert_close(value, value[:1, :1].expand(33, 3))


# Two things are left out of gradients by design (``ops.gaussians``): that a direction turns when a particle
# moves, which harmonics of degree 1 and more would see, and that a lens's Jacobian changes then, which the
# shape of a splat would see. Where either is on, only what moves nothing is held to finite differences, and
# with a lens that which moves, in the values of a splat that have nothing to do with the Jacobian.
LENS = {"radial": (0.1, -0.05, 0.01), "tangential": (0.01, -0.02), "reach": 4.0}
RESTING = ("log_scales", "quaternions", "opacity", "colors")  # what moves no particle
PLACE = [0, 1, 5, 6, 7, 8, 9]  # of a splat's values; the others, the conic, are its shape
STEP = 1e-6


def along(loss, value, direction):
    """The derivative of ``loss()`` while ``value`` is moved along ``direction`` in place."""
    start, sides = value.clone(), []
    for sign in (1, -1):
        value.copy_(start + sign * STEP * direction)
        sides.append(loss())
    value.copy_(start)
    return (sides[0] - sides[1]) / (2 * STEP)


@pytest.mark.slow
@pytest.mark.parametrize(("degree", "lens"), [(2, {}), (3, LENS)])
def test_splats_by_what_moves_nothing(degree, lens):
    particles, warp, *bases = crowd(count=3, degree=degree)

    def numbers(*leaves):
        own = particles._replace(**dict(zip(RESTING, leaves)))
        return project(own, warp, pinhole(**lens), *bases).values

    assert int((numbers()[:, 5] > 0).sum()) == 3
    leaves = [getattr(particles, name).clone().requires_grad_() for name in RESTING]
    assert gradcheck(numbers, leaves, atol=1e-6)


@pytest.mark.slow
def test_places_behind_a_lens():
    """Of colour there is one coefficient, which no direction changes."""
    particles, warp, *bases = crowd(count=3, degree=0)

    def numbers(means, maps, weights):
        own = particles._replace(means=means)
        found = project(own, Warp(maps, warp.links, weights), pinhole(**LENS), *bases).values
        return found[:, PLACE]

    leaves = [t.clone().requires_grad_() for t in (particles.means, warp.maps, warp.weights)]
    assert gradcheck(numbers, leaves, atol=1e-6)


# Of which parameters: without view dependence and lens all there are; with either those that move nothing.
STILL = {f"gaussians.{name}" for name in GaussianModel.ROWS if name != "means"} | {"exposure"}
NODES = {"deformation.nodes.translations", "deformation.nodes.rotations"}
MOVING = NODES | {"gaussians.means", "deformation.skinning.logits"}
SH, ROTATIONS = {"gaussians.sh"}, {"deformation.nodes.rotations"}
COSINES = {"view_dependence": None, "rotation": None, "motion": "cosines"}
METHODS = {
    "splines": ({"view_dependence": None}, {}, STILL - SH | MOVING),
    "cosines, no rotation": (COSINES, {}, STILL - SH | MOVING - ROTATIONS),
    "degree 3": ({"view_dependence": 3}, {}, STILL),
    "a lens": ({"view_dependence": 1}, LENS, STILL),
}


def exactly(options, lens, monkeypatch):
    """A shaken method in float64, whose camera has a lens or none, and a batch."""
    data = small_data()
    numbers = {"jitter": 0.0, "density": 1.0, "initial_share": 1.0, "time_offsets": 0}
    module = module_with(data, numbers=numbers, **EVERY | options)
    method = shaken(module).method.double()
    method.deformation.nodes.seen_times.copy_(
        torch.tensor([0.0, 1.0])
    )  # else the first look continues curves
    monkeypatch.setattr(model, "pinhole_of", lambda camera, blur: replace(pinhole_of(camera, blur), **lens))
    data.picker = lambda: 3
    return method, next(iter(data.train_dataloader())), module.generator


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_a_step_of_the_method(name, monkeypatch):
    """The loss is that of the step itself, all terms weighted; everything is the plain reference.

    With ``sh``, or behind a lens, what moves particles is left out: what that does to directions and to the
    slopes of a lens is left out of their gradients. So is ``static``, to which the mean place is a constant.
    """
    options, lens, names = METHODS[name]
    factors = {term: factor for term, factor in FACTORS.items() if term != "static"}
    method, batch, generator = exactly(options, lens, monkeypatch)

    def loss():
        terms = method.look(batch, factors, generator).terms
        return sum(factor * float(terms[term]()) for term, factor in factors.items())

    gradients = method.look(batch, factors, generator).gradients
    parameters = dict(method.named_parameters())
    assert gradients.keys() == parameters.keys()
    moves = names >= MOVING - ROTATIONS
    assert names == (parameters.keys() if moves else parameters.keys() - MOVING)
    for which in sorted(names):
        draw = torch.Generator().manual_seed(1)
        value, gradient = parameters[which].data, gradients[which]
        assert gradient.dtype == torch.float64
        assert bool(gradient.any()), which
        direction = torch.randn(value.shape, generator=draw, dtype=torch.float64)
        expected = along(loss, value, direction)
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-7), which


OF_PARTICLES = {"project", "rasterize", "nodes", "adam"}


@pytest.mark.slow
def test_kernels_for_any_processor(tmp_path):
    """The hard cases, compiled for what every processor can do."""
    pytest.importorskip("numba")
    plain = {"NUMBA_CPU_NAME": "generic", "NUMBA_CACHE_DIR": str(tmp_path), "FOREWARP_NUMBA": "1"}
    chosen = ["-m", "not slow", "-k", "not reference", __file__]
    options = {"env": os.environ | plain, "capture_output": True, "text": True}
    command = [sys.executable, "-m", "pytest", "-q", "--no-cov", *chosen]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], **options)
    assert done.returncode == 0, done.stdout[-3000:]
    assert " passed" in done.stdout
    compiled = {path.name.split(".")[0] for path in tmp_path.rglob("*.nbi")}
    assert compiled >= OF_PARTICLES, OF_PARTICLES - compiled
