"""A moving scene in memory (a coloured ball that slides along x), small methods, and runs over it."""

import math
from functools import partial
from pathlib import Path

import lightning
import torch

from forewarp.data.module import SceneDataModule
from forewarp.fields.curves import TrajectoryField
from forewarp.fields.grids import DirectRadiance, FeatureRadiance
from forewarp.methods.method import Start
from forewarp.methods.voxel import effects
from forewarp.methods.voxel.backward import BackwardWarp
from forewarp.methods.voxel.forward import ForwardWarp
from forewarp.methods.voxel.model import VoxelMethod, VoxelSnapshot
from forewarp.methods.voxel.structure import VoxelStage
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.cloud import Handover
from forewarp.scene.frame import Frame, Scene
from forewarp.training.module import DynamicSceneModule
from forewarp.training.objective import Objective
from forewarp.training.schedule import Curriculum, StageSettings
from forewarp.training.stages import Run, Stage

RADIUS, TRAVEL = 0.4, (0.8, 0.0, 0.0)
BOX = Box((-1, -0.8, -0.7), (1.2, 0.8, 0.7))
RATES = {"density": 0.3, "color": 0.1, "shading": 0.02, "flow": 5e-3, "network": 1e-3, "grid": 0.1}


def ball_center(time):
    """Return the centre (3,) of the ball at a time."""
    return torch.tensor([-0.3, 0.1, 0.0]) + time * torch.tensor(TRAVEL)


def photograph(camera, time, finer=3):
    """The exact image (H, W, 4) uint8: the mean of ``finer`` squared rays, alpha the share of hits."""
    big = camera.resized(camera.width * finer, camera.height * finer)
    rays = big.rays()
    offset = rays.origins - ball_center(time)
    along = (offset * rays.directions).sum(-1)
    inside = along**2 - (offset**2).sum(-1) + RADIUS**2
    hit = inside > 0
    normal = (offset + (-along - inside.clamp(min=0).sqrt())[:, None] * rays.directions) / RADIUS
    rgba = torch.cat([0.5 + 0.4 * normal, torch.ones(len(rays), 1)], -1) * hit[:, None]
    shape = (camera.height, finer, camera.width, finer, 4)
    mean = rgba.reshape(shape).mean((1, 3))
    mean[..., :3] /= mean[..., 3:].clamp(min=1e-6)
    return (mean * 255).round().to(torch.uint8)


