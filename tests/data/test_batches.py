"""Ray batches: right colours for the right rays, repeatable, over any background."""

from dataclasses import replace
from itertools import islice

import pytest
import torch

from forewarp.data.batches import Sampler, Targets, color_of, pixels_of
from forewarp.data.dnerf import read_scene
from forewarp.data.images import StoredImage, composited
from forewarp.data.module import DNeRFDataModule
from forewarp.scene.camera import joined
from forewarp.scene.frame import Frame, Scene
from forewarp.scene.view import Asks, Moment
from tests.support.written_scenes import dnerf_shots, refused, write_dnerf


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    root = tmp_path_factory.mktemp("batches")
    write_dnerf(root / "toy")
    return read_scene(root, "toy")


def rays_of(batch):
    """Those of all its pixels, after one another."""
    return joined([observation.view.rays() for observation in batch.observations])


def rgb_of(batch):
    return torch.cat([observation.rgb for observation in batch.observations])


def background_of(batch):
    """The background of every pixel."""
    return torch.cat([o.background.expand(len(o.view), 3) for o in batch.observations])


def colours(batches, count=3):
    return torch.stack([rgb_of(b) for b in islice(batches, count)])


@pytest.mark.parametrize("background", ["white", "black", "random"])
def test_every_ray_carries_the_colour_of_its_pixel(scene, background):
    batch = Sampler(scene, rays=50, background=background).draw()
    frame, rays = scene.train[batch.frame], rays_of(batch)
    pixel = frame.camera.project((rays.origins + rays.directions).double())[0].long()
    rgba = frame.load()[pixel[:, 1], pixel[:, 0]]
    torch.testing.assert_close(rgb_of(batch), composited(rgba, background_of(batch)))
    if background == "random":  # another colour for every pixel
        assert len(background_of(batch).unique(dim=0)) == 50
    else:
        assert torch.equal(background_of(batch), torch.full((50, 3), float(background == "white")))
    assert (batch.time, len(rays), len(batch)) == (frame.time, 50, 50)


def test_all_pixels_and_frames_are_drawn(scene):
    before = torch.get_rng_state()
    batches = list(islice(Sampler(scene, rays=400, background="random"), 60))
    assert {b.frame for b in batches} == {0, 1, 2, 3}
    assert len(rays_of(batches[0]).directions.unique(dim=0)) == 48
    assert torch.equal(torch.get_rng_state(), before)  # the global generator plays no part


def dot(scene):
    """The scene with images of 50x50 pixels, each of which shows 5x5."""
    rgba = torch.zeros(50, 50, 4, dtype=torch.uint8)
    rgba[20:25, 30:35] = 255
    cameras = [replace(frame.camera, width=50, height=50) for frame in scene.train]
    frames = [replace(f, camera=c, load=lambda: rgba) for f, c in zip(scene.train, cameras)]
    return replace(scene, train=tuple(frames), has_alpha=True), rgba[..., 3].flatten() > 0


def test_rays_near_matter_are_drawn_more_often_and_count_less(scene):
    shown, matter = dot(scene)
    draw = Sampler(shown, rays=1000, asks=Asks(near=0.8), views_per_step=1).draw
    found = [draw().observations[0] for _ in range(30)]
    pixels, shares = (torch.cat(part) for part in zip(*((o.view.pixels, o.shares) for o in found)))
    near = shares < 1
    assert near.float().mean().item() == pytest.approx(0.8 + 0.2 * 49 / 2500, abs=0.01)
    assert set(matter.nonzero()[:, 0].tolist()) <= set(pixels[near].tolist())
    assert len(pixels.unique()) > 2000
    for of in (torch.ones(2500), matter.float(), torch.arange(2500) / 2500):  # any mean over the image is met
        assert (of[pixels] * shares).mean().item() == pytest.approx(of.mean().item(), rel=0.05)


def test_rays_count_alike_where_none_is_preferred(scene):
    shown, _ = dot(scene)
    opaque = replace(shown, has_alpha=False)
    for sampler in (Sampler(shown, rays=9), Sampler(opaque, rays=9, asks=Asks(near=0.5))):
        assert sampler.draw().shares() is None
    assert len(Sampler(shown, rays=9, asks=Asks(near=0.5), views_per_step=2).draw().shares()) == 9


