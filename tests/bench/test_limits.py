import math

import pytest
import torch

from tests.bench.limits import REGIONS, by_time, error_shares, limits_of, main, regions

NOISE = torch.rand(40, 48, 3, generator=torch.Generator().manual_seed(0))
DISC = (torch.arange(40)[:, None] - 20) ** 2 + (torch.arange(48)[None] - 20) ** 2 < 100


def test_a_run_has_a_row(fitted, capsys, monkeypatch):
    rows = []
    monkeypatch.setattr("tests.bench.limits.limits_of", lambda run: rows.append(limits_of(run, 2)) or rows[0])
    main([str(fitted)])
    head, _, line = (
        [cell.strip() for cell in row.split("|")[1:-1]] for row in capsys.readouterr().out.splitlines()
    )
    assert (head[0], line[0], len(line)) == ("scene", "vehicle", len(head))
    (row,) = rows
    assert row["outside"] + row["outline"] + row["inside"] == pytest.approx(1)
    assert row["low-passed truth"] > row["test views"] > 5
    assert row["voxel, pixels"] > 1


def test_the_means_by_time():
    found = by_time([(0.0, 20.0), (0.1, 22.0), (0.5, 30.0)])
    assert found["test views"] == 24.0
    assert found["first fifth"] == 21.0
    assert found["between"] == 30.0
    assert math.isnan(found["last fifth"])


def test_regions_share_no_pixel_and_miss_none():
    found = regions(DISC)
    assert list(found) == list(REGIONS)
    assert (sum(mask.int() for mask in found.values()) == 1).all()
    assert found["inside"][20, 20]
    assert found["outside"][0, 0]
    assert found["outline"][20, [26, 29, 30, 33]].tolist() == [False, True, True, False]
    assert regions(torch.ones(5, 7, dtype=bool))["inside"].all()


def test_errors_are_shared_out_whole():
    image = NOISE.clone()
    image[20, 20] += 1.0
    image[0, 0] += 2.0
    found = error_shares(NOISE, image, DISC)
    shares = {name: round(float(value), 4) for name, value in found.items()}
    assert shares == {"outside": 4.0, "outline": 0.0, "inside": 1.0}
