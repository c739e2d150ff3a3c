from dataclasses import replace

import pytest
import torch

from forewarp.scene.camera import look_at
from forewarp.scene.view import Moment, View
from forewarp.viewer.desk import Superseded
from forewarp.viewer.look import Look, axis_of, camera_of, first_look, reach, vertical_fov
from forewarp.viewer.studio import Studio, refuse_other_scene
from forewarp.viewer.subject import Subject
from tests.support.known_ball import known_ball
from tests.support.tiny_scene import BOX, ball_center, ball_data, camera_at

SIZE = 60


@pytest.fixture
def data():
    return ball_data(size=24)


@pytest.fixture
def studio(data):
    return Studio(data.scene, [Subject("ball", known_ball(), data)])


@pytest.fixture
def look():
    """Looks along y: the ball slides across the picture."""
    camera = camera_at(0.75)
    return Look(camera.camera_to_world, vertical_fov(camera))


def drawn(studio, look, width=SIZE, height=SIZE, parts=1):
    return studio.picture(look, width, height, bool, parts)


def test_the_first_look_is_the_first_test_image(data):
    frame = data.scene.test[0]
    camera = camera_of(first_look(data.scene), 24, 24, data.scene)
    for name in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(camera, name) == pytest.approx(getattr(frame.camera, name))
    assert camera.center.equal(frame.camera.center)
    assert first_look(data.scene).time == frame.time


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
    found = reach(torch.tensor(center, dtype=torch.float64), BOX, [camera_at(0.0)])
    assert found == pytest.approx((near, far))


@pytest.mark.parametrize("roll", [0.0, 0.06, -1.0, 3.0])
@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0)])
def test_a_page_turns_upright_but_for_the_roll_of_where_it_stands(roll, up):
    pose, up = camera_at(0.3).camera_to_world.clone(), torch.tensor(up, dtype=torch.float64)
    c, s = torch.cos(torch.tensor(roll)), torch.sin(torch.tensor(roll))
    pose[:3, :2] = pose[:3, :2] @ torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    axis = axis_of(pose, up)
    torch.testing.assert_close(look_at(pose[:3, 3], pose[:3, 3] + pose[:3, 2], axis), pose)
    if roll == 0.0 and up[2] == 1:
        torch.testing.assert_close(axis, up)


def test_colour_depth_and_opacity_are_those_of_the_method_whole_or_in_parts(studio, look):
    look = replace(look, time=0.4)
    camera, module = camera_of(look, SIZE, SIZE, studio.scene), studio.subjects[0].module
    exact = module.render(View(camera), Moment(0.4), torch.ones(3))
    color = exact.rgb.reshape(SIZE, SIZE, 3).clamp(0, 1)
    assert float(exact.opacity.std()) > 0.1  # something to be seen
    torch.testing.assert_close(drawn(studio, look), color)
    torch.testing.assert_close(drawn(studio, look, parts=7), color)
    opacity = drawn(studio, replace(look, show="opacity"))
    torch.testing.assert_close(opacity[..., 1].flatten(), exact.opacity.clamp(0, 1))
    depth = drawn(studio, replace(look, show="depth"))
    assert depth[exact.opacity.reshape(SIZE, SIZE) < 1e-3].min() > 0.99  # white where nothing is
    assert float((depth - opacity).abs().max()) > 0.2


def test_motion_is_told_of_what_moves_alone(studio, look):
    picture = drawn(studio, replace(look, show="motion", time=1.0))
    saturation = picture.amax(-1) - picture.amin(-1)
    camera = camera_of(look, SIZE, SIZE, studio.scene)
    ball, block = (
        camera.project(torch.tensor([p]))[0][0].long() for p in ([-0.3, 0.1, 0.0], [-0.3, -0.6, -0.5])
    )
    assert float(saturation[ball[1], ball[0]]) > 0.3
    assert float(saturation[block[1], block[0]]) < 0.05


def test_a_time_is_warped_to_once_and_what_has_changed_is_forgotten(studio, look):
    asked, subject = studio.subjects[0].module.method.asked, studio.subjects[0]
    for show in ("colour", "depth", "opacity"):
        drawn(studio, replace(look, time=0.3, show=show), parts=3)
    assert asked == [0.3]
    drawn(studio, replace(look, time=0.6))
    drawn(studio, replace(look, time=0.3))
    assert asked == [0.3, 0.6]
    subject.forget()
    drawn(studio, replace(look, time=0.3))
    assert asked == [0.3, 0.6, 0.3]


def test_a_picture_that_is_no_longer_wanted_ends_between_two_parts(studio, look):
    answers = iter([False, False, True])
    with pytest.raises(Superseded):
        studio.picture(look, SIZE, SIZE, lambda: next(answers), 10)
    assert next(answers, None) is None


