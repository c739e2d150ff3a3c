"""Every method on a GPU that only pretends to be one: no operator is given tensors of two devices."""

import pytest
import torch

from forewarp.scene.view import Moment, View
from forewarp.training.objective import set_gradients, total
from tests.contract.fitting import module_of
from tests.contract.scenes import data_of, write_dnerf
from tests.contract.table import METHODS
from tests.support.elsewhere import GPU, Elsewhere


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    write_dnerf(folder / "dnerf")
    return data_of("dnerf", folder)


@pytest.mark.parametrize("name", METHODS)
def test_steps_and_a_picture_stay_on_their_device(data, name):
    module = module_of(METHODS[name], data)
    method = module.method
    with Elsewhere():
        method.to("cuda")
        optimizer = module.configure_optimizers()
        for number in (1, 2):
            method.advance(number / 10, number, optimizer)
            batch = next(iter(data.train_dataloader())).to("cuda")
            factors = module.objective.factors(number)
            step = method.look(batch, factors, module.generator)
            loss, _ = total(step, factors)
            assert loss.device == GPU
            if step.gradients is None:
                loss.backward()
            else:
                set_gradients(method, step.gradients)
            optimizer.step()
            optimizer.zero_grad()
        assert {p.device for p in method.parameters()} == {GPU}
        with torch.no_grad():
            drawn = method.at(Moment(0.5)).render(View(data.scene.train[0].camera), torch.ones(3).to("cuda"))
        assert {part.device for part in vars(drawn).values()} == {GPU}
