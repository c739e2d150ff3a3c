import json
import logging
import math
from dataclasses import replace

import pytest
import torch

from forewarp.evaluation.evaluate import table_of
from forewarp.metrics import image, lpips, registry
from forewarp.metrics.lpips import LPIPS
from forewarp.metrics.registry import (
    METRICS,
    ImageSuite,
    Metric,
    absences,
    described,
    metric_of,
    summarise,
    take_described,
)
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame
from forewarp.scene.view import Target

DEPTH_METRICS = [name for name, metric in METRICS.items() if metric.needs_depth]


def target(height=34, width=40, depth=None, foreground=None, seed=0):
    rgb = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))
    pose = torch.eye(4, dtype=torch.float64)
    camera = Camera(width, height, 50.0, 50.0, width / 2, height / 2, pose, 1.0, 5.0)
    frame = Frame("test/r_007", 0.5, camera, load=lambda: None)
    return Target(frame, rgb, torch.ones(3), foreground=foreground, depth=depth)


@pytest.fixture
def alex(tmp_path):
    torch.manual_seed(0)
    torch.save(lpips.alexnet_features().state_dict(), tmp_path / "alexnet.pth")
    return LPIPS("alex", tmp_path / "alexnet.pth")


@pytest.mark.slow
def test_scores_are_the_metrics_in_fixed_order(alex):
    true = target(170, 180, depth=torch.full((170, 180), 2.0))
    prediction = (true.rgb + 0.1).clamp(0, 1)
    scores = ImageSuite({"lpips_alex": alex}).score(prediction, true, torch.full((170, 180), 2.2))
    absent = [name for name in METRICS if METRICS[name].needs_covisible or name.endswith(("squeeze", "vgg"))]
    assert list(scores) == [name for name in METRICS if name not in ("psnr_box", *absent)]
    for name in ("psnr", "ssim", "ms_ssim", "ms_ssim_legacy"):
        assert scores[name] == getattr(image, name)(prediction, true.rgb)
    assert scores["dssim"] == (1 - scores["ms_ssim"]) / 2
    assert scores["lpips_alex"] == alex(prediction, true.rgb)
    assert [scores[f"depth_delta_{ratio}"] for ratio in ("1.02", "1.25", "1.5625")] == [0.0, 1.0, 1.0]


@pytest.mark.slow
def test_what_training_images_show_too_is_scored_apart(alex):
    covisible = torch.zeros(34, 40, dtype=torch.bool)
    covisible[3:30, 4:9] = True
    true = replace(target(), covisible=covisible)
    prediction = torch.where(covisible[..., None], (true.rgb + 0.1).clamp(0, 1), 0.0)
    suite = ImageSuite({"lpips_alex": alex})
    scores = suite.score(prediction, true)
    part = prediction[covisible][None], true.rgb[covisible][None]
    assert scores["mpsnr"] == image.psnr(*part) > scores["psnr"]
    assert scores["mssim"] == image.masked_ssim(prediction, true.rgb, covisible)
    assert scores["mlpips_alex"] == alex(prediction, true.rgb, covisible)
    scores = suite.score(prediction, replace(true, covisible=covisible & ~covisible))
    assert not {"mpsnr", "mssim", "mlpips_alex"} & {*scores}
    assert suite.absent["mpsnr"] == "frame test/r_007 has no pixel that training images show too"


def test_what_an_image_does_not_allow_is_left_out_and_said_once(caplog, monkeypatch):
    # The command line, where a test before this one ran it, quietens loggers.
    for name in ("forewarp", "forewarp.metrics", "forewarp.metrics.registry"):
        for key, value in (("disabled", False), ("propagate", True), ("level", logging.NOTSET)):
            monkeypatch.setattr(logging.getLogger(name), key, value)
    with caplog.at_level(logging.WARNING):
        suite = ImageSuite({"lpips_vgg": None})
        for _ in range(3):
            scores = suite.score(target().rgb, target(depth=torch.zeros(34, 40)), torch.ones(34, 40))
    assert scores == {"psnr": image.PSNR_CAP, "ssim": pytest.approx(1)}
    assert set(suite.absent) == {"lpips_vgg", "ms_ssim", "ms_ssim_legacy", *DEPTH_METRICS}
    assert suite.absent["lpips_vgg"] == "no backbone weights were found"
    assert suite.absent["ms_ssim"] == "frame test/r_007 is 40x34 pixels, a side must have 161"
    assert suite.absent["depth_delta_1.25"] == "frame test/r_007 has no foreground"
    assert len(caplog.records) == len(suite.absent) == 6


def test_the_mask_box_is_scored_where_it_is_asked_for():
    foreground = torch.zeros(34, 40, dtype=torch.bool)
    foreground[5, 20] = foreground[9, 12] = True
    true = target(foreground=foreground)
    prediction = (true.rgb + 0.1).clamp(0, 1)
    prediction[5:10, 12:21] = true.rgb[5:10, 12:21] * 0.9
    scores = ImageSuite(mask_box=True).score(prediction, true)
    assert list(scores) == ["psnr", "psnr_box", "ssim"]
    assert scores["psnr_box"] == image.psnr(prediction[5:10, 12:21], true.rgb[5:10, 12:21])
    assert scores["psnr"] == image.psnr(prediction, true.rgb) < scores["psnr_box"]
    assert "psnr_box" not in ImageSuite().score(prediction, true)
    for nothing in (None, torch.zeros(34, 40, dtype=torch.bool)):
        suite = ImageSuite(mask_box=True)
        assert "psnr_box" not in suite.score(prediction, target(foreground=nothing))
        assert suite.absent["psnr_box"] == "frame test/r_007 has no foreground"


