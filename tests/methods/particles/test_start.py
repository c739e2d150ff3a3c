"""Where particles begin, how large, and that what a step calls is compiled by then."""

import subprocess
import sys
from dataclasses import replace
from functools import cache

import pytest
import torch

from forewarp.methods.method import Start
from forewarp.methods.particles import start
from forewarp.ops.backend import numba_installed
from forewarp.scene.camera import Camera, Lens
from forewarp.scene.cloud import Cloud, Handover
from forewarp.scene.frame import Frame
from tests.contract.scenes import DATASETS, RADIUS, ball_center, data_of
from tests.support.kernels import watch
from tests.support.particles import EVERY, look, module_with, small_data

compiled = pytest.mark.skipif(not numba_installed(), reason="needs Numba")


@pytest.fixture(scope="module")
def scene_of(tmp_path_factory):
    """``scene_of(dataset)``: a ball that slides along x."""
    root = tmp_path_factory.mktemp("scenes")

    @cache
    def read(dataset):
        DATASETS[dataset][0](root / dataset)
        return data_of(dataset, root).scene

    return read


def inside(points, box):
    return bool(((points >= torch.tensor(box.low)) & (points <= torch.tensor(box.high))).all())


def test_the_hull_is_around_the_ball(scene_of):
    scene = scene_of("nhr")  # several cameras a time
    cloud = start.hull_surface(scene, [i for i, f in enumerate(scene.train) if f.time == 0.0], 400)
    away = (cloud.points - ball_center(0.0)).norm(dim=-1)
    assert len(cloud) == 400
    assert 0.8 * RADIUS < float(away.median()) < 1.5 * RADIUS
    assert bool(((cloud.colors >= 0) & (cloud.colors <= 1)).all())
    assert cloud.size > 0


@pytest.mark.slow
def test_a_sweep_looks_at_neighbours_in_time_and_keeps_known_points(scene_of):
    scene = scene_of("hypernerf")
    cloud = start.swept(scene, [], 400)
    assert len(cloud) > 16
    assert inside(cloud.points, scene.box)
    known = cloud.points[:50]
    cloud = start.swept(replace(scene, still=known), [], 400)
    cameras, images = [f.camera for f in scene.train], [f.load() for f in scene.train]
    assert torch.equal(cloud.points[:50], known)
    torch.testing.assert_close(cloud.colors[:50], start.seen_colors(known, cameras, images))
    assert float((cloud.colors[:50] - 0.5).abs().max()) > 0.05

    def unread():
        raise AssertionError("an image of another time was read")

    around = [scene.train[i % len(scene.train)] for i in range(10)]
    now = [replace(frame, time=0.5, camera_id=i) for i, frame in enumerate(around)]
    other = [replace(frame, time=t, camera_id=0, load=unread) for frame in around for t in (0.4, 0.6)]
    after = list(range(len(other), len(other) + 10))
    assert len(start.swept(replace(scene, train=(*other, *now)), after, 400)) > 16
    with pytest.raises(AssertionError, match="another time"):
        start.swept(replace(scene, train=(*other, *now[:8])), after[:8], 400)


def test_a_sweep_of_images_of_one_row(scene_of):
    scene = scene_of("hypernerf")
    strip = torch.zeros(1, 1000, 4, dtype=torch.uint8)
    narrow = [replace(f, camera=f.camera.resized(1000, 1), load=lambda: strip) for f in scene.train[:3]]
    cloud = start.swept(replace(scene, train=tuple(narrow)), [], 400)
    assert cloud is None or inside(cloud.points, scene.box)


def test_points_lie_beyond_the_box_where_there_is_a_shell(scene_of):
    scene = scene_of("hypernerf")
    cloud = start.swept(scene, [], 400, shell=4.0)
    low, high = torch.tensor(scene.box.low), torch.tensor(scene.box.high)
    beyond = ((cloud.points < low) | (cloud.points > high)).any(-1)
    assert 0 < int(beyond.sum()) < len(cloud)
    for frame in scene.train:  # hardly a ray goes past all
        rays = frame.camera.rays()
        holes = start._in_holes(cloud.points, rays.origins + rays.directions, frame.camera, 5)
        assert float(holes.float().mean()) < 0.1


