from functools import partial

import pytest
import torch

from forewarp.data.module import SceneDataModule
from forewarp.methods.method import Start, parameter_count
from forewarp.methods.tnerf import TNeRF
from forewarp.ops.encode import positional_encoding
from forewarp.scene.batch import Batch, Observation
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Moment, View
from forewarp.training.objective import Objective
from forewarp.training.schedule import StageSettings
from forewarp.training.stages import Stage
from tests.support.tiny_scene import make_run

TIMES = (0.0, 0.5, 1.0)
SMALL = {"width": 32, "layers": 3, "skip": None, "position_frequencies": 3, "time_frequencies": 2}
SMALL |= {"direction_frequencies": 1, "samples": 12, "fine_samples": 12}
GENTLE = {"density": "softplus", "open_end": False}


def camera(size=12):
    pose = look_at(torch.tensor([0.0, -3.0, 0.4]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(size, size, 1.5 * size, 1.5 * size, size / 2, size / 2, pose, 2.0, 4.0)


def picture(time, size=12):
    """A dark square that slides to the right before white."""
    image = torch.zeros(size, size, 4, dtype=torch.uint8)
    begin = round(1 + time * (size - 6))
    image[4:8, begin : begin + 4] = torch.tensor([40, 80, 160, 255], dtype=torch.uint8)
    return image


def frame(name, time):
    return Frame(name, time, camera(), lambda: picture(time))


def moving_scene():
    """A static camera, three times."""
    train = tuple(frame(f"r_{i}", time) for i, time in enumerate(TIMES))
    return Scene("square", train, (), train[:1], Box((-1, -1, -1), (1, 1, 1)), 0.0, has_alpha=True)


def method(seed=0, **changes):
    torch.manual_seed(seed)
    return TNeRF(Start(moving_scene(), "fine", {}), **(SMALL | changes))


def batch(time=0.5):
    rgb = torch.rand(144, 3, generator=torch.Generator().manual_seed(0))
    return Batch((Observation(Moment(time), View(camera()), rgb, torch.ones(3)),), 0)


def test_published_counts():
    start = Start(moving_scene(), "fine", {})
    assert parameter_count(TNeRF(start)) == 600_452
    assert parameter_count(TNeRF(start, time_frequencies=10)) == 606_596


def test_the_snapshot_asks_the_network_in_world_units():
    made = method(**GENTLE)
    points, directions = torch.randn(4, 5, 3), torch.nn.functional.normalize(torch.randn(4, 3), dim=1)
    x, t = positional_encoding(points, 3), positional_encoding(torch.tensor([0.25]), 2)
    raw, color = made.network(
        torch.cat([x, t.expand(4, 5, -1)], -1), positional_encoding(directions, 1)[:, None].expand(4, 5, -1)
    )
    snapshot = made.at(Moment(0.25))
    density, seen = snapshot.radiance(points, directions)
    torch.testing.assert_close(density, torch.nn.functional.softplus(raw))
    torch.testing.assert_close(seen, color)
    torch.testing.assert_close(snapshot.density(points), density)
    assert snapshot.holds(Moment(0.25, camera=3))
    assert not snapshot.holds(Moment(0.2))


@pytest.mark.parametrize("inside_box", [False, True])
def test_a_step_gives_the_loss_of_the_fine_pass(inside_box):
    made = method(inside_box=inside_box, **GENTLE)
    step = made.look(batch(), {"photo": 1.0}, torch.Generator().manual_seed(0))
    loss = step.terms["photo"]()
    assert loss.item() == step.squared_error.item()
    loss.backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in made.parameters())
    assert sum(float(p.grad.abs().sum()) for p in made.parameters()) > 0
    assert {"density", "weights", "rgb"} == {name for name, _ in step.tensors()}
    assert step.noted["samples"] <= 144 * 24


def test_a_dead_start_is_named():
    made = method()
    with torch.no_grad():
        made.network.density_head.bias.fill_(-100)
    generator = torch.Generator().manual_seed(0)
    for _ in range(19):
        assert made.look(batch(), {"photo": 1.0}, generator).noted["opacity"] == 0
    with pytest.raises(ValueError, match="a dead start; set another seed=N, or model.density=softplus"):
        made.look(batch(), {"photo": 1.0}, generator)


def test_a_start_that_comes_alive_is_none():
    made, generator = method(), torch.Generator().manual_seed(0)
    for step in range(40):
        with torch.no_grad():
            made.network.density_head.bias.fill_(1.0 if step % 15 == 14 else -100)
        made.look(batch(), {"photo": 1.0}, generator)


def test_its_protocol_names_departures():
    published = method().protocol()["departures"]
    changed = method(inside_box=True, **GENTLE).protocol()["departures"]
    assert "softplus" not in published
    assert changed.startswith(published)
    assert "softplus density; the last interval ends with the ray; empty outside" in changed


def static_ceiling():
    """The train PSNR that no static model exceeds with a fixed camera."""
    images = torch.stack([picture(time).double() / 255 for time in TIMES])
    rgb = images[..., :3] * images[..., 3:] + 1 - images[..., 3:]
    return float(-10 * torch.log10(rgb.var(0, unbiased=False).mean()))


def test_it_learns_what_moves(tmp_path):
    settings = StageSettings.of("fine", lr={"network": 5e-3}, iterations=260, curriculum={"all_in": 0.0})
    stages = [Stage(settings, Objective({"photo": 1.0}))]
    data, model = SceneDataModule(moving_scene, rays=96), partial(TNeRF, **(SMALL | GENTLE))
    module = make_run(tmp_path, stages, data=data, model=model).fit()
    psnr = [float(module.psnr_of(target)) for target in data.targets("train")]
    assert sum(psnr) / len(psnr) > static_ceiling() + 3
