"""The figures of a run's page: PSNR through the scene's time and by view; PSNR and loss while it trained."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean

from forewarp.report.charts import Axis, Series, chart
from forewarp.report.curve import seconds_to
from forewarp.report.markup import Html
from forewarp.report.run_facts import KINDS
from forewarp.report.run_files import Story, View

_MOST = 400  # views that a figure draws

Figure = tuple[str, Html, str]  # title, picture, what it says


def figures_of(story: Story) -> list[tuple[str, list[Figure]]]:
    """Draw the figures there are numbers for, in groups with a title."""
    trained, views = [_accuracy(story), _losses(story)], story.views
    groups = [
        ("Where it is good, and where not", [_through_time(views), _by_view(views)] if views else []),
        ("How it got there", [figure for figure in trained if figure is not None]),
    ]
    return [(title, figures) for title, figures in groups if figures]


def _kept(views: Sequence[View]) -> list[int]:
    """Choose by index which views are drawn: at most about ``_MOST``, evenly, the last and the lowest too."""
    low = min(range(len(views)), key=lambda i: views[i].psnr)
    return sorted({*range(0, len(views), -(-len(views) // _MOST)), len(views) - 1, low})


def _left_out(kept: int, views: int) -> str:
    return f" {kept} of the {views} views are drawn; the words are of all." if kept < views else ""


def _about(view: View) -> str:
    return f"{view.name}, time {view.time:.3f}: {view.psnr:.2f} dB"


def _through_time(views: Sequence[View]) -> Figure:
    kinds = list(dict.fromkeys(view.ability for view in views))
    ordered, series = sorted(views, key=lambda view: view.time), []
    kept = [ordered[i] for i in _kept(ordered)]
    for kind in kinds:
        own = [view for view in kept if view.ability == kind]
        name = KINDS.get(kind, kind) if len(kinds) > 1 else ""
        points = [(view.time, view.psnr) for view in own]
        series.append(Series(name, points, titles=[_about(view) for view in own]))
    mean = fmean(view.psnr for view in views)
    low = min(views, key=lambda view: view.psnr)
    says = f"A dot is a test view. The lowest, {low.psnr:.1f} dB, is {low.name} at time {low.time:.2f}."
    says += _left_out(len(kept), len(views))
    label = f"PSNR of {len(views)} test views against the scene's time; mean {mean:.2f} dB. {says}"
    level = mean, f"mean of all {mean:.1f}"
    drawn = chart(series, Axis("time in the scene"), Axis("PSNR (dB)"), label, level=level)
    return "Through the scene's time", drawn, says


def _by_view(views: Sequence[View]) -> Figure:
    ranked = sorted(views, key=lambda view: view.psnr)
    mean = fmean(view.psnr for view in ranked)
    kept = _kept(ranked)
    points = [(float(i + 1), ranked[i].psnr) for i in kept]
    stems = Series("", points, "stems", [_about(ranked[i]) for i in kept], base=mean)
    below = sum(view.psnr < mean - 1 for view in ranked)
    says = (
        f"From the worst view ({ranked[0].psnr:.1f} dB) to the best ({ranked[-1].psnr:.1f} dB), from their "
        f"mean; {below} of {len(ranked)} {'is' if below == 1 else 'are'} more than 1 dB below it."
        + _left_out(len(kept), len(ranked))
    )
    level = mean, f"mean of all {mean:.1f}"
    drawn = chart([stems], Axis("view, from worst to best"), Axis("PSNR (dB)"), says, level=level)
    return "View by view", drawn, says


def _accuracy(story: Story) -> Figure | None:
    curve = [point for point in story.result.curve if point.seconds > 0 and math.isfinite(point.psnr)]
    if len(curve) < 2:
        return None
    last = curve[-1]
    line = Series(
        "",
        [(point.seconds, point.psnr) for point in curve],
        "line",
        [f"{point.seconds:.1f} s, step {point.step}: {point.psnr:.2f} dB" for point in curve],
    )
    near = seconds_to(curve, last.psnr - 1)
    soon = f"; within 1 dB of that after {near:.0f} s" if near is not None else ""
    says = f"Of views that are not trained on: {last.psnr:.1f} dB after {last.seconds:.0f} s{soon}."
    axes = Axis("seconds of training", log=True), Axis("PSNR (dB)")
    return "PSNR while it learned", chart([line], *axes, f"PSNR against training time. {says}"), says


def _losses(story: Story) -> Figure | None:
    series = []
    for stage, points in story.curves.loss.items():
        kept = [(seconds, loss) for seconds, loss in points if seconds > 0 and loss > 0]
        series += [Series(stage, kept, "line")] if kept else []
    if not series:
        return None
    ends = ", ".join(f"{one.name} ends at {one.points[-1][1]:.3g}" for one in series)
    says = f"What is minimised, averaged over steps; stages may weigh terms differently: {ends}."
    axes = Axis("seconds of training", log=True), Axis("loss", log=True)
    return "Loss", chart(series, *axes, f"Loss against training time. {says}"), says
