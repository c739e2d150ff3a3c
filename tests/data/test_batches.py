"""Ray batches: right colours for the right rays, repeatable, over any background."""

from dataclasses import replace
from itertools import islice

import pytest
import torch

from forewarp.data.batches import Sampler, Targets, color_of
from forewarp.data.dnerf import read_scene
from forewarp.data.files import SceneError
from forewarp.data.images import MaskedImage, composited
from forewarp.data.module import DNeRFDataModule
from forewarp.scene.camera import joined
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Asks, Moment
from tests.support.dnerf_scene import real, shots, write_tiny


@pytest.fixture
def scene(tmp_path) -> Scene:
    write_tiny(tmp_path / "toy")
    return read_scene(tmp_path, "toy")


def rays_of(batch):
    """Those of all its pixels, after one another."""
    return joined([one.view.rays() for one in batch.observations])


def rgb_of(batch):
    return torch.cat([one.rgb for one in batch.observations])


def behind(batch):
    """The background of every pixel."""
    return torch.cat([one.background.expand(len(one.view), 3) for one in batch.observations])


def colours(batches, count=3):
    return torch.stack([rgb_of(b) for b in islice(batches, count)])


@pytest.mark.parametrize("background", ["white", "black", "random"])
def test_every_ray_carries_the_colour_of_its_pixel(scene, background):
    batch = Sampler(scene, rays=50, background=background).draw()
    frame = scene.train[batch.frame]
    rays = rays_of(batch)
    ahead = rays.origins + rays.directions
    pixel = frame.camera.project(ahead.double())[0].long()
    rgba = frame.load()[pixel[:, 1], pixel[:, 0]]
    torch.testing.assert_close(rgb_of(batch), composited(rgba, behind(batch)))
    if background != "random":
        assert torch.equal(behind(batch), torch.full((50, 3), float(background == "white")))
    assert batch.time == frame.time
    assert rays.directions.norm(dim=-1).allclose(torch.ones(50))
    assert len(rays) == len(batch) == 50


def test_a_random_background_is_another_for_every_pixel(scene):
    random = Sampler(scene, rays=500, background="random")
    first, second = behind(random.draw()), behind(random.draw())
    assert first.shape == (500, 3)
    assert len(first.unique(dim=0)) == 500
    assert not torch.equal(first, second)


def test_all_pixels_and_frames_are_drawn(scene):
    before = torch.get_rng_state()
    batches = list(islice(Sampler(scene, rays=400, background="random"), 60))
    assert {b.frame for b in batches} == {0, 1, 2, 3}
    assert len(rays_of(batches[0]).directions.unique(dim=0)) == 48
    assert torch.equal(torch.get_rng_state(), before)  # the global generator plays no part


def test_the_picker_chooses_the_frame(scene):
    batches = Sampler(scene, rays=9)
    order = iter([2, 0, 3])
    batches.picker = lambda: next(order)
    assert [b.frame for b in islice(batches, 3)] == [2, 0, 3]
    batches.picker = lambda: 4
    with pytest.raises(ValueError, match=r"picker: expected a training frame in \[0, 4\), but got 4"):
        batches.draw()


BAD = [
    ({"background": "blue"}, "data.background: expected white, black or random, but got 'blue'"),
    ({"rays": 0}, "data.rays: expected at least 1, but got 0"),
    ({"views_per_step": 0}, "data.views_per_step: expected at least 1, but got 0"),
]


@pytest.mark.parametrize(("options", "match"), BAD)
def test_bad_settings(scene, options, match):
    with pytest.raises(SceneError, match=match):
        Sampler(scene, **options)
    with pytest.raises(SceneError, match="data.rays: expected a number, as the method is trained on single"):
        Sampler(scene, rays=None).draw()
    assert len(Sampler(scene, rays=None, views_per_step=8, asks=Asks("pictures")).draw().observations) == 1
    with pytest.raises(SceneError, match="data.eval_background: expected white or black, but got 'random'"):
        color_of("random")
    with pytest.raises(ValueError, match="asks: expected a kind of pixels, crops, pictures, side >= 1,"):
        Asks(side=0)


def test_targets_are_loaded_when_asked_for(scene):
    loads = []

    def load():
        loads.append(1)
        return torch.tensor([[[255, 0, 0, 255], [255, 0, 0, 0], [255, 0, 0, 127]]], dtype=torch.uint8)

    camera = scene.train[0].camera.resized(3, 1)
    frame = Frame("a", 0.0, camera, load, lambda: torch.tensor([[1.0, 0.0, 2.0]]))
    targets = Targets([frame], color_of("black"), has_alpha=True)
    assert (len(targets), loads) == (1, [])
    target = targets[0]
    torch.testing.assert_close(target.rgb[0, :, 0], torch.tensor([1, 0, 127 / 255]))
    assert target.foreground.tolist() == [[True, False, False]]
    assert target.depth.tolist() == [[1, 0, 2]]
    by_depth = Targets([frame], color_of("black"), has_alpha=False)[0].foreground
    assert by_depth.tolist() == [[True, False, True]]
    assert ([t.frame.name for t in targets], target.moment.frame) == (["a"], None)
    assert [t.moment.frame for t in Targets(scene.train, torch.ones(3), True, trained=True)] == [0, 1, 2, 3]