def test_an_image_of_a_sweep_fills_only_its_holes(scene_of):
    camera = scene_of("hypernerf").train[0].camera  # 20 x 16 pixels; cells of 4 x 4
    rays = camera.rays()
    column = torch.arange(320) % 20
    there = (rays.origins + 3.0 * rays.directions)[column < 12]
    for depth in (1.0, 5.0):  # before what is there, and behind it
        fills = start._in_holes(there, rays.origins + depth * rays.directions, camera, 5)
        assert torch.equal(fills, column >= 12)
    assert bool(start._in_holes(torch.zeros(0, 3), there, camera, 5).all())


def test_the_lens_of_an_image_that_is_swept_is_undone():
    """The colour of a pixel is its place; without the lens it is where the lens shows its ray."""
    pose = torch.eye(4, dtype=torch.float64)
    bent = Camera(96, 64, 80.0, 80.0, 48.0, 32.0, pose, 0.1, 9.0, lens=Lens((0.15, 0.0, 0.0)))
    rows, columns = torch.meshgrid(torch.arange(64), torch.arange(96), indexing="ij")
    image = torch.stack([rows, columns, 0 * rows, 255 + 0 * rows], -1).byte()
    rgb, valid, straight = start._small([Frame("a", 0.0, bent, lambda: image)], 64, 0)
    assert straight.lens is None
    assert valid[8:-8, 8:-8].all()
    assert not valid[0, 0]  # its ray lies outside the image
    pixel, _ = bent.project(straight.rays(dtype=torch.float64).directions)
    shown = pixel.reshape(64, 96, 2)[8:-8, 8:-8] - 0.5
    found = 255 * rgb[8:-8, 8:-8, [1, 0]]
    assert (found - shown).abs().max() < 0.1


def before_wall(scene, times, ball=lambda time: time, known=lambda depth: depth > 0):
    """Frames of a camera that sees a wall at distance 4, and 2 away, at a column that time moves, a post."""
    pose = torch.eye(4, dtype=torch.float64)
    camera, frames = Camera(40, 20, 1e4, 1e4, 20, 10, pose, 0.1, 9.0), []  # nearly parallel rays
    for time in times:
        depth, at = torch.full((20, 40), 4.0), round(30 * ball(time))
        depth[:, at : at + 10] = 2.0
        rgba = (60 * depth[..., None]).repeat(1, 1, 4).to(torch.uint8)
        sensed = torch.stack([depth * known(depth), torch.ones_like(depth)])
        frames.append(Frame("a", time, camera, lambda i=rgba: i, load_sensed=lambda d=sensed: d))
    return replace(scene, train=tuple(frames), canonical_time=times[0], has_alpha=False)


def test_particles_begin_at_measured_depths_and_at_what_was_hidden_behind(scene_of):
    scene = before_wall(scene_of("hypernerf"), [0.0, 1.0])
    cloud = start.measured(scene, 300)
    near = cloud.points[:, 2] < 3
    depth = torch.where(near, 2.0, 4.0)
    torch.testing.assert_close(cloud.points[:, 2], depth, atol=1e-4, rtol=0)
    columns = torch.stack([scene.train[0].camera.project(cloud.points)[0][:, 0], near.float()])
    assert columns[0][near].max() < 10  # where it stood at the canonical time alone
    assert (columns[0][~near] < 10).sum() == near.sum()  # and the wall that it hid then
    assert cloud.colors[near].max() < 0.5 < cloud.colors[~near].min()
    scene = before_wall(scene_of("hypernerf"), [0.0], known=lambda depth: depth < 3)
    assert (start.measured(scene, 300).points[:, 2] < 3).all()
    unsure = torch.stack([torch.ones(20, 40), torch.full((20, 40), 0.1)])
    doubted = replace(scene.train[0], load_sensed=lambda: unsure)
    assert start.measured(replace(scene, train=(doubted,)), 300) is None
    assert start.measured(scene_of("hypernerf"), 300) is None


