"""Build HTML and SVG: text is escaped unless it says that it is markup already."""

from __future__ import annotations

from html import escape

_VOID = frozenset({"img", "input", "link", "meta"})


class Html(str):
    """Text that is markup, and is not escaped again."""

    __slots__ = ()


def el(name: str, /, *inside: object, **attributes: object) -> Html:
    """Make an element. What is inside is escaped unless it is ``Html``; None is left out.

    Attributes: ``class_`` is ``class``, ``aria_label`` is ``aria-label``. True is an attribute without a
    value; None and False leave it out.

    >>> el("p", "a < b", el("b", "c"), class_="x", hidden=True, title='"')
    '<p class="x" hidden title="&quot;">a &lt; b<b>c</b></p>'
    """
    parts = [f"<{name}"]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        key = key.rstrip("_").replace("_", "-")
        parts.append(f" {key}" if value is True else f' {key}="{escape(str(value))}"')
    parts.append(">")
    return Html("".join(parts) + ("" if name in _VOID else f"{joined(*inside)}</{name}>"))


def joined(*inside: object) -> Html:
    """Put parts behind each other, each escaped unless it is ``Html``.

    >>> joined("1 & ", None, Html("<hr>"))
    '1 &amp; <hr>'
    """
    return Html("".join(p if isinstance(p, Html) else escape(str(p)) for p in inside if p is not None))
