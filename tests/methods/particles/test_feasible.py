"""Without kernels: what is too large is refused before anything is computed, and what is small works."""

import re
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from forewarp.methods.particles import model
from forewarp.methods.particles.model import Particles
from forewarp.ops import backend
from tests.contract.fitting import Losses, run_of, stage_of
from tests.contract.table import METHODS
from tests.stability.twin import BACKENDS, implementation
from tests.support.particles import module_with

CPU, GPU = torch.device("cpu"), torch.device("cuda", 0)


@pytest.fixture
def plain():
    """Switches the kernels off, as a user does."""
    with implementation("reference"):
        yield


def sized(scene, width, height):
    """A scene of 100 pictures of another size, of which a fifth shows something."""
    camera = replace(scene.train[0].camera, width=width, height=height)

    def load():
        picture = torch.zeros(height, width, 4, dtype=torch.uint8)
        picture[: height // 5] = 255
        return picture

    frame = replace(scene.train[0], camera=camera, load=load)
    return replace(scene, train=(frame,) * 100, val=(), test=(), held=())


def said_by(scene, device, **numbers):
    """What the refusal says."""
    with pytest.raises(ValueError, match="expected pictures of at most") as refused:
        Particles.check_feasible(scene, "fine", numbers, device)
    return str(refused.value)


def test_a_gpu_is_refused_for_large_pictures_and_the_size_that_is_named_is_not(data):
    said = said_by(sized(data.scene, 400, 400), GPU)
    assert said.startswith("trainer: expected pictures of at most 1")
    assert "have no kernels on a GPU, but got 400 x 400 and 16,1" in said
    assert said.endswith("use trainer=cpu, or use smaller pictures")
    width, height = map(int, re.search(r"(\d+) x (\d+) pixels", said).groups())
    assert 100 < width == height < 200
    Particles.check_feasible(sized(data.scene, width, height), "fine", {}, GPU)
    said_by(sized(data.scene, round(1.1 * width), round(1.1 * height)), GPU)
    wide = said_by(sized(data.scene, 800, 200), GPU)
    width, height = map(int, re.search(r"(\d+) x (\d+) pixels", wide).groups())
    assert width == pytest.approx(4 * height, abs=4)


def test_fewer_particles_allow_larger_pictures(data):
    scene = sized(data.scene, 200, 200)
    said_by(scene, GPU)
    Particles.check_feasible(scene, "fine", {"density": 20.0}, GPU)
    Particles.check_feasible(scene, "coarse", {"first": 0.2, "full": 0.2}, GPU)
    said_by(scene, GPU, first=1.0, full=0.2)


def test_larger_pictures_of_the_test_count_too(data):
    large = sized(data.scene, 400, 400).train[0]
    said_by(replace(sized(data.scene, 60, 60), test=(replace(large, load=None),)), GPU)


def test_with_kernels_nothing_is_looked_at(data, monkeypatch):
    monkeypatch.setattr(backend, "numba_installed", lambda: True)
    monkeypatch.setattr(model, "covered_pixels", None)
    Particles.check_feasible(sized(data.scene, 4000, 4000), "fine", {}, CPU)


def test_without_numba_a_run_is_refused_before_anything_is_computed(data, plain, tmp_path, monkeypatch):
    def never(*_):
        raise AssertionError("this takes seconds")

    monkeypatch.setattr(model, "first_points", never)
    scene = sized(data.scene, 400, 400)
    large = SimpleNamespace(scene=scene, setup=lambda _: None, restart=lambda _: None)
    with pytest.raises(ValueError, match=r"model: expected .* install forewarp\[cpu\]"):
        run_of([stage_of(METHODS["particles"])], large, tmp_path).fit()
    large.scene = sized(data.scene, 40, 40)
    with pytest.raises(AssertionError, match="this takes seconds"):
        run_of([stage_of(METHODS["particles"])], large, tmp_path).fit()


def test_without_numba_particles_learn_the_same(data, tmp_path):
    pytest.importorskip("numba")
    found = {}
    for name in BACKENDS:
        losses = Losses()
        with implementation(name):
            run_of([stage_of(METHODS["particles"], steps=12)], data, tmp_path / name, losses).fit()
        found[name] = losses.values
    assert len(found["reference"]) == 12
    assert found["reference"] == pytest.approx(found["Numba"], rel=0.02)


def test_particles_of_a_module_are_no_more_than_were_counted(data):
    method = module_with(data).method
    most = float(method.most) * max(method.stage.first, method.stage.full)
    assert len(method.means) <= most
