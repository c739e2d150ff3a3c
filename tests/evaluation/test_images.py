import math
from types import SimpleNamespace

import pytest
import torch

from forewarp.drawing.images import error_colors
from forewarp.evaluation.images import (
    Filled,
    image_flow,
    images_of,
    make_shots,
    sized,
    validation_psnr,
    video,
    within,
)
from forewarp.evaluation.trajectories import Trajectories, moving_points
from forewarp.scene.film import FilmPath
from forewarp.scene.view import Target
from tests.support.tiny_scene import RADIUS, TRAVEL, ball_center, ball_data, ball_scene, camera_at, known_ball


@pytest.fixture(scope="module")
def module():
    return known_ball()


def test_flow_is_the_projected_displacement_of_the_canonical_surface(module):
    camera, time = camera_at(0.6, size=40), 0.7
    flow, opacity = image_flow(module, camera, time)
    assert flow.shape == (40, 40, 2)
    rays = camera.rays()
    offset = rays.origins - ball_center(0.0)
    along = (offset * rays.directions).sum(-1)
    inside = along**2 - (offset**2).sum(-1) + RADIUS**2
    surface = rays.origins + (-along - inside.clamp(min=0).sqrt())[:, None] * rays.directions
    moved = camera.project(surface + time * torch.tensor(TRAVEL))[0] - camera.project(surface)[0]
    well = (inside > 0.08).reshape(40, 40)  # away from the silhouette
    assert int(well.sum()) > 40
    assert float(opacity[well].min()) > 0.95
    assert float(moved.norm(dim=-1)[well.flatten()].min()) > 2
    assert float((flow - moved.reshape(40, 40, 2)).norm(dim=-1)[well].max()) < 0.35
    block = (opacity > 0.95) & (inside < -0.1).reshape(40, 40)
    assert int(block.sum()) > 5
    assert float(flow.norm(dim=-1)[block].max()) < 0.05


def test_images_are_reduced_and_compare_with_the_truth(module):
    frame, truth = ball_scene(frames=2, size=32).train[0], torch.full((32, 32, 3), 0.25)
    images = images_of(module, Target(frame, truth, torch.ones(3)), size=16)
    shapes = {"compare": (16, 3 * 16 + 8, 3), "depth": (16, 16, 3), "flow": (16, 16, 3)}
    assert {name: tuple(image.shape) for name, image in images.items()} == shapes
    assert all(0 <= float(i.min()) <= float(i.max()) <= 1 and float(i.std()) > 0 for i in images.values())
    left, middle, right = (images["compare"][:, i : i + 16] for i in (0, 20, 40))
    torch.testing.assert_close(left, truth[:16, :16])
    torch.testing.assert_close(right, error_colors(left, middle))


@pytest.mark.slow
def test_the_validation_psnr_is_a_mean_over_images_that_draws_nothing_global(module):
    targets = ball_data(frames=2, size=32).targets("test")
    whole = validation_psnr(module, targets, rays=32 * 32)
    assert whole == pytest.approx(sum(float(module.psnr_of(t)) for t in targets) / 3, abs=1e-4)
    before = torch.get_rng_state()
    some = validation_psnr(module, targets, rays=400)
    assert torch.equal(torch.get_rng_state(), before)
    assert some == validation_psnr(module, targets, rays=400)
    assert 0 < abs(some - whole) < 2


def test_sizes_follow_the_longer_side():
    camera = camera_at(0.0, size=40).resized(80, 40)
    cameras = within(camera, 60), within(camera, 90), within(camera, None), sized(camera, 160)
    assert [(c.width, c.height) for c in cameras] == [(60, 30), (80, 40), (80, 40), (160, 80)]


WHITE = torch.ones(3)


@pytest.fixture(scope="module")
def cameras():
    return [frame.camera for frame in ball_scene(frames=12, size=24).train]


def test_fixed_goes_through_all_time(cameras):
    shots = make_shots("fixed", 5, 0.5, cameras[0], cameras)
    assert all(camera is cameras[0] for camera, _ in shots)
    assert [time for _, time in shots] == [0, 0.25, 0.5, 0.75, 1]


