import sys

import imageio.v3 as iio
import numpy as np

from forewarp.report import figures
from forewarp.report.benchmark import Published
from forewarp.report.figures import MARGIN, draw_scene, pareto_front, subject, thirds
from forewarp.report.results import read_runs
from tests.support.runs_on_disk import write_run


def test_the_front_is_what_nothing_beats_in_both():
    assert pareto_front([(1, 20), (2, 19), (2, 22), (3, 22), (4, 30), (4, 29)]) == [0, 2, 4]


def test_a_run_is_drawn_with_its_flow_error_below(tmp_path):
    heights = []
    for variant, epe in (("flat", None), ("both", 0.5)):
        figures.draw_own(folder := write_run(tmp_path, variant, epe=epe))
        heights.append(iio.imread(folder / "accuracy_time.png").shape[0])
    assert heights[0] < heights[1]
    assert not list(tmp_path.rglob("*.part"))


def test_a_scene_names_those_on_the_front_and_the_hardware_of_others(tmp_path, monkeypatch):
    write_run(tmp_path)
    write_run(tmp_path, "slow", curve=((30, 20.0), (60, 24.0)))
    write_run(tmp_path, "good", curve=((30, 20.0), (60, 28.0)))
    seen = []
    monkeypatch.setattr(figures, "save", lambda figure, path: seen.append(figure.axes[0]))
    other = Published("other", 100.0, 32.0, "a GPU", "its paper", "dnerf")
    draw_scene(tmp_path / "x.png", read_runs(tmp_path)[0].by("variant", "minutes"), "ball", [other])
    legend = [text.get_text() for text in seen[0].get_legend().get_texts()]
    assert legend == ["base, 1 min", "good, 1 min", "Pareto front", "other (published, a GPU)"]
    assert seen[0].get_xscale() == "log"


def test_absent_matplotlib_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    figures.draw_own(write_run(tmp_path))
    told = "without accuracy_time.png: expected matplotlib for plots; install forewarp[plots]"
    assert told in capsys.readouterr().out


def test_a_picture_is_cut_to_its_subject():
    picture = np.ones((100, 80, 3))
    assert subject(picture) == (slice(0, 100), slice(0, 80))
    picture[50:60, 75] = 0
    assert subject(picture) == (slice(50 - MARGIN, 60 + MARGIN), slice(75 - MARGIN, 80))


def test_a_sheet_falls_into_its_parts():
    sheet = np.concatenate([np.full((2, 3, 1), i) for i in (0, 1, 2)], 1)
    wide = np.insert(sheet, [3] * 4 + [6] * 4, 9, axis=1)
    assert [part.tolist() for part in thirds(wide)] == [[[[i]] * 3] * 2 for i in (0, 1, 2)]
