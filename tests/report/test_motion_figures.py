"""The paper's figures of motion and canonical shape, from hand-made run folders."""

import csv
import json

import imageio.v3 as iio
import numpy as np
import pytest

from forewarp.report.motion_figures import (
    FILE,
    ROW,
    TRUTH,
    Flows,
    arrays_of,
    best_compared,
    common_times,
    draw_canonical,
    draw_trajectories,
    sections_of,
    shape_table,
    variation_at,
)
from forewarp.report.paper import write_paper
from forewarp.report.results import Runs, read_runs
from tests.support.runs_on_disk import write_run

TIMES = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
TRUE = np.array([0.0, 2.0, np.nan, 0.0, 2.0])  # at the times that are known: up 2, down 2, up 2
GONE = np.array([np.nan, 1.0, 1.0, np.nan, 1.0])


def stored(**changes):
    """What evaluation stores of a run, of a square picture of 12 pixels and a path from corner to corner."""
    rgb = np.full((2, 12, 12, 3), 255, np.uint8)
    rgb[:, 4:8, 4:8] = 90
    depth = np.where(rgb[..., 0] < 255, 3.0, 0.0).astype(np.float32)
    paths = np.stack([np.linspace((1, 1), (11, 11), 4), np.linspace((1, 11), (11, 1), 4)])
    arrays = {"times": TIMES, "place": np.zeros(3, np.float32), "point": np.ones(3, np.float32)}
    arrays |= {"true_backward": TRUE, "true_forward": np.linspace(0, 2, 5)}
    arrays |= {"shots": rgb, "shot_times": TIMES[:2], "marks": np.full((2, 2, 2), 6.0)}
    arrays |= {"canonical_rgb": rgb, "canonical_depth": depth, "true_rgb": rgb, "true_depth": depth}
    return {
        n: a for n, a in (arrays | {"paths": paths, "true_paths": paths} | changes).items() if a is not None
    }


def motion_run(root, method, seed=0, arrays=None, scene="vehicle", **metrics):
    """A run's folder with its arrays."""
    config = {"model": {"name": method}, "variant": None}
    made = write_run(root, method, seed, scene=scene, curve=None, config=config, metrics=metrics)
    if arrays is not None:
        np.savez(made / FILE, **arrays)
    return made


def runs_of(root):
    return read_runs(root)[0]


def test_all_curves_are_compared_at_the_times_that_all_know():
    late = np.array([0.0, 1.0, 3.0, 2.0, np.nan])
    assert common_times(TRUE, [np.arange(5.0)]).tolist() == [True, True, False, True, True]
    # One that knows three of the four times is not waited for.
    assert common_times(TRUE, [late, GONE]).tolist() == [True, True, False, True, True]
    assert variation_at(TRUE, np.isfinite(TRUE)) == 3  # 6 in all, over a range of 2
    assert variation_at(late, np.isfinite(TRUE)) is None


def test_the_table_has_the_truth_and_each_method_over_its_seeds(tmp_path):
    medians = {"true_backward": 1.5, "true_forward": 1.0, "backward": 1.25, "forward": 1.0}
    curves = {
        0: [0.0, 1.0, 9.0, 0.5, 1.0],
        1: [0.0, 2.0, 9.0, 3.0, 4.0],
    }  # 2 / 1 and 4 / 4, without the third
    for seed, curve in curves.items():
        arrays = stored(forward=np.linspace(0, 1, 5), backward=np.array(curve))
        motion_run(tmp_path, "forward", seed, arrays, flow_variation=medians)
    motion_run(tmp_path, "backward", 0, stored(backward=GONE, forward=TIMES))
    motion_run(tmp_path, "tineuvox_s", 0, stored())
    motion_run(tmp_path, "nerf", 0)
    lines = Flows(runs_of(tmp_path)).lines("vehicle")
    assert [line[1] for line in lines] == [TRUTH, "forward", "backward"]
    assert lines[0][2:7] == [3, 1, 1.5, 1.0, 4]
    assert [estimate.mean for estimate in lines[1][2:6]] == pytest.approx([1.5, 1, 1.25, 1])
    assert (lines[1][7], lines[1][8].mean) == (2, 50)
    assert lines[2][2] is None
    assert lines[2][3].mean == 1


def test_runs_at_another_place_are_left_out(tmp_path):
    motion_run(tmp_path, "forward", 0, stored(forward=TIMES))
    motion_run(tmp_path, "backward", 0, stored(place=np.ones(3, np.float32)))
    assert [row["method"] for row, _ in Flows(runs_of(tmp_path).where(method=("forward",))).runs] == [
        "forward"
    ]
    assert len(Flows(runs_of(tmp_path)).runs) == 1


