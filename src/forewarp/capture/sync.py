"""When each video of a rig began, told by what all of them heard.

A moment that two films heard is at t - o_a in one and t - o_b in the other, if they began at o_a and o_b. So
the lag at which their sound tracks are most alike is o_b - o_a; all pairs together tell all offsets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import fft

from forewarp.capture.frames import Progress

RATE, MOST = 8000, 300  # samples a second of what is heard, and seconds of a film that are listened to
_BAND = 80.0, 3600.0  # Hz: below are wind and handling, above is what microphones and codecs differ in
_HOP, _WINDOW, _BANDS = 40, 160, 6  # samples between two values of loudness, under each, bands of each
_REFINED, _BESIDE = 0.01, 0.05  # seconds: around a peak its finest place; from there on a peak is another
_SILENT = 1e-4  # of full scale, below which nothing is heard
_AGREE = 0.005  # seconds by which pairs may miss the offsets that they vote for
_SHARE, _SURE = 0.3, 2.0  # of pairs that agree; certainty of a pair that is believed without others
_FADE = 0.5  # seconds at the ends of a track, where it begins, which nobody heard; a tenth of it at most


@dataclass(frozen=True)
class Synchrony:
    """Offsets of N films.

    Attributes:
        offsets: (N,) seconds at which each began, the earliest at 0.
        certainty: (N,) of those pairs that agree, in the median: how many times higher the peak of their
            correlation is than the next; 1 is a guess.
        residual: (N,) seconds by which these pairs miss the offsets, root mean square.
        agreeing: (N,) how many of a film's N - 1 pairs agree.
        threes: (N,) in how many groups of three films whose pairs all agree each is.
    """

    offsets: np.ndarray
    certainty: np.ndarray
    residual: np.ndarray
    agreeing: np.ndarray
    threes: np.ndarray

    def is_sure(self) -> np.ndarray:
        """Tell of which films (N,) the offset is to be believed: three films agree about it, which many do by
        chance only if there are many, or its pairs are sure.
        """
        agree = (self.threes > 0) & (self.agreeing >= _SHARE * (len(self.offsets) - 1))
        return agree | ((self.agreeing > 0) & (self.certainty >= _SURE))


def is_silent(sound: np.ndarray) -> bool:
    """Tell whether a track has nothing to be heard."""
    return not len(sound) or float(np.abs(sound).max()) < _SILENT


def synchronise(sounds: Sequence[np.ndarray], progress: Progress = lambda *_: None) -> Synchrony:
    """Find when each of at least two films began.

    Args:
        sounds: of each, 8000 samples a second from its film's time 0 on.
        progress: called with pairs done and all.

    Sound takes 3 ms for a metre: a camera that is farther from what is heard seems to begin so much earlier.

    **Cost** for each pair, two inverse transforms of both tracks' length together: 0.1 s for films of half a
    minute, 2 s for those of five.
    """
    size = fft.next_fast_len(2 * max(map(len, sounds)), real=True)
    frames = fft.next_fast_len(2 * (max(map(len, sounds)) // _HOP + 1), real=True)
    waves = [fft.rfft(_faded(sound), size) for sound in sounds]
    onsets = [fft.rfft(_onsets(sound), frames) for sound in sounds]
    votes, pairs = {}, list(combinations(range(len(sounds)), 2))
    for done, (i, j) in enumerate(pairs, 1):
        votes[i, j] = _lag(waves[i], waves[j], size, onsets[i], onsets[j], frames)
        progress(done, len(pairs))
    return agreed(votes, len(sounds))


def _faded(sound: np.ndarray) -> np.ndarray:
    """Fade a track in and out: all begin and end, which is nothing that they heard."""
    fade = np.hanning(2 * min(round(_FADE * RATE), len(sound) // 10)).astype(np.float32)
    sound, half = sound.astype(np.float32), len(fade) // 2
    if half:
        sound[:half] *= fade[:half]
        sound[-half:] *= fade[half:]
    return sound


def _onsets(sound: np.ndarray) -> np.ndarray:
    """Measure by how much each of a few bands becomes louder (bands, S / hop), mean 0, deviation 1."""
    padded = np.pad(sound, (_WINDOW // 2, _WINDOW + _HOP))
    windows = np.lib.stride_tricks.sliding_window_view(padded, _WINDOW)[::_HOP][: len(sound) // _HOP + 1]
    power = np.abs(fft.rfft(windows * np.hanning(_WINDOW).astype(np.float32), axis=1)) ** 2
    edges = np.geomspace(2, power.shape[1], _BANDS + 1).round().astype(int)
    bands = np.stack([power[:, low:high].sum(1) for low, high in zip(edges, edges[1:])])
    loud = np.log(bands + 1e-3 * bands.mean(1, keepdims=True) + 1e-12)
    rises = np.maximum(np.diff(loud, axis=1, prepend=loud[:, :1]), 0)
    ends = round(_BESIDE * RATE / _HOP)
    rises[:, :ends] = rises[:, -ends:] = 0
    rises -= rises.mean(1, keepdims=True)
    return rises / np.maximum(rises.std(1, keepdims=True), 1e-12)


def _lag(first, second, size: int, onset_first, onset_second, frames: int) -> tuple[float, float]:
    """Find the lag in seconds at which the second film heard what the first did, and its certainty.

    What is alike is the wave, all frequencies counting alike (Knapp and Carter's phase transform), whose peak
    is sharp where both microphones heard one sound; and what becomes louder when, which echoes, other
    microphones and clocks of slightly other rates leave.
    """
    cross = np.conj(first) * second
    hertz = np.arange(len(cross)) * RATE / size
    cross *= (hertz >= _BAND[0]) & (hertz <= _BAND[1])
    wave = np.abs(fft.irfft(cross / np.maximum(np.abs(cross), 1e-20), size))
    # Lags of ``irfft`` go from 0 up and, at its end, from -1 down.
    count = frames // 2 * 2
    half = min(count // 2, (size // 2) // _HOP)
    lags = np.arange(-half, half)
    near = np.stack([wave[(lags * _HOP + k) % size] for k in range(-_HOP // 2, _HOP // 2)]).max(0)
    rise = fft.irfft((np.conj(onset_first) * onset_second).sum(0), frames)[lags % frames]
    alike = sum((one - one.mean()) / max(float(one.std()), 1e-12) for one in (near, rise))
    best = int(alike.argmax())
    beside = np.abs(np.arange(len(lags)) - best) * _HOP <= _BESIDE * RATE
    second_best = float(np.where(beside, -np.inf, alike).max())
    reach = np.arange(-round(_REFINED * RATE), round(_REFINED * RATE) + 1) + lags[best] * _HOP
    place = int(reach[wave[reach % size].argmax()])
    return -place / RATE, float(alike[best]) / max(second_best, 1e-12)


def agreed(votes: Mapping[tuple[int, int], tuple[float, float]], count: int) -> Synchrony:
    """Find the offsets that most pairs agree on.

    Args:
        votes: of pairs (i, j), offset j - offset i in seconds, and its certainty.
        count: of films.

    Offsets are tried as each film tells them of all others, and as the surest pairs do; those that most pairs
    agree with are fitted to them by least squares, until the same pairs agree.

    >>> votes = {(0, 1): (0.5, 3.0), (0, 2): (0.7, 3.0), (1, 2): (0.2, 3.0)}
    >>> votes |= {(0, 3): (0.1, 3.0), (1, 3): (-0.4, 3.0), (2, 3): (9.0, 1.1)}
    >>> agreed(votes, 4).offsets.round(6).tolist()
    [0.0, 0.5, 0.7, 0.1]
    """
    ends = np.array(list(votes))
    lags, certainty = np.array(list(votes.values())).T

    def misses(offsets: np.ndarray) -> np.ndarray:
        return offsets[ends[:, 1]] - offsets[ends[:, 0]] - lags

    def fitted(rows: np.ndarray) -> np.ndarray:
        """Fit the offsets to some pairs; those that these leave open are 0."""
        matrix = np.zeros((len(rows), count))
        matrix[np.arange(len(rows)), ends[rows, 1]], matrix[np.arange(len(rows)), ends[rows, 0]] = 1, -1
        weight = np.sqrt(np.minimum(certainty[rows], 10.0))
        return np.linalg.lstsq(matrix * weight[:, None], lags[rows] * weight, rcond=None)[0]

    order = np.argsort(-certainty, kind="stable")
    stars = [np.flatnonzero((ends == film).any(1)) for film in range(count)]
    tries = [fitted(rows) for rows in (_with_all((), order, ends, count), *stars)]
    offsets = max(tries, key=lambda offsets: int((np.abs(misses(offsets)) <= _AGREE).sum()))
    for _ in range(10):
        agree = np.flatnonzero(np.abs(misses(offsets)) <= _AGREE)
        agree = _with_all(agree, order, ends, count)
        offsets = fitted(agree)
    missed = misses(offsets)
    agree = np.abs(missed) <= _AGREE
    kept = [agree & (ends == film).any(1) for film in range(count)]
    linked = np.zeros((count, count), int)
    linked[tuple(ends[agree].T)] = 1
    linked += linked.T
    return Synchrony(
        offsets - offsets.min(),
        np.array([np.median(certainty[rows]) if rows.any() else 1.0 for rows in kept]),
        np.array([np.sqrt(np.mean(missed[rows] ** 2)) if rows.any() else 0.0 for rows in kept]),
        linked.sum(0),
        np.diag(linked @ linked @ linked) // 2,
    )


def _with_all(rows: Sequence[int], order: Sequence[int], ends: np.ndarray, count: int) -> np.ndarray:
    """Add pairs (M, 2) to some ``rows`` of them, in the order given, until they link all films; Kruskal's
    spanning tree where there are none to begin with.
    """
    chosen, parts = list(rows), list(range(count))
    for row in (*rows, *order):
        here, there = (parts[end] for end in ends[row])
        if here != there:
            parts = [here if part == there else part for part in parts]
            chosen += [] if row in chosen else [row]
    return np.array(chosen)