@pytest.mark.parametrize(("path", "times"), [("orbit", [0.3] * 4), ("both", [0, 1 / 3, 2 / 3, 1])])
def test_a_turn_starts_at_the_view_and_stops_before_it_comes_again(cameras, path, times):
    shots = make_shots(path, 4, 0.3, cameras[0], cameras)
    assert [time for _, time in shots] == pytest.approx(times)
    centers = torch.stack([camera.center for camera, _ in shots])
    torch.testing.assert_close(centers[0], cameras[0].center)
    middle = (centers[0] + centers[2]) / 2
    torch.testing.assert_close(middle, (centers[1] + centers[3]) / 2)
    assert float((centers - middle).norm(dim=-1).min()) > 1


def test_a_swing_stays_between_the_cameras_while_time_passes(cameras):
    shots = make_shots("swing", 5, 0.5, cameras[3], cameras[:7])
    assert [time for _, time in shots] == [0, 0.25, 0.5, 0.75, 1]
    torch.testing.assert_close(shots[0][0].center, cameras[3].center)


def test_the_warp_is_made_once_a_time(cameras):
    module = known_ball()
    pictures = list(video(module, make_shots("orbit", 3, 0.5, cameras[0], cameras), WHITE))
    assert module.method.asked == [0.5]
    assert [tuple(p.shape) for p in pictures] == [(24, 24, 3)] * 3
    assert not torch.equal(pictures[0], pictures[1])
    list(video(module, make_shots("fixed", 3, 0.5, cameras[0], cameras), WHITE))
    assert module.method.asked == [0.5, 0, 0.5, 1]


def test_points_lie_on_the_surface_that_moves(cameras):
    module = known_ball()
    points = moving_points(module, cameras, 60)
    assert points.shape == (60, 3)
    assert not bool(module.method.is_still(points).any())
    from_center = (points - torch.tensor([-0.3, 0.1, 0.0])).norm(dim=-1)
    assert float(from_center.min()) > 0.4 - 2 * module.method.radiance.lattice.voxel_size
    assert float(from_center.max()) < 0.4 + module.method.radiance.lattice.voxel_size
    torch.testing.assert_close(points, moving_points(module, cameras, 60))


def test_tails_follow_the_ball_and_nothing_is_drawn_before_it_moves(cameras):
    module = known_ball()
    camera = camera_at(0.75, size=60)  # looks along y: the ball slides across the picture
    paint = Trajectories(module, cameras, count=80, tail=1.0)
    shots = [(camera, 0.0), (camera, 1.0)]
    plain = list(video(module, shots, WHITE))
    drawn = list(video(module, shots, WHITE, [paint]))
    ink = [(a - b).abs().amax(-1) > 0.05 for a, b in zip(plain, drawn)]
    before, after = camera.project(torch.tensor([[-0.3, 0.1, 0.0], [0.5, 0.1, 0.0]]))[0][:, 0].tolist()
    assert abs(before - after) > 10
    columns = [mask.any(0).nonzero()[:, 0].float() for mask in ink]
    radius = 0.4 / 3 * 1.2 * 60 + 3
    assert float((columns[0] - before).abs().max()) < radius  # heads only
    assert float((columns[1] - before).abs().min()) < 3  # a tail back to where it came from
    assert float((columns[1] - after).abs().min()) < 3
    assert int(ink[1].sum()) > 2 * int(ink[0].sum())


def test_what_stands_behind_the_ball_is_not_drawn(cameras):
    module = known_ball()
    camera = camera_at(0.75, size=60)
    paint = Trajectories(module, cameras, count=80)
    behind = (paint.points - torch.tensor([-0.3, 0.1, 0.0])) @ camera.camera_to_world[:3, 2].float() > 0.2
    assert int(behind.sum()) > 5
    paint.points, paint.colors = paint.points[behind], paint.colors[behind]
    plain, drawn = (next(video(module, [(camera, 0.0)], WHITE, p)) for p in ((), [paint]))
    torch.testing.assert_close(plain, drawn)


