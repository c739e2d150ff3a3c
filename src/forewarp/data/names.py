"""Read times and cameras from the names of images, or refuse names that can be read in two ways."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import partial
from itertools import accumulate, pairwise
from statistics import median
from typing import NamedTuple

import numpy as np

from forewarp.data.files import SceneError, mismatch

KEY = "set data.name_pattern (of forewarp-capture: name_pattern) to a regular expression with a group"
KEY += " 'frame' or 'time', or 'year', 'month', 'day', and 'camera' for a rig"
# A number in a name; or what several of its parts say together, marked by a zero byte on both sides.
_NUMBER = "(\0[^\0]+\0|\\d+)"
_DECIMAL = "(\0[^\0]+\0|(?<!\\d)\\d\\d\\.\\d{3}(?!\\.?\\d)|(?<![\\d.])\\d+(?:\\.\\d+)?(?!\\.?\\d))"
# Seconds with a fraction: Unix time, as of TUM's data or ROS; or a whole name with 6 or 9 digits of it.
_STAMP = re.compile(r"(?<![\d\0])\d{9,10}\.\d+|(?<![^/])\d+\.(?:\d{6}|\d{9})(?=$|\.[A-Za-z])")
_STOPWATCH = re.compile(r"(?<!\d)(\d\d?)h(\d\d)m(\d\d)s(\d{3})?(?!\d)")  # as media players write it
_SECONDS_NANOSECONDS = re.compile(r"(?<!\d)(\d{9,10})[_-](\d{9})(?!\d)")
# Date and time of day as phones, screenshots and loggers write them.
_HALF, _IS_HALF = r"[\s_-]?(?P<half>[AaPp])\.?[Mm]\b\.?", r"[\s_-]?[AaPp]\.?[Mm]\b"
_FRACTION = r"(?:[.,]?(?P<f>\d{3}|\d{6}|\d{9}))?"
_PACKED = rf"(?P<H>\d\d)(?P<M>\d\d)(?:(?P<S>\d\d){_FRACTION})?(?:{_HALF})?(?!\d)"
_APART = rf"(?P<H>\d\d?)(?P<c>[-_.:])(?P<M>\d\d)(?:(?P=c)(?P<S>\d\d){_FRACTION}|(?={_IS_HALF}))"
_APART += rf"(?:{_HALF})?(?!\d)"
_OF_DATE = {"Y": r"(?P<Y>(?:19|20)\d\d)", "y": r"(?P<y>[0-4]\d)", "m": r"(?P<m>\d\d)", "d": r"(?P<d>\d\d)"}


def _date(order: str, behind: str, between: str = r"[-_.]|(?<=\d\d)") -> re.Pattern:
    """Make the pattern of a date, ``order`` as ``dmY``, of what is ``between`` its parts and ``behind``."""
    first, second, third = (_OF_DATE[part] for part in order)
    if order in ("dmY", "mdY"):  # 4.11.2023
        first, second = (part.replace(r"\d\d", r"\d\d?") for part in (first, second))
    return re.compile(rf"(?<![\d\0]){first}(?P<sep>{between}){second}(?P=sep){third}{behind}")


_TIME_OF_DAY, _COUNTER = "times of day", "a counter"
_WITH_TIME = rf"(?: at |,? |[-_T.])?{_PACKED}", rf"(?: at |,? |[-_T.]){_APART}"
_DATED = [_date("Ymd", behind) for behind in _WITH_TIME]  # which nothing else can be
# Words before a number that say what it counts.
_FRAME_WORD = re.compile(r"(?i)(?:^|[^a-z])(frame|time|t)[_-]?$")
_CAMERA_WORD = re.compile(r"(?i)(?:^|[^a-z])(cam|camera|view|sensor|c|v)[_( -]*$")
# A camera's, before one or two digits; C0001 is a clip.
_LETTER_WORD = re.compile(r"(?i)(?:^|[^a-z])[cv][_( -]*$")
# Those before the number of a film, as cameras count them, or of a part of one.
_FILM_WORD = re.compile(
    r"(?i)(?:^|[^a-z])(c|gx|gh|gopr|gp|mvi|dsc|img|vid|mov|dji|clip|part|chapter|take|seg|seq|sequence|shot"
    r"|session|run|trial)[_-]?$"
)
_FRAME = re.compile(r"(?i)(?:^|[^a-z])frame[_-]?$")
# Behind a film's number, up to the next number.
_OF_FILM = re.compile(r"(?i)^\.(mp$|m$|mov|mkv|avi|mts|webm)")
_SPLIT_WORD = re.compile(r"(?i)(?:^|/)(train|val|valid|validation|eval|test)\b")
_OF_TIME = re.compile(r"(?:(\d+)[h:_.-])?(\d{1,2})[m:_.-](\d\d(?:[.,]\d+)?)s?")  # of a group ``time``
_EXPONENT = re.compile(r"\d\.\d*[eE][-+]?\d")
_HEXADECIMAL = re.compile(r"[0-9a-f]+|[0-9A-F]+")
_ODD = 0.2  # share of the names that may have another form than all others, and are then named in the error
_GAPS = 4  # span of a counter with gaps, in numbers that are there, at most
_ROUNDING = 1e-6  # of steps that are even
_LEAST_WORDS = 4  # different texts beside the numbers, from which on these may tell nothing
_FEW = 4  # names below which a plain counter may look like a time by chance
_EVEN, _UNEVEN = 0.5, 4.0  # longest step by the shortest, less 1: at most, times that of the best reading
_SAME_TIMES = 0.25  # of the shortest step, by which times of two readings may differ that mean one thing
_RATES = (24, 25, 30, 50, 60)  # frames a second of time codes
_SHORT = 0.25  # of the time since a clock began, that a film lasts at most
_CALENDAR = ("year", "month", "day", "hour", "minute", "second")  # groups of a pattern
_LEAST_STEPS, _FEW_STEPS = 5, 3  # which are even by no chance; of plain counters, the most usual names
_MOST_DIGITS = 40  # of a time with its fraction
_SKIPPED = 4  # numbers at most that time codes leave out at the beginning of a minute
_CARRY = 3.0  # steps of the last number from its end and its beginning within which it is carried over
_ODD_ALONE = 4  # images of a camera from which on one of a single image is an odd name
_SAME_FRAMES = 0.8  # share of all frame numbers that each camera must have where no word tells the camera
_SPAN = 0.8  # share of the whole sequence that each camera's, or each split's, frame numbers must span
_COUNTER_DIGITS = 3  # from which a counter may begin anew after its last number
_ONE_PATH, _JUMPS = 3.0, 8.0  # steps from camera to camera, in steps of one camera: at most, at least
_STILL = 1e-3  # of all positions' extent: a camera that moves less stands
_STEP = 0.3  # of all positions' extent: longer steps are no path's
LEAST_SPAN, _MOST_FAR = 0.05, 0.1  # of all times: less is hardly what was meant; share that may be wrong


def in_order(things: Iterable, name: Callable[..., str] = str) -> list:
    """Sort things by their names, numbers within them by value.

    >>> in_order(["b2", "b10", "a"])
    ['a', 'b2', 'b10']
    """
    return sorted(things, key=lambda thing: name_parts(name(thing)))


def name_parts(name: str) -> list[str | float]:
    """Split a name into text, at even places, and numbers; seconds such as 1305031102.1753 are one number,
    and so are date and time of day, as phones write them.

    >>> name_parts("cam1/007"), name_parts("rgb/1305031102.1753"), name_parts("12.345678.png")
    (['cam', 1, '/', 7, ''], ['rgb/', 1305031102.1753, ''], ['', 12.345678, '.png'])
    >>> name_parts("PXL_20240501_235959500"), name_parts("2024-05-02_00-00-00")
    (['PXL_', 1714607999.5, ''], ['', 1714608000.0, ''])
    """
    parts = _split(_in_seconds(name))
    parts[1::2] = (float(part) if "." in part else int(part) for part in parts[1::2])
    return parts


def _split(name: str) -> list[str]:
    """Split a name into text, at even places, and numbers."""
    parts = re.split(_NUMBER, name)
    parts[1::2] = (part.strip("\0") for part in parts[1::2])
    return parts


def _in_seconds(name: str) -> str:
    """Mark what nothing else can be: date and time of day, stopwatches, and seconds with a fraction."""
    for pattern in _DATED:
        name = pattern.sub(lambda match: _marked(_instant(match)) or match[0], name)
    name = _SECONDS_NANOSECONDS.sub("\0\\1.\\2\0", _STOPWATCH.sub(_milliseconds, name))
    return _STAMP.sub("\0\\g<0>\0", name)


def _marked(seconds: float | None) -> str | None:
    return None if seconds is None else f"\0{seconds:.9f}\0"


def _instant(match: re.Match) -> float | None:
    """Return the seconds since 1970 of a date, with the time of day where it has one; None where there is no
    such date, or too few digits to tell.
    """
    part = match.groupdict()
    is_whole = part["sep"] or len(part["m"]) + len(part["d"]) == 4
    is_short = part.get("y") and part.get("H") and not part["S"]
    if not is_whole or is_short:
        return None
    year = int(part.get("Y") or 2000 + int(part["y"]))
    try:
        day = datetime(year, int(part["m"]), int(part["d"]), tzinfo=timezone.utc)
    except ValueError:
        return None
    seconds = _of_day(match) if part.get("H") else 0.0
    return None if seconds is None else day.timestamp() + seconds


def _of_day(match: re.Match) -> float | None:
    """Return the seconds since midnight of a time of day; None where there is no such time."""
    part = match.groupdict()
    hour, minute, second = (int(part[key] or 0) for key in "HMS")
    if half := part.get("half"):
        hour = hour % 12 + 12 * (half in "Pp")
    fraction = float(f"0.{part.get('f') or 0}")
    return (hour * 60 + minute) * 60 + second + fraction if hour < 24 and max(minute, second) < 60 else None


def _of_code(match: re.Match, rate: int) -> float | None:
    """Return the number of a frame by its time code; None where there is no such one."""
    hour, minute, second, frame = map(int, match.groups())
    is_code = hour < 24 and max(minute, second) < 60 and frame < rate
    return ((hour * 60 + minute) * 60 + second) * rate + frame if is_code else None


def _milliseconds(match: re.Match) -> str:
    hours, minutes, seconds, thousandths = (int(part or 0) for part in match.groups())
    return f"\0{((hours * 60 + minutes) * 60 + seconds) * 1000 + thousandths}\0"


_ORDERS = {
    "Ymd": "dates that begin with the year",
    "dmY": "dates that begin with the day",
    "mdY": "dates that begin with the month",
    "ymd": "dates that begin with two digits of the year",
    "dmy": "dates that begin with the day and end with two digits of the year",
    "mdy": "dates that begin with the month and end with two digits of the year",
}
_TIME_CODE = re.compile(r"(?<![\d\0])(\d\d)(\d\d)(\d\d)(\d\d)(?!\d)")
# What three numbers of two digits, one after the other, may be, too.
_CHAINS = [
    (what, _date(order, r"(?!\d)", "[-_.]"), _instant) for order, what in _ORDERS.items() if "y" in order
]
_APART_CODE = re.compile(r"(?<!\d)\d\d([-_.:])\d\d\1\d\d[-_.:;]\d\d(?!\d)")
# What numbers of a name may say together, and how it is read.
_FORMS: list[tuple[str, re.Pattern, Callable[[re.Match], float | None]]] = [
    (_TIME_OF_DAY, re.compile(rf"(?<![\d\0])(?=\d{{6}}){_PACKED}"), _of_day),
    (_TIME_OF_DAY, re.compile(rf"(?<![\d\0])(?=[-_.:\d]+{_IS_HALF}){_APART}"), _of_day),
    *((what, _date(order, behind), _instant) for order, what in _ORDERS.items() for behind in _WITH_TIME),
    *(
        (what, _date(order, r"(?!\d)", r"[-_.]|(?<=\d\d)" if "Y" in order else ""), _instant)
        for order, what in _ORDERS.items()
    ),
    *((f"time codes of {rate} frames a second", _TIME_CODE, partial(_of_code, rate=rate)) for rate in _RATES),
]


class NameNumbers(NamedTuple):
    """What names say: ``frames``, a number each, in any unit; ``cameras``, None without a rig; ``how`` they
    were read, in words.
    """

    frames: list[float]
    cameras: list[str] | None
    how: str

    @property
    def times(self) -> list[float]:
        """The frames scaled to [0, 1]."""
        first, last = min(self.frames), max(self.frames)
        return [(frame - first) / ((last - first) or 1) for frame in self.frames]


@dataclass(frozen=True)
class _Reading:
    """A way to read names: ``frames`` as numbers, of ``cameras`` (names that are equal in it are of one)."""

    what: str
    frames: list[float]
    cameras: list[tuple]

    @property
    def groups(self) -> list[set[float]]:
        """Frame numbers of each camera."""
        found: dict[tuple, set[float]] = {}
        for camera, frame in zip(self.cameras, self.frames):
            found.setdefault(camera, set()).add(frame)
        return list(found.values())

    @property
    def is_unique(self) -> bool:
        """Whether no camera has a frame number twice."""
        return sum(map(len, self.groups)) == len(self.frames)

    @property
    def is_shared(self) -> bool:
        """Whether several cameras have nearly the same frame numbers."""
        share = min(map(len, self.groups)) / len({*self.frames})
        return len(self.groups) > 1 and len({*self.frames}) < len(self.frames) and share >= _SAME_FRAMES

    @property
    def is_apart(self) -> bool:
        """Whether one camera's frame numbers end before the next one's begin."""
        ends = sorted((min(group), max(group)) for group in self.groups)
        return all(high < low for (_, high), (low, _) in pairwise(ends))


def read_names(
    names: Sequence[str],
    where: str,
    pattern: str | None = None,
    views: Sequence[Sequence[float]] | None = None,
    one_camera: bool = False,
) -> NameNumbers | None:
    """Read a frame number or a time from each name, if there is one way to read them.

    Args:
        names: paths of the images without suffix, ``cam01/0003``; of all splits together.
        where: what the names are of, for errors.
        pattern: regular expression with a group ``time`` (a number, or a time of day as 10-05-30),
            ``frame``, or ``year``, ``month``, ``day``, ``hour``, ``minute`` and ``second`` (any of them),
            and ``camera`` for a rig, ``part`` for films one after the other, that is found in every name;
            None: see the rules below.
        views: a row of numbers for each image, near where cameras stand and look alike, such as their
            positions; they tell cameras of a rig from parts of one film.
        one_camera: took all images: several numbers are of one film.

    Returns:
        the numbers; None where names have no number that varies, or have one twice and no other.

    Raises:
        SceneError: for a pattern that is none, lacks a group or misses a name; and without a pattern for
            names of which one has another form, or that may be read in several ways, naming these.

    Rules without a pattern: date and time of day, and ``seconds.fraction``, are one number, and where they
    vary they are the time. A number after ``frame`` or ``time`` is the frame's, one after ``cam``, ``view``
    or ``sensor`` the camera's. Of several other numbers one counts frames and the rest tell cameras if all
    cameras have nearly the same frame numbers and stand, or move in much shorter steps than the other way
    round; all numbers together order one film if the positions continue one path, or if the last number
    grows from part to part.

    >>> read_names(["a/0001", "a/0003", "b/0001", "b/0003"], "t.json").frames
    [1.0, 3.0, 1.0, 3.0]
    """
    if pattern is not None:
        return _by_pattern(names, where, pattern)
    if not names:
        return None
    if (name := hexadecimal(names)) is not None:
        what = "what is beside the numbers differs from image to image, as of hexadecimal numbers"
        raise _two_ways(where, name, what)
    if any(map(_EXPONENT.search, names)):
        raise _two_ways(where, names[0], "numbers with exponents")
    written = [_STOPWATCH.sub(_milliseconds, name) for name in names]
    written = _with_fractions(_composed(written, where), where)
    rows = _of_one_form(written, names, where)
    if rows is None:
        return None
    fractions = [i for i in range(3, len(rows[0]), 2) if _joined_fraction(rows, i, names[0], where)]
    places = [i for i in range(1, len(rows[0]), 2) if len({float(row[i]) for row in rows}) > 1]
    places = [i for i in places if i not in fractions]
    words = {tuple(re.sub("[^a-z]", "", row[i].lower()) for i in range(0, len(row), 2)) for row in rows}
    if not places or (not one_camera and all(_camera_word(rows, i) for i in places)):
        return None
    if len(words) >= max(_LEAST_WORDS, len(names) / 2):
        raise _two_ways(where, names[0], "what is beside the numbers differs from image to image")
    reading = _chosen(rows, places, names[0], where, views, one_camera)
    if reading is None:
        return None
    frames, how = _unrolled(reading)
    if _may_roll(frames):
        readings = f"numbers to {max(frames):.0f}, where a counter began anew, or with a gap"
        raise _two_ways(where, names[0], readings)
    refuse_far(dict(zip(names, frames)), where, "number", f"rename or remove it, or {KEY}")
    _check_groups(reading, names, where, views, any(_camera_word(rows, i) for i in places))
    if len({*frames}) < len(frames):
        how += "; images of one number share a time"
    cameras = ["".join(camera) for camera in reading.cameras] if len({*reading.cameras}) > 1 else None
    return NameNumbers(frames, cameras, how)


def _two_ways(where: str, name: str, readings: str) -> SceneError:
    expected = "names that tell times in one way"
    return mismatch(where, expected, f"names as '{name}': {readings}", f"write time in each frame, or {KEY}")


def _by_pattern(names: Sequence[str], where: str, pattern: str) -> NameNumbers:
    try:
        compiled = re.compile(pattern)
    except (re.error, TypeError) as error:
        raise mismatch("data.name_pattern", "a regular expression", f"'{pattern}' ({error})") from None
    groups = [name for name in ("time", "frame") if name in compiled.groupindex]
    calendar = [name for name in _CALENDAR if name in compiled.groupindex]
    groups += calendar[-1:]
    if len(groups) != 1:
        got = " and ".join(groups) or "neither"
        raise mismatch("data.name_pattern", "a group named time or frame, as (?P<frame>[0-9]+)", got)
    matches = [compiled.search(name) for name in names]
    if None in matches:
        missed = names[matches.index(None)]
        raise mismatch("data.name_pattern", f"to be found in every name of {where}", f"not in '{missed}'")
    texts = [match[groups[0]] or "" for match in matches]
    frames = [*map(_of_calendar, matches)] if calendar else [_number_of(text) for text in texts]
    if not calendar and not all(map(math.isfinite, frames)) and all(map(_HEXADECIMAL.fullmatch, texts)):
        frames = [float(int(text, 16)) for text in texts]
    for name, match, frame in zip(names, matches, frames):
        if not math.isfinite(frame):
            got = f"'{match[groups[0]]}' of '{name}'"
            raise mismatch(f"data.name_pattern: group {groups[0]}", "a number", got)
    if "part" in compiled.groupindex:
        parts = [match["part"] or "" for match in matches]
        rank = {part: str(n) for n, part in enumerate(in_order({*parts}))}
        rows = [["", rank[part], "", f"{frame:.10g}"] for part, frame in zip(parts, frames)]
        frames = _ranked(rows, [1, 3], may_carry=False)
    cameras = [match["camera"] for match in matches] if "camera" in compiled.groupindex else None
    reading = _Reading("", frames, [(camera,) for camera in cameras or [""] * len(names)])
    if not reading.is_unique:
        seen: set = set()
        pairs = list(zip(reading.cameras, frames))
        twice = next(i for i, pair in enumerate(pairs) if pair in seen or seen.add(pair))
        expected = f"each {groups[0]} once" if cameras is None else f"each {groups[0]} once a camera"
        got = f"{frames[twice]:g} again in '{names[twice]}'"
        advice = "name the camera by a group 'camera', or films one after the other by 'part'"
        advice = advice if cameras is None else ""
        raise mismatch("data.name_pattern", expected, got, advice)
    refuse_far(dict(zip(names, frames)), where, "time", "rename it, or set another data.name_pattern")
    return NameNumbers(frames, cameras, "taken from the images' names by data.name_pattern")


def hexadecimal(names: Sequence[str]) -> str | None:
    """Find a name whose counter, or that of a folder, has letters a to f where others have digits; None where
    there is none.

    >>> hexadecimal(["r_0009", "r_000a"]), hexadecimal(["9", "a", "10"]), hexadecimal(["1a", "1b", "2a"])
    ('r_000a', 'a', None)
    >>> hexadecimal(["0009/left", "000a/left"]), hexadecimal(["3fa9/1", "b01c/1"])
    ('000a/left', None)
    """
    paths = [name.split("/") for name in names]
    if len({*map(len, paths)}) > 1:
        paths = [path[-1:] for path in paths]
    for place, parts in enumerate(zip(*paths)):
        found = _hexadecimal(parts)
        if found is not None and (place == len(paths[0]) - 1 or _is_counter({*parts})):
            return names[parts.index(found)]
    return None


def _is_counter(parts: set[str]) -> bool:
    """Tell whether what differs in names, read as hexadecimal, hardly has gaps; hashes have."""
    prefix = os.path.commonprefix(list(parts)).rstrip("0123456789")
    numbers = [int(part.removeprefix(prefix), 16) for part in parts]
    return max(numbers) - min(numbers) < _GAPS * len(numbers)


def _hexadecimal(names: Sequence[str]) -> str | None:
    """Find as ``hexadecimal`` one of the last parts of names."""
    fields = [re.split(r"[^0-9A-Za-z]+", name) for name in names]
    if len({*map(len, fields)}) > 1:
        return None
    for values in zip(*fields):
        prefix = os.path.commonprefix(values).rstrip("0123456789")
        rests = [value.removeprefix(prefix) for value in values]
        if not all(map(_HEXADECIMAL.fullmatch, rests)) or all(map(str.isdigit, rests)):
            continue
        if len({*map(len, rests)}) == 1:
            is_mixed = any(len({c.isdigit() for c in column}) > 1 for column in zip(*rests))
        else:  # not filled with zeros
            is_filled = any(len(rest) > 1 and rest[0] == "0" for rest in rests)
            is_mixed = not is_filled and {rest[0].isdigit() for rest in rests} == {True, False}
        if is_mixed:
            return next(name for name, rest in zip(names, rests) if not rest.isdigit())
    return None


def _number_of(text: str | None) -> float:
    """Read the number that a group of a pattern found, or the seconds of a time of day; else NaN."""
    text = _in_seconds(text or "").replace("\0", "")
    if match := _OF_TIME.fullmatch(text):
        hours, minutes, seconds = match[1] or 0, match[2], match[3].replace(",", ".")
        if float(seconds) < 60 and int(minutes) < 60 and not re.fullmatch(r"\d+\.\d+", text):
            return (int(hours) * 60 + int(minutes)) * 60 + float(seconds)
    try:
        return float(text)
    except ValueError:
        return math.nan


def _composed(names: Sequence[str], where: str) -> Sequence[str]:
    """Mark what numbers of all names say together, such as a date, where it varies; longer ones go first.

    Raises:
        SceneError: naming the readings where two survive.
    """
    found: dict[tuple[int, int], dict[str, tuple]] = {}
    for what, pattern, read in _FORMS:
        some = names if pattern.search(names[0]) else ()  # none within a number that is marked
        matches = [[m for m in pattern.finditer(n) if n.count("\0", 0, m.start()) % 2 == 0] for n in some]
        for column in zip(*matches) if len({*map(len, matches)}) == 1 else ():
            values = [*map(read, column)]
            is_few = len({*values}) < min(_FEW, len(names))  # as of cameras
            is_other = is_few or _FRAME.search(names[0][: column[0].start()])
            has_year = column[0].groupdict().get("Y")
            if None not in values and len({*values}) > 1 and (has_year or not is_other):
                found.setdefault(column[0].span(), {})[what] = (column, values)
    if not found:
        return names
    of = found[max(found, key=lambda span: span[1] - span[0])]
    of = {what: read for what, read in of.items() if read[0][0].groupdict().get("Y")} or of
    column = next(iter(of.values()))[0]
    readings = {what: values for what, (_, values) in of.items()}
    counts = [float(re.sub(r"\D", "", match[0])) for match in column]
    part = column[0].groupdict()
    no_seconds = part.get("H") and not part["S"] and not part["half"]
    may_count = no_seconds or (column[0][0].isdigit() and not part.get("Y"))
    is_small = column[0][0].isdigit() and max(counts) < 10 ** (len(column[0][0]) - 2)
    parts = [match.groupdict() for match in column]
    is_one_day = len({tuple(each.get(key) for key in "Yymd") for each in parts}) == 1
    if part.get("d") and is_one_day and not part.get("f") and any(each.get("H") == "00" for each in parts):
        readings[_COUNTER] = counts  # behind a date
    if may_count and (len(names) < _FEW or is_small or _unevenness(counts) < _ROUNDING):
        readings[_COUNTER] = counts
    if np.ptp(readings.get(_TIME_OF_DAY, 0)) > 12 * 3600 and _unevenness(counts) >= _ROUNDING:
        raise _two_ways(where, names[0], "times of day more than half a day apart")
    values = readings[_survivor(readings, names[0], where)]
    marked = [f"{m.string[: m.start()]}{_marked(v)}{m.string[m.end() :]}" for m, v in zip(column, values)]
    return _composed(marked, where)


def _survivor(readings: Mapping[str, Sequence[float]], name: str, where: str) -> str:
    """Choose the first of readings that agree, or the one whose steps are even where no other's are.

    Raises:
        SceneError: naming the readings where there is none.
    """
    first, *others = readings
    differ = [what for what in others if not _agree(readings[first], readings[what])]
    if not differ:
        return first
    ranked = sorted(readings, key=lambda what: _unevenness(readings[what]))
    best = _unevenness(readings[ranked[0]])
    rest = [what for what in ranked[1:] if not _agree(readings[ranked[0]], readings[what])]
    least = _FEW_STEPS if ranked[0] == _COUNTER else _LEAST_STEPS
    tells = best <= _EVEN and len({*readings[ranked[0]]}) > least
    if tells and all(_unevenness(readings[what]) > _UNEVEN * best + 0.05 for what in rest):
        return ranked[0]
    raise _two_ways(where, name, ", or ".join((first, *differ)))


def _unevenness(values: Sequence[float]) -> float:
    """Return how much longer the longest step between values is than the shortest, in shares of that."""
    steps = np.diff(np.unique(values))
    return float(steps.max() / steps.min()) - 1 if len(steps) else 0.0


def _agree(one: Sequence[float], other: Sequence[float]) -> bool:
    """Tell whether two readings say the same times, but for their beginning and unit."""
    both = [np.asarray(values, np.float64) for values in (one, other)]
    first, second = ((values - values.min()) / (np.ptp(values) or 1) for values in both)
    steps = [np.diff(np.unique(values)).min(initial=1) for values in (first, second)]
    return float(np.abs(first - second).max()) <= _SAME_TIMES * min(steps)


def _of_calendar(match: re.Match) -> float:
    """Return the seconds that the groups year, month .. second of a pattern say; NaN where there is no such
    date.
    """
    part = {key: text for key, text in match.groupdict().items() if text}
    hour, minute, second = (_number_of(part.get(key, "0")) for key in _CALENDAR[3:])
    try:
        year, month, day = (int(part.get(key, 1)) for key in _CALENDAR[:3])
        date = datetime(year + 2000 * (year < 100), month, day, tzinfo=timezone.utc)
    except ValueError:
        return math.nan
    return date.timestamp() + (hour * 60 + minute) * 60 + second


def _with_fractions(names: Sequence[str], where: str) -> Sequence[str]:
    """Mark seconds with a fraction behind a point, written with as many digits in all names or as needed."""
    rows = [re.split(_DECIMAL, name) for name in names]
    if len({*map(len, rows)}) > 1:
        return names
    for i in range(1, len(rows[0]), 2):
        is_camera = _word(rows, i, _CAMERA_WORD) and not _word(rows, i, _FRAME_WORD)
        column = {row[i] for row in rows}
        is_no_time = len(column) == 1 or max(map(len, column)) > _MOST_DIGITS
        if any("\0" in row[i] for row in rows) or is_camera or is_no_time:
            continue
        values = _decimals(rows, i, where)
        for row, value in zip(rows, values or ()):
            row[i] = _marked(value)
    return ["".join(row) for row in rows]


def _decimals(rows: list[list[str]], place: int, where: str) -> list[float] | None:
    """Read the numbers at a place with what is behind their points; None where that is a counter.

    A fraction of one width is one if it is behind a word for time or Unix time, or reaches half of a whole; a
    counter's numbers are small. One of several widths has no zero at its end; a number of nanoseconds, which
    lacks the zeros before it, reaches half of a whole.
    """
    whole, _, behind = zip(*(row[place].partition(".") for row in rows))
    widths, most = {*map(len, behind)}, max((int(text or 0) for text in behind), default=0)
    if (width := max(widths)) == 0:
        return None
    decimals = [float(f"{number}.{text or 0}") for number, text in zip(whole, behind)]
    is_stamp = all(9 <= len(number) <= 10 for number in whole)
    if len(widths) == 1:
        are_whole = all(len(row) == 3 and row[0][-1:] in ("", "/") and not row[2] for row in rows)
        is_sure = is_stamp or (are_whole and width in (6, 9)) or _word(rows, place, _FRAME_WORD)
        # Two digits up to 59 are minutes or seconds.
        spread = most if len({*whole}) == 1 else most - min(map(int, behind))
        reaches = width > 1 and spread >= 0.5 * 10**width and (width > 2 or most >= 60)
        return decimals if is_sure or reaches else None
    readings = {}
    if not any(len(text) > 1 and text[-1] == "0" for text in behind):
        readings["seconds with a fraction"] = decimals
    is_filled = any(not text or (len(text) > 1 and text[0] == "0") for text in behind)
    unit = next((unit for unit in (10**3, 10**6, 10**9) if most < unit), None)
    if unit and not is_filled and most >= 0.5 * unit:
        counts = [int(number) + int(text) / unit for number, text in zip(whole, behind)]
        readings["seconds and a whole number of parts of one"] = counts
    if not is_filled and width <= 6 and not is_stamp:
        readings[_COUNTER] = [float(number) * 10**width + int(text) for number, text in zip(whole, behind)]
    if not readings:
        return None
    what = _survivor(readings, "".join(rows[0]), where)
    return None if what == _COUNTER else readings[what]


def _of_one_form(written: Sequence[str], names: Sequence[str], where: str) -> list[list[str]] | None:
    """Split all names into as many texts and numbers; None where they have no number in common.

    Args:
        written: the names, with dates as numbers.
        names, where: see ``read_names``.

    Raises:
        SceneError: naming one of a few names that differ from all others.
    """
    rows = [_split(name) for name in written]
    counts = [len(row) for row in rows]
    if len({*counts}) > 1:  # folders may be called differently
        files = [_split(name.rpartition("/")[2]) for name in written]
        folders = [name.rpartition("/")[0] for name in written]
        rows = [[f"{folder}/{row[0]}", *row[1:]] for folder, row in zip(folders, files)]
        counts = [len(row) for row in rows]
    usual = max({*counts}, key=counts.count)
    odd = [name for name, count in zip(names, counts) if count != usual]
    if 0 < len(odd) <= _ODD * len(names):
        like = names[counts.index(usual)]
        more = f" and {len(odd) - 1} more" if len(odd) > 1 else ""
        expected = f"names of one form, as '{like}'"
        raise mismatch(where, expected, f"'{odd[0]}'{more}", f"rename or remove it, or {KEY}")
    for i in range(1, min(counts), 2):
        before = {row[i - 1] for row in rows}
        if len({text.rstrip("-") for text in before}) < len(before):
            what = "what is beside the numbers differs from image to image, as signs"
            raise _two_ways(where, names[0], what)
    if odd:  # what differs is before the last number
        if min(counts) < 3:
            return None
        rows = [["".join(row[:-2]), *row[-2:]] for row in rows]
    return rows if len(rows[0]) > 1 else None


def _word(rows: Sequence[Sequence[str]], place: int, word: re.Pattern) -> bool:
    """Tell whether a word stands before a number in all names."""
    return all(word.search(row[place - 1]) for row in rows)


def _camera_word(rows: Sequence[Sequence[str]], place: int) -> bool:
    """Tell whether a word for cameras stands before a number in all names; a letter, before two digits."""
    is_short = all(len(row[place]) <= 2 for row in rows)
    return _word(rows, place, _CAMERA_WORD) and (is_short or not _word(rows, place, _LETTER_WORD))


def _tells_film(rows: Sequence[Sequence[str]], place: int) -> bool:
    """Tell whether a number is that of a film in all names, as ``C0001.MP4_frame_07`` has it."""
    return _word(rows, place, _FILM_WORD) or all(_OF_FILM.match(row[place + 1]) for row in rows)


def _joined_fraction(rows: list[list[str]], place: int, name: str, where: str) -> bool:
    """Join a fraction of a second to Unix time or date and time before it, and tell whether there was one.

    Raises:
        SceneError: for a number that may be a fraction, or a counter that goes on through all seconds.
    """
    between = {row[place - 1] for row in rows}
    whole = [row[place - 2].partition(".") for row in rows]
    is_whole = all((point or 9 <= len(second) <= 10) and not int(rest or 0) for second, point, rest in whole)
    behind = [row[place] for row in rows]
    is_number = all("." not in text and len(text) <= _MOST_DIGITS for text in behind)
    if len(between) > 1 or not between <= {*".,_-"} or not is_whole or not is_number:
        return False
    widths, most = {*map(len, behind)}, max(map(int, behind))
    unit = 10 ** max(widths) if len(widths) == 1 else next((u for u in (10**3, 10**6, 10**9) if most < u), 0)
    if most < 0.5 * unit or not unit or (between <= {*"_-"} and (unit == 10 or (unit == 100 and most < 60))):
        return False
    pairs = sorted({(int(second[0]), int(text)) for second, text in zip(whole, behind)})
    goes_on = all(a[1] < b[1] for a, b in pairwise(pairs)) and pairs[0][0] < pairs[-1][0]
    if goes_on and between <= {*"_-"}:
        if unit in (10**3, 10**6, 10**9) and len(pairs) <= _FEW:
            raise _two_ways(where, name, "fractions of the seconds, or a counter")
        return False
    for row, second, text in zip(rows, whole, behind):
        row[place - 2] = f"{int(second[0]) + int(text) / unit:.9f}"
    return True


def _chosen(
    rows: list[list[str]],
    places: list[int],
    name: str,
    where: str,
    views: Sequence[Sequence[float]] | None,
    one_camera: bool,
) -> _Reading | None:
    """Choose the one reading that survives; ``name`` is the first, for errors.

    Raises:
        SceneError: naming the readings where two do.
    """
    texts = [i for i in range(0, len(rows[0]), 2) if len({row[i] for row in rows}) > 1]
    named = [i for i in places if _word(rows, i, _FRAME_WORD)]
    for_cameras = [i for i in places if _camera_word(rows, i)]
    free = [i for i in places if i not in for_cameras]
    numbers = "taken from the numbers in the images' names"

    def of_place(place: int, others: Sequence[int], what: str = numbers) -> _Reading:
        cameras = [tuple(row[i] for i in sorted({*texts, *others} - {place})) for row in rows]
        return _Reading(what, [float(row[place]) for row in rows], cameras)

    clocks = [i for i in free if _is_clock([row[i] for row in rows])]
    if clocks and not named:  # counters beside a clock say nothing more
        # Of whole seconds the number beside may count the images of each.
        is_fine = any(row[clocks[-1]].isdigit() or float(row[clocks[-1]]) % 1 for row in rows)
        readings = [of_place(clocks[-1], others) for others in (for_cameras, places)[: 1 + is_fine]]
        if unique := [reading for reading in readings if reading.is_unique]:
            return unique[0]
    if not free:
        raise _two_ways(where, name, "images of several cameras")
    together, parts = "all numbers together order one film", of_place(free[-1], for_cameras).cameras

    def of_film(order: Sequence[int], must_tell: bool) -> _Reading:
        times = _ranked(rows, order)
        if times is None and must_tell:
            raise _two_ways(where, name, f"{together}, and not how much time lies between its parts")
        if must_tell:
            readings = {together: times}
            for what, pattern, read in _CHAINS:
                matches = [pattern.search("".join(row)) for row in rows]
                values = [None if match is None else read(match) for match in matches]
                readings |= {} if None in values or len({*values}) == 1 else {what: values}
            times = readings[_survivor(readings, name, where)]
        return _Reading(
            together, times or _ranks([tuple(float(row[i]) for i in order) for row in rows]), parts
        )

    if one_camera:
        order = [i for i in free if i not in named[-1:]] + named[-1:]
        counts = [len({row[i] for row in rows}) for i in order]
        whole = _Reading("", [*range(len(rows))], [*zip(parts, *([row[i] for row in rows] for i in order))])
        if len({*whole.cameras}) < len(rows):
            return None
        last = of_place(order[-1], ())
        if len({*last.frames}) == len(rows) and len(named or free) == 1:
            return last
        film, rig = of_film(order, must_tell=False), of_place(order[-1], order)
        keys = sorted({tuple(float(row[i]) for i in order) for row in rows})
        is_clock = all(len(row[order[-2:][0]].partition(".")[0]) >= 9 for row in rows)
        is_told = len(order) > 1 and (is_clock or _carries(keys, 60))
        is_told |= any(_tells_film(rows, i) for i in order[:-1]) or _APART_CODE.search(name) is not None
        is_rig = for_cameras or len({*film.frames}) < len(rows) or max(counts) > counts[-1]
        if is_rig or (rig.is_shared and not is_told):
            raise _two_ways(where, name, "images of several cameras, or parts of one film")
        return replace(of_film(order, must_tell=True), cameras=[()] * len(rows))
    film = of_film(free, must_tell=False)
    if named or len(free) == 1:
        reading = of_place((named or free)[-1], places)
        if not reading.is_unique:
            return None
        keys = [(tuple(row[i] for i in texts), *(float(row[i]) for i in places)) for row in rows]
        film = _Reading(together, _ranks(keys), [()] * len(rows))
        is_shared = len({*reading.frames}) < len(rows) and film.is_unique
        is_film = is_shared and views is not None and _path(reading, film, views) == "film"
        if is_film and not _returns(reading, views):
            raise _two_ways(where, name, "words tell cameras, whose positions continue one path")
        others = [i for i in places if i not in (*for_cameras, (named or free)[-1])]
        if is_shared and views is None and any(_tells_film(rows, i) for i in others):
            readings = "films that are counted anew, of cameras or of one after the other ('part')"
            raise _two_ways(where, name, readings)
        return reading
    count = "number {} of each name counts frames, the others tell cameras"
    rigs = [of_place(place, places, count.format(n)) for n, place in enumerate(free, 1)]
    rigs = [rig for rig in rigs if rig.is_unique and rig.is_shared]
    last = of_place(free[-1], places)
    path = None if views is None else _path(last, film, views)
    if views is not None and rigs and path != "film":
        steps = [_step(rig, views) for rig in rigs]
        short = min(steps)
        near = [rig for rig, step in zip(rigs, steps) if step <= _ONE_PATH * short]
        if len(near) == 1 and (len(rigs) > 1 or path == "rig" or short == 0):
            return near[0]
    are_parts = film.is_unique and last.is_apart
    if film.is_unique and (path == "film" or (path is None and are_parts and not rigs)):
        return of_film(free, must_tell=True)
    readings = [f"{one.what} ({len({*one.frames})} times)" for one in (*rigs, film)]
    raise _two_ways(where, name, ", or ".join(readings))


def _ranks(keys: Sequence[tuple]) -> list[float]:
    """Return the place of each key in the order of all that differ."""
    rank = {key: float(place) for place, key in enumerate(sorted({*keys}))}
    return [rank[key] for key in keys]


def _is_clock(digits: Sequence[str]) -> bool:
    """Tell whether numbers are dates, or a clock's seconds, thousandths or less since some time long ago, and
    no random ones.
    """
    parts = [text.partition(".") for text in digits]
    values = [*map(float, digits)]
    are_long = all(len(whole) >= (9 if point else 13) for whole, point, _ in parts)
    return are_long and max(values) - min(values) <= _SHORT * max(values)


def _step(rig: _Reading, views: Sequence[Sequence[float]]) -> float:
    """Return the median way of a camera of a rig from frame to frame; 0 where cameras stand."""
    places = np.asarray(views, np.float64)
    order = sorted(range(len(places)), key=lambda i: (rig.cameras[i], rig.frames[i]))
    steps = np.linalg.norm(np.diff(places[order], axis=0), axis=-1)
    within = [step for a, b, step in zip(order, order[1:], steps) if rig.cameras[a] == rig.cameras[b]]
    middle = median(within) if within else math.inf
    return 0.0 if middle <= _STILL * float(np.ptp(places, axis=0).max()) else middle


def _ranked(
    rows: Sequence[Sequence[str]], places: Sequence[int], may_carry: bool = True
) -> list[float] | None:
    """Number names by several numbers, the first of which weighs most; gaps in the last stay.

    Where the last number grows all the way, as of frames counted through all chapters, it is the frame's.
    Where it is carried over, as of minutes and seconds, both are one number, if it ``may_carry``. Else a part
    goes on one step after the one before it; None where parts are missing, or do not begin anew.
    """
    keys = [tuple(float(row[i]) for i in places) for row in rows]
    ordered = sorted({*keys})
    last = [key[-1] for key in ordered]
    are_clocks = all(
        ("." in row[i] or len(row[i]) == 2) and float(row[i]) < 60 for row in rows for i in places
    )
    if all(a < b for a, b in pairwise(last)) and (not are_clocks or not may_carry):
        return [key[-1] for key in keys]
    joined, unit = dict(zip(ordered, ordered)), 1.0
    for part, place in [*pairwise(places)][::-1] if may_carry else ():  # minutes and seconds
        if _tells_film(rows, part):
            break
        widths = {len(row[place]) for row in rows}
        bases = [60 * unit, *[10.0**width * unit for width in widths if len(widths) == 1]]
        base = next((base for base in bases if _carries(sorted({*joined.values()}), base)), None)
        if base is None:
            break
        values = sorted({*joined.values()})
        meets = {(a[-1], b[-1]) for a, b in pairwise(values) if a[:-1] != b[:-1]}
        base -= meets == {(base - 1, 1.0)} and base > 60  # counters that begin at 1
        joined = {key: (*part[:-2], part[-2] * base + part[-1]) for key, part in joined.items()}
        unit = base
    pairs = [*pairwise(joined.values())]
    steps = [b[-1] - a[-1] if a[:-1] == b[:-1] else None for a, b in pairs]
    usual = median([step for step in steps if step is not None] or [1.0])
    meets = [(a[:-1], b) for (a, b), step in zip(pairs, steps) if step is None]
    gaps = {next(y - x for x, y in zip(a, b) if x != y) for a, b in meets}
    is_next = len(gaps) == 1 and math.log10(min(gaps)) % 1 == 0  # GoPro's GX010042, GX020042 also
    are_whole = is_next and all(b[-1] - min(last) <= max(usual, _SKIPPED) for _, b in meets)
    if may_carry and meets and not are_whole:
        return None
    sums = accumulate((usual if step is None else step for step in steps), initial=ordered[0][-1])
    frames = dict(zip(ordered, sums))
    return [frames[key] for key in keys]


def _carries(parts: Sequence[tuple[float, ...]], base: float) -> bool:
    """Tell whether the last of several numbers goes on at 0 where it comes to ``base`` and the one before it
    grows by 1, as seconds and minutes do.
    """
    pairs = [*pairwise(parts)]
    within = [b[-1] - a[-1] for a, b in pairs if a[:-1] == b[:-1]]
    meets = [(a[-1], b[-1]) for a, b in pairs if a[:-2] == b[:-2] and b[-2] - a[-2] == 1]
    if not within or not meets or any(part[-1] >= base for part in parts):
        return False
    room = _CARRY * median(within)
    return all(end >= base - room and start < room for end, start in meets)


def _path(rig: _Reading, film: _Reading, views: Sequence[Sequence[float]]) -> str | None:
    """Tell a rig from one film by what cameras see; None where that does not tell.

    Ordered as one film, a camera that moves on makes steps of about one length also where what would be
    cameras of a rig meet.
    """
    order = np.argsort(film.frames, kind="stable")
    steps = np.linalg.norm(np.diff(np.asarray(views, np.float64)[order], axis=0), axis=-1)
    cameras = [rig.cameras[i] for i in order]
    meets = [a != b for a, b in pairwise(cameras)]
    within = [step for step, meet in zip(steps, meets) if not meet]
    across = [step for step, meet in zip(steps, meets) if meet]
    extent = float(np.ptp(np.asarray(views, np.float64), axis=0).max())
    if not within or not across or median(within) > _STEP * extent or extent == 0:
        return None
    least = 1e-6 * extent
    ratio = (median(across) + least) / (median(within) + least)
    return "film" if ratio <= _ONE_PATH else "rig" if ratio >= _JUMPS else None


def _returns(rig: _Reading, views: Sequence[Sequence[float]]) -> bool:
    """Tell whether the first camera ends where it began, so that another may begin there, too."""
    mine = [i for i, camera in enumerate(rig.cameras) if camera == rig.cameras[0]]
    way = np.asarray(views, np.float64)[sorted(mine, key=lambda i: rig.frames[i])]
    steps = np.linalg.norm(np.diff(way, axis=0), axis=-1)
    return len(way) < 2 or float(np.linalg.norm(way[-1] - way[0])) < 2 * median(steps.tolist())


def _unrolled(reading: _Reading) -> tuple[list[float], str]:
    """Continue a counter that began anew after its last number, as 9999; also say what was read."""
    frames, highest, lowest = reading.frames, max(reading.frames), min(reading.frames)
    turn = 10 ** min(len(f"{highest:.0f}"), _MOST_DIGITS)
    numbers = sorted({*frames})
    gap, after = max(((b - a, b) for a, b in pairwise(numbers)), default=(0, 0))
    ends = sum(number >= 0.99 * turn for number in numbers), sum(number <= 0.01 * turn for number in numbers)
    rolls = turn >= 10**_COUNTER_DIGITS and min(ends) > 1
    if not rolls or gap < 0.5 * turn or highest % 1 or lowest % 1:
        return frames, f"{reading.what}, {lowest:.10g} to {highest:.10g}"
    skips = int(lowest > 0)  # counters that begin at 1
    frames = [frame if frame >= after else frame + turn - skips for frame in frames]
    how = f"{reading.what}: {after:g} to {highest:g}, then {lowest:g} on, taken as a counter that began anew"
    return frames, how


def _may_roll(frames: Sequence[float]) -> bool:
    """Tell whether numbers begin at 0 or 1 and end at the greatest of their digits, two or more, or of 8 or
    more bits, with a gap of more than half between.
    """
    numbers = sorted({*frames})
    limits = {float(10**n - 1) for n in range(2, 10)} | {float(2**n - 1) for n in range(8, 33)}
    if len(numbers) < 4 or numbers[0] > 1 or numbers[-1] not in limits:
        return False
    gaps = np.diff(numbers)
    return gaps[0] == gaps[-1] == 1 and float(gaps.max()) > 0.5 * numbers[-1]


def refuse_far(named: Mapping[str, float], where: str, what: str, advice: str) -> None:
    """Refuse a few times or numbers far from all others, which would squeeze these to one moment.

    Raises:
        SceneError: naming the farthest, ``what`` of it is meant, and the ``advice``.
    """
    times = sorted({*named.values()})
    middle = times[len(times) // 2]
    *rest, far = sorted(times, key=lambda time: abs(time - middle))
    rest = rest[: len(times) - max(1, int(_MOST_FAR * len(times)))]
    if len(rest) > 2 and max(rest) - min(rest) < LEAST_SPAN * (times[-1] - times[0]):
        name = next(name for name, time in named.items() if time == far)
        expected = f"a {what} near all others, {min(rest):.10g} to {max(rest):.10g}"
        raise mismatch(f"{where}: {what} of {name}", expected, f"{far:.10g}", advice)


def _leap(groups: Sequence[set[float]]) -> bool:
    """Tell whether each camera's numbers are dense, and none goes on where another ends."""
    ends = sorted((min(group), max(group), len(group)) for group in groups)
    step = max((high - low) / (count - 1) for low, high, count in ends)
    return all(low - high > _CARRY * step for (_, high, _), (low, _, _) in pairwise(ends))


