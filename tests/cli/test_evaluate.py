import json

import pytest

from forewarp.report.results import read_runs

ELSEWHERE = "name=SC-GS (authors' code)", "data=dnerf", "data.scene=vehicle"


@pytest.mark.slow
def test_images_from_elsewhere_are_a_row_of_every_report(fitted, ok, refused, in_tmp):
    scenes = f"data.root={fitted.parent / 'scenes'}"
    done = ok("evaluate", f"renders={fitted / 'images'}", *ELSEWHERE, scenes, "minutes=20", "device=RTX 3090")
    folder = in_tmp / "runs" / "vehicle" / "SC-GS-authors-code-seed0"
    assert f"numbers  {folder.relative_to(in_tmp) / 'metrics.json'}" in done.out
    own, there = (json.loads((run / "metrics.json").read_text()) for run in (fitted, folder))
    kinds = {kind: scores["psnr"] for kind, scores in own["test"].items()}
    assert {kind: scores["psnr"] for kind, scores in there["test"].items()} == kinds
    assert json.loads((folder / "data.json").read_text()) == json.loads((fitted / "data.json").read_text())
    (row,), left_out = read_runs(in_tmp / "runs")
    assert (row["method"], row["preset"], row["minutes"]) == (ELSEWHERE[0][5:], "rendered elsewhere", 20)
    assert (row["variant"], row["device"], left_out) == (
        "SC-GS (authors' code)-rendered elsewhere",
        "RTX 3090",
        [],
    )
    assert "images rendered elsewhere" in row["protocol"]
    assert ELSEWHERE[0][5:] in ok("report", "kind=table", "runs=runs").out
    assert ELSEWHERE[0][5:] in ok("report", "kind=compare", f"runs=[{fitted},{folder}]").out
    ok("report", "kind=run", f"run={folder}", "render=false")
    assert "expected a run of forewarp" in refused("render", f"run={folder}")
    other = refused(
        "evaluate", f"renders={fitted / 'images'}", "name=other", *ELSEWHERE[1:], scenes, f"run={folder}"
    )
    assert "expected an empty folder, or images of other" in other


@pytest.mark.slow
def test_a_folder_of_other_files_is_not_written_into(fitted, refused):
    scene = "data=dnerf", f"data.root={fitted.parent / 'scenes'}", "data.scene=vehicle"
    words = f"renders={fitted / 'images'}", "name=a", *scene, f"run={fitted.parent / 'scenes' / 'vehicle'}"
    assert "expected an empty folder, or images of a" in refused("evaluate", *words)


@pytest.mark.slow
def test_what_images_from_elsewhere_lack_is_named(fitted, refused):
    assert refused("evaluate", f"renders={fitted / 'images'}").startswith("name: expected what tables call")
    assert refused("evaluate", "renders=here", "name=a").startswith("data: expected the scene")
    scene = "data=dnerf", f"data.root={fitted.parent / 'scenes'}", "data.scene=vehicle"
    assert "reduce" in refused("evaluate", "renders=here", "name=a", *scene, "reduce=2")
    assert "minutes" in refused("evaluate", "renders=here", "name=a", *scene, "minutes=-1")
    assert refused("evaluate", "renders=here", "name=a", *scene).startswith("renders: expected a folder")
