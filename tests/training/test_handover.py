"""The handover of a stage: what it contains, and that it is written and read correctly."""

import json
import math
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from forewarp.methods.method import Method, Start
from forewarp.scene.box import Box
from forewarp.scene.cloud import Cloud, Handover
from forewarp.training.checkpoints import load_handover, make_handover, save_handover
from tests.support.tiny_scene import BOX, RADIUS, ball_center, ball_method, ball_scene, forward_model

SCENE = ball_scene(frames=6, size=16)


@pytest.mark.parametrize("moving", [True, False])
def test_round_trip(tmp_path, moving):
    cloud = Cloud(torch.rand(5, 3), torch.rand(5, 3), torch.rand(5), 0.25)
    times, paths = (torch.rand(4), torch.rand(5, 4, 3)) if moving else (None, None)
    box, notes = Box((-1.0, 0.25, 1 / 3), (1.0, 2.0, 3.0)), {"density_scale": 0.1}
    save_handover(Handover(box, True, 17, cloud, times, paths, notes), tmp_path)
    read = load_handover(tmp_path)
    assert (read.box, read.tight, read.frames_in_play, read.notes) == (box, True, 17, notes)
    assert_close(vars(read.cloud), vars(cloud), rtol=0, atol=0)
    assert not moving or (read.times.equal(times) and read.paths.equal(paths))
    assert (read.times is None) == (read.paths is None) == (not moving)


def _numbers(**changes):
    return lambda numbers, _: numbers.write_text(json.dumps(json.loads(numbers.read_text()) | changes))


@pytest.mark.parametrize(
    "spoil",
    [
        lambda numbers, _: numbers.write_text("{"),
        lambda numbers, _: numbers.write_text("[1]"),
        lambda numbers, _: numbers.unlink(),
        lambda _, points: points.unlink(),
        lambda _, points: points.write_bytes(b"nonsense"),
        *(_numbers(low=low) for low in ([1.0, 2.0], [0, 0, "x"])),
        _numbers(high=[-9, -9, -9]),
        *(_numbers(notes=notes) for notes in (None, {"density_scale": "long"}, {"density_scale": math.inf})),
        _numbers(size=-1.0),
    ],
)
def test_what_is_no_handover_is_refused_in_one_line(tmp_path, spoil):
    cloud = Cloud(torch.rand(5, 3), torch.rand(5, 3), torch.rand(5), 0.25)
    save_handover(Handover(BOX, True, 3, cloud, notes={"density_scale": 0.1}), tmp_path)
    load_handover(tmp_path)
    spoil(tmp_path / "handover.json", tmp_path / "handover.pt")
    with pytest.raises(ValueError, match=r"handover\.\w+: expected what a stage leaves to the next, but got"):
        load_handover(tmp_path)


def test_a_stage_leaves_the_tight_box():
    method = ball_method(SCENE)
    handover = make_handover(method, SCENE, None, 6)
    assert handover.tight
    assert handover.notes == {"density_scale": method.radiance.activation.density_scale}
    assert handover.frames_in_play == 6
    center, margin = ball_center(0.0), RADIUS + 4 * method.radiance.lattice.voxel_size
    for low, high, middle in zip(handover.box.low, handover.box.high, center.tolist()):
        assert middle - margin < low < middle - 0.5 * RADIUS
        assert middle + 0.5 * RADIUS < high < middle + margin


def test_the_box_holds_what_the_stage_calls_matter():
    method, asked = ball_method(SCENE, box_alpha=0.25), []
    bounds = method.bounds
    method.bounds = lambda times: asked.append(times) or bounds(times)
    thin = ball_method(SCENE, raw=2.0, box_alpha=0.25)  # an opacity of 0.07 over a voxel
    assert make_handover(method, SCENE, None, 6).tight
    assert asked == [list(SCENE.times)]
    assert not make_handover(thin, SCENE, None, 6).tight
    assert make_handover(ball_method(SCENE, raw=2.0, box_alpha=0.01), SCENE, None, 6).tight


def test_a_stage_leaves_its_matter_and_the_paths_of_it_or_a_sample(monkeypatch):
    method = ball_method(SCENE)
    handover, matter = make_handover(method, SCENE, None, 6), method.matter()
    assert 20 < len(handover.cloud) == len(matter)
    assert handover.cloud.points.equal(matter.points)
    assert float((matter.points - ball_center(0.0)).norm(dim=-1).max()) < RADIUS
    assert handover.times.tolist() == pytest.approx(list(SCENE.times))
    assert handover.paths.equal(method.trajectories(matter.points, handover.times))
    monkeypatch.setattr("forewarp.training.checkpoints._POINTS", 7)
    monkeypatch.setattr("forewarp.training.checkpoints._TIMES", 3)
    handover = make_handover(method, SCENE, None, 6)
    assert handover.paths.shape == (7, 3, 3)
    assert handover.times.tolist() == pytest.approx([SCENE.times[i] for i in (0, 2, 4)], abs=0.21)


@pytest.mark.parametrize("box", [None, BOX.scaled(0.5)])
def test_a_stage_that_found_nothing_keeps_its_box_and_says_so(box):
    before = None if box is None else Handover(box, True, 6)
    method = forward_model()(Start(SCENE, "coarse", {"num_voxels": [[0, 1500]]}, range(6), before))
    method.radiance.density.data[:] = -9.0
    handover = make_handover(method, SCENE, before, 6)
    assert not handover.tight
    assert handover.box == method.radiance.lattice.box == (box or BOX)
    assert len(handover.cloud) == 0


class Astray(Method):
    """A method that moved out of the scene, and can tell nothing else."""

    def bounds(self, times):
        return Box((9.0, 9.0, 9.0), (10.0, 10.0, 10.0))


@pytest.mark.parametrize("method", [Astray, Method])
def test_of_a_method_that_can_tell_nothing_the_box_is_left(tmp_path, method):
    handover = make_handover(method(), SCENE, None, 4)
    assert handover == Handover(BOX, False, 4)
    save_handover(handover, tmp_path)
    assert load_handover(tmp_path) == handover
    assert not (tmp_path / "handover.pt").exists()


def test_what_lies_outside_the_scene_is_cut_off():
    far = replace(SCENE, box=BOX.scaled(0.3))
    box = make_handover(ball_method(SCENE), far, None, 6).box
    assert all(high <= edge + 1e-6 for high, edge in zip(box.high, far.box.scaled(1.05).high))
