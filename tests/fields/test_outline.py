import torch
from torch import nn
from torch.nn import functional

from forewarp.fields.outline import outline


def test_steps_are_those_that_ran_and_lead_to_the_result():
    layer, unused, last = nn.Conv2d(2, 5, 3, padding=1), nn.Conv2d(2, 7, 1), nn.Linear(7, 4)

    def network(x):
        unused(x)
        y = functional.relu(layer(x), inplace=True)
        y = torch.cat([functional.interpolate(functional.max_pool2d(y, 2), scale_factor=2.0), x], 1)
        return last(y.movedim(1, -1)).movedim(-1, 1)

    steps = outline(network, torch.zeros(1, 2, 6, 8))
    assert " ".join(step["does"] for step in steps) == "input conv2d relu max_pool2d interpolate cat linear"
    assert [step["from"] for step in steps] == [[], [0], [1], [2], [3], [4, 0], [5]]
    shapes = [[2, 6, 8], [5, 6, 8], [5, 6, 8], [5, 3, 4], [5, 6, 8], [7, 6, 8], [4, 6, 8]]
    assert [step["shape"] for step in steps] == shapes
    assert [step["parameters"] for step in steps] == [0, 2 * 5 * 9 + 5, 0, 0, 0, 0, 7 * 4 + 4]
    assert [step.get("kernel") for step in steps] == [None, [3, 3], None, None, None, None, [1, 1]]
