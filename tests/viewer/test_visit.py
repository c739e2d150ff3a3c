import pytest

from forewarp.viewer import visit as visit_module
from forewarp.viewer.pace import GOAL
from forewarp.viewer.player import WHOLE
from forewarp.viewer.visit import FASTEST, REST, Visit
from tests.support.fake_studio import FakePage, FakeStudio, Watch


@pytest.fixture
def watch():
    return Watch()


@pytest.fixture
def studio(watch):
    return FakeStudio(watch, cost=2e-6)  # whole pictures take 0.43 s


def visit_of(studio):
    page = FakePage()
    visit = Visit(studio, page, clock=studio.watch)
    visit.change(time=0.0)
    return visit, page


def serve(studio, jobs=100):
    done = 0
    while done < jobs and studio.desk.serve():
        done += 1
    return done


@pytest.fixture(autouse=True)
def as_fast_as_it_can(monkeypatch):
    monkeypatch.setattr(visit_module, "FASTEST", 0.0)


def test_thirty_pictures_a_second_are_enough(watch, monkeypatch):
    monkeypatch.setattr(visit_module, "FASTEST", FASTEST)
    studio = FakeStudio(watch, cost=1e-9)
    visit, page = visit_of(studio)
    visit.play(True)
    begun = watch.now
    while watch.now < begun + 1:
        studio.desk.serve()
        watch.now += 0.001
    assert 27 <= len(page.pictures) <= 31


def test_small_while_moving_and_whole_at_rest(studio, watch):
    visit, page = visit_of(studio)
    for time in (0.1, 0.2, 0.3):
        visit.change(time=time)
        serve(studio)
    assert [(rest, time) for _, rest, time in page.pictures] == [(False, 0.1), (False, 0.2), (False, 0.3)]
    assert all(shape[0] < 400 for shape, _, _ in page.pictures)
    assert abs(page.pictures[0][0][1] / page.pictures[0][0][0] - 4 / 3) < 0.01
    watch.now += REST
    serve(studio)
    assert page.pictures[3:] == [((400, 533), True, 0.3)]
    assert serve(studio) == 0
    assert "533 x 400, exact" in page.said[-1]
    assert page.said[0].endswith("small while moving")


def test_ten_pictures_a_second_while_moving(studio, watch):
    visit, page = visit_of(studio)
    for step in range(30):
        visit.change(time=step / 30)
        begun = watch.now
        serve(studio)
    assert 0.6 * GOAL < watch.now - begun < 1.2 * GOAL


def test_quick_pictures_are_whole_at_once(watch):
    studio = FakeStudio(watch, cost=1e-9)
    visit, page = visit_of(studio)
    for step in range(5):
        visit.change(time=step / 5)
        serve(studio)
    assert page.pictures[-1] == ((400, 533), True, 0.8)
    watch.now += REST
    assert serve(studio) == 0


def test_what_came_in_between_is_dropped(studio, watch):
    visit, page = visit_of(studio)
    for step in range(10):
        visit.change(time=step / 10)
    serve(studio)
    assert [time for _, _, time in page.pictures] == [0.9]
    watch.now += REST
    studio.interrupt = lambda: visit.change(time=0.5)  # while the whole picture is drawn
    serve(studio, 1)
    studio.interrupt = None
    assert len(page.pictures) == 1
    serve(studio)
    assert page.pictures[-1][1:] == (False, 0.5)


def test_two_pages_keep_their_own(studio, watch):
    (one, page), (two, other) = visit_of(studio), visit_of(studio)
    one.change(time=0.25)
    two.change(time=0.75, show="depth")
    serve(studio)
    assert (page.pictures[-1][2], other.pictures[-1][2]) == (0.25, 0.75)
    assert (one.look.show, two.look.show) == ("colour", "depth")
    one.play(True)
    watch.now += 0.1 * WHOLE
    serve(studio, 20)
    assert other.times == []
    assert page.times[0] == pytest.approx(0.35, abs=0.01)


@pytest.mark.parametrize("loop", [True, False])
def test_it_plays_and_follows_the_time(studio, watch, loop):
    visit, page = visit_of(studio)
    visit.player.loop = loop
    visit.change(time=0.9)
    visit.play(True)
    serve(studio, 200)
    assert all(
        abs(time - drawn) < 0.002
        for time, (_, _, drawn) in zip(page.times, page.pictures[-len(page.times) :])
    )
    if loop:
        assert visit.player.playing
        assert min(page.times) < 0.1
        visit.play(False)
        serve(studio, 3)
        assert not visit.player.playing
    assert page.plays == ([] if loop else [False])
    assert loop or page.times[-1] == 1.0
    before = visit.look.time
    watch.now += 10 * REST
    serve(studio)
    assert visit.look.time == before
    assert page.pictures[-1][1] is True