def _check_groups(
    reading: _Reading,
    names: Sequence[str],
    where: str,
    views: Sequence[Sequence[float]] | None,
    has_word: bool,
) -> None:
    """Refuse cameras or splits that were counted apart: that share some numbers, as 0 to 149 and 0 to 19, or,
    cameras that film together, none, as 1 to 14 and 101 to 114.
    """
    everything = sorted({*reading.frames})
    whole, groups = everything[-1] - everything[0], reading.groups
    first = {camera: name for name, camera in zip(names[::-1], reading.cameras[::-1])}
    counted = [sum(number in group for group in groups) for number in everything]
    one_numbering = f"one numbering of all images, {everything[0]:g} to {everything[-1]:g}"

    def apart(group: set[float], camera: tuple) -> SceneError:
        got = f"{min(group):g} to {max(group):g} for '{first[camera]}' and its like"
        return mismatch(where, one_numbering, got, f"write time in each frame, or {KEY}")

    if max(counted) == 1:  # no number twice: one numbering of all, unless cameras film together
        are_long = reading.is_apart and len(groups) > 1 and min(map(len, groups)) > 1
        path = None if views is None or not are_long else _path(reading, reading, views)
        if are_long and path is None and (has_word or (views is None and _leap(groups))):
            path = "rig" if not any(map(_SPLIT_WORD.search, names)) or has_word else None
        if path == "rig":
            raise apart(groups[-1], [*dict.fromkeys(reading.cameras)][-1])
        return
    letters = [tuple(re.sub("[^a-z0-9/]", "", part.lower()) for part in camera) for camera in reading.cameras]
    if len(groups) > len(names) / 2 or not replace(reading, cameras=letters).is_unique:
        raise _two_ways(where, names[0], "what is beside the numbers differs from image to image")
    for group, camera in zip(groups, dict.fromkeys(reading.cameras)):
        if len(group) == 1 and max(map(len, groups)) > _ODD_ALONE and not _SPLIT_WORD.search(first[camera]):
            expected = f"names of one form, as '{next(n for n in names if n != first[camera])}'"
            raise mismatch(where, expected, f"'{first[camera]}'", f"rename or remove it, or {KEY}")
    step = min(b - a for a, b in pairwise(everything))
    for group, camera in zip(groups, dict.fromkeys(reading.cameras)):
        span = max(group) - min(group)
        is_dense = span < whole and span == step * (len(group) - 1) and _SPLIT_WORD.search(first[camera])
        if len(group) > 1 and (span < _SPAN * whole or is_dense):
            raise apart(group, camera)
