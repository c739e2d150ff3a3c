"""``windows=N``: a long film in parts, by two commands; and how they did together."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import fmean

from forewarp.data.files import mismatch
from forewarp.files import read_json
from forewarp.runs.overrides import is_sweep, key_of, text_override

_MOST = 1000
_SEAM = 1e-4  # of a film, by which a window may begin beside the end of the one before
_SHOWS = ("--cfg", "-c", "--info", "-i", "--hydra-help", "--shell-completion", "-sc")  # no run
_SHOWN = ("psnr", "ssim", "ms_ssim", "lpips_vgg", "lpips_alex", "lpips_squeeze")  # of the metrics, if there


def commands_of(arguments: Sequence[str]) -> list[list[str]]:
    """Return the command lines that one with ``windows=N`` stands for; any other stands for itself.

    First comes what stands still in all of the film, then a sweep over its windows, each of which begins from
    it. ``run=FOLDER`` is the folder of all of them. With ``start=RUN`` that run is what stands still.

    Raises:
        ValueError: for a number of windows that there cannot be, or a window beside it.

    >>> for line in commands_of(["windows=2", "seed=1"]):
    ...     print(*line)
    windows=still seed=1 --multirun
    windows=each data.window=[0,0.5],[0.5,1] seed=1 --multirun
    """
    typed = {key_of(argument): argument.partition("=")[2] for argument in arguments}
    value = typed.get("windows", "null")
    if value in ("still", "each", "null"):
        return [list(arguments)]
    if not value.isdecimal() or not 2 <= int(value) <= _MOST:
        raise mismatch("windows", f"a whole number from 2 to {_MOST}, still or each", value)
    if "data.window" in typed:
        raise ValueError(f"data.window: expected none beside windows={value}; leave it out, or windows=each")
    others = [one for one in arguments if key_of(one) not in ("windows", "run", "-m", "--multirun")]
    for one in arguments:
        if key_of(one) != "seed" and not one.startswith("-") and is_sweep(one):
            raise mismatch(key_of(one), f"one value beside windows={value}", "several", "choose one")
    is_shown = any(one.partition("=")[0] in _SHOWS for one in others)  # the config, of the first window
    ends = [f"{number / int(value):.6g}" for number in range(int(value) + 1)]
    limits = [f"[{begin},{end}]" for begin, end in zip(ends, ends[1:])]  # as Hydra takes a choice of several
    limits = ",".join(limits[:1] if is_shown else limits)
    still, each = ["windows=still"], ["windows=each", f"data.window={limits}"]
    if "run" in typed:
        folder = typed["run"].strip("'\"")
        still.append(text_override("run", f"{folder}/still"))
        each.append(text_override("run", f"{folder}/{{hash}}"))
        each += [] if "start" in typed else [text_override("start", f"{folder}/still")]
    if is_shown:
        return [[*each, *others]]
    commands = [each] if "start" in typed else [still, each]
    return [[*first, *others, "--multirun"] for first in commands]


def scores_of(folders: Iterable[str | Path]) -> list[str]:
    """Return a table of the scores of a film's windows, in their order, and of all test views of all windows;
    nothing where fewer than two of the runs are windows.
    """
    windows = []
    for folder in map(Path, folders):
        protocol = (read_json(folder / "metrics.json") or {}).get("protocol", {})
        views = (read_json(folder / "per_image.json") or {}).get("images", [])
        if protocol.get("window") and views:
            windows.append((*protocol["window"], [view["scores"] for view in views]))
    if len(windows) < 2:
        return []
    windows.sort(key=lambda window: window[:2])
    rows = [(f"{begin:.4g} to {end:.4g}", scores) for begin, end, scores in windows]
    rows.append(("all", [score for _, _, scores in windows for score in scores]))
    names = [name for name in _SHOWN if all(name in score for score in rows[-1][1])]
    width = max(len(label) for label, _ in rows)
    lines = [f"{len(windows)} windows of a film, means over their test views:"]
    for label, scores in rows:
        means = "  ".join(f"{name} {fmean(score[name] for score in scores):.4f}" for name in names)
        lines.append(f"  {label:<{width}}  {len(scores):>4} views  {means}")
    return lines


def check_film(windows: Sequence[tuple[float, float]], folder: Path) -> None:
    """Refuse windows, in their order, that do not make up a whole film.

    Raises:
        ValueError: naming them.
    """
    ends = [0.0, *(end for _, end in windows)]
    follow = all(abs(begin - end) < _SEAM for (begin, _), end in zip(windows, ends))
    if not windows or not follow or abs(ends[-1] - 1) > _SEAM:
        got = ", ".join(f"[{begin:g}, {end:g}]" for begin, end in windows) or "none"
        advice = "train those that are missing (windows=N), move others elsewhere"
        raise mismatch(folder, "a run, or windows that follow one another from 0 to 1", got, advice)
