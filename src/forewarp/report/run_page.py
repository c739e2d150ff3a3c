"""Write the page of one run: what it shows, how good it is, how it came about. It fetches nothing."""

from __future__ import annotations

import base64
import hashlib
import shlex
from pathlib import Path

from forewarp.files import read_text, replace_file
from forewarp.progress import time_text
from forewarp.report.collect import UNREADABLE, unreadable
from forewarp.report.markup import Html, el, joined
from forewarp.report.run_facts import (
    KINDS,
    described,
    effects_of,
    near,
    protocol_of,
    scores_of,
    seconds_of,
    tiles_of,
    views_table,
)
from forewarp.report.run_figures import figures_of
from forewarp.report.run_files import Story
from forewarp.report.run_media import Held, Media, Shown, held
from forewarp.report.tables import Table

STYLE, SCRIPT = (Path(__file__).with_name(f"run_page.{kind}") for kind in ("css", "js"))
_SMALL = 300  # pictures with a shorter longer side are shown as squares, not blurred
_NOTES = 1000  # bytes that are kept for what the page says about sizes


def write_run_page(file: Path, story: Story, media: Media, *, megabytes: float) -> int:
    """Write the page of a run.

    Args:
        file: of the page.
        story: what the run's folder tells.
        media: what to show of it.
        megabytes: most of the page, in 10^6 bytes; pictures and the video are made smaller, or left out.

    Returns:
        bytes written.

    Raises:
        ValueError: see ``room_of``.
    """
    text = page(story, media, held(media, room_of(story, media, megabytes))).encode()
    replace_file(file, text)
    return len(text)


def room_of(story: Story, media: Media, megabytes: float) -> float:
    """Return the bytes that a page of so many 10^6 bytes has for pictures and the video.

    Raises:
        ValueError: in one line, if the text alone is larger, or the run's files hold what no page can show.
    """
    views = [dict.fromkeys([*one.pictures, "thumb"], "") for one in media.views]
    empty = Held(views, "data:" if media.video else "")
    try:
        bare = len(page(story, media, empty).encode()) + _NOTES
    except UNREADABLE as error:
        raise ValueError(
            f"run: expected a run whose files can be shown, but got {story.result.folder} "
            f"({unreadable(error)})"
        ) from error
    room = 1e6 * megabytes - bare
    if room < 0:
        raise ValueError(
            f"megabytes: expected room for the page's text, {bare / 1e6:.2f}, but got {megabytes}; raise it"
        )
    return room


def page(story: Story, media: Media, inside: Held) -> str:
    """Return the page as HTML."""
    script, style = (read_text(path) for path in (SCRIPT, STYLE))
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'; "
        f"script-src 'sha256-{digest}'"
    )
    title = f"{story.result.scene}, {described(story)}"
    head = el(
        "head",
        el("meta", charset="utf-8"),
        el("meta", http_equiv="Content-Security-Policy", content=policy),
        el("meta", name="viewport", content="width=device-width, initial-scale=1"),
        el("meta", name="color-scheme", content="light dark"),
        el("title", title),
        el("style", Html(style)),
    )
    parts = [
        _hero(story, media, inside),
        _views(media, inside),
        _figures(story),
        _effects(story),
        _numbers(story),
        _protocol(story),
        _missing(story, media, inside),
    ]
    body = el("body", el("main", *parts), el("script", Html(script)))
    return f"<!doctype html>\n{el('html', head, body, lang='en')}\n"


