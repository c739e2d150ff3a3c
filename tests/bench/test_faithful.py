"""The counted step: what is counted grows with the rays, and the page gets a row a method."""

import json

from tests.bench.faithful import FIELDS, known_rows, measured, write


def test_a_step_is_counted_and_timed(fitted):
    scene = fitted.parent / "scenes" / "vehicle"
    few, many = (measured("tnerf", scene, rays) for rays in (4, 8))
    assert [(step["rays"], step["of"]) for step in (few, many)] == [(4, 500), (8, 500)]
    assert many["flop"] == 2 * few["flop"] > 0
    assert few["parameters"] == many["parameters"] == 600_452
    assert few["seconds"] > 0
    assert few["bytes"] > 12 * few["parameters"]  # with gradients and Adam's moments
    assert set(json.loads(json.dumps(few))) == set(FIELDS)


def test_a_method_that_failed_says_why_in_its_row(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# Steps\n<!-- steps -->\n<!-- end of steps -->\n")
    row = {"method": "nerf", "of": 1000, "rays": 1000, "flop": 3 * 10**9, "seconds": 8.64, "bytes": 2**30}
    row |= {"parameters": 1_500_000, "steps": 20_000, "failed": "", "scene": "ball", "day": "today"}
    less = row | {"method": "nerfies", "rays": 500}
    failed = dict.fromkeys(FIELDS) | {"method": "ndvg", "failed": "killed", "scene": "ball", "day": "today"}
    write([row, less, failed], page)
    lines = page.read_text().splitlines()
    assert "| `nerf` | 1,000 | 3 | 3.0 | 8.6 | 1.0 | 1.50 | 20,000 | 2.0 |" in lines
    shown = "1,000, measured with 500 | ≈ 6 | 6.0 | ≈ 17.3 | 1.0 with 500 | 1.50 | 20,000 | ≈ 4.0 |"
    assert f"| `nerfies` | {shown}" in lines
    assert any(line.startswith("| `ndvg` | killed |") for line in lines)
    assert known_rows(page.with_suffix(".csv"))[:2] == [row, less]
