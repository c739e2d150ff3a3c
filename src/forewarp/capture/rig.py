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
from itertools import combinations
from pathlib import Path
from urllib.parse import quote

import cv2
import numpy as np
import pycolmap
import torch

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
    shrunk,
    write_masks,
)
from forewarp.capture.motion import Still, moving_masks
from forewarp.capture.pipeline import ABOUT, PICTURE, fingerprint, keep, kept, record, work_folder
from forewarp.capture.poses import Reconstruction, Search
from forewarp.capture.sync import MOST as HEARD
from forewarp.capture.sync import RATE, Synchrony, is_silent, synchronise
from forewarp.data.files import mismatch
from forewarp.data.images import by, in_order, read_image, write_image
from forewarp.data.transforms import numbers_in
from forewarp.data.video import VIDEOS, extracted, sound_of, stamps_of, start_of
from forewarp.drawing.images import write_png
from forewarp.files import folder_written_whole, read_json, write_json
from forewarp.ops.backend import is_number

_INSTANTS, _POLLUTED = 9, 1 / 3  # of a still; share of them in which a pixel that moves is not matched
_SEEK = 600  # frames after which a film's instants are sought, not decoded on the way
_MOST_IMAGES = 6000  # of all cameras, where frames= does not say so
_FLOW = 320  # pixels of the longer side in which a camera's own motion is looked for
# Gradient of texture; pixels of 640; share that rests if it is fixed.
_EDGES, _RESTS, _AT_REST = 20.0, 1.0, 0.5
_LOOKS = 24  # frames of a moving camera that are matched with each other camera
_LEAST_SPAN = 0.5  # of the median film, below which a few may miss parts of the span
_MOST_OF = 0.75  # of the cameras: so many film all of the span then
_RIG_VIEWS = 3  # from which on a point is sure: cameras of a rig are far apart
_VARIES = 0.05  # by which the gaps between frames may differ at a constant rate
_WORSE = 3.0  # times the median error of all cameras, from which on one is named
_SOUNDS = "sound"


@dataclass(frozen=True)
class Recording:
    """What one camera of a rig took: a video at ``path``, or the ``images`` of a folder; ``stamps`` are their
    seconds on its own clock.
    """

    name: str
    path: Path
    stamps: np.ndarray
    images: tuple[Path, ...] = ()

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
            first = read_image(self.images[0], upright=True).shape
            for row in rows:
                pixels = read_image(self.images[row], upright=True).numpy()[..., :3]
                if pixels.shape[:2] != first[:2]:
                    expected = f"{by(first[1::-1])} pixels as {self.images[0].name}"
                    raise mismatch(self.images[row], expected, by(pixels.shape[1::-1]), _without(self.name))
                longer = max(pixels.shape[:2])
                if size is not None and size < longer:
                    pixels = shrunk(pixels, *(max(1, round(n * size / longer)) for n in pixels.shape[:2]))
                yield pixels
            return
        if len(rows) * _SEEK < rows[-1]:
            starts = (start_of(self.stamps, row) for row in rows)
            sought = (extracted(self.path, [0], size, threads, start=start) for start in starts)
            frames = (frame for film in sought for frame in film)
        else:
            frames = extracted(self.path, list(rows), size, threads)
        count = 0
        for pixels in frames:
            count += 1
            yield pixels
        if count < len(rows):
            got = f"{count} of {len(rows)}"
            raise ValueError(
                f"{self.path}: expected the frames of its index, but got {got}; convert the video"
            )


def cameras_in(folder: Path) -> dict[str, Path]:
    """Find the cameras of a rig, in the order of names: a video for each, else a sub-folder of images.

    Raises:
        ValueError: for fewer than two, and for two videos of one name.
    """
    there = [path for path in folder.iterdir() if not path.name.startswith(".")]
    paths = [path for path in there if path.is_file() and path.suffix.lower() in VIDEOS]
    if twice := sorted(path.name for path in paths if sum(path.stem == one.stem for one in paths) > 1):
        raise ValueError(f"{folder}: expected a video for each camera, but got {twice[0]} and {twice[1]}")
    found = {path.stem: path for path in paths}
    if not found:
        inner = ((path, place) for path in there if path.is_dir() for place in (path, path / "images"))
        found = {path.name: place for path, place in inner if place.is_dir() and images_in(place)}
    if len(found) < 2:
        got = f"one, {next(iter(found))}; for one camera set video=" if found else "none"
        raise ValueError(
            f"videos: expected at least two videos, or sub-folders of pictures, in {folder}, but got {got}"
        )
    return {name: found[name] for name in in_order(found)}