def test_a_clicked_point_is_followed_through_time(studio, look):
    camera, end = camera_of(look, SIZE, SIZE, studio.scene), replace(look, time=1.0)
    pixel = camera.project(ball_center(1.0)[None])[0][0] / SIZE
    point = studio.point_at(end, *pixel.tolist(), SIZE, SIZE)
    away = (torch.tensor(point) - ball_center(1.0)).norm()
    assert float(away) == pytest.approx(0.4, abs=0.08)  # on the ball's surface
    canonical = studio.subjects[0].canonical(point, 1.0)
    assert float((canonical - (torch.tensor(point) - torch.tensor([0.8, 0, 0]))).norm()) < 0.1
    ink = drawn(studio, replace(end, followed=((point, 1.0),))) - drawn(studio, end)
    columns = (ink.abs().amax(-1) > 0.05).any(0).nonzero()[:, 0].float()
    begin = camera.project(ball_center(0.0)[None])[0][0, 0]
    assert float((columns - begin).abs().min()) < 4  # a tail from where it was at first
    assert float((columns - SIZE * pixel[0]).abs().min()) < 4
    assert studio.point_at(look, 0.01, 0.01, SIZE, SIZE) is None
    assert studio.point_at(look, 1.0, 1.0, SIZE, SIZE) is None  # the last pixel


def test_trajectories_are_drawn_over_the_picture_and_chosen_once(studio, look):
    plain, tails = (drawn(studio, replace(look, time=1.0, tails=on)) for on in (False, True))
    assert int(((plain - tails).abs().amax(-1) > 0.05).sum()) > 50
    before = len(studio.subjects[0].module.method.asked)
    again = drawn(studio, replace(look, time=1.0, tails=True))
    assert len(studio.subjects[0].module.method.asked) == before
    torch.testing.assert_close(tails, again)


def test_a_training_view_shows_truth_prediction_and_error(studio, look):
    picture = drawn(studio, replace(look, stand=3), width=3 * 24 + 8, height=40)
    assert picture.shape == (40, 80, 3)
    assert (picture[:8] == 1).all()  # in the middle, on white
    assert (picture[32:] == 1).all()
    truth, made = picture[8:32, :24], picture[8:32, 28:52]
    torch.testing.assert_close(truth, studio.subjects[0].targets[3].rgb)
    frame = studio.scene.train[3]
    exact = studio.subjects[0].module.render(frame.camera, Moment(frame.time), torch.ones(3))
    torch.testing.assert_close(made.reshape(-1, 3), exact.rgb.clamp(0, 1))
    assert float(picture[8:32, 56:].mean()) < 0.5  # error, black where there is none


def test_two_runs_have_one_camera_each_their_half_and_rows_of_their_own(data, look):
    subjects = [Subject(name, known_ball(), data) for name in ("a", "b")]
    subjects[1].module.method.radiance.color.data += 3.0
    fill = subjects[1].module.method.fill
    subjects[1].module.method.fill = lambda time: fill(0.0)  # the other stands still
    studio = Studio(data.scene, subjects)
    assert studio.shows == ("colour", "depth", "opacity", "motion")
    picture = drawn(studio, replace(look, time=1.0), width=2 * SIZE + 4)
    alone = [drawn(Studio(data.scene, [one]), replace(look, time=1.0)) for one in subjects]
    torch.testing.assert_close(picture[:, :SIZE], alone[0])
    torch.testing.assert_close(picture[:, SIZE + 4 :], alone[1])
    assert (picture[:, SIZE : SIZE + 4] == 1).all()
    assert float((alone[0] - alone[1]).abs().max()) > 0.1
    both = drawn(studio, replace(look, stand=2), width=80, height=52)
    torch.testing.assert_close(both[:24, :24], both[28:, :24])  # one truth
    camera = camera_of(look, SIZE, SIZE, data.scene)
    start = camera.project(ball_center(0.0)[None])[0][0]
    x = (SIZE + 4 + float(start[0])) / (2 * SIZE + 4)
    y = float(start[1]) / SIZE
    still = studio.point_at(replace(look, time=1.0), x, y, 2 * SIZE + 4, SIZE)
    assert float((torch.tensor(still) - ball_center(0.0)).norm()) == pytest.approx(0.4, abs=0.08)


@pytest.mark.parametrize(
    ("other", "says"),
    [
        (lambda scene: replace(scene, train=scene.train[:5]), None),
        (
            lambda scene: replace(scene, name="cube"),
            "expected a run of ball, as run= is, but got one of cube",
        ),
        (lambda scene: replace(scene, test=scene.test[:2]), "got one with other test views"),
        (lambda scene: replace(scene, test=scene.test[::-1]), "got one with other test views"),
    ],
)
def test_two_runs_of_different_scenes_are_refused(data, other, says):
    if says is None:
        refuse_other_scene(data.scene, other(data.scene))
        return
    with pytest.raises(ValueError, match=says):
        refuse_other_scene(data.scene, other(data.scene))


@pytest.mark.parametrize(("size", "rows"), [(None, 400), (64, 64)])
def test_the_size_at_rest_is_that_of_the_images_but_not_too_small(data, size, rows):
    assert Studio(data.scene, size=size).size == rows


def test_paths_of_points_that_nobody_follows_any_more_are_forgotten(studio, look):
    subject = studio.subjects[0]
    kept = []
    for count in range(1, 9):
        points = tuple(((-0.3, 0.1, 0.01 * i), 0.0) for i in range(count))
        drawn(studio, replace(look, followed=points))
        kept.append(len(subject._followed))
    assert kept == [1, 2, 3, 4, 4, 4, 4, 4]
    made = [*subject._followed.values()][-1]
    drawn(studio, replace(look, time=0.5, followed=points))
    assert [*subject._followed.values()][-1] is made