def test_it_plays_also_if_begun_just_before_the_picture_at_rest_is_asked_for(studio, watch):
    visit, page = visit_of(studio)
    ask = studio.desk.ask

    def late(who, job, **when):
        if job == visit._draw_at_rest and not visit.player.playing:
            visit.play(True)
        ask(who, job, **when)

    studio.desk.ask = late
    serve(studio, 1)
    watch.now += REST
    serve(studio, 3)
    assert len(page.times) > 1


def test_a_page_that_leaves_just_before_it_gets_no_picture_at_rest(studio, watch):
    visit, page = visit_of(studio)
    serve(studio, 1)
    seen = len(page.pictures)
    visit.gone = True  # and what it asks for at the same moment comes after all else was dropped
    watch.now += REST
    assert serve(studio) == 1
    assert len(page.pictures) == seen


def test_the_slider_while_it_plays_moves_the_time(studio, watch):
    visit, page = visit_of(studio)
    visit.play(True)
    serve(studio, 3)
    visit.change(time=0.8)
    serve(studio, 1)
    assert page.times[-1] == pytest.approx(0.8, abs=0.02)


def test_a_page_that_leaves_in_the_middle_is_asked_nothing_more(studio, watch):
    visit, page = visit_of(studio)
    visit.play(True)
    studio.interrupt = visit.leave
    serve(studio, 50)
    assert page.pictures == []
    assert serve(studio) == 0
    visit.refresh()  # a last event of a page that is gone
    serve(studio)
    assert page.pictures == []


def test_a_training_view_is_left_by_a_new_camera_time_or_choice(studio, watch):
    visit, page = visit_of(studio)
    frame = studio.scene.train[2]
    for change in ({"time": 0.1}, {"pose": visit.look.pose}, {"show": "depth"}):
        visit.stand(2)
        assert visit.look.stand == 2
        assert visit.look.time == frame.time
        assert visit.look.pose is frame.camera.camera_to_world
        serve(studio)
        assert f"training image {frame.name}: truth, prediction, error" in page.said[-1]
        visit.change(**change)
        assert visit.look.stand is None
    visit.stand(1)
    visit.change(tails=True)
    assert visit.look.stand == 1
    visit.play(True)
    assert visit.look.stand is None
    visit.stand(1)
    assert not visit.player.playing
    visit.stand(None)
    assert visit.look.stand is None


def test_a_training_view_or_a_time_that_is_none_becomes_the_nearest(studio):
    visit, _ = visit_of(studio)
    for asked, found in ((-1, 0), (3, 3), (4, 3), (10**9, 3)):
        assert (visit.stand(asked), visit.look.stand) == (found, found)
    assert (visit.stand(None), visit.look.stand) == (None, None)
    for asked, found in ((-0.5, 0.0), (7.0, 1.0), (float("nan"), 0.0)):
        visit.change(time=asked)
        assert visit.look.time == found


def test_a_clicked_point_is_added_to_those_followed(studio):
    visit, page = visit_of(studio)
    visit.change(time=0.25)
    for x in (0.5, 0.95, 0.25):
        visit.follow(x, 0.5)
        serve(studio)
    assert visit.look.followed == (((0.5, 0.5, 0.0), 0.25), ((0.25, 0.5, 0.0), 0.25))
    assert "nothing solid there to follow; press the button again" in page.said


def test_a_browser_draws_splats_by_itself(studio, watch):
    visit, page = visit_of(studio)
    visit.change(show="splats", time=0.5)
    serve(studio)
    watch.now += 10
    serve(studio)
    assert page.pictures == ["splats at 0.5"]
    assert "one colour from all sides" in page.said[-1]


def test_a_training_view_becomes_whole_at_rest_also_where_splats_are_chosen(studio, watch):
    visit, page = visit_of(studio)
    visit.change(show="splats")
    visit.stand(2)
    serve(studio)
    watch.now += REST
    serve(studio)
    assert page.pictures[-1][:2] == ((400, 533), True)


def test_without_a_method_it_says_why(studio):
    studio.subjects, studio.note = [], "waiting for the first step"
    visit, page = visit_of(studio)
    serve(studio)
    assert page.said == ["waiting for the first step"]
    assert page.pictures == []
