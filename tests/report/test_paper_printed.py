"""The paper's printed tables, as they are kept."""

import pytest

from forewarp.report.paper_printed import PAPER, read_paper


def test_the_papers_slips_are_footnotes_that_its_numbers_bear_out():
    tables = read_paper(PAPER)
    scenes = tables["dnerf_scenes"]
    for name, those in scenes.means:
        scenes = scenes.with_mean(name, those)
    means = {row.name: row.values[-6::3] for row in scenes.rows}
    assert means["T-NeRF"][0] == "28.78"
    assert means["D-NeRF"][0] == "30.44"
    assert means["Ours"] == ("32.68", "33.74")
    assert means["Ours, no total variation"][0] == "33.09"
    notes = " ".join(note for table in tables.values() for note in table.notes)
    for number in ("28.78", "30.44", "23.45", "33.09", "33.30"):
        assert number in notes
    ndvg = next(row for row in tables["hypernerf"].rows if row.name.startswith("NDVG"))
    assert sum(map(float, ndvg.values[:8:2])) / 4 == pytest.approx(23.45)


def test_a_row_of_another_length_is_named(tmp_path):
    path = tmp_path / "paper.yaml"
    path.write_text(
        "datasets: {d: [a]}\ntables:\n  t: {title: t, source: s, variants: [], notes: [],\n"
        "    groups: [{name: A, dataset: d, metrics: [psnr]}], rows: [{name: x, values: [1, 2]}]}\n"
    )
    with pytest.raises(ValueError, match="t: x: expected 1 values, but got 2"):
        read_paper(path)
    path.write_text("tables: []\n")
    with pytest.raises(ValueError, match="paper.yaml: expected tables of groups and rows, but got A"):
        read_paper(path)