def of_times(scene: Scene, *times: float) -> Scene:
    """The scene with these times and its cameras' ranges made different."""
    frames = [
        replace(frame, time=t, camera=replace(frame.camera, near=2 + 0.1 * i, far=6 + i))
        for i, (frame, t) in enumerate(zip(scene.train, times, strict=True))
    ]
    return replace(scene, train=tuple(frames))


def frames_of(batch, scene):
    """Which training frame each ray starts in."""
    centers = torch.stack([f.camera.center.float() for f in scene.train])
    return (rays_of(batch).origins[:, None] - centers).norm(dim=-1).argmin(-1)


def test_a_batch_may_have_rays_of_several_frames_of_one_time(scene):
    scene = of_times(scene, 0.5, 0.0, 0.5, 0.5)
    batches = Sampler(scene, rays=50, background="random", views_per_step=2, picker=lambda: 2)
    seen = set()
    for batch in islice(batches, 20):
        frames = frames_of(batch, scene)
        one, other = frames.unique().tolist()
        assert 2 in (one, other)
        assert torch.bincount(frames).max() == 25
        seen |= {one, other}
        used = [scene.train[i].camera for i in (one, other)]
        rays = rays_of(batch)
        assert (batch.time, batch.frame, len(rays)) == (0.5, 2, 50)
        assert rays.near == min(c.near for c in used)
        assert rays.far == max(c.far for c in used)
        for i, rgb, direction, background in zip(frames, rgb_of(batch), rays.directions, behind(batch)):
            frame = scene.train[i]
            pixel = frame.camera.project(frame.camera.center + direction.double())[0].long()
            torch.testing.assert_close(rgb, composited(frame.load()[pixel[1], pixel[0]], background))
    assert seen == {0, 2, 3}
    for rays, count in ((50, 3), (2, 2)):  # more views than there are, or than rays
        batch = Sampler(scene, rays=rays, views_per_step=8, picker=lambda: 2).draw()
        assert len(frames_of(batch, scene).unique()) == count


def shown(scene, one):
    """What an observation should show, of its frame's own image."""
    pixels = scene.train[one.moment.frame].load()
    rows = one.view.indices
    whole = pixels.reshape(-1, 4)
    return composited(whole if rows is None else whole[rows], one.background)


@pytest.mark.parametrize("background", ["white", "random"])
def test_crops_are_square_parts_of_a_picture_over_one_colour(scene, background):
    sampler = Sampler(scene, background=background, asks=Asks("crops", side=3))
    corners = set()
    for batch in islice(sampler, 400):
        (one,) = batch.observations
        top, left, height, width = one.view.crop
        assert (height, width) == one.view.shape == (3, 3)
        assert one.background.shape == (3,)
        image = scene.train[batch.frame].load()[top : top + 3, left : left + 3].reshape(-1, 4)
        torch.testing.assert_close(one.rgb, composited(image, one.background))
        assert one.moment == Moment(scene.train[batch.frame].time, batch.frame, one.moment.camera)
        corners.add((top, left))
    assert corners == {(top, left) for top in range(4) for left in range(6)}  # of 6 x 8 pixels
    (whole,) = Sampler(scene, asks=Asks("crops", side=7)).draw().observations
    assert whole.view.shape == (6, 7)  # never larger than the picture


@pytest.mark.parametrize("kind", ["pixels", "crops", "pictures"])
def test_neighbouring_times_come_after_the_picked_one_nearest_first(scene, kind):
    scene = of_times(scene, 0.0, 0.25, 0.5, 1.0)
    sampler = Sampler(scene, rays=10, asks=Asks(kind, side=2, neighbours=2))
    seen = {}
    for batch in islice(sampler, 40):
        times = [one.moment.time for one in batch.observations]
        assert batch.time == times[0] == scene.train[batch.frame].time
        seen[batch.frame] = times[1:]
        for one in batch.observations:
            torch.testing.assert_close(one.rgb, shown(scene, one))
        assert kind != "pixels" or [len(one.view) for one in batch.observations] == [4, 3, 3]
    assert seen == {0: [0.25, 0.5], 1: [0.0, 0.5], 2: [0.25, 0.0], 3: [0.5, 0.25]}
    moved = batch.to("cpu")
    assert [one.moment for one in moved.observations] == [one.moment for one in batch.observations]
    assert (moved.frame, len(moved)) == (batch.frame, len(batch))


