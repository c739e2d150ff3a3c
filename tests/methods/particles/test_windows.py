"""Windows of a film begin from what stands still in all of it, and leave that as it is."""

from dataclasses import replace

import pytest
import torch

from forewarp.methods.method import Start
from forewarp.methods.particles import windows
from forewarp.methods.particles.model import Particles
from forewarp.methods.particles.windows import moments_of, wrong_pixels
from tests.support.particles import BARE, EVERY, look, module_with, small_data

DATA = small_data()


def begun(before, *, blank=False, **effects):
    """The method of a window, from a method of another run or of the stage before."""
    frames = list(range(len(DATA.scene.train)))
    start = Start(DATA.scene, "fine", {}, frames, None, before, blank, shares=True)
    return Particles(start, **EVERY | effects)


@pytest.fixture(scope="module")
def still():
    """Particles at rest, most of which lie where nothing ever moves."""
    method = module_with(DATA, **BARE).method
    method.gaussians.means.data[20:] += torch.tensor([0.0, 0.0, 9.0])
    return method


@pytest.fixture
def window(still):
    module = module_with(DATA, **EVERY)
    module.method = begun(still)
    return module


def test_a_window_keeps_what_stands_still_and_adds_particles_on_what_moves(still, window):
    method = window.method
    kept = method.shared >= 0
    assert 10 < int(kept.sum()) < len(method.gaussians.means)
    assert torch.equal(method.gaussians.means[kept], still.gaussians.means[method.shared[kept]])
    assert torch.equal(method.gaussians.opacity[kept], still.gaussians.opacity[method.shared[kept]])
    assert not bool(method.deformation.skinning.shares[kept].any())
    assert bool((method.deformation.skinning.shares[~kept].sum(-1) > 0.99).all())
    own = {tuple(row) for row in method.gaussians.means[~kept].tolist()}
    assert {
        tuple(row) for row in method.deformation.nodes.positions.tolist()
    } <= own  # nodes follow what moves
    assert int((~kept).sum()) > int((still.gaussians.means[:, 2] < 5).sum())  # some are new
    assert 16 <= float(method.moving_pixels) < 400


def test_training_changes_nothing_of_what_is_shared(still, window):
    method, optimizer = window.method, window.configure_optimizers()
    for index in (0, 2, 4):
        step = look(window, DATA, index)
        for name, p in method.named_parameters():
            p.grad = step.gradients.get(name)
        optimizer.step()
    method.final_count.fill_(2 * len(method.gaussians.means))
    method.control_density(1.0, optimizer)
    method.deformation.resting[0] = True
    method.deformation.freeze_static_nodes(method.gaussians, method.ends, 1e-4, method.fixed)
    method.deformation.reskin(method.gaussians.means.data, optimizer, method.fixed)
    kept = method.shared >= 0
    rows = method.shared[kept]
    for name in ("means", "scales", "quaternions", "opacity", "colors"):
        own, theirs = (getattr(particles.gaussians, name) for particles in (method, still))
        assert torch.equal(own[kept], theirs[rows]), name
    assert not bool(method.gaussians.color_over_time[kept].any())
    assert len(rows.unique()) == len(rows)
    assert torch.equal(method.ellipsoids(1.0).centers[kept], method.gaussians.means[kept])


@pytest.mark.slow
def test_the_next_stage_and_a_checkpoint_know_what_is_shared(window):
    method = window.method
    after = begun(method)
    assert torch.equal(after.shared, method.shared)
    assert float(after.moving_pixels) == float(method.moving_pixels)
    assert float(after.final_count) == after.stage.final_count(float(method.moving_pixels), after.views)
    loaded = begun(None, blank=True)
    assert loaded.misfit(method.state_dict()) is None
    loaded = module_with(DATA, **EVERY)
    loaded.method = begun(None, blank=True)
    state = {f"method.{name}": value for name, value in method.state_dict().items()}
    loaded.load_state_dict(state | {k: v for k, v in loaded.state_dict().items() if k not in state})
    assert torch.equal(loaded.method.shared, method.shared)
    assert "shared" not in dict(module_with(DATA, **EVERY).method.named_buffers())


def test_cameras_that_film_together_at_times_of_their_own_are_asked_together(still, monkeypatch):
    """What moves is told by all views of an instant, never by one of them alone."""
    late = [replace(f, time=min(f.time + 0.01, 1.0), moment=i) for i, f in enumerate(DATA.scene.train)]
    train = tuple(replace(f, moment=i) for i, f in enumerate(DATA.scene.train))
    scene = replace(DATA.scene, train=(*train, *late))
    assert [[frame.moment for frame in frames] for frames in moments_of(scene)] == [[i, i] for i in range(6)]
    asked = []
    monkeypatch.setattr(
        windows, "wrong_pixels", lambda draw, frame: asked.append(frame) or frame.load()[..., 3] > 0
    )
    windows._on_what_moves(still.drawn, Start(scene, "fine", {}, [0], None, still, shares=True), 10)
    assert [frame.moment for frame in asked] == [0, 0]


def test_a_window_begins_from_particles_that_stand_still_alone(still):
    """Times of a window are not those of the film, so that what changes over time would be drawn wrongly."""
    for before in (
        module_with(DATA).method,
        module_with(DATA, **(BARE | {"color_over_time": 2})).method,
        None,
    ):
        with pytest.raises(ValueError, match=r"^start: expected a run of model=particles that stand still"):
            begun(before)
    assert begun(still).shared is not None


def test_a_window_learns_its_exposure_anew(monkeypatch):
    """Curves over the times of the whole film say something else at a window's times."""
    monkeypatch.setattr(windows, "_on_what_moves", lambda *given: {})
    before = module_with(DATA, **(BARE | {"exposure": 1})).method
    before.exposure.data.fill_(0.1)
    window = begun(before, **(BARE | {"exposure": 1}))
    assert before.exposure.shape == window.exposure.shape
    assert not bool(window.exposure.any())


def test_pixels_are_wrong_where_an_image_shows_something_else():
    method = module_with(DATA, **BARE).method
    method.gaussians.opacity.data.fill_(-9.0)  # nothing is drawn
    frame = DATA.scene.train[0]
    wrong, shown = wrong_pixels(method.drawn, frame), frame.load()[..., 3] > 127
    assert bool(wrong[shown].all())
    assert int(wrong.sum()) < 4 * int(shown.sum())
