"""A capture of several cameras that film one scene: offsets, poses of all in one world, one scene.

What stands still is matched between cameras: of a fixed camera the median of a few instants, in which movers
vanish, so that it has one pose from all of them; of a moving one each of its frames.
"""

from __future__ import annotations

import dataclasses
import math
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, combinations, product
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pycolmap

from forewarp.capture import poses, scene
from forewarp.capture.frames import (
    MOST,
    NO_MASKS,
    SHORT,
    TAKEN,
    Frames,
    Progress,
    Step,
    images_in,
    read_mask,
    within,
    write_mask,
    write_masks,
)
from forewarp.capture.motion import Still, is_fixed, moving_masks, resized_mask
from forewarp.capture.pipeline import ABOUT, PICTURE, keep, kept, record, work_for
from forewarp.capture.poses import Reconstruction, Search
from forewarp.capture.sync import MOST as HEARD
from forewarp.capture.sync import RATE, Synchrony, is_silent, synchronise
from forewarp.data.files import beside_images, left_out, mismatch, number
from forewarp.data.images import by, read_image, write_image
from forewarp.data.names import in_order, read_names
from forewarp.data.video import VIDEOS, doubts_of, extracted, sound_of, stamps_of, start_of
from forewarp.drawing.images import write_png
from forewarp.files import folder_written_whole, read_json, write_json

_INSTANTS, _POLLUTED = 9, 1 / 3  # of a still; share of them in which a pixel that moves is not matched
_SEEK = 600  # frames after which a film's instants are sought, not decoded on the way
_MOST_IMAGES = 6000  # of all cameras, where frames= does not say so
_LOOKS = 24  # frames of a moving camera that are matched with each other camera
_LEAST_SPAN = 0.5  # of the median film, below which a few may miss parts of the span
_MOST_OF = 0.75  # of the cameras: so many film all of the span then
_RIG_VIEWS = 3  # from which on a point is sure: cameras of a rig are far apart
_VARIES = 0.05  # by which the gaps between frames may differ at a constant rate
_WORSE = 3.0  # times the median error of all cameras, from which on one is named
_HEARD = ("certainty", "residual", "agreeing")  # what is told of a camera's ``Synchrony``


Offsets = str | float | Sequence[float] | Mapping[str, float] | None  # see ``offsets_of``


@dataclass(frozen=True)
class Recording:
    """What one camera of a rig took: a video at ``path``, or the ``images`` of a folder; ``stamps`` are their
    seconds on its own clock; ``told`` are lines on what was left out.
    """

    name: str
    path: Path
    stamps: np.ndarray
    images: tuple[Path, ...] = ()
    told: Sequence[str] = ()

    @property
    def gap(self) -> float:
        """Seconds from a frame to the next, in the median."""
        return float(np.median(np.diff(self.stamps)))

    @property
    def is_variable(self) -> bool:
        """Tell whether its rate varies."""
        gaps = np.diff(self.stamps)
        return bool(np.quantile(gaps, 0.9) - np.quantile(gaps, 0.1) > _VARIES * np.median(gaps))

    def frame(self, row: int) -> str:
        """Name a frame."""
        return f"{self.name}_{row + 1:06d}.jpg"

    def pixels(self, rows: Sequence[int], size: int | None, threads: int | None) -> Iterator[np.ndarray]:
        """Yield frames of ascending rows: uint8 (H, W, 3), upright, at most ``size`` pixels wide or high.

        Raises:
            ValueError: where one is not there.
        """
        if self.images:
            first = by(read_image(self.images[0], upright=True).shape[1::-1])
            for row in rows:
                pixels = read_image(self.images[row], upright=True).numpy()[..., :3]
                if (got := by(pixels.shape[1::-1])) != first:
                    expected = f"{first} pixels as {self.images[0].name}"
                    raise mismatch(self.images[row], expected, got, _without(self.name))
                yield within(pixels, size)
            return
        films, count = [extracted(self.path, list(rows), size, threads)], 0
        if len(rows) * _SEEK < rows[-1]:
            starts = (start_of(self.stamps, row) for row in rows)
            films = (extracted(self.path, [0], size, threads, start=start) for start in starts)
        for pixels in chain.from_iterable(films):
            count += 1
            yield pixels
        if count < len(rows):
            got = f"{count} of {len(rows)}"
            raise mismatch(self.path, "the frames of its index", got, "convert the video")


