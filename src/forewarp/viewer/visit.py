"""One page: what it looks at, and which picture it is given next."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

from torch import Tensor

from forewarp.scene.cloud import Ellipsoids
from forewarp.viewer.desk import Stale, Superseded
from forewarp.viewer.look import Look, first_look, vertical_fov
from forewarp.viewer.pace import Pace, Rate
from forewarp.viewer.player import Player
from forewarp.viewer.studio import Studio

FASTEST = 1 / 30  # seconds between two pictures while time plays
REST = 0.15  # seconds without a change after which the camera is at rest


class Surface(Protocol):
    """What a visit draws on."""

    def canvas(self) -> tuple[int, int]:
        """Return width and height of the page's picture, in pixels."""

    def show(self, picture: Tensor, *, rest: bool) -> None:
        """Show a picture (H, W, 3) in [0, 1], stretched over the canvas."""

    def splats(self, ellipsoids: Ellipsoids) -> None:
        """Let the browser draw Gaussians in the place of a picture."""

    def tell(self, text: str) -> None:
        """Say how fast pictures come."""

    def time_is(self, time: float) -> None:
        """Follow the time that plays."""

    def playing_is(self, playing: bool) -> None:
        """Follow whether it plays."""


class Visit:
    """A page's camera, time and choices; each change asks the desk for a picture.

    While something changes, pictures are small, so that about ten a second can be drawn; ``REST`` seconds
    after the last change the full one follows. All methods may be called from any thread.

    Args:
        studio: what is seen.
        surface: where it is shown.
        clock: gives seconds.
    """

    def __init__(
        self, studio: Studio, surface: Surface, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        self.studio, self.surface, self._clock = studio, surface, clock
        self.look = first_look(studio.scene)
        self.player, self._pace, self._rate = Player(), Pace(), Rate()
        self._lock = threading.RLock()
        self.drawn, self._told = 0, 0.0  # pictures so far; pictures a second
        self.gone = False

    def change(self, **what) -> None:
        """Change parts of the look. A new camera, time or choice leaves the training view it stood in."""
        if "time" in what:
            what["time"] = min(1.0, max(0.0, what["time"]))
        with self._lock:
            leaves = "stand" not in what and set(what) & {"pose", "time", "show"}
            self.look = replace(self.look, **({"stand": None} if leaves else {}), **what)
            if "time" in what and self.player.playing:
                self.player.play(self.look.time, self._clock())
        self.refresh()

    def stand(self, index: int | None) -> int | None:
        """Stand where a training image was taken, at its time, and compare; None: leave.

        Returns:
            the index, or the nearest that there is.
        """
        if index is None:
            self.change(stand=None)
            return None
        index = min(max(index, 0), len(self.studio.scene.train) - 1)
        frame = self.studio.scene.train[index]
        self.play(False)
        pose, fov = frame.camera.camera_to_world, vertical_fov(frame.camera)
        self.change(stand=index, pose=pose, fov=fov, time=frame.time)
        return index

    def play(self, playing: bool) -> None:
        """Let time pass, or stop it."""
        with self._lock:
            if playing:
                self.player.play(self.look.time, self._clock())
                self.look = replace(self.look, stand=None)
            else:
                self.player.pause()
        self.refresh()

    def set_speed(self, speed: float) -> None:
        """Change how fast time passes; 1 is ``player.WHOLE`` seconds for all of it."""
        with self._lock:
            self.player.set_speed(speed, self._clock())

    def follow(self, x: float, y: float) -> None:
        """Draw the trajectory of the point seen at ``x y``, fractions of the canvas, besides others."""

        def find(stale: Stale) -> None:
            look, (width, height) = self.look, self.full_size()
            if look.stand is not None or not self.studio.follows:
                return
            point = self.studio.point_at(look, x, y, width, height)
            if point is None:
                self.surface.tell("nothing solid there to follow; press the button again")
            else:
                self.change(followed=(*look.followed, (point, look.time)))

        self.studio.desk.ask((self, "point"), find)

    def refresh(self) -> None:
        """Ask for a picture of what is looked at now: small at once, whole at rest."""
        self.studio.desk.ask((self, "picture"), self._draw_moving)

    def leave(self) -> None:
        """Drop all that was asked for; the page is gone."""
        self.gone = True
        self.studio.desk.leave(self)

    def request(self, look: Look, urgency: int = 2, size: tuple[int, int] | None = None) -> Tensor:
        """Wait for the full picture (H, W, 3) of a look; not for the thread that serves the desk.

        Args:
            look: what is drawn; what a browser would draw is rendered.
            urgency: see ``Desk.ask``.
            size: width and height; None: those of the page at rest, ``full_size()``.

        Raises:
            Superseded: if the page has left, or everything ends.
            Exception: what went wrong while it was drawn.
        """
        done, found, failed = threading.Event(), [], []
        look = replace(look, show="colour") if look.by_browser else look

        def draw(stale: Stale) -> None:
            try:
                shown = self.studio.known(look)
                self.studio.prepare(shown)
                found.append(self.studio.picture(shown, *(size or self.full_size()), stale))
            except Exception as error:
                failed.append(error)
                raise
            finally:
                done.set()

        self.studio.desk.ask((self, draw), draw, urgency=urgency)
        while not done.wait(0.2) and not self.gone and not self.studio.desk.closed:
            pass
        if failed and not self.gone:
            raise failed[0]
        if self.gone or not found:
            raise Superseded
        return found[0]

    def full_size(self) -> tuple[int, int]:
        """Width and height of a picture at rest: the canvas's shape, with at most ``studio.size`` rows.

        On a slow machine the browser tells a canvas of half the pixels that it has.
        """
        width, height = self.surface.canvas()
        rows = max(1, min(2 * height, self.studio.size))
        return max(1, round(width * rows / height)), rows

    def _draw_moving(self, stale: Stale) -> None:
        if self.gone:  # it may have left after the last question
            return
        begun = self._clock()
        self._pass_time()
        self._keep_known()
        width, full = self.full_size()
        rows = self._pace.rows(self._kind, full)
        self._draw(max(1, round(width * rows / full)), rows, stale)
        if stale():
            return
        if self.player.playing:
            wait = max(0.0, FASTEST - (self._clock() - begun))
            self.studio.desk.ask((self, "picture"), self._draw_moving, after=wait)
        elif rows < full and not self.look.by_browser:
            self.studio.desk.ask((self, "picture"), self._draw_at_rest, urgency=1, after=REST)

    def _draw_at_rest(self, stale: Stale) -> None:
        if self.gone:
            return
        if self.player.playing:  # begun after this was asked for
            self._draw_moving(stale)
            return
        self._keep_known()
        width, rows = self.full_size()
        parts = 1 if self.look.show == "motion" else self._pace.parts(self._kind, width, rows)
        if parts > 1:
            self.surface.tell(f"{self._told:.1f} pictures/s | drawing {width} x {rows}")
        self._draw(width, rows, stale, parts, moving=False)

    def _pass_time(self) -> None:
        """Let the look follow the time that plays."""
        with self._lock:
            if not self.player.playing:
                return
            time = self.player.time(self._clock())
            self.look = replace(self.look, time=time)
            ended = not self.player.playing
        self.surface.time_is(time)
        if ended:
            self.surface.playing_is(False)

    def _keep_known(self) -> None:
        """Drop what the method of this stage cannot show."""
        if self.studio.subjects:
            with self._lock:
                self.look = self.studio.known(self.look)

    @property
    def _kind(self) -> tuple:
        look = self.look
        return look.show, look.tails, look.stand is not None

    def _draw(self, width: int, rows: int, stale: Stale, parts: int = 1, *, moving: bool = True) -> None:
        """Draw and show one picture; what the time alone needs does not count for the size of the next.

        The rate told is that of pictures while something moves; of a single one, what it took.
        """
        studio, look = self.studio, self.look
        if not studio.subjects:
            self.surface.tell(studio.note)
            return
        begun = self._clock()
        if look.by_browser:
            self.surface.splats(studio.subjects[0].ellipsoids(look.time))
            seconds, size = self._clock() - begun, "drawn by the browser, one colour from all sides"
        else:
            studio.prepare(look)
            prepared = self._clock()
            picture = studio.picture(look, width, rows, stale, parts)
            seconds = self._clock() - begun
            self._pace.drew(self._kind, rows, width * rows, self._clock() - prepared)
            if stale() and parts > 1:
                raise Superseded
            full = rows == self.full_size()[1]
            self.surface.show(picture, rest=full)
            size = f"{width} x {rows}, exact" + ("" if full else ", small while moving")
            if look.stand is not None:
                name = studio.scene.train[look.stand].name
                size += f" | training image {name}: truth, prediction, error"
        self.drawn += 1
        if moving:
            self._told = self._rate.drew(self._clock()) or 1 / max(seconds, 1e-3)
        note = f"{studio.note} | " if studio.note else ""
        self.surface.tell(f"{note}{self._told:.1f} pictures/s | {1000 * seconds:.0f} ms | {size}")
