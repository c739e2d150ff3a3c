import math

import pytest
from omegaconf import OmegaConf

from forewarp.evaluation.limits import COLUMNS, by_time, limits_of
from forewarp.runs.build import build_run
from forewarp.runs.config import saved_config


def test_a_run_has_a_row(fitted):
    row = limits_of(build_run(saved_config(str(fitted), OmegaConf.create())), views=2)
    assert set(row) == set(COLUMNS)
    assert row["outside"] + row["outline"] + row["inside"] == pytest.approx(1)
    assert row["low-passed truth"] > row["test views"] > 5
    assert row["voxel, pixels"] > 1


class At:
    def __init__(self, time, psnr):
        self.time, self.psnr = time, psnr


def test_the_means_by_time():
    found = by_time([At(0.0, 20.0), At(0.1, 22.0), At(0.5, 30.0)])
    assert found["test views"] == 24.0
    assert found["first fifth"] == 21.0
    assert found["between"] == 30.0
    assert math.isnan(found["last fifth"])
