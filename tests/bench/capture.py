"""Measure forewarp-capture where the truth is known: ``python -m tests.bench.capture`` (under an hour).

Films textured scenes of ``synth`` as a hand would, writes real mp4s, captures them, compares poses, and fits
with the found and with the true poses. ``--real FOLDER`` adds a capture in HyperNeRF's layout, where cameras
that another program has found stand for the truth.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from forewarp.capture.pipeline import PICTURE
from forewarp.data import hypernerf
from forewarp.data.files import Entry, read_json
from forewarp.data.images import read_image
from forewarp.data.posed_video import PosedShot, read_scene, write_scene
from forewarp.drawing.images import in_a_row, to_bytes, write_video
from forewarp.drawing.images import read_image as read_drawn
from forewarp.progress import Counted
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.synth.walks import cameras_of
from tests.support.captures import WALKS, pictures_of, pose_errors, smeared

FRAMES, SECONDS, SHAKEN = 120, 8.0, 4  # every fourth frame is blurred
GAP = 8  # pixels between pictures
TRAIN = ("trainer=cpu", "logger=none", "callbacks.pictures=null", "threads=1")


def film(name: str, folder: Path) -> tuple[Path, list]:
    """Write ``<name>.mp4``, unless it is there; return it and the true cameras of its frames."""
    walk, times = WALKS[name], np.linspace(0, 1, FRAMES)
    cameras, path = cameras_of(walk, times, SECONDS), folder / f"{name}.mp4"
    if not path.exists():
        with Counted(f"filming {name}") as progress:
            pictures = enumerate(pictures_of(walk, times, cameras, workers=1, progress=progress))
            shaken = (smeared(p, 9) if i % SHAKEN == 1 else p for i, p in pictures)
            write_video(path, (torch.from_numpy(p).float() / 255 for p in shaken), fps=FRAMES / SECONDS)
    return path, cameras


def called(name: str, *words) -> float:
    """Run a command; return its seconds of processor time."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [str(Path(sys.executable).with_name(f"forewarp-{name}")), *map(str, words)]
    subprocess.run(command, check=True, env=os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def in_time(scene) -> list:
    """All frames of a scene in the order of time."""
    return sorted((*scene.train, *scene.test), key=lambda frame: frame.time)


def compared(found: Path, true: list, frame_of) -> tuple[dict, object]:
    """Compare a captured scene's cameras with true ones; ``frame_of`` gives the row of a picture's name."""
    frames = in_time(read_scene(found.parent, found.name, normalise=False))
    pairs = [true[frame_of(Path(frame.name).name)] for frame in frames]
    similarity, degrees, away = pose_errors([frame.camera for frame in frames], pairs)
    about = json.loads((found / "capture.json").read_text())
    return {
        "registered": f"{about['registered']} of {about['pictures']}",
        "error": about["reprojection_error"],
        "points": about["points"],
        "degrees": [float(np.mean(degrees)), float(np.max(degrees))],
        "path": [float(100 * np.mean(away)), float(100 * np.max(away))],
        "focal": [frames[0].camera.fx, pairs[0].fx],
    }, similarity


def in_world_of(similarity, camera: Camera) -> Camera:
    """Return a true camera in the captured world, from which a similarity leads to the true one."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(similarity.turn.T) @ camera.camera_to_world[:3, :3]
    place = (np.asarray(camera.center) - similarity.shift) @ similarity.turn / similarity.scale
    pose[:3, 3] = torch.from_numpy(place)
    return replace(camera, camera_to_world=pose)


def with_true_poses(found: Path, folder: Path, true: list, frame_of, similarity) -> None:
    """Write the captured pictures, half as large, with the true cameras in the found world."""
    content, scene = json.loads((found / "transforms.json").read_text()), read_scene(found.parent, found.name)
    shots = []
    for frame in in_time(scene):
        (path,) = (found / "images_2").glob(f"{Path(frame.name).name}.*")
        name, pixels = path.name, read_image(path)[..., :3]
        camera = true[frame_of(name)].resized(pixels.shape[1], pixels.shape[0])
        shots.append(PosedShot(name, in_world_of(similarity, camera), pixels, frame.time))
    limits = {key: content[key] for key in ("near", "far")} | {"aabb": Box(*content["aabb"])}
    write_scene(folder, shots, **limits, points=np.load(found / "points.npy"))


def fitted(scene: Path, run: Path, *words: str) -> dict:
    """Fit a scene, unless a run of that name has finished; return its scores and processor seconds."""
    if not (run / "seconds.json").exists():
        options = [f"data.root={scene.parent}", f"data.scene={scene.name}", f"run={run}", *TRAIN, *words]
        spent = called("train", "experiment=video_with_poses", *options)
        (run / "seconds.json").write_text(json.dumps(spent))
    scores = json.loads((run / "metrics.json").read_text())["test"]
    return {**scores, "seconds": json.loads((run / "seconds.json").read_text())}


def number_in(name: str) -> int:
    """The row of a frame of a video, from its file's name."""
    return int(Path(name).stem.split("_")[1]) - 1


def proof(name: str, folder: Path, steps: int, seeds: list[int]) -> dict:
    """Film, capture, compare and fit one scene; nothing that is there already is done again."""
    video, true = film(name, folder)
    found = folder / "captures" / name
    if not (found / "capture.json").exists():
        spent = called("capture", f"video={video}", f"out={found}", f"frames={FRAMES // 2}", "threads=1")
        (folder / f"{name}.seconds").write_text(f"{spent}")
    facts, similarity = compared(found, true, number_in)
    facts["seconds"] = float((folder / f"{name}.seconds").read_text())
    return facts | fits(found, folder, true, number_in, similarity, steps, seeds)


def fits(found: Path, folder: Path, true: list, frame_of, similarity, steps: int, seeds: list[int]) -> dict:
    """Fit with the found and with the true poses, each with all seeds."""
    name, exact, facts = found.name, folder / "exact" / found.name, {}
    budget = ("budget.minutes=null", f"budget.iterations={steps}")
    if not (exact / "transforms.json").exists():
        with_true_poses(found, exact, true, frame_of, similarity)
    for kind, scene, scale in (("found", found, 2), ("true", exact, 1)):
        words = (*budget, f"data.scale={scale}")
        runs = [fitted(scene, folder / "runs" / f"{name}-{kind}-{s}", f"seed={s}", *words) for s in seeds]
        facts[kind] = {key: [run["all"][key] for run in runs] for key in ("psnr", "ssim")}
        facts[kind]["seconds"] = [run["seconds"] for run in runs]
    return facts


def real(source: Path, folder: Path, steps: int, seeds: list[int]) -> dict:
    """Capture the pictures of a HyperNeRF layout; compare with the cameras it comes with, and fit both."""
    found, name = folder / "captures" / source.name, source.name
    if not (found / "capture.json").exists():
        spent = called("capture", f"images={source / 'rgb' / '1x'}", f"out={found}", "threads=1")
        (folder / f"{name}.seconds").write_text(f"{spent}")
    names = sorted(path.stem for path in (source / "camera").iterdir())
    files = [source / "camera" / f"{name}.json" for name in names]
    given = [hypernerf.camera_of(Entry(file, read_json(file)), 0.0, 1.0) for file in files]
    originals = json.loads((found / "capture.json").read_text())["originals"]
    stems = {Path(ours).stem: Path(theirs).stem for ours, theirs in originals.items()}

    def frame_of(name: str) -> int:
        return names.index(stems[Path(name).stem])

    facts, similarity = compared(found, given, frame_of)
    facts["seconds"] = float((folder / f"{name}.seconds").read_text())
    return facts | fits(found, folder, given, frame_of, similarity, steps, seeds)


def pictured(folder: Path, scenes: list[str], seed: int, file: str) -> None:
    """Write ``capture-<scene>.png``, cameras and points, and ``file``: for each scene its middle held-out
    view, true, fitted with the found poses, and with the true ones.
    """
    for scene in scenes:
        shutil.copy(folder / "captures" / scene / PICTURE, folder / f"capture-{scene}.png")
    rows = []
    for scene in scenes:
        runs = [folder / f"runs/{scene}-{kind}-{seed}/images/images" for kind in ("found", "true")]
        drawn = sorted(runs[0].iterdir())
        view = drawn[len(drawn) // 2].name
        (truth,) = (folder / "exact" / scene / "images").glob(f"{Path(view).stem}.*")
        rows.append(in_a_row([read_drawn(path) for path in (truth, *(run / view for run in runs))], GAP))
    turned = [row.transpose(0, 1) for row in rows]
    picture = Image.fromarray(to_bytes(in_a_row(turned, GAP).transpose(0, 1)))
    picture.quantize(256).save(folder / file, optimize=True)  # a quarter of the bytes


def main() -> None:
    """Measure; write ``facts.json`` and the pictures of ``docs/results/capture.md``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/capture"))
    parser.add_argument("--scenes", nargs="*", default=list(WALKS))
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    parser.add_argument("--real", type=Path)
    words = parser.parse_args()
    torch.set_num_threads(1)
    facts = {name: proof(name, words.out, words.steps, words.seeds) for name in words.scenes}
    if words.real is not None:
        facts[words.real.name] = real(words.real, words.out, words.steps, words.seeds)
    (words.out / "facts.json").write_text(json.dumps(facts, indent=2) + "\n")
    pictured(words.out, words.scenes, words.seeds[0], "capture-fits.png")
    if words.real is not None:
        pictured(words.out, [words.real.name], words.seeds[0], f"capture-fits-{words.real.name}.png")
    print(json.dumps(facts, indent=2))


if __name__ == "__main__":
    main()
