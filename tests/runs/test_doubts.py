from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from forewarp.data.checks import blind_frames
from forewarp.data.module import DNeRFDataModule, SceneDataModule
from forewarp.runs.fitted import doubts
from forewarp.scene.box import Box
from forewarp.training.schedule import StageSettings
from tests.support.tiny_scene import ball_scene

SCENE = ball_scene(frames=3, size=8)


def run(steps=5000, iterations=None, suspects=SceneDataModule.suspects, scene=SCENE, **noted):
    """A finished run of one stage, ``fine``, which took 7.7 s."""
    data = SceneDataModule(lambda: scene)
    data.suspects = suspects
    settings = StageSettings("fine", {}, iterations=iterations, minutes=None if iterations else 0.05)
    stage, made = SimpleNamespace(settings=settings), {"fine": {"steps": steps, "seconds": 7.7, **noted}}
    return SimpleNamespace(stages=[stage], datamodule=data, finished=lambda: made)


def reaching(psnr):
    """A module that shows training pixels so well."""
    return SimpleNamespace(psnr_of=lambda target, pixels: torch.tensor(float(psnr)))


def test_a_good_fit_is_not_doubted():
    assert doubts(run(), reaching(30)) == []


@pytest.mark.parametrize(("steps", "said"), [(1, "1 step in"), (49, "49 steps in"), (50, None)])
def test_a_stage_that_minutes_ended_after_few_steps_is_named(steps, said):
    lines = doubts(run(steps=steps), reaching(30))
    named = [f"stage.fine ended after {said} 7.7 s, too few to learn; raise budget.minutes"] if said else []
    assert [line.partition(",")[0] for line in lines] == [line.partition(",")[0] for line in named]
    assert doubts(run(steps=4, iterations=4), reaching(30)) == []  # as many as were asked for


@pytest.mark.parametrize(
    ("steps", "first"), [(5000, "poses in other axes"), (900, "too little training, 900")]
)
def test_low_psnr_names_the_three_likeliest_causes_of_the_format(steps, first):
    line, *causes = doubts(run(steps, suspects=DNeRFDataModule.suspects), reaching(12.9))
    assert line.startswith("training images are reached to 12.9 dB; one color alone has")
    assert [cause[: len("  likely cause 1")] for cause in causes] == [
        f"  likely cause {i}" for i in (1, 2, 3)
    ]
    assert first in causes[0]


def test_cameras_that_see_nothing_of_the_box_are_counted():
    camera = SCENE.train[0].camera
    turned = camera.camera_to_world @ torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64).diag()
    away = replace(camera, camera_to_world=turned)
    scene = replace(SCENE, train=(replace(SCENE.train[0], camera=away), *SCENE.train[1:]))
    assert (blind_frames(SCENE), blind_frames(scene)) == (0, 1)
    small = Box((0.2, 0.2, 0.2), (0.21, 0.21, 0.21))  # between the nine pixels that are asked first
    assert blind_frames(replace(SCENE, box=small)) == 0
    (line,) = doubts(run(scene=scene), reaching(30))
    assert line.startswith(f"1 of {len(scene.train)} training cameras see nothing of the box")
    in_file = {"normalisation": {"center": [10.0, 0.0, 0.0], "scale": 0.5}}  # remarks and data.box are of it
    (line,) = doubts(run(scene=replace(scene, protocol=in_file)), reaching(30))
    assert line.endswith("the box (8, -1.6, -1.4) to (12.4, 1.6, 1.4)")


def test_images_that_never_came_in_are_counted():
    (line,) = doubts(run(frames_in_play=2), reaching(30))
    assert line.startswith(
        f"{len(SCENE.train) - 2} of {len(SCENE.train)} training images were never trained on"
    )
