"""Read run folders as plain files, without torch and without running their config."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path

import yaml

from forewarp.files import MOST_CONFIG, read_rows, read_text

# What reading a broken run may raise.
UNREADABLE = OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, yaml.YAMLError


@dataclass(frozen=True)
class Point:
    """A row of ``accuracy_time.csv``: PSNR (dB) of the held-out views after ``seconds`` of training.

    ``epe`` is the error of moving points in world units; None if the truth is unknown.
    """

    seconds: float
    psnr: float
    step: int
    epe: float | None = None


@dataclass(frozen=True)
class Result:
    """One run.

    Attributes:
        folder: the run's folder.
        config: the resolved config.
        stages: the ``done.json`` of each finished stage.
        metrics: content of ``metrics.json``; empty if the run was not measured.
        curve: rows of ``accuracy_time.csv``; empty if no views were held out.
    """

    folder: Path
    config: dict
    stages: dict[str, dict] = field(default_factory=dict)
    metrics: dict = field(default_factory=dict)
    curve: tuple[Point, ...] = ()

    @property
    def scene(self) -> str:
        """The scene's name."""
        return str(self.config["data"]["scene"])

    @property
    def dataset(self) -> str:
        """The dataset of the scene; "" if the run was not measured."""
        return str(self.metrics.get("protocol", {}).get("dataset", ""))

    @property
    def is_counterpart(self) -> bool:
        """Whether the scene is a synthetic counterpart of a dataset."""
        made = self.metrics.get("protocol", {}).get("synthetic", False)
        return bool(made) or ".Synthetic" in str(self.config["data"].get("_target_", ""))

    @property
    def variant(self) -> str:
        """Name what tells this run from others of its scene.

        The name of an ablation; for runs of ``sweeps=accuracy_time`` and its price lists the typed overrides
        (``base`` without any); for all other runs the method and the preset.
        """
        known = self.config.get("variant") or {}
        if "name" in known:
            return known["name"] or "base"
        return f"{self.config['model']['name']}-{self.config['preset']['name']}"

    @property
    def about(self) -> str:
        """What the variant changes, in a phrase."""
        return (self.config.get("variant") or {}).get("about", "")

    def against(self, variants: Iterable[str]) -> str:
        """Choose from ``variants`` the one to compare this run with.

        The one that the run's config names, or else the one with most of the run's overrides and no others.

        >>> run = Result(Path("run"), {"variant": {"name": "a=1 b=2 c=3"}})
        >>> run.against(["base", "a=1", "a=1 b=2", "a=1 d=4", "a=1 b=2 c=3"])
        'a=1 b=2'
        """
        if named := (self.config.get("variant") or {}).get("against"):
            return named
        own = set(_overrides(self.variant))
        inside = [name for name in variants if set(_overrides(name)) < own]
        return max(inside, key=lambda name: len(_overrides(name)), default="base")

    @property
    def effects(self) -> str:
        """Names of the method's effects that were on; "" if the run was not measured."""
        return ", ".join(name for name, on in self.metrics.get("effects", {}).items() if on)

    @property
    def seed(self) -> int:
        """The seed of all random numbers."""
        return int(self.config["seed"])

    @property
    def minutes(self) -> float | None:
        """The minutes of the budget; None if only steps bound the run."""
        return self.config["budget"]["minutes"]

    @property
    def clock(self) -> str:
        """The clock that its minutes are of: ``wall`` or ``processor``."""
        protocol, budget = self.metrics.get("protocol", {}), self.config["budget"]
        return protocol.get("clock") or budget.get("clock") or "wall"

    @property
    def command(self) -> str:
        """The command that made the run."""
        return self.config.get("command") or f"forewarp-train # as {self.folder / 'config.yaml'}"

    @property
    def day(self) -> str:
        """The day on which the run was measured, as 2026-11-22."""
        return datetime.fromtimestamp(self.measured_at / 1e9, timezone.utc).date().isoformat()

    @property
    def measured_at(self) -> int:
        """When the run was measured, in nanoseconds: the time of ``metrics.json``."""
        return (self.folder / "metrics.json").stat().st_mtime_ns

    @property
    def ability(self) -> str:
        """The kind of test view that ``numbers`` averages: ``all``, else ``time`` (between training times),
        else the first kind there is.
        """
        known = self.metrics["test"]
        return [*(kind for kind in ("all", "time") if kind in known), *known, "all"][0]

    @property
    def numbers(self) -> dict[str, float]:
        """The numbers of a measured run: ``psnr``, ``ssim``, ``epe``, ``step`` and ``frame`` (seconds),
        ``memory`` (GiB), ``parameters`` (millions) and ``steps``; unknown ones are left out.
        """
        scores = self.metrics["test"].get(self.ability, {})
        seconds, steps = self.metrics["seconds"], sum(done["steps"] for done in self.stages.values())
        memory, flow = self.metrics.get("peak_memory_bytes"), self.metrics.get("flow") or {}
        found = {
            "psnr": scores.get("psnr"),
            "ssim": scores.get("ssim"),
            "epe": flow.get("epe_moving"),
            "step": seconds["train"] / steps if steps else None,
            "frame": seconds.get("render_per_frame"),
            "memory": memory / 2**30 if memory else None,
            "parameters": self.metrics["parameters"] / 1e6,
            "steps": steps,
        }
        return {name: value for name, value in found.items() if value is not None}


