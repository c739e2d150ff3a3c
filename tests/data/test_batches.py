"""Ray batches: right colours for the right rays, repeatable, over any background."""

from dataclasses import replace
from functools import partial
from itertools import islice

import pytest
import torch
from dnerf_scene import write_tiny

from forewarp.data.batches import RayBatches, Targets, color_of
from forewarp.data.dnerf import read_scene
from forewarp.data.images import composited
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Frame, Scene


@pytest.fixture
def scene(tmp_path) -> Scene:
    write_tiny(tmp_path / "toy")
    return read_scene(tmp_path, "toy")


def opaque(scene: Scene) -> Scene:
    """The same images without an alpha channel, as a reader gives them: 255 everywhere."""

    def load(frame):
        pixels = frame.load().clone()
        pixels[..., 3] = 255
        return pixels

    train = tuple(replace(f, load=partial(load, f)) for f in scene.train)
    return replace(scene, train=train, has_alpha=False)


def colours(batches, count=3):
    return torch.stack([b.rgb for b in islice(batches, count)])


@pytest.mark.parametrize("background", ["white", "black", "random"])
def test_every_ray_carries_the_colour_of_its_pixel(scene, background):
    batch = RayBatches(scene, rays=50, background=background).draw()
    frame = scene.train[batch.frame]
    ahead = batch.rays.origins + batch.rays.directions
    pixel = frame.camera.project(ahead.double())[0].long()
    rgba = frame.load()[pixel[:, 1], pixel[:, 0]]
    torch.testing.assert_close(batch.rgb, composited(rgba, batch.background))
    assert batch.time == frame.time
    assert batch.rays.directions.norm(dim=-1).allclose(torch.ones(50))
    assert len(batch.rays) == 50


def test_backgrounds(scene):
    assert torch.equal(RayBatches(scene, background="white").draw().background, torch.ones(3))
    assert torch.equal(RayBatches(scene, background="black").draw().background, torch.zeros(3))
    random = RayBatches(scene, rays=500, background="random")
    first, second = random.draw().background, random.draw().background
    assert first.shape == (500, 3)
    assert len(first.unique(dim=0)) == 500
    assert not torch.equal(first, second)


def test_behind_an_opaque_pixel_a_random_colour_does_not_show(scene):
    batch = RayBatches(opaque(scene), rays=60, background="random").draw()
    assert len(batch.background.unique(dim=0)) == 60
    frame = opaque(scene).train[batch.frame]
    pixel = frame.camera.project((batch.rays.origins + batch.rays.directions).double())[0].long()
    torch.testing.assert_close(batch.rgb, frame.load()[pixel[:, 1], pixel[:, 0], :3] / 255)


def test_all_pixels_and_frames_are_drawn(scene):
    batches = list(islice(RayBatches(scene, rays=400), 60))
    assert {b.frame for b in batches} == {0, 1, 2, 3}
    assert len(batches[0].rays.directions.unique(dim=0)) == 48


def test_the_seed_decides(scene):
    assert torch.equal(colours(RayBatches(scene, rays=9, seed=1)), colours(RayBatches(scene, rays=9, seed=1)))
    assert not torch.equal(
        colours(RayBatches(scene, rays=9, seed=1)), colours(RayBatches(scene, rays=9, seed=2))
    )


def test_the_global_generator_plays_no_part(scene):
    before = torch.get_rng_state()
    RayBatches(scene, background="random").draw()
    assert torch.equal(torch.get_rng_state(), before)


def test_a_saved_state_continues_exactly(scene):
    batches = RayBatches(scene, rays=9, background="random")
    colours(batches)
    state = batches.state_dict()
    expected = colours(batches)
    other = RayBatches(scene, rays=9, background="random", seed=5)
    other.load_state_dict(state)
    assert torch.equal(colours(other), expected)


def test_the_picker_chooses_the_frame(scene):
    batches = RayBatches(scene, rays=9)
    order = iter([2, 0, 3])
    batches.picker = lambda: next(order)
    assert [b.frame for b in islice(batches, 3)] == [2, 0, 3]
    batches.picker = lambda: 4
    with pytest.raises(ValueError, match=r"picker: expected a training frame in \[0, 4\), but got 4"):
        batches.draw()