def _hero(story: Story, media: Media, inside: Held) -> Html:
    film = None
    if inside.video:
        options = {"controls": True, "autoplay": True, "muted": True, "loop": True, "playsinline": True}
        video = el("video", src=inside.video, aria_label=f"Video: {media.about}", **options)
        note = f"{media.about}{'; ' + inside.video_note if inside.video_note else ''}."
        film = el("figure", video, el("figcaption", note[:1].upper() + note[1:]), class_="film")
    result = story.result
    big = el("p", "Not measured", class_="big")
    if result.metrics and (psnr := result.numbers.get("psnr")) is not None:
        kind = "" if result.ability == "all" else f" {KINDS.get(result.ability, result.ability)}"
        count = sum(result.ability in ("all", view.ability) for view in story.views)
        of = f"{count} test views" if count else "test views"
        small = el("small", el("span", "PSNR"), el("span", f"mean of {of}{kind}"))
        big = el("p", el("b", f"{psnr:.2f}"), " dB ", small, class_="big")
    tiles = [el("div", el("dt", name), el("dd", value)) for name, value in tiles_of(story)]
    facts = el(
        "div",
        el("p", "A moving scene, reconstructed", class_="eyebrow"),
        el("h1", result.scene),
        el("p", described(story), class_="sub"),
        big,
        el("dl", *tiles, class_="tiles") if tiles else None,
        class_="facts",
    )
    return el("header", film, facts, class_="hero" if film else "hero alone")


def _views(media: Media, inside: Held) -> Html | None:
    if not inside.views:
        return None
    choices, panels = [], []
    for number, (shown, pictures) in enumerate(zip(media.views, inside.views)):
        name = f"v{number}"
        choices.append(el("input", type="radio", name="view", id=name, class_="pick", checked=number == 0))
        thumb = el("img", src=pictures["thumb"], alt="")
        words = el("span", el("b", shown.why), el("span", shown.about.split(", ")[-1]))
        choices.append(el("label", thumb, words, for_=name))
        panels.append(_panel(number, shown, pictures))
    about = (
        "Drag the line, or focus it and use the arrow keys: the truth is on its left, what the run renders "
        "on its right. Error is black where both agree and white where they differ by a quarter of the range "
        "or more; in depth, near is bright."
    )
    return _section(
        "Truth against prediction",
        el("p", about, el("noscript", " Without scripts the two stand beside each other.")),
        el("div", *choices, *panels, class_="views"),
        el("p", f"Pictures are {inside.pictures_note}.", class_="note"),
    )


def _panel(number: int, shown: Shown, pictures: dict[str, str]) -> Html:
    def figure(name: str) -> Html:
        width, height = shown.pictures[name].shape[1::-1]
        alt = f"{name}, {shown.why}: {shown.about}"
        small = "small" if max(width, height) < _SMALL else None
        image = el("img", src=pictures[name], alt=alt, width=width, height=height, class_=small)
        return el("figure", image, el("figcaption", name), class_=name)

    both = [figure(name) for name in ("truth", "prediction") if name in shown.pictures]
    label = f"Truth on the left, prediction on the right: {shown.why}"
    if len(both) == 2:
        cut = {"type": "range", "min": 0, "max": 100, "value": 50, "aria_label": label, "hidden": True}
        both += [el("input", **cut), el("span", class_="seam", aria_hidden="true")]
    others = [figure(name) for name in ("error", "depth") if name in shown.pictures]
    height, width = next(iter(shown.pictures.values())).shape[:2]
    return el(
        "div",
        el("div", *both, class_="pair", style=f"--shape: {width / height:.4f}"),
        el("div", *others, class_="side") if others else None,
        el("p", shown.about, class_="note"),
        class_="panel tall" if height > 1.2 * width else "panel",
        id=f"p{number}",
    )


def _figures(story: Story) -> Html | None:
    parts = []
    for title, figures in figures_of(story):
        cards = [
            el("figure", el("h3", name), chart, el("figcaption", says), class_="card")
            for name, chart, says in figures
        ]
        parts.append(_section(title, el("div", *cards, class_="cards")))
    return joined(*parts)


def _effects(story: Story) -> Html | None:
    about, effects = effects_of(story)
    if not effects:
        return None
    rows = [
        el(
            "li",
            el("span", "on" if one.on else "off", class_="badge on" if one.on else "badge"),
            el("b", one.name.replace("_", " ")),
            el("code", one.choice) if one.choice else None,
            el("p", one.because),
        )
        for one in effects
    ]
    return _section("Effects, and why", el("p", about), el("ul", *rows, class_="effects"))