def test_a_neighbouring_time_is_seen_from_any_of_its_cameras(scene):
    scene = of_times(scene, 0.0, 1.0, 1.0, 1.0)
    sampler = Sampler(scene, rays=4, picker=lambda: 0, asks=Asks(neighbours=3))
    batches = list(islice(sampler, 40))
    assert {len(batch.observations) for batch in batches} == {2}  # there is one other time
    few = Sampler(scene, rays=1, picker=lambda: 0, asks=Asks(neighbours=3)).draw()
    assert [len(one.view) for one in few.observations] == [1]  # none without a pixel
    assert {batch.observations[1].moment.frame for batch in batches} == {1, 2, 3}


def test_pictures_of_the_instant_are_whole_and_over_white(scene):
    scene = of_times(scene, 0.5, 0.0, 0.5, 0.5)
    plain = Sampler(scene, rays=9, background="random", picker=lambda: 2)
    sampler = Sampler(scene, rays=9, background="random", picker=lambda: 2, asks=Asks(instant=2))
    batch = sampler.draw()
    assert torch.equal(rgb_of(batch), rgb_of(plain.draw()))  # they cost no random number
    assert [one.moment.frame for one in batch.instant] == [2, 0]
    for one in batch.instant:
        assert one.view.shape == (6, 8)
        assert torch.equal(one.background, torch.ones(3))
        torch.testing.assert_close(one.rgb, shown(scene, one))
    assert len(batch) == len(batch.to("cpu")) == 9
    assert len(batch.to("cpu").instant) == 2
    assert plain.draw().instant == ()
    alone = Sampler(scene, picker=lambda: 1, asks=Asks(instant=5)).draw()
    assert [one.moment.frame for one in alone.instant] == [1]


ASKED = [{}, {"views_per_step": 3}, *({"asks": Asks(kind, 4, 1)} for kind in ("crops", "pictures"))]


@pytest.mark.parametrize("options", ASKED)
def test_batches_repeat_and_continue_exactly(scene, options):
    scene = of_times(scene, 0.5, 0.5, 0.5, 1.0) if "views_per_step" in options else scene
    options = {"rays": 9, "background": "random", **options}
    sampler = Sampler(scene, **options)
    first = colours(sampler)
    state = sampler.state_dict()
    expected = colours(sampler)
    assert torch.equal(colours(Sampler(scene, **options)), first)
    other = Sampler(scene, seed=5, **options)
    assert not torch.equal(colours(other), first)
    other.load_state_dict(state)
    assert torch.equal(colours(other), expected)


@pytest.mark.parametrize("depth", [False, True])
def test_reduced_truth_is_what_half_resolution_loads(tmp_path, depth):
    splits = {"test": shots(3, 2, (6, 8), depth=depth)}
    write_tiny(tmp_path / "toy", **splits)
    whole, half = (DNeRFDataModule(tmp_path, "toy", half_resolution=halve) for halve in (False, True))
    pairs = list(zip(whole.targets("test").reduced(2), half.targets("test"), strict=True))
    for target, loaded in pairs:
        assert torch.equal(target.rgb, loaded.rgb)
        assert torch.equal(target.foreground, loaded.foreground)
        assert target.depth is None if not depth else torch.equal(target.depth, loaded.depth)
        assert (target.view.shape, loaded.view.shape) == ((6, 8), (3, 4))  # rendered whole


def test_the_real_scene_of_800_pixels_reduced_is_that_of_400():
    wide, small = real("dnerf_800"), real("dnerf")
    whole = DNeRFDataModule(wide, "hellwarrior", half_resolution=False).targets("test").reduced(2)
    assert torch.equal(whole[7].rgb, DNeRFDataModule(wide, "hellwarrior").targets("test")[7].rgb)
    published = DNeRFDataModule(small, "hellwarrior").targets("test")[7].rgb
    assert float((whole[7].rgb - published).abs().max()) <= 1 / 255


def test_what_cannot_be_reduced(tmp_path):
    targets = DNeRFDataModule(write_tiny(tmp_path / "toy").parent, "toy").targets("test")
    with pytest.raises(SceneError, match="reduce: expected pictures with sides that 4 divides, but got 8"):
        targets.reduced(4)
    frame = replace(targets.frames[0], load=MaskedImage(tmp_path, tmp_path, (8, 6)))
    with pytest.raises(SceneError, match="reduce: expected whole pictures, but got test/r_0 cut out"):
        Targets([frame], targets.background, has_alpha=True).reduced(2)
