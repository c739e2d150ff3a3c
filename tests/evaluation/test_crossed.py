"""Cameras of other times, and leaned ones, show what images of the film itself hide."""

import math
from dataclasses import replace

import pytest
import torch

from forewarp.data.batches import Targets
from forewarp.evaluation.crossed import crossed_scores, drop_of
from forewarp.evaluation.trust import ANGLES, trust_of
from forewarp.methods.method import Method, Snapshot
from forewarp.metrics.registry import summarise
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Rendering

SIZE, WALL, COUNT = 40, 2.0, 45


def camera_at(time):
    """A camera that looks along z, and goes aside."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = 1.5 * time - 0.75
    return Camera(SIZE, SIZE, 40.0, 40.0, SIZE / 2, SIZE / 2, pose, 0.1, 10.0)


def hits(camera, depth):
    """Where rays meet a wall across z, and how far away."""
    rays = camera.rays()
    away = (depth - rays.origins[:, 2]) / rays.directions[:, 2]
    return rays.origins + away[:, None] * rays.directions, away


def painted(places):
    """The colours of the wall."""
    return 0.5 + 0.4 * torch.sin(places[:, :1] * torch.tensor([5.0, 7.0, 11.0]) + 3 * places[:, 1:2])


class Wall(Method):
    """A wall at ``depth`` that shows each image where it was taken; at its own depth everywhere else.

    ``near``: how much nearer it stands for cameras that are turned by more than 6 degrees.
    """

    device = torch.device("cpu")

    def __init__(self, depth=WALL, near=1.0, gain=0.0):
        super().__init__()
        self.depth, self.near, self.gain = depth, near, gain

    def moving(self):
        """It is taken for Gaussians."""

    def at(self, moment):
        method = self

        class Shown(Snapshot):
            def render(self, view, background, rendering=None):
                places, away = hits(view.camera, method.depth)
                eye = camera_at(moment.time).center.float()
                ahead = places - eye
                there = eye + ahead * (WALL / ahead[:, 2:])
                turned = math.degrees(math.acos(min(1.0, float(view.camera.camera_to_world[2, 2]))))
                away = away * (method.near if turned > 6 else 1.0)
                rgb = painted(there) + method.gain * (moment.time if moment.lit is None else moment.lit)
                return Rendering(rgb, away, torch.ones(len(away)))

        return Shown()


def film(moves=lambda time: torch.zeros(SIZE, SIZE, dtype=torch.bool), gain=0.0):
    """A scene whose every eighth frame is held out, and its targets."""

    def load(time):
        rgb = painted(hits(camera_at(time), WALL)[0]) + gain * time
        return (
            (255 * torch.cat([rgb, torch.ones(len(rgb), 1)], 1))
            .round()
            .to(torch.uint8)
            .reshape(SIZE, SIZE, 4)
        )

    times = [i / (COUNT - 1) for i in range(COUNT)]
    masks = [None if moves is None else (lambda t=t: moves(t)) for t in times]
    frames = [
        Frame(f"{t:.3f}", t, camera_at(t), lambda t=t: load(t), load_moving=mask)
        for t, mask in zip(times, masks)
    ]
    train, test = (tuple(f for i, f in enumerate(frames) if (i % 8 == 4) == held) for held in (False, True))
    scene = Scene("wall", train, (), test, Box((-1, -1, 1), (1, 1, 3)), 0.5, has_alpha=False)
    return scene, Targets(test, torch.zeros(3), has_alpha=False)


def measured(method, scene, targets):
    """Scores by kind, the reason if there are none, and the angles."""
    numbers = range(len(targets))
    rows, reason = crossed_scores(method, scene, targets, numbers)
    test = summarise(rows)
    return test, reason, trust_of(method, scene, targets, numbers, drop_of(test))


@pytest.mark.slow
def test_a_wall_that_fakes_its_depth_is_crossed_out_and_trusted_nowhere():
    scene, targets = film()
    test, _, trust = measured(Wall(), scene, targets)
    assert drop_of(test) < 3
    assert test["crossed"]["psnr"] > 50
    assert trust == {"degrees": ANGLES[-1], "rest": ANGLES[-1]}
    test, _, trust = measured(Wall(depth=1.2), scene, targets)
    assert test["crossed_own"]["psnr"] > 50
    assert test["crossed"]["psnr"] < 20
    assert trust == {"degrees": 0.0, "rest": 0.0}


@pytest.mark.slow
def test_images_are_compared_in_their_own_light():
    scene, targets = film(gain=0.1)
    assert measured(Wall(gain=0.1), scene, targets)[0]["crossed"]["psnr"] > 50
    assert measured(Wall(), scene, targets)[0]["crossed"]["psnr"] < 35


@pytest.mark.slow
def test_what_moves_at_either_time_does_not_count():
    """A part of the wall is painted wrongly in all images but within the masks, which are grown."""

    def moves(time):
        mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
        mask[:12] = True
        return mask

    scene, targets = film(moves)
    spoilt = Targets(
        [replace(f, load=lambda f=f: spoil(f.load())) for f in scene.test], torch.zeros(3), False
    )
    assert measured(Wall(), scene, spoilt)[0]["crossed"]["psnr"] > 50
    scene, _ = film(lambda time: moves(time) & (time > 2))
    spoilt = Targets(
        [replace(f, load=lambda f=f: spoil(f.load())) for f in scene.test], torch.zeros(3), False
    )
    assert measured(Wall(), scene, spoilt)[0]["crossed"]["psnr"] < 20
    scene, targets = film(moves)
    assert {*measured(Wall(), scene, targets)[2]} == {"degrees", "subject", "rest"}


def spoil(image):
    """An image whose upper rows are black."""
    image = image.clone()
    image[:16, :, :3] = 0
    return image


@pytest.mark.slow
def test_without_masks_or_times_far_away_it_says_why():
    assert measured(Wall(), *film(None))[:2] == ({}, "no mask says what moves")
    scene, targets = film()
    short = replace(scene, train=scene.train[:10])
    targets = Targets(scene.test[:1], torch.zeros(3), False)
    rows, reason = crossed_scores(Wall(), short, targets, [0])
    assert not rows
    assert reason == "of 11 times, none is 20 away from another"
    everything = film(lambda time: torch.ones(SIZE, SIZE, dtype=torch.bool))
    assert measured(Wall(), *everything)[1] == "hardly any pixel rests"


@pytest.mark.slow
def test_what_stands_before_the_photo_ends_trust():
    scene, targets = film()
    trust = measured(Wall(near=0.9), scene, targets)[2]
    assert 5 < trust["degrees"] < 7
    assert trust_of(Wall(), replace(scene, has_alpha=True), targets, [0], None) == {}
