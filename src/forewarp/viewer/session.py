"""One page's session: its camera, time and choices, the image it gets next, and its videos."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from forewarp.drawing.images import write_video
from forewarp.scene.cloud import Ellipsoids
from forewarp.viewer.queue import Cancelled, FrameRate, FrameRateControl
from forewarp.viewer.rendering import Viewer, ViewState, vertical_fov

MIN_INTERVAL = 1 / 30  # seconds between two images while time plays
REST_SECONDS = 0.15  # without a change, after which the camera is at rest
LEAN_SECONDS = 0.8  # for which a lean stays that nobody changes any more
_SPRING = 0.55  # of a lean is left from image to image
VIDEO_FPS = 25.0
WIDEST = 4  # columns of an image for each row of the largest
MIN_VIDEO_SECONDS, MAX_VIDEO_SECONDS = 0.1, 600.0


class Display(Protocol):
    """What a session shows its images on, as a browser's page."""

    def canvas(self) -> tuple[int, int]:
        """Return width and height of the place of the image, in pixels."""

    def show_image(self, image: Tensor, *, rest: bool) -> None:
        """Show an image (H, W, 3) in [0, 1], stretched over the canvas; ``rest``: it is the full one."""

    def show_splats(self, ellipsoids: Ellipsoids) -> None:
        """Draw Gaussians in the place of an image."""

    def tell(self, text: str) -> None:
        """Say how fast images come, or what is going on."""

    def show_time(self, time: float) -> None:
        """Show the time in [0, 1]."""

    def show_playing(self, playing: bool) -> None:
        """Show whether time plays."""

    def let_go(self) -> None:
        """Bring the camera that leans the view back to where it leans nothing."""


