"""Training under bad conditions: learning rates far too high, odd scenes, other units (cases 27 to 30)."""

from dataclasses import replace
from functools import partial

import lightning
import pytest
import torch

from forewarp.data.module import SceneDataModule
from forewarp.fields.trajectory import TrajectoryField
from forewarp.methods.voxel.effects.background import StaticBackground
from forewarp.methods.voxel.effects.inpaint import UNet3d
from forewarp.methods.voxel.method import VoxelMethod
from forewarp.scene.box import Box
from tests.support.hard_cases import check_finite
from tests.support.tiny_scene import RATES, ball_scene, forward_model, make_run, stage

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


TERMS = (
    *("photo", "point_color", "background_entropy", "flow_l1", "tv_density", "tv_flow", "tv_depth"),
    *("inpaint_diff", "static_points", "moving_opacity"),
)


ALL = {
    "inpainter": partial(UNet3d, levels=2),
    "background": partial(StaticBackground, features=3, alpha_init=1e-2, alpha_threshold=1e-4),
}


class Diary(lightning.Callback):
    """Notes the loss of every step."""

    def __init__(self):
        self.losses = []

    def on_before_backward(self, trainer, module, loss):
        self.losses.append(float(loss.detach()))


def fit(folder, scene, iterations, weights=None, **changes):
    """A fitted module, the losses of its steps, and the mean PSNR of its test images."""
    data = SceneDataModule(lambda: scene, rays=changes.pop("rays", 128))
    model = changes.pop("model", None) or forward_model()
    fitting = stage(iterations=iterations, weights=weights, **({"num_voxels": [[0, 12**3]]} | changes))
    diary = Diary()
    module = make_run(folder, [fitting], data=data, model=model, callbacks=[diary]).fit()
    scores = []
    for target in data.targets("test"):
        drawn = module.render(target.view, target.moment, target.background).rgb
        error = (drawn.clamp(0, 1).reshape(target.rgb.shape) - target.rgb).square().mean()
        scores.append(-10 * float(torch.log10(error)))
    return module, diary.losses, sum(scores) / len(scores)


def all_finite(module):
    return all(p.isfinite().all() for p in module.parameters())


@pytest.mark.parametrize("factor", [1e-3, 2.0**20])
def test_no_term_of_the_loss_depends_on_the_unit_of_length(tmp_path, factor):
    """With all terms on, the first steps are equal except for rounding."""
    weights = dict.fromkeys(TERMS, 0.1)
    assert set(TERMS) == set(VoxelMethod.terms)
    options = {"iterations": 4, "weights": weights, "start": "hull", "patches": 2}
    options |= {"model": forward_model(**ALL), "background_num_voxels": [[0, 12**3]]}
    scene = replace(ball_scene(frames=6, size=16), still=torch.tensor([[0.9, 0.1, 0.2], [-0.8, 0.3, -0.2]]))
    _, plain, _ = fit(tmp_path / "a", scene, **options)
    _, other, _ = fit(tmp_path / "b", in_other_units(scene, factor), **options)
    assert other == pytest.approx(plain, rel=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_a_scene_in_other_units_trains_to_the_same_psnr(tmp_path, factor):
    scene = ball_scene(frames=12, size=20)
    weights = {
        "photo": 1.0,
        "point_color": 0.01,
        "tv_flow": 1e-3,
        "background_entropy": 1e-3,
        "flow_l1": 1e-4,
    }
    options = {"iterations": 250, "weights": weights, "start": "hull", "refresh_every": 25, "rays": 256}
    small, _, first = fit(tmp_path / "a", scene, **options)
    large, _, second = fit(tmp_path / "b", in_other_units(scene, factor), **options)
    assert all_finite(small)
    assert all_finite(large)
    assert first > 20
    assert abs(first - second) < 0.5  # rounding alone makes two runs differ by as much
    reach = [
        (m.method.trajectories(torch.zeros(1, 3), torch.ones(1)).norm() / m.method.half_extent).item()
        for m in (small, large)
    ]
    assert reach[0] == pytest.approx(reach[1], rel=0.5)


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


@pytest.mark.parametrize("times", [[0.0], [0.5, 0.5], [0.0, 1.0], [0.0, 0.0, 1.0, 1.0]])
def test_few_and_equal_times_train(tmp_path, times):
    scene = ball_scene(size=16, times=times, canonical_time=times[0])
    module, losses, _ = fit(tmp_path, scene, 5)
    assert all_finite(module)
    assert len(losses) == 5


@pytest.mark.parametrize("color", [255, 0])
def test_images_of_one_colour_train(tmp_path, color):
    """White on white, and black: nothing needs to be there."""
    scene = ball_scene(frames=4, size=16)

    def plain(frame):
        image = torch.full((16, 16, 4), color, dtype=torch.uint8)
        return replace(frame, load=lambda: image)

    scene = replace(scene, train=tuple(map(plain, scene.train)), has_alpha=True)
    module, losses, _ = fit(tmp_path, scene, 12)
    assert all_finite(module)
    assert losses[-1] <= losses[0] * 1.5 + 1e-3


def test_images_without_matter_train(tmp_path):
    """Alpha is 0 everywhere: the hull is empty, so the box is used, and everything fades."""
    scene = ball_scene(frames=4, size=16)
    nothing = torch.zeros(16, 16, 4, dtype=torch.uint8)
    scene = replace(scene, train=tuple(replace(f, load=lambda: nothing) for f in scene.train))
    module, _, _ = fit(tmp_path, scene, 20, start="hull", refresh_every=5)
    assert all_finite(module)


def test_a_camera_inside_the_box_trains(tmp_path):
    scene = ball_scene(frames=4, size=16)
    scene = replace(scene, box=Box((-5, -5, -5), (5, 5, 5)))
    module, _, _ = fit(tmp_path, scene, 8)
    assert all_finite(module)


@pytest.mark.parametrize("boost", [10.0, 300.0])
def test_rates_far_too_high_stay_finite(tmp_path, boost):
    """Density grows far and voxels leave the box: softplus is linear, the splat drops what is outside."""
    rates = {kind: boost * rate for kind, rate in RATES.items()}
    scene = ball_scene(frames=6, size=16)
    module, losses, _ = fit(tmp_path, scene, 40, lr=rates, start="hull", refresh_every=10)
    assert all_finite(module)
    assert all(loss < 1e4 for loss in losses)


@pytest.mark.parametrize("thin", [1e-2, 1e-6])
def test_a_flat_scene_trains(tmp_path, thin):
    scene = ball_scene(frames=4, size=16)
    scene = replace(scene, box=Box((-1, -0.8, -thin), (1.2, 0.8, thin)))
    module, _, _ = fit(tmp_path, scene, 8)
    assert module.method.radiance.lattice.count < 3 * 12**3
    assert all_finite(module)


@pytest.mark.slow
def test_a_hostile_start_at_ten_times_the_rates_ends_finite(tmp_path):
    pytest.importorskip("trimesh")
    from tests.stability.endurance import endure

    (done,) = endure(tmp_path / "trials.jsonl", seconds=600, seeds=1, steps=60, rates=[10.0])
    assert done["wrong"] is None
    assert done["psnr"] > 5
