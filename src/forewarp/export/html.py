"""``format=html``: one page that plays ``scene.glb`` in a browser, by the code in ``player/``."""

from __future__ import annotations

import base64
import hashlib
import html
import re
import zlib
from pathlib import Path

import torch
from torch import Tensor

from forewarp.drawing.images import at_most, jpeg_bytes
from forewarp.export.glb import packed_scene
from forewarp.export.tracks import Progress, Source
from forewarp.scene.view import Moment, View

_PLAYER = Path(__file__).with_name("player")
_POSTER = 640, 85  # most pixels of a side, and the JPEG's quality
# A page may run its own two scripts and the worker made of the first, show its poster, and nothing else.
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; worker-src blob: data:; "
    "script-src {scripts}"
)


def export_html(
    source: Source, folder: Path, progress: Progress, *, quality: str, seconds: float | None
) -> dict:
    """Write ``scene.html``.

    Args:
        source: the scene.
        folder: to write into.
        progress: called once.
        quality: of the scene in it, see ``packed_scene``.
        seconds: how long the page takes from time 0 to time 1; None: see ``Source.lasts``.

    Returns:
        the facts for ``about.json``.

    Raises:
        ValueError: for a method without particles, naming the formats that it has.
    """
    text, facts = player_of(source, quality=quality, seconds=seconds)
    (folder / "scene.html").write_text(text, encoding="utf-8")
    progress(1, 1)
    return facts


def player_of(source: Source, *, quality: str = "compact", seconds: float | None = None) -> tuple[str, dict]:
    """Return the page of a scene, and the facts; see ``export_html``."""
    content, facts = packed_scene(source, "html", quality=quality, seconds=seconds)
    look = {"title": source.name, "poster": poster(source), "background": source.background}
    text = page(content, **look, framed=source.is_film)
    return text, facts


@torch.no_grad()
def poster(source: Source) -> Tensor:
    """Render what the page begins with: the first camera's image (H, W, 3) at time 0; of a film the camera
    that was there then.
    """
    first = min(range(len(source.cameras)), key=source.image_times.__getitem__) if source.is_film else 0
    camera = source.cameras[first]
    image = source.method.at(Moment(0.0)).render(View(camera), torch.tensor(source.background))
    return image.shaped(camera.height, camera.width).rgb


def page(
    content: bytes,
    *,
    title: str,
    poster: Tensor,
    background: tuple[float, float, float],
    framed: bool = False,
) -> str:
    """Return a page that plays a scene.

    Args:
        content: of ``scene.glb``.
        title: any text.
        poster: (H, W, 3) in [0, 1], shown until the scene runs, and where it cannot.
        background: behind the poster, sRGB in [0, 1].
        framed: it is a film, which is shown in its frame.
    """
    side, quality = _POSTER
    deflate = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS)
    motion, script = _scripts()
    parts = {
        "policy": _POLICY.format(scripts=" ".join(script_digests())),
        "title": html.escape(title),
        "style": _source("player.css"),
        "background": "rgb({:.0f} {:.0f} {:.0f})".format(*(255 * part for part in background)),
        "framed": ' class="framed"' * framed,
        "shape": f"{poster.shape[1] / poster.shape[0]:.4f}",
        "poster": "data:image/jpeg;base64," + _base64(jpeg_bytes(at_most(poster, side), quality)),
        "scene": _base64(deflate.compress(content) + deflate.flush()),
        "motion": motion,
        "script": script,
    }
    # In one pass, so that what is filled in is not searched again.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], _source("player.html"))


def _scripts() -> tuple[str, str]:
    """Return the page's scripts; the worker runs the first one, too."""
    return _source("motion.js"), "\n".join(map(_source, ("glb.js", "draw.js", "player.js")))


def script_digests() -> list[str]:
    """Return how a policy names the page's scripts: what encloses the page must allow them, too."""
    # Between its tags a script stands on lines of its own.
    digests = [hashlib.sha256(f"\n{script}\n".encode()).digest() for script in _scripts()]
    return [f"'sha256-{_base64(digest)}'" for digest in digests]


def _source(name: str) -> str:
    return (_PLAYER / name).read_text(encoding="utf-8")


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()