@pytest.mark.slow
def test_what_a_stage_left_comes_first_and_random_points_last(scene_of):
    scene = scene_of("dnerf")
    left = Cloud(torch.rand(100, 3), torch.rand(100, 3), torch.ones(100), 0.1)
    begun = Start(scene, "fine", {}, [0, 1], Handover(scene.box, True, 6, left))
    assert torch.equal(start.first_points(begun, 1000).points, left.points)
    assert len(start.first_points(begun, 30)) == 30
    alone = replace(scene, train=scene.train[:1], has_alpha=False)
    assert inside(start.first_points(Start(alone, "fine", {}, [0]), 50).points, scene.box)
    assert start.covered_pixels(scene, [0]) == int((scene.train[0].load()[..., 3] > 127).sum())


def values_of(points, widest=None, size=1.0):
    cloud = Cloud(points, torch.full_like(points, 0.75), torch.ones(len(points)), size)
    return start.first_values(cloud, widest)


def test_particles_begin_round_and_no_larger_than_they_are_apart(scene_of):
    axis = torch.arange(4.0)
    first = values_of(torch.cartesian_prod(axis, axis, axis))
    torch.testing.assert_close(first["scales"], torch.zeros(64, 3), atol=1e-3, rtol=0)
    torch.testing.assert_close(0.5 + 0.28209479 * first["colors"], torch.full((64, 1, 3), 0.75))
    for points in (torch.zeros(9, 3), torch.zeros(1, 3)):  # that coincide, or are alone
        assert bool(values_of(points, size=0.3)["scales"].isfinite().all())
    scene = scene_of("hypernerf")
    camera = scene.train[0].camera
    points = camera.center.float() - 2.0 * camera.camera_to_world[:3, 2].float() + 0.1 * torch.rand(50, 3)
    away = torch.stack([(points - f.camera.center.float()).norm(dim=-1) for f in scene.train]).amin(0)
    widest = start.widths(scene, points, 200.0)
    torch.testing.assert_close(widest, away / camera.fx * 2.0)  # 200 pixels for 50 points: 2 pixels apart
    far, near = (values_of(points * scale, widest)["scales"].exp() for scale in (100, 1e-3))
    torch.testing.assert_close(far, widest[:, None].expand(-1, 3))
    assert bool((near < widest[:, None]).all())


@compiled
def test_the_first_steps_meet_warm_kernels_only(monkeypatch):
    met, data = watch(monkeypatch, "project", "rasterize", "nodes", "adam"), small_data()
    module = module_with(data, **EVERY)
    module.method.warm_up()
    warm = met.copy()
    met.clear()
    optimizer = module.configure_optimizers()
    look(module, data)
    for p in module.parameters():
        p.grad = torch.ones_like(p)
    optimizer.step()
    assert len(met) > 5
    assert met <= warm


@compiled
@pytest.mark.slow
def test_the_process_beside_compiles_for_the_numbers_that_a_step_has():
    script = (
        "import types, torch\n"
        "from forewarp.methods.particles.start import compile_backward, compile_kernels\n"
        "from forewarp.ops.kernels import project, rasterize\n"
        "kernels = (rasterize.compare, project.splat_gradients, project.chain)\n"
        "compile_backward(); before = [list(kernel.signatures) for kernel in kernels]\n"
        "assert all(len(found) == 1 for found in before), before\n"
        "compile_kernels(torch.zeros(1, 3), False)\n"
        "assert [list(kernel.signatures) for kernel in kernels] == before\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("new", "cores", "child", "message"),
    [
        *((False, 2, "unused", ""), (True, 1, "unused", ""), (True, 2, None, ""), (True, 2, "", "")),
        (True, 2, "import sys; sys.exit('no room')", "as a second one failed: no room\n"),
    ],
)
def test_new_kernels_are_compiled_by_another_process_too(monkeypatch, capsys, new, cores, child, message):
    started, popen = [], subprocess.Popen

    def begin(command, **how):
        started.append(command)
        if child is None:
            raise OSError("no more processes")
        return popen([sys.executable, "-c", child], **how)

    monkeypatch.setattr(subprocess, "Popen", begin)
    monkeypatch.setattr(start, "cores", lambda: cores)
    with start._backward_compiled_beside(new):
        pass
    code = "from forewarp.methods.particles.start import compile_backward; compile_backward()"
    assert len(started) == (child != "unused")
    assert all(begun[:2] == [sys.executable, "-c"] and begun[2].endswith(code) for begun in started)
    assert capsys.readouterr().out.endswith(message)