def test_bad_settings(scene):
    with pytest.raises(SceneError, match="data.background: expected white, black or random, but got 'blue'"):
        RayBatches(scene, background="blue")
    with pytest.raises(SceneError, match="data.rays: expected at least 1, but got 0"):
        RayBatches(scene, rays=0)
    with pytest.raises(SceneError, match="data.eval_background: expected white or black, but got 'random'"):
        color_of("random")


def test_targets_are_loaded_when_asked_for(scene):
    loads = []

    def load():
        loads.append(1)
        return torch.tensor([[[255, 0, 0, 255], [255, 0, 0, 0], [255, 0, 0, 127]]], dtype=torch.uint8)

    frame = Frame("a", 0.0, scene.train[0].camera, load, lambda: torch.tensor([[1.0, 0.0, 2.0]]))
    targets = Targets([frame], color_of("black"), has_alpha=True)
    assert (len(targets), loads) == (1, [])
    target = targets[0]
    torch.testing.assert_close(target.rgb[0, :, 0], torch.tensor([1, 0, 127 / 255]))
    assert target.foreground.tolist() == [[True, False, False]]
    assert target.depth.tolist() == [[1, 0, 2]]
    assert Targets([frame], color_of("black"), has_alpha=False)[0].foreground.tolist() == [
        [True, False, True]
    ]
    assert [t.frame.name for t in targets] == ["a"]


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
    return (batch.rays.origins[:, None] - centers).norm(dim=-1).argmin(-1)


def test_a_batch_may_have_rays_of_several_frames_of_one_time(scene):
    scene = of_times(scene, 0.5, 0.0, 0.5, 0.5)
    batches = RayBatches(scene, rays=50, background="random", views_per_step=2, picker=lambda: 2)
    seen = set()
    for batch in islice(batches, 20):
        frames = frames_of(batch, scene)
        one, other = frames.unique().tolist()
        assert 2 in (one, other)
        assert torch.bincount(frames).max() == 25
        seen |= {one, other}
        used = [scene.train[i].camera for i in (one, other)]
        assert (batch.time, batch.frame, len(batch.rays)) == (0.5, 2, 50)
        assert batch.rays.near == min(c.near for c in used)
        assert batch.rays.far == max(c.far for c in used)
        for i, rgb, direction, behind in zip(frames, batch.rgb, batch.rays.directions, batch.background):
            frame = scene.train[i]
            pixel = frame.camera.project(frame.camera.center + direction.double())[0].long()
            torch.testing.assert_close(rgb, composited(frame.load()[pixel[1], pixel[0]], behind))
    assert seen == {0, 2, 3}


def test_more_views_than_there_are_takes_all_of_the_time(scene):
    scene = of_times(scene, 0.5, 0.0, 0.5, 0.5)
    batches = RayBatches(scene, rays=50, views_per_step=8)
    picks = {batch.frame: frames_of(batch, scene).unique().tolist() for batch in islice(batches, 40)}
    assert picks == {0: [0, 2, 3], 1: [1], 2: [0, 2, 3], 3: [0, 2, 3]}
    few = RayBatches(scene, rays=2, views_per_step=8, picker=lambda: 0).draw()
    assert len(frames_of(few, scene).unique()) == 2


def test_batches_of_several_views_repeat_and_continue_exactly(scene):
    scene = of_times(scene, 0.5, 0.5, 0.5, 0.5)
    options = {"rays": 9, "background": "random", "views_per_step": 3}
    batches = RayBatches(scene, **options)
    first = colours(batches)
    state = batches.state_dict()
    expected = colours(batches)
    assert torch.equal(colours(RayBatches(scene, **options)), first)
    other = RayBatches(scene, seed=5, **options)
    other.load_state_dict(state)
    assert torch.equal(colours(other), expected)


def test_one_view_a_step_draws_what_it_always_drew(scene):
    """Times that are shared change nothing where one frame gives all rays."""
    same = of_times(scene, 0.5, 0.5, 0.5, 0.5)
    assert torch.equal(colours(RayBatches(scene, rays=9)), colours(RayBatches(same, rays=9)))
    with pytest.raises(SceneError, match="data.views_per_step: expected at least 1, but got 0"):
        RayBatches(scene, views_per_step=0)
