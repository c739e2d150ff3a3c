import imageio.v3 as iio
import pytest

from forewarp.report.curve import Published
from forewarp.report.minutes import write_minutes
from tests.support.runs_on_disk import rows_of, write_run

DNERF = {"protocol": {"dataset": "dnerf"}}
OTHER = Published("Other", 600.0, 31.0, "RTX 1", "its paper", "dnerf")


def measured(runs, method, minutes, *found, scene="ball"):
    for seed, psnr in enumerate(found):
        write_run(
            runs / method, seed=seed, psnr=psnr, minutes=minutes, scene=scene, metrics=DNERF,
            config={"model": {"name": method}},
        )  # fmt: skip


def page_of(tmp_path, **more):
    files = {path.name: path for path in write_minutes(tmp_path / "runs", tmp_path / "out", **more)}
    return files.get("accuracy-time.md"), files


def test_methods_are_compared_over_lengths(tmp_path):
    runs = tmp_path / "runs"
    measured(runs, "particles", 1 / 30, 20.0, 22.0)
    measured(runs, "particles", 1.0, 30.0)
    measured(runs, "particles", 5.0, 33.0)
    measured(runs, "forward", 1.0, 24.0)
    measured(runs, "forward", 5.0, 29.5)
    page, files = page_of(tmp_path, published=[OTHER])
    text = page.read_text()
    head, own = rows_of(text, "method")[0], rows_of(text, "`particles`")[0]
    assert head == ["method", "2 s", "1 min", "5 min", "seeds", "passed by `particles` after"]
    assert own == ["`particles`", "21.00 ± 1.41", "30.00", "33.00", "2, 1, 1", ""]
    assert rows_of(text, "`forward`")[0] == ["`forward`", "", "24.00", "29.50", "1, 1", "1 min"]
    assert "* Other: 31 dB after 600 s of an RTX 1 (its paper)" in text
    assert iio.imread(files["accuracy-time-ball.png"]).ndim == 3
    assert "accuracy-time-ball.png" in text


@pytest.mark.parametrize(
    "lengths", [{"particles": (1.0, 5.0)}, {"particles": (1.0, 5.0), "forward": (5.0,)}, {"forward": (1.0,)}]
)
def test_one_method_or_one_length_is_no_comparison(tmp_path, lengths):
    for method, minutes in lengths.items():
        for one in minutes:
            measured(tmp_path / "runs", method, one, 30.0)
    assert page_of(tmp_path)[0] is None


def test_what_was_measured_before_counts(tmp_path):
    measured(tmp_path / "runs", "particles", 1.0, 30.0)
    measured(tmp_path / "runs", "particles", 5.0, 31.0)
    assert page_of(tmp_path)[0] is None
    measured(tmp_path / "later", "particles", 20.0, 32.0)
    measured(tmp_path / "later", "forward", 1.0, 25.0)
    measured(tmp_path / "later", "forward", 5.0, 32.5)
    written = write_minutes(tmp_path / "later", tmp_path / "out")
    text = next(path for path in written if path.name == "accuracy-time.md").read_text()
    assert rows_of(text, "`particles`")[0][1:4] == ["30.00", "31.00", "32.00"]
    assert rows_of(text, "`forward`")[0][-1] == ""  # nothing is above it


def test_others_stand_beside_scenes_of_their_dataset_alone(tmp_path, monkeypatch):
    drawn = {}
    monkeypatch.setattr(
        "forewarp.report.by_method._draw",
        lambda groups, beside, title, path: drawn.update({title: [other.name for other in beside]}),
    )
    for scene in ("ball", "cube"):
        for method in ("particles", "forward"):
            measured(tmp_path / "runs", method, 1.0, 30.0, scene=scene)
            measured(tmp_path / "runs", method, 5.0, 30.0, scene=scene)
    toy = Published("Toy", 60.0, 20.0, "a CPU", "a page", "toy")
    page_of(tmp_path, published=[OTHER, toy])
    assert drawn == {"ball": ["Other"], "cube": ["Other"]}
