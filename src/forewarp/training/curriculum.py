"""Which frames a step may see: the nearest to the canonical time first, then one more and one more."""

from __future__ import annotations

import math

import torch


class Curriculum:
    """Progressive frames. Call it for the index of the next training frame.

    Times come in evenly with the fraction of the stage that is done, each with all its frames, so a run
    bounded by time has seen them all as well. A share of the draws goes to the newest, whose motion is still
    unknown.

    Args:
        times: of every training frame.
        canonical_time: where training starts.
        start: distinct times in play at the beginning.
        all_in: fraction of the stage at which all are in play; 0: from the start.
        most: times that ever come in; null: all.
        newest_share: share of the draws that goes to the newest part.
        newest_part: that part, as a share of the frames in play.
        error_share: share of the draws in which a frame's chance is its own last error, told by ``report``:
            the ends of a sequence are hard, and one in two hundred frames has little say.
        seed: of the draws.
    """

    def __init__(
        self,
        times: list[float],
        canonical_time: float,
        *,
        start: int = 10,
        all_in: float = 0.6,
        most: int | None = None,
        newest_share: float = 0.3,
        newest_part: float = 0.125,
        error_share: float = 0.0,
        seed: int = 0,
    ) -> None:
        shares = all(0 <= share <= 1 for share in (all_in, newest_share, error_share))
        if not (start >= 1 and shares and 0 < newest_part <= 1):
            raise ValueError(
                "stage.curriculum: expected start >= 1, all_in, newest_share and error_share in [0, 1] and "
                f"newest_part in (0, 1], but got {start=}, {all_in=}, {newest_share=}, {error_share=}, "
                f"{newest_part=}"
            )
        self.canonical_time = canonical_time
        self.order = sorted(range(len(times)), key=lambda i: (abs(times[i] - canonical_time), times[i], i))
        last_of_time = {times[i]: place for place, i in enumerate(self.order)}
        self._ends = [place + 1 for place in last_of_time.values()]  # frames, once so many times are in
        if most is not None:
            if most < 1:
                raise ValueError(f"stage.curriculum.most: expected at least 1 or null, but got {most}")
            self._ends = self._ends[:most]
        self.start, self.all_in = min(start, len(self._ends)), all_in
        self.newest_share, self.newest_part = newest_share, newest_part
        self.error_share = error_share
        self.errors = torch.full((len(times),), float("nan"))
        self.fraction = 0.0
        self.generator = torch.Generator().manual_seed(seed)

    @property
    def in_play(self) -> int:
        """How many frames may be drawn now."""
        done = 1.0 if self.all_in == 0 else min(1.0, self.fraction / self.all_in)
        return self._ends[self.start + int((len(self._ends) - self.start) * done) - 1]

    def frames(self) -> list[int]:
        """The frames in play, nearest to the canonical time first."""
        return self.order[: self.in_play]

    def __call__(self) -> int:
        """The next training frame."""
        playing = self.in_play
        if self.error_share > 0 and float(torch.rand((), generator=self.generator)) < self.error_share:
            return self._by_error()
        newest = max(1, int(playing * self.newest_part))
        growing = playing < len(self.order)
        favour = growing and float(torch.rand((), generator=self.generator)) < self.newest_share
        low = playing - newest if favour else 0
        return self.order[int(torch.randint(low, playing, (), generator=self.generator))]

    def report(self, frame: int, error: float) -> None:
        """Tell the squared error of a frame just trained on; one that is not finite tells nothing."""
        if not math.isfinite(error):
            return
        before = float(self.errors[frame])
        self.errors[frame] = error if before != before else 0.5 * (before + error)

    def _by_error(self) -> int:
        frames = self.order[: self.in_play]
        errors = self.errors[frames]
        known = errors[~errors.isnan()]
        # A frame not yet seen counts as the worst one.
        chance = torch.nan_to_num(errors, nan=float(known.max()) if len(known) else 1.0) + 1e-8
        return frames[int(torch.multinomial(chance, 1, generator=self.generator))]

    def state_dict(self) -> dict:
        """The draws' generator and the fraction done."""
        return {
            "generator": self.generator.get_state(),
            "fraction": self.fraction,
            "errors": self.errors.clone(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Continue where ``state_dict`` was taken."""
        self.generator.set_state(state["generator"])
        self.fraction = state["fraction"]
        self.errors = state["errors"].clone()
