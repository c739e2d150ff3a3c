"""Images that are made smaller for a step."""

from dataclasses import replace

import torch

from forewarp.scene.camera import Camera
from forewarp.scene.view import Moment, Observation, View


def test_smaller_images_are_means_by_alpha_valid_where_all_is_and_as_deep_as_their_middle():
    camera = Camera(5, 4, 8.0, 8.0, 2.5, 2.0, torch.eye(4, dtype=torch.float64), 0.1, 9.0)
    rgb = torch.zeros(4, 5, 4, dtype=torch.uint8)
    rgb[..., 3] = 255
    rgb[:2, :2, 0] = torch.tensor([[10, 20], [30, 40]])
    rgb[2, 0] = torch.tensor([200, 100, 0, 0])  # seen through: its colour does not count
    rgb[2:, 1, 1], rgb[3, 0, 1] = 60, 60
    valid = torch.ones(4, 5, dtype=torch.bool)
    valid[0, 4] = False
    sensed = torch.arange(40.0).reshape(2, 4, 5)
    beside = valid.flatten(), sensed.flatten(1)
    whole = Observation(Moment(0.5, 3), View(camera), rgb.reshape(-1, 4), torch.ones(3), *beside)
    small = whole.smaller(2)
    assert (small.moment, small.view.shape) == (whole.moment, (2, 2))
    assert small.view.camera.fx == 8.0 * 2 / 5
    assert small.view.camera.fy == 4.0
    colors = small.rgb.reshape(2, 2, 4)
    assert colors.dtype == torch.uint8
    # Of five columns each of two takes three; that in the middle belongs to both.
    assert colors[0, 0].tolist() == [round(100 / 6), 0, 0, 255]
    assert colors[1, 0].tolist() == [0, round(180 / 5), 0, round(255 * 5 / 6)]
    assert small.valid.tolist() == [True, False, True, True]
    assert small.sensed.shape == (2, 4)
    assert small.sensed[0].tolist() == [6.0, 8.0, 16.0, 18.0]
    valid = torch.arange(20) % 2 == 0
    assert replace(whole, valid=valid).smaller(2).valid is valid
    assert small.background is whole.background
    assert whole.rgb.shape == (20, 4)
