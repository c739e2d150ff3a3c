"""Measure the capture of a rig where the truth is known: ``python -m tests.bench.rigs --films FOLDER``.

FOLDER is what ``forewarp-synthesize dataset=multicam`` writes. Captures it, compares offsets and poses with
the truth, and fits with the found and with the true poses and times, one camera held out.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from forewarp.data.images import read_image
from forewarp.data.posed_video import PosedShot, read_scene, write_scene
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from tests.bench.capture import called, fitted, in_world_of
from tests.support.captures import Similarity, pose_errors


def truth_of(films: Path) -> tuple[dict[str, Camera], dict[str, float], dict]:
    """Read the true cameras and offsets (seconds) by name, and all that ``truth.json`` says."""
    told = json.loads((films / "truth.json").read_text())
    cameras, offsets = {}, {}
    for one in told["cameras"]:
        pose = torch.tensor(one["camera_to_world"], dtype=torch.float64)
        inner = one["w"], one["h"], one["fl_x"], one["fl_y"], one["cx"], one["cy"]
        cameras[one["name"]], offsets[one["name"]] = Camera(*inner, pose, 0.0, 0.0), one["offset"]
    return cameras, offsets, told


def found_in(folder: Path) -> dict[str, Camera]:
    """Read one camera of each name of a captured scene of fixed cameras."""
    scene = read_scene(folder.parent, folder.name, normalise=False)
    frames = (*scene.train, *scene.test)
    return {Path(frame.name).name.rsplit("_", 1)[0]: frame.camera for frame in frames}


def compared(films: Path, folder: Path) -> tuple[dict, Similarity]:
    """Compare a capture with the truth: offsets in ms against their median, degrees, share of the rig's size,
    which is the largest distance between two cameras; and the similarity from found to true.
    """
    cameras, offsets, _ = truth_of(films)
    facts, found = json.loads((folder / "capture.json").read_text()), found_in(folder)
    names = sorted(found)
    late = np.array([facts["cameras"][name]["offset"] - offsets[name] for name in names])
    true = [cameras[name] for name in names]
    similarity, degrees, _ = pose_errors([found[name] for name in names], true)
    centers = np.stack([np.asarray(camera.center) for camera in true])
    mine = similarity(np.stack([np.asarray(found[name].center) for name in names]))
    size = np.linalg.norm(centers[:, None] - centers, axis=-1).max()
    away = np.linalg.norm(mine - centers, axis=1) / size
    focal = np.array([found[name].fx / cameras[name].fx - 1 for name in names])
    return {
        "cameras": f"{len(found)} of {len(cameras)}",
        "offset_ms": float(1e3 * np.abs(late - np.median(late)).max()),
        "certainty": [facts["cameras"][name]["certainty"] for name in names],
        "degrees": [float(degrees.mean()), float(degrees.max())],
        "size_percent": [float(100 * away.mean()), float(100 * away.max())],
        "focal_percent": float(100 * np.abs(focal).max()),
        "error": [facts["cameras"][name]["reprojection_error"] for name in names],
        "points": facts["points"],
        "pictures": facts["pictures"],
    }, similarity


def with_true_poses(films: Path, folder: Path, to: Path, similarity: Similarity, scale: int) -> None:
    """Write the captured images with the true cameras, in the found world, and the true times."""
    cameras, offsets, told = truth_of(films)
    rates = {one["name"]: one["fps"] for one in told["cameras"]}
    content = json.loads((folder / "transforms.json").read_text())
    seconds = {}
    for entry in content["frames"]:
        stem, name = Path(entry["file_path"]).stem, entry["camera"]
        seconds[entry["file_path"]] = offsets[name] + (int(stem.rsplit("_", 1)[1]) - 1) / rates[name]
    first, last = min(seconds.values()), max(seconds.values())
    shots = []
    for entry in content["frames"]:
        image = Path(entry["file_path"]).name
        pixels = read_image(folder / (f"images_{scale}" if scale > 1 else "images") / image)[..., :3]
        camera = cameras[entry["camera"]].resized(pixels.shape[1], pixels.shape[0])
        moving = read_image(folder / entry["moving_path"])[..., 0].numpy() > 127
        rows, columns = ((np.arange(n) * big // n) for n, big in zip(pixels.shape[:2], moving.shape))
        time_of = (seconds[entry["file_path"]] - first) / (last - first)
        rig = {"taken_by": entry["camera"], "moment": entry["moment"]}
        shot = PosedShot(image, in_world_of(similarity, camera), pixels, time_of, **rig)
        shots.append(replace(shot, moving=moving[rows][:, columns]))
    limits = {key: content[key] for key in ("near", "far", "seconds")} | {"aabb": Box(*content["aabb"])}
    write_scene(to, shots, **limits, points=np.load(folder / "points.npy"))


def main() -> None:
    """Measure; write ``facts.json``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--films", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("runs/rigs"))
    parser.add_argument("--scale", type=int, default=2, help="of the images that are fitted")
    parser.add_argument("--minutes", type=float, default=10.0, help="of one core, for each fit; 0: none")
    parser.add_argument("--held", default="cam05", help="the camera that is not fitted")
    parser.add_argument("--capture", nargs="*", default=[], help="words for forewarp-capture")
    words = parser.parse_args()
    torch.set_num_threads(1)
    found, exact = words.out / "captures" / "rig", words.out / "exact" / "rig"
    if not (found / "capture.json").exists():
        begin = time.perf_counter()
        spent = called("capture", f"videos={words.films}", f"out={found}", *words.capture)
        (words.out / "seconds.json").write_text(json.dumps([spent, time.perf_counter() - begin]))
    facts, similarity = compared(words.films, found)
    facts["seconds"] = json.loads((words.out / "seconds.json").read_text())
    if words.minutes:
        if not (exact / "transforms.json").exists():
            with_true_poses(words.films, found, exact, similarity, words.scale)
        budget = f"budget.minutes={words.minutes}", "budget.clock=processor"
        for kind, scene, scale in (("found", found, words.scale), ("true", exact, 1)):
            options = *budget, f"data.test_cameras=[{words.held}]", f"data.scale={scale}"
            facts[kind] = fitted(scene, words.out / "runs" / kind, *options)
    (words.out / "facts.json").write_text(json.dumps(facts, indent=2) + "\n")
    print(json.dumps(facts, indent=2))


if __name__ == "__main__":
    main()
