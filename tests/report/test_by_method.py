import imageio.v3 as iio
import pytest

from forewarp.report.by_method import _seconds
from forewarp.report.curve import Published
from forewarp.report.minutes import write_minutes
from tests.support.runs_on_disk import rows_of, write_run

DNERF = {"protocol": {"dataset": "dnerf"}}
OTHER = Published("Other", 600.0, 31.0, "RTX 1", "its paper", "dnerf")


def measured(runs, method, minutes, *found, scene="ball", clock="wall", took=None):
    for seed, psnr in enumerate(found):
        clocks = {} if took is None else {"clocks": {clock: took}}
        protocol = {**DNERF["protocol"], "clock": clock}
        write_run(
            runs / method, seed=seed, psnr=psnr, minutes=minutes, scene=scene,
            metrics={"protocol": protocol, **clocks}, config={"model": {"name": method}},
        )  # fmt: skip


def page_of(tmp_path, **more):
    files = {path.name: path for path in write_minutes(tmp_path / "runs", tmp_path / "out", **more)}
    return files.get("accuracy-time.md"), files


def test_methods_are_compared_over_lengths(tmp_path):
    runs = tmp_path / "runs"
    measured(runs, "particles", 1 / 30, 20.0, 22.0)
    measured(runs, "particles", 1.0, 30.0)
    measured(runs, "particles", 5.0, 33.0)
    measured(runs, "forward", 1 / 30, 19.0)
    measured(runs, "forward", 1.0, 24.0)
    measured(runs, "forward", 5.0, 29.5)
    page, files = page_of(tmp_path, published=[OTHER])
    text = page.read_text()
    head, own = rows_of(text, "method")[0], rows_of(text, "`particles`")[0]
    assert head == ["method", "2 s", "1 min", "5 min", "seeds", "passed by `particles` after"]
    assert own == ["`particles`", "21.00 ± 1.41", "30.00", "33.00", "2, 1, 1", ""]
    assert rows_of(text, "`forward`")[0] == ["`forward`", "19.00", "24.00", "29.50", "1, 1, 1", "1 min"]
    assert "* Other: 31 dB after 600 s of an RTX 1 (dnerf; its paper)" in text
    assert iio.imread(files["accuracy-time-ball.png"]).ndim == 3
    assert "accuracy-time-ball.png" in text


@pytest.mark.parametrize(
    "lengths", [{"particles": (1.0, 5.0, 9.0)}, {"particles": (1.0, 5.0, 9.0), "forward": (1.0, 5.0)}]
)
def test_one_method_or_two_lengths_are_no_curves(tmp_path, lengths):
    for method, minutes in lengths.items():
        for one in minutes:
            measured(tmp_path / "runs", method, one, 30.0)
    assert page_of(tmp_path)[0] is None


def test_what_was_measured_before_counts(tmp_path):
    measured(tmp_path / "runs", "particles", 1.0, 30.0)
    measured(tmp_path / "runs", "particles", 5.0, 31.0)
    assert page_of(tmp_path)[0] is None
    measured(tmp_path / "later", "particles", 20.0, 32.0)
    for minutes, psnr in ((1.0, 25.0), (5.0, 32.5), (20.0, 32.2)):
        measured(tmp_path / "later", "forward", minutes, psnr)
    written = write_minutes(tmp_path / "later", tmp_path / "out")
    text = next(path for path in written if path.name == "accuracy-time.md").read_text()
    assert rows_of(text, "`particles`")[0][1:4] == ["30.00", "31.00", "32.00"]
    assert rows_of(text, "`forward`")[0][-1] == ""  # nothing is above it


def test_others_stand_beside_scenes_of_their_dataset_alone(tmp_path, monkeypatch):
    drawn = {}
    monkeypatch.setattr(
        "forewarp.report.by_method._draw",
        lambda groups, beside, title, *rest: drawn.update({title: [other.name for other in beside]}),
    )
    for scene in ("ball", "cube"):
        for method in ("particles", "forward"):
            for minutes in (1.0, 5.0, 20.0):
                measured(tmp_path / "runs", method, minutes, 30.0, scene=scene)
    toy = Published("Toy", 60.0, 20.0, "a CPU", "a page", "toy")
    page_of(tmp_path, published=[OTHER, toy])
    assert drawn == {"ball": ["Other"], "cube": ["Other"]}


def test_what_was_measured_otherwise_is_not_compared(tmp_path):
    for method, clock in (("particles", "processor"), ("forward", "wall")):
        for minutes in (0.5, 1.0, 5.0):
            measured(tmp_path / clock / "runs", method, minutes, 30.0, clock=clock)
    for clock in ("processor", "wall"):
        written = write_minutes(tmp_path / clock / "runs", tmp_path / "out")
        assert "accuracy-time.md" not in [path.name for path in written]
    for minutes in (0.5, 1.0, 5.0):  # now there are two of one clock
        measured(tmp_path / "more", "backward", minutes, 20.0, clock="wall")
    files = {path.name: path for path in write_minutes(tmp_path / "more", tmp_path / "out", [OTHER])}
    text = files["accuracy-time.md"].read_text()
    assert "## ball, wall clock\n" in text
    assert "](accuracy-time-ball-wall-clock.png)" in text
    assert not rows_of(text, "`particles`")
    assert "* Other: " in text


def test_runs_that_ended_early_or_late_stand_where_they_ended(tmp_path, monkeypatch):
    drawn = {}
    monkeypatch.setattr("forewarp.report.by_method._draw", lambda groups, *rest: drawn.update(groups))
    for method in ("particles", "forward"):
        measured(tmp_path / "runs", method, 0.5, 29.0, took=50.0 if method == "forward" else 30.0)
        measured(tmp_path / "runs", method, 1.0, 30.0, took=60.0)
        measured(tmp_path / "runs", method, 20.0, 31.0, took=300.0 if method == "particles" else 1200.0)
    text = page_of(tmp_path, published=[Published("Toy", 60.0, 20.0, "a CPU", "a page", "toy")])[
        0
    ].read_text()
    assert rows_of(text, "`particles`")[0][2:4] == ["30.00", "31.00 (ended after 5 min)"]
    assert rows_of(text, "`forward`")[0][1:4] == ["29.00 (took 50 s)", "30.00", "31.00"]
    assert [_seconds(group) for group in drawn["particles"]] == [30.0, 60.0, 300.0]
    assert "Toy" not in text  # of no scene of the page
    pages = {path.name: path.read_text() for path in (tmp_path / "out").glob("*.md")}
    assert "Some runs ended by their steps" in pages["particles.md"]
    assert "20 (ended after 5 min)" in pages["particles.md"]
    assert "Some runs ended" not in pages["forward.md"]
