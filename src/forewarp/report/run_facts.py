"""Say in short texts what a run is, what it reached, which effects it has and why."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from forewarp.progress import time_text
from forewarp.report.run_files import Story
from forewarp.report.tables import Column, Table

KINDS = {
    "space": "at training times",
    "time": "between training times",
    "canonical": "at the canonical time",
    "all": "all",
}
_ROWS = 1000  # of the table of views
_NAMES = {"psnr": "PSNR (dB)", "ssim": "SSIM", "ms_ssim": "MS-SSIM", "ms_ssim_legacy": "MS-SSIM (legacy)"}


@dataclass(frozen=True)
class Effect:
    """An effect: whether it is on, the option chosen ("" if not known), and why."""

    name: str
    on: bool
    choice: str
    because: str


def described(story: Story) -> str:
    """Name the method, the preset and the seed."""
    config, protocol = story.result.config, story.result.metrics.get("protocol", {})
    method = protocol.get("method") or config["model"]["name"]
    return f"{method}, preset {config['preset']['name']}, seed {story.result.seed}"


def tiles_of(story: Story) -> list[tuple[str, str]]:
    """List what one wants to know first: (name, value)."""
    result, found = story.result, []
    protocol, numbers = result.metrics.get("protocol", {}), result.numbers if result.metrics else {}
    if result.stages or result.curve:
        clock = ", processor time" if result.config["budget"].get("clock") == "processor" else ""
        found.append((f"training{clock}", time_text(seconds_of(story))))
    if "ssim" in numbers:
        found.append(("SSIM", f"{numbers['ssim']:.4f}"))
    scores = result.metrics["test"].get(result.ability, {}) if result.metrics else {}
    lpips = {name: value for name, value in scores.items() if name.startswith("lpips") and value is not None}
    found += [(name_of(name), f"{value:.4f}") for name, value in lpips.items()]
    if "frame" in numbers:
        found.append(("a picture of a new time", f"{1000 * numbers['frame']:.3g} ms"))
    if story.curves.size is not None:
        kind, count = story.curves.size
        found.append((kind, f"{count:,}"))
    if "memory" in numbers:
        found.append(("peak memory", f"{numbers['memory']:.2f} GiB"))
    if protocol.get("device"):
        found.append(("device", str(protocol["device"])))
    return found


def seconds_of(story: Story) -> float:
    """Return the seconds of training: of the finished stages, or as far as the curve goes."""
    finished = sum(float(done["seconds"]) for done in story.result.stages.values())
    return max([finished, *(point.seconds for point in story.result.curve)])


def near(text: str) -> str:
    """Write folders below the current one relative to it, as a page may be passed on."""
    return re.sub(rf"(?<![\w.:/~-]){re.escape(str(Path.cwd()))}/(?=\w)", "", text)


def effects_of(story: Story) -> tuple[str, list[Effect]]:
    """Return in words how the effects were chosen, and the effects."""
    result = story.result
    switched, model = result.metrics.get("effects") or {}, result.config["model"]
    typed = _typed(result.command)
    planned = story.plan.get("effects") or {}
    if planned:
        spent = story.plan.get("seconds")
        took = f" in {time_text(spent)}" if isinstance(spent, int | float) else ""
        about = f"forewarp-plan tried out on this scene what each effect brings{took}, and kept what pays."
    else:
        about = "No plan was made for this run: its effects come from its preset or were typed by hand."
    found = []
    for name in [*planned, *(other for other in switched if other not in planned)]:
        decision = planned.get(name)
        on = switched.get(name, decision["on"] if decision else False)
        own = [one for one in typed if one.split("=")[0].lstrip("+~") in (f"model/{name}", f"model.{name}")]
        if decision is not None and on == decision["on"]:
            choice, because = _option(decision["choice"]), decision["because"]
        else:
            choice = _option(model.get(name))
            because = f"Typed: {' '.join(own)}." if own else _unplanned(typed, model["name"])
        found.append(Effect(name, bool(on), choice, near(str(because))))
    return about, sorted(found, key=lambda one: not one.on)


def _typed(command: str) -> list[str]:
    """Split a command into its overrides.

    >>> _typed("forewarp-train model.motion=none 'a=[1, 2]'")
    ['model.motion=none', 'a=[1, 2]']
    """
    try:
        words = shlex.split(command)
    except ValueError:  # no closing quote
        words = command.split()
    return [word for word in words if "=" in word]


def _unplanned(typed: list[str], method: str) -> str:
    chosen = [one for one in typed if one.split("=")[0] in ("ablation", "experiment", "scene", "preset")]
    return f"As model={method} has it" + (f" with {' '.join(chosen)}." if chosen else " by default.")


def _option(value: object) -> str:
    """Return an option's name; "" for numbers, switches and parts, which say nothing without their key."""
    return value if isinstance(value, str) and value != "none" else ""


