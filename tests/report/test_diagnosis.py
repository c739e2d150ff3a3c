"""Where the error of a run is, and what to try: splits by hand, planted defects, keys that compose."""

import json
import math

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from forewarp.metrics.errors import SIGMAS, blurred, split_errors
from forewarp.report.diagnosis import BLURS, KEYS, advice, diagnose, more_steps
from forewarp.report.run_page import read_story
from tests.report.test_run_page import told_run
from tests.support.configs import CONF, composed
from tests.support.runs_on_disk import write_views

SIDE = 96


def noise(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def square_mask(low, high):
    mask = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    mask[low:high, low:high] = True
    return mask


def test_the_groups_of_pixels_add_up():
    prediction, truth = torch.ones(SIDE, SIDE, 3), torch.ones(SIDE, SIDE, 3)
    subject, moving = square_mask(16, 80), square_mask(40, 48)
    prediction[40:48, 40:48] = 0.5  # what moves: 64 pixels, 0.25 each
    prediction[0, 0] = 0.0  # beside the subject: 1
    prediction[16, 16] = 0.0  # at the outline: 1
    sums, ratio = split_errors(prediction, truth, foreground=subject, moving=moving)
    assert sums["all"] == (18.0, SIDE * SIDE)
    assert sums["moving"] == (16.0, 64)
    assert sums["still"] == (1.0, 64 * 64 - 64)
    # A pixel to either side of the square's border.
    assert sums["outline"] == (1.0, 66 * 66 - 62 * 62)
    assert sums["inside"] == (16.0, 62 * 62)
    assert sums["beside"] == (1.0, SIDE * SIDE - 66 * 66)
    assert ratio == pytest.approx(62 * 62 / (62 * 62 - 32))
    halved, _ = split_errors(prediction, truth, valid=~moving)
    assert halved["all"] == (2.0, SIDE * SIDE - 64)
    assert "outline" not in halved
    assert "moving" not in halved


def test_a_gain_and_an_offset_explain_an_exposure_and_nothing_else():
    prediction = 0.2 + 0.5 * blurred(noise(SIDE, SIDE, 3), 3)
    dimmed = prediction * torch.tensor([0.8, 1.1, 0.9]) + torch.tensor([0.05, 0.0, -0.02])
    sums, ratio = split_errors(prediction, dimmed)
    assert sums["exposure"].total < 1e-3 * sums["all"].total
    assert ratio == pytest.approx(float(dimmed.mean() / prediction.mean()))
    other = 0.2 + 0.5 * blurred(noise(SIDE, SIDE, 3, seed=1), 3)
    shifted = prediction.roll((3, 2), (0, 1))
    for truth in (prediction + 0.1 * (other - 0.45), shifted):
        sums, _ = split_errors(prediction, truth)
        assert sums["exposure"].total > 0.8 * sums["all"].total


VIEWS = 20


def run_with(root, psnr=None, **more):
    folder = told_run(root, views=0, **more)
    psnr = psnr or (lambda i, time: 25.0 + 0.3 * (i % 3))
    write_views(folder, {f"r_{i:02d}": (i / (VIEWS - 1), psnr(i, i / (VIEWS - 1))) for i in range(VIEWS)})
    return folder


def diagnosed(folder, sums=None, fit=None, **more):
    views = {f"r_{i:02d}": {name: value(i) for name, value in more.items()} for i in range(VIEWS)}
    for i in range(VIEWS) if sums else ():
        views[f"r_{i:02d}"] |= {"sums": sums(i), "ratio": 1.0}
    return diagnose(read_story(folder), views, fit)


def test_what_is_alike_everywhere_stands_out_nowhere(tmp_path):
    plain = diagnosed(run_with(tmp_path), degrees=lambda i: 3.0 + i, gap=lambda i: 0.5 * (i % 2))
    assert plain.findings == []
    assert plain.lines()[0].startswith("why it is not better: nothing stands out")
    assert {split.name for split in plain.splits} >= {"both ends of the time", "between training times"}


def test_shares_of_the_ends_are_of_squared_errors(tmp_path):
    # Two of 20 views at either end at 20 dB and 26 at 30 dB, up to a ripple that tells no group apart.
    folder = run_with(
        tmp_path, lambda i, time: (20.0 if time <= 0.1 or time >= 0.9 else 30.0) + 1e-3 * (i % 2)
    )
    first = diagnosed(folder).findings[0]
    errors = 4 * 0.01, 16 * 0.001
    assert first.kind == "ends"
    assert first.share == pytest.approx((errors[0] - 4 * 0.001) / sum(errors), abs=1e-3)
    assert first.brings == pytest.approx(-10 * math.log10(20 * 0.001 / sum(errors)), abs=0.01)
    assert "20% of the views hold 71% of the squared error" in first.text


def test_the_worst_stretch_of_time_is_named_with_its_share(tmp_path):
    folder = told_run(tmp_path, views=0, steps=200_000)
    times = [i / 50 + 0.01 for i in range(50)]
    write_views(folder, {f"r_{t:.2f}": (t, 20.0 if 0.4 < t < 0.6 else 30.0) for t in times})
    diagnosis = diagnose(read_story(folder), fit={"images": 50})
    assert [finding.kind for finding in diagnosis.findings] == ["stretch"]
    first = diagnosis.findings[0]
    # Ten views of 0.01 and forty of 0.001.
    assert "Time 0.4 to 0.6: 20% of the views hold 71% of the squared error" in first.text
    assert first.share == pytest.approx((0.1 - 0.01) / 0.14)
    tenth = next(split for split in diagnosis.splits if split.name == "time 0.5 to 0.6")
    assert (tenth.part, tenth.error, tenth.psnr) == pytest.approx((0.1, 0.05 / 0.14, 20.0))


def smooth(generator, times, count):
    """Errors (count, times) of mean 0 and deviation 1, smooth over a tenth of the time."""
    covariance = np.exp(-(np.subtract.outer(times, times) ** 2) / (2 * 0.1**2)) + 1e-8 * np.eye(len(times))
    return generator.standard_normal((count, len(times))) @ np.linalg.cholesky(covariance).T


@pytest.mark.slow
def test_errors_that_are_smooth_in_time_seldom_make_a_finding(tmp_path):
    row, generator, runs = read_story(told_run(tmp_path, steps=1_000_000)), np.random.default_rng(0), 200
    times, blurs = np.linspace(0, 1, 40).tolist(), [f"_{sigma:g}" for sigma in SIGMAS]
    assert len(blurs) == BLURS
    fired = 0
    for _ in range(runs):
        psnr, moving, exposure, *blur = smooth(generator, times, 3 + BLURS)
        names = [f"r_{i:02d}" for i in range(len(times))]
        scores = zip(names, times, (27 + psnr).tolist())
        images = [{"name": n, "time": t, "psnr": score, "ability": "all"} for n, t, score in scores]
        views = {}
        for i, name in enumerate(names):
            sums = {"all": (1.0, 100), "moving": (0.5 * 10 ** (0.1 * moving[i]), 50), "still": (0.5, 50)}
            sums |= {"exposure": (10 ** (0.1 * exposure[i]), 100)}
            for kind, change in zip(blurs, blur):
                sums |= {f"blur{kind}": (10 ** (0.1 * change[i]), 100), f"blurrier{kind}": (1.0, 100)}
            placed = {"gap": 0.5 * (i % 2), "degrees": 3.0 + 0.1 * i + 20 * (i // 3 % 2)}
            views[name] = {"sums": sums, "ratio": 1.0, **placed}
        fired += bool(diagnose(row | {"images": images}, views, {"images": 20}).findings)
    assert fired <= 0.05 * runs


def test_two_static_cameras_are_two_samples(tmp_path):
    camera = lambda i: i // 2 % 2  # noqa: E731
    folder = run_with(tmp_path, lambda i, time: 25.0 + 0.1 * (i % 3) + 3.0 * camera(i), steps=1_000_000)
    assert diagnosed(folder, degrees=lambda i: 30.0 - 28.0 * camera(i)).findings == []


def scene(i):
    """A textured subject before white, a part of it that moves, and a good rendering, of view ``i``."""
    subject, moving = square_mask(16, 80), square_mask(60, 72)
    truth = (0.2 + 0.6 * noise(SIDE, SIDE, 3, seed=i)).where(subject[..., None], torch.tensor(1.0))
    wrong = 0.03 * (noise(SIDE, SIDE, 3, seed=100 + i) - 0.5) * subject[..., None]
    return truth + wrong, truth, subject, moving


def defect(kind, i):
    """The sums of view ``i`` with a defect."""
    prediction, truth, subject, moving = scene(i)
    if kind == "moving":
        prediction = prediction.where(~moving[..., None], torch.tensor(0.5))
    elif kind == "outline":
        rim = square_mask(15, 81) & ~square_mask(17, 79)
        prediction = prediction.where(~rim[..., None], torch.tensor(0.5))
    elif kind == "exposure":
        truth = (truth * (0.85 + 0.3 * (i % 2))).where(subject[..., None], truth)
    elif kind == "blur":
        prediction = blurred(truth, 1.2)
    elif kind == "beside":
        prediction = prediction.where(~square_mask(0, 12)[..., None], torch.tensor(0.8))
    return split_errors(prediction, truth, foreground=subject, moving=moving)[0]


@pytest.mark.parametrize("kind", ["moving", "outline", "exposure", "blur", "beside"])
def test_a_defect_of_pixels_comes_first(tmp_path, kind):
    sums = [defect(kind, i) for i in range(5)]
    first = diagnosed(run_with(tmp_path), lambda i: sums[i % 5]).findings[0]
    assert first.kind == kind
    assert first.share > 0.8


def test_without_a_defect_pixels_say_nothing(tmp_path):
    sums = [defect("", i) for i in range(5)]
    assert diagnosed(run_with(tmp_path), lambda i: sums[i % 5]).findings == []


@pytest.mark.parametrize(
    ("kind", "placed"),
    [
        ("far", {"degrees": lambda i: 2.0 + 28 * (i % 2) + 0.1 * i}),
        ("between", {"gap": lambda i: 0.5 * (i % 2)}),
    ],
)
def test_a_defect_of_views_comes_first(tmp_path, kind, placed):
    by_turns = lambda i, time: 20.0 + 0.1 * (i % 3) + 10.0 * (i % 2 == 0)  # noqa: E731
    folder = run_with(tmp_path, by_turns, steps=100_000)
    first = diagnosed(folder, fit={"images": 20, "spacing": 4.0, "psnr": 30.0}, **placed).findings[0]
    assert first.kind == kind
    # Half the views have ten times the error of the others.
    assert first.brings == pytest.approx(-10 * math.log10(2 / 11), abs=0.2)
    assert "50% of the views hold 91% of the squared error" in first.text


@pytest.mark.parametrize(("degrees", "kind"), [(2.0, "overfit"), (40.0, "far")])
def test_training_images_that_are_far_better_are_overfit_or_far(tmp_path, degrees, kind):
    fit = {"images": 4, "spacing": 4.0, "psnr": 35.0}
    first = diagnosed(run_with(tmp_path), fit=fit, degrees=lambda i: degrees).findings[0]
    assert (first.kind, first.brings) == (kind, pytest.approx(9.7, abs=0.1))


def test_an_exposure_of_test_views_is_no_overfitting(tmp_path):
    sums = [defect("exposure", i) for i in range(5)]
    fit = {"images": 20, "psnr": 25.3 + 10.0}
    first, *_ = diagnosed(run_with(tmp_path, steps=100_000), lambda i: sums[i % 5], fit).findings
    assert first.kind == "exposure"


def test_too_few_steps_come_first_unless_the_curve_is_flat(tmp_path):
    assert more_steps(2.0, 0.0) == 10.0
    first = diagnosed(run_with(tmp_path, steps=200), fit={"images": 50}).findings[0]
    assert (first.kind, first.try_) == ("training", "budget.minutes=4.0")
    assert "4 steps for each training image" in first.text
    flat = run_with(tmp_path, seed=1, steps=2000, curve=((10, 25.0), (20, 25.1), (40, 25.1)))
    assert diagnosed(flat, fit={"images": 50}).findings == []


@pytest.mark.parametrize(
    ("steps", "budget", "share", "done", "try_"),
    [
        (400, {"minutes": 1.0, "iterations": None}, 8, {}, "stage.coarse.steps_per_picture=32"),
        (399, {"minutes": 1.0, "iterations": None}, 8, {}, "budget.minutes=4.0"),
        (300, {"minutes": 1.0, "iterations": 300}, 8, {}, "budget.iterations=1200"),
        (300, {"minutes": 1.0, "iterations": 300}, None, {}, "budget.iterations=1200"),
        (300, {"minutes": 1.0, "iterations": None}, None, {"reached": "target.psnr"}, "target.psnr=null"),
    ],
)
def test_the_limit_that_ended_the_training_is_the_one_to_raise(tmp_path, steps, budget, share, done, try_):
    config = {"stage": {"coarse": {"share": 1.0, "steps_per_picture": share}}, "budget": budget}
    folder = run_with(tmp_path, steps=steps, config=config | {"target": {"psnr": 25.0}})
    (folder / "coarse" / "done.json").write_text(
        json.dumps({"steps": steps, "seconds": 50.0, "target": done})
    )
    first = diagnosed(folder, fit={"images": 50}).findings[0]
    assert (first.kind, first.try_) == ("training", try_)  # after fewer than ten steps an image, four times


def test_of_very_many_steps_nothing_stands_out(tmp_path):
    folder = run_with(tmp_path, steps=130_000 * 50, curve=None)
    assert diagnosed(folder, fit={"images": 50}).findings == []


def test_a_share_of_draws_stays_a_share():
    config = {"model": {"name": "forward"}, "stage": {"fine": {"curriculum": {"ends_share": 0.9}}}}
    assert advice("ends", config)[0] == "stage.fine.curriculum.ends_share=1.0"
    config["stage"]["fine"]["curriculum"]["ends_share"] = 1.0
    assert advice("ends", config)[0] == "model=particles"


def test_a_few_views_say_nothing_of_groups(tmp_path):
    folder = told_run(tmp_path, views=0)
    write_views(folder, {f"r_{i}": (i / 2, 10.0 * (i + 1)) for i in range(3)})
    diagnosis = diagnose(read_story(folder), {"r_0": {"sums": defect("moving", 0), "ratio": 1.0}})
    assert diagnosis.findings == []
    assert [view["name"] for view in diagnosis.worst] == ["r_0", "r_1", "r_2"]
    assert diagnose(read_story(told_run(tmp_path, views=0, seed=1))) is None


def value_at(config, path):
    for name in path.split("."):
        config = config[name]
    return config


MODELS = [path.stem for path in (CONF / "model").glob("*.yaml") if path.stem != "options"]
FAST = ("forward", "fast"), ("particles", "fast")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "preset"),
    [
        pytest.param(model, preset, marks=[] if (model, preset) in FAST else pytest.mark.slow)
        for model in MODELS
        for preset in ("fast", "demo")
    ],
)
def test_every_key_to_try_composes_for_its_model_and_changes_something(model, preset):
    words = "data.scene=x", f"model={model}", f"preset={preset}"
    config = OmegaConf.to_container(composed(*words), resolve=True)
    tried = {advice(kind, config, steps)[0] for kind in KEYS for steps in (1.0, 100.0)}
    others = {word for word in tried if word.startswith("model=")}
    assert others <= {"model=particles", "model=particles model/exposure=cosines"}
    by_key = {word.split("=")[0]: word for word in sorted(tried - others)}
    assert len(by_key) >= 2  # the minutes, and something of its own
    if others:
        composed(words[0], words[2], *max(others, key=len).split())
    changed = OmegaConf.to_container(composed(*words, *by_key.values()), resolve=True)
    for key in by_key:
        if key == "preset":
            assert changed["preset"]["name"] != config["preset"]["name"]
        else:
            path = key.lstrip("+").replace("/", ".")
            assert value_at(changed, path) != value_at(config, path), key


@pytest.mark.slow
def test_a_limit_of_steps_composes():
    words = "experiment=multicam", "data.scene=x", "model=particles"
    config = OmegaConf.to_container(composed(*words), resolve=True)
    limit = "stage.fine.steps_per_picture"
    typed, _ = advice("training", config, 100.0, limit)
    assert value_at(composed(*words, typed), limit) == 2 * value_at(config, limit) == 2600


def test_keys_follow_the_value_that_the_run_has():
    config = {"model": {"name": "particles", "motion": None}, "stage": {"fine": {"knots": 2.2}}}
    config |= {"data": {"train_views": 16, "held_out": 0, "canonical": None}, "budget": {"minutes": 0.5}}
    assert advice("moving", config)[0] == "model/motion=spline"
    config["model"]["motion"] = "spline"
    assert advice("moving", config)[0] == "stage.fine.knots=4.4"
    assert advice("far", config)[0] == "++data.train_views=null"
    assert advice("ends", config)[0] == "data.canonical=middle"
    assert [advice("training", config, steps)[0] for steps in (4.0, 40.0)] == [
        "budget.minutes=2.0",
        "budget.minutes=1.0",
    ]
