"""Lego Complete scenes: D-NeRF's layout with three kinds of test view, each with exact ray depth.

``dnerf`` reads the layout. Numbers are comparable with 50 training times and test views at training times
(``space``), at all times (``time``) and at the canonical time (``canonical``).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from forewarp.data import dnerf
from forewarp.data.dnerf import ABILITIES, Shot
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Scene, Truth

TRAINING_TIMES = 50
TEST_VIEWS = {"space": 200, "time": 197, "canonical": 50}
_SAME_TIME = 1e-4  # times are stored with four digits or more; neighbours are 1/196 apart


def read_scene(root: str | Path, scene: str, **options) -> Scene:
    """Read ``root/scene``; ``options`` as in ``dnerf.read_scene``.

    A scene with other numbers of images or other times is read too; ``protocol["note"]`` says what differs.

    Raises:
        SceneError: as ``dnerf.read_scene``, and for a test view without an ability.
    """
    found = dnerf.read_scene(root, scene, **options)
    for frame in found.test:
        if frame.ability == "all":
            raise SceneError(
                f"{Path(root) / scene}: expected transforms_test_<ability>.json for {', '.join(ABILITIES)}, "
                f"but got {frame.name} without an ability; use data=dnerf"
            )
    counts = Counter(frame.ability for frame in found.test)
    protocol = {
        **found.protocol,
        "dataset": "lego_complete",
        "training_times": len(found.times),
        "test_views": {ability: counts[ability] for ability in ABILITIES},
        "depth": "along the ray, foreground pixels",
    }
    if differences := _differences(found, protocol):
        protocol["note"] = f"not the published protocol: {'; '.join(differences)}"
    return replace(found, protocol=protocol)


def write_scene(
    folder: str | Path,
    splits: Mapping[str, Iterable[Shot]],
    *,
    camera_angle_x: float,
    trajectories: Truth | None = None,
) -> None:
    """Write a scene that ``read_scene`` reads, as ``dnerf.write_scene`` does.

    Raises:
        ValueError: also for a test shot without an ability or without a depth.
    """
    checked = {split: _complete(shots) if split == "test" else shots for split, shots in splits.items()}
    dnerf.write_scene(folder, checked, camera_angle_x=camera_angle_x, trajectories=trajectories)


def _differences(scene: Scene, protocol: dict) -> list[str]:
    """Say how a scene differs from the published protocol."""
    said = []
    if protocol["training_times"] != TRAINING_TIMES:
        said.append(f"{protocol['training_times']} training times instead of {TRAINING_TIMES}")
    if len(scene.train) != protocol["training_times"]:
        said.append(f"{len(scene.train)} training images at {protocol['training_times']} times")
    for ability, expected in TEST_VIEWS.items():
        if (count := protocol["test_views"][ability]) != expected:
            said.append(f"{count} {ability} views instead of {expected}")
    for ability, allowed in (("space", scene.times), ("canonical", (scene.canonical_time,))):
        views = [frame for frame in scene.test if frame.ability == ability]
        if away := sum(min(abs(frame.time - time) for time in allowed) > _SAME_TIME for frame in views):
            place = "a training time" if ability == "space" else "the canonical time"
            said.append(f"{away} {ability} views not at {place}")
    if bare := sum(frame.load_depth is None for frame in scene.test):
        said.append(f"{bare} of {len(scene.test)} test views without a depth")
    return said


def _complete(shots: Iterable[Shot]) -> Iterator[Shot]:
    for shot in shots:
        if shot.ability == "all" or shot.depth is None:
            got = "no ability" if shot.ability == "all" else "no depth"
            raise ValueError(f"{shot.name}: expected a test shot with an ability and a depth, but got {got}")
        yield shot