def camera_at(turn, size=24):
    """A camera of ``size`` x ``size`` pixels on a slanted circle about the origin."""
    angle = 2 * math.pi * turn
    center = torch.tensor([3 * math.cos(angle), 3 * math.sin(angle), 1.2 + 0.8 * math.sin(2 * angle)])
    pose = look_at(center, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(size, size, 1.2 * size, 1.2 * size, size / 2, size / 2, pose, 1.0, 5.5)


def frame_at(name, turn, time, size=24):
    """Make a frame with its image."""
    camera = camera_at(turn, size)
    image = photograph(camera, time)
    return Frame(name, time, camera, lambda: image)


def ball_scene(frames=12, size=24, canonical_time=0.0, times=None):
    """``frames`` training frames from everywhere, one validation frame, three test frames between them."""
    if times is None:
        times = [i / (frames - 1) for i in range(frames)]
    train = tuple(frame_at(f"r_{i}", 0.381966 * i, t, size) for i, t in enumerate(times))
    test = tuple(frame_at(f"t_{i}", 0.13 + 0.31 * i, t, size) for i, t in enumerate((0.0, 0.45, 1.0)))
    return Scene("ball", train, test[1:2], test, BOX, canonical_time, has_alpha=True)


def ball_data(rays=256, seed=0, **changes):
    """A data module over a fresh ball scene."""
    return SceneDataModule(lambda: ball_scene(**changes), rays=rays, seed=seed)


RADIANCE = partial(DirectRadiance, alpha_init=1e-2, alpha_threshold=1e-4)
FEATURES = partial(FeatureRadiance, alpha_init=1e-2, alpha_threshold=0.0, width=8)
INPAINTER = partial(effects.UNet3d, width=16, levels=2)
EVERYTHING = {
    "radiance": FEATURES,
    "view_dependence": effects.ViewNetwork,
    "upsampler": partial(effects.LearnedUpsampler, width=8),
    "inpainter": INPAINTER,
    "background": partial(effects.StaticBackground, features=3, alpha_init=1e-2, alpha_threshold=1e-4),
}


def forward_model(**changes):
    """Make a cheap forward model: colours in the voxels, few bases."""
    choices = {
        "radiance": RADIANCE,
        "motion": effects.Motion,
        "trajectory": partial(TrajectoryField, bases=4, nodes=8, width=32, layers=3),
        "view_dependence": effects.SphericalHarmonics,
    }
    return partial(ForwardWarp, **(choices | changes))


def backward_model(**changes):
    """Make a cheap backward model; name its ``deformation``."""
    choices = {"radiance": RADIANCE, "view_dependence": effects.SphericalHarmonics}
    return partial(BackwardWarp, **(choices | changes))


def built(model, lattice, active=None, *, density_scale=0.3, frames=5, canonical_time=0.0, box=BOX, **own):
    """Make a model's method on a lattice, by default fully active; ``own`` are numbers of its stage."""
    everywhere = torch.ones(lattice.shape, dtype=torch.bool)
    train = tuple(Frame(str(i), i / max(frames - 1, 1), camera_at(0.0), None) for i in range(frames))
    scene = Scene("ball", train, (), (), box, canonical_time, has_alpha=True)
    handover = Handover(box, True, frames, notes={"density_scale": density_scale})
    start = Start(scene, "fine", {"num_voxels": [[0, 500]]} | own, (), handover, blank=True)
    background = on(model.keywords.get("background"), lattice, everywhere)
    radiance = on(model.keywords["radiance"], lattice, everywhere if active is None else active)
    return model(start, radiance=radiance, background=background)


def on(factory, lattice, active):
    """Let a factory use a lattice of the test's own; None for None."""
    return factory and (lambda *_, **options: factory(lattice, active, **options))


def ball_method(scene, raw=8.0, **numbers):
    """Make a first stage's method whose canonical grid is the ball, with some motion."""
    torch.manual_seed(0)
    numbers = {"num_voxels": [[0, 1500]]} | numbers
    method = forward_model()(Start(scene, "coarse", numbers, range(len(scene.train))))
    points = method.radiance.lattice.to_world(method.radiance.voxels)
    inside = (points - ball_center(0.0)).norm(dim=-1) < RADIUS
    method.radiance.density.data = torch.where(inside, raw, -9.0)[:, None]
    torch.nn.init.normal_(method.radiance.color)
    torch.nn.init.normal_(method.motion.trajectory.network[-1].weight, std=1e-3)
    return method


def begun(method, scene, made):
    """Prepare a method for the stage ``made`` of a scene, and keep its contents."""
    settings, objective = made.settings, made.objective
    options = {"weights": objective.weights, "literal": objective.literal, "photo_on": objective.photo_on}
    method.stage = VoxelStage(name=settings.name, **settings.numbers)
    method.begin(Start(scene, settings.name, settings.numbers, blank=True, **options))
    return method


def stage(name="coarse", weights=None, photo_on=None, **changes):
    """Make a stage of few steps on a small lattice."""
    numbers = {"num_voxels": [[0, 14**3]], "iterations": 12, "keep_alpha": 1e-2, "birth_alpha": 5e-3}
    numbers |= {"lr": RATES} | changes
    weights = {"photo": 1.0, "point_color": 0.01, "tv_flow": 1e-3} if weights is None else weights
    objective = Objective(weights, photo_on=photo_on)
    return Stage(StageSettings.of(name, **(numbers | changes)), objective)


def trainer(callbacks, **changes):
    """A silent trainer on the CPU."""
    off = dict.fromkeys(("enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)
    off |= {"limit_val_batches": 0, "num_sanity_val_steps": 0, "logger": False}
    common = {"max_epochs": 1, "max_steps": -1, "accelerator": "cpu"} | off | changes
    return lightning.Trainer(callbacks=callbacks, **common)


def make_run(folder, stages, *, data=None, model=None, callbacks=(), **changes):
    """Make a run over the ball scene in ``folder``."""
    made = lambda where, own, loggers: trainer(own, logger=loggers, default_root_dir=str(where))  # noqa: E731
    changes["callbacks"] = lambda name, where: list(callbacks)
    return Run(data or ball_data(), model or forward_model(), stages, Path(folder), made, **changes)


def same(one, other):
    """Return whether two modules hold the same tensors, bit for bit."""
    one, other = ({k: v for k, v in m.state_dict().items() if torch.is_tensor(v)} for m in (one, other))
    return one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)


class Interrupt(lightning.Callback):
    """Save and exit after a step of a stage."""

    def __init__(self, stage, step):
        self.stage, self.step = stage, step

    def on_train_batch_end(self, trainer, module, *_):
        if module.settings.name == self.stage and module.global_step == self.step:
            for callback in trainer.callbacks:
                if hasattr(callback, "save"):
                    callback.save(trainer)
            raise SystemExit


class KnownBall(VoxelMethod):
    """The ball and a static block as a solid grid with exact motion, which needs no training.

    ``asked`` records the times passed to ``at``.
    """

    moves = True

    def __init__(self, count=30**3):
        start = Start(ball_scene(size=8), "fine", {"num_voxels": [[0, count]]}, blank=True)
        super().__init__(start, radiance=RADIANCE)
        lattice = self.radiance.lattice
        self.points = lattice.to_world(self.radiance.voxels)
        self.asked = []

    def at(self, moment):
        """Move the ball by filling the grid anew."""
        self.asked.append(moment.time)
        self.fill(moment.time)
        grid = self.radiance()
        canonical = self.fill(0.0).radiance()
        return VoxelSnapshot(moment, {"upsampled": grid}, canonical, self.renderer)

    def fill(self, time):
        ball = (self.points - ball_center(time)).norm(dim=-1) < RADIUS
        self.radiance.density.data = torch.where(ball | self.is_still(self.points), 20.0, -10.0)[:, None]
        return self

    def is_still(self, points, half=0.15):
        """Return whether points belong to the static block."""
        return (points - torch.tensor([-0.3, -0.6, -0.5])).abs().amax(-1) < half

    def trajectories(self, points, times):
        moved = points[:, None] + times[:, None] * torch.tensor(TRAVEL)
        return torch.where(self.is_still(points, 0.27)[:, None, None], points[:, None], moved)


def known_ball():
    """Make a module of it."""
    options = {"objective": Objective({}), "settings": stage().settings}
    return DynamicSceneModule(KnownBall().fill(0.0), curriculum=Curriculum([0.0, 1.0], 0.0), **options)