def test_a_still_scene_is_left_as_it_is(cameras):
    module = known_ball()
    module.method.trajectories = lambda points, times: points[:, None].expand(-1, len(times), 3)
    paint = Trajectories(module, cameras)
    assert len(paint.points) == 0
    picture = torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(0))
    assert paint(picture, None, cameras[0], 0.5) is picture


FILMED = [camera_at(0.06 * number) for number in range(7)]


@pytest.fixture(scope="module")
def film():
    return FilmPath.of(FILMED, [i / 6 for i in range(7)], 6.0)


def degrees_beside(film, shots):
    """Angles between each shot's camera and the film's at its time, seen from what the latter looks at."""
    angles = []
    for camera, time in shots:
        filmed = film.at(time)
        pivot = film.pivot(filmed)
        towards = (torch.nn.functional.normalize(c.center - pivot, dim=0) for c in (camera, filmed))
        angles.append(math.degrees(math.acos(min(1.0, float(torch.dot(*towards))))))
    return angles


def test_a_film_is_shown_as_it_was_filmed(film):
    shots = make_shots("as_filmed", 7, 0.5, FILMED[0].resized(48, 48), FILMED, film)
    assert [time for _, time in shots] == pytest.approx(film.times)
    for (camera, _), filmed in zip(shots, FILMED):
        torch.testing.assert_close(camera.camera_to_world, filmed.camera_to_world, atol=1e-6, rtol=0)
        assert (camera.width, camera.fx) == (48, 2 * filmed.fx)


@pytest.mark.parametrize("path", ["stabilised", "lean", "fixed", "swing", "trajectories"])
def test_no_path_through_a_film_leaves_the_angle_that_is_trusted(film, path):
    shots = make_shots(path, 25, 0.5, FILMED[0], FILMED, film, seconds=6.0)
    beside = degrees_beside(film, shots)
    assert max(beside) < 6.001
    if path in ("lean", "fixed", "swing"):
        assert max(beside) > 5.5
    for camera, _ in shots:
        assert float(camera.camera_to_world[:3, :3].det()) == pytest.approx(1)


def test_a_stabilised_path_turns_less_suddenly_and_shows_only_what_was_filmed():
    shaken = [camera_at(0.01 * number) for number in range(40)]
    for number, camera in enumerate(shaken):
        camera.camera_to_world[2, 3] += 0.06 * (-1) ** number
    film = FilmPath.of(shaken, [i / 39 for i in range(40)])
    ways = {}
    for path in ("as_filmed", "stabilised"):
        shots = make_shots(path, 40, 0.5, FILMED[0], shaken, film)
        heights = torch.stack([camera.center[2] for camera, _ in shots])
        ways[path] = float(heights.diff().diff().abs().mean())
    assert ways["stabilised"] < 0.5 * ways["as_filmed"]
    assert all(camera.fx > FILMED[0].fx for camera, _ in shots)


def test_paths_of_a_film_are_refused_without_one(cameras):
    assert FilmPath.of(cameras, [i / 11 for i in (0, 5, 2, 9, 1, 11, 3, 7, 4, 8, 6, 10)]) is None
    with pytest.raises(ValueError, match="path: expected fixed, .* no one camera filmed .* got 'lean'"):
        make_shots("lean", 5, 0.5, cameras[0], cameras)


def test_holes_get_the_colours_around_them_and_all_else_stays():
    image, opacity = torch.zeros(20, 30, 3), torch.ones(20, 30)
    image[:, :15, 0], image[:, 15:, 2] = 1.0, 0.5
    opacity[6:12, 3:9] = opacity[6:12, 20:26] = 0
    holed = torch.where(opacity[..., None] > 0, image, WHITE)
    filled = Filled(WHITE)(holed, SimpleNamespace(opacity=opacity.flatten()), None, 0.0)
    assert torch.allclose(filled[opacity > 0], image[opacity > 0], atol=1e-6)
    assert float((filled - image).abs().max()) < 0.2
