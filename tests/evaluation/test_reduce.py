"""Rendered views made smaller as the datasets make their pictures smaller."""

import json

import pytest
import torch

from forewarp.data.batches import Targets, color_of
from forewarp.evaluation.evaluate import evaluate, reduced_rendering
from forewarp.metrics.suite import ImageSuite
from forewarp.scene.view import Rendering
from tests.support.tiny_scene import ball_scene, make_run, stage


@pytest.mark.parametrize("background", ["white", "black"])
@pytest.mark.parametrize("straight", [True, False])
def test_a_perfect_rendering_becomes_the_reduced_truth(background, straight):
    frame = ball_scene().test[0]
    behind = color_of(background)
    (whole,) = Targets([frame], behind, True)
    opacity = frame.load()[..., 3].flatten() / 255
    if not straight:
        frame = type(frame)("a", 0.0, frame.camera, lambda: opaque(whole.rgb))
    (truth,) = Targets([frame], behind, straight).reduced(2)
    rendering = Rendering(whole.rgb.reshape(-1, 3), (opacity > 0) * 2.0, opacity)
    small = reduced_rendering(rendering, (24, 24), 2, behind, straight=straight)
    assert float((small.rgb.reshape(12, 12, 3) - truth.rgb).abs().max()) < 1.1 / 255  # truth has 8 bits
    assert set(small.depth.tolist()) == {0.0, 2.0}
    torch.testing.assert_close(small.opacity.mean(), opacity.mean())


def opaque(rgb):
    return (torch.cat([rgb, torch.ones(*rgb.shape[:2], 1)], -1) * 255).round().to(torch.uint8)


def test_a_run_is_scored_at_half_its_size(tmp_path):
    run = make_run(tmp_path / "run", [stage(iterations=2)])
    module = run.fit()
    metrics = evaluate(module, run.datamodule, tmp_path, ImageSuite(), sheets=1, reduce=2)
    assert metrics["protocol"]["reduced"] == 2
    rows = json.loads((tmp_path / "per_image.json").read_text())["images"]
    assert len(rows) == 3
    whole = evaluate(module, run.datamodule, tmp_path, ImageSuite(), sheets=0)
    assert "reduced" not in whole["protocol"]
    assert whole["test"]["all"]["psnr"] != metrics["test"]["all"]["psnr"]
    with pytest.raises(ValueError, match="reduce: expected pictures with sides that 5 divides"):
        evaluate(module, run.datamodule, tmp_path, ImageSuite(), reduce=5)