def collect(root: Path, needed: Sequence[str] = ()) -> tuple[list[Result], list[str]]:
    """Read all runs below a folder.

    Args:
        root: folder to search for ``config.yaml``.
        needed: files that a run must hold, such as ``metrics.json``.

    Returns:
        the runs in the order of their folders, and a line for each run that cannot be used.

    Raises:
        ValueError: if there is no run at all.
    """
    results, without = [], []
    for path in sorted(Path(root).rglob("config.yaml")):
        folder = path.parent
        absent = [name for name in needed if not (folder / name).is_file()]
        try:
            result = read_run(folder)
        except UNREADABLE as error:
            without.append(f"{folder.relative_to(root)}: cannot be read ({unreadable(error)})")
            continue
        if absent:
            again = "run its command again"
            if absent == ["accuracy_time.csv"]:  # no views were held out
                again = "run its command with data.held_out=8 into another folder"
            without.append(f"{folder.relative_to(root)}: no {', '.join(absent)}; {again}")
        else:
            results.append(result)
    _shorten(results)
    if not results and not without:
        raise ValueError(
            f"{root}: expected folders of runs, but got none; make some with forewarp-train, or set runs=..."
        )
    return results, without


def unreadable(error: Exception) -> str:
    """Say in a few words why a run cannot be read."""
    return f"no key {error}" if isinstance(error, KeyError) else str(error).split("\n")[0]


def _shorten(results: Sequence[Result]) -> None:
    """In names that are typed overrides, drop the overrides that all such runs of a scene share."""
    for found in by_scene(results).values():
        typed = [known for run in found if set(known := run.config.get("variant") or {}) == {"name"}]
        names = [_overrides(known["name"] or "") for known in typed]
        shared = set.intersection(*map(set, names)) if len({*map(tuple, names)}) > 1 else set()
        for known, name in zip(typed, names):
            known["name"] = " ".join(override for override in name if override not in shared)


def _overrides(name: str) -> list[str]:
    """Split a name into its overrides, without spaces inside them.

    >>> _overrides("preset.rays=64 stage.fine.num_voxels=[[0, 8000]] ~stage.coarse")
    ['preset.rays=64', 'stage.fine.num_voxels=[[0,8000]]', '~stage.coarse']
    """
    return [re.sub(r"\s", "", one) for one in re.split(r"\s+(?=[+~]|[\w./]+=)", name) if one]


def read_run(folder: Path) -> Result:
    """Read one run; parts whose files are missing are empty."""
    path = folder / "config.yaml"
    config = yaml.safe_load(read_text(path, MOST_CONFIG))
    if "preset" not in config and "warp" in config.get("model", {}):  # of a version before 0.2
        config["preset"] = {"name": config["budget"]["name"]}
        config["model"]["name"] = config["model"]["warp"]
    stages = {path.parent.name: _json(path) for path in sorted(folder.glob("*/done.json"))}
    result = Result(folder, config, stages, _json(folder / "metrics.json"), read_curve(folder))
    # Evaluated here, so that a broken file is noticed while its run can be named.
    _ = result.scene, result.variant, result.seed, result.minutes, result.metrics and result.numbers
    return result


def read_curve(folder: Path) -> tuple[Point, ...]:
    """Read the rows of a run's ``accuracy_time.csv``; a missing file has none."""
    return tuple(
        Point(
            float(row["seconds"]),
            float(row["psnr"]),
            int(row["step"]),
            float(row["epe_moving"]) if row["epe_moving"] else None,
        )
        for row in read_rows(folder / "accuracy_time.csv")
    )


def grouped(results: Sequence[Result]) -> dict[tuple[str, float | None], list[Result]]:
    """Group runs that differ only in the seed: (variant, minutes) -> runs by seed, the base first."""
    groups: dict[tuple[str, float | None], list[Result]] = {}
    for result in sorted(results, key=lambda r: (r.variant != "base", r.variant, r.minutes or 0, r.seed)):
        groups.setdefault((result.variant, result.minutes), []).append(result)
    return groups


def by_scene(results: Sequence[Result]) -> dict[str, list[Result]]:
    """Group runs by scene, sorted by name."""
    scenes = sorted({result.scene for result in results})
    return {scene: [result for result in results if result.scene == scene] for scene in scenes}


def left_out(title: str, lines: Sequence[str]) -> list[str]:
    """Return the section of a page that lists the runs ``collect`` could not use."""
    return [f"## {title}\n", "\n".join(f"* {line}" for line in lines) + "\n"] if lines else []


def machine(results: Sequence[Result]) -> str:
    """Say in one line what the runs were computed on."""
    protocols = [result.metrics.get("protocol", {}) for result in results]
    versions = [protocol.get("versions", {}).get("torch") for protocol in protocols]
    return machines(
        (protocol.get("device"), protocol.get("threads"), torch and f"torch {torch}")
        for protocol, torch in zip(protocols, versions)
    )


def machines(found: Iterable[tuple[str | None, float | None, str | None]]) -> str:
    """Say in one line what machines there are: of each the device, the threads and one word more.

    >>> machines([("a cpu", 2.0, "torch 2"), ("a cpu", None, None), (None, 1, ""), ("a cpu", None, None)])
    'a cpu, 2 threads, torch 2; a cpu'
    """
    lines = {}
    for device, threads, more in found:
        told = f"{threads:g} thread{'s' * (threads != 1)}" if threads else None
        lines |= {", ".join(filter(None, (device, told, more))): None} if device else {}
    return "; ".join(lines) or "unknown"


def _json(path: Path) -> dict:
    return json.loads(read_text(path)) if path.is_file() else {}