@pytest.mark.slow
def test_every_figure_is_drawn_and_its_table_written(tmp_path):
    for method in ("forward", "backward", "dnerf", "tineuvox_s"):
        follows = method in ("forward", "backward")
        arrays = stored(backward=TRUE, forward=TIMES, paths=None if not follows else stored()["paths"])
        motion_run(
            tmp_path / "runs",
            method,
            0,
            arrays,
            canonical_shape=dict.fromkeys(("chamfer", "accuracy", "completeness"), 0.0123),
        )
    sections, files = sections_of(runs_of(tmp_path / "runs"), tmp_path)
    names = [
        "flow-vehicle.png",
        "flow.csv",
        "trajectories-vehicle.png",
        "canonical.csv",
        "canonical-vehicle.png",
    ]
    assert [file.name for file in files] == [f"paper-{name}" for name in names]
    titles = ["Forward and backward flow", "Trajectories: vehicle", "Canonical shape"]
    assert [section.title for section in sections] == titles
    for file in (file for file in files if file.suffix == ".png"):
        picture = iio.imread(file)
        assert min(picture.shape[:2]) > 200
        assert picture.std() > 5
    shapes = list(csv.DictReader(files[3].read_text().splitlines()))
    assert [(row["method"], row["chamfer"]) for row in shapes[:2]] == [
        ("forward", "0.0123"),
        ("dnerf", "0.0123"),
    ]
    rows = list(csv.DictReader(files[1].read_text().splitlines()))
    assert rows[0]["curves of"] == TRUTH
    assert float(rows[0]["backward flow at the place: variation"]) == 3
    assert {row["curves of"] for row in rows[1:]} == {"forward", "backward", "dnerf", "tineuvox_s"}


@pytest.mark.slow
def test_the_papers_page_shows_them(tmp_path):
    for method in ("forward", "backward"):
        motion_run(tmp_path / "runs", method, 0, stored(backward=TRUE, forward=TIMES))
    files = write_paper(tmp_path / "runs", tmp_path / "out")
    assert all(file.is_file() for file in files)
    assert {"paper-flow.csv", "paper-flow-vehicle.png"} <= {file.name for file in files}
    page = (tmp_path / "out" / "paper.md").read_text()
    for name in ("flow", "trajectories", "canonical"):
        assert f"](paper-{name}-vehicle.png)" in page


@pytest.mark.slow
def test_a_scene_without_true_motion_has_pictures_of_its_own(tmp_path):
    left = dict.fromkeys(
        ["times", "place", "true_backward", "true_forward", "shots", "true_paths", "true_depth"]
    )
    for method in ("forward", "dnerf"):
        motion_run(
            tmp_path / "runs",
            method,
            0,
            stored(**left, paths=stored()["paths"] if method == "forward" else None),
        )
    sections, _ = sections_of(runs_of(tmp_path / "runs"), tmp_path)
    assert [section.title for section in sections] == ["Trajectories: vehicle", "Canonical shape"]


def test_runs_of_an_earlier_version_have_no_figures(tmp_path):
    motion_run(tmp_path, "forward")
    assert sections_of(runs_of(tmp_path), tmp_path) == ([], [])
    row = runs_of(tmp_path)[0]
    assert draw_trajectories(tmp_path / "a.png", {"forward": row}, "vehicle") is None
    assert draw_canonical(tmp_path / "a.png", {"forward": row}, "vehicle") is None


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 cut off"])
def test_what_is_no_archive_is_refused_in_one_line(tmp_path, content):
    folder = motion_run(tmp_path, "forward")
    (folder / FILE).write_bytes(content)
    with pytest.raises(
        ValueError, match=rf"{FILE}: expected NumPy's arrays, but got .*forewarp-evaluate run="
    ) as error:
        arrays_of(Runs(runs_of(tmp_path))[0])
    assert "\n" not in str(error.value)


def test_runs_under_other_conditions_are_no_seeds_of_a_row(tmp_path):
    for held_out, error in ((0, 0.1), (8, 0.3)):
        shape = dict.fromkeys(("chamfer", "accuracy", "completeness"), error)
        made = motion_run(tmp_path / str(held_out), "forward", 0, canonical_shape=shape)
        numbers = json.loads((made / "metrics.json").read_text())
        numbers["protocol"]["held_out"] = held_out
        (made / "metrics.json").write_text(json.dumps(numbers))
    runs = runs_of(tmp_path)
    rows = shape_table({"vehicle": runs}).rows
    assert [(row[1], row[2].mean, row[2].count) for row in rows] == [
        ("forward", 0.1, 1),
        ("forward, 8 views held out", 0.3, 1),
    ]


def test_runs_that_are_drawn_together_share_all_conditions():
    shared = dict.fromkeys((*ROW, "measured")) | {"seed": 0}
    runs = [
        shared | {"method": m, "held_out": n} for m, n in (("a", 8), ("b", 8), ("a", 0), ("c", 0), ("d", 0))
    ]
    assert {m: row["held_out"] for m, row in best_compared(Runs(runs)).items()} == {"a": 0, "c": 0, "d": 0}
    twice = Runs(shared | {"method": "a", "folder": name} for name in "xy")
    assert best_compared(twice)["a"]["folder"] == "x"
