"""The time that passes while a page plays."""

from __future__ import annotations

from dataclasses import dataclass

WHOLE = 4.0  # seconds in which the whole time passes at speed 1


@dataclass
class Player:
    """Let time run from 0 to 1, and begin again if ``loop``; at ``speed`` 1 it takes ``WHOLE`` seconds."""

    speed: float = 1.0
    loop: bool = True
    _since: tuple[float, float] | None = None  # when it was begun, and the time then

    @property
    def playing(self) -> bool:
        """Whether time runs."""
        return self._since is not None

    def play(self, time: float, now: float) -> None:
        """Begin at a time; at the end without ``loop``, from the beginning."""
        self._since = now, 0.0 if time >= 1 and not self.loop else time

    def pause(self) -> None:
        """Stop."""
        self._since = None

    def set_speed(self, speed: float, now: float) -> None:
        """Change the speed; what has passed stays passed."""
        if self.playing:
            time = self.time(now)
            self._since = None if self._since is None else (now, time)
        self.speed = speed

    def time(self, now: float) -> float:
        """Return the time; stop at the end if it does not begin again. Only while it plays.

        >>> player = Player(loop=False)
        >>> player.play(0.5, now=0.0)
        >>> player.time(1.0), player.time(3.0), player.playing
        (0.75, 1.0, False)
        """
        begun, start = self._since
        time = start + self.speed * (now - begun) / WHOLE
        if self.loop:
            return time % 1.0
        if time >= 1:
            self.pause()
        return min(time, 1.0)