def recordings(folder: Path, rate: float | None, without: Sequence[str] = ()) -> list[Recording]:
    """Look at what each camera of a rig took.

    Args:
        folder: see ``cameras_in``.
        rate: images a second of sub-folders; None: their times are numbers.
        without: names of cameras to leave out, which are not looked at.

    Raises:
        ValueError: for fewer than two, for what is no video, and for a name to leave out that is not there.
    """
    found = cameras_in(folder)
    _refuse_unknown("without", without, found)
    used = [name for name in found if name not in without]
    if len(used) < 2:
        raise ValueError(f"without: expected at least two cameras left, but got {len(used)} of {len(found)}")
    return [_recording(name, found[name], rate) for name in used]


def _recording(name: str, path: Path, rate: float | None) -> Recording:
    images, stamps = (), np.empty(0)
    if path.is_dir():
        images = tuple(images_in(path))
        numbers = numbers_in([image.stem for image in images]) or range(len(images))
        stamps = np.array(numbers, dtype=np.float64) / (rate or 1.0)
        order = np.argsort(stamps, kind="stable")
        images, stamps = tuple(images[row] for row in order), stamps[order]
    else:
        stamps = stamps_of(path)
    if len(stamps) < 2:
        kind = "pictures" if images else "frames"
        got = f"{len(stamps)} {kind}" if len(stamps) else "another file"
        raise ValueError(f"{path}: expected many {kind}, but got {got}; leave it out ({_without(name)})")
    if not np.all(np.diff(stamps) > 0):
        raise ValueError(f"{path}: expected frames at different times, but got two at one; convert the video")
    return Recording(name, path, stamps, images)


def _without(*names: str) -> str:
    """Write what leaves cameras out."""
    plain = [name if re.fullmatch(r"[\w.-]+", name) else repr(name) for name in names]
    return f"without=[{','.join(plain)}]"


def _refuse_unknown(key: str, names: Sequence[str], there: Sequence[str]) -> None:
    if unknown := [name for name in names if name not in there]:
        few = ", ".join(in_order(there)[:6]) + (" .." if len(there) > 6 else "")
        raise ValueError(f"{key}: expected names of {few}, but got {unknown[0]}; see the names of the videos")


