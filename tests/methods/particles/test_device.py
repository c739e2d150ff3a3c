"""Particles on a GPU that only pretends to be one: no operator is given tensors of two devices."""

import pytest
import torch

from forewarp.methods.method import Start
from forewarp.methods.particles.model import Particles
from forewarp.scene.view import Moment, View
from forewarp.training.objective import set_gradients
from tests.support.elsewhere import GPU, Elsewhere
from tests.support.particles import EVERY, MOVING, module_with, shaken


@pytest.fixture
def elsewhere():
    with Elsewhere() as mode:
        yield mode


def test_what_pretends_to_be_on_a_gpu_is_found_where_it_meets_the_cpu(elsewhere):
    here, there = torch.ones(3), torch.ones(3).to("cuda")
    assert (here.device.type, there.device.type) == ("cpu", "cuda")
    assert (there * 2 + torch.tensor(1.0)).device == GPU
    assert there[torch.tensor([0, 2])].device == torch.nn.Parameter(there).device == GPU
    assert there.cpu().tolist() == [1.0] * 3
    assert torch.zeros(2, device=there.device).device == there.new_zeros(2).device == GPU
    for wrong in (
        lambda: here + there,
        lambda: here * there.sum(),
        lambda: torch.cat([here, there]),
        lambda: torch.einsum("a,a->", there, here),
        lambda: here[there.long()],
    ):
        with pytest.raises(RuntimeError, match=r"expected all tensors on cuda:0|on the CPU"):
            wrong()
    with pytest.raises(TypeError, match="numpy"):
        there.numpy()
    leaf = torch.ones(3).to("cuda").requires_grad_()
    (leaf * leaf).sum().backward()
    assert leaf.grad.device == GPU


def moved_module(data, **options):
    """A module with random parameters on the GPU that pretends."""
    module = shaken(module_with(data, **options))
    module.method.to("cuda")
    return module


@pytest.mark.parametrize(
    "options",
    [
        EVERY | {"background": 10.0},
        EVERY | {"motion": "cosines", "rotation": None, "background": 10.0},
        dict.fromkeys(MOVING),
    ],
    ids=["all", "cosines", "bare"],
)
def test_a_stage_stays_on_its_device(data, elsewhere, options):
    numbers = {"every": 0.1, "relink": 1, "density": 400.0, "settled": 1.0, "rest": 0.3}
    module = moved_module(data, **options, numbers=numbers)
    method, optimizer = module.method, module.configure_optimizers()
    method.warm_up()
    begun = len(method.means)
    for number in range(1, 6):
        method.advance(number / 10, number, optimizer)
        data.picker = lambda number=number: number
        batch = next(iter(data.train_dataloader())).to("cuda")
        factors = {"photo": 1.0, "rigid": 3.0, "smooth": 0.1}
        step = method.look(batch, factors if method.moves else {"photo": 1.0}, module.generator)
        assert {slope.device for slope in step.gradients.values()} == {GPU}
        set_gradients(method, step.gradients)
        optimizer.step()
        optimizer.zero_grad()
        assert {t.device for t in method.state_dict().values()} == {GPU}
    assert len(method.means) > begun
    assert (method.at_rest() > 0) == (options.get("background") == 10.0)


@pytest.mark.parametrize("options", [EVERY, dict.fromkeys(MOVING)], ids=["all", "bare"])
def test_what_others_ask_for_stays_on_its_device(data, elsewhere, options):
    method, camera = moved_module(data, **options).method, data.scene.train[0].camera
    snapshot = method.at(Moment(0.6))
    for view in (View(camera), View(camera, torch.tensor([3, 4])), View(camera, crop=(1, 1, 4, 4))):
        drawn = snapshot.render(view, torch.ones(3))
        assert {part.device for part in vars(drawn).values()} == {GPU}
    points, times = torch.zeros(5, 3), torch.tensor([0.2, 0.8])
    assert method.trajectories(points.to("cuda"), times.to("cuda")).device == GPU
    assert method.bounds([0.0, 0.5]) is not None
    told = [method.matter(), method.ellipsoids(0.3), method.template()]
    parts = [part for one in told for part in vars(one).values() if isinstance(part, torch.Tensor)]
    assert {part.device for part in (*parts, *method.movement([0.1, 0.9]).values())} == {GPU}


def test_a_stage_after_one_that_lies_on_a_gpu_begins_on_the_cpu(data, elsewhere):
    first = moved_module(data, **EVERY).method
    after = Particles(Start(data.scene, "fine", {}, range(3), before=first), **EVERY)
    assert {t.device.type for t in after.state_dict().values()} == {"cpu"}
