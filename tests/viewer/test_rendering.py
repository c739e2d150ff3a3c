from dataclasses import replace

import pytest
import torch

from forewarp.scene.camera import look_at
from forewarp.scene.film import FilmPath
from forewarp.scene.view import Moment, View
from forewarp.viewer import rendering
from forewarp.viewer.queue import Cancelled
from forewarp.viewer.rendering import (
    SceneRenderer,
    Viewer,
    ViewState,
    camera_of,
    turning_axis,
    vertical_fov,
)
from tests.support.particles import EVERY, module_with, shaken, small_data
from tests.support.tiny_scene import BOX, ball_center, ball_data, ball_scene, camera_at, known_ball

SIZE = 60


@pytest.fixture
def data():
    return ball_data(size=24)


@pytest.fixture
def viewer(data):
    return Viewer(data.scene, [SceneRenderer("ball", known_ball(), data)])


@pytest.fixture
def state():
    """Looks along y: the ball slides across the image."""
    camera = camera_at(0.75)
    return ViewState(camera.camera_to_world, vertical_fov(camera))


def image_of(viewer, state, width=SIZE, height=SIZE, chunks=1):
    return viewer.image(state, width, height, chunks)


def test_the_first_state_is_the_first_test_image_at_a_size_that_is_not_too_small(data):
    frame, first = data.scene.test[0], ViewState.first(data.scene)
    camera = camera_of(first, 24, 24, data.scene)
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(camera, name) == pytest.approx(getattr(frame.camera, name))
    assert camera.center.equal(frame.camera.center)
    assert first.time == frame.time
    assert [Viewer(data.scene, rows=rows).rows for rows in (None, 64)] == [400, 64]


@pytest.mark.parametrize(
    ("center", "near", "far"),
    [
        ((0, 0, 0), 0.01 * BOX.diagonal, 5.5),  # within the box
        ((3, 0, 0), 1.0, 5.5),  # where training cameras are: theirs
        ((1.5, 0, 0), 0.3, 5.5),
        ((-20, 0, 0), 1.0, ((21.2) ** 2 + 0.8**2 + 0.7**2) ** 0.5),
    ],
)
def test_a_camera_anywhere_sees_the_whole_box(center, near, far):
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor(center)
    camera = camera_of(ViewState(pose, fov=1.0), SIZE, SIZE, ball_scene(frames=2))
    assert (camera.near, camera.far) == pytest.approx((near, far))


@pytest.mark.parametrize("roll", [0.0, 0.06, -1.0, 3.0])
@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0)])
def test_a_page_turns_upright_but_for_the_roll_of_where_it_stands(roll, up):
    pose, up = camera_at(0.3).camera_to_world.clone(), torch.tensor(up, dtype=torch.float64)
    c, s = torch.cos(torch.tensor(roll)), torch.sin(torch.tensor(roll))
    pose[:3, :2] = pose[:3, :2] @ torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    axis = turning_axis(pose, up)
    torch.testing.assert_close(look_at(pose[:3, 3], pose[:3, 3] + pose[:3, 2], axis), pose)
    if roll == 0.0 and up[2] == 1:
        torch.testing.assert_close(axis, up)


