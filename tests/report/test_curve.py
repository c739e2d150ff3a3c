import sys

import imageio.v3 as iio
import pytest

from forewarp.report.collect import Point, collect, grouped
from forewarp.report.curve import Published, draw_run, draw_scene, pareto_front, read_published, seconds_to
from tests.support.runs_on_disk import write_run


def curve(*pairs):
    return [Point(seconds, psnr, 0) for seconds, psnr in pairs]


@pytest.mark.parametrize(
    ("pairs", "seconds"),
    [
        ([(1, 24), (2, 25), (3, 26)], 2),
        ([(1, 25), (2, 24), (3, 25), (4, 25)], 3),  # once is chance
        ([(1, 24), (2, 25)], None),  # nothing follows that would confirm it
        ([(1, 25)], None),
        ([], None),
    ],
)
def test_a_target_is_reached_twice_in_a_row(pairs, seconds):
    assert seconds_to(curve(*pairs), 25) == seconds


def test_the_front_is_what_nothing_beats_in_both():
    points = [(1, 20), (2, 19), (2, 22), (3, 22), (4, 30), (4, 29)]
    front = pareto_front(points)
    assert front == [0, 2, 4]


def test_a_run_is_drawn_with_its_flow_error_below(tmp_path):
    flat = draw_run(tmp_path / "a" / "flat.png", curve((1, 20), (2, 21)), "run")
    both = draw_run(tmp_path / "both.png", [Point(1, 20, 0, 0.5), Point(2, 21, 0, 0.4)], "run")
    assert iio.imread(both).shape[0] > iio.imread(flat).shape[0]
    assert not list(tmp_path.rglob("*.part"))


def legend_of(monkeypatch, path, *arguments):
    seen = []

    def save(figure, path):
        seen.extend(text.get_text() for text in figure.axes[0].get_legend().get_texts())
        assert figure.axes[0].get_xscale() == "log"
        return path

    monkeypatch.setattr("forewarp.report.curve._save", save)
    draw_scene(path, *arguments)
    return seen


def test_a_scene_names_those_on_the_front_and_the_hardware_of_others(tmp_path, monkeypatch):
    write_run(tmp_path)
    write_run(tmp_path, "slow", curve=((30, 20.0), (60, 24.0)))
    write_run(tmp_path, "good", curve=((30, 20.0), (60, 28.0)))
    groups = grouped(collect(tmp_path)[0])
    other = Published("other", 100.0, 32.0, "a GPU", "its paper", "dnerf")
    legend = legend_of(monkeypatch, tmp_path / "scene.png", groups, "ball", [other])
    assert legend == ["base, 1 min", "good, 1 min", "Pareto front", "other (published, a GPU)"]


def test_published_points_are_read_and_checked(tmp_path):
    path = tmp_path / "published.yaml"
    path.write_text("- {name: a, seconds: 60, psnr: 30.5, hardware: g, source: s, dataset: dnerf}\n")
    assert read_published(path) == [Published("a", 60, 30.5, "g", "s", "dnerf")]
    for text in ("- {name: a}\n", "name: a\n"):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"published.yaml: \[0\]: expected the keys name, seconds"):
            read_published(path)
    path.write_text("[")
    with pytest.raises(ValueError, match="published.yaml: expected YAML, but got"):
        read_published(path)


def test_absent_matplotlib_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"install forewarp\[plots\]"):
        draw_run(tmp_path / "x.png", curve((1, 20)), "run")
