"""Film what a phone films, where the truth is known: ``python -m tests.bench.film OUT`` (minutes of a core).

A box that slides and turns and a ball that bounces, before a textured room, held upright by a swaying hand,
with an exposure that drifts and a shutter that is open for half of the time. Writes ``OUT/film.mp4``, which
players turn by its rotation flag, and ``OUT/truth``, a scene with true poses, times and masks of what moves;
its validation views lie beside the path. ``--score RUN`` scores a run of the film, captured or of ``truth``,
by the true masks: views that it holds out, and those beside the path. ``--lean RUN`` compares leaned views
with the truth and with what the run's own photos tell of them (``evaluation/trust.py``).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from omegaconf import OmegaConf
from torch import Tensor

from forewarp.capture.frames import shrunk
from forewarp.capture.motion import resized_mask
from forewarp.data.batches import Targets
from forewarp.data.images import MovingMask, read_image
from forewarp.data.posed_video import PosedShot, read_scene, write_scene
from forewarp.data.transforms import hold_out_every
from forewarp.evaluation import trust
from forewarp.evaluation.evaluate import draw
from forewarp.metrics.image import psnr
from forewarp.metrics.registry import PARTS, scores_of_parts
from forewarp.progress import Counted
from forewarp.runs.config import saved_config
from forewarp.runs.fitted import opened
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame, Scene
from forewarp.synth.movers import moving_faces, near_movers, specimen
from forewarp.synth.raycast import Posed, camera_rays, light_points, surface_points
from forewarp.synth.walks import Walk, cameras_of
from forewarp.synth.world import ROOM_HIGH, ROOM_LOW, World
from tests.support.captures import PHONE as LENS
from tests.support.captures import pose_errors
from tests.support.films import write_film

TRUTH, MASKS = "truth", "moving"
# Metres and seconds. The camera is 2.5 m from what moves; a metre there is 220 pixels.
WALK = Walk((-112.0, -72.0), 2.5, 14.0, (0.0, 0.05, 0.62), 44.0, LENS)
BESIDE = 0.3
GAIN, DRIFT = 0.13, 7.0  # of the exposure: share, period
SHUTTER = 0.5  # share of the time between frames
# Instants averaged into a frame where something moves; where nothing does, every third of them.
INSTANTS, EVERY = 9, 3


@dataclass(frozen=True)
class Form:
    """What a film is like: ``size`` is (width, height); every ``beside``-th frame has a view beside it."""

    count: int = 250
    fps: float = 25.0
    size: tuple[int, int] = (450, 800)
    beside: int = 10

    @property
    def seconds(self) -> float:
        """From the first frame to the last."""
        return (self.count - 1) / self.fps


PHONE = Form()


class Filming:
    """Take frames of a film, and views beside it.

    Args:
        form: of the film.
    """

    def __init__(self, form: Form) -> None:
        self.form, self.world = form, World(specimen(form.seconds), has_room=True)
        self.moves = moving_faces(self.world)
        still, steps = np.eye(4), (np.arange(INSTANTS) + 0.5) / INSTANTS
        level = replace(self.cameras([0.0])[0], camera_to_world=torch.from_numpy(still))
        # The R1 sequence covers each pixel evenly.
        spots = [(step, (0.5 + i * 0.6180339887498949) % 1.0) for i, step in enumerate(steps)]
        self.directions = [camera_rays(level, spot)[1] for spot in spots]
        self.open = SHUTTER * (steps - 0.5) / (form.count - 1)  # the instants, from the middle of the frame
        self.lights = light_points(INSTANTS // EVERY)

    def cameras(self, times: Sequence[float]) -> list[Camera]:
        """Return the cameras on the path at times."""
        return cameras_of(WALK, times, self.form.seconds, self.form.size)

    def gain(self, time: float) -> float:
        """Return the exposure at a time, 1 in the mean."""
        return 1 + GAIN * np.sin(2 * np.pi * self.form.seconds * time / DRIFT + 1)

    def take(self, time: float, aside: Tensor | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Take a frame whose shutter is half through at ``time``.

        Args:
            time: in [0, 1].
            aside: (4, 4) from the camera that takes it to the one on the path; None: that one.

        Returns:
            the frame (H, W, 3) uint8, and what moves (H, W) bool: pixels that it covers for half of the time.
        """
        (width, height), times = self.form.size, time + self.open
        cameras = self.cameras(times)
        if aside is not None:
            cameras = [replace(c, camera_to_world=c.camera_to_world @ aside) for c in cameras]
        near = np.flatnonzero(near_movers(self.world, times, cameras))
        everywhere = np.arange(height * width)
        total, seen, covered = (np.zeros((len(everywhere), *more)) for more in ((3,), (), ()))
        for i, (instant, camera) in enumerate(zip(times, cameras)):
            rows = everywhere if i % EVERY == EVERY // 2 else near
            posed, pose = Posed(self.world, instant), camera.camera_to_world.numpy()
            directions = self.directions[i][rows] @ pose[:3, :3].T
            hits = posed.first_hits(np.broadcast_to(pose[:3, 3], directions.shape), directions)
            rows = rows[hits.ray]
            total[rows] += posed.color(hits, self.lights[i // EVERY][None])
            covered[rows] += self.moves[hits.face]
            seen[rows] += 1
        color = self.gain(time) * total / seen.clip(1)[:, None]
        pixels = np.rint(255 * color.clip(0, 1)).astype(np.uint8)
        return pixels.reshape(height, width, 3), (covered > 0.5 * INSTANTS).reshape(height, width)


def name_of(number: int) -> str:
    """Name a frame as captures do, by its number from 0."""
    return f"frame_{number + 1:06d}"


def number_of(name: str) -> int:
    """Return the number of a frame, or of the frame that a view lies beside, from its name."""
    return int(Path(name).stem.split("_")[-1]) - 1


def film(folder: Path, form: Form = PHONE) -> None:
    """Write ``film.mp4`` and ``truth``."""
    filming, times = Filming(form), np.linspace(0, 1, form.count)
    cameras, frames = filming.cameras(times), []
    held = set(hold_out_every(range(form.count), 8)[1])
    sides = list(range(form.beside // 2, form.count, form.beside))

    def shots() -> Iterator[PosedShot]:
        for number, (time, camera) in enumerate(zip(times, cameras)):
            pixels, moving = filming.take(time)
            frames.append(pixels)
            split = "test" if number in held else "train"
            yield PosedShot(f"{name_of(number)}.jpg", camera, pixels, float(time), split, moving)
            progress(number + 1, form.count + len(sides))
        for done, number in enumerate(sides, 1):
            aside = aside_of(done)
            pixels, moving = filming.take(times[number], aside)
            camera = replace(cameras[number], camera_to_world=cameras[number].camera_to_world @ aside)
            name = f"beside_{number + 1:06d}.jpg"
            yield PosedShot(name, camera, pixels, float(times[number]), "val", moving)
            progress(form.count + done, form.count + len(sides))

    among = ~filming.moves
    drawn = surface_points(
        filming.world, 4000, cameras[:: max(1, form.count // 8)], np.random.default_rng(0), among=among
    )
    limits = {"near": 0.5, "far": 6.0, "aabb": Box(ROOM_LOW, ROOM_HIGH)}
    told = {"seconds": form.seconds, "moving_from": "the program that made the film"}
    with Counted("filming") as progress:
        write_scene(folder / TRUTH, shots(), **limits, **told, points=filming.world.points(*drawn, 0.0))
    flat = np.ascontiguousarray(np.rot90(np.stack(frames), -1, (1, 2)))
    stamps = f"N*{1000 / form.fps:g}"
    write_film(folder / "film.mp4", flat, stamps=stamps, rotation=90, options=("-qp", "20"))


def aside_of(number: int) -> Tensor:
    """Return the place (4, 4) of a camera beside another one: below, left, above and right by turns."""
    aside, turn = torch.eye(4, dtype=torch.float64), number * np.pi / 2
    aside[:2, 3] = BESIDE * torch.tensor([np.cos(turn), np.sin(turn)])
    return aside


def held_out(scene: Scene, truth: Path) -> list[Frame]:
    """Return a scene's test frames with the true masks."""

    def masked(frame: Frame) -> Frame:
        file = truth / MASKS / f"{name_of(number_of(frame.name))}.png"
        return replace(frame, load_moving=MovingMask(file, (frame.camera.width, frame.camera.height)))

    return [masked(frame) for frame in scene.test]


def beside(scene: Scene, truth: Path) -> list[Frame]:
    """Return the true views beside the path of a scene's frames, as the scene's own cameras would see them.

    Each lies where the true one does from the true camera of its frame: intrinsics and the frame's pose are
    the scene's, and the length is scaled by the similarity from the scene's cameras to the true ones.
    """
    known = read_scene(truth.parent, truth.name, normalise=False)
    true = {number_of(frame.name): frame.camera for frame in (*known.train, *known.test)}
    own = {number_of(frame.name): frame for frame in (*scene.train, *scene.test)}
    numbers = sorted(own.keys() & true.keys())
    pairs = [own[n].camera for n in numbers], [true[n] for n in numbers]
    similarity, degrees, away = pose_errors(*pairs)
    print(f"poses: {degrees.mean():.3f} degrees and {100 * away.mean():.2f} % of the path off")
    found = []
    for view in known.val:
        frame = own.get(number_of(view.name))
        if frame is None:  # it was not registered
            continue
        aside = torch.linalg.inv(true[number_of(view.name)].camera_to_world) @ view.camera.camera_to_world
        aside[:3, 3] /= similarity.scale
        camera = replace(frame.camera, camera_to_world=frame.camera.camera_to_world @ aside)
        size = camera.width, camera.height
        path, mask = view.load.path, MovingMask(view.load_moving.path, size)
        found.append(
            Frame(view.name, frame.time, camera, lambda p=path, s=size: _small(p, s), load_moving=mask)
        )
    return found


def _small(path: Path, size: tuple[int, int]) -> Tensor:
    """Read an image, averaged down to (width, height): (H, W, 4)."""
    return torch.from_numpy(shrunk(read_image(path).numpy(), *size[::-1]))


def _sized(pixels: np.ndarray, moving: np.ndarray, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return a frame in [0, 1] and its mask in a camera's size."""
    shape, size = (camera.height, camera.width), (camera.width, camera.height)
    image = torch.from_numpy(pixels if pixels.shape[:2] == shape else shrunk(pixels, *shape))
    return image.float() / 255, torch.from_numpy(resized_mask(moving, size))


def scores(module, frames: Sequence[Frame], background: Tensor) -> dict[str, float]:
    """Return mean PSNR of frames, and of their parts where these have pixels."""
    rows: dict[str, list[float]] = {name: [] for name in ("all", *PARTS)}
    for view in draw(module, Targets(frames, background, has_alpha=False)):
        target = view.target
        image = list(view.renderings.values())[-1].rgb.clamp(0, 1).reshape(target.rgb.shape).cpu()
        rows["all"].append(psnr(image, target.rgb))
        for part, found in scores_of_parts(image, target).items():
            rows[part].append(found["psnr"])
    return {name: fmean(values) for name, values in rows.items() if values}


def score(folder: Path, run: Path) -> dict[str, dict[str, float]]:
    """Score a run by the truth, and print the table."""
    made, module = opened(saved_config(str(run), OmegaConf.create({"trust": []})))
    scene, background = made.datamodule.scene, made.datamodule.targets("test").background
    kinds = {"held out": held_out(scene, folder / TRUTH), "beside the path": beside(scene, folder / TRUTH)}
    table = {kind: scores(module, frames, background) for kind, frames in kinds.items()}
    print(f"{'PSNR, dB':<16} views" + "".join(f"{name:>8}" for name in ("all", *PARTS)))
    for kind, found in table.items():
        print(f"{kind:<16} {len(kinds[kind]):>5}" + "".join(f"{value:>8.2f}" for value in found.values()))
    return table


@torch.no_grad()
def lean(folder: Path, run: Path) -> dict[tuple[str, float], np.ndarray]:
    """Print of leaned views, by part and angle, the PSNR against the truth, that against the carried photo,
    and the share of pixels that stand before the photo: means, which are returned.
    """
    made, module = opened(saved_config(str(run), OmegaConf.create({"trust": []})))
    scene, targets = made.datamodule.scene, made.datamodule.targets("test")
    known = read_scene(folder, TRUTH, normalise=False)
    true = {number_of(frame.name): frame.camera for frame in (*known.train, *known.test)}
    own = {number_of(frame.name): frame.camera for frame in (*scene.train, *scene.test)}
    numbers = sorted(own.keys() & true.keys())
    similarity, *_ = pose_errors([own[n] for n in numbers], [true[n] for n in numbers])
    seconds, size = known.protocol["seconds"], (known.train[0].camera.width, known.train[0].camera.height)
    filming = Filming(Form(len(true), (len(true) - 1) / seconds, size))
    found: dict[tuple[str, float], list[tuple[float, ...]]] = {}
    for target, plain, camera, angle in trust.leaned_views(module.method, targets, range(len(targets))):
        aside = torch.linalg.inv(target.frame.camera.camera_to_world) @ camera.camera_to_world
        aside[:3, 3] *= similarity.scale
        pixels, moving = filming.take(target.frame.time, aside)
        pixels, moving = _sized(pixels, moving, camera)
        drawn = trust.image_at(module.method, target.frame, target.frame.time, target.background, camera)
        told = trust.compared(module.method, target, plain, camera)
        for part, mask in zip(trust.PARTS, (moving, ~moving)):
            if part in told and bool(mask.any()):
                score = psnr(drawn.rgb[mask][None], pixels[mask][None])
                found.setdefault((part, angle), []).append((score, *told[part]))
    means = {key: np.mean(rows, axis=0) for key, rows in sorted(found.items())}
    print("part     degrees   truth   photo   front")
    for (part, angle), (truth, photo, front) in means.items():
        print(f"{part:<8} {angle:>7g} {truth:>7.2f} {photo:>7.2f} {front:>7.3f}")
    return means


def main() -> None:
    """Film, or score a run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--score", type=Path, metavar="RUN")
    parser.add_argument("--lean", type=Path, metavar="RUN")
    words = parser.parse_args()
    torch.set_num_threads(1)
    if words.lean is not None:
        lean(words.out, words.lean)
    elif words.score is not None:
        score(words.out, words.score)
    else:
        film(words.out)


if __name__ == "__main__":
    main()
