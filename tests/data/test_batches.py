"""Ray batches: right colours for the right rays, repeatable, over any background."""

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
    return Scene(scene.name, scene.train, scene.val, scene.test, scene.box, 0.0, has_alpha=False)


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
    with pytest.raises(
        SceneError, match="data.background: .* but got random and toy has images without alpha"
    ):
        RayBatches(opaque(scene), background="random")
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
