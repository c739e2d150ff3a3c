"""Charts: points lie where their axes say."""

import re
from xml.etree import ElementTree

import pytest

from forewarp.report.charts import Axis, Series, chart, ticks

PLAIN = Axis("x"), Axis("y")


def drawn(series, x=PLAIN[0], y=PLAIN[1], **options):
    """The chart, parsed; what follows the picture is dropped."""
    text = chart(series, x, y, "a < b", **options)
    return ElementTree.fromstring(text[: text.index("</svg>") + 6])


def circles(picture):
    return [(float(one.get("cx")), float(one.get("cy"))) for one in picture.iter("circle")]


def labels(picture):
    return [text.text for text in picture.iter("text")]


@pytest.mark.parametrize("log", [False, True])
def test_points_and_ticks_share_their_axes(log):
    axis = Axis("t", log=log)
    values = [1.0, 10.0, 100.0]
    picture = drawn([Series("", [(v, v) for v in values])], axis, axis)
    at = dict(zip(values, circles(picture)))
    for side, (anchor, key, off) in enumerate([("middle", "x", 0), ("end", "y", 4)]):
        marks = [text for text in picture.iter("text") if text.get("text-anchor") == anchor]
        ticked = {float(text.text): float(text.get(key)) for text in marks if text.text != "t"}
        shared = [value for value in values if value in ticked]
        assert shared
        for value in shared:
            assert ticked[value] - off == pytest.approx(at[value][side], abs=0.2)
    assert at[1][0] < at[10][0] < at[100][0]
    assert at[1][1] > at[10][1] > at[100][1]  # upwards
    if log:
        assert at[10][0] - at[1][0] == pytest.approx(at[100][0] - at[10][0], abs=0.2)


@pytest.mark.parametrize("points", [[(3.0, 5.0)], [(0.0, 0.0)], [(1.0, 2.0), (2.0, 2.0)]])
@pytest.mark.parametrize("kind", ["line", "dots", "stems"])
def test_without_a_range_everything_stays_inside(points, kind):
    text = chart([Series("", points, kind, base=points[0][1])], *PLAIN, "label", level=(points[0][1], "mean"))
    numbers = re.findall(r'(?:cx|cy|x1|y1|x2|y2)="([-\d.]+)"', text)
    places = [pair for found in re.findall(r'points="([^"]+)"', text) for pair in found.split()]
    assert len(places) == (len(points) if kind == "line" else 0)
    numbers += [number for pair in places for number in pair.split(",")]
    assert all(0 <= float(number) <= 460 for number in numbers)


def test_stems_begin_at_their_base_and_titles_are_escaped():
    series = Series("a & b", [(1.0, 1.0), (2.0, 3.0)], "stems", ["<one>", "two"], base=2.0)
    picture = drawn([series], level=(2.0, "mean"))
    stems = [line for line in picture.iter("line") if line.get("class") == "stem"]
    assert len({line.get("y1") for line in stems}) == 1
    assert float(stems[0].get("y2")) > float(stems[0].get("y1")) > float(stems[1].get("y2"))
    assert [title.text for title in picture.iter("title")] == ["<one>", "two"]
    assert "mean" in labels(picture)
    assert picture.get("aria-label") == "a < b"
    assert "a &amp; b" in chart([series], *PLAIN, "")


@pytest.mark.parametrize(("low", "high", "log"), [(29.4, 36.4, False), (0.3, 1.8, True), (0.31, 0.4, True)])
def test_ticks_are_few_and_inside(low, high, log):
    found = ticks(low, high, log)
    ends = (10**low, 10**high) if log else (low, high)
    assert 2 <= len(found) <= 8
    assert ends[0] <= found[0] < found[-1] <= ends[1]
