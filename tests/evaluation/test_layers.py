"""What moves of a fitted scene, against the truth of the procedural ones."""

from dataclasses import replace
from statistics import fmean
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from forewarp.cli.render import write_film
from forewarp.evaluation.evaluate import over_scene
from forewarp.evaluation.images import moving_share
from forewarp.evaluation.layers import layer_of
from tests.bench.layers import score
from tests.support.configs import CONF
from tests.support.particles import EVERY, module_with, shaken, small_data

DATA = small_data()


def test_a_layer_without_particles_is_refused_unless_it_will_do():
    method, frames = module_with(DATA).method, DATA.scene.train
    assert layer_of(method, "all", frames) is method
    assert len(layer_of(method, "resting", frames).gaussians.means) == len(method.gaussians.means)
    with pytest.raises(ValueError, match="layer: expected some particles that move, but got none in this"):
        layer_of(method, "moving", frames)
    assert len(layer_of(method, "moving", frames, may_be_empty=True).gaussians.means) == 0


def test_a_film_of_a_layer_has_the_masks_of_the_whole_scene(tmp_path, monkeypatch):
    module = shaken(module_with(DATA, **EVERY))
    rows = torch.arange(len(module.method.gaussians.means)) % 2 == 0
    monkeypatch.setattr(type(module.method), "in_motion", lambda self, frames: rows)
    method, config = module.method, OmegaConf.load(CONF / "render.yaml")
    config.update({"masks": "true", "layer": "moving", "frames": 3, "size": 24, "format": "png"})
    older = [tmp_path / "videos" / name / "0003.png" for name in ("fixed_moving", "fixed_moving_masks")]
    for file in older:  # of a longer film
        file.parent.mkdir(parents=True)
        file.write_bytes(b"")
    film = write_film(config, SimpleNamespace(folder=tmp_path, datamodule=DATA), module)
    assert film == tmp_path / "videos" / "fixed_moving"
    assert not any(file.exists() for file in older)
    assert len(module.method.gaussians.means) == int(rows.sum())
    masks = [iio.imread(tmp_path / "videos" / "fixed_moving_masks" / f"{i:04d}.png") for i in range(3)]
    camera = DATA.targets("test")[0].frame.camera.resized(24, 24)
    for mask, time in zip(masks, (0.0, 0.5, 1.0)):
        share = moving_share(method, rows, camera, time).numpy()
        np.testing.assert_array_equal(mask == 255, share > 0.5)
        assert 0.02 < (mask == 255).mean() < 0.98
        assert set(np.unique(mask)) == {0, 255}


@pytest.mark.slow
def test_the_mask_of_what_moves_is_that_of_the_scene_itself(ok, tmp_path):
    words = [f"data.root={tmp_path}", "data.synthesis.test_views=[4,4,0]", "logger=none", "sheets=0"]
    budget = ["budget.minutes=null", "budget.iterations=2000", "trainer=cpu", "threads=1", "seed=0"]
    ok("train", "scene=specimen_rigid", "model=particles", *words, *budget, f"run={tmp_path}/run")
    assert score(tmp_path / "run") >= 0.86


def test_how_much_faster_the_camera_goes_than_what_moves():
    """Half of the particles go along x by 1 in all; cameras of a film go around them."""
    count, scene = 10, replace(DATA.scene, protocol={"seconds": 2.0})

    class Known:
        def in_motion(self, frames):
            return torch.arange(count) < count // 2

        def only(self, rows): ...

        def template(self): ...

        def movement(self, times): ...

        def ellipsoids(self, time):
            return SimpleNamespace(centers=torch.tensor([time, 0.0, 0.0]).expand(count, 3))

    frames = scene.train
    steps = [float((b.camera.center - a.camera.center).norm()) for a, b in zip(frames, frames[1:])]
    known, still = (SimpleNamespace(method=made()) for made in (Known, object))
    said = over_scene(known, scene)["camera_over_scene"]
    assert said.startswith(f"{fmean(steps) * (len(frames) - 1):.2g} times as fast as what moves")
    assert over_scene(still, scene) == over_scene(known, DATA.scene) == {}  # no film