def test_the_picker_chooses_the_frame(scene):
    batches, order = Sampler(scene, rays=9), iter([2, 0, 3])
    batches.picker = lambda: next(order)
    assert [b.frame for b in islice(batches, 3)] == [2, 0, 3]
    batches.picker = lambda: 4
    with pytest.raises(ValueError, match=r"picker: expected a training frame in \[0, 4\), but got 4"):
        batches.draw()


BAD = [
    ({"background": "blue"}, "data.background: expected white, black or random, but got 'blue'"),
    ({"rays": 0}, "data.rays: expected at least 1, but got 0"),
    ({"views_per_step": 0}, "data.views_per_step: expected at least 1, but got 0"),
    ({"rays": None}, "data.rays: expected a number, as the method is trained on single rays, but got null"),
]


@pytest.mark.parametrize(("options", "match"), BAD)
def test_bad_settings(scene, options, match):
    with refused(match):
        Sampler(scene, **options).draw()
    assert len(Sampler(scene, rays=None, views_per_step=8, asks=Asks("pictures")).draw().observations) == 1
    with refused("data.eval_background: expected white or black, but got 'random'"):
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
    assert target.moment.frame is None
    assert [t.moment.frame for t in Targets(scene.train, torch.ones(3), True, trained=True)] == [0, 1, 2, 3]


def test_a_reader_that_gives_no_image_is_refused(scene):
    frame = replace(scene.train[0], load=lambda: torch.zeros(6, 8, 3))
    with refused(r"r_0: expected a picture as a torch.uint8 tensor"):
        pixels_of(frame)


def of_times(scene: Scene, *times: float) -> Scene:
    """The scene with these times and its cameras' ranges made different."""
    frames = [
        replace(frame, time=t, camera=replace(frame.camera, near=2 + 0.1 * i, far=6 + i))
        for i, (frame, t) in enumerate(zip(scene.train, times, strict=True))
    ]
    return replace(scene, train=tuple(frames))


def shown(scene, observation):
    """What an observation should show, of its frame's own image."""
    whole, rows = scene.train[observation.moment.frame].load().reshape(-1, 4), observation.view.indices
    return composited(whole if rows is None else whole[rows], observation.background)


def test_a_batch_may_have_rays_of_several_frames_of_one_time(scene):
    scene, seen = of_times(scene, 0.5, 0.0, 0.5, 0.5), set()
    batches = Sampler(scene, rays=50, background="random", views_per_step=2, picker=lambda: 2)
    for batch in islice(batches, 20):
        frames = [observation.moment.frame for observation in batch.observations]
        assert frames[0] == 2
        assert [len(observation.view) for observation in batch.observations] == [25, 25]
        seen |= set(frames)
        for observation in batch.observations:
            torch.testing.assert_close(observation.rgb, shown(scene, observation))
        cameras, rays = [scene.train[i].camera for i in frames], rays_of(batch)
        assert (batch.time, batch.frame, len(rays)) == (0.5, 2, 50)
        assert (rays.near, rays.far) == (min(c.near for c in cameras), max(c.far for c in cameras))
    assert seen == {0, 2, 3}
    for rays, count in ((50, 3), (2, 2)):  # more views than there are, or than rays
        batch = Sampler(scene, rays=rays, views_per_step=8, picker=lambda: 2).draw()
        assert len(batch.observations) == count


@pytest.mark.slow
@pytest.mark.parametrize("background", ["white", "random"])
def test_crops_are_square_parts_of_an_image_over_one_colour(scene, background):
    sampler, corners = Sampler(scene, background=background, asks=Asks("crops", side=3)), set()
    for batch in islice(sampler, 400):
        (crop,) = batch.observations
        top, left, height, width = crop.view.crop
        assert (height, width) == crop.view.shape == (3, 3)
        assert crop.background.shape == (3,)
        image = scene.train[batch.frame].load()[top : top + 3, left : left + 3].reshape(-1, 4)
        torch.testing.assert_close(crop.rgb, composited(image, crop.background))
        assert crop.moment == Moment(scene.train[batch.frame].time, batch.frame, filmed=True)
        corners.add((top, left))
    assert corners == {(top, left) for top in range(4) for left in range(6)}  # of 6 x 8 pixels
    (whole,) = Sampler(scene, asks=Asks("crops", side=7)).draw().observations
    assert whole.view.shape == (6, 7)  # never larger than the image