def protocol_of(story: Story) -> list[tuple[str, str]]:
    """List how the run was made and measured: (name, value)."""
    result, protocol = story.result, story.result.metrics.get("protocol", {})
    budget = result.config["budget"]
    bounds = [f"{budget['minutes']:g} min"] if budget.get("minutes") is not None else []
    bounds += [f"{budget['iterations']} steps"] if budget.get("iterations") is not None else []
    clock = ", of processor time" if budget.get("clock") == "processor" else ""
    stages = [
        f"{name}: {done['steps']} steps in {time_text(done['seconds'])}"
        for name, done in result.stages.items()
    ]
    resolution = protocol.get("resolution")
    rows = [
        ("scene", f"{result.scene}{', made by a program' if result.is_counterpart else ''}"),
        ("dataset", result.dataset),
        ("resolution", " x ".join(map(str, resolution)) if isinstance(resolution, list) else ""),
        ("budget", (" or ".join(bounds) or "none") + clock),
        ("stages", "; ".join(stages)),
        ("seed", str(result.seed)),
        ("test views", _kinds(story)),
        ("background", str(protocol.get("background", ""))),
        ("rendering scored", str(protocol.get("scored", ""))),
        ("departures", str(protocol.get("departures", ""))),
        ("parameters", f"{result.metrics['parameters']:,}" if "parameters" in result.metrics else ""),
        ("device", str(protocol.get("device", ""))),
        ("threads", str(protocol.get("threads", ""))),
        ("versions", ", ".join(f"{k} {v}" for k, v in protocol.get("versions", {}).items())),
    ]
    return [(name, value) for name, value in rows if value]


def _kinds(story: Story) -> str:
    found = {}
    for view in story.views:
        found[view.ability] = found.get(view.ability, 0) + 1
    return ", ".join(
        f"{count}" + ("" if kind == "all" else f" {KINDS.get(kind, kind)}") for kind, count in found.items()
    )


def scores_of(story: Story) -> Table | None:
    """List every score by kind of test view; None if the run was not measured."""
    test = story.result.metrics.get("test", {})
    names = list(dict.fromkeys(name for scores in test.values() for name in scores))
    if not names:
        return None
    columns = [Column("test views"), *(Column(name_of(name), _digits(name)) for name in names)]
    rows = [[KINDS.get(kind, kind), *map(scores.get, names)] for kind, scores in test.items()]
    return Table(columns, rows, _flow(story))


def _flow(story: Story) -> str:
    flow = story.result.metrics.get("flow") or {}
    error, motion = flow.get("epe_moving"), flow.get("motion_mean")
    if error is None or not motion:
        return ""
    return f"Moving points are off by {error:.4f} world units, {error / motion:.0%} of their motion."


def views_table(story: Story) -> Table:
    """List the scores of every test view, or of the first 1,000."""
    names = list(dict.fromkeys(name for view in story.views for name in view.scores))
    columns = [Column("view"), Column("kind"), Column("time", 3)]
    columns += [Column(name_of(name), _digits(name)) for name in names]
    rows = [
        [view.name, KINDS.get(view.ability, view.ability), view.time, *map(view.scores.get, names)]
        for view in story.views[:_ROWS]
    ]
    count = len(story.views)
    cut = f"The first {_ROWS} of {count} views; per_image.json has all." if count > _ROWS else ""
    return Table(columns, rows, cut)


def name_of(score: str) -> str:
    """Write the name of a score as people do.

    >>> name_of("depth_delta_1.25"), name_of("lpips_vgg"), name_of("psnr")
    ('depth < 1.25', 'LPIPS (vgg)', 'PSNR (dB)')
    """
    if score.startswith("lpips_"):
        return f"LPIPS ({score.removeprefix('lpips_')})"
    return _NAMES.get(score, score.replace("depth_delta_", "depth < ").replace("_", " "))


def _digits(score: str) -> int:
    return 2 if score.startswith("psnr") else 4
