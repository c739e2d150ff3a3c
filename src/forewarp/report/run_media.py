"""Put pictures and a video into a page as text, in so many bytes."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from forewarp.drawing.files import jpeg_bytes, smaller_video
from forewarp.drawing.images import at_most

_PICTURES = 0.6  # share of the room that pictures may take; the video has the rest
_LADDER = ((800, 92), (640, 90), (480, 88), (320, 80), (200, 70), (120, 60))  # most pixels of a side, quality
_THUMB = 96, 70


@dataclass(frozen=True)
class Shown:
    """A view: why it is shown, what it is, and its pictures (H, W, 3) in [0, 1]: ``truth``, ``prediction``,
    ``error`` and ``depth``, or some of them. ``side``: pixels of the longer side of the view that was scored,
    where the pictures were rendered smaller; 0: as they are.
    """

    why: str
    about: str
    pictures: Mapping[str, Tensor]
    side: int = 0


@dataclass(frozen=True)
class Media:
    """What a page shows: views, the file of a video and what is to be seen in it; what is missing and why."""

    views: Sequence[Shown] = ()
    video: Path | None = None
    about: str = ""
    missing: Sequence[str] = ()


@dataclass(frozen=True)
class Held:
    """What a page holds: as ``data:`` addresses the video ("" for none), and pictures and ``thumb`` of each
    view; what became of the pictures and of the video so that they fit.
    """

    views: list[dict[str, str]] = field(default_factory=list)
    video: str = ""
    pictures_note: str = ""
    video_note: str = ""


def held(media: Media, room: float) -> Held:
    """Encode pictures and video into at most ``room`` bytes of the page."""
    views, note = _pictures(media.views, _PICTURES * room if media.video else room)
    left = room - sum(len(text) for view in views for text in view.values())
    video, video_note = _video(media.video, int(0.75 * left) - 100) if media.video else (b"", "")
    return Held(views, _address("video/mp4", video) if video else "", note, video_note)


def _pictures(shown: Sequence[Shown], room: float) -> tuple[list[dict[str, str]], str]:
    if not shown:
        return [], ""
    largest = max(max(one.side, *p.shape[:2]) for one in shown for p in one.pictures.values())
    for side, quality in _LADDER:
        views = [_encoded(one, side, quality) for one in shown]
        if sum(len(text) for view in views for text in view.values()) <= room:
            smaller = f", scaled from {largest} to {side} pixels" if largest > side else ""
            return views, f"JPEG of quality {quality}{smaller}"
    return [], "left out, as the page has no room for them; raise megabytes"


def _encoded(shown: Shown, side: int, quality: int) -> dict[str, str]:
    found = {name: _jpeg(at_most(picture.cpu(), side), quality) for name, picture in shown.pictures.items()}
    first = next(iter(shown.pictures.values())).cpu()
    return found | {"thumb": _jpeg(at_most(first, _THUMB[0]), _THUMB[1])}


def _video(path: Path, room: int) -> tuple[bytes, str]:
    if path.stat().st_size <= room:
        return path.read_bytes(), ""
    return smaller_video(path, room)


def _jpeg(picture: Tensor, quality: int) -> str:
    return _address("image/jpeg", jpeg_bytes(picture, quality))


def _address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
