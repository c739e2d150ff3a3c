import json

import numpy as np
import pytest
import torch
from PIL import Image

from forewarp.data.files import SceneError
from forewarp.drawing.images import write_png
from forewarp.evaluation.evaluate import evaluate
from forewarp.metrics.registry import ImageSuite
from forewarp.runs.elsewhere import check_renders, files_of, matched, measure_renders, read_render
from tests.support.tiny_scene import ball_data, make_run, stage


@pytest.fixture(scope="module")
def data():
    return ball_data()


@pytest.fixture
def truth(data, tmp_path):
    """A folder with an image nearly like the truth of each test view, numbered."""
    for i, target in enumerate(data.targets("test")):
        write_png(tmp_path / "truth" / f"{i}.png", 0.97 * target.rgb)
    return tmp_path / "truth"


@pytest.mark.slow
def test_images_of_a_run_have_its_scores_to_the_last_digit(tmp_path):
    run = make_run(tmp_path / "run", [stage(iterations=2)])
    own = evaluate(run.fit(), run.datamodule, tmp_path / "own", ImageSuite())
    files = matched(run.datamodule.targets("test"), tmp_path / "own" / "images")
    there = tmp_path / "there"
    metrics = measure_renders(run.datamodule, files, there, ImageSuite(), protocol={}, minutes=2.0, sheets=1)
    assert metrics["test"] == own["test"]
    assert metrics["seconds"] == {"train": 120.0}
    assert json.loads((there / "metrics.json").read_text()) == metrics
    assert [path.name for path in (there / "images" / "sheets").iterdir()] == ["t_0.png"]


def test_images_are_found_by_name_or_by_number(tmp_path):
    for name in ("2", "10", "1"):
        write_png(tmp_path / f"{name}.png", torch.zeros(2, 2, 3))
    assert [file.stem for file in files_of(tmp_path, ["test/a", "test/b", "test/c"])] == ["1", "2", "10"]
    assert [file.stem for file in files_of(tmp_path, ["test/10", "test/2"])] == ["10", "2"]
    with pytest.raises(SceneError, match="none in .*/3.png"):
        files_of(tmp_path, ["test/2", "test/3"])
    with pytest.raises(SceneError, match="expected 2 PNG images, .* called a.png or numbered .* but got 3"):
        files_of(tmp_path, ["a", "b"])
    with pytest.raises(SceneError, match="renders: expected a folder"):
        files_of(tmp_path / "none", ["a"])


def test_another_order_is_refused(data, truth):
    targets, files = data.targets("test"), files_of(truth, ["a", "b", "c"])
    check_renders(files, targets)
    with pytest.raises(SceneError, match="expected 2.png to show the test view t_0, but got an image of t_2"):
        check_renders(files[::-1], targets)


@pytest.mark.parametrize(("kind", "split"), [("test", "test"), ("training", "train")])
def test_the_images_of_the_scene_itself_are_refused(data, tmp_path, kind, split):
    targets = data.targets("test")
    names = [target.frame.name for target in data.targets(split)][: len(targets)]
    files = [
        write_png(tmp_path / "gt" / f"{name}.png", target.rgb)
        for name, target in zip(names, data.targets(split))
    ]
    (tmp_path / "renders").mkdir()
    got = rf"got the {kind} images themselves \({len(files)} of {len(files)}\); set renders=.*/renders"
    with pytest.raises(SceneError, match=f"expected images of a method, but {got}"):
        check_renders(files, targets, data.targets("train"))


def test_images_that_are_all_alike_are_of_no_other_order(data, tmp_path):
    mean = torch.stack([target.rgb for target in data.targets("test")]).mean(0)
    check_renders([write_png(tmp_path / f"{i}.png", mean) for i in range(3)], data.targets("test"))


def test_the_other_background_is_refused_and_alpha_lies_over_the_right_one(data, tmp_path):
    targets = data.targets("test")
    for i, target in enumerate(targets):
        rgba = torch.cat([target.rgb, target.foreground[..., None].float()], -1)
        Image.fromarray((rgba * 255).round().byte().numpy()).save(tmp_path / f"{i}.png")
    files = files_of(tmp_path, ["a", "b", "c"])
    check_renders(files, targets)  # on white, as the scene is measured
    image = read_render(files[0], targets[0])
    assert bool((image[~targets[0].foreground] == 1).all())
    for file in files:
        black = np.array(Image.open(file).convert("RGBA"))
        black[black[..., 3] == 0] = (0, 0, 0, 255)
        Image.fromarray(black).save(file)
    with pytest.raises(SceneError, match="expected images on white.*images on black.*eval_background=black"):
        check_renders(files, targets)


@pytest.mark.parametrize(
    ("save", "what"),
    [
        (lambda path: Image.new("RGB", (12, 12)).save(path, "PNG"), "24 x 24 pixels.*12 x 12"),
        (lambda path: Image.new("RGB", (24, 24)).save(path, "JPEG"), "a PNG of 8 bits.*JPEG"),
        (lambda path: Image.new("I;16", (24, 24)).save(path, "PNG"), "a PNG of 8 bits.*mode I"),
        (lambda path: path.write_text("no"), "a PNG image, but got another file"),
    ],
)
def test_other_images_are_refused(data, tmp_path, save, what):
    save(tmp_path / "a.png")
    with pytest.raises(SceneError, match=what):
        read_render(tmp_path / "a.png", data.targets("test")[0])
