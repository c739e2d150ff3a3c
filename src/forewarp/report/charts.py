"""Draw charts as SVG that a page holds as text: they follow its colours and need no script."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from forewarp.report.markup import Html, el, joined

WIDTH, HEIGHT = 460, 270
_LEFT, _RIGHT, _TOP, _BOTTOM = 50, 14, 14, 44  # margins
_MARGIN = 0.06  # of the data's range, left free above and below


@dataclass(frozen=True)
class Axis:
    """An axis: its title, and whether it is logarithmic."""

    title: str
    log: bool = False

    def at(self, value: float) -> float:
        """Return where a value lies before scaling; of a logarithmic axis it must be > 0."""
        return math.log10(value) if self.log else value


@dataclass(frozen=True)
class Series:
    """Points (x, y) drawn as a ``line``, as ``dots``, or as ``stems`` that begin at ``base``.

    ``titles`` are shown where the pointer rests on a point; ``name`` is for the legend, "" for none of it.
    """

    name: str
    points: Sequence[tuple[float, float]]
    kind: str = "dots"
    titles: Sequence[str] = ()
    base: float = 0.0


def chart(
    series: Sequence[Series], x: Axis, y: Axis, label: str, *, level: tuple[float, str] | None = None
) -> Html:
    """Draw series into one picture.

    Args:
        series: what to draw; they have colours 0, 1, 2, ... of the page's style.
        x, y: the axes.
        label: says in words what is to be seen.
        level: a dashed line at a value of y, and its name.
    """
    xs = [x.at(px) for one in series for px, _ in one.points]
    ys = [y.at(py) for one in series for _, py in one.points] + ([y.at(level[0])] if level else [])
    spans = _span(xs, 0.02), _span(ys, _MARGIN)
    frame = _Frame(x, y, *spans)
    parts, named_level = [_grid(frame)], []
    if level is not None:
        at = frame.down(level[0])
        parts.append(el("line", x1=_LEFT, x2=WIDTH - _RIGHT, y1=at, y2=at, class_="level"))
        named_level = [_level_name(frame, series, at, level[1])]
    parts += [_drawn(frame, one, number) for number, one in enumerate(series)] + named_level
    named = [(number, one.name) for number, one in enumerate(series) if one.name]
    legend = [el("span", el("i", class_=f"c{number}"), name) for number, name in named]
    picture = el("svg", *parts, viewBox=f"0 0 {WIDTH} {HEIGHT}", role="img", aria_label=label)
    return joined(picture, el("p", *legend, class_="legend") if legend else None)


@dataclass(frozen=True)
class _Frame:
    """Where values lie in the picture."""

    x: Axis
    y: Axis
    across: tuple[float, float]
    upward: tuple[float, float]

    def right(self, value: float) -> float:
        low, high = self.across
        return round(_LEFT + (self.x.at(value) - low) / (high - low) * (WIDTH - _LEFT - _RIGHT), 1)

    def down(self, value: float) -> float:
        low, high = self.upward
        return round(
            HEIGHT - _BOTTOM - (self.y.at(value) - low) / (high - low) * (HEIGHT - _TOP - _BOTTOM), 1
        )


def _span(values: Sequence[float], margin: float) -> tuple[float, float]:
    """Return the range of the values, with a margin; never empty."""
    low, high = min(values), max(values)
    free = margin * (high - low) or max(abs(high), 1) * margin
    return low - free, high + free


def ticks(low: float, high: float, log: bool = False) -> list[float]:
    """Choose round numbers between two; of a logarithmic axis ``low`` and ``high`` are powers of ten.

    >>> ticks(27.3, 34.1), ticks(0.1, 1.9, log=True)
    ([28.0, 30.0, 32.0, 34.0], [2.0, 5.0, 10.0, 20.0, 50.0])
    """
    if not log:
        rough = (high - low) / 4
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(power * many for many in (1, 2, 5, 10) if power * many >= 0.75 * rough)
        return [round(i * step, 12) for i in range(math.ceil(low / step), math.floor(high / step) + 1)]
    decades = range(math.floor(low), math.ceil(high) + 1)
    for steps in ((1, 2, 5), (1,)):
        found = [many * 10.0**d for d in decades for many in steps]
        found = [round(value, 12) for value in found if low <= math.log10(value) <= high]
        if len(found) <= 7:
            break
    if len(found) < 2:  # less than an octave
        return [round(value, 12) for value in ticks(10**low, 10**high) if value > 0]
    return found[:: -(-len(found) // 7)]


def _grid(frame: _Frame) -> Html:
    parts, bottom = [], HEIGHT - _BOTTOM
    for value in ticks(*frame.across, frame.x.log):
        at = frame.right(value)
        parts.append(el("line", x1=at, x2=at, y1=_TOP, y2=bottom, class_="grid"))
        parts.append(el("text", f"{value:g}", x=at, y=bottom + 17, text_anchor="middle"))
    for value in ticks(*frame.upward, frame.y.log):
        at = frame.down(value)
        parts.append(el("line", x1=_LEFT, x2=WIDTH - _RIGHT, y1=at, y2=at, class_="grid"))
        parts.append(el("text", f"{value:g}", x=_LEFT - 7, y=at + 4, text_anchor="end"))
    middle = (_LEFT + WIDTH - _RIGHT) / 2
    parts.append(el("text", frame.x.title, x=middle, y=HEIGHT - 8, text_anchor="middle", class_="axis"))
    turned = f"rotate(-90) translate({-(_TOP + bottom) / 2:g} 12)"
    parts.append(el("text", frame.y.title, transform=turned, text_anchor="middle", class_="axis"))
    return joined(*parts)


def _level_name(frame: _Frame, series: Sequence[Series], at: float, name: str) -> Html:
    """Write a level's name above it, at the end where fewer points lie."""
    near = [frame.right(px) for one in series for px, py in one.points if -4 < at - frame.down(py) < 20]
    left = sum(place < _LEFT + 100 for place in near) <= sum(place > WIDTH - _RIGHT - 100 for place in near)
    x, anchor = (_LEFT + 3, "start") if left else (WIDTH - _RIGHT - 3, "end")
    return el("text", name, x=x, y=round(at - 5, 1), text_anchor=anchor, class_="level")


def _drawn(frame: _Frame, one: Series, number: int) -> Html:
    places = [(frame.right(px), frame.down(py)) for px, py in one.points]
    parts = []
    if one.kind == "line":
        parts.append(el("polyline", points=" ".join(f"{a:g},{b:g}" for a, b in places), class_="line"))
    titles = list(one.titles) or [None] * len(places)
    for (a, b), title in zip(places, titles):
        told = None if title is None else el("title", title)
        if one.kind == "stems":
            thick = max(1, min(9, 0.7 * (WIDTH - _LEFT - _RIGHT) / len(places)))
            stem = {"x1": a, "x2": a, "y1": frame.down(one.base), "y2": b, "stroke_width": round(thick, 1)}
            parts.append(el("line", told, **stem, class_="stem"))
        elif one.kind == "dots" or title is not None:
            parts.append(el("circle", told, cx=a, cy=b, r=4 if len(places) < 100 else 2.5))
    return el("g", *parts, class_=f"c{number}")
