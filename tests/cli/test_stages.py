"""Particles that begin with a stage of voxels, as one types it."""

import pytest

from forewarp import load
from forewarp.methods.particles.model import Particles
from forewarp.synth.scenes import synthesize
from forewarp.training.handover import load_handover


@pytest.mark.slow
def test_particles_begin_where_voxels_found_matter(ok, refused, in_tmp, monkeypatch):
    def elsewhere(*_):
        raise AssertionError("they began somewhere else")

    for start in ("hull_surface", "swept", "anywhere"):
        monkeypatch.setattr(f"forewarp.methods.particles.start.{start}", elsewhere)
    synthesize(in_tmp / "x", size=24, frames=8, test_views=(1, 1, 0), val_views=0, samples_per_pixel=1)
    words = ["data=dnerf", "data.root=.", "data.scene=x", "trainer=cpu", "threads=1", "logger=none"]
    words += [
        "stage=particles_after_forward",
        "stage.coarse.num_voxels=[[0,800]]",
        "stage.coarse.start_alpha=0.5",
    ]
    words += ["budget.minutes=null", "budget.iterations=6", "run=run", "sheets=0", "evaluate=false"]
    assert "expected a number, as the method is trained on single rays" in refused("train", *words)
    ok("train", *words, "preset.rays=64")
    assert len(load_handover(in_tmp / "run" / "coarse").cloud) >= 16
    assert isinstance(load(in_tmp / "run").method, Particles)
    line = refused("train", *words, "preset.rays=64", "model/radiance=mlp")
    assert "model/radiance: expected an option of model=particles" in line  # of the run as ever