def cameras_in(folder: Path) -> dict[str, Path]:
    """Find the cameras of a rig, in the order of names: a video for each, else a sub-folder of images.

    Raises:
        ValueError: for fewer than two, for two videos of one name, and for a sub-folder called as videos are,
            with another number.
    """
    there, _ = _films_and_beside(folder)
    paths = [path for path in there if path.is_file()]
    if twice := sorted(path.name for path in paths if sum(path.stem == one.stem for one in paths) > 1):
        raise mismatch(folder, "a video for each camera", " and ".join(twice[:2]))
    found = {path.stem: path for path in paths}
    forms = {re.sub(r"\d+", "0", name) for name in found}
    inner = [path for path in there if path.is_dir() and path.name not in found]
    if like := in_order(path.name for path in inner if re.sub(r"\d+", "0", path.name) in forms):
        expected = f"a video for each camera, as {in_order(found)[0]}, or sub-folders alone"
        raise mismatch(
            folder, expected, f"the folder {like[0]} beside them", "make a video of it, or move it"
        )
    if not found:
        places = ((path, place) for path in inner for place in (path, path / "images"))
        found = {path.name: place for path, place in places if place.is_dir() and images_in(place)[0]}
    if len(found) < 2:
        got = f"one, {next(iter(found))}; for one camera set video=" if found else "none"
        raise mismatch("videos", f"at least two videos, or sub-folders of pictures, in {folder}", got)
    return {name: found[name] for name in in_order(found)}


def _films_and_beside(folder: Path) -> tuple[list[Path], dict[Path, Path]]:
    """List videos and sub-folders, and masks, depth and others that go with one: see ``beside_images``."""
    there = (path for path in folder.iterdir() if not path.name.startswith("."))
    return beside_images(sorted(p for p in there if p.is_dir() or p.suffix.lower() in VIDEOS), folder)


def recordings(
    folder: Path, rate: float | None, without: Sequence[str] = (), name_pattern: str | None = None
) -> list[Recording]:
    """Look at what each camera of a rig took.

    Args:
        folder: see ``cameras_in``.
        rate: images a second of sub-folders; None: their times are numbers.
        without: names of cameras to leave out, which are not looked at.
        name_pattern: reads the names of images in sub-folders, see ``names.read_names``.

    Raises:
        ValueError: for fewer than two, for what is no video, and for a name to leave out that is not there.
    """
    found, (_, beside) = cameras_in(folder), _films_and_beside(folder)
    _refuse_unknown("without", without, [*found, *(path.stem for path in beside)])
    used = [name for name in found if name not in without]
    if len(used) < 2:
        raise mismatch("without", "at least two cameras left", f"{len(used)} of {len(found)}")
    left = left_out(beside, folder)
    films = [_recording(name, found[name], rate, name_pattern) for name in used]
    return [dataclasses.replace(films[0], told=[*left, *films[0].told]), *films[1:]]


def _recording(name: str, path: Path, rate: float | None, name_pattern: str | None) -> Recording:
    images, told = (), []
    if path.is_dir():
        images, told = images_in(path)
        read = read_names([image.stem for image in images], str(path), name_pattern, one_camera=True)
        numbers = range(len(images)) if read is None else read.frames
        stamps = np.array(numbers, dtype=np.float64) / (rate or 1.0)
        order = np.argsort(stamps, kind="stable")
        images, stamps = tuple(images[row] for row in order), stamps[order]
    else:
        stamps, told = stamps_of(path), [f"{path}: {line}" for line in doubts_of(path)]
    if len(stamps) < 2:
        kind = "pictures" if images else "frames"
        got = f"{len(stamps)} {kind}" if len(stamps) else "another file"
        raise mismatch(path, f"many {kind}", got, f"leave it out ({_without(name)})")
    if not np.all(np.diff(stamps) > 0):
        raise mismatch(path, "frames at different times", "two at one", "convert the video")
    return Recording(name, path, stamps, images, told)