def test_colour_depth_and_opacity_are_those_of_the_method_whole_or_in_chunks(viewer, state):
    state = replace(state, time=0.4)
    camera, module = camera_of(state, SIZE, SIZE, viewer.scene), viewer.renderers[0].module
    exact = module.render(View(camera), Moment(0.4), torch.ones(3))
    color = exact.rgb.reshape(SIZE, SIZE, 3).clamp(0, 1)
    assert float(exact.opacity.std()) > 0.1  # something to be seen
    torch.testing.assert_close(image_of(viewer, state), color)
    torch.testing.assert_close(image_of(viewer, state, chunks=7), color)
    opacity = image_of(viewer, replace(state, channel="opacity"))
    torch.testing.assert_close(opacity[..., 1].flatten(), exact.opacity.clamp(0, 1))
    depth = image_of(viewer, replace(state, channel="depth"))
    empty = exact.opacity.reshape(SIZE, SIZE)[: -SIZE // 4] < 1e-3  # above the scale
    assert depth[: -SIZE // 4][empty].min() > 0.99  # white where nothing is
    assert float((depth - opacity).abs().max()) > 0.2


def test_motion_is_told_of_what_moves_alone(viewer, state):
    state = replace(state, channel="motion", time=1.0)
    viewer.prepare(state)
    image = image_of(viewer, state)
    saturation = image.amax(-1) - image.amin(-1)
    camera = camera_of(state, SIZE, SIZE, viewer.scene)
    places = torch.tensor([[-0.3, 0.1, 0.0], [-0.3, -0.6, -0.5]])
    ball, block = camera.project(places)[0].long()
    assert float(saturation[ball[1], ball[0]]) > 0.3
    assert float(saturation[block[1], block[0]]) < 0.05


def test_a_time_is_warped_to_once_and_what_has_changed_is_forgotten(viewer, state):
    asked, renderer = viewer.renderers[0].module.method.asked, viewer.renderers[0]
    for channel in ("colour", "depth", "opacity"):
        image_of(viewer, replace(state, time=0.3, channel=channel), chunks=3)
    assert asked == [0.3]
    for time in (0.6, 0.3):
        image_of(viewer, replace(state, time=time))
    assert asked == [0.3, 0.6]
    renderer.invalidate()
    image_of(viewer, replace(state, time=0.3))
    assert asked == [0.3, 0.6, 0.3]


@pytest.mark.slow
def test_a_layer_shows_its_particles_alone_and_voxels_have_none(viewer, state):
    data = small_data()
    module = shaken(module_with(data, **EVERY))
    rows = torch.arange(len(module.method.gaussians.means)) % 2 == 0
    module.method.__class__ = type("Told", (type(module.method),), {"in_motion": lambda self, frames: rows})
    seen, first = Viewer(data.scene, [SceneRenderer("particles", module, data)]), ViewState.first(data.scene)
    assert (seen.layers, viewer.layers) == (("all", "moving", "resting"), ("all",))
    assert viewer.supported(replace(state, layer="moving")).layer == "all"
    camera, images = camera_of(first, 24, 24, data.scene), []
    for layer, part in (("moving", rows), ("resting", ~rows)):
        shown = seen.supported(replace(first, layer=layer, channel="opacity"))
        images.append(image_of(seen, shown, 24, 24))
        with torch.no_grad():
            alone = module.method.only(part).at(Moment(first.time)).render(View(camera), torch.ones(3))
        torch.testing.assert_close(images[-1][..., 0].flatten(), alone.opacity.clamp(0, 1))
    assert float((images[0] - images[1]).abs().max()) > 0.1
    seen.renderers[0].invalidate()  # as the method has changed
    rows.fill_(False)
    assert float(image_of(seen, replace(first, layer="moving", channel="opacity"), 24, 24).max()) == 0


def test_layers_are_made_once_also_of_frames_that_cannot_be_hashed(monkeypatch):
    data, made = small_data(), []
    data.scene = replace(data.scene, train=[*data.scene.train])
    monkeypatch.setattr(rendering, "layer_of", lambda *given, may_be_empty: made.append(given) or given[1])
    renderer = SceneRenderer("particles", module_with(data), data)
    for _ in range(2):
        assert [renderer.method_of(layer) for layer in ("moving", "resting")] == ["moving", "resting"]
    assert len(made) == 2
    renderer.invalidate()
    renderer.method_of("moving")
    assert len(made) == 3


def test_a_stale_image_ends_between_two_chunks(viewer, state):
    answers = iter([False, False, True])
    camera = camera_of(state, SIZE, SIZE, viewer.scene)
    with pytest.raises(Cancelled):
        viewer.renderers[0].image(state, camera, 10, lambda: next(answers))
    assert next(answers, None) is None


def test_a_clicked_point_is_followed_through_time(viewer, state):
    camera, end = camera_of(state, SIZE, SIZE, viewer.scene), replace(state, time=1.0)
    pixel = camera.project(ball_center(1.0)[None])[0][0] / SIZE
    point = viewer.point_at(end, *pixel.tolist(), SIZE, SIZE)
    away = (torch.tensor(point) - ball_center(1.0)).norm()
    assert float(away) == pytest.approx(0.4, abs=0.08)  # on the ball's surface
    canonical = viewer.renderers[0].canonical_point(point, 1.0)
    assert float((canonical - (torch.tensor(point) - torch.tensor([0.8, 0, 0]))).norm()) < 0.1
    ink = image_of(viewer, replace(end, followed=((point, 1.0),))) - image_of(viewer, end)
    columns = (ink.abs().amax(-1) > 0.05).any(0).nonzero()[:, 0].float()
    begin = camera.project(ball_center(0.0)[None])[0][0, 0]
    assert float((columns - begin).abs().min()) < 4  # a tail from where it was at first
    assert float((columns - SIZE * pixel[0]).abs().min()) < 4
    for corner in (0.01, 1.0):  # 1.0: the last pixel
        assert viewer.point_at(state, corner, corner, SIZE, SIZE) is None


def test_trajectories_are_drawn_over_the_image_and_chosen_once(viewer, state):
    plain, tails = (image_of(viewer, replace(state, time=1.0, trajectories=on)) for on in (False, True))
    assert int(((plain - tails).abs().amax(-1) > 0.05).sum()) > 50
    before = len(viewer.renderers[0].module.method.asked)
    again = image_of(viewer, replace(state, time=1.0, trajectories=True))
    assert len(viewer.renderers[0].module.method.asked) == before
    torch.testing.assert_close(tails, again)


def test_paths_of_points_that_nobody_follows_any_more_are_forgotten(viewer, state):
    kept = viewer.renderers[0]._followed.cache_info
    for count in range(1, 7):
        points = tuple(((-0.3, 0.1, 0.01 * i), 0.0) for i in range(count))
        image_of(viewer, replace(state, followed=points), 8, 8)
        assert kept().currsize == min(count, 4)
    image_of(viewer, replace(state, time=0.5, followed=points), 8, 8)
    assert kept().hits == 1


def test_a_training_view_shows_truth_prediction_and_error(viewer, state):
    state = replace(state, training_view=3)
    viewer.prepare(state)
    image = image_of(viewer, state, width=3 * 24 + 8, height=40)
    assert image.shape == (40, 80, 3)
    assert (image[:8] == 1).all()  # in the middle, on white
    assert (image[32:] == 1).all()
    truth, prediction = image[8:32, :24], image[8:32, 28:52]
    torch.testing.assert_close(truth, viewer.renderers[0].targets[3].rgb)
    frame = viewer.scene.train[3]
    exact = viewer.renderers[0].module.render(frame.camera, Moment(frame.time), torch.ones(3))
    torch.testing.assert_close(prediction.reshape(-1, 3), exact.rgb.clamp(0, 1))
    assert float(image[8:32, 56:].mean()) < 0.5  # error, black where there is none


def test_two_runs_have_one_camera_each_their_half_and_rows_of_their_own(data, state):
    first, second = (SceneRenderer(name, known_ball(), data) for name in ("a", "b"))
    second.module.method.radiance.color.data += 3.0
    fill = second.module.method.fill
    second.module.method.fill = lambda time: fill(0.0)  # the other stands still
    viewer, end = Viewer(data.scene, [first, second]), replace(state, time=1.0)
    assert viewer.channels == ("colour", "depth", "opacity", "motion")
    image = image_of(viewer, end, width=2 * SIZE + 4)
    alone = [image_of(Viewer(data.scene, [renderer]), end) for renderer in (first, second)]
    torch.testing.assert_close(image[:, :SIZE], alone[0])
    torch.testing.assert_close(image[:, SIZE + 4 :], alone[1])
    assert (image[:, SIZE : SIZE + 4] == 1).all()
    assert float((alone[0] - alone[1]).abs().max()) > 0.1
    both = image_of(viewer, replace(state, training_view=2), width=80, height=52)
    torch.testing.assert_close(both[:24, :24], both[28:, :24])  # one truth
    start = camera_of(state, SIZE, SIZE, data.scene).project(ball_center(0.0)[None])[0][0]
    x, y = (SIZE + 4 + float(start[0])) / (2 * SIZE + 4), float(start[1]) / SIZE
    still = viewer.point_at(end, x, y, 2 * SIZE + 4, SIZE)
    assert float((torch.tensor(still) - ball_center(0.0)).norm()) == pytest.approx(0.4, abs=0.08)
    wide, narrow = (viewer._camera(state, width, SIZE) for width in (2 * SIZE + 4, SIZE))
    assert narrow.fx == pytest.approx(wide.fx * narrow.width / SIZE)  # sees what a square would


def test_a_film_keeps_its_frame_and_an_edge_shows_where_it_is_left(data):
    viewer = Viewer(data.scene, [SceneRenderer("ball", known_ball(), data)])
    cameras = [camera_at(0.02 * i).resized(24, 12) for i in range(9)]
    viewer.film = FilmPath.of(cameras, [i / 8 for i in range(9)])
    first = viewer.film.at(0.5)
    riding = ViewState(first.camera_to_world, 0.5, time=0.5, lean=(0.0, 0.0))
    image = image_of(viewer, riding)
    own = viewer.renderers[0].image(riding, first.resized(SIZE, SIZE // 2))
    assert torch.equal(image[SIZE // 4 : 3 * SIZE // 4], own)
    assert float(image[: SIZE // 4].max()) < 0.1  # letterbox
    assert viewer.beyond(riding) == 0
    free = replace(riding, lean=None)
    assert viewer.beyond(free) == 0
    aside = replace(free, pose=camera_at(0.3).camera_to_world)
    assert viewer.beyond(aside) > 60
    assert image_of(viewer, aside)[0, 0].tolist() == pytest.approx([1.0, 0.72, 0.42])
