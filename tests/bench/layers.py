"""``python -m tests.bench.layers RUN [RUN ...]``: how far masks of what moves are those of the scene itself.

Takes finished runs of particles on procedural scenes, and prints the intersection over union of the masks in
all test views: of pixels that are mostly particles that move, and of those whose surface goes more than 1.5
pixels from its mean place in half of the training cameras' images.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from forewarp import load
from forewarp.evaluation.images import moving_share
from forewarp.evaluation.layers import moving_rows
from forewarp.methods.particles.model import MOVES
from forewarp.runs.fitted import Fitted
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame, spread
from forewarp.synth import scenes
from forewarp.synth.raycast import Posed, camera_rays
from forewarp.synth.world import World

CAMERAS, TIMES, HALF = 12, 17, 0.5


def world_of(scene: Fitted) -> tuple[World, Callable, Callable]:
    """Return the world of a run's scene, and what takes its points (..., 3) to the scene's and back."""
    data = scene.config.data
    world = World(data.synthesis.motion, has_room="HyperNeRF" in data._target_)
    if not world.has_room:
        return world, lambda points: points, lambda points: points
    size, at = scenes.SCENE_SCALE, np.array(scenes.SCENE_CENTER)
    scale, shift = scenes.WORLD_SCALE * size, (np.array(scenes.WORLD_AT) - at) * size
    return world, lambda points: scale * points + shift, lambda points: (points - shift) / scale


def true_mask(scene: Fitted, frame: Frame, cameras: list[Camera]) -> np.ndarray:
    """Tell which pixels (H, W) of a frame show what moves."""
    world, outwards, inwards = world_of(scene)
    origins, directions = camera_rays(frame.camera)
    hits = Posed(world, frame.time).first_hits(inwards(origins), directions)
    times = np.linspace(0, 1, TIMES)
    places = outwards(np.stack([world.points(hits.face, hits.barycentric, time) for time in times]))
    pixels = torch.stack([camera.project(torch.from_numpy(places))[0] for camera in cameras])
    away = (pixels - pixels.mean(1, keepdim=True)).norm(dim=-1).amax(1).median(0).values
    mask = np.zeros(frame.camera.width * frame.camera.height, bool)
    mask[hits.ray] = away > MOVES
    return mask.reshape(frame.camera.height, frame.camera.width)


def score(run: Path) -> float:
    """Return the intersection over union in all test views of a run."""
    scene = load(run)
    train = scene.frames("train")
    rows, cameras = moving_rows(scene.method, train), [train[i].camera for i in spread(len(train), CAMERAS)]
    both = either = 0
    for frame in scene.frames("test"):
        found = moving_share(scene.method, rows, frame.camera, frame.time).numpy() > HALF
        truth = true_mask(scene, frame, cameras)
        both, either = both + (found & truth).sum(), either + (found | truth).sum()
    return float(both / either)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    for run in parser.parse_args().runs:
        print(f"{run}: {score(run):.3f}")


if __name__ == "__main__":
    main()
