"""Every method on a GPU that only pretends to be one: no operator is given tensors of two devices."""

import pytest
import torch

from forewarp.scene.view import Moment, View
from tests.contract.fitting import batch_of, gradients_of, module_of
from tests.contract.scenes import data_of
from tests.contract.table import METHODS
from tests.support.elsewhere import GPU, Elsewhere


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_steps_and_a_picture_stay_on_their_device(scenes, name):
    data = data_of("dnerf", scenes)
    module = module_of(METHODS[name], data)
    method = module.method
    with Elsewhere():
        method.to("cuda")
        optimizer = module.configure_optimizers()
        for number in (1, 2):
            method.advance(number / 10, number, optimizer)
            gradients_of(module, batch_of(data).to("cuda"))
            optimizer.step()
        assert {p.device for p in method.parameters()} == {GPU}
        with torch.no_grad():
            drawn = method.at(Moment(0.5)).render(View(data.scene.train[0].camera), torch.ones(3).to("cuda"))
        assert {part.device for part in vars(drawn).values()} == {GPU}
