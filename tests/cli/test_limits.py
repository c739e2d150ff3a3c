import math

import pytest

from forewarp.cli.limits import COLUMNS, by_time, limits_of, main
from forewarp.scene.frame import spread
from forewarp.synth.scenes import synthesize

STEPS = ["budget.iterations=4", "stage.fine.num_voxels=[[0,4000]]", "stage.coarse.num_voxels=[[0,4000]]"]
QUICK = ["preset=demo", "trainer=cpu", "data.rays=64", "logger=none", "callbacks.pictures=null"]


@pytest.fixture
def run(forewarp, tmp_path):
    """The folder of a run that saw little."""
    synthesize(
        tmp_path / "vehicle", size=32, frames=6, test_views=(3, 0, 0), val_views=0, samples_per_pixel=1
    )
    where = ["data=dnerf", f"data.root={tmp_path}", "data.scene=vehicle", f"run={tmp_path / 'run'}"]
    assert forewarp("train", *where, *QUICK, *STEPS).status == 0
    return tmp_path / "run"


def test_a_run_has_a_row(run, capsys):
    row = limits_of(run, views=2)
    assert set(row) == set(COLUMNS)
    assert row["outside"] + row["outline"] + row["inside"] == pytest.approx(1)
    assert row["low-passed truth"] > row["test views"] > 5
    assert row["voxel, pixels"] > 1
    capsys.readouterr()
    main([str(run), "--views", "2"])
    lines = capsys.readouterr().out.splitlines()
    assert [cell.strip() for cell in lines[0].strip("|").split("|")] == list(COLUMNS)
    cells = [cell.strip() for cell in lines[2].strip("|").split("|")]
    assert cells[0] == "vehicle"
    assert cells[2] == f"{row['test views']:.2f}"


def test_what_is_no_run_is_refused_in_one_line(tmp_path, capsys):
    with pytest.raises(SystemExit) as leaving:
        main([str(tmp_path)])
    assert leaving.value.code == 2
    assert "config.yaml: expected the configuration of a run, but got none" in capsys.readouterr().err


class At:
    def __init__(self, time, psnr):
        self.time, self.psnr = time, psnr


def test_the_means_by_time():
    found = by_time([At(0.0, 20.0), At(0.1, 22.0), At(0.5, 30.0)])
    assert found["test views"] == 24.0
    assert found["first fifth"] == 21.0
    assert found["between"] == 30.0
    assert math.isnan(found["last fifth"])


def test_all_where_fewer_are_there():
    assert spread(3, 20) == [0, 1, 2]
    assert spread(201, 3) == [0, 100, 200]
