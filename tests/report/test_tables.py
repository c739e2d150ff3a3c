import pytest

from forewarp.metrics.gain import Estimate
from forewarp.report.tables import Column, Table

TABLE = Table(
    [Column("name"), Column("PSNR", signed=True), Column("steps", 0), Column("s", prefix="×")],
    [["a|b", Estimate(0.5, 0.25), 10, 1.234], ["c", Estimate(-1.0), None, 2.0]],
    "Of two:",
)


def test_markdown_rounds_aligns_and_escapes():
    assert TABLE.markdown().splitlines() == [
        "Of two:",
        "",
        "| name   |         PSNR |   steps |     s |",
        "|:-------|-------------:|--------:|------:|",
        "| a\\|b   | +0.50 ± 0.25 |      10 | ×1.23 |",
        "| c      |        -1.00 |         | ×2.00 |",
    ]


def test_a_table_without_rows_has_its_head():
    assert Table([Column("a")], []).markdown().splitlines() == ["| a   |", "|-----|"]


def test_csv_keeps_all_digits_and_the_spread_apart():
    assert TABLE.csv().splitlines() == ["name,PSNR,PSNR sd,steps,s", "a|b,0.5,0.25,10,1.234", "c,-1.0,,,2.0"]


@pytest.mark.parametrize(
    ("values", "estimate"), [([], None), ([2.0], Estimate(2.0)), ([1.0, 2.0, 3.0], Estimate(2.0, 1.0))]
)
def test_estimates(values, estimate):
    assert Estimate.of(values) == estimate


def test_a_row_of_another_length_is_refused():
    with pytest.raises(ValueError, match="expected rows of 1 cells"):
        Table([Column("a")], [[1, 2]])