def _without(*names: str) -> str:
    """Write what leaves cameras out."""
    plain = [name if re.fullmatch(r"[\w.-]+", name) else repr(name) for name in names]
    return f"without=[{','.join(plain)}]"


def _refuse_unknown(key: str, names: Sequence[str], there: Sequence[str]) -> None:
    if unknown := [name for name in names if name not in there]:
        few = ", ".join(in_order(there)[:6]) + (" .." if len(there) > 6 else "")
        raise mismatch(key, f"names of {few}", unknown[0], "see the names of the videos")


def offsets_of(
    films: Sequence[Recording], wanted: Offsets, everyone: Sequence[str], step: Step, is_timed: bool = True
) -> tuple[np.ndarray, Synchrony | None, str]:
    """Find when each film began, in seconds.

    Args:
        films: of the cameras in use.
        wanted: a number for each of ``everyone``, in order or by name; ``sound``; ``none`` or 0: all began
            together; None: sound, where all have it; together, where none has.
        everyone: names of all cameras that are there, also of those left out.
        step: shows progress.
        is_timed: stamps are seconds.

    Returns:
        the offsets (N,), what sound told of them, and in words how they are known.

    Raises:
        ValueError: for values of another number or name, and where sound does not tell, naming the film.
    """
    if wanted in ("none", 0):
        return np.zeros(len(films)), None, "all begin together, as offsets= says"
    if wanted in (None, "sound"):
        return _heard_offsets(films, wanted is not None, step)
    if isinstance(wanted, (list, tuple)):
        if len(wanted) != len(everyone):
            raise mismatch("offsets", f"one of each of {len(everyone)} cameras", len(wanted))
        wanted = dict(zip(everyone, wanted))
    if not isinstance(wanted, Mapping):
        expected = "seconds for each camera, sound, none or null"
        raise mismatch("offsets", expected, repr(wanted), "set offsets=")
    _refuse_unknown("offsets", list(wanted), everyone)
    if missing := [film.name for film in films if film.name not in wanted]:
        raise mismatch("offsets", "one of each camera", f"none of {missing[0]}", "leave it out, or add it")
    seconds = {name: number(value, f"offsets: seconds of {name}") for name, value in wanted.items()}
    chosen = np.array([seconds[film.name] for film in films])
    if not is_timed and np.ptp(chosen) > 0:
        raise mismatch("offsets", "rate= beside them, images a second of the sub-folders", "none")
    return chosen, None, "as offsets= says"


