import json
import platform
import re
from dataclasses import replace
from functools import partial

import imageio.v3 as iio
import pytest
import torch

from forewarp.data.batches import Targets, color_of
from forewarp.data.module import SceneDataModule
from forewarp.evaluation import evaluate as evaluation
from forewarp.evaluation.evaluate import (
    RenderedView,
    draw,
    evaluate,
    flow_error,
    keypoint_transfer,
    reduced_rendering,
    show,
)
from forewarp.methods.method import parameter_count
from forewarp.methods.voxel.effects import LearnedUpsampler
from forewarp.methods.voxel.model import VoxelSnapshot
from forewarp.metrics.registry import ImageSuite
from forewarp.scene.camera import joined
from forewarp.scene.frame import Truth
from forewarp.scene.view import Rendering
from tests.support.tiny_scene import (
    INPAINTER,
    ball_data,
    ball_scene,
    forward_model,
    frame_at,
    make_run,
    stage,
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of a few steps over the ball."""
    return make_run(tmp_path_factory.mktemp("run"), [stage(iterations=4)])


@pytest.fixture(scope="module")
def module(run):
    """What it fitted."""
    return run.fit()


@pytest.mark.slow
def test_fewer_views_are_evenly_spread_and_named(run, module, tmp_path):
    evaluate(module, run.datamodule, tmp_path, ImageSuite())
    (tmp_path / "images" / "mine.png").touch()
    metrics = evaluate(module, run.datamodule, tmp_path, ImageSuite(), sheets=6, views=2)
    rows = json.loads((tmp_path / "per_image.json").read_text())["images"]
    assert [row["name"] for row in rows] == ["t_0", "t_2"]
    assert {path.stem for path in (tmp_path / "images" / "sheets").glob("*.png")} == {"t_0", "t_2"}
    assert {path.stem for path in (tmp_path / "images").glob("*.png")} == {"t_0", "t_2", "mine"}
    assert metrics["protocol"]["measured"] == "2 of 3 test views, evenly spread"
    assert metrics["test"]["all"]["psnr"] == pytest.approx(sum(row["scores"]["psnr"] for row in rows) / 2)


@pytest.mark.slow
def test_scores_every_image_and_saves_it(run, module, tmp_path):
    seen = []
    more = {"finished": run.finished(), "sheets": 2, "progress": lambda *done: seen.append(done)}
    metrics = evaluate(module, run.datamodule, tmp_path, ImageSuite(), protocol={"seed": 5}, **more)
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    rows = json.loads((tmp_path / "per_image.json").read_text())["images"]
    assert metrics["test"]["all"]["psnr"] == pytest.approx(sum(row["scores"]["psnr"] for row in rows) / 3)
    assert {path.stem for path in (tmp_path / "images").glob("*.png")} == {"t_0", "t_1", "t_2"}
    assert len(list((tmp_path / "images" / "sheets").glob("*.png"))) == 2
    sheet = iio.imread(tmp_path / "images" / "sheets" / "t_0.png")
    assert sheet.shape == (312, 3 * 312 + 2 * 4, 3)  # 24 pixels, each 13 times
    assert (metrics["steps"], metrics["protocol"]["seed"]) == ({"coarse": 4}, 5)
    assert "flow" not in metrics  # the scene has no truth
    seconds = metrics["seconds"]
    assert seconds["train"] == seconds["coarse"] > 0
    assert 0 < seconds["render_again_per_frame"] < seconds["render_per_frame"]
    again = evaluate(module, run.datamodule, tmp_path / "again", ImageSuite(), sheets=0)
    assert again["test"] == metrics["test"]
    assert not (tmp_path / "again" / "images" / "sheets").exists()


def test_depth_is_drawn_in_the_colours_of_the_true_one(run, module, tmp_path):
    scene = run.datamodule.scene
    near, far = torch.full((24, 24), 2.0), torch.full((24, 24), 4.0)
    true = torch.where(torch.arange(24) < 8, 0.0, torch.where(torch.arange(24) < 16, near, far))
    test = tuple(replace(frame, load_depth=lambda: true) for frame in scene.test[:1])
    target = Targets(test, torch.ones(3), has_alpha=True)[0]
    depth = torch.where(true == 4, 3.2, torch.where(true == 2, 2.0, 7.0))
    rendering = Rendering(torch.ones(576, 3), depth.flatten(), (true > 0).float().flatten())
    of_truth, of_rendering, error = evaluation._depth_parts(rendering, target)
    assert bool((of_truth[:5, :8] == 1).all())  # the background is white
    assert bool((of_rendering[:5, :8] == 1).all())
    assert torch.allclose(of_truth[0, 8], of_rendering[0, 8])  # 2 as 2
    assert not torch.allclose(of_truth[0, 20], of_rendering[0, 20])
    assert bool((error[0, :16] == 0).all())
    assert torch.allclose(error[0, 20], torch.tensor([1.0, 1.0, 0.9]))  # a factor of 1.25 and more
    evaluation._save(RenderedView(0, target, {"warped": rendering}, 0.0, 0.0), tmp_path, True)
    assert iio.imread(tmp_path / "depth" / "t_0.png").shape == (312, 3 * 312 + 2 * 4, 3)


@pytest.mark.slow
def test_a_network_is_described_beside_the_numbers(tmp_path):
    changes = {"inpainter": INPAINTER, "upsampler": partial(LearnedUpsampler, width=8)}
    run = make_run(tmp_path, [stage(iterations=1)], model=forward_model(**changes))
    module = run.fit()
    evaluate(module, run.datamodule, tmp_path, ImageSuite(), views=1)
    steps = json.loads((tmp_path / "networks.json").read_text())["inpainter"]
    own = (module.method.inpainter, module.method.upsampler)
    assert sum(step["parameters"] for step in steps) == sum(map(parameter_count, own))


@pytest.mark.slow
def test_what_moves_is_scored_apart(run, module, tmp_path, capsys):
    def masked(frame, mask):
        return replace(frame, load_moving=lambda: mask)

    scene, masks = run.datamodule.scene, torch.zeros(3, 24, 24, dtype=torch.bool)
    masks[0, 4:9, 3:20], masks[1, 10:12, 10:12] = True, True  # nothing moves in the last
    valid = torch.ones(24, 24, dtype=torch.bool)
    valid[:6] = False
    test = [masked(frame, mask) for frame, mask in zip(scene.test, masks)]
    test[0] = replace(test[0], load_valid=lambda: valid)
    data = SceneDataModule(lambda: replace(scene, test=tuple(test), protocol={"seconds": 2.0}), rays=60)
    metrics = evaluate(module, data, tmp_path, ImageSuite())
    images = {}
    for view in draw(module, data.targets("test")):
        rgb = list(view.renderings.values())[-1].rgb.reshape(24, 24, 3).clamp(0, 1)
        images[view.number] = ((255 * rgb).round() / 255 - (255 * view.target.rgb).round() / 255).square()

    def psnr_of(*chosen):
        return [-10 * torch.log10(images[i][pixels].mean()).item() for i, pixels in enumerate(chosen)]

    expected = psnr_of(masks[0] & valid, masks[1])
    assert metrics["test"]["moving"] == {"psnr": pytest.approx(sum(expected) / 2, abs=1e-4)}
    still = psnr_of(~masks[0] & valid, ~masks[1], ~masks[2])
    assert metrics["test"]["still"] == {"psnr": pytest.approx(sum(still) / 3, abs=1e-4)}
    rows = json.loads((tmp_path / "per_image.json").read_text())["images"]
    assert [sorted(row["parts"]) for row in rows] == [["moving", "still"], ["moving", "still"], ["still"]]
    assert rows[1]["parts"]["moving"]["psnr"] == pytest.approx(expected[1], abs=1e-4)
    assert metrics["protocol"]["nearest_training_frame"].endswith(" s")
    show(metrics, tmp_path)
    shown = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines() if line.strip()}
    assert shown["moving"][1] == f"{metrics['test']['moving']['psnr']:.2f}"


def test_warps_once_a_time(module, monkeypatch):
    targets = ball_data().targets("test")
    times, at, render, clock = [], module.method.at, VoxelSnapshot.render, [0.0]

    def warped(moment):
        times.append(moment.time)
        clock[0] += 10
        return at(moment)

    def drawn(*arguments):
        clock[0] += 1
        return render(*arguments)

    monkeypatch.setattr(module.method, "at", warped)
    monkeypatch.setattr(VoxelSnapshot, "render", drawn)
    monkeypatch.setattr(evaluation, "now", lambda: clock[0])
    frames = [targets.frames[i] for i in (2, 0, 2, 0)]
    views = list(draw(module, Targets(frames, targets.background, targets.has_alpha)))
    assert times == [0.0, 1.0]
    assert [view.number for view in views] == [1, 3, 0, 2]
    assert [(view.seconds, view.seconds_again) for view in views] == [(11, 1), (1, 1)] * 2


def dome_scene():
    """The ball as three of four cameras of a dome see it."""
    frames = tuple(frame_at(f"{t}/{k}", k / 4, t, 12) for t in (0.0, 0.5, 1.0) for k in range(4))
    return replace(ball_scene(frames=2, size=12), train=frames, val=(), test=frames[::4])


def test_training_warps_once_for_the_rays_of_several_cameras(module, monkeypatch):
    times, at = [], module.method.at
    monkeypatch.setattr(module.method, "at", lambda moment: times.append(moment.time) or at(moment))
    batch = SceneDataModule(dome_scene, rays=60, views_per_step=3).batches.draw()
    assert len({observation.moment.frame for observation in batch.observations}) == 3
    rays = joined([observation.view.rays() for observation in batch.observations])
    assert (len(rays), len(rays.origins.unique(dim=0))) == (60, 3)
    assert torch.isfinite(module.loss_of(batch)[0])
    assert times == [batch.time]


def test_flow_is_measured_against_the_truth(run, module):
    points = torch.rand(5, 1, 3)
    drifting = torch.cat([points, points + torch.tensor([0.5, 0.0, 0.0])], 1)
    truth = Truth(drifting, torch.tensor([0.0, 1.0], dtype=torch.float64))
    flow = flow_error(module, replace(run.datamodule.scene, truth=truth))
    predicted = module.method.trajectories(points[:, 0], torch.tensor([0.0, 1.0])).detach()
    error = float((predicted - drifting)[:, 1].norm(dim=-1).mean())
    assert (flow["epe_moving"], flow["motion_mean"]) == pytest.approx((error, 0.5), rel=1e-5)


def test_keypoints_are_carried_between_all_pairs_of_frames(run, module, monkeypatch):
    """Of pixels that stay at depth 3 of the first camera but for one, and a frame that sees only that one."""
    scene, shown = run.datamodule.scene, []
    camera = scene.train[0].camera  # of 24 pixels: 5 % are 1.2
    assert keypoint_transfer(module, scene) is None
    points = torch.tensor([[5.5, 9.5, 1.0], [20.5, 3.5, 1.0], [2.0, 2.0, 0.0]])
    moved = points + torch.tensor([[1.0, 0, 0], [3, 0, 0], [0, 0, 0]])
    alone = points * torch.tensor([1.0, 1.0, 0.0])
    alone[2] = torch.tensor([4.0, 4, 1])
    keypoints = [points, moved, alone]
    train = [replace(f, camera=camera, keypoints=k) for f, k in zip(scene.train, keypoints)]
    scene = replace(scene, train=(*train, *scene.train[3:]))
    assert keypoint_transfer(module, scene) is None  # the method carries none

    def carried(view, moment, to):
        shown.append((moment.frame, to.frame))
        rays = view.rays()
        return rays.origins + 3 * rays.directions

    monkeypatch.setattr(module.method, "carried", carried, raising=False)
    found = keypoint_transfer(module, scene)
    assert found == {"pck_t": pytest.approx((1 + 0.5 + 0.5 + 1 + 1) / 5), "pairs": 5}
    assert shown == [(0, 0), (0, 1), (1, 0), (1, 1), (2, 2)]
    monkeypatch.setattr(module.method, "carried", lambda view, *_: torch.full((len(view), 3), torch.nan))
    assert keypoint_transfer(module, scene)["pck_t"] == 0


@pytest.mark.parametrize("background", ["white", "black"])
@pytest.mark.parametrize("straight", [True, False])
def test_a_perfect_rendering_becomes_the_reduced_truth(background, straight):
    frame, behind = ball_scene().test[0], color_of(background)
    (whole,) = Targets([frame], behind, True)
    opacity = frame.load()[..., 3].flatten() / 255
    if not straight:
        opaque = torch.cat([whole.rgb, torch.ones(24, 24, 1)], -1) * 255
        frame = replace(frame, load=lambda: opaque.round().to(torch.uint8))
    (truth,) = Targets([frame], behind, straight).reduced(2)
    rendering = Rendering(whole.rgb.reshape(-1, 3), (opacity > 0) * 2.0, opacity)
    small = reduced_rendering(rendering, (24, 24), 2, behind, straight=straight)
    assert float((small.rgb.reshape(12, 12, 3) - truth.rgb).abs().max()) < 1.1 / 255  # truth has 8 bits
    assert set(small.depth.tolist()) == {0.0, 2.0}
    torch.testing.assert_close(small.opacity.mean(), opacity.mean())


def test_a_run_is_scored_at_half_its_size(run, module, tmp_path):
    metrics = evaluate(module, run.datamodule, tmp_path, ImageSuite(), sheets=1, reduce=2)
    assert metrics["protocol"]["reduced"] == 2
    assert iio.imread(tmp_path / "images" / "t_0.png").shape == (12, 12, 3)
    with pytest.raises(ValueError, match="reduce: expected pictures with sides that 5 divides"):
        evaluate(module, run.datamodule, tmp_path, ImageSuite(), reduce=5)


def test_seconds_of_an_image_have_three_digits(capsys, tmp_path):
    seconds = {"train": 61.0, "fine": 61.0, "render_per_frame": 0.00277, "render_again_per_frame": 12.345}
    show({"protocol": {"scene": "x"}, "seconds": seconds}, tmp_path)
    assert "trained 1:01 (fine 1:01), 0.00277 s a frame, 12.3 s another at" in capsys.readouterr().out


def test_what_only_an_expert_asks_for_is_stored_and_not_printed(capsys, tmp_path):
    seconds = {"train": 61.0, "render_per_frame": 0.1, "render_again_per_frame": 0.1}
    protocol, test = {"scene": "x", "departures": "c"}, {"all": {"psnr": 30.0, "ms_ssim_legacy": 0.9}}
    absent = {"lpips_vgg": "no backbone weights"}
    show({"protocol": protocol, "seconds": seconds, "test": test, "absent": absent}, tmp_path)
    printed = capsys.readouterr().out
    assert "30.00" in printed
    assert not {"departures", "legacy", "weights"} & {*re.findall(r"[a-z]+", printed)}


@pytest.mark.parametrize(
    ("lines", "name"),
    [("processor : 0\nmodel name\t: A Thing 9\n", "A Thing 9"), (None, "arm"), ("model name :\n", "arm")],
)
def test_a_machine_is_called_by_its_processor(lines, name, monkeypatch, tmp_path):
    monkeypatch.setattr(platform, "processor", lambda: "arm")
    monkeypatch.setattr(evaluation, "_PROCESSOR", tmp_path / "cpuinfo")
    if lines is not None:
        (tmp_path / "cpuinfo").write_text(lines)
    assert evaluation.device_name(torch.device("cpu")) == name
