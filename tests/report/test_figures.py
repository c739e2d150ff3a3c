import sys

import imageio.v3 as iio
import numpy as np
import pytest

from forewarp.report import figures
from forewarp.report.benchmark import Published
from forewarp.report.figures import (
    GAP,
    MARGIN,
    by_side,
    draw_details,
    draw_scene,
    pareto_front,
    subject,
    telling,
    thirds,
)
from forewarp.report.results import read_runs
from forewarp.report.settings import SAME
from tests.support.runs_on_disk import write_run, write_views


def test_the_front_is_what_nothing_beats_in_both():
    assert pareto_front([(1, 20), (2, 19), (2, 22), (3, 22), (4, 30), (4, 29)]) == [0, 2, 4]


@pytest.mark.slow
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


def test_the_window_is_where_runs_differ_most_or_else_where_the_error_is():
    errors = np.zeros((2, 4, 5))
    errors[:, :2, :2] = 1.0  # both are as wrong
    errors[1, 2, 3], errors[1, 3, 4], errors[1, 3, 0] = 0.8, 0.2, 0.5
    assert telling(errors, (2, 2)) == (slice(2, 4), slice(3, 5))
    assert telling(errors[:1], (2, 2)) == (slice(0, 2), slice(0, 2))
    assert telling(errors[[0, 0]], (2, 2)) == (slice(0, 2), slice(0, 2))
    assert telling(errors, (9, 9)) == (slice(0, 4), slice(0, 5))


def sheet_of(*pictures):
    white = np.full((pictures[0].shape[0], GAP, 3), 255, np.uint8)
    return np.concatenate([part for picture in pictures for part in (white, picture)][1:], 1)


def test_details_stand_below_each_run_and_are_boxed_on_the_truth(tmp_path, monkeypatch):
    truth = np.full((40, 60, 3), 90, np.uint8)
    truth[::2] += 20  # not of one colour: nothing is cut away
    drawn, true, deep = truth.copy(), np.full_like(truth, 10), np.full_like(truth, 200)
    drawn[20:28, 30:42] = 250  # as large as what is enlarged
    for name, picture, psnr in (("good", truth, 40.0), ("bad", drawn, 20.5)):
        folder = write_run(tmp_path, name)
        views = {"t/late": (0.9, 1.0), "t/mid": (0.4, psnr)}
        write_views(folder, views, sheet_of(truth, picture, truth))
        for view in views:
            file = folder / "images" / "depth" / f"{view}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            iio.imwrite(file, sheet_of(true, deep, deep))
    runs, seen = {row["variant"]: row for row in read_runs(tmp_path)[0]}, []
    monkeypatch.setattr(figures, "save", lambda figure, path, colors: seen.append(figure.axes))
    draw_details(tmp_path / "x.png", {name: runs[name] for name in ("good", "bad")}, depth=True)
    (axes,) = seen
    assert [axis.get_title() for axis in axes] == ["truth", "good", "bad"]
    assert [axis.get_xlabel() for axis in axes] == ["t/mid\ntime 0.40", "40.00 dB", "20.50 dB"]
    tiles = [np.asarray(axis.images[0].get_array()) for axis in axes]
    detail = slice(40 + GAP, 40 + GAP + 40)  # 8 x 12 pixels, 60 wide
    assert np.allclose(tiles[2][detail], 250 / 255)
    assert np.allclose(tiles[1][:40], truth / 255)
    red = (tiles[0][:40] != tiles[1][:40]).any(-1)
    box = np.zeros((40, 60), bool)
    box[20:28, 30:42] = True
    box[22:26, 32:40] = False
    assert np.array_equal(red, box)
    depth = [tile[detail.stop + GAP :] for tile in tiles]
    assert [np.unique(part * 255).round().tolist() for part in depth] == [[10], [200], [200]]


def test_runs_without_a_shared_sheet_have_no_details(tmp_path):
    picture = np.zeros((6, 6, 3), np.uint8)
    for name in "ab":
        write_views(write_run(tmp_path, name), {name: (0.5, 30.0)}, sheet_of(picture, picture, picture))
    runs = {row["variant"]: row for row in read_runs(tmp_path)[0]}
    assert draw_details(tmp_path / "x.png", runs) is None
    assert draw_details(tmp_path / "x.png", {}) is None


def test_a_network_is_drawn_by_levels(tmp_path, monkeypatch):
    of = [("input", [], 3, 8, 0), ("conv3d", [0], 4, 8, 9), ("relu", [1], 4, 8, 0)]
    of += [("max_pool3d", [2], 4, 4, 0), ("interpolate", [3], 4, 8, 0), ("cat", [4, 2], 8, 8, 0)]
    names = "does", "from", "shape", "parameters"
    steps = [dict(zip(names, (does, source, [c, n, n, n], count))) for does, source, c, n, count in of]
    steps[1]["kernel"] = [3, 3, 3]
    seen = []
    monkeypatch.setattr(figures, "save", lambda figure, path, colors: seen.append(figure))
    figures.draw_network(tmp_path / "x.png", steps)
    (axis,) = seen[0].axes
    boxes = [(patch.get_y() + 0.3, patch.get_width()) for patch in axis.patches]
    assert [round(level) for level, _ in boxes] == [0, 0, -1, 0, 0]
    assert boxes[4][1] - 0.1 == pytest.approx(2 * (boxes[3][1] - 0.1))  # twice the channels
    words = [text.get_text() for text in axis.texts if text.get_text()]
    assert words == ["3", "4", "4", "4", "8", "N³", "(N/2)³"]
    assert len([text for text in axis.texts if not text.get_text()]) == 5  # arrows, a skip among them
    legend = [text.get_text() for text in seen[0].legends[0].get_texts()]
    assert legend[:3] == ["convolution 3×3×3, ReLU", "max pooling", "interpolation"]


def test_sizes_under_other_conditions_are_other_lines():
    def run(side, held_out, psnr):
        config = {"stage": {"fine": {"num_voxels": [[0, side**3]]}}}
        about = dict.fromkeys((*SAME, "setting")) | {"scene": "s", "method": "m", "preset": "p", "seed": 0}
        return about | {
            "held_out": held_out,
            "psnr": psnr,
            "config": config,
            "ablation": f"resolution {side}",
            "setting": f"stage.fine.num_voxels={side}",  # as typed by the sweep
            "words": {"stage.fine.num_voxels": f"num_voxels={side}"},
        }

    lines = by_side(run(side, held_out, side + held_out) for side in (16, 32) for held_out in (4, 8))
    psnr = {label: [of["psnr"] for own in sides.values() for of in own] for label, sides in lines.items()}
    assert psnr == {"s, m, p, 4 views held out": [20, 36], "s, m, p, 8 views held out": [24, 40]}
