"""What the ends of time lack: the motion alone is trained on, and a test view that is shown gains by it."""

from types import SimpleNamespace

import pytest
import torch

from tests.bench import ends
from tests.stability.test_particles_training import fit
from tests.support.tiny_scene import ball_scene


def test_the_motion_alone_is_trained_on(tmp_path):
    scene = ball_scene(frames=8, size=24)
    module, _ = fit(tmp_path, scene, 60, background=None)
    view = ends.sorted_from(scene.test, last=True)[0]
    before = {name: p.detach().clone() for name, p in module.method.named_parameters()}
    had = ends.psnr(module.method, view)
    ends.refit(module, scene, last=True, view=view, steps=60)
    changed = {name for name, p in module.method.named_parameters() if not torch.equal(p, before[name])}
    assert {"nodes.shift", "nodes.turn", "skin.learned"} <= changed
    assert all(name.startswith(("nodes.", "skin.")) for name in changed)
    assert ends.psnr(module.method, view) > had


def test_both_ends_are_listed(tmp_path, monkeypatch, capsys):
    scene = ball_scene(frames=6, size=16)
    module, _ = fit(tmp_path, scene, 4)
    monkeypatch.setattr(ends, "load", lambda run: SimpleNamespace(module=module, scene=scene))
    monkeypatch.setattr(ends, "report", lambda run, whole=ends.report: whole(run, steps=2))
    ends.main(["somewhere"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(" | ")[:2] for line in lines[2::3]] == [
        ["| first", "as it is"],
        ["| last", "as it is"],
    ]
    assert len(lines) == 2 + 6
    with pytest.raises(SystemExit, match="usage: python -m tests.bench.ends RUN"):
        ends.main([])


def test_particles_that_rest_are_refused(tmp_path):
    scene = ball_scene(frames=6, size=16)
    module, _ = fit(tmp_path, scene, 2, motion=None)
    with pytest.raises(ValueError, match="expected a run of particles that move"):
        ends.refit(module, scene, last=True, view=None, steps=1)