class Session:
    """A page's camera, time and choices; each change submits an image to the render queue.

    While something changes, images are small, so that about ten a second can be rendered; 0.15 seconds after
    the last change the full one follows. Stale images are cancelled; large ones render in chunks. All methods
    may be called from any thread.

    Args:
        viewer: what is seen.
        page: where it is shown, and how large.
        clock: gives seconds.
    """

    def __init__(self, viewer: Viewer, page: Display, clock: Callable[[], float] = time.perf_counter) -> None:
        self.viewer, self.page, self._clock = viewer, page, clock
        self.state, self._leant = ViewState.first(viewer.scene), 0.0
        if viewer.film is not None:
            self.state = replace(self.state, lean=(0.0, 0.0), time=0.0)
        self.playing, self.loop, self._speed, self._advanced = False, True, 1.0, 0.0
        self.rendered, self._rate = 0, 0.0  # images so far; images a second
        self._control, self._frame_rate = FrameRateControl(), FrameRate()
        self._lock = threading.RLock()
        self.closed = False

    def change(self, **changes) -> None:
        """Change parts of the state. A new camera, time, channel or layer leaves the training view."""
        if "time" in changes:
            changes["time"] = min(1.0, max(0.0, changes["time"]))
        if "training_view" not in changes and changes.keys() & {"pose", "time", "channel", "layer"}:
            changes["training_view"] = None
        with self._lock:
            self.state = replace(self.state, **changes)
            if "time" in changes:
                self._advanced = self._clock()
        self.refresh()

    def lean(self, across: float, upward: float, zoom: float) -> None:
        """Lean from the film's path by degrees, which spring back after a moment, and narrow its frame."""
        self._leant = self._clock()
        self.change(lean=(across, upward), zoom=zoom, training_view=None)

    def _spring_back(self) -> bool:
        """Let go of a part of a lean that nobody holds; return whether there is one, held or not."""
        with self._lock:
            lean = self.state.lean
            if lean is None or not any(lean):
                return False
            if self._clock() - self._leant >= LEAN_SECONDS:
                self.page.let_go()
                rest = tuple(_SPRING * part for part in lean)
                self.state = replace(self.state, lean=rest if max(map(abs, rest)) > 0.05 else (0.0, 0.0))
            return True

    def show_training_view(self, index: int | None) -> int | None:
        """Stand where a training image was taken, at its time, and compare; None: leave.

        Returns:
            the index, or the nearest that there is.
        """
        if index is None:
            self.change(training_view=None)
            return None
        index = min(max(index, 0), len(self.viewer.scene.train) - 1)
        frame = self.viewer.scene.train[index]
        self.playing = False
        pose, fov = frame.camera.camera_to_world, vertical_fov(frame.camera)
        self.change(training_view=index, pose=pose, fov=fov, time=frame.time)
        return index

    def play(self, playing: bool) -> None:
        """Let time pass, or stop it; at the end without ``loop`` it starts from the beginning."""
        with self._lock:
            if playing:
                time = 0.0 if self.state.time >= 1 and not self.loop else self.state.time
                self.state = replace(self.state, time=time, training_view=None)
            self.playing, self._advanced = playing, self._clock()
        self.refresh()

    def set_speed(self, speed: float) -> None:
        """Change how fast time passes; at speed 1 the whole time takes the ``viewer.seconds``."""
        with self._lock:
            self._advance()
            self._speed = speed

    def follow(self, x: float, y: float) -> None:
        """Also draw the trajectory of the point seen at ``x y``, fractions of the canvas."""

        def find() -> None:
            state, size = self.state, self.full_size()
            if state.training_view is not None or not self.viewer.can_follow:
                return
            point = self.viewer.point_at(state, x, y, *size)
            if point is None:
                self.page.tell("nothing solid there to follow; press the button again")
            else:
                self.change(followed=(*state.followed, (point, state.time)))

        self.viewer.queue.submit(self, "point", find)

    def refresh(self) -> None:
        """Ask for an image of the present state: a small one at once, the full one at rest."""
        self.viewer.queue.submit(self, "image", self._render)

    def close(self) -> None:
        """Cancel all that was asked for; the page is gone."""
        self.closed = True
        self.viewer.queue.cancel(self)

    def full_size(self) -> tuple[int, int]:
        """Width and height of an image at rest: the canvas's shape, with at most ``viewer.rows`` rows and
        ``WIDEST`` times as many columns, whatever a browser tells. A canvas narrower than the images, which
        shows more above and below them, has more rows, up to ``WIDEST`` times.

        On a slow machine the browser tells a canvas of half the pixels that it has.
        """
        width, height = self.page.canvas()
        most, narrow = WIDEST * self.viewer.rows, self.viewer.aspect * height / width
        rows = round(self.viewer.rows * min(WIDEST, max(1.0, narrow)))
        rows = max(1, min(2 * height, rows, most * height // width))
        return max(1, min(most, round(width * rows / height))), rows

    def _advance(self) -> None:
        """Move time on while it plays."""
        with self._lock:
            if not self.playing:
                return
            now = self._clock()
            time = self.state.time + self._speed * (now - self._advanced) / self.viewer.seconds
            self._advanced, self.playing = now, self.loop or time < 1
            self.state = replace(self.state, time=time % 1.0 if self.loop else min(time, 1.0))
        self.page.show_time(self.state.time)
        if not self.playing:
            self.page.show_playing(False)

    def _render(self, at_rest: bool = False) -> None:
        """Render and show an image, small while something changes, and ask for the next."""
        viewer, queue, begun = self.viewer, self.viewer.queue, self._clock()
        if self.closed:  # it may have left after its last request
            return
        if not viewer.renderers:
            self.page.tell(viewer.note)
            return
        self._advance()
        leaning = self._spring_back()
        with self._lock:
            state = viewer.supported(self.state)
            if state.lean is not None:
                camera = viewer.film.leant(state.time, *state.lean)
                state = replace(state, pose=camera.camera_to_world, fov=vertical_fov(camera))
            self.state = state
        moving = self.playing or not at_rest  # it may play since this was submitted
        width, full_rows = self.full_size()
        rows = full_rows
        if state.drawn_by_browser:
            method = viewer.renderers[0].method_of(state.layer)
            self.page.show_splats(method.ellipsoids(state.time))
            seconds, about = self._clock() - begun, "drawn by the browser, one colour from all sides"
        else:
            # How long an image takes says nothing of those of other kinds.
            kind = state.channel, state.trajectories, state.training_view is not None
            chunks = 1
            if moving:
                rows = self._control.rows(kind, full_rows)
                width = max(1, round(width * rows / full_rows))
            elif state.channel != "motion":
                chunks = self._control.chunks(kind, width, rows)
            if chunks > 1:
                self.page.tell(f"{self._rate:.1f} images/s | drawing {width} x {rows}")
            viewer.prepare(state)
            prepared = self._clock()  # what the time alone needs does not depend on the rows
            image = viewer.image(state, width, rows, chunks)
            seconds = self._clock() - begun
            self._control.record(kind, rows, width * rows, self._clock() - prepared)
            if chunks > 1 and queue.is_stale():
                raise Cancelled
            self.page.show_image(image, rest=rows == full_rows)
            about = f"{width} x {rows}, exact" + (", small while moving" if rows < full_rows else "")
            if state.training_view is not None:
                name = viewer.scene.train[state.training_view].name
                about += f" | training image {name}: truth, prediction, error"
            if beyond := viewer.beyond(state):
                trusted = f"the film shows up to {viewer.film.degrees:.0f}"
                about += f" | {beyond:.0f} degrees beside the film's camera: {trusted}"
        self.rendered += 1
        if moving:  # the rate of a single image is what it took
            self._rate = self._frame_rate.record(self._clock()) or 1 / max(seconds, 1e-3)
        note = f"{viewer.note} | " if viewer.note else ""
        self.page.tell(f"{note}{self._rate:.1f} images/s | {1000 * seconds:.0f} ms | {about}")
        if leaning and not self.playing and not queue.is_stale():
            wait = max(0.0, self._leant + LEAN_SECONDS - self._clock())
            queue.submit(self, "image", self._render, priority=1, delay=wait)
            return
        if not moving or queue.is_stale():
            return
        if self.playing:
            delay = max(0.0, MIN_INTERVAL - (self._clock() - begun))
            queue.submit(self, "image", self._render, delay=delay)
        elif rows < full_rows:
            queue.submit(self, "image", partial(self._render, True), priority=1, delay=REST_SECONDS)

    def image(self, state: ViewState, priority: int = 2, size: tuple[int, int] | None = None) -> Tensor:
        """Wait for the full image (H, W, 3) of a state; not for the thread that runs the queue.

        Args:
            state: what is shown; what a browser would draw is rendered.
            priority: see ``RenderQueue.submit``.
            size: width and height; None: those of the page at rest, ``full_size()``.

        Raises:
            Cancelled: if the page has left, or everything ends.
            Exception: what went wrong while it was rendered.
        """
        future, queue = Future(), self.viewer.queue
        state = replace(state, channel="colour") if state.drawn_by_browser else state

        def render() -> None:
            try:
                shown = self.viewer.supported(state)
                self.viewer.prepare(shown)
                future.set_result(self.viewer.image(shown, *(size or self.full_size())))
            except Exception as error:
                future.set_exception(error)
                raise

        queue.submit(self, future, render, priority=priority)
        while not (wait([future], 0.2).done or self.closed or queue.closed):
            pass
        if self.closed or not future.done():
            raise Cancelled
        return future.result()

    def write_video(
        self, folder: Path, keys: Sequence[ViewState], seconds: float, progress: Callable[[int, int], object]
    ) -> Path:
        """Write a video through key views into ``folder``, as ``path-<number>.mp4`` that is not there yet.

        Its images come from the queue, after what pages wait for; not for the thread that runs the queue.

        Args:
            folder: is made if need be.
            keys: see ``camera_path``.
            seconds: how long it plays; from 0.1 to 600, others become the nearest of these.
            progress: called with the images done, and of how many.

        Returns:
            the file.

        Raises:
            ValueError: for fewer than 2 keys.
            Cancelled: if the page leaves.
            Exception: what went wrong while an image was rendered. In all cases nothing is left behind.
        """
        seconds = min(MAX_VIDEO_SECONDS, max(MIN_VIDEO_SECONDS, seconds))
        states = camera_path(keys, max(2, round(seconds * VIDEO_FPS)))
        size = self.full_size()  # of all images, also where the window gets another size meanwhile

        def images() -> Iterator[Tensor]:
            for number, state in enumerate(states):
                progress(number, len(states))
                yield self.image(state, size=size)

        file = _new_file(folder)
        try:
            return write_video(file, images(), fps=VIDEO_FPS)
        except BaseException:
            file.unlink(missing_ok=True)
            raise


def camera_path(keys: Sequence[ViewState], number: int) -> list[ViewState]:
    """Make ``number`` states along a smooth path through key views, evenly spaced from first to last.

    Places follow a cubic spline, rotations a spline of rotations, both through every key; times and angles of
    view go monotonically from key to key. What else is shown is as in the key before.

    Raises:
        ValueError: for fewer than 2 keys or images.
    """
    from scipy.interpolate import CubicSpline, PchipInterpolator  # late, as their import takes time
    from scipy.spatial.transform import Rotation, RotationSpline

    if len(keys) < 2 or number < 2:
        raise ValueError(
            f"key views: expected at least 2, and 2 images of them, but got {len(keys)} key views and "
            f"{number} images; go to another view or time and add it"
        )
    key_poses = np.stack([key.pose.double().numpy() for key in keys])
    knots, positions = np.arange(len(keys)), np.linspace(0, len(keys) - 1, number)
    poses = np.tile(np.eye(4), (number, 1, 1))
    spline = CubicSpline if len(keys) > 2 else PchipInterpolator
    poses[:, :3, 3] = spline(knots, key_poses[:, :3, 3])(positions)
    rotations = RotationSpline(knots, Rotation.from_matrix(key_poses[:, :3, :3]))(positions)
    poses[:, :3, :3] = rotations.as_matrix()
    times = PchipInterpolator(knots, [key.time for key in keys])(positions).clip(0, 1)
    angles = PchipInterpolator(knots, [key.fov for key in keys])(positions)
    before = [keys[min(int(position + 1e-9), len(keys) - 1)] for position in positions]
    return [
        replace(key, pose=torch.from_numpy(pose), time=time, fov=fov, training_view=None, lean=None)
        for key, pose, time, fov in zip(before, poses, times.tolist(), angles.tolist())
    ]


def _new_file(folder: Path) -> Path:
    """Make an empty file of a number of its own, as another page may begin a video at the same time."""
    folder.mkdir(parents=True, exist_ok=True)
    numbers = count(1)
    while True:
        file = folder / f"path-{next(numbers)}.mp4"
        with suppress(FileExistsError):
            file.touch(exist_ok=False)
            return file
