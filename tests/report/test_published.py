"""What is kept of the paper's tables is what its own text prints."""

import re
from pathlib import Path

import pytest

from forewarp.report.published import PAPER, read_paper

ROOT = Path(__file__).parents[2]
TEXT = ROOT.parent / "shared" / "docs" / "paper.tex"
needs_paper = pytest.mark.skipif(not TEXT.is_file(), reason="the paper's source text is not here")


def printed(label):
    """The numbers of a table's rows as the paper's source has them, colours and bold face taken off."""
    text = TEXT.read_text()
    begin = text.index(r"\label{" + label + "}")
    body = text[begin : text.index(r"\end{tabular}", begin)].replace("\n", " ")
    rows = []
    for line in body.split(r"\\"):
        cells = [re.sub(r"\\\w+\{([\d.]+)\}", r"\1", cell).strip() for cell in line.split("&")[1:]]
        numbers = [cell for cell in cells if re.fullmatch(r"[\d.]+", cell)]
        rows += [numbers] if numbers else []
    return rows


def kept(key):
    return [list(row.values) for row in read_paper(PAPER)[key].rows]


@needs_paper
@pytest.mark.parametrize("key", ["dnerf", "hypernerf", "nhr", "lego_complete", "modules"])
def test_every_number_is_the_printed_one(key):
    assert kept(key) == printed(read_paper(PAPER)[key].source)


@needs_paper
def test_the_scenes_of_the_supplement_stand_side_by_side():
    rows = printed("table:quantsupp")
    assert kept("dnerf_scenes") == [a + b for a, b in zip(rows[:9], rows[9:])]


@needs_paper
def test_the_losses_are_the_supplements_turned():
    assert kept("losses") == [list(column) for column in zip(*printed("tab:rebuttal"))]
    short = [row for row in zip(*printed("tab:rebuttalmain"))]
    assert set(short) < {tuple(row) for row in kept("losses")}


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