def _heard_offsets(films: Sequence[Recording], is_asked: bool, step: Step):
    """Find offsets by sound."""
    sounds = []
    with step("sound") as progress:
        for film in films:
            sounds.append(np.empty(0) if film.images else sound_of(film.path, RATE, HEARD))
            progress(len(sounds), 2 * len(films))
        silent = [film.name for film, sound in zip(films, sounds) if is_silent(sound)]
        if len(silent) == len(films) and not is_asked:
            progress(1, 1)
            how = "no camera has sound: taken to begin together (offsets= says other)"
            return np.zeros(len(films)), None, how
        if silent:
            got = f"none in {silent[0]}" + (f" and {len(silent) - 1} more" if len(silent) > 1 else "")
            advice = "set offsets= in seconds, offsets=none if all began together, or "
            raise mismatch("offsets", "sound in all videos", got, advice + _without(*silent))
        count = len(films)
        heard = synchronise(sounds, lambda done, total: progress(count + count * done // total, 2 * count))
    unsure = [film.name for film, is_sure in zip(films, heard.is_sure()) if not is_sure]
    if unsure:
        which, advice = "all", "set offsets= in seconds"
        if len(unsure) < len(films) - 1:
            which, advice = unsure[0], f"{advice}, or {_without(*unsure)}"
        row = [film.name for film in films].index(unsure[0])
        got = f"{heard.agreeing[row]} of {len(films) - 1} pairs that agree in {which}, with a certainty of "
        got += f"{heard.certainty[row]:.1f}"
        raise mismatch("offsets", "sounds that all cameras share, a clap", got, advice)
    return heard.offsets, heard, "by sound"


def span_of(films: Sequence[Recording], offsets: np.ndarray) -> tuple[float, float, str | None]:
    """Find the time in which all films run; if that is less than half of the median film, in which three
    quarters of them do. Returns its begin and end, and a line about films that miss a part.

    Raises:
        ValueError: where two films do not overlap, naming them.
    """
    starts = np.array([film.stamps[0] for film in films]) + offsets
    ends = np.array([film.stamps[-1] for film in films]) + offsets
    usual = float(np.median(ends - starts))
    if ends.min() - starts.max() >= _LEAST_SPAN * usual:
        return float(starts.max()), float(ends.min()), None
    least, best = max(2, math.ceil(_MOST_OF * len(films))), (0.0, -1.0)
    for begin in sorted(starts):
        running = np.sort(ends[(starts <= begin) & (ends > begin)])
        if len(running) >= least and running[-least] - begin > best[1] - best[0]:
            best = float(begin), float(running[-least])
    if best[1] <= best[0]:
        first, last = int(ends.argmin()), int(starts.argmax())
        got = f"{films[first].name} until {ends[first]:.2f} s"
        got += f" and {films[last].name} from {starts[last]:.2f} s on"
        advice = f"set offsets=, or leave one out, {_without(films[last].name)}"
        raise mismatch("videos", "films that overlap in time", got, advice)
    missing = [f.name for f, a, b in zip(films, starts, ends) if a > best[0] or b < best[1]]
    return *best, f"{', '.join(missing)} film only a part of the time that the others share"


@dataclass(frozen=True)
class Taken:
    """What is taken of one camera.

    Attributes:
        film: all that it took.
        rows: of the frames in its film.
        times: of the frames, on the common clock.
        moments: the numbers of the instants that they belong to.
        looks: names of the images that its poses are found from.
        is_fixed: it stands, so that one image is enough.
    """

    film: Recording
    rows: list[int]
    times: list[float]
    moments: list[int]
    looks: Sequence[str] = ()
    is_fixed: bool = False

    @property
    def names(self) -> list[str]:
        """Of the frames."""
        return [self.film.frame(row) for row in self.rows]


def choose(
    films: Sequence[Recording], offsets: np.ndarray, span: tuple[float, float], count: int | None
) -> tuple[list[Taken], str]:
    """Choose frames of all films, and say why so many.

    Of a short span every frame; its instants are the frames of the film that has most, of those that run all
    the while, and a frame belongs to the nearest.
    Of a longer one evenly spread instants, and of each film the frame nearest to each. Frames keep times of
    their own.
    """
    clocks = [film.stamps + offset for film, offset in zip(films, offsets)]
    gap = min(film.gap for film in films)
    begin, end = span[0] - 1e-6 * gap, span[1] + 1e-6 * gap
    inside = [np.flatnonzero((clock >= begin) & (clock <= end)) for clock in clocks]
    most = max(map(len, inside))
    limit = min(MOST, max(2, _MOST_IMAGES // len(films)))
    if count is None and most <= min(SHORT, limit):
        runs = [clock[0] <= begin + 2e-6 * gap and clock[-1] >= end - 2e-6 * gap for clock in clocks]
        fullest = max(range(len(films)), key=lambda film: (runs[film], len(inside[film])))
        rows, grid, why = inside, clocks[fullest], "every frame of short films"
    else:
        asked = max(2, min(most, limit if count is None else count))
        grid, why = np.linspace(*span, asked), "frames= says so"
        if count is None:
            why = f"{asked} instants of up to {most}; frames= takes more"
        # Where there is none within a frame of an instant, a film has none of it.
        near = [(_nearest(clock, grid), clock, film.gap) for clock, film in zip(clocks, films)]
        rows = [np.unique(mine[np.abs(clock[mine] - grid) <= gap]) for mine, clock, gap in near]
    nearest = [_nearest(grid, clock[mine]) for clock, mine in zip(clocks, rows)]
    first = min(int(moments.min(initial=len(grid))) for moments in nearest)
    chosen = [
        Taken(film, mine.tolist(), clock[mine].tolist(), (moments - first).tolist())
        for film, clock, mine, moments in zip(films, clocks, rows, nearest)
    ]
    if empty := [taken.film.name for taken in chosen if len(taken.rows) < 2]:
        got = f"none of {empty[0]}"
        raise mismatch("videos", "frames in the common time", got, "leave it out (without=)")
    return chosen, why


def _nearest(clock: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Find which of two or more ascending instants is the nearest to each time."""
    right = np.searchsorted(clock, times).clip(1, len(clock) - 1)
    return np.where(times - clock[right - 1] <= clock[right] - times, right - 1, right)


def capture_rig(
    folder: Path,
    out: Path,
    search: Search,
    step: Step,
    *,
    masks: Path | None = None,
    offsets: Offsets = None,
    without: Sequence[str] = (),
    fixed: bool | None = None,
    rate: float | None = None,
    name_pattern: str | None = None,
    frames: int | None = None,
    size: int | None = 1600,
    force: bool = False,
) -> dict:
    """Make a scene of several films in ``out`` and return what was found, as ``pipeline.capture`` does.

    Args:
        folder: of the films; see ``recordings``.
        out, search, step, size: as of ``pipeline.capture``.
        masks: a folder for each camera, of masks of what moves.
        offsets: see ``offsets_of``.
        without: names of cameras to leave out.
        fixed: whether the cameras stand; None: as the images of each show.
        rate: images a second, of folders of images.
        name_pattern: see ``recordings``.
        frames: of each camera; None: see ``choose``.
        force: go on without cameras that see nothing of the others.

    Raises:
        ValueError: where nothing good comes of it, naming the camera.
    """
    without = [str(name) for name in without]  # a name of digits is read as a number
    if isinstance(offsets, Mapping):
        offsets = {str(name): seconds for name, seconds in offsets.items()}
    everyone, films = list(cameras_in(folder)), recordings(folder, rate, without, name_pattern)
    left = [line for film in films for line in film.told]
    about = {"videos": folder, "masks": masks, "fixed": fixed, "rate": rate, "frames": frames, "size": size}
    about |= {"name_pattern": name_pattern} if name_pattern is not None else {}
    with work_for(out, search, (folder, masks), **about, offsets=offsets) as folder_of_work:
        work = _Work(folder_of_work, masks, size, search.threads)
        is_timed = rate is not None or not films[0].images
        began, heard, how = offsets_of(films, offsets, everyone, step, is_timed)
        *span, missing = span_of(films, began)
        taken, why = choose(films, began, span, frames)
        write_json(work.folder / TAKEN, {"cameras": [film.name for film in films]})
        taken = _look(work, taken, fixed, step)
        model, error, matches = _poses(work, taken, search, step)
        found = dataclasses.replace(Reconstruction.of(model), error=error)
        lost = lost_of(taken, found, matches, force)
        poses.refuse_lenses(found)
        poses.refuse_misfit(found)
        found = scene.placed(found)
        limits, errors = scene.limits_of(found), poses.errors_of(model)
        cameras = {}
        for k, mine in enumerate(taken):
            of_mine = [errors[name] for name in mine.looks if name in errors]
            cameras[mine.film.name] = {
                **_facts_of(mine, found),
                "offset": float(began[k]),
                **{key: None if heard is None else getattr(heard, key)[k].item() for key in _HEARD},
                "reprojection_error": float(np.mean(of_mine)) if of_mine else None,
                "matches": matches[mine.film.name][0],
            }
        used = [mine for mine in taken if mine.film.name not in lost]
        images, every = _frames_of(work, used, found, why, step)
        with step("writing") as progress, folder_written_whole(out, ABOUT) as whole:
            of_frames = dataclasses.replace(found, cameras=every)
            written = scene.write(whole, is_timed, images, of_frames, limits, progress)
            unmasked = f"{masks}: {NO_MASKS}" if masks is not None and not written["moving"] else None
            owner = {name: mine.film.name for mine in taken for name in mine.looks}
            write_png(whole / PICTURE, scene.draw(found, limits, [owner[name] for name in found.cameras]))
            facts = {
                "source": str(folder),
                "cameras": cameras,
                "offsets": how,
                "span": span,
                "without": sorted({*everyone} - {*cameras}),
                "lost": lost,
                "told": [*filter(None, [missing, unmasked]), *left, *_suspects(cameras)],
                "why": why,
                "moments": len({*images.moments.values()}),
                "pictures": len(images.times),
                "registered": len(every),
                **scene.facts_of_space(found, limits),
                **written,
            }
            record(whole, facts)
    return facts


def _suspects(cameras: Mapping[str, dict]) -> list[str]:
    """Say which cameras fit much worse than the others."""
    errors = {name: facts["reprojection_error"] for name, facts in cameras.items() if facts["lens"]}
    usual = float(np.median(list(errors.values())))
    return [
        f"{name}: expected a reprojection error as of the others, {usual:.2f} pixels, but got {error:.2f}; "
        f"if it was moved while filming, leave it out: {_without(name)}"
        for name, error in errors.items()
        if error > max(1.0, _WORSE * usual)
    ]


@dataclass(frozen=True)
class _Work:
    """What the steps share: the ``folder`` of the work, the ``masks`` given, ``size`` and ``threads``."""

    folder: Path
    masks: Path | None
    size: int | None
    threads: int | None

    def given(self, film: Recording, rows: Sequence[int], size: Sequence[int], to: str) -> list[np.ndarray]:
        """Write the masks that were given of some frames, black where something moves, and read them."""
        mine, sizes = self.masks / film.name, {film.frame(row): tuple(size) for row in rows}
        if not mine.is_dir():
            got = f"none called {film.name} in {self.masks}"
            raise mismatch("masks", "a sub-folder for each camera", got)
        originals = {film.frame(row): film.images[row].name for row in rows} if film.images else {}
        write_masks(self.folder / to, mine, sizes, rows, len(film.stamps), originals)
        return [read_mask(self.folder / to / f"{name}.png") for name in sizes]

    def take(self, mine: Taken, still: Still | None = None, tick: Progress = lambda *_: None) -> None:
        """Write the frames of a camera and what moves in them, unless an earlier call has done so."""
        marker = self.folder / "pictures" / f"{mine.film.name}.json"
        if (read_json(marker) or {}).get("rows") == mine.rows:
            return
        pixels_of = mine.film.pixels(mine.rows, self.size, self.threads)
        for done, (name, pixels) in enumerate(zip(mine.names, pixels_of), 1):
            write_image(self.folder / "pictures" / name, pixels)
            if still is not None:
                write_mask(self.folder / "masks" / f"{name}.png", still.moves(pixels))
            tick(done, len(mine.rows))
        if self.masks is not None:
            self.given(mine.film, mine.rows, pixels.shape[1::-1], "masks")
        write_json(marker, {"rows": mine.rows})


def _look(work: _Work, taken: Sequence[Taken], fixed: bool | None, step: Step) -> list[Taken]:
    """Write the images that poses are found from, unless an earlier call has done so; note their names."""
    looked = []
    with step("looking at instants") as progress:
        for mine in taken:
            marker = work.folder / "looks" / f"{mine.film.name}.json"
            told = read_json(marker) or {}
            if told.get("rows") != mine.rows:
                told = {"rows": mine.rows, **_look_at(work, mine, fixed)}
                write_json(marker, told)
            looked.append(dataclasses.replace(mine, looks=told["names"], is_fixed=told["fixed"]))
            progress(len(looked), len(taken))
    return looked


def _look_at(work: _Work, mine: Taken, fixed: bool | None) -> dict:
    """Write one camera's images: the still of a fixed one, all frames of another."""
    looks, dark, film, rows = work.folder / "looks", work.folder / "looks_masks", mine.film, mine.rows
    place = quote(film.name, safe="")  # pycolmap's list of pairs has no place for a space
    few = sorted({rows[i] for i in np.linspace(0, len(rows) - 1, _INSTANTS).round().astype(int)})
    images = list(film.pixels(few, work.size, work.threads))
    size = images[0].shape[1::-1]
    if not (is_fixed(images) if fixed is None else fixed):
        names = [f"{place}/{row + 1:06d}.jpg" for row in rows]
        work.take(mine)
        for frame, name in zip(mine.names, names):
            (looks / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(work.folder / "pictures" / frame, looks / name)
            given = work.folder / "masks" / f"{frame}.png"
            moves = read_mask(given) if work.masks else np.zeros(size[::-1], bool)
            write_mask(dark / f"{name}.png", moves)
        return {"fixed": False, "names": names}
    name = f"{place}/still_{few[0]}_{few[-1]}_{len(few)}.png"
    still = Still.of(images)
    write_image(looks / name, np.sort(images, axis=0)[len(images) // 2])
    polluted = np.mean([still.moves(image) for image in images], axis=0) >= _POLLUTED
    moves = resized_mask(polluted, size)
    if work.masks is not None:
        moves |= np.mean(work.given(film, few, size, "given"), axis=0) >= _POLLUTED
    write_mask(dark / f"{name}.png", moves)
    np.savez(looks / f"{film.name}.npz", image=still.image, least=still.least)
    return {"fixed": True, "names": [name]}


def _poses(
    work: _Work, taken: Sequence[Taken], search: Search, step: Step
) -> tuple[pycolmap.Reconstruction, float, dict[str, tuple[int, str]]]:
    """Find all cameras in one world, unless an earlier call has done so.

    Returns:
        the model; its mean reprojection error before doubtful points were deleted; and of each camera its
        most matches with another, and which that is.

    Raises:
        ValueError: where no two cameras see the same.
    """
    names = [name for mine in taken for name in mine.looks]
    looks, dark = work.folder / "looks", work.folder / "looks_masks"
    with step("features") as progress:
        database = poses.find_features(work.folder, looks, dark, search, progress, names=names)
    with step("matches") as progress:
        poses.match(database, search, progress, named=_pairs(taken, search))
    matches = _most_matches(database, taken)
    before = kept(work.folder)
    if before is not None and before[1]["names"] == names:
        return before[0], before[1]["error"], matches
    with step("poses") as progress:
        model = poses.reconstruct(database, looks, search, progress, names)
    if model is None:
        got = f"{max(count for count, _ in matches.values())} matches between two at most"
        advice = "put textured things into the scene, or the cameras closer together"
        raise mismatch("videos", "cameras that see the same things", got, advice)
    with step("adjustment") as progress:
        error = poses.adjust(model, search, progress, _RIG_VIEWS)
    keep(work.folder, model, {"error": error, "names": names})
    return model, error, matches


def _pairs(taken: Sequence[Taken], search: Search) -> list[tuple[str, str]]:
    """Choose which images are matched: all stills; the frames of a moving camera with those near in time, a
    few with each still, and those of one instant with each other.
    """
    pairs = []
    for mine in taken:
        pairs += [(mine.looks[i], mine.looks[j]) for i, j in poses.pairs_of(len(mine.looks), search.matching)]
    for first, second in combinations(taken, 2):
        if len(first.looks) > 1 and len(second.looks) > 1:
            look_at = dict(zip(second.moments, second.looks))
            pairs += [(a, look_at[m]) for a, m in zip(first.looks, first.moments) if m in look_at]
        else:
            few = [mine.looks[:: math.ceil(len(mine.looks) / _LOOKS)] for mine in (first, second)]
            pairs += product(*few)
    return pairs


def _most_matches(database: Path, taken: Sequence[Taken]) -> dict[str, tuple[int, str]]:
    """Count of each camera the most matches with an image of another."""
    owner = {name: mine.film.name for mine in taken for name in mine.looks}
    most = {mine.film.name: (0, "") for mine in taken}
    with pycolmap.Database.open(database) as base:
        names = {image.image_id: image.name for image in base.read_all_images()}
        for key, count in zip(*base.read_two_view_geometry_num_inliers()):
            cameras = [owner.get(names[number]) for number in pycolmap.pair_id_to_image_pair(key)]
            if None not in cameras and cameras[0] != cameras[1]:
                for mine, other in (cameras, cameras[::-1]):
                    most[mine] = max(most[mine], (int(count), other))
    return most


def lost_of(taken: Sequence[Taken], found: Reconstruction, matches: Mapping, force: bool) -> list[str]:
    """Name the cameras without poses: those that stand, and those with poses of less than half their frames.

    Raises:
        ValueError: naming them, unless ``force``.
    """
    shares = {mine.film.name: np.mean([name in found.cameras for name in mine.looks]) for mine in taken}
    lost = [name for name, share in shares.items() if share < poses.MIN_REGISTERED]
    if lost and (not force or len(taken) - len(lost) < 2):
        count, other = matches[lost[0]]
        got = f"{count} matches" + (f" at most, with {other}" if other else "")
        got += f" (and {', '.join(lost[1:])})" if lost[1:] else ""
        advice = f"leave it out ({_without(*lost)}), or go on without it (force=true)"
        raise mismatch(lost[0], "a camera that sees what the others see", got, advice)
    return lost


def _frames_of(
    work: _Work, taken: Sequence[Taken], found: Reconstruction, why: str, step: Step
) -> tuple[Frames, dict]:
    """Take the frames of all films and mask what moves; also return the camera of each that has a pose."""
    total, before, told, masks = sum(len(mine.rows) for mine in taken), 0, set(), work.folder / "masks"
    times, moments, taken_by, cameras = {}, {}, {}, {}
    with step("frames, what moves") as progress:
        for mine in taken:
            film, names, still = mine.film, mine.names, None
            if mine.is_fixed and work.masks is None:
                still = Still(**np.load(work.folder / "looks" / f"{film.name}.npz"))
            work.take(mine, still, lambda done, _, before=before: progress(before + done, total))
            before += len(names)
            progress(before, total)
            taken_by |= dict.fromkeys(names, film.name)
            times |= zip(names, mine.times)
            moments |= zip(names, mine.moments)
            looks = mine.looks * (len(names) if mine.is_fixed else 1)
            posed = {n: found.cameras[look] for n, look in zip(names, looks) if look in found.cameras}
            cameras |= posed
            if work.masks is None and not mine.is_fixed and posed:
                paths = [work.folder / "pictures" / name for name in posed]
                of_film = moving_masks(paths, list(posed.values()))
                told.add("optical flow" if of_film else None)
                for name, mask in zip(posed, of_film or ()):
                    write_mask(masks / f"{name}.png", mask)
            elif posed:
                told.add("the masks given" if work.masks else "differences from what is mostly there")
    dark, by_camera = None if None in told else masks, {"cameras": taken_by, "moments": moments}
    sources = " and ".join(sorted(filter(None, told)))
    images = Frames(work.folder / "pictures", dark, times, why=why, masks_from=sources, **by_camera)
    return images, dict(sorted(cameras.items(), key=lambda pair: times[pair[0]]))


def _facts_of(mine: Taken, found: Reconstruction) -> dict:
    """Gather what is known of one camera."""
    film, posed = mine.film, [name for name in mine.looks if name in found.cameras]
    facts = {"file": film.path.name, "fixed": mine.is_fixed, "found": len(film.stamps)}
    facts |= {"rate": 1 / film.gap if not film.images else None, "variable_rate": film.is_variable}
    facts |= {"pictures": len(mine.rows), "looked_at": len(mine.looks), "posed": len(posed)}
    return facts | {"lens": scene.lens_facts(found.cameras[posed[0]]) if posed else None}


def summary(facts: dict) -> list[str]:
    """Say what was found: a line for each camera, and a few of all."""
    lines = [f"offsets: {facts['offsets']}", f"frames: {facts['pictures']}; {facts['why']}"]
    for name, camera in facts["cameras"].items():
        line = f"{name}: begins at {camera['offset']:.4f} s"
        if camera["certainty"] is not None:
            line += f" (certainty {camera['certainty']:.1f}, {camera['agreeing']} pairs agree to "
            line += f"{1e3 * camera['residual']:.1f} ms)"
        line += "" if camera["rate"] is None else f", {camera['rate']:.5g} a second"
        line += f"{', varying' if camera['variable_rate'] else ''}, {camera['pictures']} frames; "
        if lens := camera["lens"]:
            line += f"{lens['degrees']:.1f} degrees wide, {'fixed' if camera['fixed'] else 'moving'}, "
            line += f"error {camera['reprojection_error']:.2f} pixels"
        lines.append(line if lens else f"{line}no pose")
    sure = f"points: {facts['points']:,}, {facts['sure_points']:,} of them sure, reprojection error "
    lines.append(f"{sure}{facts['reprojection_error']:.2f} pixels")
    lines.append(f"{scene.space_line(facts)}, where what the cameras see is 1 away")
    lines += scene.moving_line(facts)
    lines += [f"left out: {', '.join(facts[key])}" for key in ("without", "lost") if facts[key]]
    return lines + facts["told"]