def test_pixels_that_do_not_count_are_not_scored():
    valid = torch.rand(34, 40, generator=torch.Generator().manual_seed(1)) < 0.7
    true = replace(target(), valid=valid)
    prediction = torch.where(valid[..., None], (true.rgb + 0.1).clamp(0, 1), 1 - true.rgb)
    scores, found = ImageSuite().score(prediction, true), (true.rgb + 0.1).clamp(0, 1)
    assert scores["psnr"] == image.psnr(found[valid][None], true.rgb[valid][None])
    assert scores["ssim"] == image.ssim(torch.where(valid[..., None], found, true.rgb), true.rgb)


def test_errors_name_the_frame():
    true = target(depth=torch.ones(34, 40))
    prediction = true.rgb.clone()
    prediction[0, 0, 0] = math.inf
    with pytest.raises(ValueError, match=r"frame test/r_007: prediction: expected finite values, but got 1"):
        ImageSuite().score(prediction, true)
    with pytest.raises(ValueError, match=r"frame test/r_007: depth: expected .* but got \(40, 34\)"):
        ImageSuite().score(true.rgb, true, torch.ones(40, 34))


def test_lpips_names_name_their_net(alex):
    with pytest.raises(ValueError, match="lpips: expected names of lpips_squeeze, .* but got 'lpips'"):
        ImageSuite({"lpips": None})
    with pytest.raises(ValueError, match="but got 'lpips_vgg' for the net 'alex'"):
        ImageSuite({"lpips_vgg": alex})


def test_summary_by_hand():
    rows = [("canonical", {"ssim": 0.5, "psnr": 30.0}), ("space", {"psnr": 20.0, "depth_delta_1.02": 1.0})]
    rows.append(("space", {"psnr": 24.0}))
    found, space = summarise(iter(rows)), {"psnr": 22.0, "depth_delta_1.02": 1.0}
    assert found == {"space": space, "canonical": {"psnr": 30.0, "ssim": 0.5}}
    assert (list(found), list(found["canonical"])) == (["space", "canonical"], ["psnr", "ssim"])
    assert summarise([]) == {}


def test_a_metric_of_some_images_is_named_beside_those_of_none():
    masked = {"psnr": 30.0, "mpsnr": 31.0, "depth_delta_1.02": 1.0}
    absent = absences([masked, masked, {"psnr": 20.0}], {"ssim": "small", "depth_delta_1.02": "empty"})
    assert (list(absent), absent["ssim"]) == (["ssim", "depth_delta_1.02", "mpsnr"], "small")
    assert absent["mpsnr"].startswith("only of 2 of 3 images")
    assert absent["depth_delta_1.02"].endswith(": empty")
    assert absences([masked, masked], {}) == {}


@pytest.mark.parametrize(
    ("kind", "scores", "message"),
    [
        (
            "spcae",
            {"psnr": 1.0},
            "ability: expected one of space, time, .*, still, crossed, .*, but got 'spcae'",
        ),
        ("all", {"pnsr": 1.0}, "metric: expected one of psnr, .* but got 'pnsr'"),
        ("all", {"psnr": math.nan}, "psnr: expected a finite score, but got nan"),
    ],
)
def test_summary_refuses(kind, scores, message):
    with pytest.raises(ValueError, match=message):
        summarise([(kind, scores)])


def test_a_metric_is_known_from_a_run_where_its_package_is_not(monkeypatch):
    monkeypatch.setattr(registry, "_STORED", {})
    error = Metric("mean_error", "Mean error", 3, False, unit="px")
    with monkeypatch.context() as imported:
        imported.setitem(METRICS, "mean_error", error)
        content = json.loads(json.dumps(described(["psnr", "mean_error"])))
    assert metric_of("mean_error") == Metric("mean_error", "mean error")
    take_described(content | {"psnr": {"title": "Noise", "digits": 0, "higher_is_better": False}})
    assert metric_of("mean_error") == error
    assert metric_of("psnr") is METRICS["psnr"]
    for broken in (None, [1], {"a": 3}, {"b": {"digits": -1}}, {"c": {"title": 3, "higher_is_better": "no"}}):
        take_described(broken)
    assert metric_of("a") == Metric("a", "a")
    assert metric_of("b") == Metric("b", "b")
    assert metric_of("c") == Metric("c", "c")


def test_a_registered_metric_is_scored_averaged_and_printed(monkeypatch):
    error = Metric("mean_error", "Mean error", 3, False, score=lambda image, target, depth: 0.25)
    monkeypatch.setitem(METRICS, "mean_error", error)
    scores = ImageSuite().score(target().rgb, target())
    assert list(scores) == ["psnr", "ssim", "mean_error"]
    test = summarise([("all", scores)])
    assert test["all"]["mean_error"] == 0.25
    table = table_of({"protocol": {"scene": "x"}, "test": test})
    assert [column.header for column in table.columns][-1] == "mean_error"
    assert [*table.columns[-1].cells] == ["0.250"]
