"""``format=html``: one page that shows the scene through time, without a server."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from forewarp.browser import begin_at, silent, splat_arrays, vertical_fov
from forewarp.drawing.files import to_bytes
from forewarp.export.source import Progress, Source, tracks_of
from forewarp.scene.camera import Camera
from forewarp.scene.frame import spread
from forewarp.scene.paths import focus_point, mean_up

_ACROSS = 100.0  # units of the page across the cameras: squares of small lengths vanish in half precision
_TIMES = 12  # times that are kept while particles can be left out instead
_SPARE = 0.97  # share of the room that is planned for, as a page's size is only estimated
_FULL, _TRIES = 0.9, 4  # share of the room from which on a page will do; pages that are tried
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


class Show(NamedTuple):
    """N things that move. ``add(scene, time, rows)`` puts some of them (n,) into viser's scene, by the same
    name each time; ``part`` is what changes of them later; ``order`` (N,) are their rows, least needed last.
    """

    name: str
    add: Callable
    part: str
    order: Tensor


def export_html(
    source: Source, folder: Path, progress: Progress, *, points: int, seconds: float, megabytes: float
) -> dict:
    """Write ``scene.html``: viser's own page with a recording; particles are splats of one colour from all
    sides, voxels are points.

    Args:
        source: the scene and its times.
        folder: to write into.
        progress: told after each time.
        points: most points of a method without particles.
        seconds: that the recording lasts from time 0 to time 1.
        megabytes: most of the page; times, then particles are left out so that it fits.

    Returns:
        what ``about.json`` says of it; ``thinned`` if anything was left out.

    Raises:
        ValueError: for a method whose points cannot be followed, or if nothing fits.
    """
    source.refuse_without_tracks("html")
    show = _splats(source) if source.has_ellipsoids else _points(source, points)
    count, total, room = len(show.order), len(source.times), megabytes * 1e6
    some = [source.times[i] for i in spread(total, 2)]
    empty = len(page(source, show, [], show.order, seconds))
    each = (len(page(source, show, some, show.order, seconds)) - empty) / (len(some) * count)
    best = None
    for _ in range(_TRIES):
        rows, times = thinned(count, total, (_SPARE * room - empty) / each)
        if rows < 1:
            break
        kept = [source.times[i] for i in spread(total, times)]
        text = page(source, show, kept, show.order[:rows], seconds, progress)
        if len(text) <= room and (best is None or rows * times > best[0] * len(best[1])):
            best = rows, kept
            (folder / "scene.html").write_bytes(text)
            if (rows, times) == (count, total) or len(text) > _FULL * room:
                break
        each = (len(text) - empty) / (rows * times)  # times near each other take less room
    if best is None:
        raise ValueError(f"megabytes: expected room for the page, but got {megabytes}; raise it")
    rows, kept = best
    left_out = {"thinned": f"{rows} of {count} {show.name}, {len(kept)} of {total} times"}
    return {
        show.name: rows,
        "times on the page": kept,
        "seconds": seconds,
        "colors": "sRGB, as in the pictures, the mean over directions",
    } | (left_out if (rows, len(kept)) != (count, total) else {})


def thinned(count: int, times: int, room: float) -> tuple[int, int]:
    """Say how many of ``count`` things at how many ``times`` fit where there is room for ``room`` of one at
    one time: times are left out first, but not more than to 12.

    >>> thinned(100, 50, 5000), thinned(100, 50, 2000), thinned(100, 50, 600)
    ((100, 50), (100, 20), (50, 12))
    """
    kept = max(min(times, _TIMES), min(times, int(room / count)))
    return min(count, int(room / kept)), kept


def page(
    source: Source,
    show: Show,
    times: Sequence[float],
    rows: Tensor,
    seconds: float,
    progress: Progress = lambda done, of: None,
) -> bytes:
    """Record what ``show`` shows at some times; return the page."""
    import viser

    with silent():  # viser records nothing without a server
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        _look(server, list(source.cameras))
        behind = to_bytes(torch.tensor(source.background)[None, None])
        server.scene.set_background_image(behind, format="png")
        packed = []
        for done, time in enumerate(times, 1):
            handle = show.add(server.scene, time, rows)
            packed.append(getattr(handle, show.part).copy())  # viser writes later values into its own
            progress(done, len(times))
        if packed:
            setattr(handle, show.part, packed[0])
        recording = server.get_scene_serializer()
        for k in range(1, len(times)):
            recording.insert_sleep((times[k] - times[k - 1]) * seconds)
            setattr(handle, show.part, packed[k])
        if len(times) > 1:
            recording.insert_sleep((times[-1] - times[0]) * seconds / (len(times) - 1))
        return recording.as_html().replace("<head>", f"<head>{WORKERS}", 1).encode()
    finally:
        with silent():
            server.stop()


def _look(server, cameras: list[Camera]) -> None:
    """Begin where the first camera stood, with the scene upright."""
    camera, pose = cameras[0], cameras[0].camera_to_world
    begin_at(server, pose, vertical_fov(camera), focus_point(cameras), mean_up(cameras), camera.far)
    server.initial_camera.near, server.initial_camera.far = 0.01 * camera.far, 10 * camera.far


def _splats(source: Source) -> Show:
    """Particles as splats; those that cover little are needed least."""
    clouds = [source.method.ellipsoids(source.times[i]) for i in spread(len(source.times), _TIMES)]
    long = clouds[0].covariances.diagonal(dim1=-2, dim2=-1).sum(-1)
    cover = long * torch.stack([cloud.opacity for cloud in clouds]).amax(0)
    unit = _unit(source.cameras)

    def add(scene, time: float, rows: Tensor):
        arrays = splat_arrays(source.method.ellipsoids(time)[rows], unit)
        return scene.add_gaussian_splats("/scene", *arrays, scale=unit)

    return Show("particles", add, "buffer", cover.argsort(descending=True))


def _points(source: Source, count: int) -> Show:
    """Points of the surface; evenly spread ones come first."""
    tracks = tracks_of(source, count)
    colors = tracks.colors[0].numpy()

    def add(scene, time: float, rows: Tensor):
        places = tracks.positions[list(source.times).index(time)][rows].numpy()
        options = {"point_size": tracks.size, "point_shape": "circle", "precision": "float32"}
        return scene.add_point_cloud("/scene", places, colors[rows.numpy()], **options)

    return Show("points", add, "points", torch.arange(len(tracks)))


def _unit(cameras: Sequence[Camera]) -> float:
    """World units that are one unit of the page."""
    centers = torch.stack([camera.center for camera in cameras])
    across = float((centers.amax(0) - centers.amin(0)).norm())
    return max(across, cameras[0].far) / _ACROSS