def _numbers(story: Story) -> Html | None:
    table = scores_of(story)
    if table is None:
        return None
    every = None
    if story.views:
        summary = el("summary", f"Every test view ({len(story.views)})")
        every = el("details", summary, _scrolled(views_table(story), "every test view"))
    return _section("Numbers", _scrolled(table, "scores by kind of test view"), every)


def _scrolled(table: Table, label: str) -> Html:
    from forewarp.report.page import html_table

    return el("div", Html(html_table(table)), class_="scroll", tabindex=0, role="region", aria_label=label)


def _protocol(story: Story) -> Html:
    rows = [joined(el("dt", name), el("dd", value)) for name, value in protocol_of(story)]
    folder = _folder(story)
    again = el("pre", el("code", near(story.result.command)))
    closer = f"forewarp-view run={folder}"
    if story.curves.size is not None:
        closer += f"\nforewarp-export run={folder} format=html"
    return joined(
        _section("How it was made and measured", el("dl", *rows, class_="rows")),
        _section(
            "Do it again",
            el("p", "The command that made this run; into another folder with run=..."),
            again,
            None if story.unfinished else el("p", "Fly through it:"),
            None if story.unfinished else el("pre", el("code", closer)),
        ),
    )


def _folder(story: Story) -> str:
    """Write the run's folder as a command line takes it."""
    return shlex.quote(near(str(story.result.folder)))


def _missing(story: Story, media: Media, inside: Held) -> Html:
    notes = [*_not_known(story), *map(near, media.missing)]
    if not media.views:
        notes.append("No pictures: the run's folder has none of test views, and none of training.")
    elif not inside.views:
        notes.append(f"Pictures are {inside.pictures_note}.")
    if not media.video and not media.missing:
        how = "" if story.unfinished else f" forewarp-render run={_folder(story)} makes one."
        notes.append(f"No video: the run's folder has none that was made after training.{how}")
    if media.video and not inside.video:
        notes.append(f"The video is {inside.video_note}, as the page has no room for it; raise megabytes.")
    version = story.result.metrics.get("protocol", {}).get("versions", {}).get("forewarp", "")
    measured = f" The run was measured by forewarp {version}." if version else ""
    foot = el("footer", el("p", f"Written by forewarp-report kind=run.{measured}", class_="note"))
    listed = el("ul", *(el("li", note) for note in notes))
    return joined(_section("What this page lacks", listed) if notes else None, foot)


def _not_known(story: Story) -> list[str]:
    """Say what the run's files do not tell, and how it can be had."""
    result, notes = story.result, []
    measure = f"forewarp-evaluate run={_folder(story)}"
    if story.unfinished:
        have = "has" if len(story.unfinished) == 1 else "have"
        notes.append(
            f"The run is not finished, so it has no scores: of its stages {', '.join(story.unfinished)} "
            f"{have} not ended (finished: {', '.join(result.stages) or 'none'}; trained for "
            f"{time_text(seconds_of(story))}). It goes on with: forewarp-train resume={_folder(story)}"
        )
    elif not result.metrics:
        notes.append(f"The run is not measured, so it has no scores. Measure it: {measure}")
    elif not story.views:
        notes.append(
            "No PSNR by view and through the scene's time: per_image.json is missing, cut off or empty. "
            f"Write it again: {measure}"
        )
    if not effects_of(story)[1]:
        notes.append("No effects: neither a plan nor metrics.json names any.")
    if not result.curve:
        notes.append(
            "No PSNR against training time: it needs validation views, or data.held_out=N, and some seconds "
            "of training."
        )
    if not story.curves.loss:
        notes.append("No loss: the folders of the stages have no TensorBoard events of it.")
    return notes


def _section(title: str, *parts: object) -> Html:
    return el("section", el("h2", title), *parts)
