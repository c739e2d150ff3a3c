"""``format=html``: one page that shows the scene through time, without a server."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from forewarp.browser import begin_at, silent, splat_arrays, vertical_fov
from forewarp.drawing.images import to_bytes
from forewarp.export.tracks import Progress, Source, no_progress, tracks_of
from forewarp.scene.camera import focus_point, mean_up
from forewarp.scene.frame import spread

_PAGE_SIZE = 100.0  # units of the page across the cameras: squares of small lengths vanish in half precision
_MIN_TIMES = 12  # times that are kept while particles can be left out instead
_PLANNED = 0.97  # share of the bytes that is planned for, as a page's size is only estimated
_FULL_ENOUGH, _ATTEMPTS = 0.9, 4  # share of the bytes from which on a page will do; pages that are tried
# Splats are sorted by a worker, whose code lies at a "blob:" address; browsers refuse that to a page that was
# opened as a file, and take it from a "data:" address.
WORKERS = """<script>if (location.protocol === "file:") {
  const Plain = Worker;
  window.Worker = class extends Plain {
    constructor(place, options) {
      const code = new XMLHttpRequest();
      code.open("GET", place, false);
      code.send();
      super("data:text/javascript;charset=utf-8," + encodeURIComponent(code.responseText), options);
    }
  };
}</script>"""


class Layer(NamedTuple):
    """N particles or points that a page shows, ``kind`` of the two.

    ``add(scene, time, rows)`` puts ``rows`` (n,) of them into viser's scene, under the same name each time;
    ``varying`` is the attribute that a later time changes; ``order`` (N,) are the rows, most needed first.
    """

    kind: str
    add: Callable
    varying: str
    order: Tensor


def export_html(
    source: Source, folder: Path, progress: Progress, *, points: int, seconds: float, megabytes: float
) -> dict:
    """Write ``scene.html``: viser's own page with a recording; particles are splats of one colour from all
    sides, voxels are points.

    Args:
        source: the scene and its times.
        folder: to write into.
        progress: called after each time.
        points: most points of a method without particles.
        seconds: duration of the recording from time 0 to time 1.
        megabytes: most of the page; times, then particles are left out so that it fits.

    Returns:
        the facts for ``about.json``; ``thinned`` if anything was left out.

    Raises:
        ValueError: if nothing fits.
    """
    layer = _splats(source) if source.has_ellipsoids else _points(source, points)
    count, total, limit = len(layer.order), len(source.times), megabytes * 1e6
    two_times = [source.times[i] for i in spread(total, 2)]
    empty = len(page(source, layer, [], layer.order, seconds, no_progress))
    full = len(page(source, layer, two_times, layer.order, seconds, no_progress))
    bytes_each = (full - empty) / (len(two_times) * count)
    rows, kept = 0, []
    for _ in range(_ATTEMPTS):
        fitting, times = thinned(count, total, (_PLANNED * limit - empty) / bytes_each)
        if fitting < 1:
            break
        chosen = [source.times[i] for i in spread(total, times)]
        text = page(source, layer, chosen, layer.order[:fitting], seconds, progress)
        if len(text) <= limit and fitting * times > rows * len(kept):
            rows, kept = fitting, chosen
            (folder / "scene.html").write_bytes(text)
            if (rows, times) == (count, total) or len(text) > _FULL_ENOUGH * limit:
                break
        bytes_each = (len(text) - empty) / (fitting * times)  # times near each other compress better
    if not rows:
        raise ValueError(f"megabytes: expected room for the page, but got {megabytes}; raise it")
    facts = {
        layer.kind: rows,
        "times on the page": kept,
        "seconds": seconds,
        "colors": "sRGB, as in the images, the mean over directions",
    }
    if (rows, len(kept)) != (count, total):
        facts["thinned"] = f"{rows} of {count} {layer.kind}, {len(kept)} of {total} times"
    return facts


def thinned(count: int, times: int, capacity: float) -> tuple[int, int]:
    """Return how many of ``count`` particles at how many ``times`` fit, where ``capacity`` particles fit in
    all; times are left out first, but not below 12.

    >>> thinned(100, 50, 5000), thinned(100, 50, 2000), thinned(100, 50, 600)
    ((100, 50), (100, 20), (50, 12))
    """
    kept = max(min(times, _MIN_TIMES), min(times, int(capacity / count)))
    return min(count, int(capacity / kept)), kept


def page(
    source: Source, layer: Layer, times: Sequence[float], rows: Tensor, seconds: float, progress: Progress
) -> bytes:
    """Return a page that plays ``rows`` of a layer at some times, and begins at the first camera."""
    import viser

    cameras = list(source.cameras)
    first = cameras[0]
    with silent():  # viser records nothing without a server
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        pose, fov = first.camera_to_world, vertical_fov(first)
        begin_at(server, pose, fov, focus_point(cameras), mean_up(cameras), first.far)
        server.initial_camera.near, server.initial_camera.far = 0.01 * first.far, 10 * first.far
        background = to_bytes(torch.tensor(source.background)[None, None])
        server.scene.set_background_image(background, format="png")
        states = []
        for done, time in enumerate(times, 1):
            handle = layer.add(server.scene, time, rows)
            states.append(getattr(handle, layer.varying).copy())  # viser overwrites its own array later
            progress(done, len(times))
        if states:
            setattr(handle, layer.varying, states[0])
        recording = server.get_scene_serializer()
        for before, time, state in zip(times, times[1:], states[1:]):
            recording.insert_sleep((time - before) * seconds)
            setattr(handle, layer.varying, state)
        if len(times) > 1:  # the last time is shown as long as the others on average
            recording.insert_sleep((times[-1] - times[0]) * seconds / (len(times) - 1))
        return recording.as_html().replace("<head>", f"<head>{WORKERS}", 1).encode()
    finally:
        with silent():
            server.stop()


def _splats(source: Source) -> Layer:
    """Show particles as splats; those that cover little are needed least."""
    clouds = [source.method.ellipsoids(source.times[i]) for i in spread(len(source.times), _MIN_TIMES)]
    size = clouds[0].covariances.diagonal(dim1=-2, dim2=-1).sum(-1)
    cover = size * torch.stack([cloud.opacity for cloud in clouds]).amax(0)
    centers = torch.stack([camera.center for camera in source.cameras])
    extent = float((centers.amax(0) - centers.amin(0)).norm())
    unit = max(extent, source.cameras[0].far) / _PAGE_SIZE

    def add(scene, time: float, rows: Tensor):
        arrays = splat_arrays(source.method.ellipsoids(time)[rows], unit)
        return scene.add_gaussian_splats("/scene", *arrays, scale=unit)

    return Layer("particles", add, "buffer", cover.argsort(descending=True))


def _points(source: Source, count: int) -> Layer:
    """Show points of the surface; evenly spread ones come first."""
    tracks = tracks_of(source, count)
    colors = tracks.colors[0].numpy()

    def add(scene, time: float, rows: Tensor):
        places = tracks.positions[list(source.times).index(time)][rows].numpy()
        options = {"point_size": tracks.size, "point_shape": "circle", "precision": "float32"}
        return scene.add_point_cloud("/scene", places, colors[rows.numpy()], **options)

    return Layer("points", add, "points", torch.arange(len(tracks)))
