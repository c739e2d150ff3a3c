"""Training under bad conditions: learning rates far too high, odd scenes, other units (cases 27 to 30)."""

from dataclasses import replace

import lightning
import pytest
import torch

from forewarp.data.module import SceneDataModule
from forewarp.fields.curves import TrajectoryField
from forewarp.methods.voxel.model import VoxelMethod
from forewarp.scene.box import Box
from tests.support.hard_cases import check_finite
from tests.support.tiny_scene import EVERYTHING, RATES, ball_scene, forward_model, make_run, stage

pytestmark = pytest.mark.stability


def in_other_units(scene, factor):
    """Multiply every length of a scene."""

    def grown(frame):
        pose = frame.camera.camera_to_world.clone()
        pose[:3, 3] *= factor
        near, far = frame.camera.near * factor, frame.camera.far * factor
        return replace(frame, camera=replace(frame.camera, camera_to_world=pose, near=near, far=far))

    box = Box(tuple(v * factor for v in scene.box.low), tuple(v * factor for v in scene.box.high))
    splits = {name: tuple(map(grown, getattr(scene, name))) for name in ("train", "val", "test")}
    still = None if scene.still is None else scene.still * factor
    return replace(scene, box=box, still=still, **splits)


class Diary(lightning.Callback):
    """Notes the loss of every step."""

    def __init__(self):
        self.losses = []

    def on_before_optimizer_step(self, trainer, module, optimizer):
        self.losses.append(module.last["loss"])


def fit(folder, scene, iterations, weights=None, model=None, **changes):
    """A fitted module and the losses of its steps."""
    data, diary = SceneDataModule(lambda: scene, rays=128), Diary()
    fitting = stage(iterations=iterations, weights=weights, **({"num_voxels": [[0, 12**3]]} | changes))
    return make_run(folder, [fitting], data=data, model=model, callbacks=[diary]).fit(), diary.losses


@pytest.mark.slow
def test_no_term_of_the_loss_depends_on_the_unit_of_length(tmp_path):
    """With all terms on, the first steps are equal except for rounding."""
    weights = dict.fromkeys(VoxelMethod.terms, 0.1)
    model = forward_model(**{name: EVERYTHING[name] for name in ("inpainter", "background")})
    options = {"iterations": 4, "weights": weights, "start": "hull", "patches": 2, "refresh_every": 2}
    options |= {"model": model, "background_num_voxels": [[0, 12**3]]}
    scene = replace(ball_scene(frames=6, size=16), still=torch.tensor([[0.9, 0.1, 0.2], [-0.8, 0.3, -0.2]]))
    _, plain = fit(tmp_path / "a", scene, **options)
    for factor in (1e-3, 2.0**20):
        _, losses = fit(tmp_path / str(factor), in_other_units(scene, factor), **options)
        assert losses == pytest.approx(plain, rel=2e-4)


def paths_of(factor):
    """Return trajectories of one random network over the D-NeRF box in another unit of length."""
    torch.manual_seed(0)
    box = Box((-1.5 * factor,) * 3, (1.5 * factor,) * 3)
    field = TrajectoryField(box, bases=3, frames=8, canonical_time=0.0, nodes=8, width=16, layers=2)
    torch.nn.init.normal_(field.network[-1].weight)
    return field.trajectories(factor * torch.eye(3), torch.ones(1)), field


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_a_trajectory_is_in_units_of_the_scene(factor):
    paths, field = paths_of(factor)
    check_finite(paths / factor, *field.network.parameters())
    torch.testing.assert_close(paths / factor, paths_of(1.0)[0], rtol=1e-4, atol=1e-4)


def pictured(scene, color):
    """The scene with every training image of one colour."""
    image = torch.full((16, 16, 4), color, dtype=torch.uint8)
    return replace(scene, train=tuple(replace(frame, load=lambda: image) for frame in scene.train))


SCENE = ball_scene(frames=4, size=16)
FEW = ([0.0], [0.5, 0.5], [0.0, 1.0], [0.0, 0.0, 1.0, 1.0])
HULL = {"iterations": 20, "start": "hull", "refresh_every": 10}


def boosted(boost):
    return {"lr": {kind: boost * rate for kind, rate in RATES.items()}}


HARD = {
    **{f"times {times}": (ball_scene(size=16, times=times, canonical_time=times[0]), {}) for times in FEW},
    "white on white": (pictured(SCENE, 255), {"iterations": 12}),
    "without matter": (pictured(SCENE, 0), {"iterations": 20, "start": "hull", "refresh_every": 5}),
    "a camera inside the box": (replace(SCENE, box=Box((-5, -5, -5), (5, 5, 5))), {}),
    **{f"{t} thin": (replace(SCENE, box=Box((-1, -0.8, -t), (1.2, 0.8, t))), {}) for t in (1e-2, 1e-6)},
    # Density grows far and voxels leave the box: softplus is linear, the splat drops what is outside.
    **{f"rates {boost} too high": (SCENE, HULL | boosted(boost)) for boost in (10.0, 300.0)},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HARD)
def test_hard_scenes_train(tmp_path, name):
    scene, options = HARD[name]
    module, losses = fit(tmp_path, scene, **({"iterations": 8} | options))
    assert all(p.isfinite().all() for p in module.parameters())
    assert len(losses) == options.get("iterations", 8)
    assert all(loss < 1e4 for loss in losses)
    assert module.method.radiance.lattice.count < 3 * 12**3
