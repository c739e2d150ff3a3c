"""What the toy method shows: gradients of its own, rows that come and go, neighbouring pictures."""

from dataclasses import replace

import pytest
import torch

from forewarp.methods.method import Start
from forewarp.scene.batch import Batch
from forewarp.scene.cloud import Cloud, Handover
from forewarp.training.checkpoints import misfits
from forewarp.training.objective import total
from tests.contract.fitting import module_of
from tests.contract.scenes import data_of
from tests.contract.table import METHODS


@pytest.fixture
def data(scenes):
    return data_of("dnerf", scenes)


def splats_of(data, **changes):
    """A module of splats that differ from each other in everything."""
    module = module_of(METHODS["splats"], data, **changes)
    with torch.no_grad():
        for parameter in module.method.parameters():
            parameter += 0.3 * torch.randn(parameter.shape)
    return module


@pytest.mark.parametrize("dataset", ["dnerf", "hypernerf"])  # without a lens and with one
@pytest.mark.parametrize("weights", [{"photo": 1.0, "sparse": 0.1}, {"photo": 2.0}])
def test_the_fused_gradients_are_those_of_autograd(dataset, weights, scenes):
    data = data_of(dataset, scenes)
    module = splats_of(data, weights=weights)
    method, batch = module.method, next(iter(data.train_dataloader()))
    assert len(batch.observations) == 2  # a neighbouring time beside the picked one
    assert method.velocity.abs().amax() > 0
    module.training_step(batch, 0).backward()
    found = {name: p.grad.clone() for name, p in method.named_parameters()}
    method.zero_grad()
    errors = [(drawn_of(method, one).rgb - one.rgb).square().mean() for one in batch.observations]
    raw = {"photo": sum(errors) / 2, "sparse": torch.sigmoid(method.opacity).mean()}
    sum(weight * raw[name] for name, weight in weights.items()).backward()
    for name, p in method.named_parameters():
        torch.testing.assert_close(
            found[name], p.grad, atol=1e-3 * float(p.grad.abs().amax()), rtol=1e-3, msg=name
        )


def drawn_of(method, one):
    return method.at(one.moment).render(one.view, one.background)


def test_the_loss_of_a_fused_step_needs_no_graph(data):
    module = splats_of(data)
    step = module.look(next(iter(data.train_dataloader())), {"photo": 1.0})
    assert not any(term().requires_grad for term in step.terms.values())
    loss, raw = total(step, {"photo": 1.0}, dict(module.method.named_parameters()))
    assert loss.requires_grad
    assert raw.keys() == {"photo"}


def test_rows_are_forgotten_and_split_and_their_moments_follow(data):
    module = splats_of(data)
    method, optimizer = module.method, module.configure_optimizers()
    assert isinstance(optimizer, torch.optim.RMSprop)
    module.training_step(next(iter(data.train_dataloader())), 0).backward()
    optimizer.step()
    with torch.no_grad():
        method.opacity[:10] = -9.0
    count, pull = len(method.opacity), method.pull.clone()
    moments = optimizer.state[method.position]["square_avg"].clone()
    radius = method.radius.detach().clone()
    method.advance(0.5, method.every, optimizer)
    alive = torch.arange(10, count)
    torn = alive[pull[alive].topk(7).indices]
    rows = torch.cat([alive, torn])
    assert method.size == ("splats", len(rows))
    assert torch.equal(optimizer.state[method.position]["square_avg"], moments[rows])
    assert torch.equal(method.radius[: len(alive)], radius[alive])
    torch.testing.assert_close(method.radius[len(alive) :], radius[torn] - 0.7)
    assert {id(p) for g in optimizer.param_groups for p in g["params"]} == set(map(id, method.parameters()))
    module.training_step(next(iter(data.train_dataloader())), 0).backward()
    optimizer.step()  # and goes on


def test_splats_begin_where_the_stage_before_ended(data):

    data.setup("fit")
    points = torch.tensor([[0.1, 0.2, 0.3], [-0.3, 0.0, 0.1]])
    cloud = Cloud(points, torch.tensor([[0.9, 0.1, 0.1], [0.1, 0.1, 0.9]]), torch.ones(2), 0.05)
    start = Start(data.scene, "fine", {"count": 30}, handover=Handover(data.scene.box, True, 6, cloud))
    method = METHODS["splats"].model(start)
    assert torch.cdist(method.position, points).amin(-1).amax() < 1e-6
    torch.testing.assert_close(torch.sigmoid(method.color).amax(-1), torch.full((30,), 0.9))
    blank = METHODS["splats"].model(replace(start, blank=True))
    assert torch.cdist(blank.position, points).amin(-1).amax() > 0.01


def test_what_it_asks_for_is_what_it_gets(data):
    module_of(METHODS["splats"], data)
    batch = next(iter(data.train_dataloader()))
    assert isinstance(batch, Batch)
    camera = data.scene.train[batch.frame].camera
    assert batch.observations[0].view.shape == (camera.height, camera.width)
    times = [one.moment.time for one in batch.observations]
    assert abs(times[0] - times[1]) == pytest.approx(0.2)
    module_of(METHODS["forward"], data)
    batch = next(iter(data.train_dataloader()))
    assert [len(one.view) for one in batch.observations] == [192]


def test_a_checkpoint_may_have_other_rows_but_no_other_columns(data):
    one, other = (splats_of(data, numbers={"count": count}) for count in (20, 30))
    assert misfits(one, other.state_dict()) == []
    one.load_state_dict(other.state_dict())
    assert torch.equal(one.method.pull, other.method.pull)
    wrong = other.state_dict() | {"method.color": torch.zeros(30, 4)}
    assert misfits(one, wrong) == ["method.color"]