@pytest.mark.parametrize("kind", ["pixels", "crops", "pictures"])
def test_neighbouring_times_come_after_the_picked_one_nearest_first(scene, kind):
    scene, seen = of_times(scene, 0.0, 0.25, 0.5, 1.0), {}
    for batch in islice(Sampler(scene, rays=10, asks=Asks(kind, side=2, neighbours=2)), 40):
        times = [observation.moment.time for observation in batch.observations]
        assert batch.time == times[0] == scene.train[batch.frame].time
        seen[batch.frame] = times[1:]
        for observation in batch.observations:
            torch.testing.assert_close(observation.rgb, shown(scene, observation))
        assert kind != "pixels" or [len(o.view) for o in batch.observations] == [4, 3, 3]
    assert seen == {0: [0.25, 0.5], 1: [0.0, 0.5], 2: [0.25, 0.0], 3: [0.5, 0.25]}


def test_a_neighbouring_time_is_seen_from_any_of_its_cameras(scene):
    scene = of_times(scene, 0.0, 1.0, 1.0, 1.0)
    batches = islice(Sampler(scene, rays=4, picker=lambda: 0, asks=Asks(neighbours=3)), 40)
    pairs = [[observation.moment.frame for observation in batch.observations] for batch in batches]
    assert {len(pair) for pair in pairs} == {2}  # there is one other time
    assert {pair[1] for pair in pairs} == {1, 2, 3}
    few = Sampler(scene, rays=1, picker=lambda: 0, asks=Asks(neighbours=3)).draw()
    assert [len(observation.view) for observation in few.observations] == [1]  # none without a pixel


def test_images_of_the_instant_are_whole_and_over_white(scene):
    scene = of_times(scene, 0.5, 0.0, 0.5, 0.5)
    options = {"rays": 9, "background": "random", "picker": lambda: 2}
    plain, batch = Sampler(scene, **options).draw(), Sampler(scene, **options, asks=Asks(instant=2)).draw()
    assert torch.equal(rgb_of(batch), rgb_of(plain))  # they cost no random number
    assert [image.moment.frame for image in batch.to("cpu").instant] == [2, 0]
    for image in batch.instant:
        assert image.view.shape == (6, 8)
        assert torch.equal(image.background, torch.ones(3))
        torch.testing.assert_close(image.rgb, shown(scene, image))
    assert (len(batch), len(batch.to("cpu")), plain.instant) == (9, 9, ())


ASKED = [{}, {"views_per_step": 3}, *({"asks": Asks(kind, 4, 1)} for kind in ("crops", "pictures"))]


@pytest.mark.parametrize("options", ASKED)
def test_batches_repeat_and_continue_exactly(scene, options):
    scene = of_times(scene, 0.5, 0.5, 0.5, 1.0) if "views_per_step" in options else scene
    options = {"rays": 9, "background": "random", **options}
    sampler = Sampler(scene, **options)
    first, state, expected = colours(sampler), sampler.state_dict(), colours(sampler)
    assert torch.equal(colours(Sampler(scene, **options)), first)
    other = Sampler(scene, seed=5, **options)
    assert not torch.equal(colours(other), first)
    other.load_state_dict(state)
    assert torch.equal(colours(other), expected)


@pytest.mark.slow
@pytest.mark.parametrize("depth", [False, True])
def test_reduced_truth_is_what_half_resolution_loads(tmp_path, depth):
    write_dnerf(tmp_path / "toy", test=dnerf_shots(3, 2, (6, 8), depth=depth))
    whole, half = (DNeRFDataModule(tmp_path, "toy", half_resolution=halve) for halve in (False, True))
    for target, loaded in zip(whole.targets("test").reduced(2), half.targets("test"), strict=True):
        assert torch.equal(target.rgb, loaded.rgb)
        assert torch.equal(target.foreground, loaded.foreground)
        assert target.depth is None if not depth else torch.equal(target.depth, loaded.depth)
        assert (target.view.shape, loaded.view.shape) == ((6, 8), (3, 4))  # rendered whole


def test_what_cannot_be_reduced(scene, tmp_path):
    targets = Targets(scene.test, torch.ones(3), has_alpha=True)
    with refused("reduce: expected pictures with sides that 4 divides, but got 8"):
        targets.reduced(4)
    frame = replace(scene.test[0], load=StoredImage(tmp_path, (8, 6), mask=tmp_path))
    with refused("reduce: expected whole pictures, but got test/r_0 cut out"):
        Targets([frame], torch.ones(3), has_alpha=True).reduced(2)