def offsets_of(
    films: Sequence[Recording],
    wanted: str | float | Sequence[float] | Mapping[str, float] | None,
    everyone: Sequence[str],
    step: Step,
    is_timed: bool = True,
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
    if isinstance(wanted, Mapping):
        _refuse_unknown("offsets", list(wanted), everyone)
        if missing := [film.name for film in films if film.name not in wanted]:
            got = f"none of {missing[0]}"
            raise ValueError(f"offsets: expected one of each camera, but got {got}; leave it out, or add it")
        values = dict(wanted)
    elif isinstance(wanted, (list, tuple)):
        if len(wanted) != len(everyone):
            got = f"{len(wanted)}"
            raise ValueError(f"offsets: expected one of each of {len(everyone)} cameras, but got {got}")
        values = dict(zip(everyone, wanted))
    elif wanted in ("none", 0):
        return np.zeros(len(films)), None, "all begin together, as offsets= says"
    elif wanted in (None, _SOUNDS):
        return _heard_offsets(films, wanted is not None, step)
    else:
        expected = "expected seconds for each camera, sound, none or null"
        raise ValueError(f"offsets: {expected}, but got {wanted!r}; set offsets=")
    for name, value in values.items():
        if not is_number(value):
            raise ValueError(f"offsets: expected seconds, but got {value!r} of {name}; set offsets=")
    chosen = np.array([float(values[film.name]) for film in films])
    if not is_timed and np.ptp(chosen) > 0:
        raise ValueError(
            "offsets: expected rate= beside them, images a second of the sub-folders, but got none"
        )
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
            return (
                np.zeros(len(films)),
                None,
                "no camera has sound: taken to begin together (offsets= says other)",
            )
        if silent:
            others = f" and {len(silent) - 1} more" if len(silent) > 1 else ""
            raise ValueError(
                f"offsets: expected sound in all videos, but got none in {silent[0]}{others}; set offsets= "
                f"in seconds, offsets=none if all began together, or {_without(*silent)}"
            )
        half = len(films), 2 * len(films)
        heard = synchronise(sounds, lambda done, total: progress(half[0] + half[0] * done // total, half[1]))
    unsure = [film.name for film, is_sure in zip(films, heard.is_sure()) if not is_sure]
    if unsure:
        which = unsure[0] if len(unsure) < len(films) - 1 else "all"
        row = [film.name for film in films].index(unsure[0])
        got = f"{heard.agreeing[row]} of {len(films) - 1} pairs that agree in {which}, with a certainty of "
        got += f"{heard.certainty[row]:.1f}"
        advice = "set offsets= in seconds"
        advice += f", or {_without(*unsure)}" if len(unsure) < len(films) - 1 else ""
        raise ValueError(f"offsets: expected sounds that all cameras share, a clap, but got {got}; {advice}")
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
        raise ValueError(
            f"videos: expected films that overlap in time, but got {got}; set offsets=, or leave one out, "
            f"{_without(films[last].name)}"
        )
    missing = [f.name for f, a, b in zip(films, starts, ends) if a > best[0] or b < best[1]]
    return *best, f"{', '.join(missing)} film only a part of the time that the others share"


@dataclass(frozen=True)
class Taken:
    """Frames of one camera: ``rows`` in its film, their ``times`` on the common clock, ``moments`` the
    numbers of the instants they belong to.
    """

    rows: list[int]
    times: list[float]
    moments: list[int]


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
        grid = np.linspace(*span, asked)
        why = (
            "frames= says so"
            if count is not None
            else f"{asked} instants of up to {most}; frames= takes more"
        )
        # Where there is none within a frame of an instant, a film has none of it.
        near = [(_nearest(clock, grid), clock, film.gap) for clock, film in zip(clocks, films)]
        rows = [np.unique(mine[np.abs(clock[mine] - grid) <= gap]) for mine, clock, gap in near]
    nearest = [_nearest(grid, clock[mine]) for clock, mine in zip(clocks, rows)]
    first = min(int(moments.min(initial=len(grid))) for moments in nearest)
    chosen = [
        Taken(mine.tolist(), clock[mine].tolist(), (moments - first).tolist())
        for clock, mine, moments in zip(clocks, rows, nearest)
    ]
    if empty := [film.name for film, taken in zip(films, chosen) if len(taken.rows) < 2]:
        got = f"none of {empty[0]}"
        raise ValueError(
            f"videos: expected frames in the common time, but got {got}; leave it out (without=)"
        )
    return chosen, why


def _nearest(clock: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Find which of two or more ascending instants is the nearest to each time."""
    right = np.searchsorted(clock, times).clip(1, len(clock) - 1)
    return np.where(times - clock[right - 1] <= clock[right] - times, right - 1, right)


def is_fixed(images: Sequence[np.ndarray]) -> bool:
    """Tell whether a camera stands: what has texture rests between most of its images (H, W, 3) uint8.

    Movers may fill some of the image, the median over the textured pixels does not heed them.
    """
    scale = _FLOW / max(images[0].shape[:2])
    size = [max(32, round(scale * length)) for length in images[0].shape[1::-1]]
    greys = [
        cv2.cvtColor(cv2.resize(image, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
        for image in images
    ]
    search, rests = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM), []
    for other in greys[1:]:
        flow = search.calc(greys[0], other, None)
        texture = np.hypot(cv2.Sobel(greys[0], cv2.CV_32F, 1, 0), cv2.Sobel(greys[0], cv2.CV_32F, 0, 1))
        textured = texture > _EDGES
        lengths = np.hypot(*flow.transpose(2, 0, 1))[textured if textured.mean() > 0.01 else ...]
        rests.append(float((lengths * 640 / _FLOW < _RESTS).mean()))
    return float(np.median(rests)) > _AT_REST


@dataclass(frozen=True)
class Looks:
    """Images that poses are found from: ``names`` of each camera, from ``folder`` on; whether it is fixed."""

    folder: Path
    masks: Path | None
    names: Mapping[str, list[str]]
    fixed: Mapping[str, bool]


def capture_rig(
    folder: Path,
    out: Path,
    search: Search,
    step: Step,
    *,
    masks: Path | None = None,
    offsets: str | float | Sequence[float] | Mapping[str, float] | None = None,
    without: Sequence[str] = (),
    fixed: bool | None = None,
    rate: float | None = None,
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
        frames: of each camera; None: see ``choose``.
        force: go on without cameras that see nothing of the others.

    Raises:
        ValueError: where nothing good comes of it, naming the camera.
    """
    without = [str(name) for name in without]  # a name of digits is read as a number
    if isinstance(offsets, Mapping):
        offsets = {str(name): seconds for name, seconds in offsets.items()}
    everyone, films = list(cameras_in(folder)), recordings(folder, rate, without)
    about = {"videos": folder, "masks": masks, "fixed": fixed, "rate": rate, "frames": frames, "size": size}
    about |= {"offsets": offsets, **dataclasses.asdict(search)}
    del about["threads"]
    about["files"] = [fingerprint(path) for path in (folder, masks) if path is not None]
    cv2.setNumThreads(search.threads or -1)
    if search.threads is not None:
        torch.set_num_threads(search.threads)
    with work_folder(out, about) as folder_of_work:
        work = _Work(folder_of_work, masks, size, search.threads)
        is_timed = rate is not None or not films[0].images
        began, heard, how = offsets_of(films, offsets, everyone, step, is_timed)
        *span, missing = span_of(films, began)
        taken, why = choose(films, began, span, frames)
        write_json(folder_of_work / TAKEN, {"cameras": [film.name for film in films]})
        looks = _look(work, films, taken, fixed, step)
        model, error, matches = _poses(work, films, taken, looks, search, step)
        found = dataclasses.replace(Reconstruction.of(model), error=error)
        lost = lost_of(films, looks, found, matches, force)
        poses.refuse_lenses(found)
        poses.refuse_misfit(found)
        found = scene.placed(found)
        limits = scene.limits_of(found)
        errors, owner = poses.errors_of(model), {n: film for film, mine in looks.names.items() for n in mine}
        cameras = {}
        for k, (film, mine) in enumerate(zip(films, taken)):
            of_film = [errors[name] for name in looks.names[film.name] if name in errors]
            cameras[film.name] = {
                **_facts_of(film, float(began[k]), mine, looks, found),
                "certainty": None if heard is None else float(heard.certainty[k]),
                "residual": None if heard is None else float(heard.residual[k]),
                "agreeing": None if heard is None else int(heard.agreeing[k]),
                "reprojection_error": float(np.mean(of_film)) if of_film else None,
                "matches": matches[film.name][0],
            }
        used = [pair for pair in zip(films, taken) if pair[0].name not in lost]
        images, every = _frames_of(work, *zip(*used), looks, found, why, step)
        with step("writing") as progress, folder_written_whole(out, ABOUT) as written:
            of_frames = dataclasses.replace(found, cameras=every)
            scales, moving = scene.write(written, is_timed, images, of_frames, limits, progress)
            unmasked = f"{masks}: {NO_MASKS}" if masks is not None and not moving else None
            write_png(written / PICTURE, scene.draw(found, limits, [owner[name] for name in found.cameras]))
            facts = {
                "source": str(folder),
                "cameras": cameras,
                "offsets": how,
                "span": span,
                "without": sorted({*everyone} - {*cameras}),
                "lost": lost,
                "told": [*filter(None, [missing, unmasked]), *_suspects(cameras)],
                "why": why,
                "moments": len({*images.moments.values()}),
                "pictures": len(images.times),
                "registered": len(every),
                "reprojection_error": found.error,
                "points": len(found.points),
                "sure_points": len(found.sure()),
                "near": limits.near,
                "far": limits.far,
                "box": [*limits.box.low, *limits.box.high],
                "scales": scales,
                "moving": moving,
            }
            record(written, facts)
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
        mine, names = self.masks / film.name, [film.frame(row) for row in rows]
        if not mine.is_dir():
            got = f"none called {film.name} in {self.masks}"
            raise ValueError(f"masks: expected a sub-folder for each camera, but got {got}")
        originals = {name: film.images[row].name for name, row in zip(names, rows)} if film.images else {}
        done = {"times": dict.fromkeys(names, 0.0), "rows": list(rows), "found": len(film.stamps)}
        done |= {"sizes": dict.fromkeys(names, tuple(size)), "originals": originals}
        write_masks(self.folder / to, mine, done)
        return [read_image(self.folder / to / f"{name}.png")[..., 0].numpy() == 0 for name in names]

    def take(self, film: Recording, rows: Sequence[int], still: Still | None, tick: Progress | None) -> None:
        """Write frames of a film and what moves in them, unless an earlier call has done so."""
        marker = self.folder / "pictures" / f"{film.name}.json"
        if (read_json(marker) or {}).get("rows") == list(rows):
            return
        for done, (row, pixels) in enumerate(zip(rows, film.pixels(rows, self.size, self.threads)), 1):
            name = film.frame(row)
            write_image(self.folder / "pictures" / name, pixels)
            if still is not None:
                _write_mask(self.folder / "masks" / f"{name}.png", still.moves(pixels))
            if tick is not None:
                tick(done, len(rows))
        if self.masks is not None:
            self.given(film, rows, pixels.shape[1::-1], "masks")
        write_json(marker, {"rows": list(rows), "size": list(pixels.shape[1::-1])})


def _write_mask(path: Path, moving: np.ndarray) -> None:
    """Write a mask, black where something moves."""
    write_image(path, np.where(moving, 0, 255).astype(np.uint8))


def _look(
    work: _Work, films: Sequence[Recording], taken: Sequence[Taken], fixed: bool | None, step: Step
) -> Looks:
    """Write the images that poses are found from, unless an earlier call has done so."""
    names, stands = {}, {}
    with step("looking at instants") as progress:
        for done, (film, mine) in enumerate(zip(films, taken), 1):
            marker = work.folder / "looks" / f"{film.name}.json"
            told = read_json(marker) or {}
            if told.get("rows") != mine.rows:
                told = {"rows": mine.rows, **_look_at(work, film, mine.rows, fixed)}
                write_json(marker, told)
            names[film.name], stands[film.name] = told["names"], told["fixed"]
            progress(done, len(films))
    return Looks(work.folder / "looks", work.folder / "looks_masks", names, stands)


def _look_at(work: _Work, film: Recording, rows: Sequence[int], fixed: bool | None) -> dict:
    """Write one camera's images: the still of a fixed one, all frames of another."""
    looks, dark = work.folder / "looks", work.folder / "looks_masks"
    place = quote(film.name, safe="")  # pycolmap's list of pairs has no place for a space
    few = sorted({rows[i] for i in np.linspace(0, len(rows) - 1, _INSTANTS).round().astype(int)})
    images = list(film.pixels(few, work.size, work.threads))
    size = images[0].shape[1::-1]
    if not (is_fixed(images) if fixed is None else fixed):
        names = [f"{place}/{row + 1:06d}.jpg" for row in rows]
        work.take(film, rows, None, None)
        for row, name in zip(rows, names):
            (looks / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(work.folder / "pictures" / film.frame(row), looks / name)
            given = work.folder / "masks" / f"{film.frame(row)}.png"
            moves = read_image(given)[..., 0].numpy() == 0 if work.masks else np.zeros(size[::-1], bool)
            _write_mask(dark / f"{name}.png", moves)
        return {"fixed": False, "names": names}
    name = f"{place}/still_{few[0]}_{few[-1]}_{len(few)}.png"
    still = Still.of(images)
    write_image(looks / name, np.sort(images, axis=0)[len(images) // 2])
    polluted = np.mean([still.moves(image) for image in images], axis=0) >= _POLLUTED
    moves = cv2.resize(polluted.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    if work.masks is not None:
        moves |= np.mean(work.given(film, few, size, "given"), axis=0) >= _POLLUTED
    _write_mask(dark / f"{name}.png", moves)
    np.savez(looks / f"{film.name}.npz", image=still.image, least=still.least)
    return {"fixed": True, "names": [name]}


def _poses(
    work: _Work, films: Sequence[Recording], taken: Sequence[Taken], looks: Looks, search: Search, step: Step
) -> tuple[pycolmap.Reconstruction, float, dict[str, tuple[int, str]]]:
    """Find all cameras in one world, unless an earlier call has done so.

    Returns:
        the model; its mean reprojection error before doubtful points were deleted; and of each camera its
        most matches with another, and which that is.

    Raises:
        ValueError: where no two cameras see the same.
    """
    names = [name for film in films for name in looks.names[film.name]]
    with step("features") as progress:
        database = poses.find_features(work.folder, looks.folder, looks.masks, search, progress, names=names)
    with step("matches") as progress:
        poses.match(database, search, progress, named=_pairs(films, taken, looks, search))
    matches = _most_matches(database, looks)
    before = kept(work.folder)
    if before is not None and before[1]["names"] == names:
        return before[0], before[1]["error"], matches
    with step("poses") as progress:
        models = work.folder / "models"
        shutil.rmtree(models, ignore_errors=True)
        model = poses.reconstruct(database, looks.folder, models, search, progress, names)
    if model is None:
        best = max(count for count, _ in matches.values())
        raise ValueError(
            f"videos: expected cameras that see the same things, but got {best} matches between two at most; "
            "put textured things into the scene, or the cameras closer together"
        )
    with step("adjustment") as progress:
        error = poses.adjust(model, search, progress, _RIG_VIEWS)
    keep(work.folder, model, {"error": error, "names": names})
    return model, error, matches


def _pairs(films, taken: Sequence[Taken], looks: Looks, search: Search) -> list[tuple[str, str]]:
    """Choose which images are matched: all stills; the frames of a moving camera with those near in time, a
    few with each still, and those of one instant with each other.
    """
    pairs = []
    for film in films:
        mine = looks.names[film.name]
        pairs += [(mine[i], mine[j]) for i, j in poses.pairs_of(len(mine), search.matching)]
    for (first, at_first), (second, at_second) in combinations(zip(films, taken), 2):
        here, there = looks.names[first.name], looks.names[second.name]
        if len(here) > 1 and len(there) > 1:
            row_at = dict(zip(at_second.moments, there))
            pairs += [(a, row_at[m]) for a, m in zip(here, at_first.moments) if m in row_at]
        else:
            few = [names[:: math.ceil(len(names) / _LOOKS)] for names in (here, there)]
            pairs += [(a, b) for a in few[0] for b in few[1]]
    return pairs


def _most_matches(database: Path, looks: Looks) -> dict[str, tuple[int, str]]:
    """Count of each camera the most matches with an image of another."""
    owner = {name: camera for camera, mine in looks.names.items() for name in mine}
    most = dict.fromkeys(looks.names, (0, ""))
    with pycolmap.Database.open(database) as base:
        names = {image.image_id: image.name for image in base.read_all_images()}
        for key, count in zip(*base.read_two_view_geometry_num_inliers()):
            cameras = [owner.get(names[number]) for number in pycolmap.pair_id_to_image_pair(key)]
            if None not in cameras and cameras[0] != cameras[1]:
                for mine, other in (cameras, cameras[::-1]):
                    most[mine] = max(most[mine], (int(count), other))
    return most


def lost_of(films, looks: Looks, found: Reconstruction, matches: Mapping, force: bool) -> list[str]:
    """Name the cameras without poses: those that stand, and those with poses of less than half their frames.

    Raises:
        ValueError: naming them, unless ``force``.
    """
    shares = {film.name: np.mean([n in found.cameras for n in looks.names[film.name]]) for film in films}
    lost = [name for name, share in shares.items() if share < poses.MIN_REGISTERED]
    if lost and (not force or len(films) - len(lost) < 2):
        count, other = matches[lost[0]]
        few = f" at most, with {other}" if other else ""
        more = f" (and {', '.join(lost[1:])})" if lost[1:] else ""
        raise ValueError(
            f"{lost[0]}: expected a camera that sees what the others see, but got {count} matches{few}"
            f"{more}; leave it out ({_without(*lost)}), or go on without it (force=true)"
        )
    return lost


def _frames_of(
    work: _Work, films, taken: Sequence[Taken], looks: Looks, found: Reconstruction, why: str, step: Step
) -> tuple[Frames, dict]:
    """Take the frames of all films and mask what moves; also return the camera of each that has a pose."""
    total, before, cameras, sizes, told = sum(len(mine.rows) for mine in taken), 0, {}, {}, set()
    with step("frames, what moves") as progress:
        for film, mine in zip(films, taken):
            names, stands = [film.frame(row) for row in mine.rows], looks.fixed[film.name]
            still = None
            if stands and work.masks is None:
                still = Still(**np.load(looks.folder / f"{film.name}.npz"))
            work.take(film, mine.rows, still, lambda done, _, before=before: progress(before + done, total))
            before += len(names)
            progress(before, total)
            size = read_json(work.folder / "pictures" / f"{film.name}.json")["size"]
            sizes |= dict.fromkeys(names, tuple(size))
            seen_by = looks.names[film.name] * (len(names) if stands else 1)
            posed = {n: found.cameras[look] for n, look in zip(names, seen_by) if look in found.cameras}
            cameras |= posed
            if work.masks is None and not stands and posed:
                paths = [work.folder / "pictures" / name for name in posed]
                nothing, known = np.zeros((size[1], size[0]), bool), 0
                for name, mask in zip(posed, moving_masks(paths, list(posed.values()))):
                    known += mask is not None
                    _write_mask(work.folder / "masks" / f"{name}.png", nothing if mask is None else mask)
                told.add(2 * known > len(posed) and "optical flow")
            elif posed:
                told.add("the masks given" if work.masks else "differences from what is mostly there")
    names = [film.frame(row) for film, mine in zip(films, taken) for row in mine.rows]
    times = dict(zip(names, (time for mine in taken for time in mine.times)))
    moments = dict(zip(names, (moment for mine in taken for moment in mine.moments)))
    taken_by = {film.frame(row): film.name for film, mine in zip(films, taken) for row in mine.rows}
    masks = None if False in told else work.folder / "masks"
    rows = [row for mine in taken for row in mine.rows]
    options = {"why": why, "masks_from": " and ".join(sorted(map(str, told)))}
    options |= {"cameras": taken_by, "moments": moments}
    frames = Frames(work.folder / "pictures", masks, times, rows, len(rows), 0.0, sizes, {}, **options)
    return frames, dict(sorted(cameras.items(), key=lambda pair: times[pair[0]]))


def _facts_of(film: Recording, offset: float, mine: Taken, looks: Looks, found: Reconstruction) -> dict:
    """Gather what is known of one camera."""
    names = looks.names[film.name]
    posed = [name for name in names if name in found.cameras]
    facts = {"file": film.path.name, "fixed": looks.fixed[film.name], "offset": offset}
    facts |= {"rate": 1 / film.gap if not film.images else None, "variable_rate": film.is_variable}
    facts |= {"found": len(film.stamps), "pictures": len(mine.rows), "looked_at": len(names)}
    return facts | {"posed": len(posed), "lens": scene.lens_facts(found.cameras[posed[0]]) if posed else None}


def summary(facts: dict) -> list[str]:
    """Say what was found: a line for each camera, and a few of all."""
    lines = [f"offsets: {facts['offsets']}", f"frames: {facts['pictures']}; {facts['why']}"]
    for name, camera in facts["cameras"].items():
        rate = "" if camera["rate"] is None else f", {camera['rate']:.5g} a second"
        rate += ", varying" if camera["variable_rate"] else ""
        offset = f"begins at {camera['offset']:.4f} s"
        if camera["certainty"] is not None:
            offset += f" (certainty {camera['certainty']:.1f}, {camera['agreeing']} pairs agree to "
            offset += f"{1e3 * camera['residual']:.1f} ms)"
        lens = "no pose"
        if camera["lens"] is not None:
            lens = f"{camera['lens']['degrees']:.1f} degrees wide, {'fixed' if camera['fixed'] else 'moving'}"
            lens += f", error {camera['reprojection_error']:.2f} pixels"
        lines.append(f"{name}: {offset}{rate}, {camera['pictures']} frames; {lens}")
    size = " x ".join(f"{high - low:.2f}" for low, high in zip(facts["box"][:3], facts["box"][3:]))
    lines.append(
        f"points: {facts['points']:,}, {facts['sure_points']:,} of them sure, reprojection error "
        f"{facts['reprojection_error']:.2f} pixels"
    )
    lines.append(
        f"box: {size}, near {facts['near']:.2f}, far {facts['far']:.2f}, where what the cameras see is 1 away"
    )
    if facts["moving"] is not None:
        lines.append(
            f"moving: {facts['moving']:.0%} of the pixels; test frames are scored there and elsewhere"
        )
    lines += [f"left out: {', '.join(facts[key])}" for key in ("without", "lost") if facts[key]]
    return lines + facts["told"]
